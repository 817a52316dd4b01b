"""Fisheye projection with six radial and two tangential coefficients and a shifted centre. ASSUMED.

With θ the angle between the point's direction and the axis

    θd = θ (1 + k1 θ² + … + k6 θ¹²),  (x, y) = θd (X, Y) / sqrt(X² + Y²),  s = x² + y²
    x' = x + 2 p1 x y + p2 (s + 2 x²),  y' = y + p1 (s + 2 y²) + 2 p2 x y
    (u, v) = (fx x' + cx + dcx, fy y' + cy + dcy)

The domain is the cone θ < limit, π at most, within which the mapping does not fold.

Source: the Sensor Fusion Scene format names the model and its coefficients; that they act so is assumed after its
neighbours `fisheye` and `fisheye_rad_tan_prism`, the decentring being OpenCV's and the shift one of the centre [px].
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from sceneloom.cameras.bending import bend_image, stretch
from sceneloom.cameras.charts import (
    pixel_by_angle,
    ray_by_angle,
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


class RadialCustomLens(NamedTuple):
    """The numbers of a lens, as the compiled functions take them apart."""

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    k3: float
    k4: float
    k5: float
    k6: float
    p1: float
    p2: float
    dcx: float
    dcy: float
    limit: float


_COUNT = len(RadialCustomLens._fields)

use_formulas(RadialCustomLens, {project_point: pixel_by_angle, ray_of_chart: ray_by_angle})


@formula_of(RadialCustomLens, pixel_of_plane)
def _shifted_pixel(x: Any, y: Any, lens: Any) -> Any:
    return lens.fx * x + (lens.cx + lens.dcx), lens.fy * y + (lens.cy + lens.dcy)


@formula_of(RadialCustomLens, plane_of_pixel)
def _plane_of_shifted_pixel(u: Any, v: Any, lens: Any) -> Any:
    return (u - (lens.cx + lens.dcx)) / lens.fx, (v - (lens.cy + lens.dcy)) / lens.fy


@formula_of(RadialCustomLens, distort)
def _distort(a: Any, b: Any, lens: Any) -> Any:
    s = a * a + b * b
    g = 1.0 + s * (lens.k1 + s * (lens.k2 + s * (lens.k3 + s * (lens.k4 + s * (lens.k5 + s * lens.k6)))))
    g_s = lens.k4 * 4.0 + s * (5.0 * lens.k5 + s * 6.0 * lens.k6)
    g_s = lens.k1 + s * (2.0 * lens.k2 + s * (3.0 * lens.k3 + s * g_s))
    return bend_image(stretch(a, b, g, g_s), lens.p1, lens.p2, 0.0, 0.0, 0.0, 0.0)


def domain_limit(coefficients: tuple[float, ...]) -> float:
    """The angle off the axis up to which no two rays share a pixel, π at most."""
    slope = [(2 * i + 1) * k for i, k in zip(range(6, 0, -1), reversed(coefficients[:6]), strict=True)]
    limit = min(math.pi, math.sqrt(first_positive_root([*slope, 1.0])))
    return float(fold_radius(np.array((1.0, 1.0, 0.0, 0.0, *coefficients, limit))))


@njit(**INLINE)
def _lens(numbers):  # type: ignore[no-untyped-def]
    return RadialCustomLens(*first_numbers(numbers, _COUNT))


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
