"""How upright boxes in a picture overlap: boxes of two lists with one another, and with nearer ones of their own."""

import numpy as np
from numba import njit

from sceneloom.arrays import Float64Array, Int64Array


@njit(nogil=True, error_model="numpy", inline="always")
def _common(a, i, b, j):  # type: ignore[no-untyped-def]
    """The area that two boxes share [px²]."""
    wide = min(a[i, 2], b[j, 2]) - max(a[i, 0], b[j, 0])
    high = min(a[i, 3], b[j, 3]) - max(a[i, 1], b[j, 1])
    return wide * high if wide > 0.0 and high > 0.0 else 0.0


@njit(nogil=True, error_model="numpy", inline="always")
def _area(a, i):  # type: ignore[no-untyped-def]
    return (a[i, 2] - a[i, 0]) * (a[i, 3] - a[i, 1])


@njit(
    "float64[:,::1](float64[:,::1], float64[:,::1], int64[:,::1], int64[:,::1], float64[::1], float64[::1], float64, "
    "float64, float64, float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def pair_gains(
    first: Float64Array,
    second: Float64Array,
    first_classes: Int64Array,
    second_classes: Int64Array,
    first_shares: Float64Array,
    second_shares: Float64Array,
    least_iou: float,
    same_family: float,
    one_unknown: float,
    surer: float,
) -> Float64Array:
    """Say what it is worth to take a box of one list and one of another for the same object.

    Args:
        first, second: (N, 4) and (M, 4) [px], left, top, right, bottom; finite.
        first_classes, second_classes: (N, 2) and (M, 2), class and family, -1 for none.
        first_shares, second_shares: (N,) and (M,), 0 to 1, how sure each box is.
        least_iou: boxes that overlap less are worth nothing, nor are those without an area in common.
        same_family: factor for boxes of different classes of one family.
        one_unknown: factor for boxes one of which has no family.
        surer: two boxes that are quite sure are worth this share more.

    Returns:
        (N, M) float64: (1 + GIoU) / 2 times those factors, 0 for boxes of classes that are never the same.
    """
    gains = np.zeros((len(first), len(second)))
    for i in range(len(first)):
        for j in range(len(second)):
            common = _common(first, i, second, j)
            if common <= 0.0:
                continue
            both = _area(first, i) + _area(second, j) - common
            if common < least_iou * both:
                continue
            if first_classes[i, 0] == second_classes[j, 0]:
                weight = 1.0
            elif first_classes[i, 1] < 0 or second_classes[j, 1] < 0:
                weight = one_unknown
            elif first_classes[i, 1] == second_classes[j, 1]:
                weight = same_family
            else:
                continue
            hull = (max(first[i, 2], second[j, 2]) - min(first[i, 0], second[j, 0])) * (
                max(first[i, 3], second[j, 3]) - min(first[i, 1], second[j, 1])
            )
            worth = (1.0 + common / both - (hull - both) / hull) / 2.0
            gains[i, j] = worth * weight * (1.0 + surer * (first_shares[i] + second_shares[j]) / 2.0)
    return gains


@njit(
    "float64[::1](float64[:,::1], float64[::1], float64[::1], float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def covered_shares(
    boxes: Float64Array, distances: Float64Array, likely: Float64Array, margin: float
) -> Float64Array:
    """Say which share of each box another one is likely to cover, of those nearer the one that covers most.

    Args:
        boxes: (N, 4) [px], left, top, right, bottom.
        distances: (N,) [m], how far each is.
        likely: (N,), how likely it is that each exists.
        margin: boxes that are less nearer than this are in one place, and cover nothing [m].

    Returns:
        (N,) float64, 0 for boxes without area.
    """
    shares = np.zeros(len(boxes))
    for i in range(len(boxes)):
        area = _area(boxes, i)
        if area <= 0.0:
            continue
        for j in range(len(boxes)):
            if distances[j] < distances[i] - margin:
                shares[i] = max(shares[i], likely[j] * _common(boxes, i, boxes, j) / area)
    return shares
