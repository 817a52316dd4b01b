"""Projection over a shifted unit sphere as OpenCV has it: radial and tangential distortion, and a skewed picture.

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

from sceneloom.cameras.bending import shift_and_decentre
from sceneloom.cameras.charts import (
    pixel_by_sphere,
    ray_by_sphere,
    sphere_rim,
)
from sceneloom.cameras.compiled import (
    FOLD_SIGNATURE,
    INLINE,
    KERNEL,
    PICTURE_SIGNATURE,
    ROWS_SIGNATURE,
    first_numbers,
)
from sceneloom.cameras.domain import first_positive_root, radius_without_fold
from sceneloom.cameras.formulas import (
    distort,
    formula_of,
    pixel_of_plane,
    plane_of_pixel,
    project_point,
    ray_of_chart,
    use_formulas,
)
from sceneloom.cameras.loops import look_through_chart, pick_points, place_points
from sceneloom.kernels.cache import kernel


class OmnidirLens(NamedTuple):
    """The numbers of a lens, as the compiled functions take them apart."""

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


_COUNT = len(OmnidirLens._fields)

use_formulas(OmnidirLens, {project_point: pixel_by_sphere, ray_of_chart: ray_by_sphere})


@formula_of(OmnidirLens, pixel_of_plane)
def _skewed_pixel(x: Any, y: Any, lens: Any) -> Any:
    return lens.fx * x + lens.s * y + lens.cx, lens.fy * y + lens.cy


@formula_of(OmnidirLens, plane_of_pixel)
def _plane_of_skewed_pixel(u: Any, v: Any, lens: Any) -> Any:
    y = (v - lens.cy) / lens.fy
    return (u - lens.cx - lens.s * y) / lens.fx, y


@formula_of(OmnidirLens, distort)
def _distort(a: Any, b: Any, lens: Any) -> Any:
    s = a * a + b * b
    g, g_s = 1.0 + s * (lens.k1 + s * lens.k2), lens.k1 + s * 2.0 * lens.k2
    return shift_and_decentre(a, b, g, g_s, 0.0, 0.0, lens.p1, lens.p2)


def domain_limit(coefficients: tuple[float, ...]) -> float:
    """The distance from the axis on the plane of the sphere up to which no two rays share a pixel."""
    k1, k2, _, xi, p1, p2 = coefficients
    limit = min(math.sqrt(first_positive_root([5 * k2, 3 * k1, 1.0])), sphere_rim(xi))
    if not any((p1, p2)):
        return limit
    return float(fold_radius(np.array((1.0, 1.0, 0.0, 0.0, *coefficients, limit))))


@njit(**INLINE)
def _lens(numbers):  # type: ignore[no-untyped-def]
    return OmnidirLens(*first_numbers(numbers, _COUNT))


@kernel(PICTURE_SIGNATURE, **KERNEL)
def project_into_picture(points_world, camera_from_world, lens, width, height, kept):  # type: ignore[no-untyped-def]
    """Keep the points that fall into the picture; see `compiled`."""
    return pick_points(points_world, camera_from_world, _lens(lens), width, height, kept)


@kernel(ROWS_SIGNATURE, **KERNEL)
def project_points(points_camera, lens, pixels):  # type: ignore[no-untyped-def]
    """Give a pixel for every point; see `compiled`."""
    place_points(points_camera, _lens(lens), pixels)


@kernel(ROWS_SIGNATURE, **KERNEL)
def unproject_pixels(pixels, lens, rays):  # type: ignore[no-untyped-def]
    """Give a unit ray for every pixel; see `compiled`."""
    look_through_chart(pixels, _lens(lens), rays)


@kernel(FOLD_SIGNATURE, **KERNEL)
def fold_radius(lens: Any) -> Any:
    """Give the radius of the chart's disk up to which nothing folds, the given limit at most."""
    return radius_without_fold(_lens(lens))
