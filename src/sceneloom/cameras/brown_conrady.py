"""Perspective projection with radial (rational), tangential, thin-prism and tilt distortion.

With x = X/Z, y = Y/Z, s = x² + y² and a = x + lx, b = y + ly the distorted point is

    x' = a g + 2 p1 a b + p2 (s + 2 a²) + s1 s + s2 s²
    y' = b g + p1 (s + 2 b²) + 2 p2 a b + s3 s + s4 s²
    g = (1 + k1 s + k2 s² + k3 s³) / (1 + k4 s + k5 s² + k6 s³)

which the tilt of the image plane (tx, ty) then maps on. The domain is the disk sqrt(s) < limit within which
the mapping does not fold.

Source: OpenCV documentation, "Camera Calibration and 3D Reconstruction", detailed description (which has no
lx, ly); the order of the first ten coefficients, and lx and ly, are those of the Sensor Fusion Scene format.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from sceneloom.arrays import Float64Array
from sceneloom.cameras.formulas import (
    FOLD_SIGNATURE,
    IMAGE_SIGNATURE,
    INLINE,
    KERNEL,
    ROWS_SIGNATURE,
    distort,
    first_numbers,
    formula_of,
    pixel_in_perspective,
    pixel_of_plane,
    plane_of_pixel,
    project_point,
    ray_in_perspective,
    ray_of_chart,
    shift_and_decentre,
    use_formulas,
)
from sceneloom.cameras.loops import (
    first_positive_root,
    look_through_chart,
    pick_points,
    position_points,
    radius_without_fold,
)
from sceneloom.kernels.cache import kernel


class BrownConradyModel(NamedTuple):
    """The numbers of a camera model, as the compiled functions take them apart."""

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    p1: float
    p2: float
    k3: float
    k4: float
    k5: float
    k6: float
    lx: float
    ly: float
    s1: float
    s2: float
    s3: float
    s4: float
    tx: float
    ty: float
    limit: float
    is_rational: bool
    scale_x: float
    scale_y: float
    shear: float
    w_x: float
    w_y: float
    w_1: float
    is_tilted: bool


_COUNT = 21

use_formulas(BrownConradyModel, {project_point: pixel_in_perspective, ray_of_chart: ray_in_perspective})


@formula_of(BrownConradyModel, distort)
def _distort(a: Any, b: Any, camera_model: Any) -> Any:
    s = a * a + b * b
    g = 1.0 + s * (camera_model.k1 + s * (camera_model.k2 + s * camera_model.k3))
    g_s = camera_model.k1 + s * (2.0 * camera_model.k2 + s * 3.0 * camera_model.k3)
    if camera_model.is_rational:
        below = 1.0 / (1.0 + s * (camera_model.k4 + s * (camera_model.k5 + s * camera_model.k6)))
        g = g * below
        g_s = (g_s - g * (camera_model.k4 + s * (2.0 * camera_model.k5 + s * 3.0 * camera_model.k6))) * below
    x, y, xx, xy, yx, yy = shift_and_decentre(
        a, b, g, g_s, camera_model.lx, camera_model.ly, camera_model.p1, camera_model.p2
    )
    prism_x, prism_y = (
        2.0 * (camera_model.s1 + 2.0 * camera_model.s2 * s),
        2.0 * (camera_model.s3 + 2.0 * camera_model.s4 * s),
    )
    return (
        x + s * (camera_model.s1 + s * camera_model.s2),
        y + s * (camera_model.s3 + s * camera_model.s4),
        xx + a * prism_x,
        xy + b * prism_x,
        yx + a * prism_y,
        yy + b * prism_y,
    )


@formula_of(BrownConradyModel, pixel_of_plane)
def _tilted_pixel(x: Any, y: Any, camera_model: Any) -> Any:
    if camera_model.is_tilted:
        w = camera_model.w_x * x - camera_model.w_y * y + camera_model.w_1
        x, y = camera_model.scale_x * x / w, (camera_model.scale_y * y - camera_model.shear * x) / w
        x = x if w > 0.0 else math.nan
    return camera_model.fx * x + camera_model.cx, camera_model.fy * y + camera_model.cy


@formula_of(BrownConradyModel, plane_of_pixel)
def _plane_of_tilted_pixel(u: Any, v: Any, camera_model: Any) -> Any:
    x, y = (u - camera_model.cx) / camera_model.fx, (v - camera_model.cy) / camera_model.fy
    if camera_model.is_tilted:
        # The two linear equations that the tilt poses.
        xx, xy = camera_model.scale_x - x * camera_model.w_x, x * camera_model.w_y
        yx, yy = -camera_model.shear - y * camera_model.w_x, camera_model.scale_y + y * camera_model.w_y
        determinant = xx * yy - xy * yx
        share = camera_model.w_1 / determinant if determinant > 0.0 else math.nan
        x, y = (x * yy - xy * y) * share, (xx * y - yx * x) * share
    return x, y


def domain_limit(coefficients: tuple[float, ...]) -> float:
    """The distance from the axis on the plane z = 1 up to which no two points share a pixel.

    It is the first fold or pole of the radial part, or a nearer fold that the other terms make in some
    direction.
    """
    k1, k2, _, _, k3, k4, k5, k6 = coefficients[:8]
    above, below = np.array([k3, k2, k1, 1.0]), np.array([k6, k5, k4, 1.0])
    # The slope of r N(s)/D(s), s = r², has the sign of N D + 2 s (N' D - N D').
    bend: Float64Array = np.polysub(
        np.polymul(np.polyder(above), below), np.polymul(above, np.polyder(below))
    )
    slope = np.polyadd(np.polymul(above, below), np.polymul([2.0, 0.0], bend))
    limit = math.sqrt(min(first_positive_root(slope), first_positive_root(below)))
    if not any(coefficients[2:4] + coefficients[8:14]):
        return limit
    return float(fold_radius(np.array((1.0, 1.0, 0.0, 0.0, *coefficients, limit))))


@njit(**INLINE)
def _camera_model(numbers):  # type: ignore[no-untyped-def]
    given: Any = first_numbers(numbers, _COUNT)
    k4, k5, k6, tx, ty = given[9], given[10], given[11], given[18], given[19]
    rational, tilted = k4 != 0.0 or k5 != 0.0 or k6 != 0.0, tx != 0.0 or ty != 0.0
    cos_x, sin_x, cos_y, sin_y = math.cos(tx), math.sin(tx), math.cos(ty), math.sin(ty)
    tilt = (cos_x, cos_y, sin_x * sin_y, sin_y, cos_y * sin_x, cos_y * cos_x)
    fields: Any = (*given, rational, *tilt, tilted)
    return BrownConradyModel(*fields)


@kernel(IMAGE_SIGNATURE, **KERNEL)
def project_into_image(points_world, camera_from_world, camera_model, width, height, kept):  # type: ignore[no-untyped-def]
    """Keep the points that fall into the image; see `compiled`."""
    return pick_points(points_world, camera_from_world, _camera_model(camera_model), width, height, kept)


@kernel(ROWS_SIGNATURE, **KERNEL)
def project_points(points_camera, camera_model, pixels):  # type: ignore[no-untyped-def]
    """Give a pixel for every point; see `compiled`."""
    position_points(points_camera, _camera_model(camera_model), pixels)


@kernel(ROWS_SIGNATURE, **KERNEL)
def unproject_pixels(pixels, camera_model, rays):  # type: ignore[no-untyped-def]
    """Give a unit ray for every pixel; see `compiled`."""
    look_through_chart(pixels, _camera_model(camera_model), rays)


@kernel(FOLD_SIGNATURE, **KERNEL)
def fold_radius(camera_model: Any) -> Any:
    """Give the radius of the chart's disk up to which nothing folds, the given limit at most."""
    return radius_without_fold(_camera_model(camera_model))
