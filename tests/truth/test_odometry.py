"""Lidar odometry against the exact trajectory of synthetic drives."""

import numpy as np
import pytest

from sceneloom.geometry.rigid import angle_between, conjugate_quaternion, multiply_quaternions, rotate_vectors
from sceneloom.motion.odometry import OdometryRun, lidar_odometry
from sceneloom.simulate import LidarSpec, SimulatedDrive, simulate_street


def true_trajectory(drive: SimulatedDrive, timestamps_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and orientations relative to the first of the times."""
    truth = drive.truth.world_from_ego(timestamps_ns)
    to_first = conjugate_quaternion(truth.quaternions_xyzw[0])
    positions = rotate_vectors(to_first, truth.positions - truth.positions[0])
    return positions, multiply_quaternions(to_first, truth.quaternions_xyzw)


def dense_times(run: OdometryRun) -> np.ndarray:
    """Times all over the trajectory, between its knots too."""
    first, last = run.trajectory.timestamps_ns[[0, -1]]
    return np.linspace(first, last, 500).astype(np.int64)


@pytest.mark.parametrize(
    ("lidar", "tolerance"),
    [
        # 0.2 % of the trajectory of about 18 m; a lidar with few beams sees less of the ground
        (LidarSpec(beams=32, elevations_deg=(-25.0, 15.0), steps=1200), 0.04),
        (LidarSpec(beams=16, elevations_deg=(-15.0, 15.0)), 0.08),
    ],
)
@pytest.mark.few(1)
def test_the_trajectory_of_a_drive_is_found_at_every_time_between_its_first_and_its_last_point(lidar, tolerance):
    drive = simulate_street(4, frames=25, lidar=lidar, cameras=())
    run = lidar_odometry(drive.scene)
    times = dense_times(run)
    found = run.trajectory.poses.interpolate(times)
    positions, quaternions = true_trajectory(drive, times)
    assert (found.coverage == 0).all()
    assert np.linalg.norm(positions[-1]) > 10.0
    assert np.linalg.norm(found.positions - positions, axis=1).max() < tolerance
    assert np.degrees(angle_between(found.quaternions_xyzw, quaternions)).max() < 0.3
    assert run.warnings == ()


def test_the_trajectory_spans_all_point_times():
    drive = simulate_street(1, frames=4, lidar=LidarSpec(beams=16, steps=900), cameras=())
    run = lidar_odometry(drive.scene)
    times = [frame.points.timestamps_ns for frame in drive.scene.lidars[0].frames]
    assert run.trajectory.name == "lidar"
    assert run.trajectory.timestamps_ns[0] == min(t.min() for t in times)
    assert run.trajectory.timestamps_ns[-1] == max(t.max() for t in times)
    np.testing.assert_allclose(run.trajectory.positions[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.abs(run.trajectory.quaternions_xyzw[0, 3]), 1.0, atol=1e-12)
