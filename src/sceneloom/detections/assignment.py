"""Which box of a sweep and which of a picture are one object."""

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.detections.classes import FAMILIES
from sceneloom.kernels import box_overlaps
from sceneloom.kernels.assignment import best_partners

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
    """Say what it is worth to take a box of the sweep and one of the picture for one object.

    The worth is (1 + GIoU) / 2, which is 1 for equal boxes, times a factor for the classes.

    Args:
        outlines_xyxy: (N, 4) float64 [px], of the boxes of the sweep in the picture.
        corners_xyxy: (M, 4) float64 [px], boxes of the picture.
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
        gains: (N, M), 0 or more, finite.

    Returns:
        (N,) int64, the column of each row, and (M,) int64, the row of each column; NO_BOX for none.

    Source: Crouse 2016, "On implementing 2D rectangular assignment algorithms", solved apart for what hangs together.
    """
    found: tuple[Int64Array, Int64Array] = best_partners(gains)
    return found
