"""Camera models over a shifted unit sphere, for mirrors and very wide lenses: `omnidirectional` and `omnidir`.

With P the distance of a point, x = X/(Z + ξ P), y = Y/(Z + ξ P) and s = x² + y². The domain is the disk sqrt(s) < limit
in which the mapping does not fold; with ξ > 1 also the nearer part of the sphere, 1 + ξ Z/P > 0. It may reach behind
the plane of the camera.

Source: Mei and Rives 2007, "Single View Point Omnidirectional Camera Calibration from Planar Grids", eq. 1 to 5.
"""

import math
from typing import Any

from sceneloom.cameras.compiled import compiled_fold, compiled_model, first_positive_root, look_through_chart
from sceneloom.cameras.formulas import (
    CENTRED,
    MINIMUM_DEPTH,
    Formula,
    distort,
    formula_of,
    numbers_of,
    pixel_of_plane,
    plane_of_pixel,
    project_point,
    ray_of_chart,
    rays_of_pixels,
    shift_and_decentre,
    use_formulas,
)


def _pixel_by_sphere(x: Any, y: Any, z: Any, c: Any) -> Any:
    """The pixel by the plane of the shifted sphere; with ξ > 1 its farther part hides behind the nearer one."""
    distance = math.sqrt(x * x + y * y + z * z)
    depth = z + c.xi * distance
    a, b = x / depth, y / depth
    to_x, to_y, _, _, _, _ = distort(a, b, c)
    u, v = pixel_of_plane(to_x, to_y, c)
    ahead = (depth > MINIMUM_DEPTH * distance) & ((c.xi <= 1.0) | (distance + c.xi * z > 0.0))
    return (u if ahead & (a * a + b * b < c.limit * c.limit) else math.nan), v


def _ray_by_sphere(a: Any, b: Any, c: Any) -> Any:
    """Give the unit ray of a location on the plane of the shifted sphere."""
    square = a * a + b * b
    scale = (c.xi + math.sqrt(1.0 + (1.0 - c.xi * c.xi) * square)) / (1.0 + square)
    return a * scale, b * scale, scale - c.xi


def _sphere_rim(xi: float) -> float:
    """The distance from the axis, on the plane of the shifted sphere, that none of its locations reaches."""
    if xi <= -1.0:
        return 0.0
    return 1.0 / math.sqrt(xi * xi - 1.0) if xi > 1.0 else math.inf


_BY_SPHERE: dict[Formula, Formula] = {
    **CENTRED,
    project_point: _pixel_by_sphere,
    ray_of_chart: _ray_by_sphere,
    rays_of_pixels: look_through_chart,
}


# With radial and tangential distortion, a = x + lx and b = y + ly:
#
#     x' = a g + 2 p1 a b + p2 (s + 2 a²),  y' = b g + p1 (s + 2 b²) + 2 p2 a b
#     g = 1 + k1 s + k2 s² + k3 s³ + k4 s⁴
#
# The order of the coefficients, and lx and ly, are those of the Sensor Fusion Scene format; that k4 takes part is
# assumed.

Omnidirectional = numbers_of("omnidirectional", __name__)
use_formulas(Omnidirectional, _BY_SPHERE)


@formula_of(Omnidirectional, distort)
def _distort(a: Any, b: Any, c: Any) -> Any:
    s = a * a + b * b
    g = 1.0 + s * (c.k1 + s * (c.k2 + s * (c.k3 + s * c.k4)))
    g_s = c.k1 + s * (2.0 * c.k2 + s * (3.0 * c.k3 + s * 4.0 * c.k4))
    return shift_and_decentre(a, b, g, g_s, c.lx, c.ly, c.p1, c.p2)


def _limit(coefficients: tuple[float, ...]) -> float:
    k1, k2, k3, k4, p1, p2, xi, lx, ly = coefficients
    fold = math.sqrt(first_positive_root([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0]))
    limit = min(fold, _sphere_rim(xi))
    return _fold(coefficients, limit) if any((p1, p2, lx, ly)) else limit


OMNIDIRECTIONAL = compiled_model(Omnidirectional, _limit)
_fold = compiled_fold(Omnidirectional)


# As OpenCV has it, with two radial coefficients and a skewed image, the skew s in pixels:
#
#     x' = x (1 + k1 r² + k2 r⁴) + 2 p1 x y + p2 (r² + 2 x²)
#     y' = y (1 + k1 r² + k2 r⁴) + p1 (r² + 2 y²) + 2 p2 x y
#     u = fx x' + s y' + cx,  v = fy y' + cy
#
# Source: OpenCV documentation, "Omnidirectional Camera Calibration" (omnidir). The order of the coefficients is that of
# the Spectacular AI recording format.

Omnidir = numbers_of("omnidir", __name__)


def _skewed_pixel(x: Any, y: Any, c: Any) -> Any:
    return c.fx * x + c.s * y + c.cx, c.fy * y + c.cy


def _plane_of_skewed_pixel(u: Any, v: Any, c: Any) -> Any:
    y = (v - c.cy) / c.fy
    return (u - c.cx - c.s * y) / c.fx, y


use_formulas(Omnidir, {**_BY_SPHERE, pixel_of_plane: _skewed_pixel, plane_of_pixel: _plane_of_skewed_pixel})


@formula_of(Omnidir, distort)
def _distort_by_two(a: Any, b: Any, c: Any) -> Any:
    s = a * a + b * b
    g, g_s = 1.0 + s * (c.k1 + s * c.k2), c.k1 + s * 2.0 * c.k2
    return shift_and_decentre(a, b, g, g_s, 0.0, 0.0, c.p1, c.p2)


def _limit_by_two(coefficients: tuple[float, ...]) -> float:
    k1, k2, _, xi, p1, p2 = coefficients
    limit = min(math.sqrt(first_positive_root([5 * k2, 3 * k1, 1.0])), _sphere_rim(xi))
    return _fold_by_two(coefficients, limit) if any((p1, p2)) else limit


OMNIDIR = compiled_model(Omnidir, _limit_by_two)
_fold_by_two = compiled_fold(Omnidir)
