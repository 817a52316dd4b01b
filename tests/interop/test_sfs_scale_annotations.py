"""Annotations of every type that Scale's library knows, written there and read here, and the other way round."""

import json
import subprocess

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.formats.sfs.spec import FORMAT
from sceneloom.formats.sfs.writer import write_scene
from sceneloom.scene import (
    Activation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CameraCalibration,
    CuboidAnnotation,
    CuboidPath,
    EventAnnotation,
    GroupAnnotation,
    LabeledPoints,
    LabeledPointsAnnotation,
    LinkAnnotation,
    LocalizationAdjustment,
    ObjectAnnotation,
    PointPath,
    PointsAnnotation,
    Poses,
    Projection,
    Scene,
    ShapeAnnotation,
    ShapeType,
    VertexPath,
)

WRITE = """
import sys
import numpy as np
from scale_json_binary import write_file
from scale_sensor_fusion_io.model_converters import to_scene_spec_sfs
from scale_sensor_fusion_io.models import *
from scale_sensor_fusion_io.models.annotations.box_2d import Box2DPath
from scale_sensor_fusion_io.models.annotations.cuboid import CuboidActivationPath, CuboidProjectionPath
from scale_sensor_fusion_io.models.annotations.polygon import PolygonPath
from scale_sensor_fusion_io.models.annotations.polygon_topdown import TopdownPolygonPath
from scale_sensor_fusion_io.models.annotations.polyline import PolylinePath
attributes = [
    AttributePath(name="state", timestamps=[0, 50], values=["parked", 3], sensor_id="top", static=False),
    AttributePath(name="tags", timestamps=[0], values=[["a", "b"]], static=True)]
stated = dict(label="car", stationary=True, parent_id="o", attributes=attributes)
# its rows are x y z yaw pitch roll dx dy dz, the file's dx dy dz x y z roll pitch yaw
row = [1.0, 2.0, 3.0, 90.0, 5.0, 7.0, 4.0, 2.0, 1.5]
cuboid = CuboidAnnotation(id="c", path=CuboidPath([row, row], index=[0, 100]), **stated, activations=[
    CuboidActivationPath(sensor_id="top", timestamps=[0, 50], durations=[10.0, 2.5], cuboids=[row, row]),
    CuboidActivationPath(sensor_id=7, timestamps=[1], durations=[3], cuboids=None)], projections=[
    CuboidProjectionPath(sensor_id="front", timestamps=[0, 50], boxes=[[1.0, 2.0, 3.0, 4.5], None], cuboids=None)])
line, other = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [1.5, 2.5, 3.5]
poses = Poses([[1, 2, 3, 0, 0, 0.6, 0.8], [2, 3, 4, 0, 0, 0, 1]], index=[0, 100])
scene = Scene(sensors=[], annotations=[
    cuboid,
    AttributesAnnotation(id=1, parent_id="o", attributes=attributes),
    Box2DAnnotation(id="b", sensor_id="front", path=Box2DPath([0], [[1.0, 2.0, 3.0, 4.5]]), **stated),
    PolygonAnnotation(id="p", sensor_id="front", path=PolygonPath([0], [line]), **stated),
    TopdownPolygonAnnotation(id="t", sensor_id=None, path=TopdownPolygonPath([0, 9], [line, other]), **stated),
    PolylineAnnotation(id="l", sensor_id=None, path=PolylinePath([0, 9], [line, other]), is_closed=True,
        label="lane", stationary=True, attributes=attributes),
    EventAnnotation(id="e", start=5, duration=3, label="cut-in", sensor_id=7, parent_id="o", attributes=attributes),
    LabeledPointsAnnotation(id="s", label="road", is_instance=True, parent_id="o", labeled_points=[
        LabeledPoint(sensor_id="top", point_ids=np.array([1, 3], np.uint32), sensor_frame=2),
        LabeledPoint(sensor_id="map", point_ids=np.array([0], np.uint32))]),
    LocalizationAdjustmentAnnotation(id="a", poses=poses, parent_id="o"),
    ObjectAnnotation(id="o", label="thing", attributes=attributes),
], attributes=attributes, time_offset=1000, time_unit="microseconds")
write_file(sys.argv[1], to_scene_spec_sfs(scene))
"""

READ = """
import contextlib, io, json, sys
import numpy as np
with contextlib.redirect_stdout(io.StringIO()):
    from scale_json_binary import read_file
    from scale_sensor_fusion_io.loaders import SFSLoader
    from scale_sensor_fusion_io.validation import parse_and_validate_scene
    result = parse_and_validate_scene(read_file(sys.argv[1]))
    scene = SFSLoader(sys.argv[1]).load_as_sfs()
    SFSLoader(sys.argv[1]).load()

def plain(value):
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__}
    return value

print(json.dumps({
    "valid": result.success, "offset": scene.time_offset, "attributes": plain(scene.attributes),
    "annotations": {str(a.id): {"class": type(a).__name__, **plain(a)} for a in scene.annotations}}))
"""

MS = 1_000_000
START = 1_700_000_000_000 * MS
ROW = [4.0, 2.0, 1.5, 1.0, 2.0, 3.0, 7.0, 5.0, 90.0]


@pytest.fixture
def scale(scale_python):
    """Run a program in Scale's interpreter."""

    def run(program, path):
        done = subprocess.run(
            [scale_python, "-c", program, str(path)], capture_output=True, text=True, timeout=300, check=False
        )
        assert done.returncode == 0, done.stderr[-2000:]
        return json.loads(done.stdout.splitlines()[-1]) if done.stdout.strip() else None

    return run


def assert_attributes(attributes):
    """Those that the program above writes."""
    state, tags = attributes
    assert (state.name, state.values, state.sensor_id, state.static) == ("state", ("parked", 3), "top", False)
    assert state.timestamps_ns.tolist() == [1_000_000, 1_050_000]
    assert (tags.name, tags.values, tags.static) == ("tags", (("a", "b"),), True)


def test_every_annotation_that_scales_library_writes_is_read_with_its_values(scale, tmp_path):
    path = tmp_path / "theirs.sfs"
    scale(WRITE, path)
    scene = FORMAT.open(path)
    by_id = {annotation.id: annotation for annotation in scene.annotations}
    assert_attributes(scene.attributes)
    for identifier in ("c", 1, "b", "p", "t", "l", "e", "o"):
        assert_attributes(by_id[identifier].attributes)
    for identifier in ("c", "b", "p", "t"):
        found = by_id[identifier]
        assert (found.label, found.stationary, found.parent_id) == ("car", True, "o")
    cuboid = by_id["c"]
    assert isinstance(cuboid, CuboidAnnotation)
    assert cuboid.path.timestamps_ns.tolist() == [1_000_000, 1_100_000]
    assert cuboid.path.values.tolist() == [ROW, ROW]
    first, second = cuboid.activations
    assert (first.sensor_id, first.durations_ns) == ("top", (10_000, 2_500))
    assert first.timestamps_ns.tolist() == [1_000_000, 1_050_000]
    assert first.cuboids.tolist() == [ROW, ROW]
    assert (second.sensor_id, second.durations_ns, second.cuboids) == (7, (3_000,), None)
    (seen,) = cuboid.projections
    assert seen.sensor_id == "front"
    np.testing.assert_array_equal(seen.boxes, [[1, 2, 3, 4.5], [np.nan] * 4])
    assert isinstance(by_id[1], ObjectAnnotation)
    assert (by_id[1].type, by_id[1].parent_id) == ("attributes", "o")
    assert isinstance(by_id["b"], Box2DAnnotation)
    assert (by_id["b"].sensor_id, by_id["b"].path.values.tolist()) == ("front", [[1, 2, 3, 4.5]])
    shapes = {name: by_id[name] for name in "ptl"}
    assert [shape.type.value for shape in shapes.values()] == ["polygon_2d", "polygon_topdown", "polyline"]
    assert shapes["p"].path.vertices[0].tolist() == [[1, 2], [3, 4], [5, 6]]
    for name in "tl":
        assert shapes[name].path.timestamps_ns.tolist() == [1_000_000, 1_009_000]
        assert [v.tolist() for v in shapes[name].path.vertices] == [[[1, 2, 3], [4, 5, 6]], [[1.5, 2.5, 3.5]]]
    assert (shapes["l"].is_closed, shapes["l"].label) == (True, "lane")
    event = by_id["e"]
    assert (event.start_ns, event.duration_ns, event.sensor_id) == (1_005_000, 3_000, 7)
    assert (event.label, event.parent_id) == ("cut-in", "o")
    labelled = by_id["s"]
    assert (labelled.type, labelled.label, labelled.is_instance) == ("point_segmentation", "road", True)
    assert [(p.sensor_id, p.sensor_frame, p.point_ids.tolist()) for p in labelled.labeled_points] == [
        ("top", 2, [1, 3]),
        ("map", None, [0]),
    ]
    assert by_id["a"].poses.positions.tolist() == [[1, 2, 3], [2, 3, 4]]
    assert by_id["a"].poses.quaternions_xyzw.tolist() == [[0, 0, 0.6, 0.8], [0, 0, 0, 1]]
    assert (by_id["a"].parent_id, by_id["o"].label) == ("o", "thing")
    assert scene.warnings == () or {n.code for n in scene.warnings} <= {"euler-unit", "euler-order"}


def test_a_file_of_scales_library_that_goes_through_here_is_the_same_there(scale, tmp_path):
    theirs, ours = tmp_path / "theirs.sfs", tmp_path / "ours.sfs"
    scale(WRITE, theirs)
    assert len(write_scene(FORMAT.open(theirs), ours, profile="scale")) == 0
    assert scale(READ, ours) == scale(READ, theirs)


def at(*milliseconds):
    return np.array([START + k * MS for k in milliseconds], np.int64)


def every_annotation():
    """One of each type, and what Scale's library refuses about some of them."""
    attributes = (
        AttributePath("state", ("parked", 3, ("a", "b")), at(0, 5, 9), sensor_id="top"),
        AttributePath("speed", (1.5,), at(0), static=False),
    )
    stated = {"label": "car", "stationary": True, "parent_id": "o", "attributes": attributes}
    row = np.array([ROW, ROW])
    flat, solid = np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    boxes = np.array([[1.0, 2.0, 3.0, 4.5], [np.nan] * 4])
    poses = Poses(at(0, 10), np.array([[1.0, 2, 3], [4, 5, 6]]), np.array([[0.0, 0, 0.6, 0.8], [0, 0, 0, 1]]))
    shapes = [
        ShapeAnnotation(
            kind.value,
            kind,
            VertexPath(at(0, 9), (flat, flat[:1]) if kind.value.endswith("_2d") else (solid, solid[:1])),
            "front",
            is_closed=True if kind is ShapeType.POLYLINE else None,
            **stated,
        )
        for kind in ShapeType
    ]
    parts = (LabeledPoints("top", np.array([1, 3], np.uint32), 2), LabeledPoints("map", np.array([0], np.uint32)))
    camera_model = Camera("fisheye", 8, 6, 10.0, 11.0, 3.0, 2.0, (0.1, 0.2, 0.3, 0.4))
    return (
        CuboidAnnotation(
            "cuboid",
            CuboidPath(at(0, 10), row),
            activations=(Activation("top", at(0, 5), durations_ns=(10_000, 2_500), cuboids=row),),
            projections=(Projection("front", at(0, 5), boxes=boxes, confirmed=(True, False), cuboids=row),),
            **stated,
        ),
        Box2DAnnotation("box_2d", "front", BoxPath(at(0), boxes[:1]), **stated),
        *shapes,
        PointsAnnotation("points", (PointPath(at(0), solid[:1]),)),
        EventAnnotation("event", START + 5 * MS, 3 * MS, "cut-in", "top", "o", attributes),
        LabeledPointsAnnotation("labeled_points", parts, "road", is_instance=True, parent_id="o"),
        LabeledPointsAnnotation("point_segmentation", parts, "road", type="point_segmentation"),
        LabeledPointsAnnotation("unlabelled", parts),
        LocalizationAdjustment("localization_adjustment", poses, "o"),
        CameraCalibration("camera_calibration", "front", poses=poses, intrinsics=camera_model),
        ObjectAnnotation("o", "thing", attributes=attributes),
        ObjectAnnotation("attributes", parent_id="o", attributes=attributes, type="attributes"),
        LinkAnnotation("link", "cuboid", "o", "is", is_bidirectional=False),
        GroupAnnotation("group", "all"),
    )


LOADABLE = {
    "cuboid": "CuboidAnnotation",
    "box_2d": "Box2DAnnotation",
    "polygon_2d": "Polygon2DAnnotation",
    "polygon_topdown": "TopdownPolygonAnnotation",
    "polyline": "PolylineAnnotation",
    "event": "EventAnnotation",
    "labeled_points": "LabeledPointsAnnotation",
    "point_segmentation": "LabeledPointsAnnotation",
    "localization_adjustment": "LocalizationAdjustmentAnnotation",
    "o": "ObjectAnnotation",
    "attributes": "AttributesAnnotation",
}


def test_every_annotation_that_scales_library_loads_has_its_values_there(scale, tmp_path):
    path = tmp_path / "drive.sfs"
    annotations = every_annotation()
    write_scene(Scene((), annotations, attributes=annotations[0].attributes), path, profile="scale")
    there = scale(READ, path)
    assert there["valid"]
    found = there["annotations"]
    assert {identifier: item["class"] for identifier, item in found.items()} == LOADABLE

    def timestamps(*milliseconds):
        return [START // 1000 - there["offset"] + 1000 * k for k in milliseconds]

    attributes = [
        {
            "name": "state",
            "timestamps": timestamps(0, 5, 9),
            "values": ["parked", 3, ["a", "b"]],
            "sensor_id": "top",
            "static": False,
        },
        {"name": "speed", "timestamps": timestamps(0), "values": [1500], "sensor_id": None, "static": False},
    ]
    assert there["attributes"] == attributes
    for identifier in ("cuboid", "box_2d", "polygon_2d", "polygon_topdown", "polyline", "event", "o"):
        assert found[identifier]["attributes"] == attributes, identifier
    for identifier in ("cuboid", "box_2d", "polygon_2d", "polygon_topdown", "polyline"):
        item = found[identifier]
        assert (item["label"], item["stationary"], item["parent_id"]) == ("car", True, "o")
    cuboid = found["cuboid"]
    assert cuboid["path"] == {"timestamps": timestamps(0, 10), "values": [ROW, ROW]}
    assert cuboid["activations"] == [
        {"sensor_id": "top", "timestamps": timestamps(0, 5), "durations": [10, 2.5], "cuboids": [ROW, ROW]}
    ]
    assert cuboid["projections"] == [
        {"sensor_id": "front", "timestamps": timestamps(0, 5), "boxes": [[1, 2, 3, 4.5], None], "cuboids": [ROW, ROW]}
    ]
    assert found["box_2d"]["path"] == {"timestamps": timestamps(0), "values": [[1, 2, 3, 4.5]]}
    assert found["polygon_2d"]["path"] == {"timestamps": timestamps(0, 9), "values": [[1, 2, 3, 4], [1, 2]]}
    for name in ("polygon_topdown", "polyline"):
        path_there = {"timestamps": timestamps(0, 9), "values": [[1, 2, 3, 4, 5, 6], [1, 2, 3]]}
        assert (found[name]["path"], found[name]["sensor_id"]) == (path_there, "front")
    assert found["polyline"]["is_closed"] is True
    event = found["event"]
    assert (event["start"], event["duration"], event["sensor_id"]) == (timestamps(5)[0], 3000, "top")
    parts = [
        {"sensor_id": "top", "point_ids": [1, 3], "sensor_frame": 2},
        {"sensor_id": "map", "point_ids": [0], "sensor_frame": None},
    ]
    assert found["labeled_points"]["labeled_points"] == found["point_segmentation"]["labeled_points"] == parts
    assert (found["labeled_points"]["label"], found["labeled_points"]["is_instance"]) == ("road", True)
    assert found["localization_adjustment"]["poses"] == {
        "timestamps": timestamps(0, 10),
        "values": [[1, 2, 3, 0, 0, 0.6, 0.8], [4, 5, 6, 0, 0, 0, 1]],
    }


def test_durations_and_nulls_that_scales_library_refuses_stand_aside(scale, tmp_path):
    path = tmp_path / "drive.sfs"
    timestamps, rows = np.array([START, START + MS]), np.array([ROW, ROW])
    seen = Projection("front", timestamps, np.ones((2, 4)), None, np.array([ROW, [np.nan] * 9]))
    annotations = (
        EventAnnotation("whole", START, 3 * MS),
        EventAnnotation("part", START, 3 * MS + 1),
        EventAnnotation("less", START, 0.5),
        EventAnnotation("static", START),
        CuboidAnnotation("null", CuboidPath(timestamps, rows), projections=(seen,)),
    )
    write_scene(Scene((), annotations), path, profile="scale")
    there = scale(READ, path)
    assert there["valid"]
    assert set(there["annotations"]) == {"whole", "static"}
    back = {annotation.id: annotation for annotation in FORMAT.open(path).annotations}
    assert [back[name].duration_ns for name in ("whole", "part", "less", "static")] == [3 * MS, 3 * MS + 1, 0.5, None]
    np.testing.assert_array_equal(back["null"].projections[0].cuboids, seen.cuboids)


def test_what_scales_library_refuses_stands_aside_and_comes_back(tmp_path):
    path = tmp_path / "drive.sfs"
    annotations = every_annotation()
    losses = write_scene(Scene((), annotations), path, profile="scale")
    aside = {
        "point_2d",
        "polyline_2d",
        "polygon",
        "point",
        "point_topdown",
        "points",
        "camera_calibration",
        "link",
        "group",
        "unlabelled",
    }
    assert aside | LOADABLE.keys() == {annotation.id for annotation in annotations}
    read = FORMAT.open(path).annotations
    assert [annotation.id for annotation in read[-len(aside) :]] == [
        annotation.id for annotation in annotations if annotation.id in aside
    ]
    reported = {loss.field for loss in losses if loss.kept == "metadata.sceneloom.annotations"}
    assert "annotations[labeled_points]" in reported
    assert {f"annotations[{name}]" for name in aside - {"unlabelled"}} <= reported
