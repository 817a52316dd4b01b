"""Our files against Scale's own library, in an interpreter of its own: written there and read here, and back."""

from fractions import Fraction

import numpy as np

import sceneloom
from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.colouring.cuboid_projection import (
    count_points,
    project_cuboids,
    with_activations,
    with_counts,
    with_labeled_points,
)
from sceneloom.formats.sfs.spec import FORMAT
from sceneloom.formats.sfs.writer import SceneWriter, write_scene
from sceneloom.simulate import CameraSpec, LidarSpec, TrafficSpec, simulate_street
from sceneloom.tracking.labels import label_tracks

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
poses = PosePath([[1, 2, 3, 0, 0, 0.6, 0.8], [2, 3, 4, 0, 0, 0, 1]], index=[0, 100])
xyz = np.arange(12, dtype=np.float32).reshape(4, 3)
lidar = LidarSensor(id="top", poses=poses, frames=[LidarSensorFrame(timestamp=10, points=LidarSensorPoints(
    positions=xyz, colors=xyz.astype(np.uint8), intensities=np.arange(4, dtype=np.uint8),
    timestamps=np.array([10, 11, 12, 13], np.uint32)))])
radar = RadarSensor(id=2, poses=poses, frames=[RadarSensorFrame(timestamp=10, points=RadarSensorPoints(
    positions=xyz, directions=xyz, timestamps=None))])
distortion = CameraDistortion.from_values("brown_conrady", [0.1, 0.01, 0.001, 0.002])
camera = CameraSensor(id="front", poses=poses, intrinsics=CameraIntrinsics(
    fx=10.0, fy=11.0, cx=3.0, cy=2.0, width=8, height=6, distortion=distortion),
    images=[CameraSensorImage(timestamp=5, content=np.frombuffer(b"\\xff\\xd8\\xff", np.uint8))])
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
scene = Scene(sensors=[lidar, radar, camera], annotations=[
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
], attributes=attributes, time_offset=1000, time_unit="microseconds", metadata={"town": "Ulm"})
write_file(sys.argv[1], to_scene_spec_sfs(scene))
"""

MS = 1_000_000
START = 1_700_000_000_000 * MS
ROW = [4.0, 2.0, 1.5, 1.0, 2.0, 3.0, 7.0, 5.0, 90.0]
TWO = np.array([[1, 2, 3], [4, 5, 6]], np.float32)


def assert_attributes(attributes):
    """Those that the program above writes."""
    state, tags = attributes
    assert (state.name, state.values, state.sensor_id, state.static) == ("state", ("parked", 3), "top", False)
    assert state.timestamps_ns.tolist() == [1_000_000, 1_050_000]
    assert (tags.name, tags.values, tags.static) == ("tags", (("a", "b"),), True)


def test_a_file_of_scales_library_is_read_with_all_values_and_the_same_there_when_it_is_written_again(
    scale, read_by_scale, tmp_path
):
    theirs, ours = tmp_path / "theirs.sfs", tmp_path / "ours.sfs"
    scale(WRITE, theirs)
    scene = FORMAT.open(theirs)
    assert len(write_scene(scene, ours, profile="scale")) == 0
    assert read_by_scale(ours) == read_by_scale(theirs)
    frame = scene.sensor("top").frames[0]
    np.testing.assert_array_equal(frame.points.positions, np.arange(12, dtype=np.float32).reshape(4, 3))
    assert frame.points.timestamps_ns.tolist() == [1_010_000, 1_011_000, 1_012_000, 1_013_000]
    assert frame.points.intensities.tolist() == [0, 1, 2, 3]
    path_of_lidar = scene.sensor("top").poses
    assert path_of_lidar.timestamps_ns.tolist() == [1_000_000, 1_100_000]
    assert path_of_lidar.quaternions_xyzw[0].tolist() == [0, 0, 0.6, 0.8]
    np.testing.assert_array_equal(scene.sensor(2).frames[0].points.directions, frame.points.positions)
    camera = scene.sensor("front").camera
    assert (camera.model, camera.coefficients[:4]) == ("brown_conrady", (0.1, 0.01, 0.001, 0.002))
    assert scene.metadata["town"] == "Ulm"
    by_id = {annotation.id: annotation for annotation in scene.annotations}
    assert_attributes(scene.attributes)
    for identifier in ("c", 1, "b", "p", "t", "l", "e", "o"):
        assert_attributes(by_id[identifier].attributes)
    for identifier in ("c", "b", "p", "t"):
        found = by_id[identifier]
        assert (found.label, found.stationary, found.parent_id) == ("car", True, "o")
    cuboid = by_id["c"]
    assert isinstance(cuboid, sc.CuboidAnnotation)
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
    assert isinstance(by_id[1], sc.ObjectAnnotation)
    assert (by_id[1].type, by_id[1].parent_id) == ("attributes", "o")
    assert isinstance(by_id["b"], sc.Box2DAnnotation)
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
    parts = [(p.sensor_id, p.sensor_frame, p.point_ids.tolist()) for p in labelled.labeled_points]
    assert parts == [("top", 2, [1, 3]), ("map", None, [0])]
    assert by_id["a"].poses.positions.tolist() == [[1, 2, 3], [2, 3, 4]]
    assert by_id["a"].poses.quaternions_xyzw.tolist() == [[0, 0, 0.6, 0.8], [0, 0, 0, 1]]
    assert (by_id["a"].parent_id, by_id["o"].label) == ("o", "thing")
    assert {n.code for n in scene.warnings if n.location.startswith("annotations")} <= {"euler-unit", "euler-order"}


def at(*milliseconds):
    return np.array([START + k * MS for k in milliseconds], np.int64)


def poses(*times_ns, seed=0):
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(len(times_ns), 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return sc.Poses(np.array(times_ns, np.int64), rng.normal(size=(len(times_ns), 3)), quaternions)


def every_annotation():
    """One of each type, and what Scale's library refuses about some of them."""
    attributes = (
        sc.AttributePath("state", ("parked", 3, ("a", "b")), at(0, 5, 9), sensor_id="top"),
        sc.AttributePath("speed", (1.5, -2.25), at(0, 5), static=False),
        sc.AttributePath("colour", ("red", "red"), at(0, 5), static=True),
    )
    stated = {"label": "car", "stationary": True, "parent_id": "o", "attributes": attributes}
    row = np.array([ROW, ROW])
    flat, solid = np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    boxes = np.array([[1.0, 2.0, 3.0, 4.5], [np.nan] * 4])
    adjusted = sc.Poses(at(0, 10), np.array([[1.0, 2, 3], [4, 5, 6]]), np.array([[0.0, 0, 0.6, 0.8], [0, 0, 0, 1]]))
    shapes = []
    for kind in sc.ShapeType:
        vertices = (flat, flat[:1]) if kind.value.endswith("_2d") else (solid, solid[:1])
        closed = True if kind is sc.ShapeType.POLYLINE else None
        path = sc.VertexPath(at(0, 9), vertices)
        shapes.append(sc.ShapeAnnotation(kind.value, kind, path, "front", is_closed=closed, **stated))
    parts = (sc.LabeledPoints("top", np.array([1, 3], np.uint32), 2), sc.LabeledPoints("map", np.array([0], np.uint32)))
    camera_model = Camera("fisheye", 8, 6, 10.0, 11.0, 3.0, 2.0, (0.1, 0.2, 0.3, 0.4))
    active = sc.Activation("top", at(0, 5), durations_ns=(10_000, 2_500), cuboids=row)
    seen = sc.Projection("front", at(0, 5), boxes=boxes, confirmed=(True, False), cuboids=row)
    return (
        sc.CuboidAnnotation(
            "cuboid", sc.CuboidPath(at(0, 10), row), activations=(active,), projections=(seen,), **stated
        ),
        sc.Box2DAnnotation("box_2d", "front", sc.BoxPath(at(0), boxes[:1]), **stated),
        *shapes,
        sc.PointsAnnotation("points", (sc.PointPath(at(0), solid[:1]),)),
        sc.EventAnnotation("event", START + 5 * MS, 3 * MS, "cut-in", "top", "o", attributes),
        sc.LabeledPointsAnnotation("labeled_points", parts, "road", is_instance=True, parent_id="o"),
        sc.LabeledPointsAnnotation("point_segmentation", parts, "road", type="point_segmentation"),
        sc.LabeledPointsAnnotation("unlabelled", parts),
        sc.LocalizationAdjustment("localization_adjustment", adjusted, "o"),
        sc.CameraCalibration("camera_calibration", "front", poses=adjusted, intrinsics=camera_model),
        sc.ObjectAnnotation("o", "thing", attributes=attributes),
        sc.ObjectAnnotation("attributes", parent_id="o", attributes=attributes, type="attributes"),
        sc.LinkAnnotation("link", "cuboid", "o", "is", is_bidirectional=False),
        sc.GroupAnnotation("group", "all"),
    )


def a_drive():
    """Every kind of sensor and annotation, with what Scale's library refuses among it."""
    rng = np.random.default_rng(5)
    times = [START + k * 100 * MS for k in range(3)]
    sweeps = []
    for t, count in zip(times, (50, 0, 30), strict=True):
        points = sc.LidarPoints(
            rng.normal(size=(count, 3)).astype(np.float32),
            rng.integers(0, 256, count).astype(np.uint8),
            rng.integers(0, 256, (count, 3)).astype(np.uint8),
            np.sort(rng.integers(t, t + 100 * MS, count)),
            rng.integers(0, 64, count).astype(np.uint16),
            rng.integers(0, 256, count).astype(np.uint8),
        )
        sweeps.append(sc.LidarFrame(t, points))
    cycle = sc.RadarFrame(times[0], sc.RadarPoints(TWO, TWO, np.array([1.5, 2], np.float32), np.array(times[:2])))
    camera_model = Camera("brown_conrady", 8, 6, 10.0, 11.0, 3.0, 2.0, (0.1, 0.01, 0.001, 0.002))
    wide = Camera("kannala-brandt18", 8, 6, 10.0, 11.0, 3.0, 2.0, (0.1,) * 18)
    images = [sc.CameraImage.of(t, camera_model, np.full((6, 8, 3), 90, np.uint8)) for t in times]
    lazy, one = sc.LazyFrames.of(images, times), np.ones(1)
    sensors = (
        sc.LidarSensor("top", sc.LazyFrames.of(sweeps, times), poses(*times), points_frame=sc.PointsFrame.WORLD),
        sc.LidarSensor("idle", sc.LazyFrames.of([], []), poses(*times), points_frame=sc.PointsFrame.WORLD),
        sc.RadarSensor("radar", sc.LazyFrames.of([cycle], times[:1]), poses(*times, seed=1)),
        sc.CameraSensor("front", camera_model, lazy, poses(*times, seed=2)),
        sc.CameraSensor("wide", wide, lazy, sc.Poses.identity()),
        sc.OdometrySensor("ego", poses(*times, seed=3)),
        sc.PointsSensor("map", TWO),
        sc.GnssSensor("gnss", np.array(times[:1]), np.ones((1, 3)), one, one),
        sc.PlainSensor("sonar", "sonar", {"depth": 3}),
    )
    annotations = every_annotation()
    fog = sc.AttributePath("fog", (0.5,), at(0))
    attributes = (*annotations[0].attributes, fog)
    return sc.Scene(sensors, annotations, attributes=attributes, metadata={"town": "Ulm"})


def timestamps(times_ns, offset_us):
    """Microseconds since the offset, halves to even, by exact fractions."""
    return [round(Fraction(int(t), 1000) - offset_us) for t in times_ns]


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


def test_the_profile_of_scale_loads_and_validates_with_equal_values_and_keeps_the_rest_aside(read_by_scale, tmp_path):
    path, drive = tmp_path / "drive.sfs", a_drive()
    losses = write_scene(drive, path, profile="scale")
    read = read_by_scale(path)
    assert read["faults"] == []
    offset = read["offset"]
    assert 0 <= START // 1000 - offset < 100_000_000
    sensors = {sensor["id"]: sensor for sensor in read["sensors"]}
    assert sorted(sensors) == ["front", "radar", "top", "wide"]
    for name in ("top", "front", "radar"):
        original = drive.sensor(name).poses
        assert sensors[name]["times"] == timestamps(original.timestamps_ns, offset)
        rows = np.hstack([original.positions, original.quaternions_xyzw])
        np.testing.assert_array_equal(sensors[name]["poses"], rows)
    for frame, original in zip(sensors["top"]["frames"], drive.sensor("top").frames, strict=True):
        points = original.points
        assert len(frame["positions"]) == len(points)
        np.testing.assert_array_equal(np.array(frame["positions"], np.float32).reshape(-1, 3), points.positions)
        if len(points):
            assert frame["timestamps"] == timestamps(points.timestamps_ns, offset)
            assert frame["timestamp"] == int(points.timestamps_ns.min()) // 1000 - offset
            assert frame["intensities"] == points.intensities.tolist()
            assert frame["colors"] == points.colors.tolist()
    assert sensors["front"]["camera_model"] == [10.0, 11.0, 3.0, 2.0, 8, 6]
    assert (sensors["front"]["distortion"], sensors["wide"]["distortion"]) == ("brown_conrady", None)
    expected = timestamps(drive.sensor("top").frames.timestamps_ns, offset)
    assert [image[0] for image in sensors["front"]["images"]] == expected
    found = read["annotations"]
    assert {identifier: item["class"] for identifier, item in found.items()} == LOADABLE

    def times(*milliseconds):
        return timestamps(at(*milliseconds), read["offset"])

    state = {"name": "state", "timestamps": times(0, 5, 9), "values": ["parked", 3, ["a", "b"]], "sensor_id": "top"}
    speed = {"name": "speed", "timestamps": times(0, 5), "values": [1500, -2250], "sensor_id": None}
    colour = {"name": "colour", "timestamps": times(0), "values": ["red"], "sensor_id": None}
    attributes = [{**state, "static": False}, {**speed, "static": False}, {**colour, "static": True}]
    assert read["attributes"][:3] == attributes
    for identifier in ("cuboid", "box_2d", "polygon_2d", "polygon_topdown", "polyline", "event", "o"):
        item = found[identifier]
        assert item["attributes"] == attributes, identifier
        if identifier not in ("event", "o"):
            assert (item["label"], item["stationary"], item["parent_id"]) == ("car", True, "o")
    cuboid, span = found["cuboid"], {"timestamps": times(0, 5), "cuboids": [ROW, ROW]}
    assert cuboid["path"] == {"timestamps": times(0, 10), "values": [ROW, ROW]}
    assert cuboid["activations"] == [{"sensor_id": "top", "durations": [10, 2.5], **span}]
    assert cuboid["projections"] == [{"sensor_id": "front", "boxes": [[1, 2, 3, 4.5], None], **span}]
    assert found["box_2d"]["path"] == {"timestamps": times(0), "values": [[1, 2, 3, 4.5]]}
    assert found["polygon_2d"]["path"] == {"timestamps": times(0, 9), "values": [[1, 2, 3, 4], [1, 2]]}
    for name in ("polygon_topdown", "polyline"):
        path_there = {"timestamps": times(0, 9), "values": [[1, 2, 3, 4, 5, 6], [1, 2, 3]]}
        assert (found[name]["path"], found[name]["sensor_id"]) == (path_there, "front")
    assert found["polyline"]["is_closed"] is True
    event = found["event"]
    assert (event["start"], event["duration"], event["sensor_id"]) == (times(5)[0], 3000, "top")
    parts = [
        {"sensor_id": "top", "point_ids": [1, 3], "sensor_frame": 2},
        {"sensor_id": "map", "point_ids": [0], "sensor_frame": None},
    ]
    assert found["labeled_points"]["labeled_points"] == found["point_segmentation"]["labeled_points"] == parts
    assert (found["labeled_points"]["label"], found["labeled_points"]["is_instance"]) == ("road", True)
    rows = [[1, 2, 3, 0, 0, 0.6, 0.8], [4, 5, 6, 0, 0, 0, 1]]
    assert found["localization_adjustment"]["poses"] == {"timestamps": times(0, 10), "values": rows}
    # what the library refuses stands aside and comes back
    names = "point_2d polyline_2d polygon point point_topdown points camera_calibration link group unlabelled"
    aside, ids = set(names.split()), [annotation.id for annotation in drive.annotations]
    assert aside | LOADABLE.keys() == {*ids}
    back = [annotation.id for annotation in FORMAT.open(path).annotations]
    assert back[-len(aside) :] == [identifier for identifier in ids if identifier in aside]
    reported = {loss.field for loss in losses if loss.kept == "metadata.sceneloom.annotations"}
    assert {f"annotations[{name}]" for name in (aside - {"unlabelled"}) | {"labeled_points"}} <= reported


def test_durations_and_nulls_that_scales_library_refuses_stand_aside(read_by_scale, tmp_path):
    path = tmp_path / "drive.sfs"
    timestamps, rows = np.array([START, START + MS]), np.array([ROW, ROW])
    seen = sc.Projection("front", timestamps, np.ones((2, 4)), None, np.array([ROW, [np.nan] * 9]))
    annotations = (
        sc.EventAnnotation("whole", START, 3 * MS),
        sc.EventAnnotation("part", START, 3 * MS + 1),
        sc.EventAnnotation("less", START, 0.5),
        sc.EventAnnotation("static", START),
        sc.CuboidAnnotation("null", sc.CuboidPath(timestamps, rows), projections=(seen,)),
    )
    write_scene(sc.Scene((), annotations), path, profile="scale")
    there = read_by_scale(path)
    assert there["faults"] == []
    assert set(there["annotations"]) == {"whole", "static"}
    back = {annotation.id: annotation for annotation in FORMAT.open(path).annotations}
    assert [back[name].duration_ns for name in ("whole", "part", "less", "static")] == [3 * MS, 3 * MS + 1, 0.5, None]
    np.testing.assert_array_equal(back["null"].projections[0].cuboids, seen.cuboids)


def test_the_profile_of_the_text_loads_in_scales_library(read_by_scale, tmp_path):
    """Its loader takes more than its validator; annotations that it has no converter for are left out here."""
    path, drive = tmp_path / "drive.sfs", a_drive()
    with SceneWriter(path) as writer:
        for name in ("top", "front", "ego", "map"):
            writer.add_sensor(drive.sensor(name))
        writer.add_annotation(sc.EventAnnotation("e", START))
    read = read_by_scale(path)
    assert [len(frame["positions"]) for frame in read["sensors"][0]["frames"]] == [50, 0, 30]
    refused = sorted(where[:2] for where, _ in read["faults"])
    assert refused == [["sensors", "2"], ["sensors", "3"]]


def a_rotating_car(times_ns):
    count = len(times_ns)
    yaws = np.linspace(2.5, 3.9, count)
    return sc.Track(
        3,
        "car",
        times_ns,
        np.column_stack([np.linspace(8.0, 14.0, count), np.full(count, 2.0), np.full(count, 0.8)]),
        np.tile([4.2, 1.8, 1.6], (count, 1)),
        (yaws + np.pi) % (2.0 * np.pi) - np.pi,
        np.tile([10.0, 0.0, 0.0], (count, 1)),
        np.zeros(count),
        np.tile(0.01 * np.eye(10), (count, 1, 1)),
        np.full(count, 0.87),
        np.full(count, sc.Support.BOTH, np.uint8),
        {"camera0": np.tile([100.0, 80.0, 160.5, 120.0], (count, 1))},
    )


def test_labels_load_and_validate_there(read_by_scale, tmp_path):
    camera = CameraSpec(Camera("pinhole", 320, 200, 180.0, 180.0, 159.5, 99.5))
    drive = simulate_street(2, frames=4, lidar=LidarSpec(beams=16, steps=360), cameras=(camera,))
    track = a_rotating_car(drive.truth.lidar.timestamps_ns + 50_000_000)
    bare = sc.Scene(drive.scene.sensors, trajectories=drive.scene.trajectories)
    labelled = label_tracks(bare, sc.Tracks((track,)))
    sceneloom.write(labelled.scene, tmp_path / "labels.sfs", profile="scale")
    found = read_by_scale(tmp_path / "labels.sfs")
    assert found["faults"] == []
    assert found["types"] == sorted(annotation.type for annotation in labelled.scene.annotations)
    (cuboid,) = found["cuboids"].values()
    # its rows are x y z yaw pitch roll dx dy dz; a car that rotations evenly needs its first state and its last
    rows = np.array(cuboid["rows"])
    assert len(rows) == 2
    assert np.diff(rows[:, 3])[0] == np.float64(rows[1, 3] - rows[0, 3])
    np.testing.assert_allclose(rows[:, :3], track.centers[[0, -1]], atol=1e-9)
    np.testing.assert_allclose(rows[:, 3], np.degrees([2.5, 3.9]), atol=1e-9)
    np.testing.assert_allclose(rows[:, 6:], track.sizes_lwh[[0, -1]], atol=1e-9)


def test_what_was_projected_and_counted_loads_and_validates_there(read_by_scale, tmp_path):
    camera = CameraSpec(Camera("pinhole", 320, 200, 180.0, 180.0, 159.5, 99.5))
    lidar = LidarSpec(beams=16, steps=360)
    drive = simulate_street(2, frames=3, lidar=lidar, cameras=(camera,), traffic=TrafficSpec()).scene
    counts = count_points(drive, moment="points", listed=True)
    scene = with_labeled_points(with_activations(with_counts(drive, counts), counts), counts)
    scene = project_cuboids(scene, lidar="lidar", activations=True)
    sceneloom.write(scene, tmp_path / "seen.sfs", profile="scale")
    found = read_by_scale(tmp_path / "seen.sfs")
    assert found["faults"] == []
    assert len(found["annotations"]) == len(scene.annotations)
    seen = [a for a in scene.annotations if isinstance(a, sc.CuboidAnnotation) and a.projections]
    assert len(seen) > 3
    for annotation in seen:
        (theirs,) = found["cuboids"][annotation.id]["boxes"]
        for box, ours in zip(theirs, annotation.projections[0].boxes, strict=True):
            assert (box is None) == bool(np.isnan(ours).any())
            assert box is None or box == ours.tolist()
