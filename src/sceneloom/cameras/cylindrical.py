"""Panorama on a cylinder around the camera's y axis: columns are angles, rows are not. ASSUMED.

    u = fx atan2(X, Z) + cx,  v = fy Y / sqrt(X² + Z²) + cy

All directions but straight up and down have a pixel; the seam is behind the camera, where u jumps by 2 π fx.

Source: the Sensor Fusion Scene format names the model; the formula is that of panoramas on a cylinder, and assumed
since its owner's library computes it as a pinhole.
"""

import math
from typing import Any, NamedTuple

from numba import njit

from sceneloom.cameras.formulas import (
    IMAGE_SIGNATURE,
    INLINE,
    KERNEL,
    ROWS_SIGNATURE,
    first_numbers,
    formula_of,
    project_point,
    ray_of_pixel,
    sine_and_cosine,
)
from sceneloom.cameras.loops import look_along, pick_points, position_points
from sceneloom.cameras.panorama import NEAREST, azimuth, azimuth_of_column
from sceneloom.kernels.cache import kernel


class CylindricalModel(NamedTuple):
    """The numbers of a camera model, as the compiled functions take them apart."""

    fx: float
    fy: float
    cx: float
    cy: float
    limit: float


_COUNT = len(CylindricalModel._fields)


@formula_of(CylindricalModel, project_point)
def _project(x: Any, y: Any, z: Any, camera_model: Any) -> Any:
    side = math.sqrt(x * x + z * z)
    u, v = camera_model.fx * azimuth(x, z) + camera_model.cx, camera_model.fy * (y / side) + camera_model.cy
    return (u if side > NEAREST * abs(y) else math.nan), v


@formula_of(CylindricalModel, ray_of_pixel)
def _ray(u: Any, v: Any, camera_model: Any) -> Any:
    about, height = azimuth_of_column(u, camera_model), (v - camera_model.cy) / camera_model.fy
    sine, cosine = sine_and_cosine(about)
    scale = 1.0 / math.sqrt(1.0 + height * height)
    if not abs(height) * NEAREST < 1.0:
        scale = math.nan
    return sine * scale, height * scale, cosine * scale


def domain_limit(_coefficients: tuple[float, ...]) -> float:
    """Half a rotation, to each side."""
    return math.pi


@njit(**INLINE)
def _camera_model(numbers):  # type: ignore[no-untyped-def]
    return CylindricalModel(*first_numbers(numbers, _COUNT))


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
