"""Clauses of the description that a file can break and still be read: each is found, and reported once."""

import numpy as np
import pytest

import sceneloom
from sceneloom.checks import validate
from sceneloom.errors import DataError

POSES = {"timestamps": [0, 10**6], "values": [[0, 0, 0, 0, 0, 0, 1], [9, 0, 0, 0, 0, 0, 1]]}
BOX = [4, 2, 1.5, 1, 2, 3, 0, 0, 0]
ROAD = [[0.0, 10.0], [5.0, 12.0], [10.0, 14.0], [15.0, 16.0], [20.0, 18.0], [25.0, 20.0]]


def lidar(times=None, **fields):
    points = {"positions": np.ones((4, 3), np.float32)}
    if times is not None:
        points["timestamps"] = times
    return {
        "id": "top",
        "type": "lidar",
        "poses": POSES,
        "frames": [{"timestamp": 0, "points": points}],
        **fields,
    }


def scene(*annotations, sensors=None, **fields):
    return {
        "version": "1.0",
        "sensors": [lidar()] if sensors is None else sensors,
        "annotations": list(annotations),
        **fields,
    }


def cuboid(**fields):
    return {"id": "car", "type": "cuboid", "path": {"timestamps": [0], "values": [BOX]}, **fields}


@pytest.fixture
def file(tmp_path, encode_sfs):
    """Write a header as a file; items have no dtype and shape where `bare`."""

    def write(content, *, bare=False):
        path = tmp_path / "scene.sfs"
        path.write_bytes(encode_sfs(content, **({"dtype": None, "shape": None} if bare else {})))
        return path

    return write


def found(path, *rules, **options):
    report = validate(path, rules=rules, frames=False, **options)
    return [(finding.path, finding.message) for finding in report.findings]


@pytest.mark.parametrize(("unit", "dtype"), [("nanoseconds", np.uint64), ("microseconds", np.uint32)])
def test_times_without_a_dtype_are_as_wide_as_the_unit_says(file, unit, dtype):
    times = np.arange(4, dtype=dtype) * 1000
    with sceneloom.open(file(scene(sensors=[lidar(times)], time_unit=unit), bare=True)) as opened:
        ticks = 1 if unit == "nanoseconds" else 1000
        points = opened.sensors[0].frames[0].points
        assert points.timestamps_ns.tolist() == (np.arange(4) * 1000 * ticks).tolist()


@pytest.mark.parametrize(
    ("unit", "dtype", "fits"),
    [("nanoseconds", np.uint32, "uint32"), ("microseconds", np.uint64, "uint64")],
)
def test_times_without_a_dtype_of_another_width_are_refused_and_named(file, unit, dtype, fits):
    content = scene(sensors=[lidar(np.arange(4, dtype=dtype))], time_unit=unit)
    with pytest.raises(DataError, match=f"the bytes fit {fits}"):
        sceneloom.open(file(content, bare=True))


@pytest.mark.parametrize(
    ("unit", "dtype", "wrong"),
    [
        ("nanoseconds", np.uint32, True),
        ("nanoseconds", np.uint64, False),
        ("microseconds", np.uint64, True),
        (None, np.uint64, True),
        (None, np.uint32, False),
        (None, np.int32, True),
    ],
)
def test_times_of_another_width_than_the_unit_says_are_found_and_fixed(tmp_path, file, unit, dtype, wrong):
    fields = {} if unit is None else {"time_unit": unit}
    path = file(scene(sensors=[lidar(np.arange(4, dtype=dtype))], **fields))
    locations = [location for location, _ in found(path, "point-times-width")]
    assert locations == (["sensors[0].frames[0].points.timestamps"] if wrong else [])
    report = validate(path, fix=tmp_path / "fixed.sfs")
    assert "point-times-width" not in {finding.rule for finding in report.findings}


@pytest.mark.parametrize("unit", ["nanosecond", "microsecond", "nanoseconds", "microseconds"])
def test_the_unit_of_time_is_written_back_as_it_was_read(tmp_path, file, decode_sfs, unit):
    dtype = np.uint64 if unit.startswith("nano") else np.uint32
    path = file(scene(sensors=[lidar(np.arange(4, dtype=dtype))], time_unit=unit))
    with sceneloom.open(path) as opened:
        sceneloom.write(opened, tmp_path / "again.sfs")
        sceneloom.write(opened, tmp_path / "asked.sfs", time_unit="nanoseconds")
    assert decode_sfs((tmp_path / "again.sfs").read_bytes())["time_unit"] == unit
    assert decode_sfs((tmp_path / "asked.sfs").read_bytes())["time_unit"] == "nanoseconds"


@pytest.mark.parametrize(
    ("kind", "near"), [("cubiod", "cuboid"), ("Cuboid", "cuboid"), ("box2d", "box_2d"), ("xyzzy", None)]
)
def test_a_misspelt_type_of_annotation_is_found_with_the_nearest_one(file, kind, near):
    ((location, message),) = found(file(scene({"id": 1, "type": kind})), "annotation-type-known")
    assert location == "annotations[0].type"
    assert (f"which is like {near!r}" in message) if near else "which is like" not in message


def test_a_misspelt_type_of_sensor_is_found_with_the_nearest_one(file):
    path = file(scene(sensors=[{"id": 1, "type": "lidr"}]))
    ((_, message),) = found(path, "sensor-type-known")
    assert "which is like 'lidar'" in message


def test_attributes_of_the_scene_name_sensors_of_it_and_have_rising_times(tmp_path, file):
    attributes = [
        {"name": "state", "sensor_id": "nowhere", "timestamps": [0], "values": ["dirty"]},
        {"name": "weather", "timestamps": [20, 10], "values": ["dry", "wet"]},
    ]
    path = file(scene(attributes=attributes))
    assert [location for location, _ in found(path, "annotation-sensor-unknown")] == [
        "attributes[0].sensor_id"
    ]
    assert [location for location, _ in found(path, "annotation-times-increasing")] == [
        "attributes[1].timestamps[1]"
    ]
    validate(path, fix=tmp_path / "fixed.sfs")
    with sceneloom.open(tmp_path / "fixed.sfs") as opened:
        assert opened.attributes[1].timestamps_ns.tolist() == [10_000, 20_000]
        assert opened.attributes[1].values == ("wet", "dry")


def test_a_second_activation_or_projection_of_one_sensor_is_found(file):
    active = {"sensor_id": "top", "timestamps": [0], "durations": [5]}
    seen = {"sensor_id": "top", "timestamps": [0], "boxes": [[1, 2, 3, 4]]}
    point = {"sensor_id": "top", "timestamps": [0], "points": [[1, 2]]}
    keypoints = {
        "id": "k",
        "type": "points",
        "paths": [{"timestamps": [0], "values": [[1, 2, 3]]}] * 2,
        "projections": [[point], [point, point]],
    }
    content = scene(cuboid(activations=[active, active], projections=[seen, seen]), keypoints)
    assert [location for location, _ in found(file(content), "part-of-sensor-once")] == [
        "annotations[0].activations[1].sensor_id",
        "annotations[0].projections[1].sensor_id",
        "annotations[1].projections[1][1].sensor_id",
    ]
    assert not found(file(scene(cuboid(activations=[active], projections=[seen]))), "part-of-sensor-once")


@pytest.mark.parametrize("kind", ["polyline", "polygon", "polygon_topdown"])
def test_pairs_that_are_read_as_triples_are_found_and_read_as_pairs_on_request(file, kind):
    pairs = [value for vertex in ROAD for value in vertex]
    path = file(scene({"id": 1, "type": kind, "path": {"timestamps": [0], "values": [pairs]}}))
    ((location, message),) = found(path, "shape-vertices-pairs")
    assert location == "annotations[0].path.values"
    assert "12 numbers, read as 4 x, y, z triples" in message
    assert not found(path, "shape-vertices-pairs", vertices="pairs")
    with sceneloom.open(path, vertices="pairs") as opened:
        assert opened.annotations[0].path.vertices[0].tolist() == [[x, y, 0.0] for x, y in ROAD]
    with sceneloom.open(path) as opened:
        assert len(opened.annotations[0].path.vertices[0]) == 4


@pytest.mark.parametrize("offset", [0.0, 1.0, 40.0, -300.0])
def test_triples_are_not_taken_for_pairs(file, offset):
    triples = [value for x, y in ROAD for value in (x + offset, y, 0.1 * x)]
    path = file(scene({"id": 1, "type": "polyline", "path": {"timestamps": [0], "values": [triples]}}))
    assert not found(path, "shape-vertices-pairs")


def test_rows_that_fit_both_are_questioned_beside_rows_that_are_pairs(file):
    both = {"id": 1, "type": "polyline", "path": {"timestamps": [0], "values": [[0, 0, 1, 1, 0, 2]]}}
    pairs = {"id": 2, "type": "polyline", "path": {"timestamps": [0], "values": [[0, 0, 1, 1]]}}
    assert not found(file(scene(both)), "shape-vertices-pairs")
    ((location, message),) = found(file(scene(both, pairs)), "shape-vertices-pairs")
    assert location == "annotations[0].path.values"
    assert "as in other annotations of the file" in message


def test_vertices_that_are_not_what_was_stated_are_refused(file):
    path = file(scene({"id": 1, "type": "polyline", "path": {"timestamps": [0], "values": [[0] * 8]}}))
    with pytest.raises(DataError, match="8 numbers; expected a multiple of 3"):
        sceneloom.open(path, vertices="triples")


def test_one_bad_sensor_is_reported_once_and_not_by_all_that_name_it(file):
    seen = [
        cuboid(id=k, projections=[{"sensor_id": "cam", "timestamps": [0], "boxes": [[1, 2, 3, 4]]}])
        for k in range(20)
    ]
    bad = {"id": "cam", "type": "camera", "poses": POSES, "intrinsics": {"fx": "wide"}}
    child = {"id": "ego", "type": "odometry", "parent_id": "cam", "poses": POSES}
    link = {"id": "l", "type": "link", "label": "x", "is_bidirectional": True, "from_id": 0, "to_id": "gone"}
    gone = {"id": "gone", "type": "cuboid", "parent_id": "cam"}
    path = file(scene(*seen, link, gone, sensors=[lidar(), bad, child]))
    stated = [message for _, message in found(path)]
    assert not [message for message in stated if "is no sensor" in message or "is no annotation" in message]
    assert "sensors[1].intrinsics.fx" in [location for location, _ in found(path, "fields-valid")]


def test_a_part_keeps_attributes_without_times_and_points_that_no_camera_sees(tmp_path, file):
    empty = {"name": "colour", "timestamps": [], "values": []}
    point = {"sensor_id": "top", "timestamps": [0], "points": [[1, 2]]}
    keypoints = {
        "id": "k",
        "type": "points",
        "stationary": True,
        "attributes": [empty],
        "paths": [{"timestamps": [0], "values": [[1, 2, 3]]}] * 2,
        "projections": [[], [point]],
    }
    path = file(scene(keypoints, attributes=[empty]))
    sceneloom.convert(path, tmp_path / "whole.sfs")
    with sceneloom.open(path) as opened:
        part = sceneloom.crop_scene(opened, stop=0.5)
        assert [attribute.name for attribute in part.attributes] == ["colour"]
        assert [attribute.name for attribute in part.annotations[0].attributes] == ["colour"]
