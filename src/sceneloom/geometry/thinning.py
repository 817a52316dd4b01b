"""Fewer points of a curve that still give it: greedy, with a promise for every point that is left out."""

from collections.abc import Callable

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array

Misfits = Callable[[int, int], Float64Array]
"""Of the points between two others, how far each is from what these two alone would give, (n,), in tolerances."""

_FIRST_REACH = 16


def thin_greedily(count: int, misfits: Misfits) -> Int64Array:
    """Choose the points of a curve that stay.

    From each the farthest from which all between them are reported well enough.

    The reach is doubled while it fits and then halved down to the last point that does, so that a long curve that needs
    few points is not looked at point by point. What fits is tested, never inferred.

    Args:
        count: how many points there are.
        misfits: reports what would be lost by leaving out all between two; up to 1.0 is allowed, NaN is not.

    Returns:
        (K,) int64, rising, the first and the last among them.
    """
    kept, start = [0] if count else [], 0

    def fits(stop: int) -> bool:
        return stop - start < 2 or bool((misfits(start, stop) <= 1.0).all())

    while start < count - 1:
        reach = _FIRST_REACH
        good, bad = start + 1, count
        while good < count - 1:
            further = min(start + reach, count - 1)
            if not fits(further):
                bad = further
                break
            good, reach = further, 2 * reach
        while bad - good > 1 and good < count - 1:
            middle = (good + bad) // 2
            good, bad = (middle, bad) if fits(middle) else (good, middle)
        kept.append(good)
        start = good
    return np.array(kept, np.int64)
