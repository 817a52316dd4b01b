"""Scene files cut everywhere and with bytes changed: a scene or an error of ours, nothing else."""

import contextlib
import copy
import io

import numpy as np
import pytest
import simplejpeg

from sceneloom.errors import SceneloomError
from sceneloom.formats.sfs.spec import FORMAT
from sceneloom.formats.sfs.writer import write_scene
from sceneloom.formats.video.writer import encode_to_mp4

TWO = np.array([[1, 2, 3], [4, 5, 6]], np.float32)
POSES = {"timestamps": [0, 100], "values": [[1, 2, 3, 0, 0, 0, 1], [1, 2, 3, 0, 0, 0.6, 0.8]]}
CAMERA_MODEL = {"fx": 9.5, "fy": 9, "cx": 3.5, "cy": 3.5, "width": 8, "height": 8}


def clouds():
    points = {"positions": TWO, "timestamps": np.array([5, 9], np.uint32), "ring": np.array([1, 2], np.uint16)}
    sensors = [
        {"id": "l", "type": "lidar", "poses": POSES, "frames": [{"timestamp": 5, "points": points}]},
        {"id": 2, "type": "radar", "poses": POSES, "frames": [{"timestamp": 5, "points": {"positions": TWO}}]},
        {"id": "m", "type": "points", "points": {"positions": TWO}},
    ]
    return {"version": "1.0", "time_offset": 10**15, "time_unit": "microseconds", "sensors": sensors}


def annotations():
    path = {"timestamps": [0], "values": [[1.0] * 9]}
    labels = [{"sensor_id": "l", "point_ids": np.array([0, 1], np.uint32)}]
    return {
        "version": "1.0",
        "sensors": [{"id": "o", "type": "odometry", "poses": POSES}, {"id": "x", "type": "sonar", "d": TWO}],
        "annotations": [
            {
                "id": "c",
                "type": "cuboid",
                "path": path,
                "attributes": [{"name": "n", "timestamps": [0], "values": [1]}],
            },
            {"id": "e", "type": "event", "start": 5, "duration": 1.5},
            {"id": "p", "type": "labeled_points", "label": "x", "labeled_points": labels},
        ],
        "metadata": {"sceneloom": {"time_shift_ns": 5, "trajectories": [{"name": "o", "sensor_id": "o"}]}},
    }


def drawn_annotations():
    """One of each type that the golden file above lacks."""
    timestamps, row = {"timestamps": [0]}, [1.0] * 9
    seen = {"sensor_id": "f", **timestamps, "confirmed": [None]}
    return {
        "version": "1.0",
        "annotations": [
            {
                "id": 1,
                "type": "cuboid",
                "path": {**timestamps, "values": [row]},
                "activations": [{"sensor_id": "f", **timestamps, "durations": [1], "cuboids": [row]}],
                "projections": [{**seen, "boxes": [None], "cuboids": [row]}],
            },
            {"id": 2, "type": "box_2d", "sensor_id": "f", "path": {**timestamps, "values": [[1, 2, 3, 4]]}},
            {"id": 3, "type": "polyline", "is_closed": True, "path": {**timestamps, "values": [[1, 2]]}},
            {
                "id": 4,
                "type": "points",
                "labels": ["a"],
                "paths": [{"id": 0, **timestamps, "values": [[1, 2, 3]]}],
                "projections": [[{**seen, "points": [[1, 2]], "positions": [None]}]],
            },
            {"id": 5, "type": "localization_adjustment", "poses": POSES},
            {
                "id": 6,
                "type": "camera_calibration",
                "sensor_id": "f",
                "poses": POSES,
                "intrinsics": {**CAMERA_MODEL, "distortion": {"model": "fisheye", "params": [0.1]}},
                "time_offset": 1,
            },
            {"id": 7, "type": "link", "from_id": 1, "to_id": 2},
        ],
    }


def our_metadata():
    imu = {"timestamps_ns": np.array([1, 2]), "values": np.ones((2, 3))}
    note = {
        "id": "c",
        "mount": [[1.0, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3]],
        "camera": {"model": "pinhole", "coefficients": [], **CAMERA_MODEL},
        "images": {"cameras": [{"model": "fisheye", "coefficients": [1.0], **CAMERA_MODEL}], "camera_of_image": [0]},
    }
    ours = {
        "sensor_notes": [note],
        "sensors": [{"id": "i", "type": "imu", "streams": {"gyroscope": imu}}],
        "warnings": [{"kind": "assumed", "code": "a", "location": "b", "message": "c", "count": 1}],
        "exact_attributes": [{"index": 0, "timestamps": [1], "values": [1.5], "written": [1500]}],
    }
    jpeg = np.frombuffer(simplejpeg.encode_jpeg(np.zeros((8, 8, 3), np.uint8), 50), np.uint8)
    camera = {"id": "c", "type": "camera", "poses": POSES, "intrinsics": CAMERA_MODEL}
    return {
        "version": "1.0",
        "sensors": [{**camera, "images": [{"timestamp": 3, "content": jpeg}]}],
        "attributes": [{"name": "n", "timestamps": [0], "values": [1500]}],
        "metadata": {"sceneloom": ours},
    }


def video():
    target = io.BytesIO()
    encode_to_mp4([np.zeros((16, 16, 3), np.uint8)] * 2, target, fps=10.0)
    content = {"timestamps": [0, 100], "content": np.frombuffer(target.getvalue(), np.uint8), "fps": 10}
    camera = {"id": "c", "type": "camera", "poses": POSES, "intrinsics": CAMERA_MODEL, "video": content}
    return {"version": "1.0", "sensors": [camera]}


def look_at_everything(scene):
    """Touch every frame and image, and write the scene into nothing."""
    for sensor in scene.sensors:
        for frame in getattr(sensor, "frames", ()):
            float(np.nansum(frame.points.positions, dtype=np.float64))
            assert frame.points.timestamps_ns is None or frame.points.timestamps_ns.dtype == np.int64
        for image in getattr(sensor, "images", ()):
            assert image.rgb.ndim == 3


@pytest.fixture
def survives(tmp_path):
    """Open damaged content; whatever is raised is ours."""
    path = tmp_path / "damaged.sfs"

    def check(content):
        path.unlink(missing_ok=True)  # a new file is far quicker than an old one made shorter
        path.write_bytes(content)
        FORMAT.sniff(path)
        for options in ({}, {"lenient": True}):
            with contextlib.suppress(SceneloomError), FORMAT.open(path, **options) as scene:
                look_at_everything(scene)

    return check


GOLDEN = {
    name: lambda make=make: copy.deepcopy(make())
    for name, make in {"clouds": clouds, "annotations": annotations, "ours": our_metadata}.items()
}

WITH_DRAWN = {**GOLDEN, "drawn": lambda: copy.deepcopy(drawn_annotations())}
"""The same, and annotations of all types: in their values, not in their bytes, which would take too long."""


THINNED = [4, pytest.param(1, marks=pytest.mark.slow)]
"""Every how many locations are changed: a few of each kind, or every one."""


@pytest.mark.parametrize("step", THINNED)
@pytest.mark.parametrize("golden", GOLDEN.values(), ids=GOLDEN)
def test_a_file_cut_anywhere_gives_a_scene_or_an_error_of_ours(golden, step, encode_sfs, survives):
    content = encode_sfs(golden())
    for length in range(0, len(content), step):
        survives(content[:length])


@pytest.mark.parametrize("step", THINNED)
@pytest.mark.parametrize("golden", GOLDEN.values(), ids=GOLDEN)
@pytest.mark.few(1)
def test_a_changed_byte_anywhere_gives_a_scene_or_an_error_of_ours(golden, step, encode_sfs, survives):
    content = encode_sfs(golden())
    rng = np.random.default_rng(7)
    swaps = b'0-9"[]{},:.eE\0\xff '
    for location in range(0, len(content), step):
        changed = bytearray(content)
        changed[location] = swaps[int(rng.integers(len(swaps)))]
        survives(bytes(changed))


STRANGE = [None, True, -1, 7, 2**63, 1e300, 0.5, float("nan"), "", "x", [], [None], [[]], {}, {"a": 1}, TWO]


def locations(node, path=()):
    """The keys of every value of a header, outermost first."""
    if path:
        yield path
    for key, value in node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ():
        yield from locations(value, (*path, key))


def with_value(golden, path, value):
    header = golden()
    node = header
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = value
    return header


@pytest.mark.parametrize("step", [3, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "golden",
    [
        pytest.param(golden, id=name, marks=[] if name in GOLDEN else [pytest.mark.slow])
        for name, golden in WITH_DRAWN.items()
    ],
)
@pytest.mark.few(1)
def test_a_value_of_another_kind_anywhere_gives_a_scene_or_an_error_of_ours(golden, step, encode_sfs, survives):
    """Every value of the header is replaced in order by everything else that JSON can state, or by a part of that."""
    for number, path in enumerate(locations(golden())):
        for value in STRANGE[number % step :: step]:
            survives(encode_sfs(with_value(golden, path, value)))


@pytest.mark.parametrize("golden", WITH_DRAWN.values(), ids=WITH_DRAWN)
def test_a_value_that_is_missing_anywhere_gives_a_scene_or_an_error_of_ours(golden, encode_sfs, survives):
    for path in locations(golden()):
        header = golden()
        node = header
        for key in path[:-1]:
            node = node[key]
        del node[path[-1]]
        survives(encode_sfs(header))


def test_a_damaged_video_gives_images_or_errors_of_ours(encode_sfs, survives):
    content = encode_sfs(video())
    rng = np.random.default_rng(8)
    for location in range(content.index(b"ftyp"), len(content), 97):
        changed = bytearray(content)
        changed[location] ^= int(rng.integers(1, 256))
        survives(bytes(changed))


@pytest.mark.slow
@pytest.mark.parametrize("profile", ["sfs", "scale"])
@pytest.mark.parametrize("golden", WITH_DRAWN.values(), ids=WITH_DRAWN)
def test_whatever_opens_is_written_or_refused_with_an_error_of_ours(golden, encode_sfs, tmp_path, profile):
    for number, path in enumerate(locations(golden())):
        for other, value in enumerate(STRANGE):
            source, target = tmp_path / f"{number} {other}.sfs", tmp_path / "target.sfs"
            source.write_bytes(encode_sfs(with_value(golden, path, value)))
            with contextlib.suppress(SceneloomError), FORMAT.open(source, lenient=True) as scene:
                write_scene(scene, target, profile=profile)
                FORMAT.open(target)
            target.unlink(missing_ok=True)
            source.unlink()


@pytest.mark.slow
@pytest.mark.parametrize("golden", GOLDEN.values(), ids=GOLDEN)
def test_many_changed_bytes_give_a_scene_or_an_error_of_ours(golden, encode_sfs, survives):
    content = encode_sfs(golden())
    rng = np.random.default_rng(9)
    for _ in range(20_000):
        changed = bytearray(content)
        for _ in range(int(rng.integers(1, 6))):
            changed[int(rng.integers(len(changed)))] = int(rng.integers(256))
        survives(bytes(changed))


@pytest.mark.parametrize("golden", GOLDEN.values(), ids=GOLDEN)
def test_the_undamaged_files_open_and_can_be_written(golden, encode_sfs, tmp_path):
    path = tmp_path / "whole.sfs"
    path.write_bytes(encode_sfs(golden()))
    scene = FORMAT.open(path)
    look_at_everything(scene)
    assert len(scene.sensors) + len(scene.annotations) > 1
    write_scene(scene, tmp_path / "again.sfs")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"\0" * 100,
        b'{"version":"1.0"}',
        b'{"version":"1.0"}\0',
        b'{"version":"1.0","annotations":' + b"[" * 5000 + b"]" * 5000 + b"}\0",
        b'{"version":"1.0","x":' + b'{"a":' * 400 + b"1" + b"}" * 400 + b"}\0",
        b'{"version":"1.0","time_offset":1e300}\0',
        b'{"version":"1.0","time_offset":' + b"9" * 400 + b"}\0",
        b'{"version":"1.0","sensors":[{"type":"lidar","id":"\\ud800","frames":[]}]}\0',
        b'{"version":"1.0","sensors":[{"type":"\\u0000","id":""}]}\0',
        b'\xef\xbb\xbf{"version":"1.0"}\0',
        b'{"version":"1.0"}' + b" " * 1_000_000 + b"\0",
    ],
)
def test_odd_files_give_a_scene_or_an_error_of_ours(survives, content):
    survives(content)


def test_folders_and_missing_files_give_an_error_of_ours(tmp_path):
    for path in (tmp_path, tmp_path / "absent.sfs"):
        with pytest.raises(SceneloomError):
            FORMAT.open(path)
        assert not FORMAT.sniff(path)
