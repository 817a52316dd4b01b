"""How boxes of two lists overlap, frame by frame: each box with all those of the other list in its frame.

Lists are sorted by frame; `starts` (F + 1,) reports where the boxes of each frame begin. What is stated for pairs
stands in one flat array: frame after frame, and in each the first list's boxes as rows and the second's as columns.
"""

import numpy as np
from numba import njit

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.cache import kernel

_NOTHING = float(np.finfo(np.float64).eps)
"""Areas up to this are none, as in the evaluations that results are compared with."""


@kernel("int64[::1](int64[::1], int64[::1])", nogil=True, cache=True)
def pair_starts(first_starts: Int64Array, second_starts: Int64Array) -> Int64Array:
    """Report where the pairs of each frame begin, (F + 1,) int64."""
    starts = np.zeros(len(first_starts), np.int64)
    for f in range(len(first_starts) - 1):
        rows = first_starts[f + 1] - first_starts[f]
        starts[f + 1] = starts[f] + rows * (second_starts[f + 1] - second_starts[f])
    return starts


@njit(nogil=True, error_model="numpy", inline="always")
def _areas(first, i, second, j):  # type: ignore[no-untyped-def]
    """The areas of two boxes, and what they share [px²]."""
    own = (first[i, 2] - first[i, 0]) * (first[i, 3] - first[i, 1])
    other = (second[j, 2] - second[j, 0]) * (second[j, 3] - second[j, 1])
    wide = min(first[i, 2], second[j, 2]) - max(first[i, 0], second[j, 0])
    high = min(first[i, 3], second[j, 3]) - max(first[i, 1], second[j, 1])
    return own, other, wide * high if wide > 0.0 and high > 0.0 else 0.0


@kernel(
    "float64[::1](float64[:,::1], float64[:,::1], int64[::1], int64[::1], int64[::1])",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def image_overlaps(
    first: Float64Array,
    second: Float64Array,
    first_starts: Int64Array,
    second_starts: Int64Array,
    starts: Int64Array,
) -> Float64Array:
    """Give the intersection over the union of boxes of an image.

    Args:
        first, second: (N, 4) and (M, 4) [px], left, top, right, bottom.
        first_starts, second_starts, starts: (F + 1,), of the boxes and of the pairs.

    Returns:
        (P,) float64, 0 to 1; 0 where a box has no area.
    """
    overlaps = np.zeros(starts[-1])
    for f in range(len(starts) - 1):
        k = starts[f]
        for i in range(first_starts[f], first_starts[f + 1]):
            for j in range(second_starts[f], second_starts[f + 1]):
                own, other, common = _areas(first, i, second, j)
                if own > _NOTHING and other > _NOTHING:
                    overlaps[k] = common / (own + other - common)
                k += 1
    return overlaps


@kernel(
    "float64[::1](float64[:,::1], float64[:,::1], int64[::1], int64[::1], int64[::1])",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def image_shares(
    regions: Float64Array,
    boxes: Float64Array,
    region_starts: Int64Array,
    box_starts: Int64Array,
    starts: Int64Array,
) -> Float64Array:
    """Give the share of each box of an image that lies in each region.

    Args:
        regions, boxes: (N, 4) and (M, 4) [px], left, top, right, bottom.
        region_starts, box_starts, starts: (F + 1,), of regions, boxes and pairs.

    Returns:
        (P,) float64, 0 to 1; 0 where a box has no area.
    """
    shares = np.zeros(starts[-1])
    for f in range(len(starts) - 1):
        k = starts[f]
        for i in range(region_starts[f], region_starts[f + 1]):
            for j in range(box_starts[f], box_starts[f + 1]):
                _, area, common = _areas(regions, i, boxes, j)
                if area > _NOTHING:
                    shares[k] = common / area
                k += 1
    return shares


@kernel(
    "float64[::1](float64[:,::1], float64[:,::1], int64[::1], int64[::1], int64[::1], float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def nearnesses(
    first: Float64Array,
    second: Float64Array,
    first_starts: Int64Array,
    second_starts: Int64Array,
    starts: Int64Array,
    reach: float,
) -> Float64Array:
    """Report how near locations are: 1 for the same location, falling with the distance to 0 at `reach` [m].

    Args:
        first, second: (N, D) and (M, D) [m].
        first_starts, second_starts, starts: (F + 1,), of the locations and of the pairs.
        reach: where it is 0 [m].

    Returns:
        (P,) float64, 0 to 1.
    """
    near = np.zeros(starts[-1])
    for f in range(len(starts) - 1):
        k = starts[f]
        for i in range(first_starts[f], first_starts[f + 1]):
            for j in range(second_starts[f], second_starts[f + 1]):
                square = 0.0
                for d in range(first.shape[1]):
                    square += (first[i, d] - second[j, d]) ** 2
                near[k] = max(0.0, 1.0 - np.sqrt(square) / reach)
                k += 1
    return near
