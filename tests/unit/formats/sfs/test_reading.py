"""Reading: from the words of a file to the model, and every fault with its location."""

import numpy as np
import pytest

from sceneloom.errors import CalibrationError, DataError, OptionError
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

TWO = np.array([[1, 2, 3], [4, 5, 6]], np.float32)


def codes(scene):
    return [warning.code for warning in scene.warnings]


def refused(open_header, header, **options):
    with pytest.raises(DataError) as caught:
        open_header(header, **options)
    return caught.value


def test_times_are_absolute_nanoseconds(open_header, make):
    points = {"positions": TWO, "timestamps": np.array([1_000_000, 1_000_003], np.uint32)}
    lidar = make.lidar(frames=[{"timestamp": 1_000_000, "points": points}])
    scene = open_header(make.scene(lidar, time_offset=1_700_000_000_000_001))
    frame = scene.sensors[0].frames[0]
    assert frame.timestamp_ns == (1_700_000_000_000_001 + 1_000_000) * 1000
    assert frame.points.timestamps_ns.tolist() == [frame.timestamp_ns, frame.timestamp_ns + 3000]
    assert scene.time_offset_ns == 1_700_000_000_000_001_000


@pytest.mark.parametrize("unit", ["nanoseconds", "nanosecond"])
def test_nanoseconds_pass_as_they_are(open_header, make, unit):
    points = {"positions": TWO, "timestamps": np.array([7, 1_999_999_999], np.uint64)}
    lidar = make.lidar(frames=[{"timestamp": 7, "points": points}])
    frame = open_header(make.scene(lidar, time_unit=unit, time_offset=5)).sensors[0].frames[0]
    assert frame.points.timestamps_ns.tolist() == [12, 2_000_000_004]


@pytest.mark.parametrize("dtype", [np.uint32, np.uint64, np.int32, np.int64])
def test_point_times_may_be_any_wide_integers(open_header, make, dtype):
    points = {"positions": TWO, "timestamps": np.array([3, 4], dtype)}
    lidar = make.lidar(frames=[{"timestamp": 3, "points": points}])
    assert open_header(make.scene(lidar)).sensors[0].frames[0].points.timestamps_ns.tolist() == [3000, 4000]


def test_point_times_counted_from_the_frame_are_recognised(open_header, make):
    frames = [
        {"timestamp": start, "points": {"positions": TWO, "timestamps": np.array([0, 99_000], np.uint32)}}
        for start in (0, 100_000, 200_000)
    ]
    scene = open_header(make.scene(make.lidar(frames=frames)))
    assert "relative-point-times" in codes(scene)
    assert scene.sensors[0].frames[2].points.timestamps_ns.tolist() == [200_000_000, 299_000_000]


def test_point_times_beyond_64_bits_are_refused_when_read(open_header, make):
    points = {"positions": TWO, "timestamps": np.array([3, 2**63], np.uint64)}
    scene = open_header(make.scene(make.lidar(frames=[{"timestamp": 0, "points": points}])))
    with pytest.raises(DataError, match=r"sensors\[0\].frames\[0\].points.timestamps: .* does not fit 64 bits"):
        scene.sensors[0].frames[0]


def test_times_that_are_whole_floats_or_fractions_are_exact(open_header, make):
    lidar = make.lidar(frames=[{"timestamp": timestamp, "points": {"positions": TWO}} for timestamp in (2.0, 2.5)])
    assert open_header(make.scene(lidar)).sensors[0].frames.timestamps_ns.tolist() == [2000, 2500]


def test_arrays_of_points_have_the_types_of_the_model(open_header, make):
    points = {
        "positions": TWO,
        "colors": np.array([[1, 2, 3], [4, 5, 6]], np.uint8),
        "intensities": np.array([7, 8], np.uint8),
        "ring": np.array([9, 300], np.uint16),
        "camera_index": np.array([0, 255], np.uint8),
        "confidence": np.array([0.5, 1.0]),
    }
    frame = open_header(make.scene(make.lidar(frames=[{"timestamp": 0, "points": points, "weather": "rain"}])))
    frame = frame.sensors[0].frames[0]
    np.testing.assert_array_equal(frame.points.positions, TWO)
    np.testing.assert_array_equal(frame.points.colors, points["colors"])
    assert frame.points.intensities.tolist() == [7, 8]
    assert frame.points.rings.tolist() == [9, 300]
    assert frame.points.camera_index.tolist() == [0, 255]
    assert frame.points.extras["confidence"].tolist() == [0.5, 1.0]
    assert frame.extras == {"weather": "rain"}
    assert not frame.points.positions.flags.writeable


def test_a_strangers_ring_of_another_type_is_carried_along(open_header, make):
    points = {"positions": TWO, "ring": np.array([1, 2], np.uint8)}
    points = (
        open_header(make.scene(make.lidar(frames=[{"timestamp": 0, "points": points}]))).sensors[0].frames[0].points
    )
    assert points.rings is None
    assert points.extras["ring"].tolist() == [1, 2]


def test_flat_arrays_are_cut_into_rows_and_lists_become_arrays(open_header, make):
    points = {"positions": TWO.reshape(-1), "intensities": [7, 8], "colors": [[1, 2, 3], [4, 5, 6]]}
    frame = open_header(make.scene(make.lidar(frames=[{"timestamp": 0, "points": points}]))).sensors[0].frames[0]
    np.testing.assert_array_equal(frame.points.positions, TWO)
    assert frame.points.intensities.dtype == np.uint8
    assert frame.points.colors.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_items_without_dtype_get_the_fields_own(tmp_path, encode_sfs, make):
    from sceneloom.formats.sfs.spec import FORMAT

    points = {"positions": TWO, "timestamps": np.array([5, 6], np.uint32)}
    path = tmp_path / "raw.sfs"
    header = make.scene(make.lidar(frames=[{"timestamp": 0, "points": points}]))
    path.write_bytes(encode_sfs(header, dtype=None, shape=None))
    frame = FORMAT.open(path).sensors[0].frames[0]
    np.testing.assert_array_equal(frame.points.positions, TWO)
    assert frame.points.timestamps_ns.tolist() == [5000, 6000]


def test_arrays_at_odd_addresses_come_out_aligned(tmp_path):
    from sceneloom.formats.sfs.spec import FORMAT

    text = (
        b'{"version":"1.0","sensors":[{"id":1,"type":"points","points":{"positions":""}}],"$items":'
        b'[{"keys":["sensors",0,"points","positions"],"offset":5,"length":24,"dtype":"float32","shape":[2,3]}]}'
    )
    path = tmp_path / "odd.sfs"
    path.write_bytes(text.ljust(-len(text) % 4 + len(text)) + bytes(5) + TWO.tobytes())
    positions = FORMAT.open(path).sensors[0].positions
    assert positions.flags.aligned
    np.testing.assert_array_equal(positions, TWO)


def test_nothing_but_the_header_is_read_at_open(open_header, make):
    scene = open_header(make.scene(make.lidar()))
    frames = scene.sensors[0].frames
    assert len(frames) == 1
    scene.close()
    with pytest.raises(DataError, match=r"sensors\[0\].frames\[0\]: the scene is closed"):
        frames[0]


def test_arrays_outlive_the_scene(open_header, make):
    with open_header(make.scene(make.lidar())) as scene:
        positions = scene.sensors[0].frames[0].points.positions
    assert positions.sum() == 6.0


@pytest.mark.parametrize(
    ("coordinates", "option", "expected"),
    [(None, None, "world"), ("world", None, "world"), ("ego", None, "ego"), ("ego", "sensor", "sensor")],
)
def test_points_are_in_the_frame_that_coordinates_name_unless_reported(
    open_header, make, coordinates, option, expected
):
    scene = open_header(make.scene(make.lidar(coordinates=coordinates)), points_frame=option)
    assert scene.sensors[0].points_frame == PointsFrame(expected)
    assert ("points-frame" in codes(scene)) is (option is None)


def test_poses_become_a_path(open_header, make):
    rows = [[0, 0, 0, 0, 0, 0, 1], [1.5, 0, 0, 0, 0, 0.6, 0.8]]
    for values in (rows, np.array(rows)):
        lidar = make.lidar(poses={"timestamps": [0, 100], "values": values})
        poses = open_header(make.scene(lidar, time_offset=1)).sensors[0].poses
        assert poses.timestamps_ns.tolist() == [1000, 101_000]
        assert poses.positions.tolist() == [[0, 0, 0], [1.5, 0, 0]]
        assert poses.quaternions_xyzw.tolist()[1] == [0, 0, 0.6, 0.8]
        assert not poses.static


def test_a_single_pose_holds_for_ever_on_the_ego_and_for_sensors_with_several_frames(open_header, make):
    assert open_header(make.scene(make.lidar(coordinates="ego"))).sensors[0].poses.static
    assert not open_header(make.scene(make.lidar())).sensors[0].poses.static
    frame = {"points": {"positions": TWO}}
    stationary = open_header(make.scene(make.lidar(frames=[{"timestamp": 0, **frame}, {"timestamp": 9, **frame}])))
    assert stationary.sensors[0].poses.static
    assert "single-pose" in codes(stationary)


def test_a_sensor_without_poses_opens_with_a_warning(open_header, make):
    scene = open_header(make.scene(make.lidar(poses=None)))
    assert scene.sensors[0].poses is None
    assert "no-poses" in codes(scene)


@pytest.mark.parametrize("name", ["odometry", "gps", "odometer"])
def test_odometry_is_a_sensor_and_a_trajectory(open_header, make, name):
    poses = {"timestamps": [0, 5], "values": [[0, 0, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 0, 1]]}
    scene = open_header(make.scene({"id": "car", "type": name, "poses": poses}))
    assert isinstance(scene.sensors[0], OdometrySensor)
    assert scene.trajectories["car"].positions.tolist() == [[0, 0, 0], [1, 0, 0]]
    assert ("sensor-alias" in codes(scene)) is (name != "odometry")


def test_radar_points_and_maps_are_read(open_header, make):
    points = {"positions": TWO, "directions": TWO, "lengths": np.array([1, 2], np.float32)}
    radar = make.lidar(id="radar", type="radar", frames=[{"timestamp": 0, "points": points}])
    chart = {"id": 5, "type": "points", "parent_id": "radar", "points": {"positions": TWO, "colors": None}}
    scene = open_header(make.scene(radar, chart))
    assert isinstance(scene.sensors[0], RadarSensor)
    assert scene.sensors[0].frames[0].points.lengths.tolist() == [1, 2]
    assert isinstance(scene.sensors[1], PointsSensor)
    assert scene.sensor(5).parent_id == "radar"


def test_sensors_of_unknown_types_keep_all_their_fields(open_header, make):
    sonar = {"id": "s", "type": "sonar", "depths": TWO, "frames": [{"timestamp": 7, "pings": [1, "a"]}], "poses": "?"}
    sensor = open_header(make.scene(sonar)).sensors[0]
    assert isinstance(sensor, PlainSensor)
    assert sensor.type == "sonar"
    np.testing.assert_array_equal(sensor.fields["depths"], TWO)
    assert sensor.fields["frames"] == [{"timestamp": 7000, "pings": [1, "a"]}]
    assert sensor.fields["poses"] == "?"


def test_ids_keep_their_type(open_header, make):
    scene = open_header(make.scene(make.lidar(id=1), make.lidar(id="1")))
    assert isinstance(scene.sensor(1), LidarSensor)
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
    scene = open_header(make.scene(annotations=[cuboid], time_offset=1))
    annotation = scene.annotations[0]
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
    (annotation,) = open_header(make.scene(annotations=[unknown], time_offset=1)).annotations
    assert isinstance(annotation, PlainAnnotation)
    assert annotation.fields["path"] == {"timestamps": [4000], "values": [[0.5, 1.5]]}
    assert annotation.fields["start"] == "soon"
    assert annotation.fields["depth"] == {"timestamps": [9]}


def test_an_event_without_a_start_is_an_object(open_header, make):
    scene = open_header(make.scene(annotations=[{"id": "o", "type": "event", "label": "car"}]))
    assert scene.annotations[0].type == "object"
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
    reported = open_header(make.scene(annotations=[cuboid]), euler_unit="radians", euler_order="zyx")
    assert reported.metadata["sceneloom"] == {"euler_unit": "radians", "euler_order": "zyx"}
    assert reported.warnings == ()
    assert open_header(make.scene()).metadata == {}


@pytest.mark.parametrize(
    ("option", "value"),
    [("euler_unit", "grad"), ("euler_order", "rpy"), ("points_frame", "camera"), ("altitude", "msl")],
)
def test_options_that_cannot_be_followed_are_refused(open_header, make, option, value):
    with pytest.raises(OptionError, match=option):
        open_header(make.scene(), **{option: value})


def test_options_of_none_are_not_stated(open_header, make):
    assert open_header(make.scene(), points_frame=None, altitude=None).sensors == ()


INTRINSICS = {"fx": 100, "fy": 101.5, "cx": 3.5, "cy": 2.0, "width": 8, "height": 6}


def camera_header(**fields):
    poses = {"timestamps": [0], "values": [[0, 0, 0, 0, 0, 0, 1]]}
    return {"id": "c", "type": "camera", "poses": poses, "intrinsics": INTRINSICS, "images": [], **fields}


@pytest.mark.parametrize(
    ("distortion", "model", "coefficients"),
    [
        (None, "pinhole", ()),
        ({"model": "", "params": []}, "pinhole", ()),
        ({"model": "fisheye", "params": [0.1, 0, 0, 0]}, "fisheye", (0.1, 0.0, 0.0, 0.0)),
        ({"model": "brown_conrady", "params": np.arange(10.0)}, "brown_conrady", tuple(np.arange(10.0))),
        ({"model": "ftheta", "params": [0, 1, 2, 3, 4]}, "ftheta", (0.0, 1.0, 2.0, 3.0, 4.0)),
        ({"model": "from_the_future", "params": [9]}, "from_the_future", (9.0,)),
    ],
)
def test_camera_models_of_every_model_open(open_header, make, distortion, model, coefficients):
    scene = open_header(make.scene(camera_header(intrinsics={**INTRINSICS, "distortion": distortion})))
    camera = scene.cameras[0].camera
    assert (camera.model, camera.coefficients) == (model, coefficients)
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height) == (100, 101.5, 3.5, 2, 8, 6)


def test_a_camera_model_without_a_projection_says_so_only_when_it_is_used(open_header, make):
    from sceneloom.cameras import project

    intrinsics = {**INTRINSICS, "distortion": {"model": "from_the_future", "params": [9]}}
    camera = open_header(make.scene(camera_header(intrinsics=intrinsics))).cameras[0].camera
    with pytest.raises(CalibrationError, match="from_the_future"):
        project(camera, np.ones((1, 3)))


def test_short_lists_of_coefficients_are_noticed_and_long_ones_refused(open_header, make):
    short = {**INTRINSICS, "distortion": {"model": "brown_conrady", "params": [0.1]}}
    assert "short-distortion" in codes(open_header(make.scene(camera_header(intrinsics=short))))
    long = {**INTRINSICS, "distortion": {"model": "fisheye", "params": [0.1] * 5}}
    assert "5 numbers; fisheye has 4" in refused(open_header, make.scene(camera_header(intrinsics=long))).problem


def faulty(**fields):
    return lambda make: make.scene(make.lidar(**fields))


def annotated(**fields):
    return lambda make: make.scene(annotations=[{"id": 1, **fields}])


PATH = {"timestamps": [0], "values": [[1.0] * 9]}
POINTS_U8 = {"positions": TWO, "intensities": np.zeros(3, np.uint8)}


@pytest.mark.parametrize(
    ("header", "location", "problem"),
    [
        (lambda _: {"version": "2.0"}, "version", "'2.0'; expected 1.0* or 5.1*"),
        (lambda _: {"sensors": []}, "version", "None; expected"),
        (lambda make: make.scene(time_unit="seconds"), "time_unit", "'seconds'; expected one of"),
        (lambda make: make.scene(time_unit=5), "time_unit", "5; expected one of"),
        (lambda make: make.scene(time_offset="now"), "time_offset", "'now'"),
        (lambda make: make.scene(time_offset=2**70), "time_offset", "292 years"),
        (lambda make: make.scene(metadata=[1]), "metadata", "expected an object"),
        (lambda make: make.scene(metadata={"sceneloom": 5}), "metadata.sceneloom", "5; expected an object"),
        (lambda _: {"version": "1.0", "sensors": {}}, "sensors", "expected a list"),
        (lambda _: {"version": "1.0", "annotations": 5}, "annotations", "expected a list"),
        (lambda make: make.scene(attributes=5), "attributes", "5; expected a list of objects"),
        (lambda make: make.scene(5), "sensors[0].type", "None; expected one of points, lidar"),
        (faulty(id=None), "sensors[0].id", "missing; expected an id"),
        (faulty(id=1.5), "sensors[0].id", "1.5; expected an id"),
        (faulty(id=True), "sensors[0].id", "True; expected an id"),
        (faulty(frames=5), "sensors[0].frames", "5; expected a list of objects"),
        (faulty(frames=[5]), "sensors[0].frames[0]", "5; expected an object"),
        (faulty(frames=[{"points": {"positions": TWO}}]), "sensors[0].frames[0].timestamp", "missing"),
        (faulty(frames=[{"timestamp": "0", "points": {"positions": TWO}}]), "sensors[0].frames[0].timestamp", "'0'"),
        (faulty(frames=[{"timestamp": 0}]), "sensors[0].frames[0].points", "missing; expected an object"),
        (faulty(frames=[{"timestamp": 0, "points": {}}]), "sensors[0].frames[0].points.positions", "missing"),
        (
            faulty(frames=[{"timestamp": 0, "points": {"positions": TWO.astype(np.float64)}}]),
            "sensors[0].frames[0].points.positions ($items[0])",
            "an array of float64; expected float32",
        ),
        (
            faulty(frames=[{"timestamp": 0, "points": {"positions": np.ones((3, 2), np.float32)}}]),
            "sensors[0].frames[0].points.positions ($items[0])",
            "shape (3, 2); expected (N, 3)",
        ),
        (
            faulty(frames=[{"timestamp": 0, "points": POINTS_U8}]),
            "sensors[0].frames[0].points.intensities ($items[1])",
            "3 values for 2 points",
        ),
        (
            faulty(frames=[{"timestamp": 0, "points": {"positions": TWO, "timestamps": np.zeros(2)}}]),
            "sensors[0].frames[0].points.timestamps ($items[1])",
            "an array of float64; expected uint32 or uint64",
        ),
        (faulty(coordinates="map"), "sensors[0].coordinates", "'map'; expected one of world, ego"),
        (faulty(poses={"timestamps": [0], "values": [[1, 2]]}), "sensors[0].poses", "expected rows of 7 numbers"),
        (faulty(poses={"timestamps": [0, 1], "values": [[0, 0, 0, 0, 0, 0, 1]]}), "sensors[0].poses", "2 timestamps"),
        (
            faulty(poses={"timestamps": [1, 1], "values": [[0, 0, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 0, 1]]}),
            "sensors[0].poses.values[0]",
            "another pose than the other one at 1000 ns; expected one pose for each time",
        ),
        (
            faulty(poses={"timestamps": [0], "values": [[0, 0, 0, 0, 0, 0, 2]]}),
            "sensors[0].poses.values[0]",
            "norm 2; expected 1",
        ),
        (faulty(poses={"timestamps": [0], "values": [["0"] * 7]}), "sensors[0].poses", "something else"),
        (faulty(poses={"timestamps": [2**62], "values": []}), "sensors[0].poses.timestamps", "does not fit 64 bits"),
        (annotated(type=5), "annotations[0].type", "5; expected one of cuboid"),
        (annotated(type="cuboid"), "annotations[0].path", "missing; expected an object"),
        (
            annotated(type="cuboid", path={**PATH, "values": [[1.0]]}),
            "annotations[0].path.values[0]",
            "1 numbers; expected 9 numbers",
        ),
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


def test_an_error_reports_the_locations_of_further_faults(open_header, make):
    error = refused(open_header, make.scene(make.lidar(id=None, frames=None), version="9"))
    assert error.location == "version"
    assert error.problem.endswith("; also at fault: sensors[0].id, sensors[0].frames")


def test_an_error_counts_the_faults_beyond_the_first_ones(open_header, make):
    error = refused(open_header, make.scene(*(make.lidar(id=None) for _ in range(7))))
    assert error.problem.endswith("sensors[4].id and 2 more; `sceneloom validate FILE` lists all")


def test_lenient_reading_leaves_faulty_parts_out_with_a_warning(open_header, make):
    header = make.scene(make.lidar(id=None), make.lidar(), annotations=[{"id": 1}, {"id": 2, "type": "group"}])
    scene = open_header(header, lenient=True)
    assert [sensor.id for sensor in scene.sensors] == ["top"]
    assert [annotation.id for annotation in scene.annotations] == [2]
    left_out = [warning.message for warning in scene.warnings if warning.code == "at-fault"]
    assert left_out[0].startswith("left out: sensors[0].id: missing")
    assert left_out[1].startswith("left out: annotations[0].type")


def test_ids_used_twice_are_refused(open_header, make):
    assert "'top' is used twice" in refused(open_header, make.scene(make.lidar(), make.lidar())).problem


def test_ego_coordinates_are_read(open_header, make):
    assert open_header(make.scene(make.lidar(coordinates="ego"))).sensors[0].coordinates == Coordinates.EGO
