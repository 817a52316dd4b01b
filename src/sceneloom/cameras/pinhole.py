"""Perspective projection without distortion: u = fx X/Z + cx, v = fy Y/Z + cy.

Source: Hartley and Zisserman 2004, "Multiple View Geometry", eq. 6.2 and 6.9.
"""

import math
from typing import Any, NamedTuple

from numba import njit

from sceneloom.cameras.charts import ray_in_perspective
from sceneloom.cameras.compiled import (
    INLINE,
    KERNEL,
    MINIMUM_DEPTH,
    PICTURE_SIGNATURE,
    ROWS_SIGNATURE,
    first_numbers,
)
from sceneloom.cameras.formulas import (
    centred_pixel,
    formula_of,
    pixel_of_plane,
    plane_of_centred_pixel,
    plane_of_pixel,
    project_point,
    ray_of_chart,
    ray_of_pixel,
    use_formulas,
)
from sceneloom.cameras.loops import look_along, pick_points, place_points
from sceneloom.kernels.cache import kernel


class PinholeLens(NamedTuple):
    """The numbers of a lens, as the compiled functions take them apart."""

    fx: float
    fy: float
    cx: float
    cy: float
    limit: float


_COUNT = len(PinholeLens._fields)


use_formulas(
    PinholeLens,
    {
        pixel_of_plane: centred_pixel,
        plane_of_pixel: plane_of_centred_pixel,
        ray_of_chart: ray_in_perspective,
    },
)


@formula_of(PinholeLens, project_point)
def _project(x: Any, y: Any, z: Any, lens: Any) -> Any:
    u, v = pixel_of_plane(x / z, y / z, lens)
    return (u if z > MINIMUM_DEPTH else math.nan), v


@formula_of(PinholeLens, ray_of_pixel)
def _ray(u: Any, v: Any, lens: Any) -> Any:
    x, y = plane_of_pixel(u, v, lens)
    return ray_of_chart(x, y, lens)


def domain_limit(_coefficients: tuple[float, ...]) -> float:
    """The largest distance from the axis on the plane z = 1: there is no limit."""
    return math.inf


@njit(**INLINE)
def _lens(numbers):  # type: ignore[no-untyped-def]
    return PinholeLens(*first_numbers(numbers, _COUNT))


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
    look_along(pixels, _lens(lens), rays)
