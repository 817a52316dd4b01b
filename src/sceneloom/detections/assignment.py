"""Which box of a sweep and which of a picture are one object."""

import numpy as np
from scipy.optimize import linear_sum_assignment

from sceneloom.arrays import Float64Array, Int64Array

SAME_FAMILY = 0.8
"""What a pair of boxes is worth whose classes are taken for one another, of one with the same class."""
ONE_UNKNOWN = 0.6
"""What it is worth where a class is in no table."""
_SURER = 1e-3
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
    """Say what it is worth to take a box of the sweep and one of the picture for one object.

    The worth is (1 + GIoU) / 2, which is 1 for equal boxes, times a factor for the classes.

    Args:
        outlines_xyxy: (N, 4) [px], of the boxes of the sweep in the picture.
        corners_xyxy: (M, 4) [px], boxes of the picture.
        classes_3d, classes_2d: (N, 2) and (M, 2) of `classes.codes`.
        probabilities_3d, probabilities_2d: (N,) and (M,).
        least_iou: boxes that overlap less are worth nothing.

    Returns:
        (N, M) float64, 0 where they cannot be one object.

    Source: Rezatofighi et al. 2019, "Generalized Intersection over Union".
    """
    a, b = outlines_xyxy[:, None], corners_xyxy[None]
    inner = np.maximum(np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2]), 0.0)
    outer = np.maximum(a[..., 2:], b[..., 2:]) - np.minimum(a[..., :2], b[..., :2])
    common, hull = inner[..., 0] * inner[..., 1], outer[..., 0] * outer[..., 1]
    both = _areas(outlines_xyxy)[:, None] + _areas(corners_xyxy) - common
    with np.errstate(divide="ignore", invalid="ignore"):
        iou, giou = common / both, common / both - (hull - both) / hull
    same = classes_3d[:, None, 0] == classes_2d[None, :, 0]
    family_3d, family_2d = classes_3d[:, None, 1], classes_2d[None, :, 1]
    known = np.where(family_3d == family_2d, SAME_FAMILY, 0.0)
    weights = np.where(same, 1.0, np.where((family_3d < 0) | (family_2d < 0), ONE_UNKNOWN, known))
    surer = 1.0 + _SURER * (probabilities_3d[:, None] + probabilities_2d) / 2.0
    fits = (common > 0.0) & (iou >= least_iou)
    gains: Float64Array = np.where(fits, (1.0 + giou) / 2.0 * weights * surer, 0.0)
    return gains


def _areas(corners_xyxy: Float64Array) -> Float64Array:
    sides = np.maximum(corners_xyxy[:, 2:] - corners_xyxy[:, :2], 0.0)
    areas: Float64Array = sides[:, 0] * sides[:, 1]
    return areas


def assign(gains: Float64Array) -> tuple[Int64Array, Int64Array]:
    """Pair rows with columns so that the sum of their gains is the largest; pairs without gain are none.

    Args:
        gains: (N, M), 0 or more, finite.

    Returns:
        (K,) int64 rows, rising, and the column of each.

    Source: Crouse 2016, "On implementing 2D rectangular assignment algorithms", as SciPy has it.
    """
    rows, columns = linear_sum_assignment(gains, maximize=True)
    kept = gains[rows, columns] > 0.0
    return rows[kept].astype(np.int64), columns[kept].astype(np.int64)
