"""Perspective projection without distortion: u = fx X/Z + cx, v = fy Y/Z + cy.

Source: Hartley and Zisserman 2004, "Multiple View Geometry", eq. 6.2 and 6.9.
"""

import math

import numpy as np
from numba import float32, int64, njit, uint64

from sceneloom.cameras.compiled import (
    BLOCK,
    INLINE,
    KERNEL,
    MINIMUM_DEPTH,
    PART,
    PICTURE_SIGNATURE,
    ROWS_SIGNATURE,
    camera_coordinates,
    keep_in_picture,
    pose_numbers,
    unit_ray,
)


def domain_limit(_coefficients: tuple[float, ...]) -> float:
    """The largest distance from the axis on the plane z = 1: there is no limit."""
    return math.inf


@njit(**INLINE)
def _project(x, y, z, fx, fy, cx, cy):  # type: ignore[no-untyped-def]
    if not z > MINIMUM_DEPTH:
        return math.nan, math.nan
    return fx * (x / z) + cx, fy * (y / z) + cy


@njit(**PART)
def _project_block(flat_points, pose, lens, columns, rows, depths):  # type: ignore[no-untyped-def]
    """Project as many points as the outputs have room for, without a branch between them."""
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    for i in range(len(columns)):
        x, y, z = camera_coordinates(flat_points[3 * i], flat_points[3 * i + 1], flat_points[3 * i + 2], pose)
        columns[i] = float32(fx * (x / z) + cx) if z > MINIMUM_DEPTH else float32(math.nan)
        rows[i], depths[i] = float32(fy * (y / z) + cy), float32(z)


@njit(PICTURE_SIGNATURE, **KERNEL)
def project_into_picture(  # type: ignore[no-untyped-def]
    points_world, camera_from_world, lens, width, height, point_ids, pixels, depths
):
    """Keep the points that fall into the picture; see `compiled`."""
    pose = pose_numbers(camera_from_world)
    flat_points, flat_pixels = points_world.reshape(points_world.size), pixels.reshape(pixels.size)
    columns, rows, block_depths = (
        np.empty(BLOCK, np.float32),
        np.empty(BLOCK, np.float32),
        np.empty(BLOCK, np.float32),
    )
    count = uint64(0)
    for start in range(0, len(points_world), BLOCK):
        size = min(BLOCK, len(points_world) - start)
        u, v, z = columns[:size], rows[:size], block_depths[:size]
        _project_block(flat_points[3 * start : 3 * (start + size)], pose, lens, u, v, z)
        count = keep_in_picture(start, u, v, z, width, height, count, point_ids, flat_pixels, depths)
    return int64(count)


@njit(ROWS_SIGNATURE, **KERNEL)
def project_points(points_camera, lens, pixels):  # type: ignore[no-untyped-def]
    """Give a pixel for every point; see `compiled`."""
    for i in range(len(points_camera)):
        x, y, z = points_camera[i, 0], points_camera[i, 1], points_camera[i, 2]
        pixels[i, 0], pixels[i, 1] = _project(x, y, z, lens[0], lens[1], lens[2], lens[3])


@njit(ROWS_SIGNATURE, **KERNEL)
def unproject_pixels(pixels, lens, rays):  # type: ignore[no-untyped-def]
    """Give a unit ray for every pixel; see `compiled`."""
    for i in range(len(pixels)):
        x, y = (pixels[i, 0] - lens[2]) / lens[0], (pixels[i, 1] - lens[3]) / lens[1]
        rays[i, 0], rays[i, 1], rays[i, 2] = unit_ray(x, y)
