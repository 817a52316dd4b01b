"""Existence probabilities of objects that one detector or both report.

What detectors are like stands in a table of numbers, a row for each kind of object and the columns named below; which
kind an object is of says its row. `detections.existence` fills the table and derives the formulas.
"""

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.overlaps import box_area, common_area
from sceneloom.kernels.signatures import inlined

(
    PRIOR, SWEEP_LOW, _SWEEP_HIGH, _SWEEP_BASE, _SWEEP_SLOPE, IMAGE_LOW, _IMAGE_HIGH, _IMAGE_BASE, _IMAGE_SLOPE,
    BOTH_BASE, _BOTH_SWEEP, _BOTH_IMAGE, BOTH_OVERLAP, RECALL_2D, WEAK_RECALL_2D, WEAK_SHARE, LOW_PX,
    HIGH_PX, SEEN_SHARE, RECALL_3D, FARTHEST_3D,
) = range(21)  # fmt: skip
"""The columns of the table, as `detections.detectors` names and explains them; PRIOR as logarithm of odds."""

COLUMNS = 21

USUAL_OVERLAP = 0.7
"""Overlaps of pairs count from here on."""

_SUREST = 1e-6  # no detector is surer than this of what is there or not: two of them could not contradict each other
_LIMIT = float(np.log((1.0 - _SUREST) / _SUREST))
_TABLE, _REPORTED = "Array(float64, 2, 'C', readonly=True)", "Array(float64, 1, 'C', readonly=True)"


@inlined
def _reported(score, is_logit):  # type: ignore[no-untyped-def]
    """Logarithm of the odds that a score names; NaN for one that is no number."""
    if is_logit:
        return min(max(score, -_LIMIT), _LIMIT) if score == score else score  # noqa: PLR0124 - no number
    share = min(max(score, _SUREST), 1.0 - _SUREST) if score == score else score  # noqa: PLR0124
    return np.log(share / (1.0 - share))


@inlined
def _within(reported, low, kind, table):  # type: ignore[no-untyped-def]
    """What a score reports, no lower and no higher than is known of such scores; columns from `low` on."""
    return min(max(reported, table[kind, low]), table[kind, low + 1])


@inlined
def _alone(reported, low, kind, table):  # type: ignore[no-untyped-def]
    """Logarithm of the odds of a box by its own detector; a score that is no number leaves the prior."""
    if np.isnan(reported):
        return table[kind, PRIOR]
    return table[kind, low + 2] + table[kind, low + 3] * _within(reported, low, kind, table)


@inlined
def _agreed(reported_3d, reported_2d, overlap, kind, table):  # type: ignore[no-untyped-def]
    """Logarithm of the odds of an object that both detectors report."""
    if np.isnan(reported_3d):
        return _alone(reported_2d, IMAGE_LOW, kind, table)
    if np.isnan(reported_2d):
        return _alone(reported_3d, SWEEP_LOW, kind, table)
    return (
        table[kind, BOTH_BASE]
        + table[kind, _BOTH_SWEEP] * _within(reported_3d, SWEEP_LOW, kind, table)
        + table[kind, _BOTH_IMAGE] * _within(reported_2d, IMAGE_LOW, kind, table)
        + table[kind, BOTH_OVERLAP] * (overlap - USUAL_OVERLAP)
    )


@inlined
def _openness(height, seen_share, kind, table):  # type: ignore[no-untyped-def]
    """How openly an image shows an object so high [px], of which so much is seen: 0 to 1."""
    low, high = table[kind, LOW_PX], table[kind, HIGH_PX]
    tall = 1.0 if height >= high else 0.0
    if low < height < high:
        tall = (height - low) / (high - low)
    return tall * min(seen_share / table[kind, SEEN_SHARE], 1.0)


@inlined
def _missing(weak_odds, openness, kind, table):  # type: ignore[no-untyped-def]
    """Logarithm of the chance that an image has no box of an object that lies so openly in it.

    It depends on the logarithm of the odds that the image's detector works poorly.
    """
    weak = 0.0 if np.isneginf(weak_odds) else _probability(weak_odds)
    recall = (1.0 - weak) * table[kind, RECALL_2D] + weak * table[kind, WEAK_RECALL_2D]
    return np.log1p(-recall * openness)


@inlined
def _weakness(found, odds, openness, kind, table):  # type: ignore[no-untyped-def]
    """What an object adds to the logarithm of the odds that the image's detector works poorly.

    It has these odds by its sweep, and a box in the image or none.
    """
    likely = _probability(odds)
    if found:
        return likely * np.log(table[kind, WEAK_RECALL_2D] / table[kind, RECALL_2D])
    weak = 1.0 - likely * table[kind, WEAK_RECALL_2D] * openness
    return np.log(weak / (1.0 - likely * table[kind, RECALL_2D] * openness))


@inlined
def _missed(odds, chance):  # type: ignore[no-untyped-def]
    """Logarithm of the odds of an object that one detector reports, and the other had this chance to find."""
    return odds + np.log1p(-chance)


@inlined
def _chance_in_sweep(distance, kind, table):  # type: ignore[no-untyped-def]
    """Chance that the detector of sweeps finds an object so far away [m]."""
    return table[kind, RECALL_3D] if distance <= table[kind, FARTHEST_3D] else 0.0


@inlined
def _probability(odds):  # type: ignore[no-untyped-def]
    return 1.0 / (1.0 + np.exp(-odds))


@inlined
def _overlap(one, i, other, j):  # type: ignore[no-untyped-def]
    """Intersection over union of two boxes of an image."""
    common, both = common_area(one, i, other, j), box_area(one, i) + box_area(other, j)
    return common / (both - common) if both > common else 0.0


@kernel(
    f"Tuple((float64[::1], float64[::1], float64[::1]))({_REPORTED}, int64[::1], boolean, boolean, int64[::1], "
    f"{_TABLE})"
)
def reported_odds(
    scores: Float64Array, rows: Int64Array, is_logit: bool, of_image: bool,  # noqa: FBT001 - kernels take no keywords
    kinds: Int64Array, table: Float64Array,
) -> tuple[Float64Array, Float64Array, Float64Array]:  # fmt: skip
    """Give what the scores of one detector state.

    `scores`: of all of its boxes; `rows` (N,), which of them count; `is_logit`: whether scores are logarithms of odds,
    else probabilities; `of_image`: whether it is the detector of images, else that of sweeps; `kinds` (N,), rows of the
    table; `table` (K, COLUMNS). Returns (N,) float64 logarithms of odds as the scores name them, NaN for no numbers;
    (N,) float64 logarithms of odds as they came true, and (N,) float64 probabilities.
    """
    reported, odds, shares = np.empty(len(rows)), np.empty(len(rows)), np.empty(len(rows))
    low = IMAGE_LOW if of_image else SWEEP_LOW
    for n in range(len(rows)):
        reported[n] = _reported(scores[rows[n]], is_logit)
        odds[n] = _alone(reported[n], low, kinds[n], table)
        shares[n] = _probability(odds[n])
    return reported, odds, shares


@kernel(
    "float64[::1](float64[:,::1], float64[::1], int64[::1], float64[::1], float64[::1], float64[:,::1], float64[::1], "
    f"int64[::1], {_TABLE})"
)
def scores_of_sweep(
    outlines_xyxy: Float64Array, seen_shares: Float64Array, partners: Int64Array, reported_3d: Float64Array,
    odds_3d: Float64Array, corners_xyxy: Float64Array, reported_2d: Float64Array, kinds: Int64Array,
    table: Float64Array,
) -> Float64Array:  # fmt: skip
    """Give how likely the objects of the boxes of a sweep are.

    `outlines_xyxy` (N, 4) [px], where the image shows them; zeros where it does not; `seen_shares` (N,), which share of
    each the image shows; `partners` (N,), which box of the image is the same object, -1 for none; `reported_3d`,
    `odds_3d` (N,), of `reported_odds`; `corners_xyxy` (M, 4) [px], boxes of the image; `reported_2d` (M,), of
    `reported_odds`; `kinds` (N,), rows of the table; `table` (K, COLUMNS). Returns (N,) float64, probabilities.
    """
    count = len(partners)
    scores, openness, weakness = np.empty(count), np.empty(count), np.empty(count)
    weak = 0.0
    for n in range(count):
        height = outlines_xyxy[n, 3] - outlines_xyxy[n, 1]
        openness[n] = _openness(height, seen_shares[n], kinds[n], table)
        weakness[n] = _weakness(partners[n] >= 0, odds_3d[n], openness[n], kinds[n], table)
        weak += weakness[n]
    for n in range(count):
        kind = kinds[n]
        if partners[n] >= 0:
            overlap = _overlap(outlines_xyxy, n, corners_xyxy, partners[n])
            odds = _agreed(reported_3d[n], reported_2d[partners[n]], overlap, kind, table)
        else:
            share = table[kind, WEAK_SHARE]
            others = np.log(share / (1.0 - share)) + weak - weakness[n] if share > 0.0 else -np.inf
            odds = odds_3d[n] + _missing(others, openness[n], kind, table)
        scores[n] = _probability(odds)
    return scores


@kernel(f"float64[::1](int64[::1], float64[::1], float64[::1], int64[::1], {_TABLE})")
def scores_of_image(
    rows: Int64Array, distances: Float64Array, odds_2d: Float64Array, kinds: Int64Array, table: Float64Array
) -> Float64Array:
    """Give how likely the objects of boxes of an image alone are.

    `rows` (L,), which boxes of the image are alone; `distances` (L,) [m], how far those may be; `odds_2d` (M,),
    logarithms of odds; `kinds` (M,), rows of the table; `table` (K, COLUMNS). Returns (L,) float64, probabilities.
    """
    scores = np.empty(len(rows))
    for n in range(len(rows)):
        kind = kinds[rows[n]]
        scores[n] = _probability(_missed(odds_2d[rows[n]], _chance_in_sweep(distances[n], kind, table)))
    return scores
