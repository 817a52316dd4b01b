"""Perspective projection without distortion: u = fx X/Z + cx, v = fy Y/Z + cy.

Source: Hartley and Zisserman 2004, "Multiple View Geometry", eq. 6.2 and 6.9.
"""

import math
from typing import Any, NamedTuple

from numba import njit

from sceneloom.cameras.formulas import (
    IMAGE_SIGNATURE,
    INLINE,
    KERNEL,
    MINIMUM_DEPTH,
    ROWS_SIGNATURE,
    centred_pixel,
    first_numbers,
    formula_of,
    pixel_of_plane,
    plane_of_centred_pixel,
    plane_of_pixel,
    project_point,
    ray_in_perspective,
    ray_of_chart,
    ray_of_pixel,
    use_formulas,
)
from sceneloom.cameras.loops import look_along, pick_points, position_points
from sceneloom.kernels.cache import kernel


class PinholeModel(NamedTuple):
    """The numbers of a camera model, as the compiled functions take them apart."""

    fx: float
    fy: float
    cx: float
    cy: float
    limit: float


_COUNT = len(PinholeModel._fields)


use_formulas(
    PinholeModel,
    {
        pixel_of_plane: centred_pixel,
        plane_of_pixel: plane_of_centred_pixel,
        ray_of_chart: ray_in_perspective,
    },
)


@formula_of(PinholeModel, project_point)
def _project(x: Any, y: Any, z: Any, camera_model: Any) -> Any:
    u, v = pixel_of_plane(x / z, y / z, camera_model)
    return (u if z > MINIMUM_DEPTH else math.nan), v


@formula_of(PinholeModel, ray_of_pixel)
def _ray(u: Any, v: Any, camera_model: Any) -> Any:
    x, y = plane_of_pixel(u, v, camera_model)
    return ray_of_chart(x, y, camera_model)


def domain_limit(_coefficients: tuple[float, ...]) -> float:
    """The largest distance from the axis on the plane z = 1: there is no limit."""
    return math.inf


@njit(**INLINE)
def _camera_model(numbers):  # type: ignore[no-untyped-def]
    return PinholeModel(*first_numbers(numbers, _COUNT))


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
    look_along(pixels, _camera_model(camera_model), rays)
