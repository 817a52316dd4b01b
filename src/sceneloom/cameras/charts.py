"""Charts: the plane coordinates of rays that a distortion starts from, and the way back to the ray.

- perspective: (X, Y)/Z, for rays ahead of the camera;
- by angle: θ (X, Y)/sqrt(X² + Y²), θ the angle off the axis, for all rays but the one straight back;
- by sphere: (X, Y)/(Z + ξ P), P the distance of the point: the unit sphere seen from ξ behind its centre.

The first three functions are what `project_point` means for models of each chart, the next three
`ray_of_chart`; they take the model's own `distort` and `pixel_of_plane`.

Source: Mei and Rives 2007, "Single View Point Omnidirectional Camera Calibration from Planar Grids", eq. 1 and 3,
for the sphere.
"""

import math
from typing import Any

from sceneloom.cameras.angles import angle_off_axis, sine_and_cosine
from sceneloom.cameras.compiled import MINIMUM_DEPTH
from sceneloom.cameras.formulas import distort, pixel_of_plane


def pixel_in_perspective(x: Any, y: Any, z: Any, camera_model: Any) -> Any:
    """Give the pixel of a point by its location on the plane z = 1."""
    a, b = x / z, y / z
    to_x, to_y, _, _, _, _ = distort(a, b, camera_model)
    u, v = pixel_of_plane(to_x, to_y, camera_model)
    known = (z > MINIMUM_DEPTH) & (a * a + b * b < camera_model.limit * camera_model.limit)
    return (u if known else math.nan), v


def pixel_by_angle(x: Any, y: Any, z: Any, camera_model: Any) -> Any:
    """Give the pixel of a point by its direction and its angle off the axis."""
    side = math.sqrt(x * x + y * y)
    angle = angle_off_axis(side, z)
    scale = angle / side if side > 0.0 else 0.0
    to_x, to_y, _, _, _, _ = distort(x * scale, y * scale, camera_model)
    u, v = pixel_of_plane(to_x, to_y, camera_model)
    known = (angle < camera_model.limit) & ((side > 0.0) | (z > 0.0))
    return (u if known else math.nan), v


def pixel_by_sphere(x: Any, y: Any, z: Any, camera_model: Any) -> Any:
    """Give the pixel of a point by its location on the plane of the shifted sphere.

    With ξ > 1 the farther part of the sphere hides behind the nearer one.
    """
    distance = math.sqrt(x * x + y * y + z * z)
    depth = z + camera_model.xi * distance
    a, b = x / depth, y / depth
    to_x, to_y, _, _, _, _ = distort(a, b, camera_model)
    u, v = pixel_of_plane(to_x, to_y, camera_model)
    ahead = (depth > MINIMUM_DEPTH * distance) & (
        (camera_model.xi <= 1.0) | (distance + camera_model.xi * z > 0.0)
    )
    return (u if ahead & (a * a + b * b < camera_model.limit * camera_model.limit) else math.nan), v


def ray_in_perspective(a: Any, b: Any, _camera_model: Any) -> Any:
    """Give the unit ray through (a, b) on the plane z = 1; NaN where that is too far out for numbers."""
    scale = 1.0 / math.sqrt(a * a + b * b + 1.0)
    scale = scale if scale > 0.0 else math.nan
    return a * scale, b * scale, scale


def ray_by_angle(a: Any, b: Any, _camera_model: Any) -> Any:
    """Give the unit ray that lies as far off the axis as (a, b) from the middle."""
    angle = math.sqrt(a * a + b * b)
    sine, cosine = sine_and_cosine(angle)
    scale = sine / angle if angle > 0.0 else 1.0
    return a * scale, b * scale, cosine


def ray_by_sphere(a: Any, b: Any, camera_model: Any) -> Any:
    """Give the unit ray of a location on the plane of the shifted sphere."""
    square = a * a + b * b
    scale = (camera_model.xi + math.sqrt(1.0 + (1.0 - camera_model.xi * camera_model.xi) * square)) / (
        1.0 + square
    )
    return a * scale, b * scale, scale - camera_model.xi


def sphere_rim(xi: float) -> float:
    """The distance from the axis, on the plane of the shifted sphere, that none of its locations reaches."""
    if xi <= -1.0:
        return 0.0
    return 1.0 / math.sqrt(xi * xi - 1.0) if xi > 1.0 else math.inf
