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


@pytest.mark.parametrize("frame", PointsFrame)
def test_points_in_the_frame_that_is_stated_are_left_alone(sound, found, frame):
    assert found(drive(sound, frame, frame), RULE) == []


@pytest.mark.parametrize("stated", PointsFrame)
@pytest.mark.parametrize("real", PointsFrame)
def test_points_in_another_frame_are_reported_by_what_meets(sound, found, stated, real):
    if stated == real:
        return
    [(path, message)] = found(drive(sound, stated, real), RULE)
    assert path == "sensors[0].frames[].points"
    assert f"taken as {real.value} coordinates" in message
    assert message.endswith(f"stated is {stated.value}")
    assert "meet points of another frame" in message


def test_points_far_from_their_sensor_are_reported_without_any_motion(sound, found):
    still = trajectory(speed=0.0, start=(500.0, 300.0), yaw_rate=0.0)
    [(_, message)] = found(drive(sound, PointsFrame.WORLD, PointsFrame.SENSOR, still), RULE)
    assert message.startswith("taken as world coordinates half of the points lie more than 58")
    assert found(drive(sound, PointsFrame.WORLD, PointsFrame.WORLD, still), RULE) == []


def test_a_sensor_that_stands_near_the_origin_shows_nothing(sound, found):
    still = trajectory(speed=0.0, yaw_rate=0.0)
    for stated in PointsFrame:
        assert found(drive(sound, stated, PointsFrame.SENSOR, still), RULE) == []


def test_a_lidar_without_a_known_location_is_left_alone(sound, found):
    frames = [
        LidarFrame(int(t), LidarPoints(points)) for t, points in zip(TIMES, seen(trajectory(), "world"), strict=True)
    ]
    assert found(sound.scene(LidarSensor("top", LazyFrames.of(frames, TIMES))), RULE) == []


def test_radars_are_judged_by_distance(sound, found):
    path = trajectory(start=(500.0, 300.0))
    for stated, hits in ((PointsFrame.WORLD, 1), (PointsFrame.SENSOR, 0)):
        clouds = [points[:50] for points in seen(path, PointsFrame.SENSOR)]
        frames = [RadarFrame(int(t), RadarPoints(points)) for t, points in zip(TIMES, clouds, strict=True)]
        radar = RadarSensor("radar", LazyFrames.of(frames, TIMES), path, points_frame=stated)
        assert len(found(sound.scene(radar), RULE)) == hits


GROUND, CUBOIDS, UPRIGHT = "ground-above-sensor", "cuboids-off-points", "camera-not-upright"
RULES = (GROUND, CUBOIDS, UPRIGHT)
LIDAR = LidarSpec(beams=32, steps=900)
CAMERA = CameraSpec(Camera("pinhole", 48, 32, 40.0, 40.0, 23.5, 15.5))


def drive_of_surroundings(**options):
    given = {"frames": 6, "lidar": LIDAR, "cameras": (CAMERA,), "traffic": TrafficSpec()}
    return simulate_street(21, **{**given, **options}).scene


def changed(scene, kind, change):
    """The scene with its sensors of a class changed."""
    return replace(scene, sensors=tuple(change(s) if isinstance(s, kind) else s for s in scene.sensors))


def with_swept(lidar):
    """The lidar with its sweeps simulated once for all."""
    return replace(lidar, frames=LazyFrames(lidar.frames.timestamps_ns, list(lidar.frames).__getitem__))


@pytest.fixture(scope="module")
def sound_drive():
    return changed(drive_of_surroundings(), LidarSensor, with_swept)


def with_points(scene, change):
    def moved(frame):
        positions = np.ascontiguousarray(change(frame.points.positions), np.float32)
        return replace(frame, points=replace(frame.points, positions=positions))

    def remade(lidar):
        frames = lidar.frames
        return replace(lidar, frames=LazyFrames(frames.timestamps_ns, lambda k: moved(frames[k])))

    return changed(scene, LidarSensor, remade)


def with_cuboids(scene, change):
    return replace(
        scene,
        annotations=tuple(
            replace(a, path=replace(a.path, values=change(a.path.values.copy())))
            if isinstance(a, CuboidAnnotation)
            else a
            for a in scene.annotations
        ),
    )


def with_quaternions(scene, change):
    trajectories = {
        name: replace(trajectory, quaternions_xyzw=change(trajectory.quaternions_xyzw))
        for name, trajectory in scene.trajectories.items()
    }
    return replace(scene, trajectories=trajectories)


@pytest.mark.parametrize("rule", RULES)
def test_a_sound_drive_is_left_alone(found, sound_drive, rule):
    assert found(sound_drive, rule) == []


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
        lambda scene: with_points(scene, lambda p: p * [1, -1, 1]),
        lambda scene: with_points(scene, lambda p: p * 1000),
        lambda scene: with_cuboids(scene, lambda rows: rows * [1, 1, 1, 1, -1, 1, 1, 1, 1]),
        lambda scene: with_cuboids(scene, lambda rows: rows + 2.5 * (np.arange(9) == 5)),
        lambda scene: changed(scene, LidarSensor, lambda lidar: replace(lidar, mount=lidar.mount.inverse())),
    ],
    ids=["left-handed", "millimetres", "y the other way", "too high", "mounting the other way"],
)
def test_cuboids_that_hold_no_points_are_reported(found, sound_drive, broken):
    ((location, message),) = found(broken(sound_drive), CUBOIDS)
    assert location == "annotations"
    assert "hold a point" in message


def test_cuboids_of_another_drive_are_reported(found, sound_drive):
    other = simulate_street(99, frames=6, lidar=LIDAR, cameras=(), traffic=TrafficSpec()).scene
    assert len(found(replace(sound_drive, annotations=other.annotations), CUBOIDS)) == 1


def test_a_lidar_that_is_rotated_by_ten_degrees_is_reported(found):
    faults = Faults(sensors={"lidar": SensorFaults(rotation_deg=(0.0, 0.0, 10.0))})
    assert len(found(drive_of_surroundings(faults=faults, cameras=()), CUBOIDS)) == 1


@pytest.mark.parametrize(
    "broken",
    [
        lambda scene: changed(scene, CameraSensor, lambda camera: replace(camera, mount=camera.mount.inverse())),
        lambda scene: changed(
            scene, CameraSensor, lambda camera: replace(camera, mount=replace(camera.mount, rotation=np.eye(3)))
        ),
        lambda scene: with_quaternions(scene, lambda q: np.ascontiguousarray(np.roll(q, 1, axis=1))),
    ],
    ids=["mounting the other way", "axes of a body", "quaternions w first"],
)
def test_images_that_do_not_stand_upright_are_reported(found, sound_drive, broken):
    ((location, message),) = found(broken(sound_drive), UPRIGHT)
    (number,) = (k for k, s in enumerate(sound_drive.sensors) if isinstance(s, CameraSensor))
    assert location == f"sensors[{number}]"
    assert "° off" in message


def test_a_camera_that_looks_up_a_little_stands_upright(found):
    faults = Faults(sensors={"camera0": SensorFaults(rotation_deg=(45.0, 0.0, 0.0))})
    assert found(drive_of_surroundings(faults=faults), UPRIGHT) == []


def test_frames_that_nothing_locations_are_left_alone(found, sound_drive):
    lost = changed(replace(sound_drive, trajectories={}), LidarSensor, lambda s: replace(s, poses=None))
    assert [found(lost, rule) for rule in RULES] == [[], [], []]
