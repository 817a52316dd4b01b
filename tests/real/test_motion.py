"""Trajectories and clocks of real drives: against the drives' GNSS and IMU units, and fixes that were left out."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom import evaluate_trajectory, read_trajectory, write_trajectory
from sceneloom.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from sceneloom.motion.clock.comparison import ClockVerdict, compare_rotations
from sceneloom.motion.clock.signals import Orientations
from sceneloom.motion.gnss_imu import gnss_imu_motion
from sceneloom.pipeline import sync
from sceneloom.scene import GnssSensor, Scene, Trajectory

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
def poses(drive):
    """The poses of ORB-SLAM3 on a sequence of KITTI, and the trajectory of its GNSS and IMU unit at 10 Hz."""

    def read(sequence, *, optical=True):
        kitti = drive("real/kitti_tracking")
        rows = np.loadtxt(kitti / "oxts" / f"{sequence}.txt")[:, :6]
        timestamps = np.arange(len(rows), dtype=np.int64) * 100_000_000
        rotations = Rotation.from_euler("xyz", rows[:, 3:]).as_quat()
        unit = Trajectory("oxts", timestamps, enu_from_geodetic(rows[:, :3], rows[0, :3]), rotations)
        return read_trajectory(kitti / "orbslam3_poses" / f"{sequence}.txt", rate_hz=10, optical=optical), unit

    return read


@pytest.mark.parametrize(("sequence", "align"), OF_EVO)
def test_orb_slam_against_the_unit_has_the_errors_that_evo_finds(poses, sequence, align):
    found, unit = poses(sequence)
    report = evaluate_trajectory(found, unit, align=align, associate="nearest", rpe_deltas=("5f",))
    assert report.pairs == len(found.timestamps_ns)
    shift, motions = report.absolute.translation, report.relative[0].translation
    figures = (shift.mean, shift.rms, shift.max, report.absolute.rotation_deg.mean, motions.rms)
    # evo's figures are quoted with nine digits
    assert figures == pytest.approx(OF_EVO[sequence, align], rel=1e-7)


def test_a_camera_taken_for_a_vehicle_is_noticed_and_of_a_car_that_stands_the_doubt_is_reported(poses):
    report = evaluate_trajectory(*poses("0010", optical=False), align="sim3")
    assert "--est-optical" in report.warnings[0].message
    assert report.absolute.rotation_deg.median == pytest.approx(120.0, abs=2.0)
    report = evaluate_trajectory(*poses("0012"))
    assert report.absolute.translation.max < 0.02
    assert [warning.code for warning in report.warnings] == ["doubtful-alignment", "no-steps"]


def test_fixes_of_a_recording_are_its_trajectory(drive, tmp_path):
    oxts = drive("recordings/kitti_oxts_0000")
    report = evaluate_trajectory(f"{oxts}:fixes", oxts, align="none")
    # both are the unit's own fixes, brought to the same metres
    assert report.absolute.translation.max < 1e-6
    assert report.coverage == 1.0
    trajectory = read_trajectory(oxts)
    write_trajectory(trajectory, tmp_path / "trajectory.csv")
    assert evaluate_trajectory(tmp_path / "trajectory.csv", trajectory, align="none").absolute.translation.max == 0.0


def test_lidar_odometry_is_near_the_recorded_trajectory(drive):
    pandaset = drive("recordings/pandaset")
    report = evaluate_trajectory(f"{pandaset}:lidar", pandaset, align="origin")
    assert report.pairs >= 5
    # five sweeps without times of points: a hundredth of the trajectory or two
    assert report.absolute.translation.max < 0.05
    assert report.absolute.rotation_deg.max < 0.5


@pytest.fixture(scope="module")
def scene(drive):
    with sceneloom.open(drive("recordings/kitti_oxts_0000")) as scene:
        yield scene


def squares(scene: Scene, rows: np.ndarray, noise=0.0) -> tuple[float, float]:
    """Mean square horizontal error at the fixes between: ours, and that of straight lines between the fixes kept."""
    imu, gnss = scene.sensor("imu"), scene.sensor("gnss")
    left = np.setdiff1d(np.arange(rows[0], rows[-1] + 1), rows)
    locations = gnss.positions_lla[rows]
    if np.any(noise):
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


@pytest.mark.parametrize(
    ("rows", "least"),
    [
        *((np.arange(first, 154, 10), 2.0) for first in (0, 4)),
        # outages of ten seconds
        *((np.setdiff1d(np.arange(154), np.arange(start, start + 100)), 5.0**2) for start in (15, 27, 38)),
    ],
)
def test_between_fixes_and_in_outages_the_trajectory_is_far_better_than_straight_lines(scene, rows, least):
    ours, lines = squares(scene, rows)
    assert ours < lines / least


@pytest.mark.slow
def test_noise_of_a_metre_and_jumps_of_ten_are_a_third_of_what_they_are_on_straight_lines(scene):
    rows, found = np.arange(0, 154, 10), []
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        noise = rng.standard_normal((len(rows), 3))
        angle = rng.uniform(0.0, 2.0 * np.pi, len(rows))
        off = rng.uniform(size=len(rows)) < 0.05
        noise[off, :2] += 10.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)[off]
        found.append(squares(scene, rows, noise))
    ours, lines = np.sqrt(np.mean(found, axis=0))
    assert lines > 3.0 * ours


def test_the_trajectory_of_all_fixes_has_the_heading_of_the_navigation_unit(scene):
    found = sceneloom.find_ego_motion(replace(scene, trajectories={}))
    assert found.name == "gnss"
    truth = scene.trajectories["groundTruth"].poses.interpolate(found.path.timestamps_ns)
    dot = np.abs((found.path.quaternions_xyzw * truth.quaternions_xyzw).sum(axis=1))
    assert np.degrees(2.0 * np.arccos(np.clip(dot, 0.0, 1.0))).max() < 3.0
    assert np.abs(found.path.positions - truth.positions).max() < 0.5


def compared(gyroscope, trajectory):
    """The trajectory's clock against the gyroscope's."""
    rates = Orientations.of_rates(gyroscope.timestamps_ns, gyroscope.values[:, :3])
    return compare_rotations(rates, Orientations.of_poses(trajectory.timestamps_ns, trajectory.quaternions_xyzw))


def test_rates_of_the_oxts_unit_are_late_by_half_a_sample_and_injected_offsets_come_back_on_top_of_that(scene):
    """They are means over the sample before: the rotation from pose k to k + 1 is rate k + 1, not the mean of both."""
    gyroscope, trajectory = scene.sensor("imu").streams["gyroscope"], scene.trajectories["groundTruth"]
    found = compared(gyroscope, trajectory)
    assert found.offset_ns == pytest.approx(-5e7, abs=8e6)
    assert found.verdict is ClockVerdict.OFF
    for offset_ns in (-1_000_000_000, -30_000_000, 30_000_000, 300_000_000, 1_000_000_000):
        late = replace(trajectory, timestamps_ns=trajectory.timestamps_ns + offset_ns, file_seconds=None)
        # the same samples, cut a little differently at the ends
        added = compared(gyroscope, late).offset_ns - found.offset_ns
        assert added == pytest.approx(offset_ns, abs=2e6)
    in_degrees = replace(gyroscope, values=np.degrees(gyroscope.values))
    scaled = compared(in_degrees, trajectory)
    assert scaled.verdict is ClockVerdict.NOT_OBSERVABLE or scaled.offset_ns == pytest.approx(-5e7, abs=2e7)


def test_fixes_are_in_step_with_the_trajectory_that_they_are_and_half_a_second_is_too_short_to_say(scene, drive):
    found = sync(scene, reference="groundTruth", streams=("gnss",)).comparison("gnss").estimate
    assert (found.verdict, abs(found.offset_ns) < 1e4) == (ClockVerdict.IN_STEP, True)
    assert found.interval_ns[0] <= 0.0 <= found.interval_ns[1]
    with sceneloom.open(drive("recordings/pandaset")) as short:
        report = sync(short, streams=("groundTruth", "camera0"))
    assert {c.estimate.verdict for c in report.comparisons} == {ClockVerdict.NOT_OBSERVABLE}
    assert all("samples" in c.estimate.reason for c in report.comparisons)


@pytest.mark.parametrize("name", ["0012", "0016"])
def test_a_car_that_stands_has_no_motion_in_common_with_anything(drive, name):
    sequence = oxts(drive, name)
    report = sync(sequence, streams=("oxts", "gnss"))
    assert {c.estimate.verdict for c in report.comparisons if c.reference == "imu"} == {ClockVerdict.NOT_OBSERVABLE}


@pytest.mark.parametrize("name", ["0003", "0013"])
def test_errors_of_fixes_that_last_for_half_a_minute_do_not_move_the_offset_out_of_its_interval(drive, name):
    sequence, draw = oxts(drive, name), np.random.default_rng(0)
    receiver = sequence.sensor("gnss")
    offset_ns = round(draw.uniform(-2e8, 2e8))
    errors = draw.standard_normal((len(receiver.timestamps_ns), 3))
    kept = np.exp(-0.1 / 30.0)
    for k in range(1, len(errors)):
        errors[k] = kept * errors[k - 1] + np.sqrt(1.0 - kept**2) * errors[k]
    origin = receiver.positions_lla[0]
    moved = geodetic_from_enu(enu_from_geodetic(receiver.positions_lla, origin) + 0.4 * errors, origin)
    late = replace(receiver, positions_lla=moved, timestamps_ns=receiver.timestamps_ns + offset_ns)
    sensors = tuple(late if s is receiver else s for s in sequence.sensors)
    report = sync(replace(sequence, sensors=sensors), reference="oxts", streams=("gnss",))
    low, high = report.comparison("gnss").estimate.interval_ns
    assert low < offset_ns < high
    assert high - low < 8e7


def oxts(drive, name):
    """A sequence of KITTI's tracking benchmark, with what its GNSS and IMU unit measured."""
    with sceneloom.open(drive("real/kitti_tracking"), sequence=name) as sequence:
        return sequence
