"""Fisheye camera models: the distance from the image's centre depends on the angle off the axis.

θ is the angle between a point's direction and the axis, φ its direction about the axis: cos φ = X / sqrt(X² + Y²). The
domain is the cone θ < limit, π at most, within which no two rays share a pixel. It may reach behind the plane of the
camera, so a visible point may have a depth of zero or less.

The formulas of `mod_equi_fish`, `mod_kannala`, `ftheta`, `fisheye_rad_tan_prism` and `fisheye_radial_custom` go by the
names that the Sensor Fusion Scene format has for models and coefficients; each says where its formula comes from.
"""

import math
from typing import Any

from numba import njit

from sceneloom.cameras.compiled import (
    compiled_fold,
    compiled_model,
    first_positive_root,
    look_off_axis,
    look_through_chart,
)
from sceneloom.cameras.formulas import (
    CENTRED,
    INLINE,
    Formula,
    angle_off_axis,
    bend_image,
    distance_at,
    distort,
    formula_of,
    numbers_of,
    odd_polynomial,
    pixel_of_plane,
    plane_of_pixel,
    prepared,
    project_point,
    ray_of_chart,
    rays_of_pixels,
    sine_and_cosine,
    stretch,
    use_formulas,
)


def _pixel_off_axis(x: Any, y: Any, z: Any, c: Any) -> Any:
    """Give the pixel of a point: in its direction from the centre, as far as `distance_at` says."""
    # right ahead there is no direction: that point is seen only where the distance vanishes there
    side = math.sqrt(x * x + y * y)
    angle = angle_off_axis(side, z)
    distance, _ = distance_at(angle, c)
    scale = distance / side if side > 0.0 else 0.0
    u, v = pixel_of_plane(x * scale, y * scale, c)
    ahead = (side == 0.0) & (z > 0.0) & (distance == 0.0)
    known = (angle < c.limit) & (((side > 0.0) & (distance > 0.0)) | ahead)
    return (u if known else math.nan), v


def _pixel_by_angle(x: Any, y: Any, z: Any, c: Any) -> Any:
    """Give the pixel of a point by its direction and its angle off the axis, which `distort` takes to the plane."""
    side = math.sqrt(x * x + y * y)
    angle = angle_off_axis(side, z)
    scale = angle / side if side > 0.0 else 0.0
    to_x, to_y, _, _, _, _ = distort(x * scale, y * scale, c)
    u, v = pixel_of_plane(to_x, to_y, c)
    known = (angle < c.limit) & ((side > 0.0) | (z > 0.0))
    return (u if known else math.nan), v


def _ray_by_angle(a: Any, b: Any, _c: Any) -> Any:
    """Give the unit ray that lies as far off the axis as (a, b) from the middle."""
    angle = math.sqrt(a * a + b * b)
    sine, cosine = sine_and_cosine(angle)
    scale = sine / angle if angle > 0.0 else 1.0
    return a * scale, b * scale, cosine


_RADIAL: dict[Formula, Formula] = {**CENTRED, project_point: _pixel_off_axis, rays_of_pixels: look_off_axis}
_BENT: dict[Formula, Formula] = {
    **CENTRED,
    project_point: _pixel_by_angle,
    ray_of_chart: _ray_by_angle,
    rays_of_pixels: look_through_chart,
}


# An odd polynomial of the angle:
#
#     θd = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸),  (x', y') = θd (cos φ, sin φ)
#
# Source: Kannala and Brandt 2006, eq. 6 (there k1 is the factor of θ); OpenCV documentation, "Fisheye camera model".

Fisheye = numbers_of("fisheye", __name__)
use_formulas(Fisheye, _RADIAL)


@formula_of(Fisheye, distance_at)
def _odd_distance(angle: Any, c: Any) -> Any:
    share, slope = odd_polynomial(angle * angle, c.k1, c.k2, c.k3, c.k4)
    return angle * share, slope


def _odd_limit(coefficients: tuple[float, ...]) -> float:
    """Where the odd polynomial stops growing, π at most."""
    k1, k2, k3, k4 = coefficients[:4]
    return min(math.pi, math.sqrt(first_positive_root([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0])))


FISHEYE = compiled_model(Fisheye, _odd_limit)


# A polynomial with even powers too:
#
#     θd = θ (1 + k2 θ² + k3 θ³ + k4 θ⁴),  (x', y') = θd (cos φ, sin φ)
#
# k1 has its place among the coefficients and is not used. Source: the library of the Sensor Fusion Scene format's owner
# computes this formula.

ModEquiFish = numbers_of("mod_equi_fish", __name__)
use_formulas(ModEquiFish, _RADIAL)


@formula_of(ModEquiFish, distance_at)
def _mixed_distance(angle: Any, c: Any) -> Any:
    s = angle * angle
    return (
        angle * (1.0 + s * (c.k2 + angle * (c.k3 + angle * c.k4))),
        1.0 + s * (3.0 * c.k2 + angle * (4.0 * c.k3 + angle * 5.0 * c.k4)),
    )


def _mixed_limit(coefficients: tuple[float, ...]) -> float:
    _, k2, k3, k4 = coefficients
    return min(math.pi, first_positive_root([5 * k4, 4 * k3, 3 * k2, 0.0, 1.0]))


MOD_EQUI_FISH = compiled_model(ModEquiFish, _mixed_limit)


# An odd polynomial of f = atan(θ), and the tangent of that:
#
#     r = f (1 + k1 f² + k2 f⁴ + k3 f⁶ + k4 f⁸),  (x', y') = tan(r) (cos φ, sin φ)
#
# Without coefficients the distance from the centre is θ itself. Source: the library of the Sensor Fusion Scene format's
# owner computes this formula, and ends it at θ = π/2; here r must grow and stay below π/2.

ModKannala = numbers_of("mod_kannala", __name__)
use_formulas(ModKannala, _RADIAL)
_JUST_INSIDE = 1.0 - 1e-9


@formula_of(ModKannala, distance_at)
def _tangent_distance(angle: Any, c: Any) -> Any:
    f = angle_off_axis(angle, 1.0)
    share, slope = odd_polynomial(f * f, c.k1, c.k2, c.k3, c.k4)
    sine, cosine = sine_and_cosine(f * share)
    return sine / cosine, slope / (cosine * cosine * (1.0 + angle * angle))


def _tangent_limit(coefficients: tuple[float, ...]) -> float:
    k1, k2, k3, k4 = coefficients
    fold = math.sqrt(first_positive_root([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0]))
    pole = first_positive_root([k4, 0.0, k3, 0.0, k2, 0.0, k1, 0.0, 1.0, -math.pi / 2])
    return math.tan(min(math.atan(math.pi), fold, _JUST_INSIDE * pole))


MOD_KANNALA = compiled_model(ModKannala, _tangent_limit)


# A polynomial that gives pixels. ASSUMED.
#
#     r = k1 + k2 θ + k3 θ² + k4 θ³ + k5 θ⁴ [px],  (u, v) = (cx, cy) + r (cos φ, sin φ)
#
# fx and fy take no part; with k1 other than 0 a point right ahead has no pixel. Source: assumed after other camera
# models of the name, whose polynomial gives pixels from the angle.

Ftheta = numbers_of("ftheta", __name__)
_NOTHING_PX = 1e-9


def _without_focal_lengths(_given: Any, c: Any) -> Any:
    k1 = c.k1 if abs(c.k1) > _NOTHING_PX else 0.0
    return Ftheta(1.0, 1.0, c.cx, c.cy, k1, c.k2, c.k3, c.k4, c.k5, c.limit)


use_formulas(Ftheta, {**_RADIAL, prepared: _without_focal_lengths})


@formula_of(Ftheta, distance_at)
def _distance_px(angle: Any, c: Any) -> Any:
    return (
        c.k1 + angle * (c.k2 + angle * (c.k3 + angle * (c.k4 + angle * c.k5))),
        c.k2 + angle * (2.0 * c.k3 + angle * (3.0 * c.k4 + angle * 4.0 * c.k5)),
    )


def _limit_px(coefficients: tuple[float, ...]) -> float:
    _, k2, k3, k4, k5 = coefficients
    if not k2 > 0.0:
        return 0.0
    return min(math.pi, first_positive_root([4 * k5, 3 * k4, 2 * k3, k2]))


FTHETA = compiled_model(Ftheta, _limit_px)


# The polynomial of all powers of the angle, and a linear term that skews the image, s and t in pixels:
#
#     d = k0 + θ + k2 θ² + k3 θ³ + k4 θ⁴ + k5 θ⁵,  (x, y) = d (cos φ, sin φ),  u = fx x + s y + cx,  v = t x + fy y + cy
#
# With k0 other than 0 a point right ahead has no pixel. Source: documentation of NVIDIA NCore, "Sensor Models", FTheta,
# whose forward polynomial is fy times this one, and whose c, d, e are fx/fy, s/fy, t/fy.

FthetaSkewed = numbers_of("ftheta_skewed", __name__)


def _skewed_pixel(x: Any, y: Any, c: Any) -> Any:
    return c.fx * x + c.skew_u * y + c.cx, c.skew_v * x + c.fy * y + c.cy


def _plane_of_skewed_pixel(u: Any, v: Any, c: Any) -> Any:
    right, down = u - c.cx, v - c.cy
    determinant = c.fx * c.fy - c.skew_u * c.skew_v
    return (c.fy * right - c.skew_u * down) / determinant, (c.fx * down - c.skew_v * right) / determinant


use_formulas(FthetaSkewed, {**_RADIAL, pixel_of_plane: _skewed_pixel, plane_of_pixel: _plane_of_skewed_pixel})


@formula_of(FthetaSkewed, distance_at)
def _distance_of_all_powers(angle: Any, c: Any) -> Any:
    return (
        c.k0 + angle * (1.0 + angle * (c.k2 + angle * (c.k3 + angle * (c.k4 + angle * c.k5)))),
        1.0 + angle * (2.0 * c.k2 + angle * (3.0 * c.k3 + angle * (4.0 * c.k4 + angle * 5.0 * c.k5))),
    )


def _limit_of_all_powers(coefficients: tuple[float, ...]) -> float:
    """Where the polynomial stops growing, π at most."""
    _, k2, k3, k4, k5, _, _ = coefficients
    return min(math.pi, first_positive_root([5 * k5, 4 * k4, 3 * k3, 2 * k2, 1.0]))


FTHETA_SKEWED = compiled_model(FthetaSkewed, _limit_of_all_powers)


# Six radial, two tangential and four thin-prism coefficients, with t = (p1, p2):
#
#     θd = θ (1 + k1 θ² + … + k6 θ¹²),  p = θd (cos φ, sin φ),  r = |p|
#     (x', y') = p + 2 (p·t) p + r² t + (s1 r² + s2 r⁴, s3 r² + s4 r⁴)
#
# Source: Project Aria documentation, "Camera intrinsic models", Fisheye624. Its p1 and p2 have changed places with
# OpenCV's.

FisheyeRadTanPrism = numbers_of("fisheye_rad_tan_prism", __name__)
use_formulas(FisheyeRadTanPrism, _BENT)


@formula_of(FisheyeRadTanPrism, distort)
def _prism(a: Any, b: Any, c: Any) -> Any:
    return bend_image(_stretched_by_six(a, b, c), c.p2, c.p1, c.s1, c.s2, c.s3, c.s4)


@njit(**INLINE)
def _stretched_by_six(a, b, c):  # type: ignore[no-untyped-def]
    s = a * a + b * b
    g = 1.0 + s * (c.k1 + s * (c.k2 + s * (c.k3 + s * (c.k4 + s * (c.k5 + s * c.k6)))))
    g_s = c.k4 * 4.0 + s * (5.0 * c.k5 + s * 6.0 * c.k6)
    return stretch(a, b, g, c.k1 + s * (2.0 * c.k2 + s * (3.0 * c.k3 + s * g_s)))


def _limit_of_six(coefficients: tuple[float, ...]) -> float:
    slope = [(2 * i + 1) * k for i, k in zip(range(6, 0, -1), reversed(coefficients[:6]), strict=True)]
    return min(math.pi, math.sqrt(first_positive_root([*slope, 1.0])))


_prism_fold = compiled_fold(FisheyeRadTanPrism)
FISHEYE_RAD_TAN_PRISM = compiled_model(FisheyeRadTanPrism, lambda k: _prism_fold(k, _limit_of_six(k)))


# Six radial and two tangential coefficients and a shifted centre. ASSUMED.
#
#     θd = θ (1 + k1 θ² + … + k6 θ¹²),  (x, y) = θd (cos φ, sin φ),  s = x² + y²
#     x' = x + 2 p1 x y + p2 (s + 2 x²),  y' = y + p1 (s + 2 y²) + 2 p2 x y
#     (u, v) = (fx x' + cx + dcx, fy y' + cy + dcy)
#
# Source: assumed after its neighbours `fisheye` and `fisheye_rad_tan_prism`, the decentring being OpenCV's and the
# shift one of the centre [px].

FisheyeRadialCustom = numbers_of("fisheye_radial_custom", __name__)


def _with_shifted_centre(_given: Any, c: Any) -> Any:
    k = (c.k1, c.k2, c.k3, c.k4, c.k5, c.k6)
    return FisheyeRadialCustom(c.fx, c.fy, c.cx + c.dcx, c.cy + c.dcy, *k, c.p1, c.p2, 0.0, 0.0, c.limit)


use_formulas(FisheyeRadialCustom, {**_BENT, prepared: _with_shifted_centre})


@formula_of(FisheyeRadialCustom, distort)
def _decentred(a: Any, b: Any, c: Any) -> Any:
    return bend_image(_stretched_by_six(a, b, c), c.p1, c.p2, 0.0, 0.0, 0.0, 0.0)


_decentred_fold = compiled_fold(FisheyeRadialCustom)
FISHEYE_RADIAL_CUSTOM = compiled_model(FisheyeRadialCustom, lambda k: _decentred_fold(k, _limit_of_six(k)))


# Kannala and Brandt's full model: radial, and asymmetric both along and across the direction.
#
#     r = θ (1 + k0 θ² + k1 θ⁴ + k2 θ⁶ + k3 θ⁸)
#     Δr = (l1 θ + l2 θ³ + l3 θ⁵) (i1 cos φ + i2 sin φ + i3 cos 2φ + i4 sin 2φ)
#     Δt = (m1 θ + m2 θ³ + m3 θ⁵) (j1 cos φ + j2 sin φ + j3 cos 2φ + j4 sin 2φ)
#     (x', y') = (r + Δr) (cos φ, sin φ) + Δt (-sin φ, cos φ)
#
# Source: Kannala and Brandt 2006, "A Generic Camera Model and Calibration Method for Conventional, Wide-Angle, and
# Fish-Eye Lenses", eq. 6, 8, 9 and 10 (there the factor of θ is k1). The order of the coefficients is that of the
# Spectacular AI recording format.

KannalaBrandt18 = numbers_of("kannala_brandt18", __name__)
use_formulas(KannalaBrandt18, _BENT)


@formula_of(KannalaBrandt18, distort)
def _asymmetric(a: Any, b: Any, c: Any) -> Any:
    s = a * a + b * b
    angle = math.sqrt(s)
    cosine, sine = (a / angle, b / angle) if angle > 0.0 else (1.0, 0.0)
    cosine_2, sine_2 = cosine * cosine - sine * sine, 2.0 * cosine * sine
    g, slope = odd_polynomial(s, c.k0, c.k1, c.k2, c.k3)
    along, along_slope = _amplitude(s, c.l1, c.l2, c.l3)
    across, across_slope = _amplitude(s, c.m1, c.m2, c.m3)
    in_i, in_i_slope = _wave(cosine, sine, cosine_2, sine_2, c.i1, c.i2, c.i3, c.i4)
    in_j, in_j_slope = _wave(cosine, sine, cosine_2, sine_2, c.j1, c.j2, c.j3, c.j4)
    # Both parts over θ, and the slopes along and across the direction, of which (xx, xy, yx, yy) is a rotation.
    out, aside = g + along * in_i, across * in_j
    out_out, out_aside = slope + along_slope * in_i, along * in_i_slope - aside
    aside_out, aside_aside = across_slope * in_j, out + across * in_j_slope
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


_asymmetric_fold = compiled_fold(KannalaBrandt18)
KANNALA_BRANDT18 = compiled_model(KannalaBrandt18, lambda k: _asymmetric_fold(k, _odd_limit(k)))
