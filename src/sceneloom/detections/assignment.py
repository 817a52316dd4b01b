"""Which box of a sweep and which of an image are one object, and the best assignment of any pairs."""

import numpy as np
from scipy.optimize import linear_sum_assignment

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.detections.classes import FAMILIES
from sceneloom.detections.results import NO_BOX
from sceneloom.kernels import box_overlaps

SAME_FAMILY = 0.8
"""What a pair of boxes is worth whose classes are taken for one another, of one with the same class."""
ONE_UNKNOWN = 0.6
"""What it is worth where a class is in no table."""
SURER = 1e-3
"""Of boxes that fit equally well, the surer one is worth so much more at most."""


def pair_gains(
    outlines_xyxy: Float64Array,
    corners_xyxy: Float64Array,
    classes_3d: Int64Array,
    classes_2d: Int64Array,
    probabilities_3d: Float64Array,
    probabilities_2d: Float64Array,
    *,
    least_iou: float,
) -> Float64Array:
    """Report what it is worth to take a box of the sweep and one of the image for one object.

    The worth is (1 + GIoU) / 2, which is 1 for equal boxes, times a factor for the classes.

    Args:
        outlines_xyxy: (N, 4) float64 [px], of the boxes of the sweep in the image.
        corners_xyxy: (M, 4) float64 [px], boxes of the image.
        classes_3d, classes_2d: (N,) and (M,) of `classes.numbers_of`.
        probabilities_3d, probabilities_2d: (N,) and (M,).
        least_iou: boxes that overlap less are worth nothing.

    Returns:
        (N, M) float64, 0 where they cannot be one object.

    Source: Rezatofighi et al. 2019, "Generalized Intersection over Union".
    """
    gains: Float64Array = box_overlaps.pair_gains(
        outlines_xyxy,
        corners_xyxy,
        classes_3d,
        classes_2d,
        FAMILIES,
        probabilities_3d,
        probabilities_2d,
        least_iou,
        SAME_FAMILY,
        ONE_UNKNOWN,
        SURER,
    )
    return gains


def assign(gains: Float64Array) -> tuple[Int64Array, Int64Array]:
    """Pair rows with columns so that the sum of their gains is the largest; pairs without gain are none.

    Args:
        gains: (N, M), finite.

    Returns:
        (N,) int64, the column of each row, and (M,) int64, the row of each column; NO_BOX for none.
    """
    rows, columns = np.nonzero(gains > 0.0)
    rows, columns = assign_pairs(rows, columns, gains[rows, columns])
    of_rows, of_columns = (np.full(count, NO_BOX, np.int64) for count in gains.shape)
    of_rows[rows], of_columns[columns] = columns, rows
    return of_rows, of_columns


def assign_pairs(rows: Int64Array, columns: Int64Array, gains: Float64Array) -> tuple[Int64Array, Int64Array]:
    """Choose pairs so that the sum of their gains is the largest, and none shares a row or a column.

    Pairs that compete with no other are taken as they are, since SciPy's time grows with the whole table.

    Args:
        rows, columns: (K,), the pairs that there may be, each once.
        gains: (K,), of each, finite; what gains nothing is no pair.

    Returns:
        (P,) int64 rows, rising, and their columns.
    """
    worth = gains > 0.0
    rows, columns, gains = rows[worth], columns[worth], gains[worth]
    if not len(rows):
        return rows, columns
    taken = (np.bincount(rows)[rows] == 1) & (np.bincount(columns)[columns] == 1)
    rivals = np.flatnonzero(~taken)
    if len(rivals):
        first, second = _renumbered(rows[rivals]), _renumbered(columns[rivals])
        table = np.zeros((first.max() + 1, second.max() + 1))
        table[first, second] = gains[rivals]
        partners = np.full(len(table), -1)
        chosen, partners_of_chosen = linear_sum_assignment(table, maximize=True)
        partners[chosen] = partners_of_chosen
        taken[rivals] = partners[first] == second
    order = np.argsort(rows[taken])
    return rows[taken][order], columns[taken][order]


def _renumbered(numbers: Int64Array) -> Int64Array:
    """Number what is there from 0 without gaps, in the same order."""
    found: Int64Array = (np.cumsum(np.bincount(numbers) > 0) - 1)[numbers]
    return found
