"""Fisheye projection: the distance from the image's centre is a polynomial of the angle, with even powers too.

With θ the angle between the point's direction and the axis

    θd = θ (1 + k2 θ² + k3 θ³ + k4 θ⁴),  (x', y') = θd (X, Y) / sqrt(X² + Y²)

k1 has its location among the coefficients and is not used. The domain is the cone θ < limit, π at most, within which
θd grows.

Source: the Sensor Fusion Scene format names the model and its coefficients; the formula is the one that its owner's
library computes.
"""

import math
from typing import Any, NamedTuple

from numba import njit

from sceneloom.cameras.formulas import (
    IMAGE_SIGNATURE,
    INLINE,
    KERNEL,
    ROWS_SIGNATURE,
    centred_pixel,
    distance_at,
    first_numbers,
    formula_of,
    pixel_of_plane,
    pixel_off_axis,
    plane_of_centred_pixel,
    plane_of_pixel,
    project_point,
    use_formulas,
)
from sceneloom.cameras.loops import first_positive_root, look_off_axis, pick_points, position_points
from sceneloom.kernels.cache import kernel


class ModEquiFishModel(NamedTuple):
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


_COUNT = len(ModEquiFishModel._fields)

use_formulas(
    ModEquiFishModel,
    {project_point: pixel_off_axis, pixel_of_plane: centred_pixel, plane_of_pixel: plane_of_centred_pixel},
)


@formula_of(ModEquiFishModel, distance_at)
def _distance(angle: Any, camera_model: Any) -> Any:
    s = angle * angle
    return (
        angle * (1.0 + s * (camera_model.k2 + angle * (camera_model.k3 + angle * camera_model.k4))),
        1.0 + s * (3.0 * camera_model.k2 + angle * (4.0 * camera_model.k3 + angle * 5.0 * camera_model.k4)),
    )


def domain_limit(coefficients: tuple[float, ...]) -> float:
    """The angle off the axis at which the distance from the centre stops growing, π at most."""
    _, k2, k3, k4 = coefficients
    return min(math.pi, first_positive_root([5 * k4, 4 * k3, 3 * k2, 0.0, 1.0]))


@njit(**INLINE)
def _camera_model(numbers):  # type: ignore[no-untyped-def]
    return ModEquiFishModel(*first_numbers(numbers, _COUNT))


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
