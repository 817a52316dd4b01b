"""Reading: from the words of a file to the model, and every fault with its location."""

from functools import partial

import numpy as np
import pytest
from simplejpeg import encode_jpeg

from sceneloom.cameras import project
from sceneloom.editing import convert_camera_models, undistort_scene
from sceneloom.errors import CalibrationError, DataError, OptionError
from sceneloom.formats.base.registry import write_scene as write_any
from sceneloom.formats.sfs.spec import FORMAT
from sceneloom.formats.sfs.writer import write_scene
from sceneloom.pipeline.alignment import align
from sceneloom.scene import (
    Coordinates,
    CuboidAnnotation,
    LidarSensor,
    OdometrySensor,
    PlainAnnotation,
    PlainSensor,
    PointsFrame,
    PointsSensor,
    RadarSensor,
)
from sceneloom.scene.scene import assumed_models, check_camera_models

TWO = np.array([[1, 2, 3], [4, 5, 6]], np.float32)
OFFSET = 1_700_000_000_000_001


def codes(scene):
    return [warning.code for warning in scene.warnings]


def refused(open_header, header, **options):
    with pytest.raises(DataError) as caught:
        open_header(header, **options)
    return caught.value


def swept(make, timestamp=0, root=None, **points):
    """The header of one sweep of two points with further arrays."""
    frames = [{"timestamp": timestamp, "points": {"positions": TWO, **points}, "weather": "rain"}]
    return make.scene(make.lidar(frames=frames), **(root or {}))


@pytest.mark.parametrize(
    ("times", "dtype", "root", "expected"),
    [
        (
            [10**6, 10**6 + 3],
            np.uint32,
            {"time_offset": OFFSET},
            [1000 * (OFFSET + 10**6), 1000 * (OFFSET + 10**6 + 3)],
        ),
        ([7, 1_999_999_999], np.uint64, {"time_unit": "nanoseconds", "time_offset": 5}, [12, 2_000_000_004]),
        ([7, 1_999_999_999], np.uint64, {"time_unit": "nanosecond", "time_offset": 5}, [12, 2_000_000_004]),
        ([3, 4], np.uint32, {}, [3000, 4000]),
        ([3, 4], np.uint64, {}, [3000, 4000]),
        ([3, 4], np.int32, {}, [3000, 4000]),
        ([3, 4], np.int64, {}, [3000, 4000]),
    ],
)
def test_times_are_absolute_nanoseconds(open_header, make, times, dtype, root, expected):
    scene = open_header(swept(make, times[0], root, timestamps=np.array(times, dtype)))
    frame = scene.sensors[0].frames[0]
    assert frame.timestamp_ns == expected[0]
    assert frame.points.timestamps_ns.tolist() == expected
    assert scene.time_offset_ns == root.get("time_offset", 0) * (1 if "time_unit" in root else 1000)


def test_point_times_counted_from_the_frame_are_recognised(open_header, make):
    points = {"positions": TWO, "timestamps": np.array([0, 99_000], np.uint32)}
    frames = [{"timestamp": start, "points": points} for start in (0, 100_000, 200_000)]
    scene = open_header(make.scene(make.lidar(frames=frames)))
    assert "relative-point-times" in codes(scene)
    assert scene.sensors[0].frames[2].points.timestamps_ns.tolist() == [200_000_000, 299_000_000]


def test_point_times_beyond_64_bits_are_refused_when_read(open_header, make):
    scene = open_header(swept(make, timestamps=np.array([3, 2**63], np.uint64)))
    with pytest.raises(DataError, match=r"sensors\[0\].frames\[0\].points.timestamps: .* does not fit 64 bits"):
        scene.sensors[0].frames[0]


def test_times_that_are_whole_floats_or_fractions_are_exact(open_header, make):
    lidar = make.lidar(frames=[{"timestamp": timestamp, "points": {"positions": TWO}} for timestamp in (2.0, 2.5)])
    assert open_header(make.scene(lidar)).sensors[0].frames.timestamps_ns.tolist() == [2000, 2500]


def test_arrays_of_points_have_the_types_of_the_model(open_header, make):
    points = {
        "colors": np.array([[1, 2, 3], [4, 5, 6]], np.uint8),
        "intensities": np.array([7, 8], np.uint8),
        "ring": np.array([9, 300], np.uint16),
        "camera_index": np.array([0, 255], np.uint8),
        "confidence": np.array([0.5, 1.0]),
    }
    frame = open_header(swept(make, **points)).sensors[0].frames[0]
    np.testing.assert_array_equal(frame.points.positions, TWO)
    np.testing.assert_array_equal(frame.points.colors, points["colors"])
    assert frame.points.intensities.tolist() == [7, 8]
    assert frame.points.rings.tolist() == [9, 300]
    assert frame.points.camera_index.tolist() == [0, 255]
    assert frame.points.extras["confidence"].tolist() == [0.5, 1.0]
    assert frame.extras == {"weather": "rain"}
    assert not frame.points.positions.flags.writeable


def test_arrays_of_strangers_are_carried_along_cut_into_rows_and_made_of_lists(open_header, make):
    ring, flat = np.array([1, 2], np.uint8), TWO.reshape(-1)
    header = swept(make, positions=flat, ring=ring, intensities=[7, 8], colors=[[1, 2, 3], [4, 5, 6]])
    points = open_header(header).sensors[0].frames[0].points
    assert points.rings is None
    assert points.extras["ring"].tolist() == [1, 2]
    np.testing.assert_array_equal(points.positions, TWO)
    assert points.intensities.dtype == np.uint8
    assert points.colors.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_items_without_dtype_get_the_fields_own(tmp_path, encode_sfs, make):
    path = tmp_path / "raw.sfs"
    path.write_bytes(encode_sfs(swept(make, timestamps=np.array([5, 6], np.uint32)), dtype=None, shape=None))
    points = FORMAT.open(path).sensors[0].frames[0].points
    np.testing.assert_array_equal(points.positions, TWO)
    assert points.timestamps_ns.tolist() == [5000, 6000]


def test_arrays_at_odd_addresses_come_out_aligned(tmp_path):
    text = (
        b'{"version":"1.0","sensors":[{"id":1,"type":"points","points":{"positions":""}}],"$items":'
        b'[{"keys":["sensors",0,"points","positions"],"offset":5,"length":24,"dtype":"float32","shape":[2,3]}]}'
    )
    path = tmp_path / "odd.sfs"
    path.write_bytes(text.ljust(-len(text) % 4 + len(text)) + bytes(5) + TWO.tobytes())
    positions = FORMAT.open(path).sensors[0].positions
    assert positions.flags.aligned
    np.testing.assert_array_equal(positions, TWO)


def test_nothing_but_the_header_is_read_at_open_and_arrays_outlive_the_scene(open_header, make):
    with open_header(make.scene(make.lidar())) as scene:
        frames = scene.sensors[0].frames
        positions = frames[0].points.positions
    assert len(frames) == 1
    assert positions.sum() == 6.0
    with pytest.raises(DataError, match=r"sensors\[0\].frames\[0\]: the scene is closed"):
        frames[0]


@pytest.mark.parametrize(
    ("coordinates", "option", "expected"),
    [(None, None, "world"), ("world", None, "world"), ("ego", None, "ego"), ("ego", "sensor", "sensor")],
)
def test_points_are_in_the_frame_that_coordinates_name_unless_stated(open_header, make, coordinates, option, expected):
    scene = open_header(make.scene(make.lidar(coordinates=coordinates)), points_frame=option)
    assert scene.sensors[0].points_frame == PointsFrame(expected)
    assert scene.sensors[0].coordinates == Coordinates(coordinates or "world")
    assert ("points-frame" in codes(scene)) is (option is None)


def test_a_single_pose_holds_for_ever_on_the_ego_and_for_sensors_with_several_frames(open_header, make):
    assert open_header(make.scene(make.lidar(coordinates="ego"))).sensors[0].poses.static
    rows = np.array([[0, 0, 0, 0, 0, 0, 1], [1.5, 0, 0, 0, 0, 0.6, 0.8]])
    for values in (rows, rows.tolist()):
        lidar = make.lidar(poses={"timestamps": [0, 100], "values": values})
        poses = open_header(make.scene(lidar, time_offset=1)).sensors[0].poses
        assert (poses.timestamps_ns.tolist(), poses.static) == ([1000, 101_000], False)
        np.testing.assert_array_equal(np.hstack([poses.positions, poses.quaternions_xyzw]), rows)
    assert not open_header(make.scene(make.lidar())).sensors[0].poses.static
    frames = [{"timestamp": timestamp, "points": {"positions": TWO}} for timestamp in (0, 9)]
    stationary = open_header(make.scene(make.lidar(frames=frames)))
    assert stationary.sensors[0].poses.static
    assert "single-pose" in codes(stationary)
    without = open_header(make.scene(make.lidar(poses=None)))
    assert without.sensors[0].poses is None
    assert "no-poses" in codes(without)


@pytest.mark.parametrize("name", ["odometry", "gps", "odometer"])
def test_odometry_is_a_sensor_and_a_trajectory(open_header, make, name):
    poses = {"timestamps": [0, 5], "values": [[0, 0, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 0, 1]]}
    scene = open_header(make.scene({"id": "car", "type": name, "poses": poses}))
    assert isinstance(scene.sensors[0], OdometrySensor)
    assert scene.trajectories["car"].positions.tolist() == [[0, 0, 0], [1, 0, 0]]
    assert ("sensor-alias" in codes(scene)) is (name != "odometry")


def test_sensors_of_every_type_are_read_and_ids_keep_their_type(open_header, make):
    points = {"positions": TWO, "directions": TWO, "lengths": np.array([1, 2], np.float32)}
    radar = make.lidar(id="radar", type="radar", frames=[{"timestamp": 0, "points": points}])
    chart = {"id": 5, "type": "points", "parent_id": "radar", "points": {"positions": TWO, "colors": None}}
    sonar = {"id": "s", "type": "sonar", "depths": TWO, "frames": [{"timestamp": 7, "pings": [1, "a"]}], "poses": "?"}
    scene = open_header(make.scene(radar, chart, sonar, make.lidar(id=1), make.lidar(id="1")))
    kinds = (RadarSensor, PointsSensor, PlainSensor, LidarSensor, LidarSensor)
    assert tuple(map(type, scene.sensors)) == kinds
    assert scene.sensors[0].frames[0].points.lengths.tolist() == [1, 2]
    assert scene.sensor(5).parent_id == "radar"
    unknown = scene.sensors[2]
    assert unknown.type == "sonar"
    np.testing.assert_array_equal(unknown.fields["depths"], TWO)
    assert unknown.fields["frames"] == [{"timestamp": 7000, "pings": [1, "a"]}]
    assert unknown.fields["poses"] == "?"
    assert (scene.sensor(1), scene.sensor("1")) == scene.sensors[3:]
    assert scene.sensor("1") is not scene.sensor(1)


def test_cuboids_are_typed_and_keep_every_other_field(open_header, make):
    row = [4.0, 2.0, 1.5, 1.0, 2.0, 3.0, 0.0, 0.0, 270.0]
    cuboid = {
        "id": "a",
        "type": "cuboid",
        "label": "car",
        "stationary": False,
        "parent_id": None,
        "path": {"timestamps": [0, 10], "values": [row, row], "smooth": True},
        "attributes": [{"name": "speed", "timestamps": [4], "values": [1.5], "static": False}],
        "activations": [{"sensor_id": "top", "timestamps": [1], "durations": [2.5], "cuboids": [row]}],
        "projections": [{"sensor_id": "c", "timestamps": [1], "boxes": [None], "confirmed": [True]}],
        "colour": "red",
    }
    (annotation,) = open_header(make.scene(annotations=[cuboid], time_offset=1)).annotations
    assert isinstance(annotation, CuboidAnnotation)
    assert annotation.path.timestamps_ns.tolist() == [1000, 11_000]
    assert annotation.path.values[0].tolist() == row
    assert (annotation.label, annotation.stationary, annotation.parent_id) == ("car", False, None)
    assert annotation.attributes[0].timestamps_ns.tolist() == [5000]
    assert annotation.attributes[0].values == (1.5,)
    assert annotation.activations[0].timestamps_ns.tolist() == [2000]
    assert annotation.activations[0].durations_ns == (2500,)
    assert np.isnan(annotation.projections[0].boxes).all()
    assert annotation.path.extras == {"smooth": True}
    assert annotation.extras == {"colour": "red"}


def test_annotations_of_unknown_types_stay_as_they_are_with_times_in_nanoseconds(open_header, make):
    path = {"timestamps": [3], "values": [[0.5, 1.5]]}
    unknown = {"id": 5, "type": "future", "path": path, "start": "soon", "depth": {"timestamps": [9]}}
    thing = {"id": "o", "type": "event", "label": "car"}
    scene = open_header(make.scene(annotations=[unknown, thing], time_offset=1))
    annotation, without_start = scene.annotations
    assert isinstance(annotation, PlainAnnotation)
    assert annotation.fields["path"] == {"timestamps": [4000], "values": [[0.5, 1.5]]}
    assert annotation.fields["start"] == "soon"
    assert annotation.fields["depth"] == {"timestamps": [9]}
    assert without_start.type == "object"
    assert "event-is-object" in codes(scene)


def test_unknown_root_fields_and_metadata_are_kept(open_header, make):
    scene = open_header(make.scene(metadata={"town": "Ulm", "map": TWO}, licence="open", time_unit="microsecond"))
    assert scene.metadata["town"] == "Ulm"
    np.testing.assert_array_equal(scene.metadata["map"], TWO)
    assert scene.extras == {"licence": "open", "time_unit": "microsecond"}


def test_how_angles_are_meant_is_recorded_and_asked_about(open_header, make):
    cuboid = {"id": 1, "type": "cuboid", "path": {"timestamps": [0], "values": [[1.0] * 9]}}
    assumed = open_header(make.scene(annotations=[cuboid]))
    assert assumed.metadata["sceneloom"] == {"euler_unit": "degrees", "euler_order": "xyz"}
    assert {"euler-unit", "euler-order"} <= set(codes(assumed))
    stated = open_header(make.scene(annotations=[cuboid]), euler_unit="radians", euler_order="zyx")
    assert stated.metadata["sceneloom"] == {"euler_unit": "radians", "euler_order": "zyx"}
    assert stated.warnings == ()
    assert open_header(make.scene()).metadata == {}


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"euler_unit": "grad"}, "euler_unit"),
        ({"euler_order": "rpy"}, "euler_order"),
        ({"points_frame": "camera"}, "points_frame"),
        ({"altitude": "msl"}, "altitude"),
        ({"tangential": "euler"}, "tangential 'euler'; expected one of opencv, brown"),
        ({"points_frame": None, "altitude": None}, None),
    ],
)
def test_options_that_cannot_be_followed_are_refused_and_none_states_nothing(open_header, make, options, problem):
    if problem is None:
        assert open_header(make.scene(), **options).sensors == ()
    else:
        with pytest.raises(OptionError, match=problem):
            open_header(make.scene(), **options)


def camera(model=None, params=(), distortion=None, **fields):
    poses = {"timestamps": [0], "values": [[0, 0, 0, 0, 0, 0, 1]]}
    intrinsics = {"fx": 100, "fy": 101.5, "cx": 3.5, "cy": 2.0, "width": 8, "height": 6}
    intrinsics["distortion"] = distortion if model is None else {"model": model, "params": params}
    return {"id": "c", "type": "camera", "poses": poses, "intrinsics": intrinsics, "images": [], **fields}


BROWN = [0.1, 0.2, 0.003, 0.004, 0, 0, 0, 0, 0, 0]


@pytest.mark.parametrize(
    ("model", "params", "tangential", "expected"),
    [
        ("", [], None, ("pinhole", ())),
        (None, [], None, ("pinhole", ())),
        ("fisheye", [0.1, 0, 0, 0], None, ("fisheye", (0.1, 0.0, 0.0, 0.0))),
        ("fisheye", [0.1, 0.2, 0.3, 0.4], "brown", ("fisheye", (0.1, 0.2, 0.3, 0.4))),
        ("brown_conrady", np.arange(10.0), None, ("brown_conrady", tuple(np.arange(10.0)))),
        ("brown_conrady", BROWN, "opencv", ("brown_conrady", tuple(BROWN))),
        ("brown_conrady", BROWN, "brown", ("brown_conrady", (0.1, 0.2, 0.004, 0.003, *BROWN[4:]))),
        ("brown_conrady", [0.1, 0.2, 0.003], "brown", ("brown_conrady", (0.1, 0.2, 0.0, 0.003))),
        ("ftheta", [0, 1, 2, 3, 4], None, ("ftheta", (0.0, 1.0, 2.0, 3.0, 4.0))),
        ("from_the_future", [9], None, ("from_the_future", (9.0,))),
    ],
)
def test_camera_models_of_every_model_open(open_header, make, model, params, tangential, expected):
    found = open_header(make.scene(camera(model, params)), tangential=tangential).cameras[0].camera
    assert (found.model, found.coefficients) == expected
    assert (found.fx, found.fy, found.cx, found.cy, found.width, found.height) == (100, 101.5, 3.5, 2, 8, 6)


def test_a_camera_model_without_a_projection_says_so_only_when_it_is_used(open_header, make):
    found = open_header(make.scene(camera("from_the_future", [9]))).cameras[0].camera
    with pytest.raises(CalibrationError, match="from_the_future"):
        project(found, np.ones((1, 3)))


def test_short_lists_of_coefficients_are_noticed_and_long_ones_refused(open_header, make):
    assert "short-distortion" in codes(open_header(make.scene(camera("brown_conrady", [0.1]))))
    assert "5 numbers; fisheye has 4" in refused(open_header, make.scene(camera("fisheye", [0.1] * 5))).problem


def test_terms_are_exchanged_once_however_often_a_scene_is_written_and_read(open_header, make, target):
    scene = open_header(make.scene(camera("brown_conrady", BROWN)), tangential="brown")
    assert scene.metadata["sceneloom"]["tangential"] == "opencv"
    assert scene.metadata["sceneloom"]["tangential_before"] == "brown"
    write_scene(scene, target)
    for stated in (None, "opencv", "brown"):
        again = FORMAT.open(target, tangential=stated)
        assert again.cameras[0].camera.coefficients[2:4] == (0.004, 0.003)
        assert ("tangential-recorded" in codes(again)) is (stated == "brown")


FTHETA = [0.0, 100.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("model", ["ftheta", "fisheye_radial_custom"])
def test_a_camera_model_whose_formula_nothing_confirms_opens_but_is_not_computed_with(open_header, make, model):
    scene = open_header(make.scene(camera(model, FTHETA)))
    assert scene.cameras[0].camera.model == model
    assert assumed_models(scene) == ()
    with pytest.raises(CalibrationError, match=rf"sensors\[c\].camera: '{model}' .* use `--assume-model`"):
        check_camera_models(scene)
    check_camera_models(scene, [])


def test_computing_with_it_can_be_asked_for_and_stands_in_the_output(open_header, make, target):
    scene = open_header(make.scene(camera("ftheta", FTHETA)), assume_model=True)
    check_camera_models(scene)
    assert scene.metadata["sceneloom"]["assumed_models"] == ["ftheta"]
    assert codes(scene).count("assumed-model") == 1
    write_scene(scene, target)
    again = FORMAT.open(target)
    check_camera_models(again)
    assert codes(again).count("assumed-model") == 1
    in_vain = open_header(make.scene(camera("fisheye", [0.1, 0, 0, 0])), assume_model=True)
    assert "assumed-model" not in codes(in_vain)
    assert assumed_models(in_vain) == ()


def test_fusing_and_converting_such_a_camera_model_need_the_option(open_header, make, tmp_path):
    jpeg = np.frombuffer(encode_jpeg(np.zeros((6, 8, 3), np.uint8)), np.uint8)
    images = [{"timestamp": 0, "content": jpeg}]
    scene = open_header(make.scene(camera("ftheta", FTHETA, images=images, coordinates="ego")))
    convert = partial(convert_camera_models, model="fisheye")
    for compute in (align, undistort_scene, convert, partial(write_any, path=tmp_path / "drive")):
        with pytest.raises(CalibrationError, match="assume-model"):
            compute(scene)
    assert not (tmp_path / "drive").exists()


def lidar(**fields):
    return lambda make: make.scene(make.lidar(**fields))


def points(**arrays):
    return lambda make: swept(make, **arrays)


def annotated(**fields):
    return lambda make: make.scene(annotations=[{"id": 1, **fields}])


def root(**fields):
    return lambda make: make.scene(**fields)


def poses(timestamps, values):
    return lidar(poses={"timestamps": timestamps, "values": values})


POSE = [0, 0, 0, 0, 0, 0, 1]
PATH = {"timestamps": [0], "values": [[1.0] * 9]}
FRAME = "sensors[0].frames[0]"


@pytest.mark.parametrize(
    ("header", "location", "problem"),
    [
        (root(version="2.0"), "version", "'2.0'; expected 1.0* or 5.1*"),
        (root(version=None), "version", "None; expected"),
        (root(time_unit="seconds"), "time_unit", "'seconds'; expected one of"),
        (root(time_unit=5), "time_unit", "5; expected one of"),
        (root(time_offset="now"), "time_offset", "'now'"),
        (root(time_offset=2**70), "time_offset", "292 years"),
        (root(metadata=[1]), "metadata", "expected an object"),
        (root(metadata={"sceneloom": 5}), "metadata.sceneloom", "5; expected an object"),
        (root(sensors={}), "sensors", "expected a list"),
        (root(annotations=5), "annotations", "expected a list"),
        (root(attributes=5), "attributes", "5; expected a list of objects"),
        (root(sensors=[5]), "sensors[0].type", "None; expected one of points, lidar"),
        (lidar(id=None), "sensors[0].id", "missing; expected an id"),
        (lidar(id=1.5), "sensors[0].id", "1.5; expected an id"),
        (lidar(id=True), "sensors[0].id", "True; expected an id"),
        (lidar(frames=5), "sensors[0].frames", "5; expected a list of objects"),
        (lidar(frames=[5]), FRAME, "5; expected an object"),
        (lidar(frames=[{"points": {"positions": TWO}}]), f"{FRAME}.timestamp", "missing"),
        (lidar(frames=[{"timestamp": "0", "points": {"positions": TWO}}]), f"{FRAME}.timestamp", "'0'"),
        (lidar(frames=[{"timestamp": 0}]), f"{FRAME}.points", "missing; expected an object"),
        (points(positions=None), f"{FRAME}.points.positions", "missing"),
        (
            points(positions=TWO.astype(np.float64)),
            f"{FRAME}.points.positions ($items[0])",
            "an array of float64; expected float32",
        ),
        (points(positions=TWO.T), f"{FRAME}.points.positions ($items[0])", "shape (3, 2); expected (N, 3)"),
        (points(intensities=np.zeros(3, np.uint8)), f"{FRAME}.points.intensities ($items[1])", "3 values for 2 points"),
        (
            points(timestamps=np.zeros(2)),
            f"{FRAME}.points.timestamps ($items[1])",
            "float64; expected uint32 or uint64",
        ),
        (lidar(coordinates="map"), "sensors[0].coordinates", "'map'; expected one of world, ego"),
        (poses([0], [[1, 2]]), "sensors[0].poses", "expected rows of 7 numbers"),
        (poses([0, 1], [POSE]), "sensors[0].poses", "2 timestamps"),
        (
            poses([1, 1], [POSE, [1, *POSE[1:]]]),
            "sensors[0].poses.values[0]",
            "another pose than the other one at 1000 ns; expected one pose for each time",
        ),
        (poses([0], [[0, 0, 0, 0, 0, 0, 2]]), "sensors[0].poses.values[0]", "norm 2; expected 1"),
        (poses([0], [["0"] * 7]), "sensors[0].poses", "something else"),
        (poses([2**62], []), "sensors[0].poses.timestamps", "does not fit 64 bits"),
        (annotated(type=5), "annotations[0].type", "5; expected one of cuboid"),
        (annotated(type="cuboid"), "annotations[0].path", "missing; expected an object"),
        (annotated(type="cuboid", path={**PATH, "timestamps": [1, "2"]}), "annotations[0].path.timestamps", "[1]: '2'"),
        (annotated(type="cuboid", path={**PATH, "timestamps": []}), "annotations[0].path", "expected as many of both"),
        (annotated(type="cuboid", path=PATH, label=5), "annotations[0].label", "5; expected text"),
        (annotated(type="link", from_id=1), "annotations[0].to_id", "missing; expected an id"),
        (annotated(type="polygon", path=PATH, attributes=[{}]), "annotations[0].attributes[0].name", "missing"),
    ],
)
def test_a_fault_is_refused_with_its_location(open_header, make, header, location, problem):
    error = refused(open_header, header(make))
    assert error.location == location
    assert problem in error.problem


def test_an_error_reports_the_locations_of_further_faults_and_counts_those_beyond(open_header, make):
    error = refused(open_header, make.scene(make.lidar(id=None, frames=None), version="9"))
    assert error.location == "version"
    assert error.problem.endswith("; also at fault: sensors[0].id, sensors[0].frames")
    many = refused(open_header, make.scene(*(make.lidar(id=None) for _ in range(7))))
    assert many.problem.endswith("sensors[4].id and 2 more; `sceneloom validate FILE` lists all")
    assert "'top' is used twice" in refused(open_header, make.scene(make.lidar(), make.lidar())).problem


def test_lenient_reading_leaves_faulty_parts_out_with_a_warning(open_header, make):
    header = make.scene(make.lidar(id=None), make.lidar(), annotations=[{"id": 1}, {"id": 2, "type": "group"}])
    scene = open_header(header, lenient=True)
    assert [sensor.id for sensor in scene.sensors] == ["top"]
    assert [annotation.id for annotation in scene.annotations] == [2]
    left_out = [warning.message for warning in scene.warnings if warning.code == "at-fault"]
    assert left_out[0].startswith("left out: sensors[0].id: missing")
    assert left_out[1].startswith("left out: annotations[0].type")
