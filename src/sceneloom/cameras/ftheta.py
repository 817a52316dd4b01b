"""Fisheye projection whose polynomial gives the distance from the image's centre in pixels. ASSUMED.

With θ the angle between the point's direction and the axis

    r = k1 + k2 θ + k3 θ² + k4 θ³ + k5 θ⁴ [px],  (u, v) = (cx, cy) + r (X, Y) / sqrt(X² + Y²)

fx and fy take no part. The domain is where 0 <= r, in the cone θ < limit, π at most, within which r grows. With
k1 other than 0 a point right ahead has no pixel.

Source: the Sensor Fusion Scene format names the model and that it has k1 to k5; that they are these is assumed after
other camera models of the name, whose polynomial gives pixels from the angle.
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

_NOTHING_PX = 1e-9


class FthetaModel(NamedTuple):
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
    limit: float


_COUNT = len(FthetaModel._fields)

use_formulas(
    FthetaModel,
    {project_point: pixel_off_axis, pixel_of_plane: centred_pixel, plane_of_pixel: plane_of_centred_pixel},
)


@formula_of(FthetaModel, distance_at)
def _distance(angle: Any, camera_model: Any) -> Any:
    return (
        camera_model.k1
        + angle
        * (camera_model.k2 + angle * (camera_model.k3 + angle * (camera_model.k4 + angle * camera_model.k5))),
        camera_model.k2
        + angle * (2.0 * camera_model.k3 + angle * (3.0 * camera_model.k4 + angle * 4.0 * camera_model.k5)),
    )


def domain_limit(coefficients: tuple[float, ...]) -> float:
    """The angle off the axis at which the distance from the centre stops growing, π at most."""
    _, k2, k3, k4, k5 = coefficients
    if not k2 > 0.0:
        return 0.0
    return min(math.pi, first_positive_root([4 * k5, 3 * k4, 2 * k3, k2]))


@njit(**INLINE)
def _camera_model(numbers):  # type: ignore[no-untyped-def]
    _, _, cx, cy, k1, k2, k3, k4, k5, limit = first_numbers(numbers, _COUNT)
    return FthetaModel(1.0, 1.0, cx, cy, (k1 if abs(k1) > _NOTHING_PX else 0.0), k2, k3, k4, k5, limit)


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
