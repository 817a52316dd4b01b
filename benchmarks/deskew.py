"""How far deskewed points are from where they truly were, by what they were deskewed, on synthetic streets.

Run with `python -m benchmarks.deskew [--sweeps 60]`. Every row is a drive; the lidar has no noise of range, so that
what is left is what deskewing left. A point is compared with the surface that it truly came from, seen from where the
lidar truly was in the middle of the sweep: mean, 95th percentile and largest distance [m] over all points.

nothing: the points as measured. imu: the rotating alone. lidar: odometry. truth: the true trajectory at 100 Hz.
"""

import argparse
from dataclasses import dataclass, replace

import numpy as np

from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.imu import imu_motion
from sceneloom.pipeline import deskewed_scene
from sceneloom.scene import LazyFrames, Scene
from sceneloom.scene.poses import PoseSource
from sceneloom.simulate import LidarSpec, PathSpec, SimulatedDrive, simulate_street
from sceneloom.simulate.drive import ImuSpec
from sceneloom.simulate.trajectory import Stop

TRAJECTORIES = {"nothing": "identity", "imu": "imu", "lidar": "lidar", "truth": "groundTruth"}


@dataclass(frozen=True)
class Row:
    """One drive."""

    name: str
    path: PathSpec
    bias_deg: float = 0.06
    sweeps: int = 1


TIGHT, BIASED = {"speeds": (2.5, 3.5), "yaw_rate": 0.8}, 1.0
ROWS = (
    Row("town, 5 to 10.5 m/s", PathSpec()),
    Row("fast road, 20 to 25 m/s", PathSpec(speeds=(20.0, 25.0), yaw_rate=0.05)),
    Row("tight rotations at 3 m/s", PathSpec(**TIGHT)),
    Row("the same, gyroscope's bias 1 deg/s an axis", PathSpec(**TIGHT), BIASED),
    Row("the same, stationary for 3 s in between", PathSpec(**TIGHT, stops=(Stop(4.0, 3.0),)), BIASED, 2),
)


def errors(drive: SimulatedDrive, scene: Scene) -> np.ndarray:
    """Distance of every point from its truth [m]."""
    apart = []
    for k, frame in enumerate(scene.lidars[0].frames):
        ego = drive.truth.world_from_ego(np.array([frame.timestamp_ns]))
        at = PoseSource(ego, drive.truth.lidar.spec.mount).at(ego.timestamps_ns)
        world_from_lidar = RigidTransform.from_quaternion(at.positions[0], at.quaternions_xyzw[0])
        true = drive.truth.clean_points_world(k).positions_world
        apart.append(np.linalg.norm(world_from_lidar.apply(frame.points.positions) - true, axis=1))
    return np.concatenate(apart)


def in_memory(scene: Scene) -> Scene:
    """The scene with its sweeps measured once."""
    frames = scene.lidars[0].frames
    lidar = replace(scene.lidars[0], frames=LazyFrames.of(list(frames), frames.timestamps_ns.tolist()))
    return replace(scene, sensors=(lidar, *(sensor for sensor in scene.sensors if sensor.id != lidar.id)))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sweeps", type=int, default=60)
    parser.add_argument("--seed", type=int, default=2)
    arguments = parser.parse_args()
    print("| drive | " + " | ".join(TRAJECTORIES) + " | gyroscope's bias left in [deg/s] |")
    print("| --- |" + " --- |" * (len(TRAJECTORIES) + 1))
    for row in ROWS:
        lidar = LidarSpec(beams=32, steps=900, range_sigma=0.0)
        drive = simulate_street(
            arguments.seed,
            frames=row.sweeps * arguments.sweeps,
            lidar=lidar,
            cameras=(),
            path=row.path,
            imu=ImuSpec(gyroscope_bias_sigma=np.radians(row.bias_deg)),
        )
        scene = in_memory(drive.scene)
        cells = []
        for trajectory in TRAJECTORIES.values():
            apart = errors(drive, deskewed_scene(scene, trajectory=trajectory))
            cells.append(f"{apart.mean():.3f}, {np.percentile(apart, 95):.3f}, {apart.max():.3f}")
        found = imu_motion(drive.scene).bias
        bias = drive.truth.imu.gyroscope_bias - (0.0 if found is None else found)
        left = np.degrees(np.linalg.norm(bias))
        print(f"| {row.name} | " + " | ".join(cells) + f" | {left:.3f} |", flush=True)


if __name__ == "__main__":
    main()
