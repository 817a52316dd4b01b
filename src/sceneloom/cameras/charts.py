"""Charts: the plane coordinates of rays that a distortion starts from, and the way back to the ray.

- perspective: (X, Y)/Z, for rays ahead of the camera;
- by angle: θ (X, Y)/sqrt(X² + Y²), θ the angle off the axis, for all rays but the one straight back;
- by sphere: (X, Y)/(Z + ξ P), P the distance of the point: the unit sphere seen from ξ behind its centre.

Each gives its distance from the axis squared as infinity where it has no place for a point.

Source: Mei and Rives 2007, "Single View Point Omnidirectional Camera Calibration from Planar Grids", eq. 1 and 3,
for the sphere.
"""

import math

from numba import njit

from sceneloom.cameras.angles import angle_off_axis, sine_and_cosine
from sceneloom.cameras.compiled import INLINE, MINIMUM_DEPTH


@njit(**INLINE)
def in_perspective(x, y, z):  # type: ignore[no-untyped-def]
    """Give the place on the plane z = 1, and the square of its distance from the axis."""
    a, b = x / z, y / z
    return a, b, (a * a + b * b if z > MINIMUM_DEPTH else math.inf)


@njit(**INLINE)
def ray_of_perspective(a, b):  # type: ignore[no-untyped-def]
    """Give the unit ray through (a, b) on the plane z = 1."""
    scale = 1.0 / math.sqrt(a * a + b * b + 1.0)
    return a * scale, b * scale, scale


@njit(**INLINE)
def by_angle(x, y, z):  # type: ignore[no-untyped-def]
    """Give the place as far from the middle as the angle off the axis, and the square of that."""
    side = math.sqrt(x * x + y * y)
    angle = angle_off_axis(side, z)
    scale = angle / side if side > 0.0 else 0.0
    return x * scale, y * scale, (angle * angle if (side > 0.0) | (z > 0.0) else math.inf)


@njit(**INLINE)
def ray_of_angle(a, b):  # type: ignore[no-untyped-def]
    """Give the unit ray that lies as far off the axis as (a, b) from the middle."""
    angle = math.sqrt(a * a + b * b)
    sine, cosine = sine_and_cosine(angle)
    scale = sine / angle if angle > 0.0 else 1.0
    return a * scale, b * scale, cosine


@njit(**INLINE)
def by_sphere(x, y, z, xi):  # type: ignore[no-untyped-def]
    """Give the place on the plane of the shifted sphere, and the square of its distance from the axis.

    With ξ > 1 the farther half of the sphere, as seen from its shifted centre, hides behind the nearer one.
    """
    distance = math.sqrt(x * x + y * y + z * z)
    depth = z + xi * distance
    a, b = x / depth, y / depth
    hidden = z * xi < -distance if xi > 1.0 else False
    seen = (depth > MINIMUM_DEPTH * distance) & (distance > 0.0) & (not hidden)
    return a, b, (a * a + b * b if seen else math.inf)


@njit(**INLINE)
def ray_of_sphere(a, b, xi):  # type: ignore[no-untyped-def]
    """Give the unit ray of a place on the plane of the shifted sphere; NaN where no part of the sphere is seen."""
    square = a * a + b * b
    scale = (xi + math.sqrt(1.0 + (1.0 - xi * xi) * square)) / (1.0 + square)
    return a * scale, b * scale, scale - xi


def sphere_rim(xi: float) -> float:
    """The distance from the axis, on the plane of the shifted sphere, that none of its places reaches."""
    if xi <= -1.0:
        return 0.0
    return 1.0 / math.sqrt(xi * xi - 1.0) if xi > 1.0 else math.inf
