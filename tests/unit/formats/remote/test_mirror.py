"""Folders and files behind URLs: what is fetched and how much, bounded, and gone when the drive is closed."""

import hashlib
import json
import os
import pickle
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest
from tests.unit.formats.conftest import digest

import sceneloom
from sceneloom.batch.jobs import find_inputs
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError, UnknownFormatError
from sceneloom.formats.remote import mirror, stores
from sceneloom.formats.remote.mirror import fetch
from sceneloom.formats.remote.uploads import MARKER
from sceneloom.scene import LazyFrames, LidarFrame, LidarPoints, LidarSensor, Scene
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

COUNT = 40
POINTS = 8_000
IMAGES = 200
FILE = POINTS * 16
"""What one of the clouds takes [bytes]; more than the beginning of a file that is looked at."""


def cloud(number):
    return np.random.default_rng(number).uniform(-9, 9, (POINTS, 3)).astype(np.float32)


@pytest.fixture
def clouds(tmp_path, monkeypatch):
    """A folder of clouds, which a store of this machine serves."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    bright = np.full(POINTS, 7, np.uint8)
    frames = [LidarFrame(k * 100_000_000, LidarPoints(cloud(k), bright)) for k in range(COUNT)]
    lidar = LidarSensor("top", LazyFrames.of(frames, [frame.timestamp_ns for frame in frames]))
    sceneloom.write(Scene((lidar,)), tmp_path / "clouds", format="kitti-bin")
    return tmp_path / "clouds"


@pytest.fixture
def fetched(monkeypatch):
    """Names of the files that were fetched whole."""
    names, get = [], stores.Store.get

    def noted(self, target):
        names.append(Path(self.path).name)
        get(self, target)

    monkeypatch.setattr(stores.Store, "get", noted)
    return names


def numbers(names, folder):
    """Which of the clouds they are."""
    order = sorted(path.name for path in folder.glob("*.bin"))
    return sorted(order.index(name) for name in names if name.endswith(".bin"))


def check(scene, *numbers):
    for k in numbers:
        np.testing.assert_array_equal(scene.lidars[0].frames[k].points.positions, cloud(k))


def test_a_frame_costs_its_own_file_and_files_are_fetched_ahead_of_who_reads_on_and_each_once(clouds, fetched):
    with sceneloom.open(f"local://{clouds}") as scene:
        assert numbers(fetched, clouds) == [0], "what brightness means is known by the first one"
        check(scene, 17, 17, 3)
        assert numbers(fetched, clouds) == [0, 3, 17]
        check(scene, *range(10, 20))
    found = numbers(fetched, clouds)
    assert found == sorted(set(found))
    assert {0, 3, *range(10, 20)} <= set(found) <= {0, 3, *range(10, 20 + mirror._AHEAD)}
    assert len(found) > 12


def test_no_more_stays_on_disk_than_may_and_what_went_comes_again(clouds, fetched, monkeypatch):
    monkeypatch.setattr(mirror, "_STAY", 2)
    location = fetch(f"local://{clouds}", largest=6 * FILE)
    with sceneloom.open(location.path) as scene:
        for _ in range(2):
            for k in (2, 5, 9, 14, 20, 26, 30, 33, 37):
                check(scene, k)
                used = sum(path.stat().st_blocks * 512 for path in Path(str(location.path)).iterdir())
                assert used <= 6 * (FILE + 4096)
    assert len(numbers(fetched, clouds)) == 19
    location.remove()


@pytest.mark.parametrize("change", ["longer", "newer", "removed"])
@pytest.mark.few(1)
def test_a_file_that_changed_since_the_folder_was_opened_is_an_error(clouds, change):
    with sceneloom.open(f"local://{clouds}") as scene:
        file = sorted(clouds.glob("*.bin"))[7]
        content = file.read_bytes()
        file.unlink()
        if change != "removed":
            file.write_bytes(content + bytes(16) * (change == "longer"))
            os.utime(file, (1, 1))
        expected = "cannot be found" if change == "removed" else "was changed after it was opened|the server gave"
        with pytest.raises(DataError, match=f"{file.name}.*({expected})"):
            _ = scene.lidars[0].frames[7].points.positions


READER = """
import hashlib, json, pickle, sys
with open(sys.argv[1], "rb") as file:
    scene = pickle.load(file)
stated = [hashlib.sha256(scene.lidars[0].frames[k].points.positions.tobytes()).hexdigest() for k in (30, 31, 32, 33)]
scene.close()
print(json.dumps(stated))
"""


def test_other_processes_fetch_what_they_read(clouds, tmp_path):
    with sceneloom.open(f"local://{clouds}") as scene:
        parcel = tmp_path / "scene.pickle"
        parcel.write_bytes(pickle.dumps(scene))
        assert parcel.stat().st_size < FILE / 4
        command = [sys.executable, "-W", "error", "-c", READER, str(parcel)]
        done = [subprocess.run(command, capture_output=True, text=True, check=False) for _ in range(2)]
        expected = [hashlib.sha256(cloud(k).tobytes()).hexdigest() for k in (30, 31, 32, 33)]
        for one in done:
            assert one.returncode == 0, one.stderr
            assert json.loads(one.stdout) == expected
        # and what they closed is still there for this one
        check(scene, 30)


@pytest.fixture
def filmed(tmp_path, monkeypatch):
    """A recording with an mp4 of noise, in groups of ten images; a store of this machine serves it."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    for name, size in (("_WORTHWHILE", 100_000), ("HEAD", 8192), ("PIECE", 16384)):
        monkeypatch.setattr(mirror, name, size)
    camera_model = dict.fromkeys(("focalLengthX", "focalLengthY"), 90) | {"model": "pinhole"}
    camera_model |= dict.fromkeys(("principalPointX", "principalPointY"), 64)
    camera = {"cameraInd": 0, "cameraParameters": camera_model, "imuToCamera": np.eye(4).tolist()}
    lines = [{"time": 0.1 * k, "number": k, "frames": [camera]} for k in range(IMAGES)]
    folder = tmp_path / "filmed"
    folder.mkdir()
    (folder / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    rng = np.random.default_rng(3)
    with av.open(folder / "data.mp4", "w") as movie:
        stream = movie.add_stream("libx264", rate=10, options={"preset": "ultrafast", "g": "10", "bf": "2"})
        stream.width = stream.height = 128
        for _ in lines:
            frame = av.VideoFrame.from_ndarray(rng.integers(0, 256, (128, 128, 3), np.uint8), format="rgb24")
            movie.mux(stream.encode(frame))
        movie.mux(stream.encode())
    return folder


def test_images_of_an_mp4_come_in_chunks_until_much_of_it_was_read_and_not_of_one_that_changed(
    filmed, fetched, monkeypatch
):
    sent, read = [], stores.Handle.read

    def counted(self, start, stop, **how):
        sent.append(stop - start)
        return read(self, start, stop, **how)

    monkeypatch.setattr(stores.Handle, "read", counted)
    size = (filmed / "data.mp4").stat().st_size
    with sceneloom.open(filmed) as local, sceneloom.open(f"local://{filmed}") as scene:
        expected, images = local.cameras[0].images, scene.cameras[0].images
        assert len(images) == IMAGES
        elsewhere = pickle.loads(pickle.dumps(images))
        for k in (101, 102):
            np.testing.assert_array_equal(elsewhere[k].rgb, expected[k].rgb)
        np.testing.assert_array_equal(images[102].rgb, expected[102].rgb)
        assert fetched == ["data.jsonl"]
        assert sum(sent) < size / 4
        for k in range(IMAGES):
            np.testing.assert_array_equal(images[k].rgb, expected[k].rgb)
        assert fetched == ["data.jsonl", "data.mp4"]
        with scene.cameras[0].video.open() as video:
            assert video.read() == (filmed / "data.mp4").read_bytes()
    with sceneloom.open(f"local://{filmed}") as scene:
        content = bytearray((filmed / "data.mp4").read_bytes())
        content[len(content) // 2] ^= 1
        (filmed / "data.mp4").write_bytes(content)
        with pytest.raises(DataError, match="was changed after it was opened"):
            _ = scene.cameras[0].images[101].rgb


def test_the_beginning_of_a_file_is_fetched_alone_and_what_gets_around_the_fetching_finds_nothing_not_zeros(
    clouds, fetched
):
    location = fetch(f"local://{clouds}")
    first, other, *_ = sorted(location.path.glob("*.bin"))
    content = (clouds / first.name).read_bytes()
    assert first.stat().st_size == FILE
    assert Path(str(first)).read_bytes() == b""
    with first.open("rb") as file:
        assert file.read(100) == content[:100]
        assert file.seek(-100, os.SEEK_END) == FILE - 100
        assert file.seek(50) == file.tell() == 50
        assert (file.read(10), fetched) == (content[50:60], [])
        assert (file.read(), fetched) == (content[60:], [first.name])
    assert (len(first.read_bytes()), Path(str(first)).stat().st_size) == (FILE, FILE)
    with other.open("rb", buffering=0) as file:
        assert os.fstat(file.fileno()).st_size == FILE
    location.remove()
    with pytest.raises(FileNotFoundError):
        first.read_bytes()


@pytest.fixture(scope="module")
def drive():
    camera_model = Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5)
    spec = LidarSpec(beams=8, steps=90)
    return simulate_street(1, frames=4, lidar=spec, cameras=(CameraSpec(camera_model),)).scene


@pytest.mark.few(7)
@pytest.mark.parametrize(
    ("form", "options"),
    [
        *[("recording", {"images": kind}) for kind in ("png", "ffv1", "h264")],
        *[(form, {}) for form in ("nuscenes", "pcd", "ply", "las", "laz", "nuscenes-bin", "npz", "ros2")],
        *[(form, {}) for form in ("kitti-raw", "kitti-odometry", "kitti-object", "kitti-tracking")],
    ],
)
def test_folders_of_all_formats_hold_what_they_hold_on_disk(drive, tmp_path, form, options):
    sceneloom.write(drive, tmp_path / "drive", format=form, **options)
    with sceneloom.open(tmp_path / "drive") as local, sceneloom.open(f"local://{tmp_path}/drive") as remote:
        assert remote.format == local.format == form
        assert digest(remote) == digest(local)
        assert len(local.lidars[0].frames) == 4


def test_a_connection_that_is_busy_while_a_drive_is_closed_ends_with_its_answer(clouds, monkeypatch):
    closed, read, close = [], stores.Handle.read, stores.Handle.close
    location = fetch(f"local://{clouds}")
    fetching = mirror.mirror_of(location.path)

    def slow(self, start, stop, **how):
        found = read(self, start, stop, **how)
        fetching.close()
        return found

    monkeypatch.setattr(stores.Handle, "read", slow)
    monkeypatch.setattr(stores.Handle, "close", lambda self: (closed.append(self), close(self))[1])
    assert len(fetching.piece(fetching.listing.files[0], 0)) == min(FILE, mirror.PIECE)
    assert len(closed) == 1


CLOUD = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nHEIGHT 1\nDATA ascii\n{} 0 0\n"


@pytest.fixture
def bucket(memory, monkeypatch, tmp_path):
    """A store in memory with a folder of five clouds and a marker; what is fetched goes to an empty folder."""
    for k in range(5):
        memory.pipe(f"/bucket/clouds/{k}.pcd", CLOUD.format(k + 1).encode())
    memory.pipe(f"/bucket/clouds/{MARKER}", b"")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return memory


def test_a_folder_opens_as_on_disk_and_goes_when_it_is_closed(bucket, tmp_path):
    with sceneloom.open("memory://bucket/clouds") as scene:
        assert scene.source == "memory://bucket/clouds"
        assert [frame.points.positions[0, 0] for frame in scene.lidars[0].frames] == [1, 2, 3, 4, 5]
        (warning,) = (warning for warning in scene.warnings if warning.code == "fetched")
        location = Path(warning.message.split(" to ")[1].split(";")[0])
        assert sorted(path.name for path in location.iterdir()) == [f"{k}.pcd" for k in range(5)]
    assert list(tmp_path.iterdir()) == []


def test_a_folder_of_no_format_too_large_or_with_names_that_lead_out_leaves_nothing_behind(
    bucket, monkeypatch, tmp_path
):
    bucket.pipe("/bucket/other/readme.txt", b"nothing")
    with pytest.raises(UnknownFormatError):
        sceneloom.open("memory://bucket/other")
    monkeypatch.setattr(stores.Store, "get", None)
    with pytest.raises(DataError, match=r"a file of 0\.0 GB is more than the 0\.0 GB that may be fetched"):
        fetch("memory://bucket/clouds", largest=10)
    walk, evil = stores.Store.walk, stores.Facts("/bucket/clouds/../../evil.sh", 1, None, is_folder=False)
    monkeypatch.setattr(stores.Store, "walk", lambda self: [*walk(self), evil])
    with pytest.raises(DataError, match="leads out of its folder"):
        fetch("memory://bucket/clouds")
    assert list(tmp_path.iterdir()) == []


def test_files_that_come_short_are_fetched_again(bucket, monkeypatch, waits):
    get, faults = stores.Store.get, [b"", b"half"]

    def short(self, target):
        if faults:
            target.write_bytes(faults.pop())
        else:
            get(self, target)

    monkeypatch.setattr(stores.Store, "get", short)
    fetched = fetch("memory://bucket/clouds")
    assert all((fetched.path / f"{k}.pcd").read_text() == CLOUD.format(k + 1) for k in range(5))
    assert len(waits) == 2
    fetched.remove()


def test_patterns_find_drives_in_stores_for_batches(bucket):
    found = find_inputs(["memory://bucket/clouds/[13].pcd", "memory://bucket/*/0.pcd", "https://host/a*b.sfs?x=*"])
    clouds = [f"memory://bucket/clouds/{k}.pcd" for k in (1, 3, 0)]
    assert [drive.location for drive in found] == [*clouds, "https://host/a*b.sfs?x=*"]
    with pytest.raises(OptionError, match="no file or folder fits"):
        find_inputs(["memory://bucket/*.sfs"])
