"""How upright boxes in an image overlap: boxes of two lists with one another, and with nearer ones of their own."""

import numpy as np
from numba import njit

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.cache import kernel


@njit(nogil=True, error_model="numpy", inline="always")
def _common(a, i, b, j):  # type: ignore[no-untyped-def]
    """The area that two boxes share [px²]."""
    wide = min(a[i, 2], b[j, 2]) - max(a[i, 0], b[j, 0])
    high = min(a[i, 3], b[j, 3]) - max(a[i, 1], b[j, 1])
    return wide * high if wide > 0.0 and high > 0.0 else 0.0


@njit(nogil=True, error_model="numpy", inline="always")
def _area(a, i):  # type: ignore[no-untyped-def]
    return (a[i, 2] - a[i, 0]) * (a[i, 3] - a[i, 1])


@kernel(
    "float64[:,::1](float64[:,::1], float64[:,::1], int64[::1], int64[::1], Array(int64, 1, 'C', readonly=True), "
    "float64[::1], float64[::1], float64, float64, float64, float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def pair_gains(
    first: Float64Array,
    second: Float64Array,
    first_classes: Int64Array,
    second_classes: Int64Array,
    families: Int64Array,
    first_shares: Float64Array,
    second_shares: Float64Array,
    least_iou: float,
    same_family: float,
    one_unknown: float,
    surer: float,
) -> Float64Array:
    """Report what it is worth to take a box of one list and one of another for the same object.

    Args:
        first, second: (N, 4) and (M, 4) [px], left, top, right, bottom; finite.
        first_classes, second_classes: (N,) and (M,), numbers of classes; those beyond the families have the last.
        families: (K,), of classes; -1 for none.
        first_shares, second_shares: (N,) and (M,), 0 to 1, how sure each box is.
        least_iou: boxes that overlap less are worth nothing, nor are those without an area in common.
        same_family: factor for boxes of different classes of one family.
        one_unknown: factor for boxes one of which has no family.
        surer: two boxes that are quite sure are worth this share more.

    Returns:
        (N, M) float64: (1 + GIoU) / 2 times those factors, 0 for boxes of classes that are never the same.
    """
    gains, last = np.zeros((len(first), len(second))), len(families) - 1
    for i in range(len(first)):
        family = families[min(first_classes[i], last)]
        for j in range(len(second)):
            if first[i, 2] <= second[j, 0] or second[j, 2] <= first[i, 0]:
                continue
            common = _common(first, i, second, j)
            if common <= 0.0:
                continue
            both = _area(first, i) + _area(second, j) - common
            if common < least_iou * both:
                continue
            other = families[min(second_classes[j], last)]
            if first_classes[i] == second_classes[j]:
                weight = 1.0
            elif family < 0 or other < 0:
                weight = one_unknown
            elif family == other:
                weight = same_family
            else:
                continue
            hull = (max(first[i, 2], second[j, 2]) - min(first[i, 0], second[j, 0])) * (
                max(first[i, 3], second[j, 3]) - min(first[i, 1], second[j, 1])
            )
            worth = (1.0 + common / both - (hull - both) / hull) / 2.0
            gains[i, j] = worth * weight * (1.0 + surer * (first_shares[i] + second_shares[j]) / 2.0)
    return gains


@kernel(
    "void(float64[:,::1], float64[::1], float64[::1], float64[::1], float64[::1], float64, float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def hide_covered(
    boxes: Float64Array,
    shares: Float64Array,
    distances: Float64Array,
    gaps: Float64Array,
    likely: Float64Array,
    near: float,
    margin: float,
) -> None:
    """Take from the share of each box that is seen what another one is likely to cover: of the nearer ones the most.

    Args:
        boxes: (N, 4) [px], left, top, right, bottom; those the wrong way round, or around the eye, become 0.
        shares: (N,), changed; 0 for boxes without area.
        distances: (N,) [m], how far each is.
        gaps: (N,) [m], how far from the eye each begins.
        likely: (N,), how likely it is that each exists.
        near: what begins nearer than this is around the eye [m].
        margin: boxes that are less nearer than this are in one location, and cover nothing [m].
    """
    for i in range(len(boxes)):
        if gaps[i] <= near or boxes[i, 2] <= boxes[i, 0] or boxes[i, 3] <= boxes[i, 1]:
            boxes[i], shares[i] = 0.0, 0.0
    shown = np.flatnonzero((boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1]))
    order = shown[np.argsort(distances[shown])]
    lefts, rights = boxes[order, 0], boxes[order, 2]
    nearer = 0
    for k in range(len(order)):
        i, most = order[k], 0.0
        while distances[order[nearer]] < distances[i] - margin:
            nearer += 1
        for n in range(nearer):
            if lefts[n] < boxes[i, 2] and rights[n] > boxes[i, 0]:
                j = order[n]
                most = max(most, likely[j] * _common(boxes, i, boxes, j) / _area(boxes, i))
        shares[i] *= 1.0 - most
