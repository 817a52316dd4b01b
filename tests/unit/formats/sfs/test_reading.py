"""Reading: from the words of a file to the model, and every fault with its location."""

from functools import partial

import numpy as np
import pytest
from simplejpeg import encode_jpeg
from tests.unit.formats.sfs.conftest import make

import sceneloom
from sceneloom import scene as sc
from sceneloom.cameras import project
from sceneloom.editing import convert_camera_models, undistort_scene
from sceneloom.errors import CalibrationError, DataError, OptionError, PoseError
from sceneloom.formats import open_scene
from sceneloom.formats.base.registry import write_scene as write_any
from sceneloom.formats.sfs.spec import FORMAT
from sceneloom.formats.sfs.writer import write_scene
from sceneloom.pipeline.alignment import align
from sceneloom.scene.scene import assumed_models, check_camera_models

TWO = np.array([[1, 2, 3], [4, 5, 6]], np.float32)
OFFSET = 1_700_000_000_000_001


def codes(scene):
    return [warning.code for warning in scene.warnings]


def refused(open_header, header, **options):
    with pytest.raises(DataError) as caught:
        open_header(header, **options)
    return caught.value


def swept(timestamp=0, root=None, **points):
    """The header of one sweep of two points with further arrays."""
    frames = [{"timestamp": timestamp, "points": {"positions": TWO, **points}, "weather": "rain"}]
    return make.scene(make.lidar(frames=frames), **(root or {}))


def test_times_are_absolute_nanoseconds_and_odd_ones_exact_counted_from_the_frame_or_refused_when_read(open_header):
    late = {"time_offset": OFFSET}, [1000 * (OFFSET + 10**6), 1000 * (OFFSET + 10**6 + 3)]
    for times, dtype, root, expected in (
        ([10**6, 10**6 + 3], np.uint32, *late),
        *(([7, 1_999_999_999], np.uint64, {"time_unit": unit, "time_offset": 5}, [12, 2_000_000_004])
          for unit in ("nanoseconds", "nanosecond")),
        *(([3, 4], dtype, {}, [3000, 4000]) for dtype in (np.uint32, np.uint64, np.int32, np.int64)),
    ):  # fmt: skip
        scene = open_header(swept(times[0], root, timestamps=np.array(times, dtype)))
        frame = scene.sensors[0].frames[0]
        assert (frame.timestamp_ns, frame.points.timestamps_ns.tolist()) == (expected[0], expected)
        assert scene.time_offset_ns == root.get("time_offset", 0) * (1 if "time_unit" in root else 1000)
    lidar = make.lidar(frames=[{"timestamp": timestamp, "points": {"positions": TWO}} for timestamp in (2.0, 2.5)])
    assert open_header(make.scene(lidar)).sensors[0].frames.timestamps_ns.tolist() == [2000, 2500]
    points = {"positions": TWO, "timestamps": np.array([0, 99_000], np.uint32)}
    frames = [{"timestamp": start, "points": points} for start in (0, 100_000, 200_000)]
    scene = open_header(make.scene(make.lidar(frames=frames)))
    assert "relative-point-times" in codes(scene)
    assert scene.sensors[0].frames[2].points.timestamps_ns.tolist() == [200_000_000, 299_000_000]
    scene = open_header(swept(timestamps=np.array([3, 2**63], np.uint64)))
    with pytest.raises(DataError, match=r"sensors\[0\].frames\[0\].points.timestamps: .* does not fit 64 bits"):
        scene.sensors[0].frames[0]


def test_arrays_of_points_have_the_types_of_the_model(open_header):
    known = {
        "colors": np.array([[1, 2, 3], [4, 5, 6]], np.uint8),
        "intensities": np.array([7, 8], np.uint8),
        "camera_index": np.array([0, 255], np.uint8),
    }
    ring, confidence = np.array([9, 300], np.uint16), np.array([0.5, 1.0])
    frame = open_header(swept(**known, ring=ring, confidence=confidence)).sensors[0].frames[0]
    for name, array in {"positions": TWO, **known, "rings": ring}.items():
        np.testing.assert_array_equal(getattr(frame.points, name), array)
    assert frame.points.extras["confidence"].tolist() == [0.5, 1.0]
    assert frame.extras == {"weather": "rain"}
    assert not frame.points.positions.flags.writeable
    # those of strangers are carried along, cut into rows and made of lists
    ring, flat = np.array([1, 2], np.uint8), TWO.reshape(-1)
    header = swept(positions=flat, ring=ring, intensities=[7, 8], colors=[[1, 2, 3], [4, 5, 6]])
    points = open_header(header).sensors[0].frames[0].points
    assert points.rings is None
    assert points.extras["ring"].tolist() == [1, 2]
    np.testing.assert_array_equal(points.positions, TWO)
    assert points.intensities.dtype == np.uint8
    assert points.colors.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_items_without_dtype_get_the_fields_own_and_arrays_at_odd_addresses_come_out_aligned(tmp_path, encode_sfs):
    path = tmp_path / "raw.sfs"
    path.write_bytes(encode_sfs(swept(timestamps=np.array([5, 6], np.uint32)), dtype=None, shape=None))
    points = FORMAT.open(path).sensors[0].frames[0].points
    np.testing.assert_array_equal(points.positions, TWO)
    assert points.timestamps_ns.tolist() == [5000, 6000]
    text = (
        b'{"version":"1.0","sensors":[{"id":1,"type":"points","points":{"positions":""}}],"$items":'
        b'[{"keys":["sensors",0,"points","positions"],"offset":5,"length":24,"dtype":"float32","shape":[2,3]}]}'
    )
    path = tmp_path / "odd.sfs"
    path.write_bytes(text.ljust(-len(text) % 4 + len(text)) + bytes(5) + TWO.tobytes())
    positions = FORMAT.open(path).sensors[0].positions
    assert positions.flags.aligned
    np.testing.assert_array_equal(positions, TWO)


def test_nothing_but_the_header_is_read_at_open_and_arrays_outlive_the_scene(open_header):
    with open_header(make.scene(make.lidar())) as scene:
        frames = scene.sensors[0].frames
        positions = frames[0].points.positions
    assert len(frames) == 1
    assert positions.sum() == 6.0
    with pytest.raises(DataError, match=r"sensors\[0\].frames\[0\]: the scene is closed"):
        frames[0]


def test_points_are_where_coordinates_name_unless_stated_and_a_single_pose_of_the_ego_or_many_frames_holds_for_ever(
    open_header,
):
    for given, option, expected in (
        (None, None, "world"), ("world", None, "world"), ("ego", None, "ego"), ("ego", "sensor", "sensor"),
    ):  # fmt: skip
        scene = open_header(make.scene(make.lidar(coordinates=given)), points_frame=option)
        sensor = scene.sensors[0]
        assert (sensor.points_frame, sensor.coordinates) == (expected, given or "world")
        assert ("points-frame" in codes(scene)) is (option is None)

    def read(**fields):
        scene = open_header(make.scene(make.lidar(**fields), time_offset=1))
        return scene.sensors[0].poses, codes(scene)

    assert read(coordinates="ego")[0].static
    rows = np.array([[0, 0, 0, 0, 0, 0, 1], [1.5, 0, 0, 0, 0, 0.6, 0.8]])
    for values in (rows, rows.tolist()):
        poses, _ = read(poses={"timestamps": [0, 100], "values": values})
        assert (poses.timestamps_ns.tolist(), poses.static) == ([1000, 101_000], False)
        np.testing.assert_array_equal(np.hstack([poses.positions, poses.quaternions_xyzw]), rows)
    assert not read()[0].static
    poses, found = read(frames=[{"timestamp": timestamp, "points": {"positions": TWO}} for timestamp in (0, 9)])
    assert poses.static
    assert "single-pose" in found
    poses, found = read(poses=None)
    assert poses is None
    assert "no-poses" in found


def test_sensors_of_every_type_are_read_and_ids_keep_their_type(open_header):
    points = {"positions": TWO, "directions": TWO, "lengths": np.array([1, 2], np.float32)}
    radar = make.lidar(id="radar", type="radar", frames=[{"timestamp": 0, "points": points}])
    chart = {"id": 5, "type": "points", "parent_id": "radar", "points": {"positions": TWO, "colors": None}}
    sonar = {"id": "s", "type": "sonar", "depths": TWO, "frames": [{"timestamp": 7, "pings": [1, "a"]}], "poses": "?"}
    scene = open_header(make.scene(radar, chart, sonar, make.lidar(id=1), make.lidar(id="1")))
    kinds = (sc.RadarSensor, sc.PointsSensor, sc.PlainSensor, sc.LidarSensor, sc.LidarSensor)
    assert tuple(map(type, scene.sensors)) == kinds
    assert scene.sensors[0].frames[0].points.lengths.tolist() == [1, 2]
    assert scene.sensor(5).parent_id == "radar"
    fields = dict(scene.sensors[2].fields)
    np.testing.assert_array_equal(fields.pop("depths"), TWO)
    assert (scene.sensors[2].type, fields["poses"]) == ("sonar", "?")
    assert fields["frames"] == [{"timestamp": 7000, "pings": [1, "a"]}]
    assert [scene.sensors.index(scene.sensor(name)) for name in (1, "1")] == [3, 4]
    # odometry is a sensor and a trajectory
    poses = {"timestamps": [0, 5], "values": [[0, 0, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 0, 1]]}
    for name in ("odometry", "gps", "odometer"):
        scene = open_header(make.scene({"id": "car", "type": name, "poses": poses}))
        assert isinstance(scene.sensors[0], sc.OdometrySensor)
        assert scene.trajectories["car"].positions.tolist() == [[0, 0, 0], [1, 0, 0]]
        assert ("sensor-alias" in codes(scene)) is (name != "odometry")


def test_annotations_of_unknown_types_stay_as_they_are_with_times_in_nanoseconds(open_header):
    path = {"timestamps": [3], "values": [[0.5, 1.5]]}
    unknown = {"id": 5, "type": "future", "path": path, "start": "soon", "depth": {"timestamps": [9]}}
    thing = {"id": "o", "type": "event", "label": "car"}
    scene = open_header(make.scene(annotations=[unknown, thing], time_offset=1))
    annotation, without_start = scene.annotations
    assert isinstance(annotation, sc.PlainAnnotation)
    fields = {**unknown, "path": {"timestamps": [4000], "values": [[0.5, 1.5]]}}
    assert annotation.fields == {name: fields[name] for name in ("path", "start", "depth")}
    assert without_start.type == "object"
    assert "event-is-object" in codes(scene)


def test_how_angles_are_meant_is_recorded_and_asked_about(open_header):
    cuboid = {"id": 1, "type": "cuboid", "path": {"timestamps": [0], "values": [[1.0] * 9]}}
    assumed = open_header(make.scene(annotations=[cuboid]))
    assert assumed.metadata["sceneloom"] == {"euler_unit": "degrees", "euler_order": "xyz"}
    assert {"euler-unit", "euler-order"} <= set(codes(assumed))
    stated = open_header(make.scene(annotations=[cuboid]), euler_unit="radians", euler_order="zyx")
    assert stated.metadata["sceneloom"] == {"euler_unit": "radians", "euler_order": "zyx"}
    assert stated.warnings == ()
    assert open_header(make.scene()).metadata == {}
    # options that cannot be followed are refused, and none states nothing
    wrong = {"euler_unit": "grad", "euler_order": "rpy", "points_frame": "camera", "altitude": "msl"}
    for name, value in (*wrong.items(), ("tangential", "euler")):
        problem = "tangential 'euler'; expected one of opencv, brown" if name == "tangential" else name
        with pytest.raises(OptionError, match=problem):
            open_header(make.scene(), **{name: value})
    assert open_header(make.scene(), points_frame=None, altitude=None).sensors == ()


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
def test_camera_models_of_every_model_open(open_header, model, params, tangential, expected):
    found = open_header(make.scene(camera(model, params)), tangential=tangential).cameras[0].camera
    assert (found.model, found.coefficients) == expected
    assert (found.fx, found.fy, found.cx, found.cy, found.width, found.height) == (100, 101.5, 3.5, 2, 8, 6)


def test_coefficients_that_are_too_few_are_noticed_too_many_refused_and_unknown_ones_not_computed_with(open_header):
    assert "short-distortion" in codes(open_header(make.scene(camera("brown_conrady", [0.1]))))
    assert "5 numbers; fisheye has 4" in refused(open_header, make.scene(camera("fisheye", [0.1] * 5))).problem
    found = open_header(make.scene(camera("from_the_future", [9]))).cameras[0].camera
    with pytest.raises(CalibrationError, match="from_the_future"):
        project(found, np.ones((1, 3)))


def test_terms_are_exchanged_once_however_often_a_scene_is_written_and_read(open_header, target):
    scene = open_header(make.scene(camera("brown_conrady", BROWN)), tangential="brown")
    assert scene.metadata["sceneloom"]["tangential"] == "opencv"
    assert scene.metadata["sceneloom"]["tangential_before"] == "brown"
    write_scene(scene, target)
    for stated in (None, "opencv", "brown"):
        again = FORMAT.open(target, tangential=stated)
        assert again.cameras[0].camera.coefficients[2:4] == (0.004, 0.003)
        assert ("tangential-recorded" in codes(again)) is (stated == "brown")


def test_computing_with_a_camera_model_whose_formula_nothing_confirms_needs_an_option_that_stands_in_the_output(
    open_header, target, tmp_path
):
    numbers = [0.0, 100.0, 0.0, 0.0, 0.0]
    for model in ("ftheta", "fisheye_radial_custom"):
        scene = open_header(make.scene(camera(model, numbers)))
        assert (scene.cameras[0].camera.model, assumed_models(scene)) == (model, ())
        with pytest.raises(CalibrationError, match=rf"sensors\[c\].camera: '{model}' .* use `--assume-model`"):
            check_camera_models(scene)
        check_camera_models(scene, [])
    jpeg = np.frombuffer(encode_jpeg(np.zeros((6, 8, 3), np.uint8)), np.uint8)
    images = [{"timestamp": 0, "content": jpeg}]
    header = make.scene(camera("ftheta", numbers, images=images, coordinates="ego"))
    convert = partial(convert_camera_models, model="fisheye")
    for compute in (align, undistort_scene, convert, partial(write_any, path=tmp_path / "drive")):
        with pytest.raises(CalibrationError, match="assume-model"):
            compute(open_header(header))
    assert not (tmp_path / "drive").exists()
    scene = open_header(header, assume_model=True)
    assert scene.metadata["sceneloom"]["assumed_models"] == ["ftheta"]
    write_scene(scene, target)
    for asked in (scene, FORMAT.open(target)):
        check_camera_models(asked)
        assert codes(asked).count("assumed-model") == 1
    in_vain = open_header(make.scene(camera("fisheye", [0.1, 0, 0, 0])), assume_model=True)
    assert "assumed-model" not in codes(in_vain)
    assert assumed_models(in_vain) == ()


def lidar(**fields):
    return make.scene(make.lidar(**fields))


def annotated(**fields):
    return make.scene(annotations=[{"id": 1, **fields}])


def poses(timestamps, values):
    return lidar(poses={"timestamps": timestamps, "values": values})


POSE = [0, 0, 0, 0, 0, 0, 1]
PATH = {"timestamps": [0], "values": [[1.0] * 9]}
FRAME, POINTS = "sensors[0].frames[0]", "sensors[0].frames[0].points"
ANOTHER = "another pose than the other one at 1000 ns; expected one pose for each time"


@pytest.mark.parametrize(
    ("header", "location", "problem"),
    [
        (make.scene(version="2.0"), "version", "'2.0'; expected 1.0* or 5.1*"),
        (make.scene(version=None), "version", "None; expected"),
        (make.scene(time_unit="seconds"), "time_unit", "'seconds'; expected one of"),
        (make.scene(time_unit=5), "time_unit", "5; expected one of"),
        (make.scene(time_offset="now"), "time_offset", "'now'"),
        (make.scene(time_offset=2**70), "time_offset", "292 years"),
        (make.scene(metadata=[1]), "metadata", "expected an object"),
        (make.scene(metadata={"sceneloom": 5}), "metadata.sceneloom", "5; expected an object"),
        (make.scene(sensors={}), "sensors", "expected a list"),
        (make.scene(annotations=5), "annotations", "expected a list"),
        (make.scene(attributes=5), "attributes", "5; expected a list of objects"),
        (make.scene(sensors=[5]), "sensors[0].type", "None; expected one of points, lidar"),
        (lidar(id=None), "sensors[0].id", "missing; expected an id"),
        (lidar(id=1.5), "sensors[0].id", "1.5; expected an id"),
        (lidar(id=True), "sensors[0].id", "True; expected an id"),
        (lidar(frames=5), "sensors[0].frames", "5; expected a list of objects"),
        (lidar(frames=[5]), FRAME, "5; expected an object"),
        (lidar(frames=[{"points": {"positions": TWO}}]), f"{FRAME}.timestamp", "missing"),
        (lidar(frames=[{"timestamp": "0", "points": {"positions": TWO}}]), f"{FRAME}.timestamp", "'0'"),
        (lidar(frames=[{"timestamp": 0}]), POINTS, "missing; expected an object"),
        (swept(positions=None), f"{POINTS}.positions", "missing"),
        (swept(positions=TWO.astype("f8")), f"{POINTS}.positions ($items[0])", "an array of float64; expected float32"),
        (swept(positions=TWO.T), f"{POINTS}.positions ($items[0])", "shape (3, 2); expected (N, 3)"),
        (swept(intensities=np.zeros(3, np.uint8)), f"{POINTS}.intensities ($items[1])", "3 values for 2 points"),
        (swept(timestamps=np.zeros(2)), f"{POINTS}.timestamps ($items[1])", "float64; expected uint32 or uint64"),
        (lidar(coordinates="map"), "sensors[0].coordinates", "'map'; expected one of world, ego"),
        (poses([0], [[1, 2]]), "sensors[0].poses", "expected rows of 7 numbers"),
        (poses([0, 1], [POSE]), "sensors[0].poses", "2 timestamps"),
        (poses([1, 1], [POSE, [1, *POSE[1:]]]), "sensors[0].poses.values[0]", ANOTHER),
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
def test_a_fault_is_refused_with_its_location(open_header, header, location, problem):
    error = refused(open_header, header)
    assert error.location == location
    assert problem in error.problem


def test_an_error_reports_the_locations_of_further_faults_and_lenient_reading_leaves_them_out_with_a_warning(
    open_header,
):
    error = refused(open_header, make.scene(make.lidar(id=None, frames=None), version="9"))
    assert error.location == "version"
    assert error.problem.endswith("; also at fault: sensors[0].id, sensors[0].frames")
    many = refused(open_header, make.scene(*(make.lidar(id=None) for _ in range(7))))
    assert many.problem.endswith("sensors[4].id and 2 more; `sceneloom validate FILE` lists all")
    assert "'top' is used twice" in refused(open_header, make.scene(make.lidar(), make.lidar())).problem
    header = make.scene(make.lidar(id=None), make.lidar(), annotations=[{"id": 1}, {"id": 2, "type": "group"}])
    scene = open_header(header, lenient=True)
    assert ([s.id for s in scene.sensors], [a.id for a in scene.annotations]) == (["top"], [2])
    left_out = [warning.message for warning in scene.warnings if warning.code == "at-fault"]
    assert left_out[0].startswith("left out: sensors[0].id: missing")
    assert left_out[1].startswith("left out: annotations[0].type")


TIMESTAMPS = np.array([1_000_000_000, 1_100_000_000], np.int64)


@pytest.fixture
def drive(tmp_path):
    """Write a scene file with a lidar in ego coordinates and odometry sensors that are 100 m apart."""

    def make(odometries, parent_id=None):
        rows = np.random.default_rng(1).normal(0, 5, (50, 3)).astype(np.float32)
        frames = sc.LazyFrames.of(
            [sc.LidarFrame(int(t), sc.LidarPoints(rows)) for t in TIMESTAMPS], TIMESTAMPS.tolist()
        )
        ego = {"coordinates": sc.Coordinates.EGO, "points_frame": sc.PointsFrame.EGO}
        lidar = sc.LidarSensor("top", frames, poses=sc.Poses.identity(), parent_id=parent_id, **ego)
        ends, still = [[[0.0, 100.0 * k, 0.0], [1.0, 100.0 * k, 0.0]] for k in range(2)], np.eye(4)[[3, 3]]
        paths = [sc.Poses(TIMESTAMPS, np.array(positions), still) for positions in ends[:odometries]]
        trajectories = [sc.OdometrySensor(f"odometry{k}", path) for k, path in enumerate(paths)]
        write_scene(sc.Scene((lidar, *trajectories)), tmp_path / "drive.sfs")
        return tmp_path / "drive.sfs"

    return make


@pytest.mark.parametrize(
    ("odometries", "target", "options"),
    [
        (0, "clouds", {"to": "pcd", "frame": "world"}),
        (2, "clouds", {"to": "pcd", "frame": "world"}),
        # points that stay in the ego's frame need no trajectory of it
        (2, "clouds", {"to": "ply"}),
        (2, "nuscenes", {"to": "nuscenes"}),
        (2, "kitti", {"to": "kitti-odometry"}),
        (2, "drive.mcap", {}),
        (2, "drive.json", {"to": "openlabel"}),
        (2, "recording", {"to": "recording"}),
    ],
)
def test_what_needs_the_ego_refuses_where_it_is_not_clear(drive, tmp_path, odometries, target, options):
    path = drive(odometries)
    with pytest.raises(PoseError, match="'top' is in ego coordinates"):
        sceneloom.convert(path, tmp_path / target, **options)
    with open_scene(path) as scene, pytest.raises(PoseError, match="'top' is in ego coordinates"):
        sceneloom.fuse(scene, output=tmp_path / "fused.sfs")


def test_the_parent_says_which_odometry_sensor_is_meant_else_validate_says_what_is_wrong(drive, tmp_path):
    for odometries, rule in ((0, "ego-odometry"), (2, "ego-odometry-unique")):
        path = drive(odometries)
        with open_scene(path) as scene:
            assert len(scene.lidars[0].frames[0].points) == 50
        assert {f.rule for f in sceneloom.validate(path).findings if f.severity == "error"} == {rule}
        path.unlink()
    path = drive(2, parent_id="odometry1")
    assert not [f for f in sceneloom.validate(path).findings if f.severity == "error"]
    sceneloom.convert(path, tmp_path / "copy.sfs")
    with open_scene(tmp_path / "copy.sfs") as scene:
        assert scene.lidars[0].parent_id == "odometry1"
    with pytest.raises(PoseError, match="ego coordinates of odometry sensor 'odometry1'"):
        sceneloom.convert(path, tmp_path / "drive.mcap")
