"""Formulas that the panoramas share: angles about the camera's y axis."""

import math
from typing import Any

from numba import njit

from sceneloom.cameras.formulas import INLINE, angle_off_axis

NEAREST = 1e-6
"""Directions nearer to straight up or down [rad] have no pixel: rounding would decide on its column."""

HALF_ROTATION = 0.5 * math.pi + 1e-3
_SEAM = math.pi + 1e-12


@njit(**INLINE)
def azimuth(side, ahead):  # type: ignore[no-untyped-def]
    """Give the angle from `ahead` towards `side`, -pi to pi, negative where `side` is (also where it is -0)."""
    return math.copysign(angle_off_axis(abs(side), ahead), side)


@njit(**INLINE)
def azimuth_of_column(u: Any, camera_model: Any) -> Any:
    """Give the angle that a column stands for; NaN beyond the seam."""
    about = (u - camera_model.cx) / camera_model.fx
    return min(max(about, -math.pi), math.pi) if abs(about) <= _SEAM else math.nan
