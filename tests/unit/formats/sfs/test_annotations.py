"""Annotations of every type: what becomes of their fields, and where faults are stated to be."""

from itertools import product

import numpy as np
import pytest
from tests.unit.formats.sfs.conftest import make

from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.sfs.spec import FORMAT
from sceneloom.formats.sfs.writer import SceneWriter, write_scene

ROW = [4.0, 2.0, 1.5, 1.0, 2.0, 3.0, 0.0, 0.0, 270.0]
POSE = [1.0, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8]
CAMERA_MODEL = {"fx": 10.0, "fy": 11.0, "cx": 3.0, "cy": 2.0, "width": 8, "height": 6}
ATTRIBUTE = {"name": "speed", "timestamps": [1, 2], "values": [1.5, "fast"]}


@pytest.fixture
def read(open_header):
    """Read annotations whose file counts microseconds from 1 µs."""
    return lambda *annotations, **options: open_header(
        make.scene(annotations=list(annotations), time_offset=1), **options
    )


@pytest.fixture
def read_one(read):
    return lambda type_name, **fields: read({"id": "a", "type": type_name, **fields}).annotations[0]


def path_of(*values, **fields):
    return {"timestamps": list(range(1, len(values) + 1)), "values": list(values), **fields}


@pytest.mark.parametrize("kind", sc.ShapeType)
def test_shapes_have_pairs_in_images_and_triples_in_space_and_lines_may_be_closed(read_one, kind):
    width = 2 if kind.endswith("_2d") else 3
    shape = read_one(kind, sensor_id="front", path=path_of([1, 2, 3, 4, 5, 6], []), is_closed=True)
    assert isinstance(shape, sc.ShapeAnnotation)
    assert (shape.type, shape.sensor_id) == (kind, "front")
    rows = np.arange(1, 7).reshape(-1, width)
    assert [vertices.tolist() for vertices in shape.path.vertices] == [rows.tolist(), []]
    closed = kind is sc.ShapeType.POLYLINE
    assert (shape.is_closed, shape.extras) == ((True, {}) if closed else (None, {"is_closed": True}))


def test_keypoints_have_paths_labels_and_projections_each(read_one):
    paths = [{"id": "nose", **path_of([1, 2, 3], why="seen")}, path_of([4, 5, 6])]
    projection = {"sensor_id": "front", "timestamps": [1, 2], "points": [[1, 2], None], "score": 1}
    projection |= {"confirmed": [True, None], "positions": [None, [1, 2, 3]]}
    attributes = [{**ATTRIBUTE, "point_index": 1}]
    points = read_one("points", paths=paths, labels=["a", "b"], projections=[[projection], []], attributes=attributes)
    assert isinstance(points, sc.PointsAnnotation)
    found = [(path.id, path.extras, path.values.tolist()) for path in points.paths]
    assert found == [("nose", {"why": "seen"}, [[1, 2, 3]]), (None, {}, [[4, 5, 6]])]
    assert (points.labels, points.attributes[0].point_index) == (("a", "b"), 1)
    ((seen,), unseen) = points.projections
    assert unseen == ()
    np.testing.assert_array_equal(seen.points, [[1, 2], [np.nan, np.nan]])
    np.testing.assert_array_equal(seen.positions, [[np.nan] * 3, [1, 2, 3]])
    assert (seen.confirmed, seen.extras) == ((True, None), {"score": 1})


def test_pairs_in_space_lie_at_height_zero_with_a_warning_and_keypoints_may_stand_in_one_path(read):
    rows, mixed = [[1, 2, 3, 4]], [[1, 2, 3, 4, 5, 6], [1, 2]]
    scene = read(
        {"id": 1, "type": "polygon", "path": path_of(*rows)},
        {"id": 2, "type": "polygon", "path": path_of(*mixed)},
        {"id": 3, "type": "points", "paths": path_of([1, 2, 3, 4, 5, 6]), "labels": ["a", "b"]},
        {"id": 4, "type": "points", "paths": [path_of([1, 2], [3, 4])]},
    )
    first, second, together, keypoints = scene.annotations
    for polygon, wide in ((first, rows), (second, mixed)):
        flat = [[[x, y, 0] for x, y in zip(row[::2], row[1::2], strict=True)] for row in wide]
        assert [vertices.tolist() for vertices in polygon.path.vertices] == flat
    (path,) = together.paths
    assert (path.values.tolist(), together.labels) == ([[1, 2, 3, 4, 5, 6]], ("a", "b"))
    assert keypoints.paths[0].values.tolist() == [[1, 2, 0], [3, 4, 0]]
    locations = [f"annotations[{where}.values" for where in ("0].path", "1].path", "3].paths[0]")]
    assert [(n.code, n.location) for n in scene.warnings] == [("no-height", location) for location in locations]


def test_calibrations_keep_what_the_model_has_no_field_for(read_one):
    distortion = {"model": "fisheye", "params": [0.1, 0.2, 0.3, 0.4], "fit": 1}
    intrinsics = {**CAMERA_MODEL, "distortion": distortion, "skew": 0}
    poses = path_of(POSE, POSE, x=1)
    calibration = read_one("camera_calibration", sensor_id="c", poses=poses, intrinsics=intrinsics, time_offset=-4)
    assert isinstance(calibration, sc.CameraCalibration)
    assert calibration.intrinsics == Camera("fisheye", 8, 6, 10.0, 11.0, 3.0, 2.0, (0.1, 0.2, 0.3, 0.4))
    assert (calibration.time_offset_ns, calibration.poses.positions[0].tolist()) == (-4000, POSE[:3])
    assert calibration.extras == {"poses": {"x": 1}, "intrinsics": {"skew": 0, "distortion": {"fit": 1}}}
    bare = read_one("camera_calibration", sensor_id="front")
    assert (bare.poses, bare.intrinsics, bare.time_offset_ns) == (None, None, None)


def test_a_single_pose_of_a_correction_does_not_move_the_clock_and_camera_models_have_all_numbers_or_the_nearest(
    target,
):
    late = 1_700_000_000 * 10**9
    single = sc.LocalizationAdjustment("a", sc.Poses.identity())
    write_scene(sc.Scene((), (single, sc.EventAnnotation("e", late))), target)
    scene = FORMAT.open(target)
    assert (scene.time_offset_ns, scene.annotations[0].poses.static) == (late, True)
    camera_model = Camera("brown_conrady", 8, 6, 10.0, 11.0, 3.0, 2.0, (0.1, 0.2, 0.3, 0.4, 0.5))
    calibrations = (sc.CameraCalibration("c", "front", intrinsics=camera_model),)
    losses = write_scene(sc.Scene((), calibrations), target, overwrite=True)
    scene = FORMAT.open(target)
    assert scene.annotations[0].intrinsics.coefficients == (0.1, 0.2, 0.3, 0.4, 0.5, 0, 0, 0, 0, 0)
    assert (losses.losses, scene.warnings) == ((), ())
    prism = (0.01, 0.002, 0, 0, 0, 0, 0, 0, 0, 0, 0.001, 0, 0, 0)
    camera_model = Camera("brown_conrady", 640, 480, 400.0, 400.0, 319.5, 239.5, prism)
    calibration = sc.CameraCalibration("c", "front", intrinsics=camera_model)
    (loss,) = write_scene(sc.Scene((), (calibration,)), target, overwrite=True).losses
    assert loss.field == "annotations[c].intrinsics.distortion"
    assert "px" in loss.what
    nearest = FORMAT.open(target).annotations[0].intrinsics
    assert (nearest.width, nearest.height) == (640, 480)


def test_an_attribute_with_more_or_fewer_values_than_timestamps_is_kept_as_found(read, target):
    for values, unknown in product(([], [1.5], [1.5, "fast", "faster"]), ({}, {"unit": "m/s"})):
        scene = read({**CUBOID, "id": 1, "attributes": [{**ATTRIBUTE, **unknown, "values": values}]})
        write_scene(scene, target, overwrite=True)
        for (cuboid,) in (scene.annotations, FORMAT.open(target).annotations):
            (attribute,) = cuboid.attributes
            assert (attribute.timestamps_ns.tolist(), attribute.values) == ([2000, 3000], tuple(values))


USUAL = {"id": "c", "type": "cuboid", "path": path_of(ROW, ROW), "attributes": [ATTRIBUTE]}


@pytest.mark.parametrize(
    "unusual",
    [
        {"colour": "red"},
        {"path": path_of(ROW, ROW, smooth=1)},
        {"path": {"timestamps": [1.5, 2], "values": [ROW, ROW]}},
        {"path": {"timestamps": np.array([1, 2]), "values": np.array([ROW, ROW])}},
        {"attributes": [{**ATTRIBUTE, "by": "hand"}]},
        {"activations": []},
        {"stationary": None, "label": None},
        {},
    ],
)
def test_a_cuboid_is_the_same_whichever_trajectory_it_is_read(read, unusual):
    first, cuboid = read({**USUAL, "id": "first"}, {**USUAL, **unusual}).annotations
    timestamps = [2500, 3000] if unusual.get("path", {}).get("timestamps", [1])[0] == 1.5 else [2000, 3000]
    for found, expected in ((first, [2000, 3000]), (cuboid, timestamps)):
        assert isinstance(found, sc.CuboidAnnotation)
        assert found.path.timestamps_ns.tolist() == expected
        assert found.path.timestamps_ns.dtype == np.int64
        np.testing.assert_array_equal(found.path.values, [ROW, ROW])
        assert not found.path.values.flags.writeable
        assert found.attributes[0].values == (1.5, "fast")
        assert found.attributes[0].timestamps_ns.tolist() == [2000, 3000]
    assert cuboid.extras == ({"colour": "red"} if "colour" in unusual else {})


def test_cuboids_of_different_lengths_share_their_arrays_and_keep_their_own_rows(read):
    rows = [[float(k)] * 9 for k in range(6)]
    parts = (rows[:1], rows[1:3], rows[3:])
    scene = read(*({"id": k, "type": "cuboid", "path": path_of(*part)} for k, part in enumerate(parts)))
    found = [(c.path.values[:, 0].tolist(), c.path.timestamps_ns.tolist()) for c in scene.annotations]
    assert found == [([0], [2000]), ([1, 2], [2000, 3000]), ([3, 4, 5], [2000, 3000, 4000])]


CUBOID = {"type": "cuboid", "path": path_of(ROW)}
BOX = {"type": "box_2d", "sensor_id": "c", "path": path_of([1, 2, 3, 4])}
POINTS = {"type": "points", "paths": [path_of([1, 2, 3])]}
SEEN = {"sensor_id": "c", "timestamps": [1, 2]}


def cuboid(*rows, **fields):
    return {**CUBOID, **({"path": path_of(*rows)} if rows else {}), **fields}


def projected(**fields):
    return cuboid(projections=[{"sensor_id": "c", "timestamps": [1]}] * 2 + [{**SEEN, **fields}])


def shape(kind, *rows):
    return {**BOX, "type": kind, "path": path_of(*rows)}


def adjusted(*rows):
    return {"type": "localization_adjustment", "poses": path_of(*rows)}


LABELLED = {"type": "labeled_points", "labeled_points": [{"sensor_id": 1, "point_ids": [-1]}]}
CALIBRATION = {"type": "camera_calibration", "sensor_id": 1, "intrinsics": {**CAMERA_MODEL, "fx": -1}}


@pytest.mark.parametrize(
    ("annotation", "location", "problem"),
    [
        (cuboid(ROW, ROW[:8]), "path.values[1]", "8 numbers; expected 9 numbers"),
        (cuboid(ROW, None), "path.values[1]", "None; expected 9 numbers"),
        (cuboid([1.0, "x"]), "path.values[0]", "[1.0, 'x']; expected 9 numbers"),
        (cuboid(path={"timestamps": [1], "values": [ROW, ROW]}), "path", "1 timestamps and 2 values; expected as many"),
        (cuboid(path={"timestamps": [2**62], "values": [ROW]}), "path.timestamps", "64 bits"),
        (projected(boxes=[None, [1, 2, 3]]), "projections[2].boxes[1]", "3 numbers; expected 4 numbers"),
        (projected(boxes=[None]), "projections[2].boxes", "2 timestamps and 1 boxes"),
        (projected(confirmed=[True, 1]), "projections[2].confirmed[1]", "1; expected true, false or null"),
        (projected(cuboids=[None, ROW[:3]]), "projections[2].cuboids[1]", "3 numbers; expected 9"),
        (cuboid(activations=[{**SEEN, "durations": [1]}]), "activations[0].durations", "2 timestamps and 1 durations"),
        (cuboid(attributes=[{**ATTRIBUTE, "point_index": "1"}]), "attributes[0].point_index", "'1'; expected an int"),
        (shape("box_2d", [1, 2, 3]), "path.values[0]", "3 numbers; expected 4"),
        ({**BOX, "sensor_id": None}, "sensor_id", "missing; expected an id"),
        (shape("polygon_2d", [1, 2], [1, 2, 3]), "path.values[1]", "3 numbers; expected a multiple of 2"),
        (shape("polygon", [1, 2, 3], [1, 2, 3, 4, 5]), "path.values[1]", "5 numbers; expected a multiple of 3"),
        (shape("polyline", [1, "2", 3]), "path.values[0]", "expected a list of"),
        (shape("point", [[1, 2], [3]]), "path.values[0]", "expected a list of"),
        ({**POINTS, "labels": ["a", "b"]}, "labels", "2 labels for 1 points"),
        ({**POINTS, "labels": [None]}, "labels[0]", "None; expected text"),
        ({**POINTS, "paths": [path_of([1, 2, 3], [1, 2])]}, "paths[0].values[1]", "2 numbers; expected 3"),
        ({**POINTS, "paths": [path_of([1.0] * 5)]}, "paths[0].values", "rows of 5 numbers"),
        ({**POINTS, "projections": [[], [{**SEEN, "points": [None, [1]]}]]}, "projections[1][0].points[1]", "1 number"),
        (adjusted(), "poses", "empty; expected at least one"),
        (adjusted(POSE, [0.0] * 7), "poses.values[1]", "a quaternion of norm 0; expected 1"),
        (CALIBRATION, "intrinsics", "focal lengths -1.0"),
        (LABELLED, "labeled_points[0].point_ids", "numbers beyond uint32"),
    ],
)
def test_a_fault_is_named_with_its_location(read, annotation, location, problem):
    with pytest.raises(DataError) as caught:
        read({"id": "sound", "type": "object"}, {"id": "a", **annotation})
    assert caught.value.location == f"annotations[1].{location}"
    assert problem in caught.value.problem


def test_numbers_that_json_cannot_state_are_refused_with_their_location(target):
    t0, box, row = np.zeros(1, np.int64), np.array([[1, np.nan, 2, 3]]), np.full((1, 3), np.nan)
    seen, cuboid = (sc.Projection("c", t0, boxes=box),), sc.CuboidPath(t0, np.ones((1, 9)))
    for annotation, location in (
        (sc.Box2DAnnotation("a", "c", sc.BoxPath(t0, np.full((1, 4), np.inf))), "path.values[0]"),
        (sc.CuboidAnnotation("a", sc.CuboidPath(t0, np.full((1, 9), np.nan))), "path.values[0]"),
        (sc.ShapeAnnotation("a", sc.ShapeType.POINT, sc.VertexPath(t0, (row,))), "path.values[0], vertices[0]"),
        (sc.PointsAnnotation("a", (sc.PointPath(t0, row),)), "paths[0].values[0]"),
        (sc.CuboidAnnotation("a", cuboid, projections=seen), "projections[0].boxes[0]"),
    ):
        with pytest.raises(OptionError) as caught, SceneWriter(target) as writer:
            writer.add_annotation(annotation)
        assert f"annotations[a].{location}: " in str(caught.value)


def test_many_warnings_take_no_longer_each(read):
    """Each is compared with those before it by its hash: 3,000 in a list took seconds."""
    flat = [{"id": k, "type": "point", "path": path_of([1, 2])} for k in range(3000)]
    assert len(read(*flat).warnings) == 3000
