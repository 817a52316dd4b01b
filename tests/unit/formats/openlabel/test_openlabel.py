"""OpenLABEL files read and written: what comes back, what is reported, and what is refused."""

import json
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError, OutputError, UnknownOptionError
from sceneloom.formats.base.losses import Support
from sceneloom.formats.base.registry import find_format, open_scene, write_scene
from sceneloom.formats.openlabel.spec import FORMAT
from sceneloom.geometry.rigid import RigidTransform

T0 = 1_700_000_000_000_000_001
TIMES = np.array([T0, T0 + 100_000_000, T0 + 200_000_000])
QUARTER = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]
MOUNT = RigidTransform.from_quaternion(np.array([1.5, 0.1, 1.2]), np.array([-0.5, 0.5, -0.5, 0.5]))


def scene(*annotations, **fields):
    frames = [sc.LidarFrame(int(t), sc.LidarPoints(np.ones((2, 3), np.float32))) for t in TIMES]
    camera = Camera("brown_conrady", 640, 480, 500.0, 510.0, 320.0, 240.0, (-0.1, 0.02, 0.001, -0.002, 0.003))
    empty = sc.LazyFrames.of([], [])
    sensors = (
        sc.LidarSensor("top", sc.LazyFrames.of(frames, TIMES), mount=RigidTransform.identity()),
        sc.CameraSensor("front", camera, empty, mount=MOUNT),
        sc.CameraSensor(7, Camera("fisheye", 64, 48, 30.0, 30.0, 32.0, 24.0, (0.1, 0.0, 0.0, 0.0)), empty),
        sc.ImuSensor("imu", {}),
        sc.GnssSensor("gps", np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0), np.zeros(0), mount=MOUNT),
    )
    rotations = np.array([[0.0, 0, 0, 1], QUARTER, [0, 0, 0, 1]])
    trajectory = sc.Trajectory("vio", TIMES, np.array([[0.0, 0, 0], [1, 0, 0], [2, 1, 0]]), rotations)
    return sc.Scene(sensors, annotations=annotations, trajectories={"vio": trajectory}, **fields)


def there_and_back(tmp_path, one):
    losses = write_scene(one, tmp_path / "a.json", overwrite=True)
    return open_scene(tmp_path / "a.json"), losses


ENDS = TIMES[[0, 2]]
ROWS = np.array([[4.0, 2, 1.5, 10, 20, 1, 0, 0, 0], [4, 2, 1.5, 12, 24, 1, 0, 0, 90]])
BOXES = np.array([[1.5, 2, 30, 40], [2, 2, 30, 40], [3, 2, 31, 40.0]])


def annotations_of_odd_kinds():
    """What tests/properties/test_conversion_loss.py writes none of."""
    square, ring = np.array([[0.0, 0.0], [10.0, 0.0]]), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    attributes = (
        sc.AttributePath("colour", ("red",), static=True),
        sc.AttributePath("lights", (("left", "brake"), ()), TIMES[:2], sensor_id="front"),
        sc.AttributePath("odd", (1, "x", None), TIMES),
    )
    yield sc.CuboidAnnotation("a", sc.CuboidPath(TIMES[1:2], ROWS[:1]), "Car", stationary=True, attributes=attributes)
    yield sc.Box2DAnnotation(3, "front", sc.BoxPath(TIMES, BOXES), "Car")
    yield sc.ShapeAnnotation("3", sc.ShapeType.POLYGON_TOPDOWN, sc.VertexPath(TIMES[:1], (ring,)), stationary=True)
    yield sc.ShapeAnnotation("dot", sc.ShapeType.POINT_2D, sc.VertexPath(TIMES[1:2], (square[:1],)), 7)
    yield sc.ShapeAnnotation("tip", sc.ShapeType.POINT, sc.VertexPath(TIMES[:1], (ring[1:2],)), parent_id="lane")
    yield sc.PointsAnnotation("joints", (sc.PointPath(TIMES[:1], ring[:1], "a"), sc.PointPath(TIMES[:2], ring[:2], 2)))
    yield sc.EventAnnotation("ends", T0, None)
    ids = np.array([0, 5, 4_000_000_000], np.uint32)
    labelled = sc.LabeledPoints("top", ids, 1), sc.LabeledPoints("top", ids[:1])
    yield sc.LabeledPointsAnnotation("road", labelled, "Road", is_instance=False)
    yield sc.ObjectAnnotation("thing", "Thing", parent_id="all", extras={"note": {"a": [1, None]}})
    yield sc.LinkAnnotation("tie", "ends", 3, "causes", is_bidirectional=False)


def test_odd_kinds_of_annotation_come_back_and_a_stationary_cuboid_is_in_every_frame(tmp_path, assert_same):
    poses = [[10.0, 20, 1, 5, -10, 30], [11, 20, 1, 0, 0, 95], [12, 21, 1, 0, 0, -120]]
    values = np.hstack([np.tile([4, 2, 1.5], (3, 1)), poses])
    car = sc.CuboidAnnotation("car 1", sc.CuboidPath(TIMES, values), "Car", stationary=False)
    expected = list(annotations_of_odd_kinds())
    found, losses = there_and_back(tmp_path, scene(car, *expected))
    assert not [loss for loss in losses if loss.field.startswith("annotations")]
    by_id = {(type(one.id), one.id): one for one in found.annotations}
    assert len(by_id) == len(expected) + 1
    for one in expected:
        assert_same(by_id[type(one.id), one.id], one)
    # through quaternions: a few units of the last digit of 120 degrees
    np.testing.assert_allclose(by_id[str, "car 1"].path.values, values, rtol=0, atol=1e-12)
    written = json.loads((tmp_path / "a.json").read_text())["openlabel"]
    (uid,) = (uid for uid, one in written["objects"].items() if one["name"] == "a")
    assert all(uid in frame["objects"] for frame in written["frames"].values())


def one_thing():
    """An object with all that can be reported it by annotations of its own, and its trailer."""
    state = sc.AttributePath("review_state", ("approved", "open"), ENDS)
    gone = np.array([[1.5, 2, 30, 40], [np.nan] * 4, [3, 2, 31, 40.0]])
    seen = (
        sc.Projection("front", TIMES, gone, (True, None, False), extras={"by": "x"}),
        sc.Projection(7, TIMES[:1], None, (False,), np.full((1, 9), np.nan)),
    )
    active = (sc.Activation("top", TIMES[:2], (5, 7), np.ones((2, 9)), {"z": 1}), sc.Activation(7, TIMES[:1]))
    joints = (sc.PointPath(TIMES[:1], np.ones((1, 3)), "a", {"n": 1}),)
    pixels = ((sc.PointProjection("front", TIMES[:2], np.ones((2, 2)), (None, True)),),)
    ring = (np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 5.0]]),)
    yield sc.ObjectAnnotation("thing", "Car", attributes=(sc.AttributePath("plate", ("HB",), static=True),))
    stated = {"parent_id": "thing", "attributes": (state,), "activations": active, "projections": seen}
    yield sc.CuboidAnnotation("cuboid", sc.CuboidPath(ENDS, ROWS, {"k": [1]}), "Car", stationary=False, **stated)
    yield sc.Box2DAnnotation(3, "front", sc.BoxPath(TIMES, BOXES), "Car", parent_id="thing", attributes=(state,))
    yield sc.Box2DAnnotation("box", 7, sc.BoxPath(TIMES[:1], BOXES[:1]), parent_id="cuboid", extras={"q": 1})
    mask = sc.VertexPath(TIMES[:1], ring)
    yield sc.ShapeAnnotation("mask", sc.ShapeType.POLYGON_2D, mask, "front", label="Car", parent_id="thing")
    yield sc.PointsAnnotation("joints", joints, ("head",), pixels, parent_id="cuboid")
    own = sc.LabeledPoints("top", np.array([3], np.uint32), 1, {"e": 1})
    yield sc.LabeledPointsAnnotation("own points", (own,), "Car", parent_id="thing")
    yield sc.CuboidAnnotation("trailer", sc.CuboidPath(ENDS, ROWS), "Trailer", parent_id="thing")
    yield sc.EventAnnotation("brakes", T0, 100_000_000, "Braking")
    yield sc.LinkAnnotation("tie", 3, "brakes", "shows")


ONE_THING = {str(one.id): one for one in one_thing()}


@pytest.fixture(scope="module")
def thing(tmp_path_factory):
    folder = tmp_path_factory.mktemp("thing")
    found, losses = there_and_back(folder, scene(*one_thing()))
    return found, losses, json.loads((folder / "a.json").read_text())["openlabel"]


def test_what_concerns_one_thing_is_one_object_with_data_of_several_types_and_comes_back(thing, assert_same):
    found, losses, written = thing
    assert [one["name"] for one in written["objects"].values()] == ["thing", "trailer"]
    uid = next(iter(written["objects"]))
    data = written["frames"]["0"]["objects"][uid]["object_data"]
    systems = {(kind, one["coordinate_system"]) for kind in ("cuboid", "bbox", "poly2d") for one in data[kind]}
    assert systems == {("cuboid", "world"), ("bbox", "front"), ("bbox", "7"), ("poly2d", "front")}
    names = [one["name"] for elements in data.values() for one in elements]
    assert len(set(names)) == len(names)
    assert set(names) <= set(written["objects"][uid]["object_data_pointers"])
    # a cuboid is in each frame between its key frames, and marked there
    rows = [written["frames"][str(k)]["objects"][uid]["object_data"]["cuboid"][0] for k in range(3)]
    half = np.deg2rad(45) / 2
    expected = [11, 22, 1, 0, 0, np.sin(half), np.cos(half), 4, 2, 1.5]
    np.testing.assert_allclose(rows[1]["val"], expected, rtol=0, atol=1e-12)
    flags = [row["attributes"]["boolean"] for row in rows]
    assert [one["val"] for (one,) in flags] == [False, True, False]
    assert not [loss for loss in losses if loss.field.startswith("annotations")]
    assert sorted(str(one.id) for one in found.annotations) == sorted(ONE_THING)
    for one in found.annotations:
        back = one
        if one.type == "cuboid":  # angles come through quaternions
            np.testing.assert_allclose(one.path.values, ROWS, rtol=0, atol=1e-12)
            back = replace(one, path=replace(one.path, values=ROWS))
        assert_same(back, ONE_THING[str(one.id)])


def test_what_others_change_of_a_thing_is_read_and_what_is_wrong_of_ours_refused_with_its_location(thing, tmp_path):
    written = deepcopy(thing[2])
    uid = next(iter(written["objects"]))
    data = [written["frames"][str(k)]["objects"][uid]["object_data"] for k in range(3)]
    data[1]["cuboid"][0]["val"][0] = 100
    data[1]["cuboid"][0]["attributes"]["boolean"][0]["val"] = False  # a key frame now
    projection = next(one for one in data[2]["bbox"] if one["name"] == "projection:front")
    projection["attributes"]["boolean"][0]["val"] = True
    del data[0]["poly2d"]
    data[0]["cuboid"].append({**data[0]["cuboid"][0], "name": "theirs"})
    found = {one.id: one for one in read(tmp_path, {"openlabel": written}).annotations}
    np.testing.assert_allclose(found["cuboid"].path.values[:, 3], [10, 100, 12])
    assert found["cuboid"].projections[0].confirmed == (True, None, True)
    assert "mask" not in found
    (added,) = [one for one in found.values() if one.id not in ONE_THING and one.id != 3]
    assert (added.type, added.parent_id) == ("cuboid", "thing")
    for name, value in (("data", 5), ("own", [[1]]), ("projections", [{}]), ("activations", [{"sensor_id": 1}])):
        written = deepcopy(thing[2])
        fields = next(iter(written["metadata"]["sceneloom"]["object"].values()))
        fields["parts"][0][name] = value
        with pytest.raises(DataError) as caught:
            read(tmp_path, {"openlabel": written})
        assert "metadata.sceneloom.object" in caught.value.location


def test_sensors_come_back_without_frames_the_ego_trajectory_with_all_digits_and_metadata(tmp_path):
    one = scene(metadata={"city": "Bremen", "n": [1, {"a": None}]})
    found, losses = there_and_back(tmp_path, one)
    assert [(type(s), s.id) for s in found.sensors] == [(type(s), s.id) for s in one.sensors]
    assert found.sensor("front").camera == one.sensor("front").camera
    assert found.sensor(7).camera == one.sensor(7).camera
    for name in ("front", "gps"):
        np.testing.assert_allclose(found.sensor(name).mount.matrix, MOUNT.matrix, rtol=0, atol=1e-15)
    trajectory, expected = found.trajectories["vio"], one.trajectories["vio"]
    np.testing.assert_array_equal(trajectory.timestamps_ns, TIMES)
    np.testing.assert_array_equal(trajectory.positions, expected.positions)
    np.testing.assert_allclose(trajectory.quaternions_xyzw, expected.quaternions_xyzw, rtol=0, atol=1e-15)
    assert {name: found.metadata[name] for name in ("city", "n")} == {"city": "Bremen", "n": [1, {"a": None}]}
    reported = {loss.field: loss.support for loss in losses}
    assert reported["sensors[top].frames"] is Support.DROPPED
    assert "frames-elsewhere" in {warning.code for warning in found.warnings}
    with pytest.raises(IndexError):
        found.sensor("top").frames[0]


def test_what_has_no_location_is_reported(tmp_path):
    seen = sc.Activation("top", TIMES[:1], (5,), extras={"y": np.ones(2)})
    path = sc.CuboidPath(TIMES[:1], np.ones((1, 9)), extras={"x": np.ones(2)})
    box = sc.CuboidAnnotation("a", path, activations=(seen,))
    repair = sc.LocalizationAdjustment("repair", sc.Poses.identity())
    plain = sc.PlainAnnotation("odd", "odd", {"v": 1})
    second = sc.Trajectory("other", TIMES, np.zeros((3, 3)))
    one = scene(box, repair, plain, metadata={"city": "x", "bytes": np.ones(3)})
    one = replace(one, trajectories={**one.trajectories, "other": second})
    # written as it is: `write_scene` would apply the adjustment, which is then no loss
    losses = FORMAT.write(one, tmp_path / "a.json")
    reported = {loss.field for loss in losses if loss.support is Support.DROPPED}
    lost = {"annotations.localization_adjustment", "annotations.plain", "metadata.bytes", "trajectories[other]"}
    assert lost | {"annotations[a].extras", "annotations[a].path.extras"} <= reported


# what other programs write


def document(**members):
    return {"openlabel": {"metadata": {"schema_version": "1.0.0"}, **members}}


def read(tmp_path, content, **options):
    path = tmp_path / "b.json"
    path.write_text(json.dumps(content) if isinstance(content, dict) else content, "utf-8")
    assert find_format(path) is FORMAT
    return open_scene(path, **options)


def written_anew(scene, tmp_path):
    """What we write of a scene without the document that it was read from."""
    kept = {name: value for name, value in scene.metadata["openlabel"].items() if name != "document"}
    write_scene(replace(scene, metadata={**scene.metadata, "openlabel": kept}), tmp_path / "again.json")
    return json.loads((tmp_path / "again.json").read_text())["openlabel"]


def frame(timestamp, data, **properties):
    properties = {**({} if timestamp is None else {"timestamp": timestamp}), **properties}
    return {"frame_properties": properties, "objects": {"1": {"object_data": data}}}


OBJECT = {"1": {"name": "one", "type": "Car"}}


def cuboid(*values, **further):
    return {"cuboid": [{"name": "c", "val": list(values), **further}]}


def test_boxes_in_a_sensor_are_brought_to_the_root_of_its_coordinate_systems(tmp_path):
    # the lidar looks to the left of a vehicle that stands at (100, 0, 0) in the map
    pose = {"quaternion": QUARTER, "translation": [1, 0, 2]}
    systems = {
        "map": {"type": "scene_cs", "parent": ""},
        "car": {"type": "local_cs", "parent": "map"},
        "lidar": {"type": "sensor_cs", "parent": "car", "pose_wrt_parent": pose},
    }
    matrix = [1, 0, 0, -100, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    forwards = {"euler_angles": [0] * 3, "translation": [100, 0, 0]}
    forwards = {"src": "car", "dst": "map", "transform_src_to_dst": forwards}
    backwards = {"src": "map", "dst": "car", "transform_src_to_dst": {"matrix4x4": matrix}}
    for step in (forwards, backwards):
        box = cuboid(5, 0, 0, 0, 0, 0, 1, 4, 2, 1, coordinate_system="lidar")
        frames = {"0": frame("10.5", box, transforms={"t": step})}
        path = read(tmp_path, document(coordinate_systems=systems, objects=OBJECT, frames=frames)).annotations[0].path
        np.testing.assert_allclose(path.values, [[4, 2, 1, 101, 5, 2, 0, 0, 90]], rtol=0, atol=1e-12)
        assert path.timestamps_ns.tolist() == [10_500_000_000]


@pytest.mark.parametrize(
    ("timestamp", "time_ns"),
    [
        ("1700000000.000000001", 1_700_000_000_000_000_001),
        ("2023-11-14T22:13:20.5Z", 1_700_000_000_500_000_000),
        (1_700_000_000_000_000_001, 1_700_000_000_000_000_001),
        (1_700_000_000_000_001, 1_700_000_000_000_001_000),
        ("1700000000000", 1_700_000_000_000_000_000),
        (0.25, 250_000_000),
        (None, 300_000_000),
    ],
)
def test_times_are_read_in_the_unit_that_makes_them_times(tmp_path, timestamp, time_ns):
    found = read(tmp_path, document(objects=OBJECT, frames={"3": frame(timestamp, cuboid(0, 0, 0, *QUARTER, 1, 1, 1))}))
    assert found.annotations[0].path.timestamps_ns.tolist() == [time_ns]
    assert ("frame-times-assumed" in {warning.code for warning in found.warnings}) is (timestamp is None)


def test_rotated_boxes_matrices_and_whole_objects_come_back_and_relative_polygons_are_summed_up(tmp_path):
    matrix = {"name": "m", "val": [1, 2], "width": 2, "height": 1, "channels": 1, "data_type": "float"}
    static = {"text": [{"name": "plate", "val": "HB"}], "mat": [matrix], **cuboid(1, 2, 3, 0, 0, 0, 1, 1, 1, 1)}
    relative = {"name": "p", "val": [5, 5, 1, 0, 0, 2], "mode": "MODE_POLY2D_RELATIVE", "closed": False}
    coded = {"name": "q", "val": ["0", "0", "1"], "mode": "MODE_POLY2D_F8DCC", "closed": True}
    turned = {"name": "r", "val": [100, 50, 40, 20, np.pi / 2]}
    objects = {name: {"name": name, "type": "Car"} for name in "123"} | {"4": {"name": "four", "type": "Car"}}
    objects["4"]["object_data"] = static
    frames = {"0": frame(1, {"rbbox": [turned]})}
    frames["0"]["objects"]["2"] = {"object_data": {"poly2d": [relative, coded]}}
    kept = {"ontologies": {"0": "https://example.org"}, "tags": {"0": {"type": "x", "ontology_uid": "0"}}}
    found = read(tmp_path, document(objects=objects, frames=frames, **kept))
    shapes = [one for one in found.annotations if isinstance(one, sc.ShapeAnnotation)]
    corners = shapes[0].path.vertices[0]
    # a quarter rotation exchanges width and height
    np.testing.assert_allclose([np.ptp(corners, axis=0), corners.mean(axis=0)], [[20, 40], [100, 50]])
    np.testing.assert_array_equal(shapes[1].path.vertices[0], [[5, 5], [6, 5], [6, 7]])
    assert shapes[1].type == "polyline_2d"
    assert "poly2d-mode" in {warning.code for warning in found.warnings}
    (box,) = (one for one in found.annotations if one.type == "cuboid")
    assert box.stationary
    assert {one.name: one.values[0] for one in box.attributes}["plate"] == "HB"
    again = written_anew(found, tmp_path)
    assert again["frames"]["0"]["objects"]["1"]["object_data"]["rbbox"][0]["val"] == turned["val"]
    assert (again["objects"]["4"]["object_data"]["mat"], again["objects"]["4"]["name"]) == ([matrix], "four")
    assert {name: again[name] for name in kept} == kept


UNIT = [1] * 16
NO_SUBJECT = {"name": "r", "type": "t", "rdf_subjects": [{"type": "object", "uid": "9"}], "rdf_objects": []}
VAL = "frames.0.objects.1.object_data.cuboid[0].val"
PLACED = {"a": {"parent": "b", "pose_wrt_parent": {"matrix4x4": UNIT}}}


@pytest.mark.parametrize(
    ("members", "location", "problem"),
    [
        ({"objects": OBJECT, "frames": {"0": frame(1, cuboid(1, 2))}}, VAL, "9 or 10"),
        ({"objects": OBJECT, "frames": {"0": frame(1, cuboid(0, 0, 0, 9, 0, 0, 0, 1, 1, 1))}}, "val", "length 1"),
        ({"objects": OBJECT, "frames": {"0": frame("soon", {})}}, "timestamp", "soon"),
        ({"objects": {}, "frames": {"0": frame(1, {})}}, "frames.0.objects.1", "entry"),
        ({"objects": {"1": {"name": "x"}}}, "objects.1.type", "missing"),
        ({"objects": OBJECT, "frames": {"x": {}}}, "frames.x", "whole number"),
        ({"objects": OBJECT, "frames": {"0": frame(1, {"sphere": []})}}, "sphere", "a type of data out of"),
        ({"streams": {"c": {"type": "eye"}}}, "streams.c.type", "camera"),
        ({"coordinate_systems": PLACED}, "matrix4x4", "last row"),
        ({"relations": {"0": NO_SUBJECT}}, "rdf_subjects[0]", "uid"),
    ],
)
def test_what_is_wrong_is_reported_with_its_location(tmp_path, members, location, problem):
    with pytest.raises(DataError) as caught:
        read(tmp_path, document(**members))
    assert location in caught.value.location
    assert problem in caught.value.problem


def test_a_lenient_reading_counts_what_is_wrong_and_torn_files_options_and_targets_are_refused(tmp_path):
    objects = {"1": {"name": "one", "type": "Car"}, "2": {"name": "two", "type": "Car"}}
    frames = {"0": frame(1, cuboid(1, 2))}
    frames["0"]["objects"]["2"] = {"object_data": cuboid(0, 0, 0, 0, 0, 0, 1, 1, 1, 1)}
    found = read(tmp_path, document(objects=objects, frames=frames), lenient=True)
    assert [one.id for one in found.annotations] == ["2"]
    assert [warning.count for warning in found.warnings if warning.code == "elements"] == [1]
    for content in ('{"openlabel": ', '{"openlabel": 3}', '{"openlabel": {"objects": []}}'):
        with pytest.raises(DataError):
            read(tmp_path, content)
    write_scene(scene(), tmp_path / "a.json")
    with pytest.raises(OutputError):
        write_scene(scene(), tmp_path / "a.json")
    with pytest.raises(UnknownOptionError):
        write_scene(scene(), tmp_path / "c.json", frame="world")
    with pytest.raises(OptionError):
        open_scene(tmp_path / "a.json", rate_hz=-1.0)
