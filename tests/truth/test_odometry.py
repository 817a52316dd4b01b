"""Lidar odometry against the exact trajectory of synthetic drives."""

import numpy as np
import pytest

from sceneloom.geometry import rigid
from sceneloom.motion.odometry import LidarOdometry, PoseEstimate, lidar_odometry
from sceneloom.simulate import LidarSpec, PathSpec, SimulatedDrive, SolidStateSpec, Stop, TrafficSpec, simulate_street


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
    times = np.linspace(*run.trajectory.timestamps_ns[[0, -1]], 500).astype(np.int64)  # between its knots too
    found = run.trajectory.poses.interpolate(times)
    truth = drive.truth.world_from_ego(times)
    to_first = rigid.conjugate_quaternion(truth.quaternions_xyzw[0])
    positions = rigid.rotate_vectors(to_first, truth.positions - truth.positions[0])
    quaternions = rigid.multiply_quaternions(to_first, truth.quaternions_xyzw)
    assert (found.coverage == 0).all()
    assert np.linalg.norm(positions[-1]) > 10.0
    assert np.linalg.norm(found.positions - positions, axis=1).max() < tolerance
    assert np.degrees(rigid.angle_between(found.quaternions_xyzw, quaternions)).max() < 0.3
    assert run.warnings == ()


def test_the_trajectory_spans_all_point_times():
    drive = simulate_street(1, frames=4, lidar=LidarSpec(beams=16, steps=900), cameras=())
    run = lidar_odometry(drive.scene)
    times = [frame.points.timestamps_ns for frame in drive.scene.lidars[0].frames]
    assert (run.trajectory.name, run.trajectory.timestamps_ns[0]) == ("lidar", min(t.min() for t in times))
    assert run.trajectory.timestamps_ns[-1] == max(t.max() for t in times)
    np.testing.assert_allclose(run.trajectory.positions[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.abs(run.trajectory.quaternions_xyzw[0, 3]), 1.0, atol=1e-12)


BUSY = TrafficSpec(cars=5.0, cyclists=2.0, pedestrians=6.0)


def follow(drive: SimulatedDrive, mount) -> list[PoseEstimate]:
    odometry = LidarOdometry()
    return [
        odometry.add(frame.timestamp_ns, mount.apply(frame.points.positions), frame.points.timestamps_ns)
        for frame in drive.scene.lidars[0].frames
    ]


def errors(drive: SimulatedDrive, estimates: list[PoseEstimate]) -> tuple[np.ndarray, np.ndarray, float]:
    """Shift errors (N, 3) [m] and rotate errors (N,) [deg] relative to the first pose.

    And the length of the trajectory.
    """
    times = np.array([estimate.state.timestamp_ns for estimate in estimates])
    truth = drive.truth.world_from_ego(times)
    rotations = rigid.matrix_from_quaternion(truth.quaternions_xyzw)
    positions = (truth.positions - truth.positions[0]) @ rotations[0]
    found = np.array([estimate.state.position for estimate in estimates])
    apart = np.array(
        [
            estimate.state.rotation.T @ (rotations[0].T @ rotation)
            for estimate, rotation in zip(estimates, rotations, strict=True)
        ]
    )
    cosines = np.clip((np.trace(apart, axis1=1, axis2=2) - 1) / 2, -1, 1)
    trajectory = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    return found - found[0] - positions, np.degrees(np.arccos(cosines)), trajectory


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spec", "path"),
    [
        (LidarSpec(beams=32, elevations_deg=(-25.0, 15.0), steps=1200), PathSpec()),
        (LidarSpec(beams=16, elevations_deg=(-15.0, 15.0), steps=1200), PathSpec()),
        (SolidStateSpec(), PathSpec(stops=(Stop(8.0, 2.0),), ramp=2.0)),
        (LidarSpec(steps=1200), PathSpec(yaw_rate=1.05, speeds=(4.0, 10.0))),
    ],
    ids=["32 beams", "16 beams", "solid state with a stop", "60 deg/s"],
)
def test_the_drift_among_traffic_is_small_and_its_covariance_right_within_an_order_of_magnitude(spec, path):
    drive = simulate_street(31, frames=200, lidar=spec, cameras=(), path=path, traffic=BUSY)
    estimates = follow(drive, spec.mount)
    shifts, rotations, trajectory = errors(drive, estimates)
    assert trajectory > 80.0
    assert np.linalg.norm(shifts[-1]) < 0.005 * trajectory
    assert rotations[-1] < 0.3 * max(trajectory / 100.0, 1.0)
    covariance = estimates[-1].covariance[3:, 3:]
    squared = shifts[-1] @ np.linalg.solve(covariance, shifts[-1]) / 3
    # ten standard deviations either way would mean that the covariance says nothing
    assert squared < 15.0
    assert np.sqrt(np.trace(covariance)) < 10 * max(float(np.linalg.norm(shifts[-1])), 0.02)


@pytest.mark.slow
def test_a_minute_of_stationary_among_traffic_moves_the_car_by_less_than_two_centimetres():
    spec = LidarSpec(beams=16, elevations_deg=(-15.0, 15.0), steps=1200)
    drive = simulate_street(
        32, frames=600, lidar=spec, cameras=(), path=PathSpec(stops=(Stop(0.0, 70.0),)), traffic=BUSY
    )
    shifts, _, trajectory = errors(drive, follow(drive, spec.mount))
    assert trajectory == pytest.approx(0.0, abs=1e-6)
    assert np.linalg.norm(shifts, axis=1).max() < 0.02
