"""The trajectory from satellite fixes and IMU of a real car, against fixes that were left out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sceneloom
from sceneloom.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from sceneloom.motion.gnss_imu import gnss_imu_motion
from sceneloom.scene import GnssSensor, ImuSensor, Scene


@pytest.fixture(scope="module")
def scene(data_dir: Path) -> Scene:
    folder = data_dir / "recordings" / "kitti_oxts_0000"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    return sceneloom.open(folder)


def squares(scene: Scene, rows: np.ndarray, left: np.ndarray, noise: np.ndarray | None = None) -> tuple[float, float]:
    """Mean square horizontal error at fixes left out: ours, and that of straight lines between the fixes kept."""
    imu = next(sensor for sensor in scene.sensors if isinstance(sensor, ImuSensor))
    gnss = next(sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor))
    locations = gnss.positions_lla[rows]
    if noise is not None:
        locations = geodetic_from_enu(enu_from_geodetic(locations, locations[0]) + noise, locations[0])
    kept = GnssSensor(
        "gnss", gnss.timestamps_ns[rows], locations, gnss.accuracies[rows], gnss.vertical_accuracies[rows]
    )
    run = gnss_imu_motion(Scene((imu, kept), source=scene.source))
    truth = enu_from_geodetic(gnss.positions_lla[left], run.origin_lla)[:, :2]
    known = enu_from_geodetic(locations, run.origin_lla)
    found = []
    for times, positions in ((run.trajectory.timestamps_ns, run.trajectory.positions), (kept.timestamps_ns, known)):
        at = [np.interp(gnss.timestamps_ns[left], times, positions[:, axis]) for axis in range(2)]
        found.append(float(((np.stack(at, axis=1) - truth) ** 2).sum(axis=1).mean()))
    return found[0], found[1]


def between(rows: np.ndarray) -> np.ndarray:
    return np.setdiff1d(np.arange(rows[0], rows[-1] + 1), rows)


@pytest.mark.parametrize("first", [0, 4])
def test_with_one_fix_in_ten_the_trajectory_between_is_better_than_straight_lines(scene, first):
    rows = np.arange(first, 154, 10)
    ours, lines = squares(scene, rows, between(rows))
    assert ours < 0.5 * lines


@pytest.mark.parametrize("start", [15, 27, 38])
def test_an_outage_of_ten_seconds_costs_a_fifth_of_what_straight_lines_do(scene, start):
    left = np.arange(start, start + 100)
    rows = np.setdiff1d(np.arange(154), left)
    ours, lines = squares(scene, rows, left)
    assert ours < (lines / 5.0**2)


@pytest.mark.slow
def test_noise_of_a_metre_and_jumps_of_ten_are_a_third_of_what_they_are_on_straight_lines(scene):
    rows = np.arange(0, 154, 10)
    found = []
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        noise = rng.standard_normal((len(rows), 3))
        angle = rng.uniform(0.0, 2.0 * np.pi, len(rows))
        off = rng.uniform(size=len(rows)) < 0.05
        noise[off, :2] += 10.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)[off]
        found.append(squares(scene, rows, between(rows), noise))
    ours, lines = np.sqrt(np.mean(found, axis=0))
    assert lines > 3.0 * ours


def test_the_trajectory_of_all_fixes_has_the_heading_of_the_navigation_unit(scene):
    found = sceneloom.find_ego_motion(replace(scene, trajectories={}))
    assert found.name == "gnss"
    truth = scene.trajectories["groundTruth"].poses.interpolate(found.path.timestamps_ns)
    dot = np.abs((found.path.quaternions_xyzw * truth.quaternions_xyzw).sum(axis=1))
    assert np.degrees(2.0 * np.arccos(np.clip(dot, 0.0, 1.0))).max() < 3.0
    assert np.abs(found.path.positions - truth.positions).max() < 0.5
