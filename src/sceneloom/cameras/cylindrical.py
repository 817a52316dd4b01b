"""Panorama on a cylinder around the camera's y axis: columns are angles, rows are not. ASSUMED.

    u = fx atan2(X, Z) + cx,  v = fy Y / sqrt(X² + Z²) + cy

All directions but straight up and down have a pixel; the seam is behind the camera, where u jumps by 2 π fx.

Source: the Sensor Fusion Scene format names the model; the formula is that of panoramas on a cylinder, and assumed
since its owner's library computes it as a pinhole.
"""

import math
from typing import Any, NamedTuple

from numba import njit

from sceneloom.cameras.angles import sine_and_cosine
from sceneloom.cameras.compiled import (
    INLINE,
    KERNEL,
    PICTURE_SIGNATURE,
    ROWS_SIGNATURE,
    first_numbers,
)
from sceneloom.cameras.formulas import (
    formula_of,
    project_point,
    ray_of_pixel,
)
from sceneloom.cameras.loops import look_along, pick_points, place_points
from sceneloom.cameras.panorama import NEAREST, azimuth, azimuth_of_column
from sceneloom.kernels.cache import kernel


class CylindricalLens(NamedTuple):
    """The numbers of a lens, as the compiled functions take them apart."""

    fx: float
    fy: float
    cx: float
    cy: float
    limit: float


_COUNT = len(CylindricalLens._fields)


@formula_of(CylindricalLens, project_point)
def _project(x: Any, y: Any, z: Any, lens: Any) -> Any:
    side = math.sqrt(x * x + z * z)
    u, v = lens.fx * azimuth(x, z) + lens.cx, lens.fy * (y / side) + lens.cy
    return (u if side > NEAREST * abs(y) else math.nan), v


@formula_of(CylindricalLens, ray_of_pixel)
def _ray(u: Any, v: Any, lens: Any) -> Any:
    about, height = azimuth_of_column(u, lens), (v - lens.cy) / lens.fy
    sine, cosine = sine_and_cosine(about)
    scale = 1.0 / math.sqrt(1.0 + height * height)
    if not abs(height) * NEAREST < 1.0:
        scale = math.nan
    return sine * scale, height * scale, cosine * scale


def domain_limit(_coefficients: tuple[float, ...]) -> float:
    """Half a turn, to each side."""
    return math.pi


@njit(**INLINE)
def _lens(numbers):  # type: ignore[no-untyped-def]
    return CylindricalLens(*first_numbers(numbers, _COUNT))


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
