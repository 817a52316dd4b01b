"""Where the distortion of a chart folds: searched in every direction, in compiled code."""

import math

from numba import njit

from sceneloom.cameras.compiled import PART
from sceneloom.cameras.formulas import distort

_DIRECTIONS = 180
_STEPS = 200
_ROUNDS = 3
_JUST_INSIDE = 1.0 - 1e-9
_WIDEST = math.radians(89.9)


@njit(**PART)
def _is_one_to_one(radius, lens):  # type: ignore[no-untyped-def]
    """Say whether the slopes on a circle of the chart keep every step within 90 degrees of its direction.

    Where they do so all over a disk, no two of its places are taken to one: the step between them would be turned
    back. Slopes of lenses are symmetric or nearly so, and then this ends just where the area factor vanishes.
    """
    for k in range(_DIRECTIONS):
        about = 2.0 * math.pi * k / _DIRECTIONS
        _, _, xx, xy, yx, yy = distort(radius * math.cos(about), radius * math.sin(about), lens)
        if not (xx > 0.0 and yy > 0.0 and 4.0 * xx * yy > (xy + yx) * (xy + yx)):
            return False
    return True


@njit(**PART)
def radius_without_fold(lens):  # type: ignore[no-untyped-def]
    """Give the radius of the disk, `lens.limit` at most, within which no two places are taken to one."""
    low, high = 0.0, min(_JUST_INSIDE * math.atan(lens.limit), _WIDEST)
    for attempt in range(_ROUNDS):
        step, folded = (high - low) / (_STEPS - 1), -1
        for k in range(_STEPS):
            if not _is_one_to_one(math.tan(low + k * step), lens):
                folded = k
                break
        if folded < 0:
            return lens.limit if attempt == 0 else math.tan(low)
        low, high = low + max(folded - 1, 0) * step, low + folded * step
    return math.tan(low)
