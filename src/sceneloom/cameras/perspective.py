"""Perspective camera models: `pinhole`, and `brown_conrady` with distortion and a tilted image plane."""

import math
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.compiled import (
    compiled_fold,
    compiled_model,
    first_positive_root,
    look_along,
    look_through_chart,
)
from sceneloom.cameras.formulas import (
    CENTRED,
    MINIMUM_DEPTH,
    distort,
    formula_of,
    numbers_of,
    pixel_of_plane,
    plane_of_pixel,
    prepared,
    project_point,
    ray_in_perspective,
    ray_of_chart,
    ray_of_pixel,
    rays_of_pixels,
    shift_and_decentre,
    use_formulas,
)

# Without distortion: u = fx X/Z + cx, v = fy Y/Z + cy.
#
# Source: Hartley and Zisserman 2004, "Multiple View Geometry", eq. 6.2 and 6.9.

Pinhole = numbers_of("pinhole", __name__)
use_formulas(Pinhole, {**CENTRED, ray_of_chart: ray_in_perspective, rays_of_pixels: look_along})


@formula_of(Pinhole, project_point)
def _project(x: Any, y: Any, z: Any, c: Any) -> Any:
    u, v = pixel_of_plane(x / z, y / z, c)
    return (u if z > MINIMUM_DEPTH else math.nan), v


@formula_of(Pinhole, ray_of_pixel)
def _ray(u: Any, v: Any, c: Any) -> Any:
    x, y = plane_of_pixel(u, v, c)
    return ray_of_chart(x, y, c)


PINHOLE = compiled_model(Pinhole, lambda _coefficients: math.inf)

# With radial (rational), tangential, thin-prism and tilt distortion: with x = X/Z, y = Y/Z, s = x² + y² and
# a = x + lx, b = y + ly the distorted point is
#
#     x' = a g + 2 p1 a b + p2 (s + 2 a²) + s1 s + s2 s²
#     y' = b g + p1 (s + 2 b²) + 2 p2 a b + s3 s + s4 s²
#     g = (1 + k1 s + k2 s² + k3 s³) / (1 + k4 s + k5 s² + k6 s³)
#
# which the tilt of the image plane (tx, ty) then maps on. The domain is the disk sqrt(s) < limit within which the
# mapping does not fold.
#
# Source: OpenCV documentation, "Camera Calibration and 3D Reconstruction", detailed description (which has no lx, ly);
# the order of the first ten coefficients, and lx and ly, are those of the Sensor Fusion Scene format.

BrownConrady = numbers_of("brown_conrady", __name__)
BrownConradyPrepared = numbers_of(
    "brown_conrady", __name__, computed="is_rational scale_x scale_y shear w_x w_y w_1 is_tilted"
)
use_formulas(BrownConradyPrepared, {ray_of_chart: ray_in_perspective, rays_of_pixels: look_through_chart})


@formula_of(BrownConrady, prepared)
def _with_tilt(given: Any, c: Any) -> Any:
    is_rational, is_tilted = c.k4 != 0.0 or c.k5 != 0.0 or c.k6 != 0.0, c.tx != 0.0 or c.ty != 0.0
    cos_x, sin_x, cos_y, sin_y = math.cos(c.tx), math.sin(c.tx), math.cos(c.ty), math.sin(c.ty)
    tilt = (cos_x, cos_y, sin_x * sin_y, sin_y, cos_y * sin_x, cos_y * cos_x)
    return BrownConradyPrepared(*given, is_rational, *tilt, is_tilted)


@formula_of(BrownConradyPrepared, project_point)
def _project_distorted(x: Any, y: Any, z: Any, c: Any) -> Any:
    a, b = x / z, y / z
    to_x, to_y, _, _, _, _ = distort(a, b, c)
    u, v = pixel_of_plane(to_x, to_y, c)
    known = (z > MINIMUM_DEPTH) & (a * a + b * b < c.limit * c.limit)
    return (u if known else math.nan), v


@formula_of(BrownConradyPrepared, distort)
def _distort(a: Any, b: Any, c: Any) -> Any:
    s = a * a + b * b
    g = 1.0 + s * (c.k1 + s * (c.k2 + s * c.k3))
    g_s = c.k1 + s * (2.0 * c.k2 + s * 3.0 * c.k3)
    if c.is_rational:
        below = 1.0 / (1.0 + s * (c.k4 + s * (c.k5 + s * c.k6)))
        g = g * below
        g_s = (g_s - g * (c.k4 + s * (2.0 * c.k5 + s * 3.0 * c.k6))) * below
    x, y, xx, xy, yx, yy = shift_and_decentre(a, b, g, g_s, c.lx, c.ly, c.p1, c.p2)
    prism_x, prism_y = 2.0 * (c.s1 + 2.0 * c.s2 * s), 2.0 * (c.s3 + 2.0 * c.s4 * s)
    return (
        x + s * (c.s1 + s * c.s2),
        y + s * (c.s3 + s * c.s4),
        xx + a * prism_x,
        xy + b * prism_x,
        yx + a * prism_y,
        yy + b * prism_y,
    )


@formula_of(BrownConradyPrepared, pixel_of_plane)
def _tilted_pixel(x: Any, y: Any, c: Any) -> Any:
    if c.is_tilted:
        w = c.w_x * x - c.w_y * y + c.w_1
        x, y = c.scale_x * x / w, (c.scale_y * y - c.shear * x) / w
        x = x if w > 0.0 else math.nan
    return c.fx * x + c.cx, c.fy * y + c.cy


@formula_of(BrownConradyPrepared, plane_of_pixel)
def _plane_of_tilted_pixel(u: Any, v: Any, c: Any) -> Any:
    x, y = (u - c.cx) / c.fx, (v - c.cy) / c.fy
    if c.is_tilted:
        # The two linear equations that the tilt poses.
        xx, xy = c.scale_x - x * c.w_x, x * c.w_y
        yx, yy = -c.shear - y * c.w_x, c.scale_y + y * c.w_y
        determinant = xx * yy - xy * yx
        share = c.w_1 / determinant if determinant > 0.0 else math.nan
        x, y = (x * yy - xy * y) * share, (xx * y - yx * x) * share
    return x, y


def _limit(coefficients: tuple[float, ...]) -> float:
    """The first fold or pole of the radial part, or a nearer fold that the other terms make in some direction."""
    k1, k2, _, _, k3, k4, k5, k6 = coefficients[:8]
    above, below = np.array([k3, k2, k1, 1.0]), np.array([k6, k5, k4, 1.0])
    # The slope of r N(s)/D(s), s = r², has the sign of N D + 2 s (N' D - N D').
    bend: Float64Array = np.polysub(np.polymul(np.polyder(above), below), np.polymul(above, np.polyder(below)))
    slope = np.polyadd(np.polymul(above, below), np.polymul([2.0, 0.0], bend))
    limit = math.sqrt(min(first_positive_root(slope), first_positive_root(below)))
    if not any(coefficients[2:4] + coefficients[8:14]):
        return limit
    return _fold(coefficients, limit)


BROWN_CONRADY = compiled_model(BrownConrady, _limit)
_fold = compiled_fold(BrownConrady)
