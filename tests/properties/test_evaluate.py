"""What an alignment leaves open changes no error; equal ways have none."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sceneloom import evaluate_trajectory
from sceneloom.scene import Trajectory

GROUPS = {"none": (0, 0, 0), "yaw": (1, 0, 0), "origin": (1, 1, 0), "se3": (1, 1, 0), "sim3": (1, 1, 1)}
"""Whether a kind of alignment leaves open the heading and the location, the other rotations, and the scale."""

seeds = st.integers(0, 10_000)


def trajectories(seed):
    """A winding trajectory and a noisy copy of it."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(5, 60))
    timestamps = np.cumsum(rng.integers(50_000_000, 150_000_000, count))
    positions = np.cumsum(rng.normal(0, 1, (count, 3)), axis=0)
    rotations = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.2, (count, 3)), axis=0))
    noisy = positions + rng.normal(0, 0.1, (count, 3))
    noisy_rotations = rotations * Rotation.from_rotvec(rng.normal(0, 0.02, (count, 3)))
    return (
        Trajectory("found", timestamps, noisy, noisy_rotations.as_quat()),
        Trajectory("true", timestamps, positions, rotations.as_quat()),
    )


def moved(trajectory, world, shift, scale):
    rotations = (world * Rotation.from_quat(trajectory.quaternions_xyzw)).as_quat()
    positions = scale * world.apply(trajectory.positions) + shift
    return Trajectory(trajectory.name, trajectory.timestamps_ns, positions, rotations)


def figures(report):
    errors = [report.absolute.translation, report.absolute.rotation_deg]
    errors += [part for step in report.relative for part in (step.translation, step.rotation_deg)]
    return [getattr(one, name) for one in errors for name in ("mean", "rms", "median", "max", "percentile_95")]


@pytest.mark.parametrize("kind", GROUPS)
@settings(max_examples=12)
@given(seed=seeds, other=seeds)
def test_moving_the_estimate_by_what_is_aligned_changes_nothing(kind, seed, other):
    found, true = trajectories(seed)
    rng = np.random.default_rng(other)
    heading, tilt, scale = GROUPS[kind]
    angles = rng.uniform(-3, 3, 3) * (heading, tilt, tilt)
    world = Rotation.from_euler("ZYX", angles)
    there = moved(found, world, heading * rng.uniform(-1e3, 1e3, 3), float(rng.uniform(0.1, 10)) if scale else 1.0)
    deltas = ("1f", "3m", "1s")
    before, after = (evaluate_trajectory(one, true, align=kind, rpe_deltas=deltas) for one in (found, there))
    # coordinates of 1e4 m leave 1e-12 m, angles of matrices 1e-8 rad or some 1e-6 degrees
    assert figures(after) == pytest.approx(figures(before), rel=1e-7, abs=1e-6)
    assert after.path_length == before.path_length


@pytest.mark.parametrize("kind", GROUPS)
@settings(max_examples=12)
@given(seed=seeds, other=seeds)
def test_moving_both_alike_changes_nothing(kind, seed, other):
    found, true = trajectories(seed)
    rng = np.random.default_rng(other)
    # yaw knows what is up, so that only rotates about the vertical leave it alone
    world = Rotation.from_euler("ZYX", rng.uniform(-3, 3, 3) * (1, kind != "yaw", kind != "yaw"))
    shift = rng.uniform(-1e3, 1e3, 3)
    there = [moved(trajectory, world, shift, 1.0) for trajectory in (found, true)]
    before, after = (evaluate_trajectory(*both, align=kind, rpe_deltas=("2f",)) for both in ((found, true), there))
    assert figures(after) == pytest.approx(figures(before), rel=1e-7, abs=1e-6)


@pytest.mark.parametrize("kind", GROUPS)
@settings(max_examples=12)
@given(seed=seeds, other=seeds)
def test_a_moved_copy_has_no_error_and_reports_how_it_was_moved(kind, seed, other):
    _, true = trajectories(seed)
    rng = np.random.default_rng(other)
    heading, tilt, scale = GROUPS[kind]
    world = Rotation.from_euler("ZYX", rng.uniform(-3, 3, 3) * (heading, tilt, tilt))
    factor = float(rng.uniform(0.1, 10)) if scale else 1.0
    shift = heading * rng.uniform(-1e3, 1e3, 3)
    report = evaluate_trajectory(moved(true, world, shift, factor), true, align=kind, rpe_deltas=("1f",))
    assert max(figures(report)) < 1e-5
    assert report.alignment.scale == pytest.approx(1 / factor, rel=1e-9)
    back = Rotation.from_quat(report.alignment.quaternion_xyzw)
    assert (back * world).magnitude() < 1e-7
    np.testing.assert_allclose(report.alignment.translation, -back.apply(shift) / factor, atol=1e-5)
    assert report.coverage == 1.0


@settings(max_examples=12)
@given(seed=seeds)
def test_a_richer_alignment_leaves_less_and_the_figures_of_errors_keep_their_order(seed):
    found, true = trajectories(seed)
    reports = [evaluate_trajectory(found, true, align=kind) for kind in ("none", "yaw", "se3", "sim3")]
    left = [report.absolute.translation.rms for report in reports]
    assert all(later <= earlier + 1e-9 for earlier, later in pairwise(left))

    reported = reports[0].absolute.translation
    assert reported.min <= reported.median <= reported.percentile_95 <= reported.max
    assert reported.min <= reported.mean <= reported.rms <= reported.max
    assert reported.rms**2 == pytest.approx(reported.mean**2 + reported.std**2)
