"""The compiled functions of all camera models: written once, and compiled for each model with its own formulas.

`compiled_model` makes the three functions of a `CompiledModel`; projection and unprojection by blocks, the search for
the ray of a pixel and the search for folds follow. What a model computes is in `formulas` and in its own module.

Within its domain a camera model takes no two locations to one, so a solution that lies inside is the one.
"""

import math
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numba import float32, float64, int32, int64, njit, types, uint64, void
from numba.np.unsafe.ndarray import to_fixed_tuple
from numpy.typing import ArrayLike

from sceneloom.cameras.formulas import (
    FORMULA,
    INLINE,
    PART,
    distance_at,
    distort,
    plane_of_pixel,
    prepared,
    project_point,
    ray_of_chart,
    ray_of_pixel,
    rays_of_pixels,
    sine_and_cosine,
)
from sceneloom.cameras.projection import CompiledModel, PointsInImage
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.projection import number_pixels, write_directions

_Function = TypeVar("_Function", bound=Callable[..., Any])
_named_tuple: Any = types.NamedTuple
_ROWS = types.Array(float64, 2, "C", readonly=True)
_NUMBERS = types.Array(float64, 1, "C", readonly=True)
_KEPT = (int64[::1], float32[:, ::1], int32[::1], float32[::1], float32[::1], float32[::1], float32[::1])
_IMAGE_SIGNATURE = int64(_ROWS, _ROWS, _NUMBERS, int64, int64, _named_tuple(_KEPT, PointsInImage))
_ROWS_SIGNATURE = void(_ROWS, _NUMBERS, float64[:, ::1])
_first_numbers: Any = to_fixed_tuple
_BLOCK = 512  # points that are projected at once, by vector instructions, before those in the image are picked out

_EDGE = float32(-0.5)  # where the image begins, to the left and at the top [px]

_NEAREST = 1e-250
"""Points whose squared distance [m²] is less, or no number, have no pixel: its root would mean nothing."""

# The search for the ray of a pixel.
_QUICK_STEPS, _ITERATIONS, _SMALLEST_STEP = 4, 60, 1e-4
_EXACT, _GOOD, _ROUNDING = 1e-14, 1e-12, 1e-15
_INSIDE = 1.0 - 1e-12
_ANYWHERE, _INSIDE_ONLY = False, True

# The search for folds.
_DIRECTIONS, _STEPS, _ROUNDS = 180, 200, 3
_VANISHED, _JUST_INSIDE = 1e-30, 1.0 - 1e-9
_WIDEST = math.radians(89.9999)
"""How far out of a chart without a rim a camera model is searched for folds: the arctangent of a radius."""


def compiled_model(numbers: Any, domain_limit: Callable[[tuple[float, ...]], float]) -> CompiledModel:
    """Make the functions of a camera model, which are compiled at their first call.

    `kernels.cache` counts three kernels for every call of this at the start of a line.

    Args:
        numbers: the class of its cameras' numbers, for which its formulas are registered.
        domain_limit: computes the limit of the domain from all coefficients.
    """
    # Numba finds a kept kernel again by what it closes over: classes and numbers, but no compiled functions.
    count = len(numbers._fields)

    @_kernel_of(numbers, _IMAGE_SIGNATURE)
    def project_into_image(points_world, camera_from_world, camera, width, height, kept):  # type: ignore[no-untyped-def]
        given = _first_numbers(camera, count)
        c = prepared(given, numbers(*given))
        return _pick_points(points_world, camera_from_world, c, width, height, kept)

    @_kernel_of(numbers, _ROWS_SIGNATURE)
    def project_points(points_camera, camera, pixels):  # type: ignore[no-untyped-def]
        given = _first_numbers(camera, count)
        c = prepared(given, numbers(*given))
        _project_rows(points_camera.reshape(points_camera.size), c, pixels.reshape(pixels.size))

    @_kernel_of(numbers, _ROWS_SIGNATURE)
    def unproject_pixels(pixels, camera, rays):  # type: ignore[no-untyped-def]
        given = _first_numbers(camera, count)
        rays_of_pixels(pixels, rays, prepared(given, numbers(*given)))

    return CompiledModel(project_into_image, project_points, unproject_pixels, domain_limit)


def compiled_fold(numbers: Any) -> Callable[[tuple[float, ...], float], float]:
    """Make the function that finds where a model with terms that are not radial folds; it is compiled when called.

    `kernels.cache` counts one kernel for every call of this at the start of a line.

    Returns:
        A function of all coefficients of the model, and of a radius of its chart: that radius, or a smaller one, up to
        which no two locations of the chart are taken to one.
    """
    count = len(numbers._fields)

    @_kernel_of(numbers, float64(_NUMBERS))
    def fold_radius(camera: Any) -> Any:
        given = _first_numbers(camera, count)
        return _radius_without_fold(prepared(given, numbers(*given)))

    def fold(coefficients: tuple[float, ...], limit: float) -> float:
        return float(fold_radius(np.array((1.0, 1.0, 0.0, 0.0, *coefficients, limit))))

    return fold


def _kernel_of(numbers: Any, signature: Any) -> Callable[[_Function], _Function]:
    """Declare a kernel as the module of a model would: kept by a name of its own, until that module changes."""

    def declare(function: _Function) -> _Function:
        function.__module__ = numbers.__module__
        function.__qualname__ = f"{numbers.__name__}.{function.__name__}"
        return kernel(signature, **FORMULA)(function)

    return declare


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


def look_along(pixels, rays, c):  # type: ignore[no-untyped-def]
    """Give a unit ray for every pixel of a model that can be solved for it."""
    for i in range(len(pixels)):
        x, y, z = ray_of_pixel(pixels[i, 0], pixels[i, 1], c)
        known = not math.isnan(x + y + z)
        rays[i, 0], rays[i, 1], rays[i, 2] = (x, y, z) if known else (math.nan, math.nan, math.nan)


@njit(**PART)
def _approach_angles(flat_pixels, c, xs, ys, angles):  # type: ignore[no-untyped-def]
    for i in range(len(angles)):
        xs[i], ys[i] = plane_of_pixel(flat_pixels[2 * i], flat_pixels[2 * i + 1], c)
        angles[i] = _approach_angle(math.sqrt(xs[i] * xs[i] + ys[i] * ys[i]), c)


@njit(**PART)
def _rotation_to_rays(xs, ys, angles, flat_rays):  # type: ignore[no-untyped-def]
    for i in range(len(angles)):
        distance = math.sqrt(xs[i] * xs[i] + ys[i] * ys[i])
        # To the centre itself only the axis leads, not the directions of a cone.
        angle = angles[i] if (distance > 0.0) | (angles[i] == 0.0) else math.nan
        sine, cosine = sine_and_cosine(angle)
        scale = sine / distance if distance > 0.0 else sine
        flat_rays[3 * i], flat_rays[3 * i + 1], flat_rays[3 * i + 2] = xs[i] * scale, ys[i] * scale, cosine


def look_off_axis(pixels, rays, c):  # type: ignore[no-untyped-def]
    """Give a unit ray for every pixel of a model in which the angle decides on the distance."""
    flat_pixels, flat_rays = pixels.reshape(pixels.size), rays.reshape(rays.size)
    room = np.empty((3, _BLOCK))
    for start in range(0, len(pixels), _BLOCK):
        stop = min(start + _BLOCK, len(pixels))
        xs, ys, angles = room[0, : stop - start], room[1, : stop - start], room[2, : stop - start]
        _approach_angles(flat_pixels[2 * start : 2 * stop], c, xs, ys, angles)
        for i in range(len(angles)):
            if math.isnan(angles[i]):
                angles[i] = _angle_at(math.sqrt(xs[i] * xs[i] + ys[i] * ys[i]), c)
        _rotation_to_rays(xs, ys, angles, flat_rays[3 * start : 3 * stop])


@njit(**PART)
def _approach_locations(flat_pixels, c, xs, ys, flat_positions):  # type: ignore[no-untyped-def]
    for i in range(len(xs)):
        xs[i], ys[i] = plane_of_pixel(flat_pixels[2 * i], flat_pixels[2 * i + 1], c)
        flat_positions[2 * i], flat_positions[2 * i + 1] = _approach_location(xs[i], ys[i], c)


@njit(**PART)
def _raise_to_rays(flat_positions, c, flat_rays):  # type: ignore[no-untyped-def]
    for i in range(len(flat_positions) // 2):
        x, y, z = ray_of_chart(flat_positions[2 * i], flat_positions[2 * i + 1], c)
        flat_rays[3 * i], flat_rays[3 * i + 1], flat_rays[3 * i + 2] = x, y, z


def look_through_chart(pixels, rays, c):  # type: ignore[no-untyped-def]
    """Give a unit ray for every pixel of a model that distorts a plane chart of the rays."""
    flat_pixels, flat_rays = pixels.reshape(pixels.size), rays.reshape(rays.size)
    room, locations = np.empty((2, _BLOCK)), np.empty(2 * _BLOCK)
    for start in range(0, len(pixels), _BLOCK):
        size = min(_BLOCK, len(pixels) - start)
        xs, ys, found = room[0, :size], room[1, :size], locations[: 2 * size]
        _approach_locations(flat_pixels[2 * start : 2 * (start + size)], c, xs, ys, found)
        for i in range(size):
            if math.isnan(found[2 * i]):
                found[2 * i], found[2 * i + 1] = _position_at(xs[i], ys[i], c)
        _raise_to_rays(found, c, flat_rays[3 * start : 3 * (start + size)])


@njit(**PART)
def _project_block(flat_points, pose, c, flat_pixels, x_camera, y_camera, z_camera):  # type: ignore[no-untyped-def]
    """Project as many points as the outputs have room for, and take them into the camera frame."""
    for i in range(len(z_camera)):
        x, y, z = _camera_coordinates(flat_points[3 * i], flat_points[3 * i + 1], flat_points[3 * i + 2], pose)
        u, v = project_point(x, y, z, c)
        flat_pixels[2 * i], flat_pixels[2 * i + 1] = float32(u), float32(v)
        x_camera[i], y_camera[i], z_camera[i] = float32(x), float32(y), float32(z)


@njit(**PART)
def _mark_inside(flat_pixels, width, height, inside):  # type: ignore[no-untyped-def]
    """Mark the pixels that lie in the image and give their number; a NaN does not."""
    # the test is made on the float32 pixels that are stored: rounding them to the nearest must stay in the image
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
    """Move the points that are inside to the front."""
    # every one is moved and only those that count stay: to guess which ones these are would take longer; `count` is
    # unsigned, which spares the test for indices from the end
    count = uint64(0)
    for i in range(len(inside)):
        point_ids[count], xs[count], ys[count], zs[count] = first_id + i, xs[i], ys[i], zs[i]
        flat_pixels[uint64(2) * count], flat_pixels[uint64(2) * count + uint64(1)] = (
            flat_pixels[2 * i],
            flat_pixels[2 * i + 1],
        )
        count += uint64(inside[i])


@njit(**PART)
def _pick_points(points_world, camera_from_world, c, width, height, kept):  # type: ignore[no-untyped-def]
    """Keep the points that fall into the image."""
    # a block is projected to where it would stand if all of it were kept, which is so for most of a lidar's blocks, or
    # none; directions and pixel numbers are made while it is in the nearest cache
    pose = _pose_numbers(camera_from_world)
    flat_points, flat_pixels = points_world.reshape(points_world.size), kept.pixels.reshape(kept.pixels.size)
    marks, count = np.empty(_BLOCK, np.bool_), 0
    for start in range(0, len(points_world), _BLOCK):
        size = min(_BLOCK, len(points_world) - start)
        stop, inside = count + size, marks[:size]
        ids, pixels = kept.point_ids[count:stop], flat_pixels[2 * count : 2 * stop]
        xs, ys, zs = kept.rightward[count:stop], kept.downward[count:stop], kept.depths[count:stop]
        _project_block(flat_points[3 * start : 3 * (start + size)], pose, c, pixels, xs, ys, zs)
        found = _mark_inside(pixels, width, height, inside)
        if found == size:
            _count_up(start, ids)
        elif found > 0:
            _close_up(inside, start, ids, pixels, xs, ys, zs)
        near = kept.inverse_ranges[count : count + found]
        write_directions(xs[:found], ys[:found], zs[:found], near)
        number_pixels(pixels, width, height, kept.pixel_numbers[count : count + found])
        count += found
    return count


@njit(**PART)
def _project_rows(flat_points, c, flat_pixels):  # type: ignore[no-untyped-def]
    for i in range(len(flat_points) // 3):
        x, y, z = flat_points[3 * i], flat_points[3 * i + 1], flat_points[3 * i + 2]
        u, v = project_point(x, y, z, c)
        square = x * x + y * y + z * z
        u = u if (square > _NEAREST) & (square < math.inf) else math.nan
        flat_pixels[2 * i], flat_pixels[2 * i + 1] = u, (math.nan if math.isnan(u) else v)


@njit(**INLINE)
def _approach_angle(distance, c):  # type: ignore[no-untyped-def]
    """Solve distance_at(angle) = distance by a few steps; NaN where they do not suffice."""
    at_axis, slope = distance_at(0.0, c)
    angle = (distance - at_axis) / slope
    for _ in range(_QUICK_STEPS):
        found, slope = distance_at(angle, c)
        angle -= (found - distance) / slope
    found, _ = distance_at(angle, c)
    solved = (abs(found - distance) <= _EXACT * (1.0 + distance)) & (angle >= 0.0) & (angle < c.limit)
    return angle if solved else math.nan


@njit(**PART)
def _angle_at(distance, c):  # type: ignore[no-untyped-def]
    """Solve distance_at(angle) = distance, kept between bounds of the solution; NaN where there is none."""
    low, high = 0.0, c.limit
    nearest, _ = distance_at(low, c)
    farthest, _ = distance_at(high, c)
    if not (high > 0.0 and nearest <= distance < farthest):
        return math.nan
    angle = 0.5 * high
    for _ in range(_ITERATIONS):
        found, slope = distance_at(angle, c)
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
def _approach_location(x, y, c):  # type: ignore[no-untyped-def]
    """Solve distort(a, b) = x, y by a few steps; NaN where they do not suffice."""
    a, b = x, y
    for _ in range(_QUICK_STEPS):
        to_x, to_y, xx, xy, yx, yy = distort(a, b, c)
        off_x, off_y = to_x - x, to_y - y
        share = 1.0 / (xx * yy - xy * yx)
        a, b = a + (xy * off_y - yy * off_x) * share, b + (yx * off_x - xx * off_y) * share
    to_x, to_y, _, _, _, _ = distort(a, b, c)
    off = abs(to_x - x) + abs(to_y - y)
    solved = (off <= _EXACT * (1.0 + abs(x) + abs(y))) & (a * a + b * b < c.limit * c.limit)
    return (a if solved else math.nan), b


@njit(**INLINE)
def _distort_beyond(a, b, c):  # type: ignore[no-untyped-def]
    """`distort`, continued beyond the domain by its rim's image and the distance from the rim."""
    # so a search may leave the domain and come back, and a location that only lies beyond is found, and refused
    from_axis = math.sqrt(a * a + b * b)
    rim = _INSIDE * c.limit
    if from_axis <= rim:
        return distort(a, b, c)
    along_a, along_b = a / from_axis, b / from_axis
    x, y, xx, xy, yx, yy = distort(rim * along_a, rim * along_b, c)
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
def _start(x, y, c):  # type: ignore[no-untyped-def]
    """Give a location in the domain, towards x, y, that the distortion does not take farther out than that."""
    size = math.sqrt(x * x + y * y)
    part = 1.0 if size < c.limit else 0.9 * c.limit / size
    for _ in range(_ITERATIONS):
        to_x, to_y, _, _, _, _ = distort(part * x, part * y, c)
        if to_x * to_x + to_y * to_y <= size * size:
            break
        part *= 0.7
    return part * x, part * y


@njit(**INLINE)
def _halfway_to_rim(a, b, step_a, step_b, c):  # type: ignore[no-untyped-def]
    """Shorten a step that leaves the domain to half the way to its rim."""
    aim_a, aim_b = a + step_a, b + step_b
    if aim_a * aim_a + aim_b * aim_b < c.limit * c.limit:
        return step_a, step_b
    square, along = step_a * step_a + step_b * step_b, a * step_a + b * step_b
    left = c.limit * c.limit - a * a - b * b
    part = 0.5 * left / (along + math.sqrt(along * along + square * left))
    return part * step_a, part * step_b


@njit(**PART)
def _search(x, y, c, inside):  # type: ignore[no-untyped-def]
    """Go by Newton's steps, halved until they come nearer, to where the distortion gives x, y; and whether it does."""
    # unless it is to stay `inside` the domain, the search sees the mapping continued beyond it
    size = math.sqrt(x * x + y * y)
    a, b = _start(x, y, c)
    to_x, to_y, xx, xy, yx, yy = _distort_beyond(a, b, c)
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
            step_a, step_b = _halfway_to_rim(a, b, step_a, step_b, c)
        before, part = off, 1.0
        while part > _SMALLEST_STEP and not off < before:
            new_a, new_b = a + part * step_a, b + part * step_b
            to_x, to_y, xx, xy, yx, yy = _distort_beyond(new_a, new_b, c)
            off_x, off_y = to_x - x, to_y - y
            off = math.sqrt(off_x * off_x + off_y * off_y)
            part *= 0.5
        if not off < before:
            return a, b, before <= enough
        a, b = new_a, new_b
    return a, b, off <= enough


@njit(**PART)
def _position_at(x, y, c):  # type: ignore[no-untyped-def]
    """Solve distort(a, b) = x, y; NaN where no location of the domain does."""
    # a search that may leave the domain slides along its rim, and reports soon where nothing is to be found; one that
    # stays inside is for poles on the rim, beyond which a continuation means nothing
    if not c.limit > 0.0 or not x * x + y * y < math.inf:
        return math.nan, math.nan
    a, b, solved = _search(x, y, c, _ANYWHERE)
    if not solved:
        a, b, solved = _search(x, y, c, _INSIDE_ONLY)
    if solved and a * a + b * b < c.limit * c.limit:
        return a, b
    return math.nan, math.nan


@njit(**PART)
def _rotations_nothing_back(radius, c):  # type: ignore[no-untyped-def]
    """Report whether, on a circle of the chart, each small step is taken to one within 90 degrees of it."""
    # where that holds all over a disk, no two of its locations are taken to one: the step between them would have to be
    # rotated back on its way; slopes of camera models are symmetric or nearly so, and then it ends at the fold, where
    # the area factor vanishes
    for k in range(_DIRECTIONS):
        about = 2.0 * math.pi * k / _DIRECTIONS
        _, _, xx, xy, yx, yy = distort(radius * math.cos(about), radius * math.sin(about), c)
        if not (xx > 0.0 and yy > 0.0 and 4.0 * xx * yy > (xy + yx) * (xy + yx)):
            return False
    return True


@njit(**PART)
def _radius_without_fold(c):  # type: ignore[no-untyped-def]
    """The radius of the disk of the chart, at most the domain's limit, on which no two locations are taken to one."""
    # decentring and prism terms, however small, fold a chart without a rim somewhere, so that such a disk always ends
    low, high = 0.0, min(_JUST_INSIDE * math.atan(c.limit), _WIDEST)
    for attempt in range(_ROUNDS):
        step, folded = (high - low) / (_STEPS - 1), -1
        for k in range(_STEPS):
            if not _rotations_nothing_back(math.tan(low + k * step), c):
                folded = k
                break
        if folded < 0:
            return min(c.limit, math.tan(_WIDEST)) if attempt == 0 else math.tan(low)
        low, high = low + max(folded - 1, 0) * step, low + folded * step
    return math.tan(low)


@njit(**INLINE)
def _pose_numbers(m):  # type: ignore[no-untyped-def]
    """Give the twelve numbers of a (3, 4) matrix, row by row."""
    return (
        m[0, 0], m[0, 1], m[0, 2], m[0, 3],
        m[1, 0], m[1, 1], m[1, 2], m[1, 3],
        m[2, 0], m[2, 1], m[2, 2], m[2, 3],
    )  # fmt: skip


@njit(**INLINE)
def _camera_coordinates(x, y, z, pose):  # type: ignore[no-untyped-def]
    """Take one world point into the camera frame."""
    return (
        pose[0] * x + pose[1] * y + pose[2] * z + pose[3],
        pose[4] * x + pose[5] * y + pose[6] * z + pose[7],
        pose[8] * x + pose[9] * y + pose[10] * z + pose[11],
    )
