"""Which boxes stand for things that have none yet: the surest first, and no second box of any."""

import numpy as np
from numba import njit

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel


@njit(nogil=True, error_model="numpy", inline="always")
def _overlap_more(a, i, b, j, least):  # type: ignore[no-untyped-def]
    """Whether two boxes of an image overlap by more than a share; those with NaN do not."""
    wide = min(a[i, 2], b[j, 2]) - max(a[i, 0], b[j, 0])
    high = min(a[i, 3], b[j, 3]) - max(a[i, 1], b[j, 1])
    if not (wide > 0.0 and high > 0.0):
        return False
    both = (a[i, 2] - a[i, 0]) * (a[i, 3] - a[i, 1]) + (b[j, 2] - b[j, 0]) * (b[j, 3] - b[j, 1])
    return wide * high > least * (both - wide * high)


@kernel(
    "int64[::1](int64[::1], float64[:,::1], boolean[::1], float64[:,:,::1], float64[:,::1], boolean[::1], "
    "float64[:,:,::1], float64, float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def without_twins(
    rows: Int64Array,
    locations: Float64Array,
    measured: BoolArray,
    corners: Float64Array,
    known_locations: Float64Array,
    known_measured: BoolArray,
    known_corners: Float64Array,
    share: float,
    overlap: float,
) -> Int64Array:
    """Leave out boxes that are second boxes of a thing that is known, or of a box before them that was kept.

    A box that a sweep placed is one of a thing if their middles are nearer to each other on the ground than a share of
    the thing's width. Where a sweep did not location both, they are one if their boxes in some image overlap; of two
    that sweeps location apart one may stand before the other, however they overlap there.

    Args:
        rows: (K,), which boxes, the surest first.
        locations: (M, 3) [m], middles on the ground and widths of the boxes.
        measured: (M,), whether a sweep placed them.
        corners: (C, M, 4) [px], in each image; NaN where there is none.
        known_locations, known_measured, known_corners: the same of N things that are known.
        share: of a width.
        overlap: intersection over union.

    Returns:
        Those of the rows that are kept.
    """
    kept, count = np.empty(len(rows), np.int64), 0
    for k in range(len(rows)):
        row, is_new = rows[k], True
        for n in range(len(known_locations) + count):
            known = n < len(known_locations)
            i = n if known else kept[n - len(known_locations)]
            others, boxes = (known_locations, known_corners) if known else (locations, corners)
            placed = known_measured[i] if known else measured[i]
            if measured[row]:
                x, y = locations[row, 0] - others[i, 0], locations[row, 1] - others[i, 1]
                if x * x + y * y < (share * others[i, 2]) ** 2:
                    is_new = False
            if is_new and not (measured[row] and placed):
                for c in range(len(corners)):
                    if _overlap_more(corners[c], row, boxes[c], i, overlap):
                        is_new = False
            if not is_new:
                break
        if is_new:
            kept[count] = row
            count += 1
    return kept[:count].copy()
