"""One value at fault costs no more than it must: the array, else the frame, else the sensor or annotation."""

import json
import pickle

import numpy as np
import pytest

import sceneloom
from sceneloom.errors import DataError
from sceneloom.formats.sfs.reader import copied, examine, parse_path
from sceneloom.formats.sfs.spec import FORMAT

POSE = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
BOX = [4.0, 2.0, 1.5, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0]
JPEG = np.frombuffer(b"\xff\xd8\xff\xe0 no image", np.uint8)


def poses():
    return {"timestamps": [0, 100_000, 200_000], "values": [[k, *POSE[1:]] for k in range(3)]}


def cloud(kind, k):
    points = {"positions": np.full((4, 3), k, np.float32), "timestamps": np.full(4, 100_000 * k, np.uint32)}
    if kind == "radar":
        return points | {"directions": np.ones((4, 3), np.float32), "lengths": np.ones(4, np.float32)}
    return points | {"colors": np.zeros((4, 3), np.uint8), "intensities": np.zeros(4, np.uint8)}


def swept(identifier, kind):
    frames = [{"timestamp": 100_000 * k, "points": cloud(kind, k)} for k in range(3)]
    return {"id": identifier, "type": kind, "poses": poses(), "frames": frames}


def path(*rows):
    return {"timestamps": [100_000 * k for k in range(len(rows))], "values": [list(row) for row in rows]}


def header():
    attribute = {"name": "colour", "timestamps": [0], "values": ["red"]}
    projection = {"sensor_id": "cam", "timestamps": [0], "boxes": [[1, 2, 3, 4]], "confirmed": [True]}
    point = {"sensor_id": "cam", "timestamps": [0], "points": [[1, 2]]}
    images = [{"timestamp": 100_000 * k, "content": JPEG} for k in range(3)]
    intrinsics = {"fx": 9, "fy": 9, "cx": 4, "cy": 3, "width": 8, "height": 6}
    chart = {"positions": np.ones((2, 3), np.float32), "colors": np.ones((2, 3), np.uint8)}
    active = {"sensor_id": "top", "timestamps": [0], "durations": [5]}
    car = {"id": "car", "type": "cuboid", "path": path(BOX, BOX, BOX)}
    car["attributes"] = [attribute, {**attribute, "name": "access", "values": [4]}]
    car["activations"] = [active, {**active, "sensor_id": "front"}]
    car["projections"] = [projection, {**projection, "timestamps": [100_000]}]
    pose = {"id": "pose", "type": "points", "labels": ["head", "hand", "foot"]}
    pose["paths"] = [path([k, 0, 0], [k, 0, 1]) for k in range(3)]
    pose["projections"] = [[point], [point], []]
    pose["attributes"] = [{**attribute, "point_index": 2}, {**attribute, "point_index": 1}]
    ids = np.arange(2, dtype=np.uint32)
    road = {"id": "road", "type": "labeled_points", "label": "road", "is_instance": False}
    road["labeled_points"] = [{"sensor_id": "top", "sensor_frame": k, "point_ids": ids} for k in range(3)]
    return {
        "version": "1.0",
        "sensors": [
            swept("top", "lidar"),
            swept("front", "radar"),
            {"id": "cam", "type": "camera", "poses": poses(), "intrinsics": intrinsics, "images": images},
            {"id": "map", "type": "points", "points": chart},
            {"id": "ego", "type": "odometry", "poses": poses()},
        ],
        "annotations": [
            car,
            pose,
            road,
            {"id": "lane", "type": "polyline", "path": path([0, 0, 0, 1, 0, 0], [0, 0, 0, 2, 0, 0])},
        ],
        "attributes": [attribute, {**attribute, "name": "weather"}],
    }


def with_value(tree, location, value):
    """A header in which one value is another."""
    changed = copied(tree)
    node = changed
    *above, last = parse_path(location)
    for key in above:
        node = node[key]
    node[last] = value
    return changed


def outline(scene):
    """What is in a scene, in numbers and names that a lost part would change."""
    found = {}
    for sensor in scene.sensors:
        frames = getattr(sensor, "frames", None) or getattr(sensor, "images", None) or ()
        given = [getattr(sensor, "poses", None) is not None and len(sensor.poses.timestamps_ns), len(frames)]
        for frame in frames:
            points = getattr(frame, "points", None)
            names = ("colors", "intensities", "directions", "lengths", "timestamps_ns")
            given += [getattr(points, name, None) is not None for name in names]
        found[sensor.id] = [*given, getattr(sensor, "colors", None) is not None]
    for annotation in scene.annotations:
        shape = getattr(annotation, "path", None)
        found[annotation.id] = [
            shape is not None and len(shape.timestamps_ns),
            [attribute.name for attribute in getattr(annotation, "attributes", ())],
            len(getattr(annotation, "activations", ())),
            [getattr(p, "boxes", None) is not None for p in getattr(annotation, "projections", ())],
            getattr(annotation, "labels", None) or getattr(annotation, "label", None),
            len(getattr(annotation, "labeled_points", ())),
        ]
    found["scene"] = [attribute.name for attribute in scene.attributes]
    return found


SHORT = np.zeros(3, np.float32)
CASES = [
    ("sensors[0].frames[1].points.colors", np.zeros((3, 3), np.uint8), "colors of frame 1 of lidar 'top'"),
    ("sensors[0].frames[1].points.intensities", SHORT, "intensities of frame 1 of lidar 'top'"),
    ("sensors[0].frames[1].points.timestamps", SHORT, "timestamps of frame 1 of lidar 'top'"),
    ("sensors[0].frames[1].points.positions", np.zeros(5, np.float32), "frame 1 of lidar 'top'"),
    ("sensors[0].frames[1].timestamp", "soon", "frame 1 of lidar 'top'"),
    ("sensors[0].frames[1]", None, "frame 1 of lidar 'top'"),
    ("sensors[0].poses.values[1]", [0, 0, 0, 0, 0, 0, 0], "poses.values[1] of lidar 'top'"),
    ("sensors[0].poses.values", [POSE], "poses of lidar 'top'"),
    ("sensors[0].coordinates", "moon", "lidar 'top'"),
    ("sensors[0].frames", 5, "lidar 'top'"),
    ("sensors[1].frames[2].points.lengths", SHORT, "lengths of frame 2 of radar 'front'"),
    ("sensors[1].frames[2].points.directions", SHORT, "directions of frame 2 of radar 'front'"),
    ("sensors[1].frames[2].points.positions", "", "frame 2 of radar 'front'"),
    ("sensors[2].images[0].content", np.zeros(3), "image 0 of camera 'cam'"),
    ("sensors[2].images[0].timestamp", None, "image 0 of camera 'cam'"),
    ("sensors[2].poses.values[0]", [float("nan"), *POSE[1:]], "poses.values[0] of camera 'cam'"),
    ("sensors[2].intrinsics.fx", "wide", "camera 'cam'"),
    ("sensors[2].intrinsics.distortion", {"model": "fisheye", "params": "none"}, "camera 'cam'"),
    ("sensors[3].points.colors", np.zeros((1, 3), np.uint8), "colors of points 'map'"),
    ("sensors[3].points.positions", 1, "points 'map'"),
    ("sensors[4].poses.values[2]", [0, 0, 0, 0, 0, 0, 0], "poses.values[2] of odometry 'ego'"),
    ("sensors[4].poses", {"timestamps": [0]}, "odometry 'ego'"),
    ("annotations[0].path.values[1]", BOX[:8], "path.values[1] of cuboid 'car'"),
    ("annotations[0].path.timestamps", [0], "cuboid 'car'"),
    ("annotations[0].attributes[1].values", 4, "attributes[1] of cuboid 'car'"),
    ("annotations[0].activations[0].durations", [1, 2], "activations[0] of cuboid 'car'"),
    ("annotations[0].projections[1].boxes", [[1, 2]], "projections[1].boxes of cuboid 'car'"),
    ("annotations[0].projections[1].timestamps", "x", "projections[1] of cuboid 'car'"),
    ("annotations[1].paths[0].values", "x", "paths[0] of points 'pose'"),
    ("annotations[1].projections[1][0].points", [[1]], "projections[1][0].points of points 'pose'"),
    ("annotations[2].labeled_points[1].point_ids", SHORT, "labeled_points[1] of labeled_points 'road'"),
    ("annotations[2].label", 5, "label of labeled_points 'road'"),
    ("annotations[3].path.values[0]", ["a"], "path.values[0] of polyline 'lane'"),
    ("attributes[0].values", 3, "attributes[0]"),
]


@pytest.mark.parametrize(("location", "value", "words"), CASES)
def test_a_value_at_fault_costs_the_least_part_that_cannot_be_without_it(tmp_path, encode_sfs, location, value, words):
    file = tmp_path / "scene.sfs"
    file.write_bytes(encode_sfs(header()))
    with FORMAT.open(file) as scene:
        whole = outline(scene)
    file.write_bytes(encode_sfs(with_value(header(), location, value)))
    with pytest.raises(DataError):
        FORMAT.open(file)
    with FORMAT.open(file, lenient=True) as scene:
        found = outline(scene)
        warnings = [n for n in scene.warnings if n.code == "at-fault"]
    owner = words.rpartition("'")[0].rpartition("'")[2] or "scene"
    changed = {name for name in whole if found.get(name) != whole[name]}
    assert changed - {owner} <= ({"road"} if "frame 1 of lidar" in words else set())
    assert owner in changed or words.startswith("projections[1][0]")
    assert len(warnings) == 1
    assert words in warnings[0].message or owner not in found
    faults = [fault for fault in examine(file).faults if not fault.repaired]
    assert faults
    assert {fault.costs for fault in faults} == {words}


def test_what_belongs_to_points_and_frames_follows_those_that_stay(tmp_path, encode_sfs):
    file = tmp_path / "scene.sfs"
    file.write_bytes(encode_sfs(with_value(header(), "annotations[1].paths[0].timestamps", None)))
    with FORMAT.open(file, lenient=True) as scene:
        points = scene.annotations[1]
    assert points.labels == ("hand", "foot")
    assert [path.values[0, 0] for path in points.paths] == [1, 2]
    assert [len(of_point) for of_point in points.projections] == [1, 0]
    assert [attribute.point_index for attribute in points.attributes] == [1, 0]
    file.write_bytes(encode_sfs(with_value(header(), "sensors[0].frames[1].points.positions", 1)))
    with FORMAT.open(file, lenient=True) as scene, pickle.loads(pickle.dumps(scene)) as in_another_process:
        assert [part.sensor_frame for part in scene.annotations[2].labeled_points] == [0, 1]
        assert [float(f.points.positions[0, 0]) for f in in_another_process.sensors[0].frames] == [0.0, 2.0]


def test_fixing_keeps_what_is_whole_and_lists_every_loss(tmp_path, encode_sfs):
    file, target = tmp_path / "scene.sfs", tmp_path / "fixed.sfs"
    damaged = with_value(header(), "sensors[0].frames[0].points.positions", np.zeros(5, np.float32))
    damaged = with_value(damaged, "sensors[1].frames[2].points.lengths", SHORT)
    damaged["sensors"][2].pop("images")
    damaged["sensors"][0]["frames"][2]["points"]["positions"][0] = np.nan
    file.write_bytes(encode_sfs(damaged))
    report = sceneloom.validate(file, fix=target)
    assert {(loss.path.partition(" ")[0], loss.message.partition("left out: ")[2]) for loss in report.left_out} == {
        ("sensors[0].frames[0].points.positions", "frame 0 of lidar 'top'"),
        ("sensors[1].frames[2].points.lengths", "lengths of frame 2 of radar 'front'"),
    }
    with FORMAT.open(target) as scene:
        assert [len(sensor.frames) for sensor in scene.sensors[:2]] == [2, 3]
    found = sceneloom.validate(file, rules=["points-not-finite"]).findings
    assert [finding.path for finding in found] == ["sensors[0].frames[2].points.positions"]
    # faults that a removal brings to light are reported at their location in the file
    content = {**header(), "sensors": header()["sensors"][4:], "annotations": [], "attributes": []}
    rows = content["sensors"][0]["poses"]["values"]
    rows[0], rows[2] = [float("inf"), *POSE[1:]], [0] * 7
    file.write_bytes(json.dumps(content).encode())
    assert [fault.path for fault in examine(file).faults] == [f"sensors[0].poses.values[{k}]" for k in (0, 2)]
