"""Rules about the frame of points, on a street of poles whose frame is known, and about what is around a lidar."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.checks import validate
from sceneloom.geometry.rigid import RigidTransform, matrix_from_quaternion
from sceneloom.scene import (
    CameraSensor,
    Coordinates,
    CuboidAnnotation,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    OdometrySensor,
    PointsFrame,
    Poses,
    RadarFrame,
    RadarPoints,
    RadarSensor,
)
from sceneloom.simulate import CameraSpec, Faults, LidarSpec, SensorFaults, SolidStateSpec, TrafficSpec, simulate_street

PERIOD = 100_000_000
RULE = "points-in-another-frame"
TIMES = np.arange(8, dtype=np.int64) * PERIOD
EGO_FROM_LIDAR = RigidTransform.from_quaternion(np.array([1.0, 0.5, 1.8]), np.array([0, 0, np.sin(0.6), np.cos(0.6)]))


def trajectory(speed=10.0, start=(0.0, 0.0), yaw_rate=0.3):
    """The ego trajectory: at constant speed, rotating."""
    seconds = TIMES / 1e9
    positions = np.column_stack([start[0] + speed * seconds, np.full(8, start[1]), np.zeros(8)])
    half = yaw_rate * seconds / 2
    quaternions = np.column_stack([np.zeros(8), np.zeros(8), np.sin(half), np.cos(half)])
    return Poses(TIMES, positions, quaternions)


def poles():
    """400 poles of 3 m in a square of 160 m, with ground between them, (N, 3) [m]."""
    rng = np.random.default_rng(2)
    feet = rng.uniform(-80, 80, (400, 2))
    heights = np.linspace(0, 3, 16)
    shafts = np.column_stack([np.repeat(feet, 16, axis=0), np.tile(heights, 400)])
    ground = np.column_stack([rng.uniform(-80, 80, (4_000, 2)), np.zeros(4_000)])
    return np.vstack([shafts, ground])


def seen(path, frame):
    """The points within 50 m of the lidar at each time, in a frame."""
    world, found = poles(), []
    for k in range(len(TIMES)):
        world_from_ego = RigidTransform(matrix_from_quaternion(path.quaternions_xyzw[k]), path.positions[k])
        locations = {
            PointsFrame.WORLD: RigidTransform.identity(),
            PointsFrame.EGO: world_from_ego,
            PointsFrame.SENSOR: world_from_ego @ EGO_FROM_LIDAR,
        }
        near = world + np.append(path.positions[0, :2], 0.0)
        near = near[np.linalg.norm(near - path.positions[k], axis=1) < 50]
        found.append(locations[frame].inverse().apply(near).astype(np.float32))
    return found


def drive(sound, stated, real, path=None):
    """A lidar mounted on an ego, its points stated to be in one frame and really in another."""
    path = path or trajectory()
    frames = [LidarFrame(int(t), LidarPoints(points)) for t, points in zip(TIMES, seen(path, real), strict=True)]
    mount = Poses(np.zeros(1, np.int64), EGO_FROM_LIDAR.translation[None], EGO_FROM_LIDAR.quaternion_xyzw[None])
    lidar = LidarSensor("top", LazyFrames.of(frames, TIMES), mount, coordinates=Coordinates.EGO, points_frame=stated)
    return sound.scene(lidar, OdometrySensor("ego", path))


@pytest.mark.parametrize("stated", PointsFrame)
@pytest.mark.parametrize("real", PointsFrame)
def test_points_in_another_frame_are_reported_by_what_meets(sound, found, stated, real):
    hits = found(drive(sound, stated, real), RULE)
    assert [path for path, _ in hits] == ["sensors[0].frames[].points"] * (stated != real)
    for _, message in hits:
        assert f"taken as {real.value} coordinates" in message
        assert message.endswith(f"stated is {stated.value}")
        assert "meet points of another frame" in message


def test_points_far_from_their_sensor_are_reported_without_any_motion(sound, found):
    still = trajectory(speed=0.0, start=(500.0, 300.0), yaw_rate=0.0)
    [(_, message)] = found(drive(sound, PointsFrame.WORLD, PointsFrame.SENSOR, still), RULE)
    assert message.startswith("taken as world coordinates half of the points lie more than 58")
    assert found(drive(sound, PointsFrame.WORLD, PointsFrame.WORLD, still), RULE) == []
    near_origin = trajectory(speed=0.0, yaw_rate=0.0)
    for stated in PointsFrame:
        assert found(drive(sound, stated, PointsFrame.SENSOR, near_origin), RULE) == []


def test_a_lidar_without_a_known_location_is_left_alone_and_radars_are_judged_by_distance(sound, found):
    frames = [LidarFrame(t, LidarPoints(p)) for t, p in zip(TIMES.tolist(), seen(trajectory(), "world"), strict=True)]
    assert found(sound.scene(LidarSensor("top", LazyFrames.of(frames, TIMES))), RULE) == []
    path = trajectory(start=(500.0, 300.0))
    clouds = zip(TIMES.tolist(), seen(path, PointsFrame.SENSOR), strict=True)
    frames = [RadarFrame(t, RadarPoints(points[:50])) for t, points in clouds]
    for stated, hits in ((PointsFrame.WORLD, 1), (PointsFrame.SENSOR, 0)):
        radar = RadarSensor("radar", LazyFrames.of(frames, TIMES), path, points_frame=stated)
        assert len(found(sound.scene(radar), RULE)) == hits


GROUND, CUBOIDS, UPRIGHT = "ground-above-sensor", "cuboids-off-points", "camera-not-upright"
RULES = (GROUND, CUBOIDS, UPRIGHT)
LIDAR = LidarSpec(beams=32, steps=900)
CAMERA = CameraSpec(Camera("pinhole", 48, 32, 40.0, 40.0, 23.5, 15.5))


def drive_of_surroundings(seed=21, **options):
    given = {"frames": 6, "lidar": LIDAR, "cameras": (CAMERA,), "traffic": TrafficSpec()}
    return simulate_street(seed, **{**given, **options}).scene


def changed(scene, kind, change):
    return replace(scene, sensors=tuple(change(s) if isinstance(s, kind) else s for s in scene.sensors))


@pytest.fixture(scope="module")
def sound_drive():
    """A drive with its sweeps simulated once for all."""

    def swept(lidar):
        return replace(lidar, frames=LazyFrames(lidar.frames.timestamps_ns, list(lidar.frames).__getitem__))

    return changed(drive_of_surroundings(), LidarSensor, swept)


def with_points(scene, change):
    def moved(frame):
        positions = np.ascontiguousarray(change(frame.points.positions), np.float32)
        return replace(frame, points=replace(frame.points, positions=positions))

    def remade(lidar):
        frames = lidar.frames
        return replace(lidar, frames=LazyFrames(frames.timestamps_ns, lambda k: moved(frames[k])))

    return changed(scene, LidarSensor, remade)


def with_cuboids(scene, change):
    cuboids = (
        replace(a, path=replace(a.path, values=change(a.path.values.copy()))) if isinstance(a, CuboidAnnotation) else a
        for a in scene.annotations
    )
    return replace(scene, annotations=tuple(cuboids))


def with_mounts(scene, kind, change):
    return changed(scene, kind, lambda sensor: replace(sensor, mount=change(sensor.mount)))


def with_quaternions(scene, change):
    paths = scene.trajectories.items()
    return replace(scene, trajectories={k: replace(p, quaternions_xyzw=change(p.quaternions_xyzw)) for k, p in paths})


def rotated(sensor, *degrees, **options):
    """A drive in which a sensor is mounted another way than is stated."""
    faults = Faults(sensors={sensor: SensorFaults(rotation_deg=degrees)})
    return drive_of_surroundings(faults=faults, **options)


def test_a_sound_drive_and_one_whose_frames_nothing_locates_are_left_alone(found, sound_drive):
    lost = changed(replace(sound_drive, trajectories={}), LidarSensor, lambda s: replace(s, poses=None))
    assert [found(scene, rule) for rule in RULES for scene in (sound_drive, lost)] == [[]] * 6


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
    assert validate(drive_of_surroundings(**options, cameras=()), rules=[GROUND, CUBOIDS]).findings == ()


def test_a_lidar_whose_z_is_down_has_the_ground_above_it(found, sound_drive):
    # the roof is about 1.8 m above the ground; a sheet is reported to a quarter of a metre
    ((location, message),) = found(with_points(sound_drive, lambda p: p * [1, -1, -1]), GROUND)
    assert location.endswith(".frames[].points")
    assert float(message.split(" m above")[0].split()[-1]) == pytest.approx(1.8, abs=0.3)


@pytest.mark.parametrize(
    "broken",
    [
        lambda scene: with_points(scene, lambda p: p * [1, -1, 1]),  # left-handed
        lambda scene: with_points(scene, lambda p: p * 1000),  # millimetres
        lambda scene: with_cuboids(scene, lambda rows: rows * [1, 1, 1, 1, -1, 1, 1, 1, 1]),  # y the other way
        lambda scene: with_cuboids(scene, lambda rows: rows + 2.5 * (np.arange(9) == 5)),  # too high
        lambda scene: with_mounts(scene, LidarSensor, RigidTransform.inverse),
        lambda scene: replace(scene, annotations=drive_of_surroundings(99, cameras=()).annotations),
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
        lambda scene: with_mounts(scene, CameraSensor, RigidTransform.inverse),
        lambda scene: with_mounts(scene, CameraSensor, lambda mount: replace(mount, rotation=np.eye(3))),
        lambda scene: with_quaternions(scene, lambda q: np.ascontiguousarray(np.roll(q, 1, axis=1))),  # w first
    ],
)
def test_images_that_do_not_stand_upright_are_reported(found, sound_drive, broken):
    ((location, message),) = found(broken(sound_drive), UPRIGHT)
    (number,) = (k for k, s in enumerate(sound_drive.sensors) if isinstance(s, CameraSensor))
    assert location == f"sensors[{number}]"
    assert "° off" in message


def test_a_camera_that_looks_up_a_little_stands_upright(found):
    assert found(rotated("camera0", 45.0, 0.0, 0.0), UPRIGHT) == []
