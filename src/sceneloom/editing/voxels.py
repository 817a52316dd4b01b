"""Which points stay when a cloud is thinned."""

import numpy as np

from sceneloom.arrays import Float64Array, FloatArray, Int64Array
from sceneloom.errors import OptionError

NEAREST, FIRST = "nearest", "first"
KEEPERS = (NEAREST, FIRST)
"""Which point of a cube stays: the one nearest to the mean of those in it, or the first."""


def one_per_cube(positions: FloatArray, side: float, *, keep: str = NEAREST) -> Int64Array:
    """Give the rows, ascending, of one point of each cube of side `side` [m].

    Cubes begin at whole multiples of their side on either side of zero: the one at the origin is no larger than others.

    Args:
        positions: (N, 3) [m]; a point that is not finite is left out.
        side: [m].
        keep: one of `KEEPERS`.

    Raises:
        OptionError: the side is not positive, or `keep` is not one of those.
    """
    from sceneloom.kernels.voxels import first_of_cubes, nearest_of_cubes, number_cubes

    if not 0 < side < np.inf:
        raise OptionError(f"voxel {side}; expected a positive number of metres")
    if keep not in KEEPERS:
        raise OptionError(f"keep {keep!r}; expected one of {', '.join(KEEPERS)}")
    points: Float64Array = np.ascontiguousarray(positions, np.float64)
    numbers = np.empty(len(points), np.int64)
    chosen = np.empty(number_cubes(points, side, numbers), np.int64)
    first_of_cubes(numbers, chosen)
    if keep == NEAREST:
        nearest_of_cubes(points, numbers, chosen)
    return np.sort(chosen)


def evenly(count: int, wanted: int) -> Int64Array:
    """Give `wanted` of `count` rows, evenly spread; all of them where there are no more.

    Row k is the one in whose share of the rows the middle of the k-th of `wanted` equal parts falls.
    """
    if wanted >= count:
        return np.arange(count)
    return (2 * np.arange(wanted, dtype=np.int64) + 1) * count // (2 * wanted)
