"""Projection over a shifted unit sphere as OpenCV has it: radial and tangential distortion, and a skewed image.

With P the distance of the point, x = X/(Z + ξ P), y = Y/(Z + ξ P) and r² = x² + y²

    x' = x (1 + k1 r² + k2 r⁴) + 2 p1 x y + p2 (r² + 2 x²)
    y' = y (1 + k1 r² + k2 r⁴) + p1 (r² + 2 y²) + 2 p2 x y
    u = fx x' + s y' + cx,  v = fy y' + cy

with the skew s in pixels. The domain is that of `omnidirectional`.

Source: Mei and Rives 2007, eq. 1 to 5; OpenCV documentation, "Omnidirectional Camera Calibration" (omnidir). The order
of the coefficients is that of the Spectacular AI recording format.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from sceneloom.cameras.formulas import (
    FOLD_SIGNATURE,
    IMAGE_SIGNATURE,
    INLINE,
    KERNEL,
    ROWS_SIGNATURE,
    distort,
    first_numbers,
    formula_of,
    pixel_by_sphere,
    pixel_of_plane,
    plane_of_pixel,
    project_point,
    ray_by_sphere,
    ray_of_chart,
    shift_and_decentre,
    sphere_rim,
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


class OmnidirModel(NamedTuple):
    """The numbers of a camera model, as the compiled functions take them apart."""

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    s: float
    xi: float
    p1: float
    p2: float
    limit: float


_COUNT = len(OmnidirModel._fields)

use_formulas(OmnidirModel, {project_point: pixel_by_sphere, ray_of_chart: ray_by_sphere})


@formula_of(OmnidirModel, pixel_of_plane)
def _skewed_pixel(x: Any, y: Any, camera_model: Any) -> Any:
    return camera_model.fx * x + camera_model.s * y + camera_model.cx, camera_model.fy * y + camera_model.cy


@formula_of(OmnidirModel, plane_of_pixel)
def _plane_of_skewed_pixel(u: Any, v: Any, camera_model: Any) -> Any:
    y = (v - camera_model.cy) / camera_model.fy
    return (u - camera_model.cx - camera_model.s * y) / camera_model.fx, y


@formula_of(OmnidirModel, distort)
def _distort(a: Any, b: Any, camera_model: Any) -> Any:
    s = a * a + b * b
    g, g_s = 1.0 + s * (camera_model.k1 + s * camera_model.k2), camera_model.k1 + s * 2.0 * camera_model.k2
    return shift_and_decentre(a, b, g, g_s, 0.0, 0.0, camera_model.p1, camera_model.p2)


def domain_limit(coefficients: tuple[float, ...]) -> float:
    """The distance from the axis on the plane of the sphere up to which no two rays share a pixel."""
    k1, k2, _, xi, p1, p2 = coefficients
    limit = min(math.sqrt(first_positive_root([5 * k2, 3 * k1, 1.0])), sphere_rim(xi))
    if not any((p1, p2)):
        return limit
    return float(fold_radius(np.array((1.0, 1.0, 0.0, 0.0, *coefficients, limit))))


@njit(**INLINE)
def _camera_model(numbers):  # type: ignore[no-untyped-def]
    return OmnidirModel(*first_numbers(numbers, _COUNT))


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
