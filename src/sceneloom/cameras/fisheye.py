"""Fisheye projection: the distance from the picture's centre is an odd polynomial of the angle off the axis.

With θ the angle between the point's direction and the axis

    θd = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸),  (x', y') = θd (X, Y) / sqrt(X² + Y²)

The domain is the cone θ < limit, π at most, within which θd grows. It may reach behind the plane of the
camera, so a visible point may have a depth of zero or less.

Source: Kannala and Brandt 2006, eq. 6 (there k1 is the factor of θ); OpenCV documentation, "Fisheye camera
model".
"""

import math

import numpy as np
from numba import float32, njit

from sceneloom.cameras.compiled import (
    INLINE,
    KERNEL,
    PICTURE_SIGNATURE,
    ROWS_SIGNATURE,
    camera_coordinates,
    in_picture,
    pose_numbers,
)
from sceneloom.cameras.domain import first_positive_root

_ITERATIONS = 60


def domain_limit(coefficients: tuple[float, ...]) -> float:
    """The angle off the axis at which the distance from the centre stops growing, π at most."""
    k1, k2, k3, k4 = coefficients
    slope = np.array([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0])
    return min(math.pi, math.sqrt(first_positive_root(slope)))


@njit(**INLINE)
def _radius(angle, k1, k2, k3, k4):  # type: ignore[no-untyped-def]
    s = angle * angle
    return angle * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))


@njit(**INLINE)
def _slope(angle, k1, k2, k3, k4):  # type: ignore[no-untyped-def]
    s = angle * angle
    return 1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4)))


@njit(**INLINE)
def _project(x, y, z, fx, fy, cx, cy, k1, k2, k3, k4, limit):  # type: ignore[no-untyped-def]
    off_axis = math.sqrt(x * x + y * y)
    if off_axis == 0.0:
        return (cx, cy) if z > 0.0 else (math.nan, math.nan)
    angle = math.atan2(off_axis, z)
    if not angle < limit:
        return math.nan, math.nan
    scale = _radius(angle, k1, k2, k3, k4) / off_axis
    return fx * (x * scale) + cx, fy * (y * scale) + cy


@njit(PICTURE_SIGNATURE, **KERNEL)
def project_into_picture(  # type: ignore[no-untyped-def]
    points_world, camera_from_world, lens, width, height, point_ids, pixels, depths
):
    """Keep the points that fall into the picture; see `compiled`."""
    fx, fy, cx, cy, k1, k2, k3, k4, limit = (
        lens[0], lens[1], lens[2], lens[3], lens[4], lens[5], lens[6], lens[7], lens[8],
    )  # fmt: skip
    pose, count = pose_numbers(camera_from_world), 0
    for i in range(len(points_world)):
        x, y, z = camera_coordinates(points_world[i, 0], points_world[i, 1], points_world[i, 2], pose)
        u, v = _project(x, y, z, fx, fy, cx, cy, k1, k2, k3, k4, limit)
        column, row = float32(u), float32(v)
        # The test is made on what is stored: rounding that to the nearest pixel must stay inside the picture.
        if in_picture(column, row, width, height):
            point_ids[count], depths[count] = i, z
            pixels[count, 0], pixels[count, 1] = column, row
            count += 1
    return count


@njit(ROWS_SIGNATURE, **KERNEL)
def project_points(points_camera, lens, pixels):  # type: ignore[no-untyped-def]
    """Give a pixel for every point; see `compiled`."""
    for i in range(len(points_camera)):
        x, y, z = points_camera[i, 0], points_camera[i, 1], points_camera[i, 2]
        pixels[i, 0], pixels[i, 1] = _project(
            x, y, z, lens[0], lens[1], lens[2], lens[3], lens[4], lens[5], lens[6], lens[7], lens[8]
        )


@njit(**INLINE)
def _angle(radius, k1, k2, k3, k4, limit):  # type: ignore[no-untyped-def]
    """Solve θd(θ) = radius by Newton's method, kept between bounds of the root; NaN where there is none."""
    low, high = 0.0, limit
    if not radius <= _radius(limit, k1, k2, k3, k4):
        return math.nan
    angle = min(radius, 0.5 * limit)
    for _ in range(_ITERATIONS):
        excess = _radius(angle, k1, k2, k3, k4) - radius
        if excess > 0.0:
            high = angle
        else:
            low = angle
        better = angle - excess / _slope(angle, k1, k2, k3, k4)
        if not low <= better <= high:
            better = 0.5 * (low + high)
        if abs(better - angle) <= 1e-15 * (1.0 + angle):
            return better
        angle = better
    return angle


@njit(ROWS_SIGNATURE, **KERNEL)
def unproject_pixels(pixels, lens, rays):  # type: ignore[no-untyped-def]
    """Give a unit ray for every pixel; see `compiled`."""
    for i in range(len(pixels)):
        x, y = (pixels[i, 0] - lens[2]) / lens[0], (pixels[i, 1] - lens[3]) / lens[1]
        radius = math.sqrt(x * x + y * y)
        angle = _angle(radius, lens[4], lens[5], lens[6], lens[7], lens[8])
        scale = math.sin(angle) / radius if radius > 0.0 else 1.0
        rays[i, 0] = x * scale
        rays[i, 1] = y * scale
        rays[i, 2] = math.cos(angle)
