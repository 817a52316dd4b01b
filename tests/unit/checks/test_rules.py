"""Rules over sensors, poses, times, points, images, annotations and cuboids; `s0` and `a0` are the first of a scene."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.unit.checks.conftest import film

from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.checks import validate
from sceneloom.checks.cuboids import CUBOID_RULES
from sceneloom.checks.images import BOX_RULES, CAMERA_RULES, IMAGE_RULES
from sceneloom.checks.points import LABELLED_POINT_RULES, POINT_RULES
from sceneloom.checks.poses import CORRECTION_RULES, POSE_RULES
from sceneloom.checks.sensors import REFERENCE_RULES, SENSOR_RULES
from sceneloom.checks.shapes import ATTRIBUTE_RULES, SHAPE_RULES
from sceneloom.checks.times import ANNOTATION_TIME_RULES, POINT_TIME_RULES, TIME_RULES
from sceneloom.geometry.rigid import RigidTransform, matrix_from_quaternion, quaternion_from_rotation_vector
from sceneloom.simulate import CameraSpec, Faults, LidarSpec, SensorFaults, SolidStateSpec, TrafficSpec, simulate_street

P, SECOND = 100_000_000, 1_000_000_000
TIMES = np.arange(3, dtype=np.int64) * P
NO_VIDEO = sc.VideoContent(lambda: BytesIO(b"no video at all"), "h264")
MAP = sc.PointsSensor("map", np.ones((5, 3), np.float32))


def cuboid(name="car", times=TIMES[:2], values=None, **fields):
    times = np.asarray(times, np.int64)
    rows = np.tile([4.0, 2, 1.5, 1, 2, 0, 0, 0, 30], (len(times), 1)) if values is None else values
    return sc.CuboidAnnotation(name, sc.CuboidPath(times, rows), **fields)


def drawn(*rows, sensor="front"):
    return sc.Box2DAnnotation("box", sensor, sc.BoxPath(TIMES[: len(rows)], np.array(rows)))


def shape(kind, *outlines, name="s", sensor=None):
    path = sc.VertexPath(TIMES[: len(outlines)], tuple(np.asarray(outline, float) for outline in outlines))
    return sc.ShapeAnnotation(name, kind, path, sensor_id=sensor or ("front" if kind in FLAT_TYPES else None))


def imu(first=0, stop=3, *, times=None, rows=None):
    times = np.arange(first, stop) * P if times is None else np.array(times, np.int64)
    return sc.ImuSensor(
        "imu", {"gyroscope": sc.VectorSamples(times, np.zeros((len(times), 3)) if rows is None else rows)}
    )


FLAT_TYPES = [kind for kind in sc.ShapeType if kind.value.endswith("_2d")]
RNG = np.random.default_rng(1)
BLUE = np.full((24, 32, 3), (10, 20, 200), np.uint8)
BOX, NULL = [1.0, 1, 5, 5], [np.nan] * 4


def camera_with(s, **fields):
    given = {"model": "pinhole", "width": 32, "height": 24, "fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5}
    return s.camera(camera_model=Camera(**{**given, **fields}))


def camera_of(s, *images):
    usual, times = s.camera().camera, s.times(len(images))
    made = [
        sc.CameraImage.of(int(t), usual.resized(rgb.shape[1], rgb.shape[0]), rgb)
        for t, rgb in zip(times, images, strict=True)
    ]
    return sc.CameraSensor("front", usual, sc.LazyFrames.of(made, times), poses=s.path())


def noise(width=32, height=24, most=255):
    return RNG.integers(0, most, (height, width, 3), np.uint8)


def projected(*rows, name="car", confirmed=None, sensor="front", times=TIMES):
    rows = np.array(rows) if rows else None
    times = times if rows is None else TIMES[: len(rows)]
    return cuboid(name, projections=(sc.Projection(sensor, times, rows, confirmed),))


def outlined(*vertices, name="shape"):
    return shape(sc.ShapeType.POLYGON_2D, vertices, name=name)


def test_images_and_boxes_in_them(check, keeps, sound):
    fisheye = Camera("fisheye", 32, 24, 9.0, 9.0, 15.5, 11.5, (0.1, 0.0, 0.0, 0.0))
    assert keeps(sound.scene(sound.camera(), sound.camera(id="fish", camera_model=fisheye)), CAMERA_RULES)
    assert keeps(sound.scene(camera_of(sound, noise(), noise(), noise())), IMAGE_RULES)
    boxes = (
        drawn(BOX, [0, 0, 32, 24]),
        projected(BOX, NULL, confirmed=(True, False)),
        projected(name="other", times=TIMES[:2]),
    )
    assert keeps(sound.scene(*boxes, outlined([0, 0], [32, 0], [16, 24])), BOX_RULES)

    model = "s0.intrinsics.distortion.model: 'spherical'"
    check("camera-model-known", model, camera_with(sound, model="spherical"))
    check("principal-point", "s0.intrinsics.cx", camera_with(sound, cx=40.0))
    check("principal-point", ["s0.intrinsics.cx", "s0.intrinsics.cy"], camera_with(sound, cx=-3.0, cy=24.0))
    check("principal-point", "", camera_with(sound, cx=-0.5, cy=23.5))
    for fx, fy in ((30.0, 50.0), (1.0, 1.0), (5000.0, 5000.0)):
        check("focal-length", "s0.intrinsics", camera_with(sound, fx=fx, fy=fy))
    check("focal-length", "", camera_with(sound, fx=30.0, fy=31.0))
    check("video-count", "s0.video.content", sound.camera(video=NO_VIDEO))
    check("image-size", "s0.images[1]: 64 x 48 px", camera_of(sound, noise(), noise(64, 48), noise(64, 48)))
    # an image of another size that has a camera model of its own
    camera = camera_of(sound, noise(64, 48))
    image = replace(camera.images[0], camera=replace(camera.camera.resized(64, 48), fx=70.0))
    check("image-size", "", replace(camera, images=sc.LazyFrames.of([image], [0])))
    repeated = "s0.images[3]: 2 of 5 images are equal to the one before"
    check("image-repeated", repeated, camera_of(sound, BLUE, noise(), BLUE, BLUE, BLUE.copy()))
    check("image-plain", "s0.images[1]: black, as are 1 more", camera_of(sound, noise(), noise(most=9), BLUE))
    check("image-plain", "s0.images[0]: of one colour, [10, 20, 200]", camera_of(sound, BLUE))

    check("box-not-finite", "a0.path.values[1]", drawn(BOX, NULL))
    # a box outside is not reported to reach beyond, too; unknown cameras and lidars are left to other rules
    check("box-beyond-image", "", drawn(BOX, [50, 5, 4, 4]))
    for sensor in ("gone", "top"):
        check("box-outside-image", "", drawn(BOX, [90, 5, 4, 4], sensor=sensor))
    point = sc.PointProjection("front", TIMES[:2], np.array([[3.0, 3.0], [60.0, 3.0]]))
    hand = sc.PointsAnnotation("hand", (sc.PointPath(TIMES[:2], np.ones((2, 3))),), projections=((point,),))
    outside = outlined([40, 3], [45, 3], [45, 9]), hand, outlined([30, 3], [40, 3], [40, 9], name=2)
    check("box-outside-image", ["a0.path.values[0]", "a1.projections[0][0].points[1]"], *outside)
    check("box-beyond-image", "a2.path.values[0]", *outside)
    confirmed = "a0.projections[0].confirmed[1]: true, yet boxes[1] is null"
    check("null-box-confirmed", confirmed, projected(BOX, NULL, confirmed=(True, True)))
    check("null-box-confirmed", "", projected(BOX, NULL, confirmed=(True, None)))
    for rule, row, near in (
        ("box-not-finite", [np.nan, 1, 2, 2], [0, 1, 2, 2]),
        ("box-not-finite", [np.inf, 1, 2, 2], [0, 1, 2, 2]),
        ("box-negative-size", [5, 5, -1, 2], [5, 5, 0, 2]),
        ("box-without-area", [5, 5, 3, 0], [5, 5, 3, 0.1]),
        ("box-outside-image", [33.5, 5, 4, 4], [32.5, 5, 4, 4]),
        ("box-outside-image", [3, -6, 4, 4.5], [3, -6, 4, 5.5]),
        ("box-beyond-image", [-1.5, 5, 4, 4], [-0.5, 5, 4, 4]),
        ("box-beyond-image", [3, 5, 4, 20.5], [3, 5, 4, 19.5]),
    ):
        check(rule, ["a0.path.values[1]", "a1.projections[0].boxes[1]"], drawn(BOX, row), projected(BOX, row))
        check(rule, "", drawn(BOX, near), projected(BOX, near))


def test_a_video_with_more_or_fewer_images_than_timestamps_is_found(sound, found):
    content, model = film(64, 48, *(sound.times() / 1e9)), Camera("pinhole", 64, 48, 60.0, 60.0, 31.5, 23.5)

    def found_in(count, chosen=None):
        """What is found where the video of six images has so many timestamps."""
        video = sc.VideoContent(lambda: BytesIO(content), "h264", frame_indices=chosen)
        return found(sound.scene(sound.camera(sound.times(count), camera_model=model, video=video)), "video-count")

    assert found_in(6) == found_in(6, (0, 1, 2, 3, 4, 5)) == []
    assert found_in(4) == [("sensors[0].video.timestamps", "4 timestamps; the video has 6 images")]
    assert len(found_in(8)) == len(found_in(6, (0, 6))) == 1
    # what the reader remarked is known by its own rule
    for rule, code in (
        ("video-or-images", "video-and-images"),
        ("distortion-length", "short-distortion"),
        ("point-times-clock", "relative-point-times"),
    ):
        note = sc.DataWarning(kind=sc.WarningKind.ASSUMED, code=code, location="sensors[1]", message="so it was")
        scene = sound.scene(warnings=(note,))
        assert (found(scene, rule), found(scene, "reading-assumed")) == ([("sensors[1]", "so it was")], [])


def locations(count=100):
    """Points around the sensor, none of them at it."""
    angles = np.linspace(0, 6, count)
    return np.column_stack([10 * np.cos(angles), 10 * np.sin(angles), angles]).astype(np.float32)


def lidar_with(sound, **fields):
    """Every sweep has these fields."""

    def sweep(timestamp_ns):
        count = len(fields.get("positions", locations()))
        given = {"positions": locations(), "intensities": np.arange(count) % 256, "timestamps_ns": None, **fields}
        dtypes = {"positions": np.float32, "intensities": np.uint8, "colors": np.uint8, "camera_index": np.uint8}
        made = {k: v if v is None else np.asarray(v, dtypes.get(k)) for k, v in given.items()}
        return sound.sweep(timestamp_ns, **made)

    return sound.lidar(sweep=sweep)


def radar_with(**fields):
    positions = locations(4)
    given = {"directions": positions / np.linalg.norm(positions, axis=1, keepdims=True), "lengths": np.full(4, 150.0)}
    arrays = {name: np.asarray(value, np.float32) for name, value in {**given, **fields}.items()}
    return sc.RadarSensor("radar", sc.LazyFrames.of([sc.RadarFrame(0, sc.RadarPoints(positions, **arrays))], [0]))


def swept(s, *counts):
    left = iter(counts)
    return s.lidar(sweep=lambda t: s.sweep(t, positions=locations(next(left)), intensities=None, timestamps_ns=None))


def marked(point_ids, *frames, name="a", sensor="top", instance=True):
    """Labelled points, the same in several frames, or of a whole sensor."""
    ids = np.asarray(point_ids, np.uint32)
    points = tuple(sc.LabeledPoints(sensor, ids, frame) for frame in frames or (None,))
    return sc.LabeledPointsAnnotation(name, points, is_instance=instance)


def test_labelled_points(check, keeps, sound, found, fixed):
    sound_points = marked([0, 99], 0), marked([1, 2], 0, name="b"), marked([0, 1], 1, name="c")
    whole = marked([599], name="whole"), marked([4], name="map", sensor="map")
    of_class = marked([0, 1, 2], 0, name="class", instance=False)
    assert keeps(sound.scene(sound.lidar(), MAP, *sound_points, of_class, *whole), LABELLED_POINT_RULES)
    ids, unknown = "labeled_points[0].point_ids", (marked([1], 6), marked([1], -1, name="b"))
    unknown += (marked([1], 0, name="c", sensor="map"),)
    frames = [f"a{k}.labeled_points[0].sensor_frame" for k in range(3)]
    check("labelled-frame-unknown", frames, sound.lidar(), MAP, *unknown)
    expected = [
        f"a2.{ids}: point 5; sensor 'map' has 5 points, counted from 0",
        f"a0.{ids}: point 101; frame 0 has 100 points, counted from 0",
        f"a1.{ids}: point 600; sensor 'top' has 600 points, counted from 0",
    ]
    beyond = marked([5, 100, 101], 0), marked([600], name="whole"), marked([5], name="map", sensor="map")
    check("labelled-point-unknown", expected, sound.lidar(), MAP, *beyond)
    twice, rule = f"a1.{ids}: 'b' shares 2 points with 'a'", "point-in-two-instances"
    others = marked([9, 3, 2], 0, name="b"), marked([3], 0, name="c", instance=False)
    check(rule, twice, marked([1, 2, 3], 0), *others)
    check(rule, f"{twice} in 2 frames, first here", marked([1, 3], 0, 1, 2), marked([3, 9], 0, 2, name="b"))
    # a point named twice by one instance belongs to one
    check(rule, "", marked([1], 0, 0), marked([5], 0, name="b"))
    scene = sound.scene(marked([7, 3, 7, 3, 1], 0))
    assert found(scene, "labelled-point-twice") == [(f"annotations[0].{ids}", "2 points named twice in one list")]
    [repaired] = fixed(scene, "labelled-point-twice").annotations
    assert repaired.labeled_points[0].point_ids.tolist() == [7, 3, 1]
    # frames are read only where the caller wants it
    assert found(sound.scene(marked([100], 0)), "labelled-point-unknown", frames=False) == []


def test_points(check, keeps, sound, found):
    coloured = lidar_with(sound, colors=np.arange(300).reshape(100, 3) % 250, camera_index=[0] * 50 + [255] * 50)
    far = sc.PointsSensor("map", np.full((5, 3), 9_999.0, np.float32))
    scene = sound.scene(coloured, sound.camera(), radar_with(), far)
    assert keeps(scene, [rule for rule in POINT_RULES if rule.id != "frame-repeated"])
    frames = [f"s0.frames[{k}].points.positions" for k in range(6)]
    broken, far, near = locations(), locations(), locations()
    broken[[3, 7], 1], far[0, 1], near[:5] = (np.nan, np.inf), -10_001, 0
    expected = [f"{path}: 2 of 100 points have a location" for path in ("s1.points.positions", *frames)]
    check("points-not-finite", expected, lidar_with(sound, positions=broken), sc.PointsSensor("map", broken))
    steps = [f"{path}: coordinates up to 10001 m, where float32 steps by 0.98 mm" for path in frames]
    check("points-far", ["s1.points.positions", *steps], lidar_with(sound, positions=far), sc.PointsSensor("map", far))
    check("points-at-origin", "", lidar_with(sound, positions=near))
    near[5] = 0
    check("points-at-origin", frames, lidar_with(sound, positions=near))
    none = "s0.frames[1]: 2 of 6 frames have no points"
    check("frame-without-points", none, swept(sound, 100, 0, 9, 0, 11, 100))
    few = "s0.frames[2].points: 99 points; the sensor's frames have 1000 in the middle"
    check("point-count-collapses", few, swept(sound, 1000, 1000, 99, 1000, 101, 1000))
    check("point-count-collapses", "", swept(sound, 98, 98, 1, 98, 98, 98))
    again = "s0.frames[2]: 2 of 6 frames have the very points of the one before"
    check("frame-repeated", again, swept(sound, 10, 20, 20, 20, 10, 0))
    check("frame-repeated", "", swept(sound, 10, 0, 0, 10, 20, 10))
    directions = np.vstack([np.eye(3) * 1.009, [0, 0.98, 0]])
    norm = "s0.frames[0].points.directions[3]: length 0.98; expected 1"
    check("radar-direction-norm", norm, radar_with(directions=directions))
    absurd = "s0.frames[0].points.lengths[2]: 151 m/s"
    check("radar-length-absurd", absurd, radar_with(lengths=[0, -150, 151, np.nan]))
    scene = sound.scene(lidar_with(sound, camera_index=[0] * 98 + [1, 254]), sound.camera())
    unknown = "sensors[0].frames[0].points.camera_index", "camera 1; the scene has 1 cameras, counted from 0"
    assert found(scene, "camera-index-unknown")[0] == unknown
    for level, name in ((255, "white"), (0, "black")):
        colors = np.full((100, 3), level)
        alike = f"s0.frames[].points.colors: all 600 points are {name}"
        check("colors-all-alike", alike, lidar_with(sound, colors=colors))
        colors[5, 1] = 100
        check("colors-all-alike", "", lidar_with(sound, colors=colors))
    for intensities, message in (
        (np.zeros(100), "all are 0"),
        (np.full(100, 255), "all are 255"),
        (np.arange(100) % 2, "all are 0 or 1: numbers from 0 to 1 were rounded to integers"),
        (np.arange(100) % 4 * 60, "only 4 levels: 0, 60, 120, 180"),
        (np.arange(100) % 3 + 1, "only 3 levels"),
        (np.r_[np.full(51, 255), np.arange(49)], "51% are 255: they were cut off"),
        (np.arange(100) % 5, None),
        (np.r_[np.full(50, 255), np.arange(50)], None),
        (None, None),
    ):
        expected = f"s0.frames[].points.intensities: {message}" if message else ""
        check("intensity-scale", expected, lidar_with(sound, intensities=intensities))


MOUNT = RigidTransform(np.eye(3), np.zeros(3))
CALIBRATION = sc.CameraCalibration("c", "front", time_offset_ns=5)


def trajectory(s, *, row=0, up=0.0, early_ns=0):
    """A scene with one trajectory, of which the rows from one on are higher, or one is earlier."""
    path = s.path()
    positions, times = path.positions.copy(), path.timestamps_ns.copy()
    positions[row:, 2] += up
    times[row] -= early_ns
    return s.scene(trajectories={"ego": sc.Trajectory("ego", times, positions, path.quaternions_xyzw)})


def rotated(s, degrees, signs=1):
    quaternions = np.tile([0.0, 0, 0, 1], (6, 1))
    quaternions[3] = quaternion_from_rotation_vector(np.array([0, 0, np.radians(degrees)]))
    quaternions[::2] *= signs
    return s.lidar(poses=s.path(quaternions_xyzw=quaternions))


def adjusted(s, *times, name="a"):
    return sc.LocalizationAdjustment(name, s.path(np.array(times)))


def test_poses_and_corrections(check, keeps, sound):
    mounted = sound.lidar(id="mounted", poses=None, mount=MOUNT)
    sensors = sound.lidar(), sound.camera(), mounted, sound.odometry()
    assert keeps(replace(trajectory(sound), sensors=sensors), POSE_RULES)
    check("sensor-placed", "s0.poses", sound.lidar(poses=None))
    check("sensor-placed", "", mounted)
    check("ego-trajectory-known", "trajectories: sensors[0]", mounted)
    check("poses-cover-frames", "s0.frames[7]: 2 of 9 frames", sound.lidar(sound.times(9)))
    check("poses-cover-frames", "", sound.lidar(sound.times(7)))
    # what is off is found at both steps, what jumps for good once
    path = sound.path(sound.times(12))
    aside = path.positions + np.outer(np.arange(12) == 5, [0, 4.0, 0])
    jumps = ["s0.poses.values[5]", "s0.poses.values[6]"]
    check("poses-jump", jumps, sound.lidar(poses=replace(path, positions=aside)))
    check("poses-jump", "trajectories[ego].values[3]", trajectory(sound, row=3, up=40.0))
    # a lidar that brakes and then stands, by fixes with noise
    times = np.arange(200) * P
    along = np.cumsum(np.clip(20 - 8 * times / 1e9, 0, None) * 0.1)
    positions = np.column_stack([along, np.zeros((200, 2))]) + np.random.default_rng(2).normal(0, 0.1, (200, 3))
    check("poses-jump", "", sound.lidar(poses=sound.path(times, positions=positions)))
    check("poses-rotation", "", rotated(sound, 10.0))
    check("poses-rotation", ["s0.poses.values[3]", "s0.poses.values[4]"], rotated(sound, 80.0))
    check("poses-rotation", "", rotated(sound, 0.0, signs=-1))
    check("trajectory-times-increasing", "trajectories[ego][2]", trajectory(sound, row=2, early_ns=P))
    for rule, frame, location in (
        ("ego-points-placed", sc.Coordinates.WORLD, "s0"),
        ("ego-odometry", sc.Coordinates.EGO, "s0.coordinates"),
    ):
        lidar = sound.lidar(coordinates=frame, points_frame=sc.PointsFrame.EGO)
        check(rule, location, lidar)
        check(rule, "", lidar, sound.odometry())
    for parent_id, expected in ((None, "s0.parent_id: 'wheels', 2"), (2, ""), ("2", "s0.parent_id")):
        camera = sound.camera(coordinates=sc.Coordinates.EGO, parent_id=parent_id)
        check("ego-odometry-unique", expected, camera, sound.odometry(id="wheels"), sound.odometry(id=2))

    other = sc.CameraCalibration("d", "back", intrinsics=sound.camera().camera)
    sensors = sound.lidar(), sound.camera(), sound.camera(id="back")
    scene = sound.scene(*sensors, adjusted(sound, P, 4 * P), CALIBRATION, other)
    assert keeps(scene, [rule for rule in CORRECTION_RULES if rule.id != "corrections-not-applied"])
    check("localization-adjustments-several", "a1", adjusted(sound, 0), adjusted(sound, 0, name="b"))
    # it may end a sweep too soon, hold throughout with one pose, and not cover what only the IMU measured
    for times, expected in (((0, 4 * P), ""), ((0, 4 * P - 1), "a0.poses"), ((0,), "")):
        check("localization-adjustment-short", expected, adjusted(sound, *times))
    check("localization-adjustment-short", "", sound.lidar(), imu(-20, 40), adjusted(sound, 0, 5 * P))
    check("camera-calibrations-several", "a1", CALIBRATION, replace(CALIBRATION, id="d"))
    empty = sc.CameraCalibration("c", "front")
    check("camera-calibration-empty", "a0", empty, sc.CameraCalibration("d", "front", sound.path()))
    wide = replace(empty, intrinsics=Camera("pinhole", 64, 48, 60.0, 60.0, 31.5, 23.5))
    check("camera-calibration-size", "a0.intrinsics: 64 x 48 px; the camera's images are 32 x 24 px", wide)


def gnss(latitude=48.0, longitude=11.0, times=(0, 1)):
    unknown = np.full(2, np.nan)
    return sc.GnssSensor(
        "gnss", np.array(times, np.int64), np.array([[latitude, longitude, 500.0]] * 2), unknown, unknown
    )


def test_sensors(check, keeps, sound):
    scene = sound.scene(sound.lidar(), sound.camera(parent_id="top"), sound.odometry(), imu(), gnss())
    assert keeps(scene, SENSOR_RULES)
    check("scene-not-empty", "sensors: neither a sensor nor an annotation nor a trajectory", sc.Scene(()))
    none = sc.PointsSensor("map", np.zeros((0, 3), np.float32)), sc.ImuSensor("imu", {})
    empty = [
        "s0: lidar 'top' has no measurements",
        "s1: camera 'front' has no images",
        "s2: points 'map' has no measurements",
        "s3: imu 'imu' has no measurements",
    ]
    check("sensor-empty", empty, sound.lidar([]), sound.camera([]), *none, sound.odometry())
    # a camera without images that annotations name is used
    check("sensor-empty", "s1", sound.camera([]), sound.lidar([]), drawn(BOX))
    check("sensor-type-known", "s0.type", sc.PlainSensor("x", "thermal", {}))
    alike = "s1.id: '1' beside 1: a number and a text that look alike"
    check("sensor-ids-distinct", alike, sound.lidar(id=1), sound.camera(id="1"))
    check("sensor-parent-known", "s0.parent_id: 'roof'", sound.camera(parent_id="roof"))
    check("sensor-parent-known", "s1.parent_id: 7", sound.lidar(id="7"), sound.camera(parent_id=7))
    cycles = ((0, "'a' in 'b' in 'a'"), (1, "'b' in 'a' in 'b'"), (3, "'d' in 'd'"))
    lidars = [sound.lidar(id=a, parent_id=b) for a, b in ("ab", "ba", "ca", "dd")]
    check("sensor-parent-cycle", [f"s{k}.parent_id: a cycle: {names}" for k, names in cycles], *lidars)
    backwards = ["s0.streams.gyroscope.timestamps_ns[2]", "s1.timestamps_ns[1]"]
    check("sample-times-increasing", backwards, imu(times=(0, 5, 5)), gnss(times=(5, 5)))
    check("samples-finite", "s0.streams.gyroscope.values[1]", imu(rows=np.diag([0, 0, np.inf])[[0, 2, 1]]))
    for location in ((91.0, 0.0), (0.0, -181.0)):
        check("gnss-on-earth", "s0.positions_lla[0]", gnss(*location))


LABELS = ("Traffic Cone", "Traffic Cone", "traffic_cone", "traffic light")
LINKS = (
    sc.LinkAnnotation("l", "car", "gone"),
    sc.LinkAnnotation("m", "car", "car"),
    sc.LinkAnnotation("n", "n", "car"),
)


def keypoints(*sensors, **fields):
    seen = {"projections": (tuple(sc.PointProjection(name, TIMES[:2]) for name in sensors),)} if sensors else {}
    return sc.PointsAnnotation("hand", (sc.PointPath(TIMES[:2], np.ones((2, 3))),), **seen, **fields)


def activated(*sensors):
    return cuboid(activations=tuple(sc.Activation(name, TIMES[:2]) for name in sensors))


def attributed(**fields):
    return keypoints(attributes=(sc.AttributePath("seen", (1,), static=True, **fields),))


def test_what_annotations_refer_to(check, keeps, sound):
    attribute = sc.AttributePath("seen", (1, 2), TIMES[:2], sensor_id="top", point_index=0)
    annotations = (
        cuboid(parent_id="o", label="Car", activations=(sc.Activation("top", TIMES[:2]),)),
        cuboid("second", label="van", projections=(sc.Projection("front", TIMES[:1]),)),
        *(drawn(BOX), marked(range(3), 0), keypoints(attributes=(attribute,))),
        *(sc.ObjectAnnotation("o"), sc.GroupAnnotation("g"), sc.LinkAnnotation("l", "car", "g")),
        sc.ObjectAnnotation("reported", attributes=(sc.AttributePath("colour", ("red",), static=True),)),
        CALIBRATION,
    )
    assert keeps(sound.scene(*annotations), REFERENCE_RULES)
    check("annotation-parent-unknown", "a0.parent_id: 'gone' is no annotation of the scene", cuboid(parent_id="gone"))
    other = "a1.parent_id: there is one '7', which is another id"
    check("annotation-parent-unknown", other, cuboid("7"), cuboid("b", parent_id=7))
    cycle = "a1.parent_id: 'a' in 'b' in 'c' in 'a'; expected no cycle"
    check("annotation-parent-cycle", cycle, *(cuboid(a, parent_id=b) for a, b in ("xa", "ab", "bc", "ca")))
    check("annotation-parent-cycle", "a0.parent_id", cuboid("a", parent_id="a"))
    # two ways to one parent
    check("annotation-parent-cycle", "", cuboid("a", parent_id="c"), cuboid("b", parent_id="c"), cuboid("c"))
    check("link-end-unknown", "a1.to_id", cuboid(), *LINKS)
    check("link-to-itself", ["a2", "a3"], cuboid(), *LINKS)
    check("attribute-point-unknown", "a0.attributes[0].point_index", attributed(point_index=1))
    check("annotation-unused", "a0", sc.ObjectAnnotation("o"), sc.GroupAnnotation("g"), cuboid(parent_id="g"))
    labels = "labels 'Traffic Cone' (2 times), 'traffic_cone' (1 times); expected one spelling, as 'Traffic C"
    check("label-spellings", f"annotations: {labels}", *(cuboid(k, label=label) for k, label in enumerate(LABELS)))

    for annotation, location in (
        (drawn(BOX, sensor="gone"), "sensor_id"),
        (marked(range(3), 0, sensor="gone"), "labeled_points[0].sensor_id"),
        (activated("gone"), "activations[0].sensor_id"),
        (projected(sensor="gone"), "projections[0].sensor_id"),
        (attributed(sensor_id="gone"), "attributes[0].sensor_id"),
        (keypoints("front", "gone"), "projections[0][1].sensor_id"),
    ):
        check("annotation-sensor-unknown", f"a0.{location}", annotation)
    for annotation, location in (
        (drawn(BOX, sensor="top"), "sensor_id"),
        (marked(range(3), 0, sensor="front"), "labeled_points[0].sensor_id"),
        (projected(sensor="top"), "projections[0].sensor_id"),
        (sc.CameraCalibration("c", "top", time_offset_ns=3), "sensor_id"),
        (shape(sc.ShapeType.POINT_2D, np.ones((1, 2)), sensor="top"), "sensor_id"),
        (keypoints("top"), "projections[0][0].sensor_id"),
    ):
        check("annotation-sensor-type", f"a0.{location}", annotation)
    # activations and shapes in space may be of any sensor that sees
    check(
        "annotation-sensor-type", "", shape(sc.ShapeType.POLYLINE, np.eye(3), sensor="top"), activated("front", "top")
    )
    expected = "a0.activations[0].sensor_id: 'ego' is an odometry; expected a lidar, a radar or a camera"
    check("annotation-sensor-type", expected, sound.lidar(), sound.odometry(), activated("ego"))


SQUARE = np.array([[0.0, 0], [4, 0], [4, 4], [0, 4]])
NOTCHED = np.array([[0.0, 0], [4, 0], [2, 1.9], [4, 4], [0, 4]])
TILT = matrix_from_quaternion(np.array([0.3, -0.5, 0.2, 0.8]) / np.linalg.norm([0.3, -0.5, 0.2, 0.8]))


def lifted(outline, heights=0.0, kind=sc.ShapeType.POLYGON):
    """An outline in a tilted plane far from the origin, its vertices that far off the plane [m]."""
    flat = np.column_stack([outline, np.broadcast_to(heights, len(outline))])
    return shape(kind, flat @ TILT.T + [100.0, 50.0, 7.0])


def points(**fields):
    paths = tuple(sc.PointPath(TIMES[:2], np.ones((2, 3)), id=k) for k in range(2))
    return sc.PointsAnnotation("hand", **{"paths": paths, **fields})


def holder(*attributes):
    return sc.ObjectAnnotation("o", attributes=attributes)


def test_shapes_and_named_points(check, keeps, sound):
    for annotation in (
        shape(sc.ShapeType.POLYGON_2D, SQUARE, SQUARE + 1),
        lifted(SQUARE),
        shape(sc.ShapeType.POINT, [[1, 2, 3]]),
        shape(sc.ShapeType.POLYLINE, [[0, 0, 0], [1, 1, 1]]),
        points(labels=("tip", "root"), projections=((), ())),
    ):
        assert keeps(sound.scene(annotation), SHAPE_RULES)
    for kind in sc.ShapeType:
        least = {"polygon": 3, "polyline": 2, "point": 1}[kind.value.split("_")[0]]
        vertices = np.random.default_rng(0).normal(size=(least, 2 if kind in FLAT_TYPES else 3))
        check("shape-vertices", "a0.path.values[0]", shape(kind, vertices[:-1]))
        check("shape-vertices", "", shape(kind, vertices))
    check(
        "point-of-several", "a0.path.values[0]: 2 vertices; a point has one", shape(sc.ShapeType.POINT, np.eye(3)[:2])
    )
    lost = sc.PointsAnnotation("other", (sc.PointPath(TIMES[:2], np.array([[1.0, 1, 1], [np.inf, 1, 1]])),))
    torn = shape(sc.ShapeType.POLYGON_2D, SQUARE, [[0, 0], [4, np.nan], [4, 4]])
    check("shape-not-finite", ["a0.path.values[1]", "a1.paths[0].values[1]"], torn, lost)
    fewer = shape(sc.ShapeType.POLYGON_2D, SQUARE, SQUARE[:3])
    check("vertex-count-changes", "a0.path.values[1]: 3 vertices after 4", fewer)
    wide = sc.PointPath(TIMES[:2], np.ones((2, 6)), id=9)
    uneven = points(labels=("tip",), projections=((),), paths=(wide, *points().paths))
    check("points-annotation-counts", ["a0.labels", "a0.projections", "a0.paths[0].values"], uneven)
    named = tuple(sc.PointPath(TIMES[:2], np.ones((2, 3)), id=name) for name in ("a", 1, "1", "a", None, None))
    check("points-annotation-ids", "a0.paths[3].id: 'a' is the id of paths[0], too", points(paths=named))
    # only plain polygons in space have to be flat
    check("polygon-not-flat", "", lifted(SQUARE, [0, 3, 0, 3], sc.ShapeType.POLYGON_TOPDOWN))
    # the plane of a square whose corners go up and down alternately goes through the middle: each is off by the
    # same; the polygon is as large as its diagonal
    for size, limit in ((1.0, 0.02), (10.0, 0.1)):
        outline, up_and_down = (SQUARE - 2) / 4 * size / np.sqrt(2), np.array([1, -1, 1, -1]) * limit
        check("polygon-not-flat", "a0.path.values[0]", lifted(outline, up_and_down * 1.05))
        check("polygon-not-flat", "", lifted(outline, up_and_down * 0.95))


def crosses(outline):
    """Whether any two edges meet, by the parameters of their meeting point."""
    count = len(outline)
    for i in range(count):
        for j in range(i + 2, count - (i == 0)):
            a, b = outline[i], outline[(i + 1) % count]
            c, d = outline[j], outline[(j + 1) % count]
            s, t = np.linalg.solve(np.column_stack([b - a, c - d]), c - a)
            if 0 < s < 1 and 0 < t < 1:
                return True
    return False


def test_edges_that_cross_are_found_and_a_notch_is_not(check):
    def heighten(outline):
        return np.column_stack([outline, np.arange(len(outline))])

    for made in (
        lifted,
        lambda outline: shape(sc.ShapeType.POLYGON_2D, outline),
        lambda outline: shape(sc.ShapeType.POLYGON_TOPDOWN, heighten(outline)),
    ):
        check("polygon-crosses-itself", "a0.path.values[0]", made(SQUARE[[0, 2, 1, 3]]))
        for outline in (NOTCHED, NOTCHED[::-1], np.vstack([NOTCHED, NOTCHED[:1]])):
            check("polygon-crosses-itself", "", made(outline))
    rng = np.random.default_rng(3)
    for outline in rng.uniform(0, 10, (20, 5, 2)):
        check("polygon-crosses-itself", "a0.path.values[0]" * crosses(outline), shape(sc.ShapeType.POLYGON_2D, outline))


def test_attributes(check, keeps, sound, fixed):
    attributes = (
        sc.AttributePath("colour", ("red",), static=True),
        sc.AttributePath("state", ("parked", "moving"), TIMES[:2]),
        sc.AttributePath("speed", (1, 2.5), TIMES[:2]),
        sc.AttributePath("lights", (("left", "brake"), ()), TIMES[:2]),
    )
    assert keeps(sound.scene(holder(*attributes), attributes=attributes), ATTRIBUTE_RULES)
    mixed = "a0.attributes[0].values: 'lane' is a number and text alternately"
    check("attribute-kinds-mixed", mixed, holder(sc.AttributePath("lane", (1, "2"), TIMES[:2])))
    untimed = [
        "a0.attributes[0]: 'state' has 2 values and no timestamps",
        "a0.attributes[1]: 'state' has 2 timestamps and 1 values",
    ]
    states = sc.AttributePath("state", ("parked", "moving")), sc.AttributePath("state", ("parked",), TIMES[:2])
    check("attribute-times", untimed, holder(*states))
    for value in (True, None, {"a": 1}, ("a", 1)):
        attribute = sc.AttributePath("state", ("parked", value), TIMES[:2])
        wrong = ["attributes[0].values[1]", "a0.attributes[0].values[1]"]
        check("attribute-value-type", wrong, sound.scene(holder(attribute), attributes=(attribute,)))
    changing = sc.AttributePath("colour", ("red", "blue"), TIMES[:2], static=True)
    scene = sound.scene(holder(changing, sc.AttributePath("make", ("vw", "vw"), TIMES[:2], static=True)))
    check("attribute-static-changes", "a0.attributes[0].values[1]", scene)
    check("attribute-static-repeats", "a0.attributes[1]", scene)
    [repaired] = fixed(scene, "attribute-static-repeats").annotations
    assert repaired.attributes[0] is changing
    assert (repaired.attributes[1].values, repaired.attributes[1].timestamps_ns.tolist()) == (("vw",), [0])


EPOCH_NS, WRAP_NS = 1_700_000_000 * SECOND, 2**32 * 1000


def late_lidar(s, start_ns, **fields):
    return s.lidar(start_ns + s.times(), poses=s.path(start_ns + s.times()), **fields)


def timed(s, shift, start_ns=20 * SECOND):
    """A lidar whose point times are changed by `shift(times, frame's timestamp)`."""

    def sweep(timestamp_ns):
        times = s.sweep(timestamp_ns).points.timestamps_ns
        return s.sweep(timestamp_ns, timestamps_ns=np.asarray(shift(times, timestamp_ns), np.int64))

    return late_lidar(s, start_ns, sweep=sweep)


def test_times_of_frames(check, keeps, sound, found, fixed):
    assert keeps(sound.scene(sound.lidar(), sound.camera(fps=10.0), sound.odometry()), TIME_RULES)
    check("frame-times-increasing", f"s0.frames[2]: {P} ns after {2 * P} ns", sound.lidar([0, 2 * P, P, P, 3 * P]))
    backwards = sound.camera([P, 0], video=NO_VIDEO)
    check("frame-times-increasing", "", backwards)
    check("video-times-increasing", "s0.images[1]", backwards)
    check("video-times-increasing", "", sound.camera([P, 0]))
    twice = [f"s0.frames[{k}]: {t} ns, as frame {k - 3}; expected a time of its own" for k, t in ((3, 0), (4, P))]
    check("frame-times-unique", twice, sound.lidar([0, P, 2 * P, 0, P]))
    fast = "s0.frames: 200.0 frames a second; expected at most 100"
    check("frame-rate", fast, sound.lidar(np.arange(5) * (SECOND // 200)))
    check("frame-rate", "s0.images: endlessly many", sound.camera([0, 0]))
    check("frame-rate", "", sound.lidar(np.arange(5) * (SECOND // 100)))
    check("frame-gaps", "s0.frames[3]: 2 seem missing", sound.lidar(np.delete(np.arange(10) * P, [4, 5])))
    check("frame-doubled", "s0.frames[4]", sound.lidar(np.sort([*range(0, 10 * P, P), 3 * P + P // 50])))
    jitter = np.random.default_rng(1).uniform(-0.3, 0.3, 40) * P
    check("frame-jitter", "s0.frames", sound.lidar(np.arange(40) * P + jitter))
    check("frame-jitter", "", sound.lidar(np.arange(40) * P + jitter / 20))
    for fps, wrong in ((10.0, False), (10.4, False), (30.0, True), (5.0, True)):
        assert bool(found(sound.scene(sound.camera(fps=fps)), "video-fps")) is wrong
    # frames are sorted with their contents
    repaired = fixed(sound.scene(sound.lidar([P, 0]), sound.camera([P, 2 * P, 0])), "frame-times-increasing")
    check("frame-times-increasing", "", repaired)
    lidar, camera = repaired.sensors
    assert lidar.frames.timestamps_ns.tolist() == [0, P] == [f.timestamp_ns for f in lidar.frames]
    assert [image.timestamp_ns for image in camera.images] == [0, P, 2 * P]
    for left in (sound.scene(), sound.scene(backwards)):
        assert fixed(left, "frame-times-increasing") is left


def test_timestamps_far_from_the_clocks_zero_get_an_offset(check, sound, fixed):
    for start_ns, rule in ((EPOCH_NS, "epoch-times"), (5_000 * SECOND, "late-start")):
        scene = sound.scene(late_lidar(sound, start_ns), format="sfs")
        check(rule, f"time_offset: {start_ns // SECOND}", scene)
        repaired = fixed(scene, rule)
        assert (repaired.time_offset_ns, repaired.sensors) == (start_ns, scene.sensors)
        check(rule, "", repaired)
    check("epoch-times", "", sound.scene(late_lidar(sound, EPOCH_NS), format="sfs", time_offset_ns=EPOCH_NS))
    check("epoch-times", "", sound.scene(late_lidar(sound, EPOCH_NS), format="recording"))
    check("late-start", "", sound.scene(format="sfs"))


def test_times_of_points(check, keeps, sound, found):
    none = {"positions": np.zeros((0, 3), np.float32), "intensities": np.zeros(0, np.uint8)}
    empty = sound.lidar(id="empty", sweep=lambda t: sound.sweep(t, **none, timestamps_ns=np.zeros(0, np.int64)))
    bare = sound.lidar(id="bare", sweep=lambda t: sound.sweep(t, timestamps_ns=None))
    assert keeps(sound.scene(timed(sound, lambda times, _: times), bare, empty), POINT_TIME_RULES)
    # a microsecond of rounding is no fault
    check("point-times-frame", "", timed(sound, lambda times, _: times - 900))
    first = "frames[0].points.timestamps"
    before = f"s0.{first}: 55 of 100 points lie before their frame, by up to 0.050000 s"
    check("point-times-frame", before, timed(sound, lambda times, _: times - P // 2))
    late = timed(sound, lambda times, _: times + 2 * P)
    assert "beyond the end of the next sweep" in found(sound.scene(late), "point-times-frame")[0][1]
    alike = timed(sound, lambda times, timestamp: np.full(100, timestamp))
    check("point-times-equal", f"s1.{first}: all 100 are {20 * SECOND} ns", sound.lidar(id="good"), alike)
    for shift, start_s, what in (
        (lambda times, timestamp: times - timestamp, 20, "count from the frame's own timestamp"),
        (lambda times, _: times * 1000, 2000, "are 1000 times too large"),
        (lambda times, _: times // 1000, 2000, "are 1000 times too small"),
        (lambda times, _: times + 3600 * SECOND, 20, "on another clock"),
        (lambda times, _: times - WRAP_NS, 20 + WRAP_NS / SECOND, "1 times 2^32 µs"),
    ):
        scene = sound.scene(timed(sound, shift, round(start_s * SECOND)))
        check("point-times-clock", f"s0.{first}: {what}", scene)
        assert validate(scene, rules=["point-times-clock"]).counts["warning"] == 6


def test_times_of_annotations(check, keeps, sound, fixed):
    projection = sc.Projection("front", TIMES, np.tile([1.0, 1, 5, 5], (3, 1)), (True, None, False))
    car = cuboid(times=TIMES, projections=(projection,), activations=(sc.Activation("top", TIMES, (0, 5, 1.5)),))
    scene = sound.scene(car, sc.EventAnnotation("e", P, 2 * P), sc.EventAnnotation("moment", 6 * P))
    assert keeps(scene, ANNOTATION_TIME_RULES)
    increasing = "annotation-times-increasing"
    beyond, outside = "annotation-beyond-scene", "annotation-outside-scene"
    for times, reported in (([0, 0, P], "0 ns after 0 ns"), ([P, 0, 2 * P], f"0 ns after {P} ns")):
        check(increasing, f"a1.path.timestamps[1]: {reported}", cuboid(), cuboid("b", times))
    # the first time of a path may be before the last one of the path before, also with an empty path between them
    between = cuboid(times=[P]), cuboid("b", []), cuboid("c", [0])
    check(increasing, "", cuboid(times=[P, 2 * P]), cuboid("b", [0, P]))
    check(increasing, "", *between)
    check("annotation-path-empty", "a1.path", *between)
    check("annotation-path-empty", "a0.paths", sc.PointsAnnotation("hand", ()))
    # one sweep beyond the sensors is allowed, a second makes what lies outside as a whole another rule's
    for times, is_beyond, is_outside in (
        ([0, 6 * P], "", ""),
        ([0, 6 * P + 1], "[1]: after the scene ends", ""),
        ([16 * P, 20 * P], "[1]", ""),
        ([16 * P + 1, 20 * P], "", "a0.path.timestamps"),
    ):
        check(beyond, is_beyond and f"a0.path.timestamps{is_beyond}", cuboid(times=times))
        check(outside, is_outside, cuboid(times=times))
    check(outside, "", cuboid(times=[-90 * P, 90 * P]))
    # poses of corrections, and what holds always
    poses = sc.Poses(np.array([-SECOND, SECOND]), np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)))
    check(beyond, "", sc.LocalizationAdjustment("drift", poses))
    for rule in (outside, beyond):
        check(rule, "", cuboid(times=[90 * P], stationary=True))
    colour = sc.AttributePath("colour", ("red",), np.array([90 * P]), static=True)
    check(beyond, "", cuboid(times=TIMES, attributes=(colour,)))
    early = sc.EventAnnotation("early", -19 * P, 2 * P), sc.EventAnnotation("reaching in", -19 * P, 19 * P)
    check(outside, "a0.start", *early)
    check("annotation-duration", "a0.duration", sc.EventAnnotation("backwards", P, -1))
    activation = sc.Activation("top", TIMES, (0, -1, 3))
    check("annotation-duration", "a0.activations[0].durations[1]", cuboid(times=TIMES, activations=(activation,)))
    seen = sc.Projection("front", np.array([0, P + P // 4, P + P // 4 + 1, 5 * P]))
    check("projection-without-image", "a0.projections[0].timestamps[2]", cuboid(times=TIMES, projections=(seen,)))

    # sorting takes values and vertices along, and drops rows reported twice
    rows = np.arange(36.0).reshape(4, 9)
    rows[3] = rows[0]
    attribute = sc.AttributePath("state", ("b", "a"), np.array([P, 0]))
    projection = sc.Projection("front", np.array([P, 0]), np.array([[1.0] * 4, [np.nan] * 4]), (True, None))
    car = cuboid(times=[P, 0, 2 * P, P], values=rows, attributes=(attribute,), projections=(projection,))
    outlines = sc.VertexPath(np.array([P, 0]), (np.full((3, 2), 2.0), np.full((4, 2), 1.0)))
    flat = sc.ShapeAnnotation("s", sc.ShapeType.POLYGON_2D, outlines, sensor_id="front")
    car, flat = fixed(sound.scene(car, flat), increasing).annotations
    assert car.path.timestamps_ns.tolist() == [0, P, 2 * P]
    np.testing.assert_array_equal(car.path.values, rows[[1, 0, 2]])
    assert (car.attributes[0].values, car.projections[0].confirmed) == (("a", "b"), (None, True))
    np.testing.assert_array_equal(car.projections[0].boxes[1], [1.0] * 4)
    assert [len(vertices) for vertices in flat.path.vertices] == [4, 3]
    # two different rows of one time are left to a person
    scene = sound.scene(cuboid(times=[0, 0], values=np.arange(18.0).reshape(2, 9)))
    assert fixed(scene, increasing) is scene


KEYFRAMES = np.arange(5, dtype=np.int64) * P


def rows(count=5, **columns):
    """A car at 15 m/s that rotates slowly."""
    values = np.tile([4.0, 2, 1.5, 0, 0, 0, 0, 0, 170], (count, 1))
    values[:, 3] = 1.5 * np.arange(count)
    values[:, 8] += 4.0 * np.arange(count)
    for name, column in columns.items():
        values[:, {"height": 2, "yaw": 8}[name]] = column
    return values


def scene_of(sound, values, times=KEYFRAMES, metadata=None, **fields):
    shift = np.array([0, 0, 0, 500.0, 0, 0, 0, 0, 90])
    around = [sc.CuboidAnnotation(k, sc.CuboidPath(KEYFRAMES, rows() + k * shift)) for k in (1, 2)]
    middle = sc.CuboidAnnotation("middle", sc.CuboidPath(times, values), **fields)
    return sound.scene(around[0], middle, around[1], metadata=metadata or {})


def changed(row, column, value, count=5):
    values = rows(count)
    values[row, column] = value
    return values


def test_sizes_and_motion(check, keeps, sound, found, fixed):
    rules = [rule for rule in CUBOID_RULES if "angles" not in rule.id and "heading" not in rule.id]
    assert keeps(scene_of(sound, rows()), rules)
    assert keeps(scene_of(sound, np.zeros((0, 9)), KEYFRAMES[:0]), rules)
    for rule, column, value, near in (
        ("cuboid-not-finite", 8, np.nan, 1e300),
        ("cuboid-not-finite", 3, np.inf, 0.0),
        ("cuboid-negative-size", 0, -4.0, 4.0),
        ("cuboid-no-size", 2, 0.0, 1e-9),
        ("cuboid-size-absurd", 0, 100.1, 100.0),
        ("cuboid-size-absurd", 1, 0.009, 0.01),
        ("cuboid-size-changes", 0, 8.1, 7.9),
        ("cuboid-size-changes", 1, 0.9, 1.1),
        ("cuboid-jump", 4, 2.2, 2.0),
        ("cuboid-rotation", 8, 174.0 + 101, 174.0 + 99),
    ):
        assert found(scene_of(sound, changed(2, column, value)), rule)[0][0] == "annotations[1].path.values[2]"
        check(rule, "", scene_of(sound, changed(2, column, near)))
    jump = "cuboid-jump"
    for rule, values, times, expected in (
        ("cuboid-size-changes", rows(height=[0.2, 0.2, 0.6, 0.6, 0.6]), KEYFRAMES, ""),  # small things double
        (jump, changed(2, 4, 10.0), KEYFRAMES * 10, ""),  # far apart in time
        (jump, changed(1, 3, 11.9, count=2), KEYFRAMES[:2], ""),  # within reach
        (jump, changed(2, 4, 6.0), KEYFRAMES, "2]: 6.0 m off the trajectory between the keyframes before and"),
        (jump, changed(1, 3, 12.1, count=2), KEYFRAMES[:2], "1]: 12.1 m from the keyframe before, in 0.100 s"),
        ("cuboid-rotation", rows(yaw=[170, 175, -180, -175, 530]), KEYFRAMES, ""),  # full circle of numbers
        ("cuboid-rotation", changed(2, 8, 350.0), KEYFRAMES * 7, ""),  # slow rotation
    ):
        check(rule, expected and f"a1.path.values[{expected}", scene_of(sound, values, times))
    radians = {"sceneloom": {"euler_unit": "radians", "euler_order": "xyz"}}
    scene = scene_of(sound, rows(yaw=[3.0, 3.1, -3.1, -3.0, 0.0]), metadata=radians)
    alone = replace(scene, annotations=scene.annotations[1:2])
    check("cuboid-rotation", "a0.path.values[4]: rotated by 172°", alone)
    still = rows()
    still[:, 3:6] = np.linspace(0, 0.5, 5)[:, None]
    moving = [len(found(scene_of(sound, v, stationary=True), "cuboid-stationary-moves")) for v in (rows(), still)]
    assert moving == [1, 0]
    # negative lengths become positive, and nothing else changes
    values = rows()
    values[1, :3] *= [-1, 1, -1]
    scene = scene_of(sound, values)
    repaired = fixed(scene, "cuboid-negative-size")
    np.testing.assert_array_equal(repaired.annotations[1].path.values, rows())
    assert repaired.annotations[0] is scene.annotations[0]


SIZE = np.array([4.5, 1.8, 1.5])
BY_MOTION, BY_POINTS, UNSAID = "cuboid-heading-off-motion", "cuboid-angles-off-points", "cuboid-angles-unsaid"
DEGREES = ("degrees", "xyz")


def drive(written=DEGREES, stated=DEGREES, *, tilted=False, speed=10.0, points=True):
    """Objects that move along their x axis; points on their faces, seen by a lidar whose points are in the world."""
    count, (unit, order) = 24, written
    tilt = 40 * np.sin(np.arange(count)) if tilted else np.zeros(count)
    yaw = np.linspace(-170, 175, count)
    orientation = Rotation.from_euler("ZYX", np.column_stack([yaw, tilt, -0.7 * tilt]), degrees=True)
    # roll, pitch and yaw of the product of matrices in an order, by scipy's intrinsic rotations
    in_order = orientation.as_euler(order.upper(), degrees=unit == "degrees")
    angles = np.column_stack([in_order[:, order.index(axis)] for axis in "xyz"])
    forward, times = orientation.apply([1.0, 0, 0]), KEYFRAMES[:4]
    start = np.column_stack([*np.divmod(np.arange(count), 6)[::-1], np.zeros(count)]) * 12.0
    annotations = []
    for k in range(count):
        centers = start[k] + speed * (times / 1e9)[:, None] * forward[k]
        values = np.hstack([np.tile(SIZE, (4, 1)), centers, np.tile(angles[k], (4, 1))])
        annotations.append(sc.CuboidAnnotation(k, sc.CuboidPath(times, values), label="car"))
    rng = np.random.default_rng(0)
    frames = []
    for time_ns in times:
        centers = start + speed * time_ns / 1e9 * forward
        inside = rng.uniform(-0.49, 0.49, (count, 60, 3)) * SIZE
        cloud = np.concatenate([o.apply(p) + c for o, p, c in zip(orientation, inside, centers, strict=True)])
        frames.append(
            sc.LidarFrame(int(time_ns), sc.LidarPoints(cloud[: len(cloud) if points else 0].astype(np.float32)))
        )
    lidar = sc.LidarSensor("top", sc.LazyFrames.of(frames, times), points_frame=sc.PointsFrame.WORLD)
    ours = {"euler_unit": stated[0], "euler_order": stated[1]}
    return sc.Scene((lidar,), tuple(annotations), metadata={"sceneloom": ours})


READ, OTHER_ORDER, RADIANS = "read as {} in the order {}".format, ("degrees", "zyx"), ("radians", "xyz")
RIGHT = ({"written": reading, "stated": reading} for reading in (DEGREES, RADIANS, OTHER_ORDER, ("radians", "zxy")))


@pytest.mark.parametrize(
    ("options", "by_motion", "by_points"),
    [
        *(({**right, "tilted": tilted}, "", "") for right in RIGHT for tilted in (False, True)),
        ({"stated": RADIANS}, READ(*DEGREES), READ(*DEGREES)),
        ({"written": ("radians", "zyx"), "stated": OTHER_ORDER}, READ("radians", "zyx"), READ("radians", "zyx")),
        ({"written": OTHER_ORDER, "tilted": True}, None, READ(*OTHER_ORDER)),
        ({"written": OTHER_ORDER}, "", ""),
        ({"stated": RADIANS, "speed": 0.0}, "", READ(*DEGREES)),
        ({"stated": RADIANS, "points": False}, READ(*DEGREES), ""),
        ({"speed": -10.0}, "", ""),
    ],
)
def test_what_motion_and_points_show(found, options, by_motion, by_points):
    scene = drive(**options)
    for rule, expected in ((BY_MOTION, by_motion), (BY_POINTS, by_points)):
        findings = found(scene, rule)
        if expected is not None:
            assert [path for path, _ in findings] == ["annotations"] * bool(expected)
            for _, message in findings:
                assert (expected in message, READ(*options.get("stated", DEGREES)) in message) == (True, True)


def test_where_nothing_is_stated_the_evidence_is_reported(found):
    message = "taken to be degrees"
    assumed = sc.DataWarning(kind=sc.WarningKind.ASSUMED, code="euler-unit", location="annotations", message=message)
    assert found(drive(), UNSAID) == []
    [(path, message)] = found(replace(drive(), warnings=(assumed,)), UNSAID)
    assert path == "annotations"
    assert message.startswith("not stated; taken to be degrees in the order xyz: headings are 0° off the motion")
    [(_, message)] = found(replace(drive(speed=0.0, points=False), warnings=(assumed,)), UNSAID)
    assert message.endswith("neither motion nor points in the boxes show it")


RULE = "points-in-another-frame"
FRAME_TIMES = np.arange(8, dtype=np.int64) * P
EGO_FROM_LIDAR = RigidTransform.from_quaternion(np.array([1.0, 0.5, 1.8]), np.array([0, 0, np.sin(0.6), np.cos(0.6)]))


def circling(speed=10.0, start=(0.0, 0.0), yaw_rate=0.3):
    """The ego trajectory: at constant speed, rotating."""
    seconds = FRAME_TIMES / 1e9
    positions = np.column_stack([start[0] + speed * seconds, np.full(8, start[1]), np.zeros(8)])
    half = yaw_rate * seconds / 2
    quaternions = np.column_stack([np.zeros(8), np.zeros(8), np.sin(half), np.cos(half)])
    return sc.Poses(FRAME_TIMES, positions, quaternions)


def poles():
    """400 poles of 3 m in a square of 160 m, with ground between them, (N, 3) [m]."""
    rng = np.random.default_rng(2)
    feet = rng.uniform(-80, 80, (400, 2))
    heights = np.linspace(0, 3, 16)
    shafts = np.column_stack([np.repeat(feet, 16, axis=0), np.tile(heights, 400)])
    ground = np.column_stack([rng.uniform(-80, 80, (4_000, 2)), np.zeros(4_000)])
    return np.vstack([shafts, ground])


def seen_sweeps(path, frame):
    """The points within 50 m of the lidar at each time, in a frame, as sweeps."""
    world, found = poles(), []
    for k in range(len(FRAME_TIMES)):
        world_from_ego = RigidTransform(matrix_from_quaternion(path.quaternions_xyzw[k]), path.positions[k])
        locations = {
            sc.PointsFrame.WORLD: RigidTransform.identity(),
            sc.PointsFrame.EGO: world_from_ego,
            sc.PointsFrame.SENSOR: world_from_ego @ EGO_FROM_LIDAR,
        }
        near = world + np.append(path.positions[0, :2], 0.0)
        near = near[np.linalg.norm(near - path.positions[k], axis=1) < 50]
        points = locations[frame].inverse().apply(near).astype(np.float32)
        found.append(sc.LidarFrame(int(FRAME_TIMES[k]), sc.LidarPoints(points)))
    return sc.LazyFrames.of(found, FRAME_TIMES)


def pole_drive(sound, stated, real, path=None):
    """A lidar mounted on an ego, its points stated to be in one frame and really in another."""
    path = path or circling()
    mount = sc.Poses(np.zeros(1, np.int64), EGO_FROM_LIDAR.translation[None], EGO_FROM_LIDAR.quaternion_xyzw[None])
    lidar = sc.LidarSensor("top", seen_sweeps(path, real), mount, coordinates=sc.Coordinates.EGO, points_frame=stated)
    return sound.scene(lidar, sc.OdometrySensor("ego", path))


@pytest.mark.parametrize("stated", sc.PointsFrame)
@pytest.mark.parametrize("real", sc.PointsFrame)
def test_points_in_another_frame_are_reported_by_what_meets(sound, found, stated, real):
    hits = found(pole_drive(sound, stated, real), RULE)
    assert [path for path, _ in hits] == ["sensors[0].frames[].points"] * (stated != real)
    for _, message in hits:
        for text in (f"taken as {real.value} coordinates", "meet points of another frame"):
            assert text in message
        assert message.endswith(f"stated is {stated.value}")


def test_points_far_from_their_sensor_are_reported_without_any_motion_and_those_of_radars(sound, found):
    still = circling(speed=0.0, start=(500.0, 300.0), yaw_rate=0.0)
    [(_, message)] = found(pole_drive(sound, sc.PointsFrame.WORLD, sc.PointsFrame.SENSOR, still), RULE)
    assert message.startswith("taken as world coordinates half of the points lie more than 58")
    assert found(pole_drive(sound, sc.PointsFrame.WORLD, sc.PointsFrame.WORLD, still), RULE) == []
    near_origin = circling(speed=0.0, yaw_rate=0.0)
    for stated in sc.PointsFrame:
        assert found(pole_drive(sound, stated, sc.PointsFrame.SENSOR, near_origin), RULE) == []
    # a lidar without a known location is left alone
    assert found(sound.scene(sc.LidarSensor("top", seen_sweeps(circling(), sc.PointsFrame.WORLD))), RULE) == []
    path = circling(start=(500.0, 300.0))
    sweeps = seen_sweeps(path, sc.PointsFrame.SENSOR)
    cycles = [sc.RadarFrame(sweep.timestamp_ns, sc.RadarPoints(sweep.points.positions[:50])) for sweep in sweeps]
    for stated, hits in ((sc.PointsFrame.WORLD, 1), (sc.PointsFrame.SENSOR, 0)):
        radar = sc.RadarSensor("radar", sc.LazyFrames.of(cycles, FRAME_TIMES), path, points_frame=stated)
        assert len(found(sound.scene(radar), RULE)) == hits


GROUND, CUBOIDS, UPRIGHT = "ground-above-sensor", "cuboids-off-points", "camera-not-upright"
RULES = (GROUND, CUBOIDS, UPRIGHT)
LIDAR = LidarSpec(beams=32, steps=900)
CAMERA = CameraSpec(Camera("pinhole", 48, 32, 40.0, 40.0, 23.5, 15.5))


def street(seed=21, **options):
    given = {"frames": 6, "lidar": LIDAR, "cameras": (CAMERA,), "traffic": TrafficSpec()}
    return simulate_street(seed, **{**given, **options}).scene


def with_sensors(scene, kind, change):
    return replace(scene, sensors=tuple(change(s) if isinstance(s, kind) else s for s in scene.sensors))


@pytest.fixture(scope="module")
def sound_drive():
    """A pole_drive with its sweeps simulated once for all."""

    def swept(lidar):
        return replace(lidar, frames=sc.LazyFrames(lidar.frames.timestamps_ns, list(lidar.frames).__getitem__))

    return with_sensors(street(), sc.LidarSensor, swept)


def with_points(scene, change):
    def moved(frame):
        positions = np.ascontiguousarray(change(frame.points.positions), np.float32)
        return replace(frame, points=replace(frame.points, positions=positions))

    def remade(lidar):
        frames = lidar.frames
        return replace(lidar, frames=sc.LazyFrames(frames.timestamps_ns, lambda k: moved(frames[k])))

    return with_sensors(scene, sc.LidarSensor, remade)


def with_cuboids(scene, change):
    cuboids = (
        replace(a, path=replace(a.path, values=change(a.path.values.copy())))
        if isinstance(a, sc.CuboidAnnotation)
        else a
        for a in scene.annotations
    )
    return replace(scene, annotations=tuple(cuboids))


def with_mounts(scene, kind, change):
    return with_sensors(scene, kind, lambda sensor: replace(sensor, mount=change(sensor.mount)))


def with_quaternions(scene, change):
    paths = scene.trajectories.items()
    return replace(scene, trajectories={k: replace(p, quaternions_xyzw=change(p.quaternions_xyzw)) for k, p in paths})


def misaligned(sensor, *degrees, **options):
    """A pole_drive in which a sensor is mounted another way than is stated."""
    faults = Faults(sensors={sensor: SensorFaults(rotation_deg=degrees)})
    return street(faults=faults, **options)


def test_a_sound_drive_and_one_whose_frames_nothing_locates_are_left_alone(found, sound_drive):
    lost = with_sensors(replace(sound_drive, trajectories={}), sc.LidarSensor, lambda s: replace(s, poses=None))
    assert [found(scene, rule) for rule in RULES for scene in (sound_drive, lost)] == [[]] * 6
    # of a lidar whose z is down the ground is above: the roof is 1.8 m up, a sheet is reported to a quarter of a metre
    ((location, message),) = found(with_points(sound_drive, lambda p: p * [1, -1, -1]), GROUND)
    assert location.endswith(".frames[].points")
    assert float(message.split(" m above")[0].split()[-1]) == pytest.approx(1.8, abs=0.3)
    # a camera that looks up a little stands upright
    assert found(misaligned("camera0", 45.0, 0.0, 0.0), UPRIGHT) == []


@pytest.mark.parametrize(
    "options",
    [
        {"traffic": TrafficSpec(cars=6, pedestrians=20, cyclists=10)},
        {"lidar": SolidStateSpec()},
        {"lidar": replace(LIDAR, beams=8, steps=360)},
    ],
)
@pytest.mark.few(1)
def test_crowds_and_lidars_that_see_little_are_left_alone(options):
    assert validate(street(**options, cameras=()), rules=[GROUND, CUBOIDS]).findings == ()


@pytest.mark.parametrize(
    ("rule", "broken"),
    [
        (CUBOIDS, lambda scene: with_points(scene, lambda p: p * [1, -1, 1])),  # left-handed
        (CUBOIDS, lambda scene: with_points(scene, lambda p: p * 1000)),  # millimetres
        (CUBOIDS, lambda scene: with_cuboids(scene, lambda rows: rows * np.where(np.arange(9) == 4, -1, 1))),  # -y
        (CUBOIDS, lambda scene: with_cuboids(scene, lambda rows: rows + 2.5 * (np.arange(9) == 5))),  # too high
        (CUBOIDS, lambda scene: with_mounts(scene, sc.LidarSensor, RigidTransform.inverse)),
        (CUBOIDS, lambda scene: replace(scene, annotations=street(99, cameras=()).annotations)),
        (CUBOIDS, lambda scene: misaligned("lidar", 0.0, 0.0, 10.0, cameras=())),
        (UPRIGHT, lambda scene: with_mounts(scene, sc.CameraSensor, RigidTransform.inverse)),
        (UPRIGHT, lambda scene: with_mounts(scene, sc.CameraSensor, lambda m: replace(m, rotation=np.eye(3)))),
        (UPRIGHT, lambda scene: with_quaternions(scene, lambda q: np.roll(q, 1, axis=1).copy())),  # w first
    ],
)
def test_cuboids_that_hold_no_points_and_images_that_are_not_upright_are_reported(found, sound_drive, rule, broken):
    ((location, message),) = found(broken(sound_drive), rule)
    (number,) = (k for k, s in enumerate(sound_drive.sensors) if isinstance(s, sc.CameraSensor))
    where, stated = {CUBOIDS: ("annotations", "hold a point"), UPRIGHT: (f"sensors[{number}]", "° off")}[rule]
    assert (location, stated in message) == (where, True)
