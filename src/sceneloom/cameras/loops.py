"""The loops that all projection models share, by blocks that fit the processor's cache and its vectors.

Each is compiled for every model, with the model's own formulas of `formulas` inside.
"""

import math

import numpy as np
from numba import float32, njit, uint64

from sceneloom.cameras.angles import sine_and_cosine
from sceneloom.cameras.compiled import BLOCK, PART, camera_coordinates, pose_numbers
from sceneloom.cameras.formulas import plane_of_pixel, project_point, ray_of_chart, ray_of_pixel
from sceneloom.cameras.solving import angle_at, approach_angle, approach_location, position_at
from sceneloom.kernels.directions import rotation_to_directions
from sceneloom.kernels.pixel_numbers import number_pixels

_EDGE = float32(-0.5)
"""Where the image begins, to the left and at the top [px]."""
_NEAREST = 1e-250
"""Points whose squared distance [m²] is less, or no number, have no pixel: its root would mean nothing."""


@njit(**PART)
def _project_block(flat_points, pose, camera_model, flat_pixels, x_camera, y_camera, z_camera):  # type: ignore[no-untyped-def]
    """Project as many points as the outputs have room for, and take them into the camera frame."""
    for i in range(len(z_camera)):
        x, y, z = camera_coordinates(flat_points[3 * i], flat_points[3 * i + 1], flat_points[3 * i + 2], pose)
        u, v = project_point(x, y, z, camera_model)
        flat_pixels[2 * i], flat_pixels[2 * i + 1] = float32(u), float32(v)
        x_camera[i], y_camera[i], z_camera[i] = float32(x), float32(y), float32(z)


@njit(**PART)
def _mark_inside(flat_pixels, width, height, inside):  # type: ignore[no-untyped-def]
    """Mark the pixels that lie in the image and give their number; a NaN does not.

    The test is made on the float32 pixels that are stored: rounding them to the nearest must stay in the image.
    """
    right, bottom, count = float32(width - 0.5), float32(height - 0.5), 0
    for i in range(len(inside)):
        u, v = flat_pixels[2 * i], flat_pixels[2 * i + 1]
        inside[i] = (u >= _EDGE) & (u < right) & (v >= _EDGE) & (v < bottom)
        count += inside[i]
    return count


@njit(**PART)
def _count_up(first, numbers):  # type: ignore[no-untyped-def]
    for i in range(len(numbers)):
        numbers[i] = first + i


@njit(**PART)
def _close_up(inside, first_id, point_ids, flat_pixels, xs, ys, zs):  # type: ignore[no-untyped-def]
    """Move the points that are inside to the front.

    Every one is moved and only those that count are left stationary: to guess which ones these are would take longer.
    `count` is unsigned, which spares the test for indices from the end.
    """
    count = uint64(0)
    for i in range(len(inside)):
        point_ids[count], xs[count], ys[count], zs[count] = first_id + i, xs[i], ys[i], zs[i]
        flat_pixels[uint64(2) * count], flat_pixels[uint64(2) * count + uint64(1)] = (
            flat_pixels[2 * i],
            flat_pixels[2 * i + 1],
        )
        count += uint64(inside[i])


@njit(**PART)
def pick_points(points_world, camera_from_world, camera_model, width, height, kept):  # type: ignore[no-untyped-def]
    """Keep the points that fall into the image; see `compiled`.

    A block is projected to where it would stand if all of it were kept, which is so for most of a lidar's blocks, or
    none. Directions and pixel numbers are made while it is in the nearest cache.
    """
    pose = pose_numbers(camera_from_world)
    flat_points, flat_pixels = points_world.reshape(points_world.size), kept.pixels.reshape(kept.pixels.size)
    marks, count = np.empty(BLOCK, np.bool_), 0
    for start in range(0, len(points_world), BLOCK):
        size = min(BLOCK, len(points_world) - start)
        stop, inside = count + size, marks[:size]
        ids, pixels = kept.point_ids[count:stop], flat_pixels[2 * count : 2 * stop]
        xs, ys, zs = kept.rightward[count:stop], kept.downward[count:stop], kept.depths[count:stop]
        _project_block(flat_points[3 * start : 3 * (start + size)], pose, camera_model, pixels, xs, ys, zs)
        found = _mark_inside(pixels, width, height, inside)
        if found == size:
            _count_up(start, ids)
        elif found > 0:
            _close_up(inside, start, ids, pixels, xs, ys, zs)
        near = kept.inverse_ranges[count : count + found]
        rotation_to_directions(xs[:found], ys[:found], zs[:found], near)
        number_pixels(pixels, width, height, kept.pixel_numbers[count : count + found])
        count += found
    return count


@njit(**PART)
def _location(flat_points, camera_model, flat_pixels):  # type: ignore[no-untyped-def]
    for i in range(len(flat_points) // 3):
        x, y, z = flat_points[3 * i], flat_points[3 * i + 1], flat_points[3 * i + 2]
        u, v = project_point(x, y, z, camera_model)
        square = x * x + y * y + z * z
        u = u if (square > _NEAREST) & (square < math.inf) else math.nan
        flat_pixels[2 * i], flat_pixels[2 * i + 1] = u, (math.nan if math.isnan(u) else v)


@njit(**PART)
def position_points(points_camera, camera_model, pixels):  # type: ignore[no-untyped-def]
    """Give a pixel for every point; see `compiled`."""
    _location(points_camera.reshape(points_camera.size), camera_model, pixels.reshape(pixels.size))


@njit(**PART)
def look_along(pixels, camera_model, rays):  # type: ignore[no-untyped-def]
    """Give a unit ray for every pixel of a model that can be solved for it; see `compiled`."""
    for i in range(len(pixels)):
        x, y, z = ray_of_pixel(pixels[i, 0], pixels[i, 1], camera_model)
        known = not math.isnan(x + y + z)
        rays[i, 0], rays[i, 1], rays[i, 2] = (x, y, z) if known else (math.nan, math.nan, math.nan)


@njit(**PART)
def _approach_angles(flat_pixels, camera_model, xs, ys, angles):  # type: ignore[no-untyped-def]
    for i in range(len(angles)):
        xs[i], ys[i] = plane_of_pixel(flat_pixels[2 * i], flat_pixels[2 * i + 1], camera_model)
        angles[i] = approach_angle(math.sqrt(xs[i] * xs[i] + ys[i] * ys[i]), camera_model)


@njit(**PART)
def _rotation_to_rays(xs, ys, angles, flat_rays):  # type: ignore[no-untyped-def]
    for i in range(len(angles)):
        distance = math.sqrt(xs[i] * xs[i] + ys[i] * ys[i])
        # To the centre itself only the axis leads, not the directions of a cone.
        angle = angles[i] if (distance > 0.0) | (angles[i] == 0.0) else math.nan
        sine, cosine = sine_and_cosine(angle)
        scale = sine / distance if distance > 0.0 else sine
        flat_rays[3 * i], flat_rays[3 * i + 1], flat_rays[3 * i + 2] = xs[i] * scale, ys[i] * scale, cosine


@njit(**PART)
def look_off_axis(pixels, camera_model, rays):  # type: ignore[no-untyped-def]
    """Give a unit ray for every pixel of a model in which the angle decides on the distance; see `compiled`."""
    flat_pixels, flat_rays = pixels.reshape(pixels.size), rays.reshape(rays.size)
    room = np.empty((3, BLOCK))
    for start in range(0, len(pixels), BLOCK):
        stop = min(start + BLOCK, len(pixels))
        xs, ys, angles = room[0, : stop - start], room[1, : stop - start], room[2, : stop - start]
        _approach_angles(flat_pixels[2 * start : 2 * stop], camera_model, xs, ys, angles)
        for i in range(len(angles)):
            if math.isnan(angles[i]):
                angles[i] = angle_at(math.sqrt(xs[i] * xs[i] + ys[i] * ys[i]), camera_model)
        _rotation_to_rays(xs, ys, angles, flat_rays[3 * start : 3 * stop])


@njit(**PART)
def _approach_locations(flat_pixels, camera_model, xs, ys, flat_positions):  # type: ignore[no-untyped-def]
    for i in range(len(xs)):
        xs[i], ys[i] = plane_of_pixel(flat_pixels[2 * i], flat_pixels[2 * i + 1], camera_model)
        flat_positions[2 * i], flat_positions[2 * i + 1] = approach_location(xs[i], ys[i], camera_model)


@njit(**PART)
def _raise_to_rays(flat_positions, camera_model, flat_rays):  # type: ignore[no-untyped-def]
    for i in range(len(flat_positions) // 2):
        x, y, z = ray_of_chart(flat_positions[2 * i], flat_positions[2 * i + 1], camera_model)
        flat_rays[3 * i], flat_rays[3 * i + 1], flat_rays[3 * i + 2] = x, y, z


@njit(**PART)
def look_through_chart(pixels, camera_model, rays):  # type: ignore[no-untyped-def]
    """Give a unit ray for every pixel of a model that distorts a plane chart of the rays; see `compiled`."""
    flat_pixels, flat_rays = pixels.reshape(pixels.size), rays.reshape(rays.size)
    room, locations = np.empty((2, BLOCK)), np.empty(2 * BLOCK)
    for start in range(0, len(pixels), BLOCK):
        size = min(BLOCK, len(pixels) - start)
        xs, ys, found = room[0, :size], room[1, :size], locations[: 2 * size]
        _approach_locations(flat_pixels[2 * start : 2 * (start + size)], camera_model, xs, ys, found)
        for i in range(size):
            if math.isnan(found[2 * i]):
                found[2 * i], found[2 * i + 1] = position_at(xs[i], ys[i], camera_model)
        _raise_to_rays(found, camera_model, flat_rays[3 * start : 3 * (start + size)])
