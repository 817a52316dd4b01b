"""Scene files behind URLs: the header and what is asked for are fetched, not the file."""

import io
import pickle
import sys

import fsspec
import numpy as np
import pytest
import simplejpeg
from click.testing import CliRunner

import sceneloom
from sceneloom.cli.main import sceneloom as program
from sceneloom.errors import DataError, MissingExtraError
from sceneloom.formats.base.files import is_url, path_or_url
from sceneloom.formats.remote.stores import GAP, coalesced
from sceneloom.formats.sfs.container import Container
from sceneloom.formats.video.writer import encode_to_mp4


def big_scene(encode_sfs, *, frames=30, points=20_000):
    """A lidar whose frames are large, and all that is read on opening."""
    rng = np.random.default_rng(1)
    clouds = [
        {
            "timestamp": 100_000 * k,
            "points": {
                "positions": rng.normal(size=(points, 3)).astype(np.float32),
                "intensities": rng.integers(0, 256, points, np.uint8),
                "timestamps": np.arange(points, dtype=np.uint32) + 100_000 * k,
            },
        }
        for k in range(frames)
    ]
    poses = {"timestamps": [0, 10**7], "values": [[0, 0, 0, 0, 0, 0, 1], [9, 0, 0, 0, 0, 0, 1]]}
    jpeg = np.frombuffer(simplejpeg.encode_jpeg(rng.integers(0, 256, (64, 96, 3), np.uint8), 95), np.uint8)
    images = [{"timestamp": 100_000 * k, "content": jpeg} for k in range(3)]
    labels = [{"sensor_id": "top", "sensor_frame": 1, "point_ids": np.array([3, 7], np.uint32)}]
    sensors = [
        {"id": "top", "type": "lidar", "poses": poses, "frames": clouds},
        {"id": "cam", "type": "camera", "poses": poses, "intrinsics": camera_model(96, 64), "images": images},
        {"id": "map", "type": "points", "points": {"positions": np.ones((5, 3), np.float32)}},
    ]
    annotations = [{"id": "l", "type": "labeled_points", "label": "car", "labeled_points": labels}]
    return encode_sfs({"version": "1.0", "sensors": sensors, "annotations": annotations})


def camera_model(width, height):
    return {"fx": 60.0, "fy": 60.0, "cx": 48.0, "cy": 32.0, "width": width, "height": height}


def test_a_frame_costs_its_arrays_in_one_request_and_an_image_itself_and_not_the_file(served, encode_sfs, tmp_path):
    content = big_scene(encode_sfs)
    served.files["drive.sfs"] = content
    (tmp_path / "drive.sfs").write_bytes(content)
    with sceneloom.open(served.url("drive.sfs")) as scene, sceneloom.open(tmp_path / "drive.sfs") as local:
        opened, requests = served.bytes_sent, len(served.asked)
        assert opened < 600_000
        assert scene.sensors[2].positions.tolist() == [[1, 1, 1]] * 5
        frame, expected = scene.lidars[0].frames[17], local.lidars[0].frames[17]
        np.testing.assert_array_equal(frame.points.positions, expected.points.positions)
        np.testing.assert_array_equal(frame.points.intensities, expected.points.intensities)
        np.testing.assert_array_equal(frame.points.timestamps_ns, expected.points.timestamps_ns)
        assert frame.points.positions.flags.writeable is False
        assert served.bytes_sent - opened < 17 * 20_000 + 100
        assert served.bytes_sent < len(content) / 8
        assert len(served.asked) == requests + 1
        image = scene.cameras[0].images[1]
        assert image.rgb.shape == (64, 96, 3)
        assert image.encoded()[:2] == b"\xff\xd8"
        assert len(served.asked) == requests + 2


def test_other_back_ends_are_read_too(encode_sfs, tmp_path):
    content = big_scene(encode_sfs, frames=2, points=10)
    fsspec.filesystem("memory").pipe("/folder/drive.sfs", content)
    (tmp_path / "my drive.sfs").write_bytes(content)
    for url in ("memory://folder/drive.sfs", (tmp_path / "my drive.sfs").as_uri()):
        with sceneloom.open(url) as scene:
            assert len(scene.lidars[0].frames[1].points.positions) == 10


def video_scene(encode_sfs, *, images, side):
    """A camera with a video of noise, which takes many bytes an image."""
    rng = np.random.default_rng(4)
    target = io.BytesIO()
    encode_to_mp4([rng.integers(0, 256, (side, side, 3), np.uint8) for _ in range(images)], target, fps=10.0)
    content, timestamps = np.frombuffer(target.getvalue(), np.uint8), [100_000 * k for k in range(images)]
    video = {"timestamps": timestamps, "content": content, "fps": 10}
    camera = {"id": "cam", "type": "camera", "intrinsics": camera_model(side, side), "video": video}
    return encode_sfs({"version": "1.0", "sensors": [camera]})


def test_a_drive_with_a_video_is_the_same_as_from_disk_and_an_image_costs_what_it_leans_on(
    served, encode_sfs, tmp_path
):
    served.files["drive.sfs"] = content = video_scene(encode_sfs, images=70, side=192)
    (tmp_path / "drive.sfs").write_bytes(content)
    with sceneloom.open(served.url("drive.sfs")) as scene, sceneloom.open(tmp_path / "drive.sfs") as local:
        assert scene.cameras[0].video.codec == local.cameras[0].video.codec
        assert scene.cameras[0].images[0].rgb.shape == (192, 192, 3)
        assert served.bytes_sent < len(content) / 2
        for k in (0, 1, 65):
            np.testing.assert_array_equal(scene.cameras[0].images[k].rgb, local.cameras[0].images[k].rgb)
        sceneloom.write(scene, tmp_path / "copy.sfs")
        sceneloom.write(local, tmp_path / "copy_of_local.sfs")
    assert (tmp_path / "copy.sfs").read_bytes() == (tmp_path / "copy_of_local.sfs").read_bytes()


def test_a_scene_behind_a_url_goes_to_other_processes_and_fetches_nothing_once_closed(served, encode_sfs):
    served.files["drive.sfs"] = big_scene(encode_sfs)
    with sceneloom.open(served.url("drive.sfs")) as scene:
        again = pickle.loads(pickle.dumps(scene))
        found, expected = (s.lidars[0].frames[5].points.positions for s in (again, scene))
        np.testing.assert_array_equal(found, expected)
        late = pickle.loads(pickle.dumps(scene))
    with pytest.raises(DataError, match="is closed"):
        scene.lidars[0].frames[0]
    served.files["drive.sfs"] += b"\0"
    with pytest.raises(DataError, match="was changed after it was opened"):
        late.lidars[0].frames[5]


def test_missing_files_and_servers_those_without_ranges_and_a_file_that_is_cut_are_errors(
    served, encode_sfs, monkeypatch
):
    served.files["drive.sfs"] = content = big_scene(encode_sfs)
    served.files["empty.sfs"] = b""
    with sceneloom.open(served.url("drive.sfs")) as scene:
        served.files["drive.sfs"] = content[:100_000]
        with pytest.raises(DataError, match=r"cannot be read|the server gave"):
            scene.lidars[0].frames[20]
    for url, problem in (
        (served.url("absent.sfs"), "cannot be found"),
        (served.url("data.jsonl"), "cannot be found"),
        (served.url("empty.sfs"), r"empty|how long"),
        ("http://127.0.0.1:9/drive.sfs", "cannot be found: Cannot connect"),
        ("nosuchprotocol://host/drive.sfs", "cannot be read"),
    ):
        with pytest.raises(DataError, match=problem):
            sceneloom.open(url)
    served.files["drive.sfs"], served.ranges = content, False
    with pytest.raises(DataError, match=r"answers no ranges \(`Range`\); download the file first"):
        sceneloom.open(served.url("drive.sfs"))
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'sceneloom\[cloud\]'"):
        sceneloom.open("http://127.0.0.1/drive.sfs")


def test_long_headers_are_fetched_in_blocks_that_grow_and_other_formats_whole(served, encode_sfs):
    content = encode_sfs({"version": "1.0", "sensors": [], "note": "x" * 3_000_000, "last": np.ones(3)})
    served.files["drive.sfs"] = content
    with sceneloom.open(served.url("drive.sfs")) as scene:
        assert scene.extras["last"].tolist() == [1, 1, 1]
    assert len(served.asked) < 10
    served.files["cloud.pcd"] = (
        b"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        b"WIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n1 2 3\n"
    )
    with sceneloom.open(served.url("cloud.pcd")) as scene:
        assert scene.lidars[0].frames[0].points.positions.tolist() == [[1, 2, 3]]


def test_commands_take_urls(served, encode_sfs, tmp_path):
    def run(*words):
        done = CliRunner().invoke(program, list(map(str, words)))
        assert done.exit_code == 0, done.output
        return done.output

    served.files["drive.sfs"] = content = big_scene(encode_sfs, frames=2)
    (tmp_path / "drive.sfs").write_bytes(content)
    url = served.url("drive.sfs")
    assert "20000 points in the first frame" in run("info", url)
    assert "nothing found" in run("validate", url, "--profile", "scale", "--rule", "scale-points", "--quick")
    run("convert", url, tmp_path / "a.sfs")
    run("convert", tmp_path / "drive.sfs", tmp_path / "b.sfs")
    assert (tmp_path / "a.sfs").read_bytes() == (tmp_path / "b.sfs").read_bytes()


def test_values_that_were_not_fetched_cannot_be_looked_at(served, encode_sfs):
    served.files["drive.sfs"] = big_scene(encode_sfs)
    container = Container(served.url("drive.sfs"))
    positions = container.header["sensors"][0]["frames"][0]["points"]["positions"]
    assert positions.shape == (20_000, 3)
    for look in (np.sum, np.array_equal, lambda a: a[0], lambda a: a + 1, lambda a: a.max(), list, pickle.dumps):
        with pytest.raises(DataError, match="not asked for"):
            look(positions) if look is not np.array_equal else look(positions, positions)
    assert container.fetch(positions).any()
    container.close()
    # chunks of a content are those of its bytes
    video = np.random.default_rng(2).integers(0, 256, 649_000, np.uint8)
    served.files["video.sfs"] = encode_sfs({"sensors": [{"type": "camera", "video": {"content": video}}]})
    container, expected = Container(served.url("video.sfs")), video.tobytes()
    part = container.bytes_of(container.header["sensors"][0]["video"]["content"])
    assert len(part) == len(expected)
    for start, stop in ((0, 4), (300_000, 300_001), (262_140, 262_150), (648_990, 700_000), (-4, None), (5, 5)):
        assert part[start:stop] == expected[start:stop]
    with part() as opened:
        opened.seek(-10, 2)
        assert opened.read() == expected[-10:]
        opened.seek(3)
        assert opened.read(600_000) == expected[3:600_003]
    container.close()


def test_arrays_of_strangers_and_without_a_dtype_are_fetched(served, encode_sfs):
    """Big-endian arrays, unknown sensors and the like."""
    frames = [{"timestamp": 1, "points": {"positions": np.ones((2, 3), ">f4")}}]
    lidar, unknown = {"id": "l", "type": "lidar", "frames": frames}, {"id": "x", "type": "sonar", "d": np.arange(3)}
    content = encode_sfs({"version": "1.0", "sensors": [lidar, unknown]})
    served.files["drive.sfs"] = content.replace(b'"dtype": "float32"', b'"dtype": ">f4"    ')
    with sceneloom.open(served.url("drive.sfs")) as scene:
        assert scene.lidars[0].frames[0].points.positions.tolist() == [[1, 1, 1]] * 2
        assert scene.sensors[1].fields["d"].tolist() == [0, 1, 2]
    frames[0]["points"]["positions"] = np.full((2, 3), 7, np.float32)
    served.files["other.sfs"] = encode_sfs({"version": "1.0", "sensors": [lidar]}, dtype=None, shape=None)
    with sceneloom.open(served.url("other.sfs")) as scene:
        assert scene.lidars[0].frames[0].points.positions.tolist() == [[7, 7, 7]] * 2


def test_urls_are_distinguished_from_paths_and_neighbouring_ranges_are_joined(tmp_path):
    assert all(map(is_url, ("http://host/a.sfs", "s3://bucket/a.sfs", "simplecache::https://host/a.sfs")))
    assert not any(map(is_url, ("C:/a.sfs", "a.sfs", "a//b.sfs")))
    assert path_or_url((tmp_path / "ä b.sfs").as_uri()) == tmp_path / "ä b.sfs"
    near, far = (5 + GAP, 9 + GAP), (6 + GAP, 9 + GAP)
    for ranges, joined in (
        ([], []),
        ([(10, 20), (0, 5)], [(0, 20)]),
        ([(0, 5), near], [(0, 9 + GAP)]),
        ([(0, 5), far], [(0, 5), far]),
        ([(0, 50), (10, 20)], [(0, 50)]),
    ):
        assert coalesced(ranges) == joined
