"""Perspective projection without distortion: u = fx X/Z + cx, v = fy Y/Z + cy.

Source: Hartley and Zisserman 2004, "Multiple View Geometry", eq. 6.2 and 6.9.
"""

import math

from numba import float32, njit

from sceneloom.cameras.compiled import (
    INLINE,
    KERNEL,
    MINIMUM_DEPTH,
    PICTURE_SIGNATURE,
    ROWS_SIGNATURE,
    camera_coordinates,
    in_picture,
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


@njit(PICTURE_SIGNATURE, **KERNEL)
def project_into_picture(  # type: ignore[no-untyped-def]
    points_world, camera_from_world, lens, width, height, point_ids, pixels, depths
):
    """Keep the points that fall into the picture; see `compiled`."""
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    pose, count = pose_numbers(camera_from_world), 0
    for i in range(len(points_world)):
        x, y, z = camera_coordinates(points_world[i, 0], points_world[i, 1], points_world[i, 2], pose)
        u, v = _project(x, y, z, fx, fy, cx, cy)
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
        pixels[i, 0], pixels[i, 1] = _project(x, y, z, lens[0], lens[1], lens[2], lens[3])


@njit(ROWS_SIGNATURE, **KERNEL)
def unproject_pixels(pixels, lens, rays):  # type: ignore[no-untyped-def]
    """Give a unit ray for every pixel; see `compiled`."""
    for i in range(len(pixels)):
        x, y = (pixels[i, 0] - lens[2]) / lens[0], (pixels[i, 1] - lens[3]) / lens[1]
        rays[i, 0], rays[i, 1], rays[i, 2] = unit_ray(x, y)
