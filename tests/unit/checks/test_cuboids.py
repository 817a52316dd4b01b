"""Rules about cuboids (sizes, motion, angles, points in them), the frame of points, and what is around a lidar."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.checks import validate
from sceneloom.checks.cuboids import CUBOID_RULES
from sceneloom.geometry.rigid import RigidTransform, matrix_from_quaternion
from sceneloom.simulate import CameraSpec, Faults, LidarSpec, SensorFaults, SolidStateSpec, TrafficSpec, simulate_street

TIMES = np.arange(5, dtype=np.int64) * 100_000_000


def rows(count=5, **columns):
    """A car at 15 m/s that rotates slowly."""
    values = np.tile([4.0, 2, 1.5, 0, 0, 0, 0, 0, 170], (count, 1))
    values[:, 3] = 1.5 * np.arange(count)
    values[:, 8] += 4.0 * np.arange(count)
    for name, column in columns.items():
        values[:, {"height": 2, "yaw": 8}[name]] = column
    return values


def scene_of(sound, values, times=TIMES, metadata=None, **fields):
    shift = np.array([0, 0, 0, 500.0, 0, 0, 0, 0, 90])
    around = [sc.CuboidAnnotation(k, sc.CuboidPath(TIMES, rows() + k * shift)) for k in (1, 2)]
    middle = sc.CuboidAnnotation("middle", sc.CuboidPath(times, values), **fields)
    return sound.scene(around[0], middle, around[1], metadata=metadata or {})


def changed(row, column, value, count=5):
    values = rows(count)
    values[row, column] = value
    return values


def test_sizes_and_motion(check, keeps, sound, found, fixed):
    rules = [rule for rule in CUBOID_RULES if "angles" not in rule.id and "heading" not in rule.id]
    assert keeps(scene_of(sound, rows()), rules)
    assert keeps(scene_of(sound, np.zeros((0, 9)), TIMES[:0]), rules)
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
        ("cuboid-size-changes", rows(height=[0.2, 0.2, 0.6, 0.6, 0.6]), TIMES, ""),  # small things double
        (jump, changed(2, 4, 10.0), TIMES * 10, ""),  # far apart in time
        (jump, changed(1, 3, 11.9, count=2), TIMES[:2], ""),  # within reach
        (jump, changed(2, 4, 6.0), TIMES, "2]: 6.0 m off the trajectory between the keyframes before and"),
        (jump, changed(1, 3, 12.1, count=2), TIMES[:2], "1]: 12.1 m from the keyframe before, in 0.100 s"),
        ("cuboid-rotation", rows(yaw=[170, 175, -180, -175, 530]), TIMES, ""),  # full circle of numbers
        ("cuboid-rotation", changed(2, 8, 350.0), TIMES * 7, ""),  # slow rotation
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
    forward, times = orientation.apply([1.0, 0, 0]), TIMES[:4]
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


@pytest.mark.parametrize("reading", [DEGREES, ("radians", "xyz"), ("degrees", "zyx"), ("radians", "zxy")])
@pytest.mark.parametrize("tilted", [False, True])
def test_the_right_reading_is_left_alone(found, reading, tilted):
    scene = drive(reading, reading, tilted=tilted)
    assert (found(scene, BY_MOTION), found(scene, BY_POINTS)) == ([], [])


READ_XYZ, READ_ZYX = ("read as {} in the order " + order for order in ("xyz", "zyx"))


@pytest.mark.parametrize(
    ("options", "by_motion", "by_points"),
    [
        ({"stated": ("radians", "xyz")}, READ_XYZ.format("degrees"), READ_XYZ.format("degrees")),
        (
            {"written": ("radians", "zyx"), "stated": ("degrees", "zyx")},
            READ_ZYX.format("radians"),
            READ_ZYX.format("radians"),
        ),
        ({"written": ("degrees", "zyx"), "tilted": True}, None, READ_ZYX.format("degrees")),
        ({"written": ("degrees", "zyx")}, "", ""),
        ({"stated": ("radians", "xyz"), "speed": 0.0}, "", READ_XYZ.format("degrees")),
        ({"stated": ("radians", "xyz"), "points": False}, READ_XYZ.format("degrees"), ""),
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
                assert expected in message
                assert "read as {} in the order {}".format(*options.get("stated", DEGREES)) in message


def test_where_nothing_is_stated_the_evidence_is_reported(found):
    message = "taken to be degrees"
    assumed = sc.DataWarning(kind=sc.WarningKind.ASSUMED, code="euler-unit", location="annotations", message=message)
    assert found(drive(), UNSAID) == []
    [(path, message)] = found(replace(drive(), warnings=(assumed,)), UNSAID)
    assert path == "annotations"
    assert message.startswith("not stated; taken to be degrees in the order xyz: headings are 0° off the motion")
    [(_, message)] = found(replace(drive(speed=0.0, points=False), warnings=(assumed,)), UNSAID)
    assert message.endswith("neither motion nor points in the boxes show it")


PERIOD = 100_000_000
RULE = "points-in-another-frame"
FRAME_TIMES = np.arange(8, dtype=np.int64) * PERIOD
EGO_FROM_LIDAR = RigidTransform.from_quaternion(np.array([1.0, 0.5, 1.8]), np.array([0, 0, np.sin(0.6), np.cos(0.6)]))


def trajectory(speed=10.0, start=(0.0, 0.0), yaw_rate=0.3):
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


def swept(path, frame):
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
    path = path or trajectory()
    mount = sc.Poses(np.zeros(1, np.int64), EGO_FROM_LIDAR.translation[None], EGO_FROM_LIDAR.quaternion_xyzw[None])
    lidar = sc.LidarSensor("top", swept(path, real), mount, coordinates=sc.Coordinates.EGO, points_frame=stated)
    return sound.scene(lidar, sc.OdometrySensor("ego", path))


@pytest.mark.parametrize("stated", sc.PointsFrame)
@pytest.mark.parametrize("real", sc.PointsFrame)
def test_points_in_another_frame_are_reported_by_what_meets(sound, found, stated, real):
    hits = found(pole_drive(sound, stated, real), RULE)
    assert [path for path, _ in hits] == ["sensors[0].frames[].points"] * (stated != real)
    for _, message in hits:
        assert f"taken as {real.value} coordinates" in message
        assert message.endswith(f"stated is {stated.value}")
        assert "meet points of another frame" in message


def test_points_far_from_their_sensor_are_reported_without_any_motion_and_those_of_radars(sound, found):
    still = trajectory(speed=0.0, start=(500.0, 300.0), yaw_rate=0.0)
    [(_, message)] = found(pole_drive(sound, sc.PointsFrame.WORLD, sc.PointsFrame.SENSOR, still), RULE)
    assert message.startswith("taken as world coordinates half of the points lie more than 58")
    assert found(pole_drive(sound, sc.PointsFrame.WORLD, sc.PointsFrame.WORLD, still), RULE) == []
    near_origin = trajectory(speed=0.0, yaw_rate=0.0)
    for stated in sc.PointsFrame:
        assert found(pole_drive(sound, stated, sc.PointsFrame.SENSOR, near_origin), RULE) == []
    # a lidar without a known location is left alone
    assert found(sound.scene(sc.LidarSensor("top", swept(trajectory(), sc.PointsFrame.WORLD))), RULE) == []
    path = trajectory(start=(500.0, 300.0))
    sweeps = swept(path, sc.PointsFrame.SENSOR)
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


def rotated(sensor, *degrees, **options):
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
    assert found(rotated("camera0", 45.0, 0.0, 0.0), UPRIGHT) == []


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
    "broken",
    [
        lambda scene: with_points(scene, lambda p: p * [1, -1, 1]),  # left-handed
        lambda scene: with_points(scene, lambda p: p * 1000),  # millimetres
        lambda scene: with_cuboids(scene, lambda rows: rows * [1, 1, 1, 1, -1, 1, 1, 1, 1]),  # y the other way
        lambda scene: with_cuboids(scene, lambda rows: rows + 2.5 * (np.arange(9) == 5)),  # too high
        lambda scene: with_mounts(scene, sc.LidarSensor, RigidTransform.inverse),
        lambda scene: replace(scene, annotations=street(99, cameras=()).annotations),
        lambda scene: rotated("lidar", 0.0, 0.0, 10.0, cameras=()),
    ],
)
def test_cuboids_that_hold_no_points_are_reported(found, sound_drive, broken):
    ((location, message),) = found(broken(sound_drive), CUBOIDS)
    assert location == "annotations"
    assert "hold a point" in message


@pytest.mark.parametrize(
    "broken",
    [
        lambda scene: with_mounts(scene, sc.CameraSensor, RigidTransform.inverse),
        lambda scene: with_mounts(scene, sc.CameraSensor, lambda mount: replace(mount, rotation=np.eye(3))),
        lambda scene: with_quaternions(scene, lambda q: np.ascontiguousarray(np.roll(q, 1, axis=1))),  # w first
    ],
)
def test_images_that_do_not_stand_upright_are_reported(found, sound_drive, broken):
    ((location, message),) = found(broken(sound_drive), UPRIGHT)
    (number,) = (k for k, s in enumerate(sound_drive.sensors) if isinstance(s, sc.CameraSensor))
    assert location == f"sensors[{number}]"
    assert "° off" in message
