"""Clocks compared by ways: fixes against a trajectory and against what an IMU computes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.clock.comparison import ClockVerdict
from sceneloom.motion.clock.streams import Method, compare_streams, streams_of
from sceneloom.scene import Trajectory
from sceneloom.simulate import GnssSpec, LidarSpec, simulate_street

BLIND = LidarSpec(beams=1, steps=4, elevations_deg=(-1.0, 1.0))
"""Nothing looks at the sweeps."""


def drive(seed, *, seconds=60, sigma=0.02, rate_hz=10.0):
    gnss = GnssSpec(rate_hz=rate_hz, horizontal_sigma=sigma)
    return simulate_street(seed, frames=10 * seconds, lidar=BLIND, gnss=gnss).scene


@pytest.fixture(scope="module")
def scene():
    return drive(0)


def shifted(scene, offset_ns, skew_ppm=0.0):
    """The receiver's clock off."""
    receiver = scene.sensor("gnss")
    times = receiver.timestamps_ns
    wrong = times + np.rint(offset_ns + skew_ppm * 1e-6 * (times - times[0])).astype(np.int64)
    return with_receiver(scene, replace(receiver, timestamps_ns=wrong))


def with_receiver(scene, receiver):
    return replace(scene, sensors=tuple(receiver if s.id == "gnss" else s for s in scene.sensors))


def compared(scene, reference, stream="gnss", **more):
    found = {s.name: s for s in streams_of(scene)}
    return compare_streams(found[reference], found[stream], **more)


@pytest.mark.parametrize(("offset_ns", "skew"), [(3e7, 0.0), (-1e9, 200.0), (9e8, -200.0)])
def test_an_offset_of_fixes_against_a_trajectory_comes_back(scene, offset_ns, skew):
    method, found = compared(shifted(scene, offset_ns, skew), "groundTruth")
    truth_ns = offset_ns + skew * 1e-6 * (found.at_ns - scene.sensor("gnss").timestamps_ns[0])
    assert method is Method.TRAJECTORY
    # fixes of 2 cm a tenth of a second apart know it to a millisecond
    assert found.offset_ns == pytest.approx(truth_ns, abs=4e6)
    assert found.offset_sigma_ns < 2e6
    assert abs(found.skew_ppm - skew) < 5 * found.skew_sigma_ppm
    assert found.is_off


@pytest.mark.parametrize("offset_ns", [3e7, pytest.param(-7e8, marks=pytest.mark.slow)])
def test_an_offset_of_fixes_against_an_imu_comes_back(scene, offset_ns):
    _, found = compared(shifted(scene, offset_ns), "imu", lever_sigma=0.0)
    # what was computed bends by centimetres, which is worth some milliseconds
    assert abs(found.offset_ns - offset_ns) < 4 * found.offset_sigma_ns
    assert found.offset_sigma_ns < 1.2e7


def test_the_other_way_round_the_sign_changes(scene):
    wrong = shifted(scene, 4e7)
    forth = compared(wrong, "groundTruth")[1]
    back = compared(wrong, "gnss", "groundTruth")[1]
    assert back.offset_ns == pytest.approx(-forth.offset_ns, abs=1e5)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_fixes_in_step_raise_no_alarm(seed):
    scene = drive(seed, seconds=40, sigma=0.4)
    for reference in ("groundTruth", "imu"):
        assert not compared(scene, reference)[1].is_off


def test_an_unknown_antenna_widens_the_uncertainty(scene):
    known = compared(scene, "groundTruth", lever_sigma=0.0)[1]
    unknown = compared(scene, "groundTruth", lever_sigma=1.0)[1]
    assert unknown.offset_sigma_ns > 1.5 * known.offset_sigma_ns


def test_jumps_of_single_fixes_do_not_matter(scene):
    receiver = scene.sensor("gnss")
    positions = receiver.positions_lla.copy()
    positions[::37, 0] += 2e-4
    wild = with_receiver(scene, replace(receiver, positions_lla=positions))
    _, found = compared(shifted(wild, 3e7), "groundTruth")
    # a fix in 37 is off by 22 m; the others know the offset nearly as well
    assert found.offset_ns == pytest.approx(3e7, abs=5e6)


def test_a_trajectory_without_orientations_is_compared_by_its_trajectory(scene):
    trajectory = scene.trajectories["groundTruth"]
    times = trajectory.timestamps_ns[::10] + 30_000_000
    locations = Trajectory("groundTruth", times, trajectory.positions[::10])
    bare = replace(scene, trajectories={"groundTruth": locations})
    method, found = compared(bare, "imu", "groundTruth")
    assert method is Method.TRAJECTORY
    assert abs(found.offset_ns - 3e7) < 4 * found.offset_sigma_ns


def test_a_stationary_receiver_states_nothing(scene):
    receiver = scene.sensor("gnss")
    draw = np.random.default_rng(0)
    still = receiver.positions_lla[:1] + 1e-6 * draw.standard_normal((len(receiver.timestamps_ns), 3))
    stationary = with_receiver(scene, replace(receiver, positions_lla=still))
    found = compared(stationary, "groundTruth")[1]
    assert found.verdict is ClockVerdict.NOT_OBSERVABLE
    assert found.reason


def test_a_straight_road_at_one_speed_states_nothing(scene):
    receiver, trajectory = scene.sensor("gnss"), scene.trajectories["groundTruth"]
    draw = np.random.default_rng(0)

    def along(times, noise):
        locations = np.zeros((len(times), 3))
        locations[:, 0] = 8.0 * (times - times[0]) * 1e-9
        return locations + noise * draw.standard_normal(locations.shape)

    fixes = geodetic_from_enu(along(receiver.timestamps_ns, 0.4), receiver.positions_lla[0])
    straight = Trajectory("groundTruth", trajectory.timestamps_ns, along(trajectory.timestamps_ns, 0.002))
    moved = with_receiver(scene, replace(receiver, positions_lla=fixes))
    found = compared(replace(moved, trajectories={"groundTruth": straight}), "groundTruth")[1]
    assert found.verdict is ClockVerdict.NOT_OBSERVABLE
    assert found.offset_ns is None
    assert found.reason


@pytest.mark.parametrize("kept", [0, 1, 6])
def test_too_few_fixes_are_named(scene, kept):
    receiver = scene.sensor("gnss")
    names = ("timestamps_ns", "positions_lla", "accuracies", "vertical_accuracies")
    few = replace(receiver, **{name: getattr(receiver, name)[:kept] for name in names})
    found = compared(with_receiver(scene, few), "groundTruth")[1]
    assert found.verdict is ClockVerdict.NOT_OBSERVABLE
    assert "fixes" in found.reason or "in common" in found.reason


def test_fixes_before_reception_and_without_heights_do_not_matter(scene):
    receiver = scene.sensor("gnss")
    positions = receiver.positions_lla.copy()
    positions[:40] = 0.0
    positions[:, 2] = np.nan
    _, found = compared(with_receiver(scene, replace(receiver, positions_lla=positions)), "groundTruth")
    # as with all of them
    assert found.offset_ns == pytest.approx(0, abs=4e6)
    assert found.offset_sigma_ns < 2e6


def test_a_fix_of_a_wrong_time_makes_no_windows_by_the_million(scene):
    receiver = scene.sensor("gnss")
    times = receiver.timestamps_ns.copy()
    times[-1] = 9_000_000_000_000_000_000
    found = compared(with_receiver(scene, replace(receiver, timestamps_ns=times)), "groundTruth")[1]
    assert found.samples < len(times)


@pytest.mark.parametrize("forces", [0.0, 1e200])
def test_an_accelerometer_that_states_nothing_reports_no_offset(scene, forces):
    imu = scene.sensor("imu")
    samples = imu.streams["accelerometer"]
    dead = replace(samples, values=np.full_like(samples.values, forces))
    streams = {**imu.streams, "accelerometer": dead}
    sensors = tuple(replace(s, streams=streams) if s.id == "imu" else s for s in scene.sensors)
    found = compared(replace(scene, sensors=sensors), "imu")[1]
    assert found.verdict is ClockVerdict.NOT_OBSERVABLE


def test_a_stated_antenna_is_believed(scene):
    receiver, trajectory = scene.sensor("gnss"), scene.trajectories["groundTruth"].poses
    arm, origin = np.array([1.5, -0.4, 1.2]), receiver.positions_lla[0]
    rotations = Rotation.from_quat(trajectory.held(receiver.timestamps_ns).quaternions_xyzw)
    moved = enu_from_geodetic(receiver.positions_lla, origin) + rotations.apply(arm)
    mount = RigidTransform(np.eye(3), arm)
    away = replace(receiver, positions_lla=geodetic_from_enu(moved, origin), mount=mount)
    stated = compared(with_receiver(scene, away), "groundTruth")[1]
    # 1.5 m ahead is a fifth of a second at the drive's speed
    assert stated.offset_ns == pytest.approx(0, abs=4e6)
    silent = compared(with_receiver(scene, replace(away, mount=None)), "groundTruth", lever_sigma=0.0)[1]
    assert abs(silent.offset_ns) > 5e7
