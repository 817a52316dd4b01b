"""Fisheye projection: the distance from the picture's centre is a polynomial of the angle, with even powers too.

With θ the angle between the point's direction and the axis

    θd = θ (1 + k2 θ² + k3 θ³ + k4 θ⁴),  (x', y') = θd (X, Y) / sqrt(X² + Y²)

k1 has its place among the coefficients and is not used. The domain is the cone θ < limit, π at most, within which
θd grows.

Source: the Sensor Fusion Scene format names the model and its coefficients; the formula is the one that its owner's
library computes.
"""

import math
from typing import Any, NamedTuple

from numba import njit

from sceneloom.cameras.compiled import (
    INLINE,
    KERNEL,
    PICTURE_SIGNATURE,
    ROWS_SIGNATURE,
    first_numbers,
)
from sceneloom.cameras.domain import first_positive_root
from sceneloom.cameras.formulas import (
    centred_pixel,
    distance_at,
    formula_of,
    pixel_of_plane,
    plane_of_centred_pixel,
    plane_of_pixel,
    project_point,
    use_formulas,
)
from sceneloom.cameras.loops import look_off_axis, pick_points, place_points
from sceneloom.cameras.off_axis import pixel_off_axis
from sceneloom.kernels.cache import kernel


class ModEquiFishLens(NamedTuple):
    """The numbers of a lens, as the compiled functions take them apart."""

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    k3: float
    k4: float
    limit: float


_COUNT = len(ModEquiFishLens._fields)

use_formulas(
    ModEquiFishLens,
    {project_point: pixel_off_axis, pixel_of_plane: centred_pixel, plane_of_pixel: plane_of_centred_pixel},
)


@formula_of(ModEquiFishLens, distance_at)
def _distance(angle: Any, lens: Any) -> Any:
    s = angle * angle
    return (
        angle * (1.0 + s * (lens.k2 + angle * (lens.k3 + angle * lens.k4))),
        1.0 + s * (3.0 * lens.k2 + angle * (4.0 * lens.k3 + angle * 5.0 * lens.k4)),
    )


def domain_limit(coefficients: tuple[float, ...]) -> float:
    """The angle off the axis at which the distance from the centre stops growing, π at most."""
    _, k2, k3, k4 = coefficients
    return min(math.pi, first_positive_root([5 * k4, 4 * k3, 3 * k2, 0.0, 1.0]))


@njit(**INLINE)
def _lens(numbers):  # type: ignore[no-untyped-def]
    return ModEquiFishLens(*first_numbers(numbers, _COUNT))


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
    look_off_axis(pixels, _lens(lens), rays)
