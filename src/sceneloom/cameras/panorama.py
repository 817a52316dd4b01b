"""Panoramas around the camera's y axis, `cylindrical` and `equirectangular`: columns are angles. ASSUMED.

    u = fx atan2(X, Z) + cx
    v = fy Y / sqrt(X² + Z²) + cy        cylindrical
    v = fy atan2(Y, sqrt(X² + Z²)) + cy  equirectangular

All directions but straight up and down have a pixel; the seam is behind the camera, where u jumps by 2 π fx.

Source: the Sensor Fusion Scene format names the models; the formulas are those of panoramas of the names, and assumed,
since its owner's library computes the first as a pinhole, and the second to NaN nearly everywhere.
"""

import math
from typing import Any

from numba import njit

from sceneloom.cameras.compiled import compiled_model, look_along
from sceneloom.cameras.formulas import (
    CENTRED,
    INLINE,
    angle_off_axis,
    formula_of,
    numbers_of,
    project_point,
    ray_of_pixel,
    rays_of_pixels,
    sine_and_cosine,
    use_formulas,
)

_NEAREST = 1e-6  # directions nearer to straight up or down [rad] have no pixel: rounding would decide on its column

_QUARTER_ROTATION = 0.5 * math.pi + 1e-3
_SEAM = math.pi + 1e-12


@njit(**INLINE)
def _azimuth(side, ahead):  # type: ignore[no-untyped-def]
    """Give the angle from `ahead` towards `side`, -pi to pi, negative where `side` is (also where it is -0)."""
    return math.copysign(angle_off_axis(abs(side), ahead), side)


@njit(**INLINE)
def _azimuth_of_column(u, c):  # type: ignore[no-untyped-def]
    """Give the angle that a column stands for; NaN beyond the seam."""
    about = (u - c.cx) / c.fx
    return min(max(about, -math.pi), math.pi) if abs(about) <= _SEAM else math.nan


Cylindrical = numbers_of("cylindrical", __name__)
use_formulas(Cylindrical, {**CENTRED, rays_of_pixels: look_along})


@formula_of(Cylindrical, project_point)
def _onto_cylinder(x: Any, y: Any, z: Any, c: Any) -> Any:
    side = math.sqrt(x * x + z * z)
    u, v = c.fx * _azimuth(x, z) + c.cx, c.fy * (y / side) + c.cy
    return (u if side > _NEAREST * abs(y) else math.nan), v


@formula_of(Cylindrical, ray_of_pixel)
def _from_cylinder(u: Any, v: Any, c: Any) -> Any:
    about, height = _azimuth_of_column(u, c), (v - c.cy) / c.fy
    sine, cosine = sine_and_cosine(about)
    scale = 1.0 / math.sqrt(1.0 + height * height)
    if not abs(height) * _NEAREST < 1.0:
        scale = math.nan
    return sine * scale, height * scale, cosine * scale


CYLINDRICAL = compiled_model(Cylindrical, lambda _coefficients: math.pi)
Equirectangular = numbers_of("equirectangular", __name__)
use_formulas(Equirectangular, {**CENTRED, rays_of_pixels: look_along})


@formula_of(Equirectangular, project_point)
def _onto_angles(x: Any, y: Any, z: Any, c: Any) -> Any:
    side = math.sqrt(x * x + z * z)
    u, v = c.fx * _azimuth(x, z) + c.cx, c.fy * _azimuth(y, side) + c.cy
    return (u if side > _NEAREST * abs(y) else math.nan), v


@formula_of(Equirectangular, ray_of_pixel)
def _from_angles(u: Any, v: Any, c: Any) -> Any:
    sine, cosine = sine_and_cosine(_azimuth_of_column(u, c))
    latitude = (v - c.cy) / c.fy
    down, level = sine_and_cosine(latitude)
    if not (abs(latitude) < _QUARTER_ROTATION and level > _NEAREST):
        level, down = math.nan, math.nan
    return sine * level, down, cosine * level


EQUIRECTANGULAR = compiled_model(Equirectangular, lambda _coefficients: math.pi)
