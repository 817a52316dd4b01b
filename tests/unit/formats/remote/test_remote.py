"""Folders and files behind URLs: what is fetched and how much, bounded, and gone when the drive is closed."""

import json
import os
import pickle
import subprocess
import sys
import traceback
from pathlib import Path

import av
import numpy as np
import pytest
from click.testing import CliRunner
from tests.unit.formats.conftest import digest

import sceneloom
from sceneloom.batch.jobs import find_inputs
from sceneloom.batch.running import may_pass
from sceneloom.cameras.camera import Camera
from sceneloom.cli.main import sceneloom as program
from sceneloom.errors import DataError, MissingExtraError, OptionError, OutputError, UnknownFormatError
from sceneloom.formats.remote import mirror, stores
from sceneloom.formats.remote.mirror import fetch, find_urls
from sceneloom.formats.remote.stores import Patience, RemoteIdentity, patiently
from sceneloom.formats.remote.uploads import MARKER, check_remote_output, upload, uploading
from sceneloom.scene import LazyFrames, LidarFrame, LidarPoints, LidarSensor, Scene
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

COUNT = 40
POINTS = 8_000
IMAGES = 200
FILE = POINTS * 16
"""What one of the clouds takes [bytes]; more than the beginning of a file that is looked at."""


def cloud(number):
    return np.random.default_rng(number).uniform(-9, 9, (POINTS, 3)).astype(np.float32)


def drive_of_clouds():
    bright = np.full(POINTS, 7, np.uint8)
    frames = [LidarFrame(k * 100_000_000, LidarPoints(cloud(k), bright)) for k in range(COUNT)]
    return Scene((LidarSensor("top", LazyFrames.of(frames, [frame.timestamp_ns for frame in frames])),))


@pytest.fixture
def clouds(tmp_path, monkeypatch):
    """A folder of clouds, which a store of this machine serves."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    sceneloom.write(drive_of_clouds(), tmp_path / "clouds", format="kitti-bin")
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
        assert len(pickle.dumps(scene)) < FILE / 4
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
    cameras = (CameraSpec(Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5)),)
    return simulate_street(1, frames=4, lidar=LidarSpec(beams=8, steps=90), cameras=cameras).scene


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


def test_a_folder_opens_as_on_disk_and_leaves_nothing_behind_when_it_is_closed(bucket, monkeypatch, tmp_path):
    with sceneloom.open("memory://bucket/clouds") as scene:
        assert scene.source == "memory://bucket/clouds"
        assert [frame.points.positions[0, 0] for frame in scene.lidars[0].frames] == [1, 2, 3, 4, 5]
        (warning,) = (warning for warning in scene.warnings if warning.code == "fetched")
        location = Path(warning.message.split(" to ")[1].split(";")[0])
        assert sorted(path.name for path in location.iterdir()) == [f"{k}.pcd" for k in range(5)]
    assert list(tmp_path.iterdir()) == []
    # as does one of no format, too large or with names that lead out
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


def test_files_that_come_short_are_fetched_again_and_patterns_find_drives_for_batches(bucket, monkeypatch, waits):
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
    found = find_inputs(["memory://bucket/clouds/[13].pcd", "memory://bucket/*/0.pcd", "https://host/a*b.sfs?x=*"])
    clouds = [f"memory://bucket/clouds/{k}.pcd" for k in (1, 3, 0)]
    assert [drive.location for drive in found] == [*clouds, "https://host/a*b.sfs?x=*"]
    with pytest.raises(OptionError, match="no file or folder fits"):
        find_inputs(["memory://bucket/*.sfs"])


CONTENT = bytes(np.random.default_rng(3).integers(0, 256, 900_000, np.uint8))


@pytest.fixture
def file(served):
    served.files["drive.bin"] = CONTENT
    file = RemoteIdentity.of(served.url("drive.bin")).open()
    yield file
    file.close()


@pytest.mark.parametrize("faults", [["503"], ["cut"], ["503", "cut", "503"], ["slow"]])
def test_ranges_come_whole_after_faults_that_pass_and_slow_answers(served, file, waits, faults, monkeypatch):
    if "slow" in faults:
        monkeypatch.setattr(stores, "_PATIENCE", Patience(answer=0.3))
    served.faults[:] = faults
    assert file.fetch(1000, 500_000) == CONTENT[1000:500_000]
    assert len(waits) == len(faults)


@pytest.mark.parametrize("fault", ["503", "cut"])
def test_a_fault_that_stays_says_that_it_may_pass(served, file, waits, fault):
    served.faults[:] = [fault] * 50
    problem = r"bytes 5 to 5000: (cannot be read: .*503|.*Not enough data|the server gave)"
    with pytest.raises(DataError, match=problem) as reported:
        file.fetch(5, 5000)
    assert reported.value.passing
    reported.value.__context__ = None  # pickled, too, once a library for clusters was imported
    assert may_pass(pickle.loads(pickle.dumps(reported.value)))
    assert len(waits) == Patience().tries - 1
    assert all(first > 0 for first in waits)


def test_what_is_busy_is_tried_again_what_is_missing_or_refused_is_not_and_waits_grow_up_to_the_deadline(
    served, waits, encode_sfs
):
    def failing(error, *rule):
        def fail():
            raise error

        with pytest.raises(type(error)):
            patiently(fail, *rule)

    with pytest.raises(DataError, match="cannot be found") as reported:
        RemoteIdentity.of(served.url("absent.sfs")).open()
    assert not reported.value.passing
    failing(PermissionError(13, "no"))
    failing(ConnectionResetError("cut"), Patience(deadline=0.0))
    assert waits == []
    served.faults[:] = ["503", "503", "503"]  # of HEAD, and of GET, which is asked for where HEAD is refused
    served.files["drive.sfs"] = encode_sfs({"version": "1.0", "sensors": []})
    with sceneloom.open(served.url("drive.sfs")) as scene:
        assert scene.sensors == ()
    assert waits
    waits.clear()
    failing(ConnectionResetError("cut"), Patience(tries=9, wait=1.0, longest_wait=4.0, deadline=1000.0))
    bounds = [1, 2, 4, 4, 4, 4, 4, 4]
    assert all(top / 2 <= wait <= top for wait, top in zip(waits, bounds, strict=True))


def test_what_is_asked_for_ahead_is_not_asked_for_again_and_reading_near_takes_what_follows(served, file):
    file.ask_ahead([(0, 100), (200_000, 200_300), (200_400, 200_500), (800_000, 800_001)])
    assert len(served.asked) == 3
    for start, stop in ((0, 100), (10, 20), (200_290, 200_450), (800_000, 800_001)):
        assert file.fetch(start, stop) == CONTENT[start:stop]
    assert len(served.asked) == 3
    assert file.fetch(50, 150) == CONTENT[50:150]
    assert len(served.asked) == 4
    assert file.read_near(1100, 1110, 50_000) == CONTENT[1100:1110]
    assert file.read_near(40_000, 40_010, 50_000) == CONTENT[40_000:40_010]
    assert len(served.asked) == 5
    assert file.read_near(899_990, 900_000, 50_000) == CONTENT[-10:]


def test_a_sweep_costs_its_message_faults_that_pass_do_not_show_and_other_processes_refuse_a_changed_drive(
    served, tmp_path, waits
):
    mcap_drive = tmp_path / "drive.mcap"
    # in chunks that are not compressed
    sceneloom.write(drive_of_clouds(), mcap_drive, compression="none")
    served.files["drive.mcap"] = mcap_drive.read_bytes()
    with sceneloom.open(served.url("drive.mcap") + "?sig=hidden") as scene, sceneloom.open(mcap_drive) as local:
        assert served.bytes_sent < len(served.files["drive.mcap"]) / 4
        opened = served.bytes_sent
        found, expected = scene.lidars[0].frames[17], local.lidars[0].frames[17]
        assert found.timestamp_ns == expected.timestamp_ns
        np.testing.assert_array_equal(found.points.positions, expected.points.positions)
        assert served.bytes_sent - opened < 2 * 8_000 * 16 + 200_000
        served.faults[:] = ["503", "cut", "503"]
        assert len(scene.lidars[0].frames[3].points.positions) == 8_000
        assert waits
        again, late = (pickle.loads(pickle.dumps(scene)) for _ in range(2))
        assert len(again.lidars[0].frames[3].points.positions) == 8_000
    served.files["drive.mcap"] += b"\0"
    with pytest.raises(DataError, match="was changed after it was opened") as reported:
        _ = late.lidars[0].frames[5].points.positions
    assert "hidden" not in str(reported.value)


SIGNED = "?X-Amz-Signature=hidden&X-Amz-Credential=hidden%2Fus&sig=hidden&token=hidden"


def all_that_hangs_on(error):
    """An error, what it came from, and their texts."""
    seen, waiting = [], [error]
    while waiting:
        one = waiting.pop()
        if one is not None and one not in seen:
            seen.append(one)
            waiting += [one.__cause__, one.__context__]
    texts = [f"{one!r} {one} {one.args} {vars(one)}" for one in seen]
    return seen, "".join([*texts, *traceback.format_exception(error)]).replace("hidden)", "")


@pytest.mark.parametrize("fault", [None, "503", "cut"])
@pytest.mark.parametrize("sensors", [[{"id": 1.5, "type": "lidar"}], None])
def test_an_error_brings_nothing_of_what_the_back_end_raised(served, encode_sfs, fault, sensors):
    """Neither a file that is missing or faulty, nor one that is cut, nor a server that fails."""
    whole = encode_sfs({"version": "1.0", "sensors": sensors})
    served.files["drive.sfs"] = whole if sensors else b'{"version": "1.0"' + b" " * 100_000
    there = served.url("drive.sfs")
    user = there.replace("http://", "http://me:hidden@")
    for url in (there, user, served.url("absent.sfs"), "http://127.0.0.1:9/drive.sfs"):
        served.faults[:] = [fault] * 40
        with pytest.raises(DataError) as reported:
            sceneloom.open(url + SIGNED)
        seen, text = all_that_hangs_on(reported.value)
        assert "hidden" not in text
        assert all(type(one).__module__.startswith("sceneloom") for one in seen)
        assert b"hidden" not in pickle.dumps(reported.value)
        done = CliRunner().invoke(program, ["info", url + SIGNED])
        assert done.exit_code == 1
        assert "hidden" not in done.output + str(done.exception)
    if fault is None:
        assert "sig=hidden" in served.queries[0], "the server has to get what the user stated"


def test_a_scene_reports_its_source_without_secrets_and_the_other_doors_bring_none_either(served, encode_sfs, tmp_path):
    served.files["drive.sfs"] = encode_sfs({"version": "1.0", "sensors": []})
    url = served.url("drive.sfs").replace("http://", "http://me:hidden@") + SIGNED
    for arguments in (["info", url], ["info", "--json", url], ["validate", url]):
        done = CliRunner().invoke(program, arguments)
        assert "127.0.0.1" in done.output
        assert "hidden" not in done.output, arguments
    with sceneloom.open(url) as scene:
        assert "hidden" not in repr(scene)
    (tmp_path / "file").write_bytes(b"x")
    unknown = "nosuch://me:hidden@host/a.sfs" + SIGNED
    for door in (find_urls, lambda location: upload(tmp_path / "file", location)):
        with pytest.raises(sceneloom.SceneloomError) as reported:
            door(unknown)
        assert "hidden" not in all_that_hangs_on(reported.value)[1]


POOL = """
import json, logging, multiprocessing, sys, traceback
from concurrent.futures import ProcessPoolExecutor
import sceneloom
from sceneloom.formats.remote import stores

def read(url):
    # who tries again for long, tries here no longer than the test
    stores.time.sleep = lambda _: None
    with sceneloom.open(url) as scene:
        return float(scene.lidars[0].frames[0].points.positions.sum())

def frame(scene):
    return float(scene.lidars[0].frames[1].points.positions.sum())

if __name__ == "__main__":
    given = json.load(sys.stdin)
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        print(pool.submit(read, given["there"]).result())
        with sceneloom.open(given["there"]) as scene:
            print(pool.submit(frame, scene).result())
            for work, what in ((read, given["absent"]), (read, given["nobody"]), (read, given["refused"])):
                try:
                    pool.submit(work, what).result()
                except Exception as error:
                    traceback.print_exc()
                    logging.exception("in the log")
                    print(repr(error), error.args, error.__cause__, error.__context__)
    print("validated", repr(sceneloom.validate(given["nobody"])))
    sceneloom.open(given["absent"])  # and what nobody catches
"""


@pytest.mark.slow
def test_errors_of_worker_processes_show_none_in_tracebacks_and_logs(served, encode_sfs, tmp_path):
    frames = [{"timestamp": 100_000 * k, "points": {"positions": np.ones((30_000, 3), np.float32)}} for k in range(2)]
    served.files["drive.sfs"] = encode_sfs(
        {"version": "1.0", "sensors": [{"id": "top", "type": "lidar", "frames": frames}]}
    )
    (tmp_path / "pool.py").write_text(POOL)
    given = {
        "there": served.url("drive.sfs"),
        "absent": served.url("absent.sfs"),
        "nobody": "http://me:hidden@127.0.0.1:9/drive.sfs",
        "refused": "nosuch://me:hidden@host/drive.sfs",
    }
    signed = json.dumps({name: url + SIGNED for name, url in given.items()})
    command = [sys.executable, str(tmp_path / "pool.py")]
    done = subprocess.run(command, input=signed, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout.splitlines()[:2] == ["90000.0", "90000.0"]
    assert "127.0.0.1:9/drive.sfs" in done.stdout.partition("validated")[2]
    assert done.stderr.count("cannot be found") > 4, "each fault is reported in traceback and log"
    assert "in the log" in done.stderr
    # the last line of the program is shown as it stands, without its values
    assert "hidden" not in done.stdout + done.stderr
    assert "***" in done.stderr


NAMES = ["data.jsonl", "frames/0.png", "frames/1.png"]


def test_a_scene_is_written_to_a_store_as_to_disk_and_replaces_nothing_unless_it_may(memory, encode_sfs, tmp_path):
    small_drive = tmp_path / "drive.sfs"
    frames = [{"timestamp": k, "points": {"positions": np.full((2, 3), k, np.float32)}} for k in range(3)]
    scene = {"version": "1.0", "sensors": [{"id": "top", "type": "lidar", "frames": frames}]}
    small_drive.write_bytes(encode_sfs(scene))
    memory.pipe("/bucket/deep/copy.sfs", b"old")
    with sceneloom.open(small_drive) as scene:
        with pytest.raises(OutputError, match=r"bucket/deep/copy\.sfs: exists already; .*--overwrite"):
            sceneloom.write(scene, "memory://bucket/deep/copy.sfs")
        assert memory.cat_file("/bucket/deep/copy.sfs") == b"old"
        sceneloom.write(scene, tmp_path / "copy.sfs")
        sceneloom.write(scene, "memory://bucket/deep/copy.sfs", overwrite=True)
    assert memory.cat_file("/bucket/deep/copy.sfs") == (tmp_path / "copy.sfs").read_bytes()
    assert sceneloom.convert(small_drive, "memory://bucket/other.sfs").target == "memory://bucket/other.sfs"
    assert "/bucket/other.sfs" in memory.store
    thin = ["edit", "thin", str(small_drive), "-o", "memory://bucket/thin.sfs", "--every", "2", "--json"]
    done = CliRunner().invoke(program, thin)
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["output"] == "memory://bucket/thin.sfs"
    with sceneloom.open("memory://bucket/thin.sfs") as scene:
        assert len(scene.lidars[0].frames) == 2


def test_chunks_that_were_sent_are_given_up_where_one_fails(memory, tmp_path, waits, monkeypatch):
    """Nothing may put them together later, neither a commit nor the file's end."""
    (tmp_path / "a.bin").write_bytes(b"x" * 100)
    reported = []

    class File:
        closed = False

        def write(self, piece):
            reported.append(len(piece))
            if len(reported) == 3:
                raise PermissionError(13, "not any more")

        def __getattr__(self, name):
            return lambda: reported.append(name)

    monkeypatch.setattr(stores, "_PART", 40)
    monkeypatch.setattr(type(memory), "open", lambda *_, **__: File())
    with pytest.raises(OutputError, match=r"memory://bucket/a\.bin: cannot be written: .*not any more"):
        upload(tmp_path / "a.bin", "memory://bucket/a.bin")
    assert reported == [40, 40, 20, "discard"]
    assert waits == []


def test_a_folder_replaces_all_of_the_old_one_its_marker_comes_last_and_what_fails_midway_is_taken_back_or_begun_anew(
    memory, tmp_path, waits, monkeypatch
):
    put, order, faults, folder = stores.Store.put, [], {}, tmp_path / "drive"

    def noted(self, source):
        order.append(self.path)
        for name in [name for name in faults if self.path.endswith(name) and faults[name]]:
            raise faults[name].pop()
        put(self, source)

    monkeypatch.setattr(stores.Store, "put", noted)
    (folder / "frames").mkdir(parents=True)
    for name in NAMES:
        (folder / name).write_text(name)
    with pytest.raises(RuntimeError), uploading("memory://bucket/a.bin", overwrite=False) as draft:
        draft.write_bytes(b"half")
        raise RuntimeError
    assert memory.store == {}
    assert not draft.parent.exists()
    faults["data.jsonl"] = [ConnectionResetError("cut"), TimeoutError("slow")]
    upload(folder / "data.jsonl", "memory://bucket/data.jsonl")
    assert (len(waits), memory.cat_file("/bucket/data.jsonl")) == (2, b"data.jsonl")
    memory.rm("/bucket/data.jsonl")
    faults["1.png"] = [PermissionError(13, "no")]
    with pytest.raises(OutputError, match="cannot be written"):
        upload(folder, "memory://bucket/drive")
    assert memory.store == {}
    for name in (MARKER, "old.bin", "data.jsonl"):
        memory.pipe(f"/bucket/drive/{name}", b"old")
    with pytest.raises(OutputError, match="exists already"):
        check_remote_output("memory://bucket/drive", overwrite=False)
    upload(folder, "memory://bucket/drive")
    assert order[-1] == f"/bucket/drive/{MARKER}"
    assert sorted(memory.find("/bucket/drive")) == [f"/bucket/drive/{name}" for name in (MARKER, *NAMES)]
    assert [memory.cat_file(f"/bucket/drive/{name}").decode() for name in NAMES] == NAMES


def test_locations_that_nothing_can_be_written_to_are_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    for url, error, problem in (
        ("https://me:hidden@host/drive.sfs", OutputError, "web server, which is only read from"),
        ("s3://", OutputError, "names no file or folder"),
        ("gs://b/drive.sfs", MissingExtraError, r"gs://b/drive\.sfs: .*gcsfs.*pip install 'sceneloom\[cloud\]'"),
    ):
        with pytest.raises(error, match=problem):
            check_remote_output(url, overwrite=False)
