"""Fixes between states, led there by the IMU, against the exact motion and differences; and where states lie."""

import numpy as np
import pytest

from sceneloom.geometry.rotations import matrix_from_quaternion, quaternion_from_rotation_vector
from sceneloom.kernels.imu_chain import SIZE
from sceneloom.motion.gnss_imu.measurements import (
    Fixes,
    GnssFixes,
    InertialSamples,
    SmootherSettings,
    knot_times,
)
from sceneloom.simulate.drive import GRAVITY, ImuSpec, imu_truth
from sceneloom.simulate.trajectory import PathSpec, plan_path

PATH = plan_path(np.random.default_rng(0), start_ns=0, duration=10.0, spec=PathSpec(yaw_rate=0.8, speeds=(3.0, 5.0)))
KNOTS = np.array([500, 1400, 2300, 3200]) * 1_000_000
TIMES = np.array([490, 500, 800, 1399, 1500, 2000, 2309, 3200, 3210]) * 1_000_000
LEVER = np.array([0.4, -0.3, 1.2])
MEASURED = np.array([True, True, True])


def samples(gaps: tuple[tuple[int, int], ...] = ()) -> InertialSamples:
    times = np.arange(1960, dtype=np.int64) * 5_000_000
    truth = imu_truth(ImuSpec(), PATH, times, seed=0)
    values = np.hstack([truth.angular_rates, truth.specific_forces])
    return InertialSamples(times, values, np.array(gaps, np.int64).reshape(-1, 2))


def antennas() -> GnssFixes:
    states, count = PATH.at(TIMES), len(TIMES)
    sigmas, levers = np.ones((count, 3)), np.tile(LEVER, (count, 1))
    positions = states.positions + states.rotations @ LEVER
    reported, receivers = np.zeros(count, np.bool_), np.zeros(count, np.int64)
    return GnssFixes(TIMES, positions, sigmas, reported, levers, receivers, np.zeros(3), ())


def expected(fixes: Fixes, moved: np.ndarray | None = None) -> np.ndarray:
    """Where true states state that the antennas are, (F, 3), moved by (K, 15)."""
    moved = np.zeros((len(KNOTS), SIZE)) if moved is None else moved
    states, at = PATH.at(KNOTS), fixes.locations
    rotations = states.rotations @ matrix_from_quaternion(quaternion_from_rotation_vector(moved[:, :3]))
    levers = fixes.levers + np.einsum("nij,nj->ni", fixes.slopes, moved[at, 9:] - fixes.biases)
    away = np.einsum("nij,nj->ni", rotations[at], levers) - fixes.falls[:, None] * [0.0, 0.0, 1.0]
    trajectories = fixes.seconds[:, None] * (states.velocities + moved[:, 6:9])[at]
    return states.positions[at] + moved[at, 3:6] + trajectories + away


def test_true_states_expect_the_antenna_where_it_is():
    found = antennas().carried(KNOTS, MEASURED, samples(), biases=np.zeros((3, 6)), gravity=GRAVITY)
    assert found.locations.tolist() == [0, 0, 0, 0, 1, 1, 2, 3, 3]
    # 10 ms beyond the first and the last state nothing but the velocity leads on: 1 m/s² and rotates of 1 rad/s leave
    # less than a millimetre of the ego, and a centimetre of the lever
    limits = np.where((KNOTS[0] > TIMES) | (KNOTS[-1] < TIMES), 2e-2, 1e-4)
    assert (np.abs(expected(found) - found.positions).max(axis=1) < limits).all()


def test_without_imu_each_fix_goes_to_the_nearest_state():
    found = antennas().carried(KNOTS, ~MEASURED, samples(), biases=np.zeros((3, 6)), gravity=GRAVITY)
    assert found.locations.tolist() == [0, 0, 0, 1, 1, 2, 2, 3, 3]
    assert not found.falls.any()
    assert np.array_equal(found.levers, np.tile(LEVER, (len(TIMES), 1)))


def test_a_bias_taken_off_is_one_known_to_the_slopes():
    bias = np.array([2e-3, -1e-3, 3e-3, 0.05, -0.04, 0.02])
    plain = antennas().carried(KNOTS, MEASURED, samples(), biases=np.zeros((3, 6)), gravity=GRAVITY)
    other = antennas().carried(KNOTS, MEASURED, samples(), biases=np.tile(bias, (3, 1)), gravity=GRAVITY)
    assert np.abs(other.levers - plain.levers).max() > 0.01
    # what is second order in 3e-3 rad and 0.05 m/s² over 0.9 s
    assert np.abs(expected(other) - expected(plain)).max() < 1e-4


@pytest.mark.slow
def test_variances_are_those_of_drawn_states():
    rng = np.random.default_rng(1)
    found = antennas().carried(KNOTS, MEASURED, samples(), biases=np.zeros((3, 6)), gravity=GRAVITY)
    roots = 1e-3 * rng.standard_normal((len(KNOTS), SIZE, SIZE))
    own = roots @ roots.swapaxes(1, 2)
    drawn = [
        expected(found, np.einsum("kij,kj->ki", roots, rng.standard_normal((len(KNOTS), SIZE)))) for _ in range(4000)
    ]
    # a variance of 4000 draws has a deviation of √(2 / 4000) = 2.2 %
    variances = found.variances(PATH.at(KNOTS).rotations, own)
    assert np.var(drawn, axis=0) == pytest.approx(variances, rel=0.1)


def test_states_lie_farther_apart_than_fixes_only_where_the_imu_leads_well():
    fixes = np.arange(0, 9_700_000_001, 100_000_000, dtype=np.int64)
    settings = SmootherSettings()
    quiet = knot_times(fixes, samples(), np.empty(0, np.int64), settings)
    assert np.diff(quiet).max() == 500_000_000
    assert len(quiet) < len(fixes) / 4
    with_gap = knot_times(fixes, samples(((3_040_000_000, 5_060_000_000),)), np.empty(0, np.int64), settings)
    inside = with_gap[(with_gap > 3_040_000_000) & (with_gap < 5_060_000_000)]
    assert inside.tolist() == [time for time in fixes.tolist() if 3_060_000_000 <= time <= 5_040_000_000]
    assert {3_040_000_000, 5_060_000_000} <= set(with_gap.tolist())
    noisy = samples()
    noisy.values[:, 3:] += 3.0 * np.random.default_rng(2).standard_normal((len(noisy.values), 3))
    assert len(knot_times(fixes, noisy, np.empty(0, np.int64), settings)) >= len(fixes)


def test_times_of_no_imu_are_all_states():
    fixes = np.array([0, 5, 30, 2000]) * 1_000_000
    knots = knot_times(fixes, None, np.array([15, 1000], np.int64) * 1_000_000, SmootherSettings())
    assert knots.tolist() == [0, 30_000_000, 1_000_000_000, 2_000_000_000]
