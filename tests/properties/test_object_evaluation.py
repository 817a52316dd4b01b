"""What holds of any boxes and any tracks: symmetry, motion of both sides, names of objects."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sceneloom.evaluate.objects import FramePairs, ObjectTable, Similarity, similarities
from sceneloom.evaluate.tracking import TrackingRules, score_sequence

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


@given(BOXES, BOXES, SPACES)
def test_overlaps_are_the_same_from_either_side_and_never_above_one(first, second, similarity):
    found = overlaps(first, second, similarity)
    assert (found >= 0).all()
    assert (found <= 1).all()
    np.testing.assert_allclose(found, overlaps(second, first, similarity).T, rtol=0, atol=ROUNDING)


@given(BOXES, BOXES, SPACES, NUMBERS, arrays(float, 3, elements=NUMBERS))
def test_overlaps_do_not_change_where_both_move_together(first, second, similarity, delta_rotation, shift):
    def moved(boxes: np.ndarray) -> np.ndarray:
        cosine, sine = np.cos(delta_rotation), np.sin(delta_rotation)
        rotation = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        return np.hstack([boxes[:, :3] @ rotation.T + shift, boxes[:, 3:6], boxes[:, 6:] + delta_rotation])

    expected = overlaps(first, second, similarity)
    np.testing.assert_allclose(overlaps(moved(first), moved(second), similarity), expected, rtol=0, atol=ROUNDING)


@given(BOXES, SPACES)
def test_overlaps_do_not_change_where_a_box_is_rotated_by_half_a_circle(boxes, similarity):
    rotated = boxes + np.array([0, 0, 0, 0, 0, 0, np.pi])
    np.testing.assert_allclose(
        overlaps(boxes, rotated, similarity), overlaps(boxes, boxes, similarity), rtol=0, atol=ROUNDING
    )


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
