"""Kannala and Brandt's full fisheye projection: radial, and asymmetric both along and across the direction.

With θ the angle between the point's direction and the axis, and φ = atan2(Y, X)

    r = θ (1 + k0 θ² + k1 θ⁴ + k2 θ⁶ + k3 θ⁸)
    Δr = (l1 θ + l2 θ³ + l3 θ⁵) (i1 cos φ + i2 sin φ + i3 cos 2φ + i4 sin 2φ)
    Δt = (m1 θ + m2 θ³ + m3 θ⁵) (j1 cos φ + j2 sin φ + j3 cos 2φ + j4 sin 2φ)
    (x', y') = (r + Δr) (cos φ, sin φ) + Δt (-sin φ, cos φ)

The domain is the cone θ < limit, π at most, within which the mapping does not fold.

Source: Kannala and Brandt 2006, "A Generic Camera Model and Calibration Method for Conventional, Wide-Angle, and
Fish-Eye Camera models", eq. 6, 8, 9 and 10 (there the factor of θ is k1). The order of the coefficients is that of the
Spectacular AI recording format.
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


class KannalaBrandt18Model(NamedTuple):
    """The numbers of a camera model, as the compiled functions take them apart."""

    fx: float
    fy: float
    cx: float
    cy: float
    k0: float
    k1: float
    k2: float
    k3: float
    l1: float
    l2: float
    l3: float
    i1: float
    i2: float
    i3: float
    i4: float
    m1: float
    m2: float
    m3: float
    j1: float
    j2: float
    j3: float
    j4: float
    limit: float


_COUNT = len(KannalaBrandt18Model._fields)

use_formulas(
    KannalaBrandt18Model,
    {
        project_point: pixel_by_angle,
        pixel_of_plane: centred_pixel,
        plane_of_pixel: plane_of_centred_pixel,
        ray_of_chart: ray_by_angle,
    },
)


@formula_of(KannalaBrandt18Model, distort)
def _distort(a: Any, b: Any, camera_model: Any) -> Any:
    s = a * a + b * b
    angle = math.sqrt(s)
    cosine, sine = (a / angle, b / angle) if angle > 0.0 else (1.0, 0.0)
    cosine_2, sine_2 = cosine * cosine - sine * sine, 2.0 * cosine * sine
    g = 1.0 + s * (camera_model.k0 + s * (camera_model.k1 + s * (camera_model.k2 + s * camera_model.k3)))
    slope = 1.0 + s * (
        3.0 * camera_model.k0
        + s * (5.0 * camera_model.k1 + s * (7.0 * camera_model.k2 + s * 9.0 * camera_model.k3))
    )
    along, along_slope = _amplitude(s, camera_model.l1, camera_model.l2, camera_model.l3)
    across, across_slope = _amplitude(s, camera_model.m1, camera_model.m2, camera_model.m3)
    in_i, in_i_rotation = _wave(
        cosine, sine, cosine_2, sine_2, camera_model.i1, camera_model.i2, camera_model.i3, camera_model.i4
    )
    in_j, in_j_rotation = _wave(
        cosine, sine, cosine_2, sine_2, camera_model.j1, camera_model.j2, camera_model.j3, camera_model.j4
    )
    # Both parts over θ, and the slopes along and across the direction, of which (xx, xy, yx, yy) is a rotation.
    out, aside = g + along * in_i, across * in_j
    out_out, out_aside = slope + along_slope * in_i, along * in_i_rotation - aside
    aside_out, aside_aside = across_slope * in_j, out + across * in_j_rotation
    return (
        a * out - b * aside,
        b * out + a * aside,
        *_rotated(cosine, sine, out_out, out_aside, aside_out, aside_aside),
    )


@njit(**INLINE)
def _amplitude(s, c1, c2, c3):  # type: ignore[no-untyped-def]
    """Give c1 θ + c2 θ³ + c3 θ⁵ over θ, and its slope over θ, with s = θ²."""
    return c1 + s * (c2 + s * c3), c1 + s * (3.0 * c2 + s * 5.0 * c3)


@njit(**INLINE)
def _wave(cosine, sine, cosine_2, sine_2, w1, w2, w3, w4):  # type: ignore[no-untyped-def]
    """Give w1 cos φ + w2 sin φ + w3 cos 2φ + w4 sin 2φ, and its slope over φ."""
    return (
        w1 * cosine + w2 * sine + w3 * cosine_2 + w4 * sine_2,
        w2 * cosine - w1 * sine + 2.0 * (w4 * cosine_2 - w3 * sine_2),
    )


@njit(**INLINE)
def _rotated(c, s, pp, pq, qp, qq):  # type: ignore[no-untyped-def]
    """Give a matrix of the directions along (c, s) and across in those of x and y."""
    return (
        c * c * pp - c * s * (pq + qp) + s * s * qq,
        c * s * (pp - qq) + c * c * pq - s * s * qp,
        c * s * (pp - qq) + c * c * qp - s * s * pq,
        s * s * pp + c * s * (pq + qp) + c * c * qq,
    )


def domain_limit(coefficients: tuple[float, ...]) -> float:
    """The angle off the axis up to which no two rays share a pixel, π at most."""
    k0, k1, k2, k3 = coefficients[:4]
    limit = min(math.pi, math.sqrt(first_positive_root([9 * k3, 7 * k2, 5 * k1, 3 * k0, 1.0])))
    return float(fold_radius(np.array((1.0, 1.0, 0.0, 0.0, *coefficients, limit))))


@njit(**INLINE)
def _camera_model(numbers):  # type: ignore[no-untyped-def]
    return KannalaBrandt18Model(*first_numbers(numbers, _COUNT))


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
