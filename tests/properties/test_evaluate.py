"""What an alignment leaves open changes no error, equal ways have none; overlaps are symmetric, names are free."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from sceneloom import evaluate_trajectory
from sceneloom.evaluate.objects import FramePairs, ObjectTable, Similarity, similarities
from sceneloom.evaluate.tracking import TrackingRules, score_sequence
from sceneloom.scene import Trajectory

GROUPS = {"none": (0, 0, 0), "yaw": (1, 0, 0), "origin": (1, 1, 0), "se3": (1, 1, 0), "sim3": (1, 1, 1)}
"""Whether a kind of alignment leaves open the heading and the location, the other rotations, and the scale."""

seeds = st.integers(0, 10_000)


def trajectories(seed):
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
def test_moving_the_estimate_by_what_is_aligned_or_both_alike_changes_nothing(kind, seed, other):
    (found, true), rng = trajectories(seed), np.random.default_rng(other)
    heading, tilt, scale = GROUPS[kind]
    factor, shift = float(rng.uniform(0.1, 10)) if scale else 1.0, rng.uniform(-1e3, 1e3, 3)
    angles = rng.uniform(-3, 3, 3)
    aligned = Rotation.from_euler("ZYX", angles * (heading, tilt, tilt))
    # yaw knows what is up, so that only rotates about the vertical leave it alone
    both = Rotation.from_euler("ZYX", angles * (1, kind != "yaw", kind != "yaw"))
    before, *after = (
        evaluate_trajectory(*ways, align=kind, rpe_deltas=("1f", "3m", "1s"))
        for ways in (
            (found, true),
            (moved(found, aligned, heading * shift, factor), true),
            [moved(trajectory, both, shift, 1.0) for trajectory in (found, true)],
        )
    )
    for report in after:
        # coordinates of 1e4 m leave 1e-12 m, angles of matrices 1e-8 rad or some 1e-6 degrees
        assert figures(report) == pytest.approx(figures(before), rel=1e-7, abs=1e-6)
        assert report.path_length == pytest.approx(before.path_length, rel=1e-9)
    assert after[0].path_length == before.path_length
    # a moved copy has no error and reports how it was moved
    copied = moved(true, aligned, heading * shift, factor)
    report = evaluate_trajectory(copied, true, align=kind, rpe_deltas=("1f",))
    assert max(figures(report)) < 1e-5
    assert report.alignment.scale == pytest.approx(1 / factor, rel=1e-9)
    back = Rotation.from_quat(report.alignment.quaternion_xyzw)
    assert (back * aligned).magnitude() < 1e-7
    np.testing.assert_allclose(report.alignment.translation, -back.apply(heading * shift) / factor, atol=1e-5)
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


NUMBERS = st.floats(-10, 10)
SIZES = st.floats(0.01, 8)
BOXES = st.tuples(
    arrays(float, (4, 3), elements=NUMBERS),
    arrays(float, (4, 3), elements=SIZES),
    arrays(float, (4, 1), elements=NUMBERS),
).map(np.hstack)
SPACES = st.sampled_from([Similarity.ABOVE, Similarity.SPACE])
ROUNDING = 1e-7
"""Areas are sums of products of lengths up to 20 m; of thin boxes little is left of them."""


def table(boxes: np.ndarray, ids: np.ndarray | None = None) -> ObjectTable:
    """All boxes in one frame; or two frames of the same two objects, where ids report it."""
    numbers = np.arange(len(boxes)) if ids is None else ids
    frames = np.zeros(len(boxes), np.int64) if ids is None else np.arange(len(boxes)) // 2
    return ObjectTable(frames, numbers.astype(np.int64), ("car",) * len(boxes), boxes=boxes)


def overlaps(first: np.ndarray, second: np.ndarray, similarity: Similarity) -> np.ndarray:
    tables = table(first), table(second)
    pairs = FramePairs.of(*(one.frame_starts(1) for one in tables))
    return similarities(*tables, pairs, similarity).reshape(len(first), len(second))


@given(BOXES, BOXES, SPACES, NUMBERS, arrays(float, 3, elements=NUMBERS))
def test_overlaps_are_the_same_from_either_side_and_wherever_both_move(first, second, similarity, rotated, shift):
    def moved(boxes: np.ndarray) -> np.ndarray:
        cosine, sine = np.cos(rotated), np.sin(rotated)
        rotation = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        return np.hstack([boxes[:, :3] @ rotation.T + shift, boxes[:, 3:6], boxes[:, 6:] + rotated])

    found = overlaps(first, second, similarity)
    assert ((found >= 0) & (found <= 1)).all()
    half_round = second + np.array([0, 0, 0, 0, 0, 0, np.pi])
    for same in (
        overlaps(second, first, similarity).T,
        overlaps(moved(first), moved(second), similarity),
        overlaps(first, half_round, similarity),
    ):
        np.testing.assert_allclose(same, found, rtol=0, atol=ROUNDING)


@given(BOXES, BOXES, st.permutations(range(50, 54)))
def test_figures_do_not_depend_on_how_objects_are_called(truth, found, names):
    rules = TrackingRules(similarity=Similarity.ABOVE, least_similarity=0.1)
    ids = np.array([0, 1, 0, 1])
    reported = score_sequence(table(found, ids), table(truth, ids), "car", rules=rules)
    renamed = score_sequence(table(found, np.array(names)[ids]), table(truth, ids + 7), "car", rules=rules)
    assert renamed.hota.hota == reported.hota.hota or abs(renamed.hota.hota - reported.hota.hota) < 1e-12
    assert (renamed.clear.tp, renamed.clear.idsw) == (reported.clear.tp, reported.clear.idsw)
    assert renamed.identity == reported.identity
    assert reported.clear.tp + reported.clear.fn == reported.clear.tp + reported.clear.fp == 4
