"""Fisheye projection with six radial, two tangential and four thin-prism coefficients.

With θ the angle between the point's direction and the axis, t = (p1, p2)

    θd = θ (1 + k1 θ² + … + k6 θ¹²),  p = θd (X, Y) / sqrt(X² + Y²),  r = |p|
    (x', y') = p + 2 (p·t) p + r² t + (s1 r² + s2 r⁴, s3 r² + s4 r⁴)

The domain is the cone θ < limit, π at most, within which the mapping does not fold.

Source: Project Aria documentation, "Camera intrinsic models", Fisheye624. Its p1 and p2 have changed locations with
OpenCV's.
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
    bend_image,
    centred_pixel,
    distort,
    first_numbers,
    formula_of,
    pixel_by_angle,
    pixel_of_plane,
    plane_of_centred_pixel,
    plane_of_pixel,
    project_point,
    ray_by_angle,
    ray_of_chart,
    stretch,
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


class RadTanPrismModel(NamedTuple):
    """The numbers of a camera model, as the compiled functions take them apart."""

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
    s1: float
    s2: float
    s3: float
    s4: float
    limit: float


_COUNT = len(RadTanPrismModel._fields)

use_formulas(
    RadTanPrismModel,
    {
        project_point: pixel_by_angle,
        pixel_of_plane: centred_pixel,
        plane_of_pixel: plane_of_centred_pixel,
        ray_of_chart: ray_by_angle,
    },
)


@formula_of(RadTanPrismModel, distort)
def _distort(a: Any, b: Any, camera_model: Any) -> Any:
    s = a * a + b * b
    g = 1.0 + s * (
        camera_model.k1
        + s
        * (
            camera_model.k2
            + s * (camera_model.k3 + s * (camera_model.k4 + s * (camera_model.k5 + s * camera_model.k6)))
        )
    )
    g_s = camera_model.k4 * 4.0 + s * (5.0 * camera_model.k5 + s * 6.0 * camera_model.k6)
    g_s = camera_model.k1 + s * (2.0 * camera_model.k2 + s * (3.0 * camera_model.k3 + s * g_s))
    return bend_image(
        stretch(a, b, g, g_s),
        camera_model.p2,
        camera_model.p1,
        camera_model.s1,
        camera_model.s2,
        camera_model.s3,
        camera_model.s4,
    )


def domain_limit(coefficients: tuple[float, ...]) -> float:
    """The angle off the axis up to which no two rays share a pixel, π at most."""
    slope = [(2 * i + 1) * k for i, k in zip(range(6, 0, -1), reversed(coefficients[:6]), strict=True)]
    limit = min(math.pi, math.sqrt(first_positive_root([*slope, 1.0])))
    return float(fold_radius(np.array((1.0, 1.0, 0.0, 0.0, *coefficients, limit))))


@njit(**INLINE)
def _camera_model(numbers):  # type: ignore[no-untyped-def]
    return RadTanPrismModel(*first_numbers(numbers, _COUNT))


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
