"""Rules about what stands around a vehicle, on drives through a street that nothing or one thing is wrong with."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.checks import validate
from sceneloom.scene import CameraSensor, CuboidAnnotation, LazyFrames, LidarSensor
from sceneloom.simulate import (
    CameraSpec,
    Faults,
    LidarSpec,
    SensorFaults,
    SolidStateSpec,
    TrafficSpec,
    simulate_street,
)

GROUND, CUBOIDS, UPRIGHT = "ground-above-sensor", "cuboids-off-points", "camera-not-upright"
RULES = (GROUND, CUBOIDS, UPRIGHT)
LIDAR = LidarSpec(beams=32, steps=900)
CAMERA = CameraSpec(Camera("pinhole", 48, 32, 40.0, 40.0, 23.5, 15.5))


def drive(**options):
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
    return changed(drive(), LidarSensor, with_swept)


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
    assert validate(drive(**options, cameras=()), rules=[GROUND, CUBOIDS]).findings == ()


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
    assert len(found(drive(faults=faults, cameras=()), CUBOIDS)) == 1


@pytest.mark.parametrize(
    "broken",
    [
        lambda scene: changed(
            scene, CameraSensor, lambda camera: replace(camera, mount=camera.mount.inverse())
        ),
        lambda scene: changed(
            scene,
            CameraSensor,
            lambda camera: replace(camera, mount=replace(camera.mount, rotation=np.eye(3))),
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
    assert found(drive(faults=faults), UPRIGHT) == []


def test_frames_that_nothing_locations_are_left_alone(found, sound_drive):
    lost = changed(replace(sound_drive, trajectories={}), LidarSensor, lambda s: replace(s, poses=None))
    assert [found(lost, rule) for rule in RULES] == [[], [], []]
