"""The compiled loops of all camera models: the domain without folds, Newton inversion of the distortion.

Projection and unprojection by blocks.

Within its domain a camera model takes no two locations to one (see `domain`), so a solution that lies inside is the
one.

Each is compiled for every model, with the model's own formulas of `formulas` inside.
"""

import math

import numpy as np
from numba import float32, njit, uint64
from numpy.typing import ArrayLike

from sceneloom.cameras.formulas import (
    BLOCK,
    INLINE,
    PART,
    camera_coordinates,
    distance_at,
    distort,
    plane_of_pixel,
    pose_numbers,
    project_point,
    ray_of_chart,
    ray_of_pixel,
    sine_and_cosine,
)
from sceneloom.kernels.projection import number_pixels, rotation_to_directions

_DIRECTIONS = 180

_STEPS = 200

_ROUNDS = 3

_VANISHED = 1e-30

_JUST_INSIDE = 1.0 - 1e-9

_WIDEST = math.radians(89.9999)
"""How far out of a chart without a rim a bent camera model is looked at, and trusted: the arctangent of a radius."""


def first_positive_root(polynomial: ArrayLike) -> float:
    """Give the smallest positive real root, infinity where there is none.

    Args:
        polynomial: coefficients, the highest power first.
    """
    coefficients = np.asarray(polynomial, np.float64)
    # Nearly vanished ones have no root within reach, but would overflow the division by the leading one.
    kept = np.where(np.abs(coefficients) < _VANISHED * np.abs(coefficients).max(), 0.0, coefficients)
    # Found as the largest inverse root: a root far out, of a small leading number, then spoils nothing near zero.
    inverses = np.roots(kept[::-1])
    largest = inverses.real[inverses.imag == 0].max(initial=0.0)
    return float(1.0 / largest) if largest > 0.0 else math.inf


@njit(**PART)
def _rotations_nothing_back(radius, camera_model):  # type: ignore[no-untyped-def]
    """Report whether, on a circle of the chart, each small step is taken to one within 90 degrees of it.

    Where that holds all over a disk, no two of its locations are taken to one: the step from one to the other would
    have to be rotated back on its way. The slopes of camera models are symmetric or nearly so, and then it ends just
    where the area factor vanishes, which is the fold.
    """
    for k in range(_DIRECTIONS):
        about = 2.0 * math.pi * k / _DIRECTIONS
        _, _, xx, xy, yx, yy = distort(radius * math.cos(about), radius * math.sin(about), camera_model)
        if not (xx > 0.0 and yy > 0.0 and 4.0 * xx * yy > (xy + yx) * (xy + yx)):
            return False
    return True


@njit(**PART)
def radius_without_fold(camera_model):  # type: ignore[no-untyped-def]
    """Give the radius of the disk of the chart, `camera model.limit` at most.

    On which no two locations are taken to one.

    Decentring and prism terms, however small, fold a chart without a rim somewhere, so that such a disk always ends.
    """
    low, high = 0.0, min(_JUST_INSIDE * math.atan(camera_model.limit), _WIDEST)
    for attempt in range(_ROUNDS):
        step, folded = (high - low) / (_STEPS - 1), -1
        for k in range(_STEPS):
            if not _rotations_nothing_back(math.tan(low + k * step), camera_model):
                folded = k
                break
        if folded < 0:
            return min(camera_model.limit, math.tan(_WIDEST)) if attempt == 0 else math.tan(low)
        low, high = low + max(folded - 1, 0) * step, low + folded * step
    return math.tan(low)


_QUICK_STEPS = 4

_ITERATIONS = 60

_ANYWHERE, _INSIDE_ONLY = False, True

_SMALLEST_STEP = 1e-4

_EXACT = 1e-14

_GOOD = 1e-12

_ROUNDING = 1e-15

_INSIDE = 1.0 - 1e-12


@njit(**INLINE)
def _approach_angle(distance, camera_model):  # type: ignore[no-untyped-def]
    """Solve distance_at(angle) = distance by a few steps; NaN where they do not suffice."""
    at_axis, slope = distance_at(0.0, camera_model)
    angle = (distance - at_axis) / slope
    for _ in range(_QUICK_STEPS):
        found, slope = distance_at(angle, camera_model)
        angle -= (found - distance) / slope
    found, _ = distance_at(angle, camera_model)
    solved = (
        (abs(found - distance) <= _EXACT * (1.0 + distance)) & (angle >= 0.0) & (angle < camera_model.limit)
    )
    return angle if solved else math.nan


@njit(**PART)
def _angle_at(distance, camera_model):  # type: ignore[no-untyped-def]
    """Solve distance_at(angle) = distance, kept between bounds of the solution; NaN where there is none."""
    low, high = 0.0, camera_model.limit
    nearest, _ = distance_at(low, camera_model)
    farthest, _ = distance_at(high, camera_model)
    if not (high > 0.0 and nearest <= distance < farthest):
        return math.nan
    angle = 0.5 * high
    for _ in range(_ITERATIONS):
        found, slope = distance_at(angle, camera_model)
        if found > distance:
            high = angle
        else:
            low = angle
        better = angle - (found - distance) / slope
        if not low <= better <= high:
            better = 0.5 * (low + high)
        if abs(better - angle) <= 1e-15 * (1.0 + angle):
            return better
        angle = better
    return angle


@njit(**INLINE)
def _approach_location(x, y, camera_model):  # type: ignore[no-untyped-def]
    """Solve distort(a, b) = x, y by a few steps; NaN where they do not suffice."""
    a, b = x, y
    for _ in range(_QUICK_STEPS):
        to_x, to_y, xx, xy, yx, yy = distort(a, b, camera_model)
        off_x, off_y = to_x - x, to_y - y
        share = 1.0 / (xx * yy - xy * yx)
        a, b = a + (xy * off_y - yy * off_x) * share, b + (yx * off_x - xx * off_y) * share
    to_x, to_y, _, _, _, _ = distort(a, b, camera_model)
    off = abs(to_x - x) + abs(to_y - y)
    solved = (off <= _EXACT * (1.0 + abs(x) + abs(y))) & (
        a * a + b * b < camera_model.limit * camera_model.limit
    )
    return (a if solved else math.nan), b


@njit(**INLINE)
def _distort_beyond(a, b, camera_model):  # type: ignore[no-untyped-def]
    """`distort`, continued beyond the domain by its rim's image and the distance from the rim.

    So a search may leave the domain and come back, and a location that only lies beyond is found, and refused.
    """
    from_axis = math.sqrt(a * a + b * b)
    rim = _INSIDE * camera_model.limit
    if from_axis <= rim:
        return distort(a, b, camera_model)
    along_a, along_b = a / from_axis, b / from_axis
    x, y, xx, xy, yx, yy = distort(rim * along_a, rim * along_b, camera_model)
    beyond, rotation = from_axis - rim, rim / from_axis
    # On the rim only rotating moves the image: the projector across the axis, and the outward rest.
    aa, ab, bb = rotation * along_b * along_b, -rotation * along_a * along_b, rotation * along_a * along_a
    return (
        x + beyond * along_a,
        y + beyond * along_b,
        xx * aa + xy * ab + 1.0 - aa,
        xx * ab + xy * bb - ab,
        yx * aa + yy * ab - ab,
        yx * ab + yy * bb + 1.0 - bb,
    )


@njit(**INLINE)
def _start(x, y, camera_model):  # type: ignore[no-untyped-def]
    """Give a location in the domain, towards x, y, that the distortion does not take farther out than that."""
    size = math.sqrt(x * x + y * y)
    part = 1.0 if size < camera_model.limit else 0.9 * camera_model.limit / size
    for _ in range(_ITERATIONS):
        to_x, to_y, _, _, _, _ = distort(part * x, part * y, camera_model)
        if to_x * to_x + to_y * to_y <= size * size:
            break
        part *= 0.7
    return part * x, part * y


@njit(**INLINE)
def _halfway_to_rim(a, b, step_a, step_b, camera_model):  # type: ignore[no-untyped-def]
    """Shorten a step that leaves the domain to half the way to its rim."""
    aim_a, aim_b = a + step_a, b + step_b
    if aim_a * aim_a + aim_b * aim_b < camera_model.limit * camera_model.limit:
        return step_a, step_b
    square, along = step_a * step_a + step_b * step_b, a * step_a + b * step_b
    left = camera_model.limit * camera_model.limit - a * a - b * b
    part = 0.5 * left / (along + math.sqrt(along * along + square * left))
    return part * step_a, part * step_b


@njit(**PART)
def _search(x, y, camera_model, inside):  # type: ignore[no-untyped-def]
    """Go by Newton's steps, halved until they come nearer, to where the distortion gives x, y.

    Args:
        inside: whether to stay in the domain; else the search sees the mapping continued beyond it.

    Returns:
        a, b: where it ends.
        solved: whether the distortion, or its continuation, gives x, y there.
    """
    size = math.sqrt(x * x + y * y)
    a, b = _start(x, y, camera_model)
    to_x, to_y, xx, xy, yx, yy = _distort_beyond(a, b, camera_model)
    off_x, off_y = to_x - x, to_y - y
    off = math.sqrt(off_x * off_x + off_y * off_y)
    enough = _GOOD * (1.0 + size)
    for _ in range(_ITERATIONS):
        if off <= _EXACT * (1.0 + size):
            break
        # Nearer than the rounding of a and b lets it come nothing can.
        steepest = abs(xx) + abs(xy) + abs(yx) + abs(yy)
        enough = _GOOD * (1.0 + size) + _ROUNDING * steepest * (abs(a) + abs(b))
        share = 1.0 / (xx * yy - xy * yx)
        step_a, step_b = (xy * off_y - yy * off_x) * share, (yx * off_x - xx * off_y) * share
        if inside:
            step_a, step_b = _halfway_to_rim(a, b, step_a, step_b, camera_model)
        before, part = off, 1.0
        while part > _SMALLEST_STEP and not off < before:
            new_a, new_b = a + part * step_a, b + part * step_b
            to_x, to_y, xx, xy, yx, yy = _distort_beyond(new_a, new_b, camera_model)
            off_x, off_y = to_x - x, to_y - y
            off = math.sqrt(off_x * off_x + off_y * off_y)
            part *= 0.5
        if not off < before:
            return a, b, before <= enough
        a, b = new_a, new_b
    return a, b, off <= enough


@njit(**PART)
def _position_at(x, y, camera_model):  # type: ignore[no-untyped-def]
    """Solve distort(a, b) = x, y; NaN where no location of the domain does.

    A search that may leave the domain slides along its rim, and reports soon where nothing is to be found; one that
    stays inside is for poles on the rim, beyond which a continuation means nothing.
    """
    if not camera_model.limit > 0.0 or not x * x + y * y < math.inf:
        return math.nan, math.nan
    a, b, solved = _search(x, y, camera_model, _ANYWHERE)
    if not solved:
        a, b, solved = _search(x, y, camera_model, _INSIDE_ONLY)
    if solved and a * a + b * b < camera_model.limit * camera_model.limit:
        return a, b
    return math.nan, math.nan


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
        angles[i] = _approach_angle(math.sqrt(xs[i] * xs[i] + ys[i] * ys[i]), camera_model)


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
                angles[i] = _angle_at(math.sqrt(xs[i] * xs[i] + ys[i] * ys[i]), camera_model)
        _rotation_to_rays(xs, ys, angles, flat_rays[3 * start : 3 * stop])


@njit(**PART)
def _approach_locations(flat_pixels, camera_model, xs, ys, flat_positions):  # type: ignore[no-untyped-def]
    for i in range(len(xs)):
        xs[i], ys[i] = plane_of_pixel(flat_pixels[2 * i], flat_pixels[2 * i + 1], camera_model)
        flat_positions[2 * i], flat_positions[2 * i + 1] = _approach_location(xs[i], ys[i], camera_model)


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
                found[2 * i], found[2 * i + 1] = _position_at(xs[i], ys[i], camera_model)
        _raise_to_rays(found, camera_model, flat_rays[3 * start : 3 * (start + size)])
