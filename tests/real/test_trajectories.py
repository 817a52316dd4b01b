"""Poses of ORB-SLAM3 on KITTI against the drives' GNSS and IMU units; ways out of recordings."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom import evaluate_trajectory, read_trajectory, write_trajectory
from sceneloom.geometry.geodesy import enu_from_geodetic
from sceneloom.scene import Trajectory

OF_EVO = {
    ("0002", "se3"): (1.16438047, 1.36927163, 3.33876394, 1.04241038, 0.142834775),
    ("0002", "sim3"): (0.140063571, 0.153199674, 0.291239865, 1.04241038, 0.0665079195),
    ("0010", "se3"): (2.74895322, 3.22117852, 5.93550243, 1.11199784, 0.228186754),
    ("0010", "sim3"): (0.213244285, 0.23040931, 0.470703265, 1.11199784, 0.117905181),
    ("0014", "se3"): (0.251172422, 0.298986123, 0.683835985, 2.16120954, 0.135085215),
    ("0014", "sim3"): (0.252756525, 0.297450454, 0.648308434, 2.16120954, 0.134917389),
}
"""By sequence and alignment what evo 1.38.1 gives: mean, rmse and max of the translation [m], mean of the rotation
[deg], rmse of motions over 5 poses [m]."""


@pytest.fixture(scope="module")
def kitti(data_dir: Path) -> Path:
    """The folder of KITTI's tracking benchmark."""
    return data_dir / "real" / "kitti_tracking"


def oxts_trajectory(kitti: Path, sequence: str) -> Trajectory:
    """The trajectory of the GNSS and IMU unit at 10 Hz: east, north and up of its first location."""
    lines = (kitti / "oxts" / f"{sequence}.txt").read_text("ascii").splitlines()
    rows = np.array([[float(word) for word in line.split()[:6]] for line in lines if line.strip()])
    rotations = Rotation.from_euler("xyz", rows[:, 3:]).as_quat()
    timestamps = np.arange(len(rows), dtype=np.int64) * 100_000_000
    return Trajectory("oxts", timestamps, enu_from_geodetic(rows[:, :3], rows[0, :3]), rotations)


@pytest.mark.parametrize(("sequence", "align"), OF_EVO)
def test_orb_slam_against_the_unit_has_the_errors_that_evo_finds(kitti: Path, sequence: str, align: str) -> None:
    found = read_trajectory(kitti / "orbslam3_poses" / f"{sequence}.txt", rate_hz=10, optical=True)
    report = evaluate_trajectory(
        found, oxts_trajectory(kitti, sequence), align=align, associate="nearest", rpe_deltas=("5f",)
    )
    assert report.pairs == len(found.timestamps_ns)
    assert report.absolute.rotation_deg is not None
    reported = report.absolute.translation
    figures = (
        reported.mean,
        reported.rms,
        reported.max,
        report.absolute.rotation_deg.mean,
        report.relative[0].translation.rms,
    )
    # evo's figures are quoted with nine digits
    assert figures == pytest.approx(OF_EVO[sequence, align], rel=1e-7)


def test_a_camera_taken_for_a_vehicle_is_noticed(kitti: Path) -> None:
    found = read_trajectory(kitti / "orbslam3_poses" / "0010.txt", rate_hz=10)
    report = evaluate_trajectory(found, oxts_trajectory(kitti, "0010"), align="sim3")
    assert "--est-optical" in report.warnings[0].message
    assert report.absolute.rotation_deg is not None
    assert report.absolute.rotation_deg.median == pytest.approx(120.0, abs=2.0)


def test_of_a_car_that_stands_the_doubt_is_reported(kitti: Path) -> None:
    found = read_trajectory(kitti / "orbslam3_poses" / "0012.txt", rate_hz=10, optical=True)
    report = evaluate_trajectory(found, oxts_trajectory(kitti, "0012"))
    assert report.absolute.translation.max < 0.02
    assert [warning.code for warning in report.warnings] == ["doubtful-alignment", "no-steps"]


def test_fixes_of_a_recording_are_its_trajectory(data_dir: Path, tmp_path: Path) -> None:
    drive = data_dir / "recordings" / "kitti_oxts_0000"
    report = evaluate_trajectory(f"{drive}:fixes", drive, align="none")
    # both are the unit's own fixes, brought to the same metres
    assert report.absolute.translation.max < 1e-6
    assert report.coverage == 1.0
    trajectory = read_trajectory(drive)
    write_trajectory(trajectory, tmp_path / "trajectory.csv")
    assert evaluate_trajectory(tmp_path / "trajectory.csv", trajectory, align="none").absolute.translation.max == 0.0


def test_lidar_odometry_is_near_the_recorded_trajectory(data_dir: Path) -> None:
    drive = data_dir / "recordings" / "pandaset"
    report = evaluate_trajectory(f"{drive}:lidar", drive, align="origin")
    assert report.pairs >= 5
    # five sweeps without times of points: a hundredth of the trajectory or two
    assert report.absolute.translation.max < 0.05
    assert report.absolute.rotation_deg is not None
    assert report.absolute.rotation_deg.max < 0.5
