"""Fisheye projection with an arctangent within: an odd polynomial of atan(θ), and the tangent of that.

With θ the angle between the point's direction and the axis, and f = atan(θ)

    r = f (1 + k1 f² + k2 f⁴ + k3 f⁶ + k4 f⁸),  (x', y') = tan(r) (X, Y) / sqrt(X² + Y²)

Without coefficients the distance from the centre is θ itself. The domain is the cone θ < limit, π at most, within
which r grows and stays below π/2.

Source: the Sensor Fusion Scene format names the model and its coefficients; the formula is the one that its owner's
library computes, which ends it at θ = π/2.
"""

import math
from typing import Any, NamedTuple

from numba import njit

from sceneloom.cameras.formulas import (
    IMAGE_SIGNATURE,
    INLINE,
    KERNEL,
    ROWS_SIGNATURE,
    angle_off_axis,
    centred_pixel,
    distance_at,
    first_numbers,
    formula_of,
    pixel_of_plane,
    pixel_off_axis,
    plane_of_centred_pixel,
    plane_of_pixel,
    project_point,
    sine_and_cosine,
    use_formulas,
)
from sceneloom.cameras.loops import first_positive_root, look_off_axis, pick_points, position_points
from sceneloom.kernels.cache import kernel

_JUST_INSIDE = 1.0 - 1e-9


class ModKannalaModel(NamedTuple):
    """The numbers of a camera model, as the compiled functions take them apart."""

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    k3: float
    k4: float
    limit: float


_COUNT = len(ModKannalaModel._fields)

use_formulas(
    ModKannalaModel,
    {project_point: pixel_off_axis, pixel_of_plane: centred_pixel, plane_of_pixel: plane_of_centred_pixel},
)


@formula_of(ModKannalaModel, distance_at)
def _distance(angle: Any, camera_model: Any) -> Any:
    f = angle_off_axis(angle, 1.0)
    s = f * f
    r = f * (
        1.0 + s * (camera_model.k1 + s * (camera_model.k2 + s * (camera_model.k3 + s * camera_model.k4)))
    )
    r_f = 1.0 + s * (
        3.0 * camera_model.k1
        + s * (5.0 * camera_model.k2 + s * (7.0 * camera_model.k3 + s * 9.0 * camera_model.k4))
    )
    sine, cosine = sine_and_cosine(r)
    return sine / cosine, r_f / (cosine * cosine * (1.0 + angle * angle))


def domain_limit(coefficients: tuple[float, ...]) -> float:
    """The angle off the axis at which r stops growing or reaches π/2, π at most."""
    k1, k2, k3, k4 = coefficients
    fold = math.sqrt(first_positive_root([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0]))
    pole = first_positive_root([k4, 0.0, k3, 0.0, k2, 0.0, k1, 0.0, 1.0, -math.pi / 2])
    return math.tan(min(math.atan(math.pi), fold, _JUST_INSIDE * pole))


@njit(**INLINE)
def _camera_model(numbers):  # type: ignore[no-untyped-def]
    return ModKannalaModel(*first_numbers(numbers, _COUNT))


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
    look_off_axis(pixels, _camera_model(camera_model), rays)
