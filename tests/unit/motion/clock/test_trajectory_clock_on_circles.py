"""Fixes against an IMU on circles, which are reported in closed form."""

import numpy as np
import pytest

from sceneloom.motion.clock.comparison import ClockVerdict, compare_trajectories
from sceneloom.motion.clock.signals import Fixes
from sceneloom.motion.clock.streams import DeadReckonedTrajectory, Unit
from sceneloom.scene import VectorSamples

RADIUS, RATE = 30.0, 0.3
"""A car in a roundabout [m, rad/s]."""


def compared(swing, offset_ns, *, noise=0.02, seed=0, seconds=40.0):
    """Round a circle, by an angle of RATE t plus `swing` times a sine, with fixes that are timestamped late."""
    draw = np.random.default_rng(seed)
    t, fixed = np.arange(0.0, seconds, 0.02), np.arange(0.5, seconds - 0.5, 0.1)
    w = 0.5
    rate = RATE + swing * w * np.cos(w * t)
    faster = -swing * w * w * np.sin(w * t)
    timestamps = (t * 1e9).astype(np.int64)
    # ahead: the speed's change; left: towards the middle
    forces = np.stack([RADIUS * faster, RADIUS * rate**2, np.full_like(t, 9.81)], axis=1)
    rates = np.stack([np.zeros_like(t), np.zeros_like(t), rate], axis=1)
    unit = Unit.of(
        VectorSamples(timestamps, rates + 2e-3 * draw.standard_normal(rates.shape)),
        VectorSamples(timestamps, forces + 2e-2 * draw.standard_normal(forces.shape)),
    )
    locations = RADIUS * np.exp(1j * (RATE * fixed + swing * np.sin(w * fixed)))
    scatter = noise * draw.standard_normal((2, len(fixed)))
    fixes = Fixes((fixed * 1e9).astype(np.int64) + offset_ns, locations + scatter[0] + 1j * scatter[1])
    return compare_trajectories(
        fixes,
        DeadReckonedTrajectory(unit, 0),
        origin_ns=0,
        fixes_are_reference=False,
        reach_ns=1_000_000_000,
        lever_sigma=0.0,
    )


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.slow
def test_a_circle_at_one_speed_reports_no_offset_however_good_the_fixes_are(seed):
    """Later on the circle is the same as rotated about its middle; what is left is what the IMU gets wrong."""
    found = compared(0.0, 200_000_000, noise=1e-5, seed=seed)
    assert (found.verdict, found.offset_ns) == (ClockVerdict.NOT_OBSERVABLE, None)
    assert "too even" in found.reason


@pytest.mark.parametrize("offset_ns", [200_000_000, -30_000_000])
def test_a_circle_at_changing_speed_reports_the_offset(offset_ns):
    found = compared(0.5, offset_ns)
    assert found.offset_ns == pytest.approx(offset_ns, abs=4 * found.offset_sigma_ns)
    # fixes of 2 cm at 9 m/s that comes and goes by a half
    assert found.offset_sigma_ns < 5e6
