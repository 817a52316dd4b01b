"""How likely objects are that one detector or both report: the formulas, each a function of plain numbers, and loops.

What detectors are like stands in a table of numbers, a row for each kind of object and the columns named below; which
kind an object is of says its row. `detections.existence` fills the table and derives the formulas.

The loops are in one module with the formulas, since a compiled loop that is kept on disk knows the age of its own
module only.
"""

import numpy as np
from numba import njit

from sceneloom.arrays import Float64Array, Int64Array

PRIOR, RECALL_2D, RECALL_3D, LEAST_HEIGHT_PX, FARTHEST_3D = range(5)
"""The columns of the table: logarithm of the prior odds, and as `ProjectionSettings` names them."""
COLUMNS = 5

SUREST = 1e-6
"""No detector is surer than this of what is there or not: two of them could not contradict each other."""
_LIMIT = float(np.log((1.0 - SUREST) / SUREST))

_TABLE, _TOLD = "Array(float64, 2, 'C', readonly=True)", "Array(float64, 1, 'C', readonly=True)"


@njit(nogil=True, error_model="numpy", inline="always")
def _told(score, is_logit, kind, table):  # type: ignore[no-untyped-def]
    """Logarithm of the odds of a box with this score; a score that is no number leaves the prior."""
    if np.isnan(score):
        return table[kind, PRIOR]
    if is_logit:
        return min(max(score, -_LIMIT), _LIMIT)
    share = min(max(score, SUREST), 1.0 - SUREST)
    return np.log(share / (1.0 - share))


@njit(nogil=True, error_model="numpy", inline="always")
def _agreed(odds_3d, odds_2d, kind, table):  # type: ignore[no-untyped-def]
    """Logarithm of the odds of an object that both detectors report."""
    return odds_3d + odds_2d - table[kind, PRIOR]


@njit(nogil=True, error_model="numpy", inline="always")
def _missed(odds, chance):  # type: ignore[no-untyped-def]
    """Logarithm of the odds of an object that one detector reports, and the other had this chance to find."""
    return odds + np.log1p(-chance)


@njit(nogil=True, error_model="numpy", inline="always")
def _chance_in_picture(height, seen_share, kind, table):  # type: ignore[no-untyped-def]
    """Chance that the detector of pictures finds an object so high [px], of which so much is seen."""
    high = height >= table[kind, LEAST_HEIGHT_PX]
    return table[kind, RECALL_2D] * seen_share if high else 0.0


@njit(nogil=True, error_model="numpy", inline="always")
def _chance_in_sweep(distance, kind, table):  # type: ignore[no-untyped-def]
    """Chance that the detector of sweeps finds an object so far away [m]."""
    return table[kind, RECALL_3D] if distance <= table[kind, FARTHEST_3D] else 0.0


@njit(nogil=True, error_model="numpy", inline="always")
def _probability(odds):  # type: ignore[no-untyped-def]
    return 1.0 / (1.0 + np.exp(-odds))


@njit(
    f"Tuple((float64[::1], float64[::1]))({_TOLD}, int64[::1], boolean, int64[::1], {_TABLE})",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def told_odds(
    scores: Float64Array,
    rows: Int64Array,
    is_logit: bool,  # noqa: FBT001 - compiled functions take no keywords
    kinds: Int64Array,
    table: Float64Array,
) -> tuple[Float64Array, Float64Array]:
    """Give what the scores of one detector say.

    Args:
        scores: of all of its boxes.
        rows: (N,), which of them count.
        is_logit: whether scores are logarithms of odds, else probabilities.
        kinds: (N,), rows of the table.
        table: (K, COLUMNS).

    Returns:
        (N,) float64 logarithms of odds, and (N,) float64 probabilities.
    """
    odds, shares = np.empty(len(rows)), np.empty(len(rows))
    for n in range(len(rows)):
        odds[n] = _told(scores[rows[n]], is_logit, kinds[n], table)
        shares[n] = _probability(odds[n])
    return odds, shares


@njit(
    f"float64[::1](float64[:,::1], float64[::1], int64[::1], float64[::1], float64[::1], int64[::1], {_TABLE})",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def scores_of_sweep(
    outlines_xyxy: Float64Array,
    seen_shares: Float64Array,
    partners: Int64Array,
    odds_3d: Float64Array,
    odds_2d: Float64Array,
    kinds: Int64Array,
    table: Float64Array,
) -> Float64Array:
    """Give how likely the objects of the boxes of a sweep are.

    Args:
        outlines_xyxy: (N, 4) [px], where the picture shows them; zeros where it does not.
        seen_shares: (N,), which share of each the picture shows.
        partners: (N,), which box of the picture is the same object, -1 for none.
        odds_3d, odds_2d: (N,) and (M,), logarithms of odds by each detector.
        kinds: (N,), rows of the table.
        table: (K, COLUMNS).

    Returns:
        (N,) float64, probabilities.
    """
    scores = np.empty(len(partners))
    for n in range(len(partners)):
        if partners[n] >= 0:
            odds = _agreed(odds_3d[n], odds_2d[partners[n]], kinds[n], table)
        else:
            height = outlines_xyxy[n, 3] - outlines_xyxy[n, 1]
            odds = _missed(odds_3d[n], _chance_in_picture(height, seen_shares[n], kinds[n], table))
        scores[n] = _probability(odds)
    return scores


@njit(
    f"float64[::1](int64[::1], float64[::1], float64[::1], int64[::1], {_TABLE})",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def scores_of_picture(
    rows: Int64Array,
    distances: Float64Array,
    odds_2d: Float64Array,
    kinds: Int64Array,
    table: Float64Array,
) -> Float64Array:
    """Give how likely the objects of boxes of a picture alone are.

    Args:
        rows: (L,), which boxes of the picture are alone.
        distances: (L,) [m], how far those may be.
        odds_2d: (M,), logarithms of odds.
        kinds: (M,), rows of the table.
        table: (K, COLUMNS).

    Returns:
        (L,) float64, probabilities.
    """
    scores = np.empty(len(rows))
    for n in range(len(rows)):
        kind = kinds[rows[n]]
        scores[n] = _probability(_missed(odds_2d[rows[n]], _chance_in_sweep(distances[n], kind, table)))
    return scores
