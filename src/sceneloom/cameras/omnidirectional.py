"""Projection over a shifted unit sphere, with radial and tangential distortion: mirrors and very wide camera models.

With P the distance of the point, x = X/(Z + ξ P), y = Y/(Z + ξ P), s = x² + y², a = x + lx and b = y + ly

    x' = a g + 2 p1 a b + p2 (s + 2 a²),  y' = b g + p1 (s + 2 b²) + 2 p2 a b
    g = 1 + k1 s + k2 s² + k3 s³ + k4 s⁴

The domain is the disk sqrt(s) < limit in which the mapping does not fold; with ξ > 1 also the nearer part of the
sphere, 1 + ξ Z/P > 0. It may reach behind the plane of the camera.

Source: Mei and Rives 2007, "Single View Point Omnidirectional Camera Calibration from Planar Grids", eq. 1 to 5. The
order of the coefficients, and lx and ly, are those of the Sensor Fusion Scene format; that k4 takes part is assumed.
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
    pixel_by_sphere,
    pixel_of_plane,
    plane_of_centred_pixel,
    plane_of_pixel,
    project_point,
    ray_by_sphere,
    ray_of_chart,
    shift_and_decentre,
    sphere_rim,
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


class OmnidirectionalModel(NamedTuple):
    """The numbers of a camera model, as the compiled functions take them apart."""

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    k3: float
    k4: float
    p1: float
    p2: float
    xi: float
    lx: float
    ly: float
    limit: float


_COUNT = len(OmnidirectionalModel._fields)

use_formulas(
    OmnidirectionalModel,
    {
        project_point: pixel_by_sphere,
        pixel_of_plane: centred_pixel,
        plane_of_pixel: plane_of_centred_pixel,
        ray_of_chart: ray_by_sphere,
    },
)


@formula_of(OmnidirectionalModel, distort)
def _distort(a: Any, b: Any, camera_model: Any) -> Any:
    s = a * a + b * b
    g = 1.0 + s * (camera_model.k1 + s * (camera_model.k2 + s * (camera_model.k3 + s * camera_model.k4)))
    g_s = camera_model.k1 + s * (
        2.0 * camera_model.k2 + s * (3.0 * camera_model.k3 + s * 4.0 * camera_model.k4)
    )
    return shift_and_decentre(
        a, b, g, g_s, camera_model.lx, camera_model.ly, camera_model.p1, camera_model.p2
    )


def domain_limit(coefficients: tuple[float, ...]) -> float:
    """The distance from the axis on the plane of the sphere up to which no two rays share a pixel."""
    k1, k2, k3, k4, p1, p2, xi, lx, ly = coefficients
    fold = math.sqrt(first_positive_root([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0]))
    limit = min(fold, sphere_rim(xi))
    if not any((p1, p2, lx, ly)):
        return limit
    return float(fold_radius(np.array((1.0, 1.0, 0.0, 0.0, *coefficients, limit))))


@njit(**INLINE)
def _camera_model(numbers):  # type: ignore[no-untyped-def]
    return OmnidirectionalModel(*first_numbers(numbers, _COUNT))


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
