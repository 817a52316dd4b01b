"""File to file: an `.sfs` that is read and written again loses nothing; Scale's profile keeps aside what it must."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.formats.sfs.clock import INT64_MIN
from sceneloom.formats.sfs.spec import FORMAT
from sceneloom.formats.sfs.writer import write_scene
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import GnssSensor, OdometrySensor, Scene, Trajectory

TWO = np.array([[1, 2, 3], [4, 5, 6]], np.float32)
POSES = {"timestamps": [5, 105], "values": [[1.5, 2, 3, 0, 0, 0, 1], [1.5, 2, 3, 0, 0, 0.6, 0.8]], "smoothed": True}
PATH = {"timestamps": [5, 6], "values": [[0.25, 1.5, 3], [3, 4, -5.5]], "closed": "no"}
FLAT_PATH = {"timestamps": [5, 6], "values": [[0.25, 1.5, 3, 4], [3, 4, 5, 6]], "closed": "no"}
ATTRIBUTES = [
    {"name": "speed", "sensor_id": "top", "static": False, "timestamps": [5, 7], "values": [1.5, -2]},
    {"name": "colour", "static": True, "timestamps": [5, 6], "values": ["red", ["a", "b"]], "by": "hand"},
]
FLAT_SHAPES = ("box_2d", "polyline_2d", "polygon_2d", "point_2d")
SHAPES = ("polygon", "polygon_topdown", "polyline", "point", "point_topdown")
ROW = [4.0, 2.0, 1.5, 1.0, 2.0, 3.0, 0.0, 0.0, 270.0]


def frame(timestamp, **points):
    return {"timestamp": timestamp, "points": {"positions": TWO + timestamp, **points}, "quality": [1, None, "x"]}


def annotated(identifier, kind, **fields):
    return {"id": identifier, "type": kind, **fields}


def sensors_of_all_types():
    points = {
        "colors": np.array([[1, 2, 3], [4, 5, 6]], np.uint8),
        "intensities": np.array([7, 8], np.uint8),
        "timestamps": np.array([5, 9], np.uint32),
        "ring": np.array([1, 300], np.uint16),
        "camera_index": np.array([0, 255], np.uint8),
        "confidence": np.array([0.1, 0.2]),
    }
    moving = {"coordinates": "world", "poses": POSES}
    returns = {"directions": TWO, "lengths": np.array([1.5, 2], np.float32), "rcs": np.array([3.0, 4.0])}
    distortion = {"model": "from_the_future", "params": [0.5], "fit": 0.1}
    intrinsics = {"fx": 10.5, "fy": 11.5, "cx": 3.5, "cy": 2.5, "width": 8, "height": 6, "distortion": distortion}
    image = {"timestamp": 6, "content": np.frombuffer(b"\xff\xd8\xff\xe0 any bytes", np.uint8), "iso": 100}
    lidar = {"id": "top", "type": "lidar", "parent_id": 7, **moving, "fw": "1.2"}
    radar = {"id": 7, "type": "radar", **moving, "coordinates": "ego", "frames": [frame(5, **returns)]}
    camera = {"id": "front", "type": "camera", **moving, "intrinsics": {**intrinsics, "skew": 0.0}, "images": [image]}
    return [
        {**lidar, "frames": [frame(5, **points), frame(100_005)]},
        radar,
        {"id": "7", "type": "points", "points": {"positions": TWO * 20_000, "colors": points["colors"], "n": TWO}},
        {"id": "car", "type": "odometry", "poses": POSES, "maker": {"name": "x"}},
        {"id": "odd", "type": "sonar", "poses": POSES, "frames": [{"timestamp": 9, "pings": TWO}]},
        camera,
    ]


def annotations_of_all_types():
    flat = {"label": "x", "stationary": True, "attributes": ATTRIBUTES, "parent_id": "o"}
    seen = {"sensor_id": "front", "timestamps": [5, 6], "boxes": [[1, 2, 3, 4], None], "confirmed": [True, False]}
    active = {"sensor_id": "top", "timestamps": [5], "durations": [2.5], "cuboids": [ROW], "q": 1}
    box = {"path": {"timestamps": [5, 6], "values": [ROW, ROW], "smooth": 1}, "meta": {"deep": [{"array": TWO}]}}
    shapes = [
        annotated(f"shape {kind}", kind, sensor_id="front", path=path, **flat, unknown=kind)
        for kinds, path in ((FLAT_SHAPES, FLAT_PATH), (SHAPES, PATH))
        for kind in kinds
    ]
    point = {"sensor_id": "front", "timestamps": [5], "points": [None], "positions": [[1, 2, 3]]}
    keypoints = {"labels": ["a", "b"], "paths": [{"id": 0, **PATH}, PATH], "projections": [[point], []]}
    labelled = [{"sensor_id": "top", "sensor_frame": 0, "point_ids": np.array([0, 1], np.uint32)}]
    distortion = {"model": "fisheye", "params": [0.1, 0.2, 0.3, 0.4], "fit": 0.1}
    intrinsics = {"fx": 1.5, "fy": 1.5, "cx": 1.5, "cy": 1.5, "width": 8, "height": 6, "distortion": distortion}
    calibration = {"time_offset": -3, "poses": POSES, "intrinsics": {**intrinsics, "skew": 0.0}}
    return [
        annotated("c", "cuboid", **flat, **box, activations=[active], projections=[seen]),
        *shapes,
        annotated(1, "points", **keypoints, attributes=[{**ATTRIBUTES[0], "point_index": 1}]),
        annotated(2, "event", start=7, duration=3.5, sensor_id="top"),
        annotated(3, "labeled_points", label="road", is_instance=False, labeled_points=labelled),
        annotated(4, "localization_adjustment", poses=POSES),
        annotated(5, "camera_calibration", sensor_id="front", **calibration),
        annotated("o", "object", label="thing"),
        annotated(6, "link", label="l", from_id="c", to_id=1, is_bidirectional=True),
        annotated(7, "group", label="g"),
        annotated(8, "attributes", attributes=ATTRIBUTES),
        annotated(9, "future", path=PATH, start="soon", payload=TWO, none=None),
    ]


@pytest.fixture(scope="module")
def header():
    """One of everything, with unknown fields everywhere."""
    return {
        "version": "1.0",
        "time_unit": "microseconds",
        "time_offset": 1_700_000_000_123_456,
        "sensors": sensors_of_all_types(),
        "annotations": annotations_of_all_types(),
        "attributes": ATTRIBUTES,
        "metadata": {"town": "Ulm", "grid": TWO, "big": 2**70, "unicode": "Straße 🚗", "none": None},
        "licence": {"name": "open", "since": 2020},
    }


def plain(node):
    """Arrays as lists with their dtype, so that `==` compares everything."""
    if isinstance(node, dict):
        return {key: plain(value) for key, value in node.items()}
    if isinstance(node, list):
        return [plain(value) for value in node]
    return (node.dtype.name, node.tolist()) if isinstance(node, np.ndarray) else node


def without_ours(header):
    metadata = {name: value for name, value in header["metadata"].items() if name != "sceneloom"}
    return {**header, "metadata": metadata}


@pytest.mark.parametrize("unit", ["microseconds", "nanoseconds"])
def test_a_file_that_is_read_and_written_is_the_same(open_header, target, decode_sfs, header, unit):
    header = {**header, "time_unit": unit, "sensors": sensors_of_all_types()}
    if unit == "nanoseconds":
        points = header["sensors"][0]["frames"][0]["points"]
        points["timestamps"] = points["timestamps"].astype(np.uint64)
    report = write_scene(open_header(header), target)
    expected, found = plain(header), plain(without_ours(decode_sfs(target.read_bytes())))
    assert list(found) == [name for name in found if name in expected]
    for part in ("version", "time_unit", "time_offset", "attributes", "metadata", "licence"):
        assert found[part] == expected[part], part
    for kind in ("sensors", "annotations"):
        for read, original in zip(found[kind], expected[kind], strict=True):
            assert read == original, original["type"]
    assert not report.losses
    write_scene(FORMAT.open(target), target.with_name("again.sfs"))
    assert target.with_name("again.sfs").read_bytes() == target.read_bytes()


def test_times_are_equal_in_another_unit(open_header, target, header):
    before = open_header(header)
    write_scene(before, target, time_unit="nanoseconds")
    after = FORMAT.open(target)
    assert (after.extras["time_unit"], after.time_offset_ns) == ("nanoseconds", before.time_offset_ns)
    times, expected = (scene.sensors[0].frames[0].points.timestamps_ns for scene in (after, before))
    np.testing.assert_array_equal(times, expected)
    assert after.annotations[0].activations[0].durations_ns == (2500,)


def test_the_profile_of_scale_keeps_aside_what_it_drops_and_a_file_of_it_comes_back_whole(
    open_header, target, decode_sfs, header
):
    report = write_scene(open_header(header), target, profile="scale")
    written = decode_sfs(target.read_bytes())
    assert [sensor["type"] for sensor in written["sensors"]] == ["lidar", "radar", "camera"]
    assert "lengths" not in written["sensors"][1]["frames"][0]["points"]
    assert written["annotations"][0]["attributes"][0]["values"] == [1500, -2000]
    assert written["annotations"][0]["attributes"][1]["timestamps"] == [5]
    assert not written["sensors"][2]["intrinsics"].get("distortion", {}).get("model")
    losses = {loss.field: loss.kept for loss in report}
    for field in ("sensors[car]", "sensors[7]", "sensors[odd]", "annotations[group]", "annotations[link]"):
        assert losses[field].startswith("metadata.sceneloom."), field
    assert losses["sensors[7].frames[].points.lengths"] == "metadata.sceneloom.sensor_notes[].lengths"
    assert losses["annotations[].attributes[]"] == "metadata.sceneloom.exact_attributes"
    back = target.with_name("back.sfs")
    write_scene(FORMAT.open(target), back)
    found, expected = plain(without_ours(decode_sfs(back.read_bytes()))), plain(header)
    for kind in ("sensors", "annotations"):
        by_id = {(type(item["id"]), item["id"]): item for item in found[kind]}
        assert len(by_id) == len(expected[kind])
        for original in expected[kind]:
            read = by_id[type(original["id"]), original["id"]]
            if original["type"] == "camera":
                read["intrinsics"]["distortion"] = original["intrinsics"]["distortion"]
            assert read == original, original["type"]
    assert found["attributes"] == expected["attributes"]


def test_covariances_of_a_trajectory_and_the_position_of_an_antenna_come_back(target):
    timestamps = np.array([5_000, 105_000], np.int64)
    positions, quaternions = np.array([[0.0, 0, 0], [1, 2, 3]]), np.array([[0.0, 0, 0, 1], [0, 0, 0.6, 0.8]])
    covariances = np.arange(72.0).reshape(2, 6, 6) / 7
    trajectory = Trajectory("lidar", timestamps, positions, quaternions, covariances=covariances)
    mount = RigidTransform.from_quaternion(np.array([0.4, -0.1, 1.2]), quaternions[1])
    gnss = GnssSensor("gnss", timestamps, positions, np.ones(2), np.ones(2), mount=mount)
    for sensors in ((gnss, OdometrySensor("ego", trajectory.poses)), (gnss,)):
        write_scene(Scene(sensors, trajectories={"lidar": trajectory}), target, overwrite=True)
        scene = FORMAT.open(target)
        for name in ("covariances", "positions", "timestamps_ns"):
            np.testing.assert_array_equal(getattr(scene.trajectories["lidar"], name), getattr(trajectory, name))
        np.testing.assert_array_equal(scene.sensor("gnss").mount.matrix, mount.matrix)
        assert scene.sensor("gnss").extras == {}
    # as do the earliest times of 64 bits
    earliest = replace(trajectory, timestamps_ns=INT64_MIN + np.array([808, 100_000_808], np.int64))
    for unit in ("microseconds", "nanoseconds"):
        write_scene(Scene((), trajectories={"lidar": earliest}), target, time_unit=unit, overwrite=True)
        np.testing.assert_array_equal(FORMAT.open(target).trajectories["lidar"].timestamps_ns, earliest.timestamps_ns)
