"""Perspective projection with radial (rational), tangential, thin-prism and tilt distortion.

With x = X/Z, y = Y/Z, s = x² + y² and a = x + lx, b = y + ly the distorted point is

    x' = a g + 2 p1 a b + p2 (s + 2 a²) + s1 s + s2 s²
    y' = b g + p1 (s + 2 b²) + 2 p2 a b + s3 s + s4 s²
    g = (1 + k1 s + k2 s² + k3 s³) / (1 + k4 s + k5 s² + k6 s³)

which the tilt of the image plane (tx, ty) then maps on. The domain is the disk sqrt(s) < limit within which
the mapping does not fold.

Source: OpenCV documentation, "Camera Calibration and 3D Reconstruction", detailed description (which has no
lx, ly); the order of the first ten coefficients, and lx and ly, are those of the Sensor Fusion Scene format.
"""

import math

import numpy as np
from numba import float32, int64, njit, uint64

from sceneloom.arrays import Float64Array
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
from sceneloom.cameras.domain import first_positive_root, radius_without_fold

_ITERATIONS = 60
_SMALLEST_STEP = 1e-4
_EXACT = 1e-14
_GOOD = 1e-12


def domain_limit(coefficients: tuple[float, ...]) -> float:
    """The distance from the axis on the plane z = 1 up to which no two points share a pixel.

    It is the first fold or pole of the radial part, or a nearer fold that the other terms make in some
    direction.
    """
    k1, k2, _, _, k3, k4, k5, k6 = coefficients[:8]
    above, below = np.array([k3, k2, k1, 1.0]), np.array([k6, k5, k4, 1.0])
    # The slope of r N(s)/D(s), s = r², has the sign of N D + 2 s (N' D - N D').
    bend: Float64Array = np.polysub(
        np.polymul(np.polyder(above), below), np.polymul(above, np.polyder(below))
    )
    slope = np.polyadd(np.polymul(above, below), np.polymul([2.0, 0.0], bend))
    limit = math.sqrt(min(first_positive_root(slope), first_positive_root(below)))
    if not any(coefficients[2:4] + coefficients[8:14]):
        return limit
    terms = _terms.py_func((1.0, 1.0, 0.0, 0.0, *coefficients))
    return radius_without_fold(lambda x, y: _distort.py_func(x, y, terms)[2:], limit)


@njit(**INLINE)
def _terms(lens):  # type: ignore[no-untyped-def]
    """The coefficients but for the tilt, and whether the rarer ones are needed at all."""
    k1, k2, p1, p2, k3, k4, k5, k6 = lens[4], lens[5], lens[6], lens[7], lens[8], lens[9], lens[10], lens[11]
    lx, ly, s1, s2, s3, s4 = lens[12], lens[13], lens[14], lens[15], lens[16], lens[17]
    rational = k4 != 0.0 or k5 != 0.0 or k6 != 0.0
    return k1, k2, p1, p2, k3, k4, k5, k6, lx, ly, s1, s2, s3, s4, rational


@njit(**INLINE)
def _distort(x, y, terms):  # type: ignore[no-untyped-def]
    """Give x', y' and dx'/dx, dx'/dy, dy'/dx, dy'/dy, which cost nothing where they are not used."""
    k1, k2, p1, p2, k3, k4, k5, k6, lx, ly, s1, s2, s3, s4, rational = terms
    s = x * x + y * y
    a, b = x + lx, y + ly
    g = 1.0 + s * (k1 + s * (k2 + s * k3))
    g_s = k1 + s * (2.0 * k2 + s * 3.0 * k3)
    if rational:
        below = 1.0 / (1.0 + s * (k4 + s * (k5 + s * k6)))
        g = g * below
        g_s = (g_s - g * (k4 + s * (2.0 * k5 + s * 3.0 * k6))) * below
    mixed = 2.0 * a * b
    distorted_x = a * g + p1 * mixed + p2 * (s + 2.0 * a * a) + s * (s1 + s * s2)
    distorted_y = b * g + p1 * (s + 2.0 * b * b) + p2 * mixed + s * (s3 + s * s4)
    radial_x = a * g_s + p2 + s1 + 2.0 * s2 * s
    radial_y = b * g_s + p1 + s3 + 2.0 * s4 * s
    return (
        distorted_x,
        distorted_y,
        g + 2.0 * p1 * b + 4.0 * p2 * a + radial_x * 2.0 * x,
        2.0 * p1 * a + radial_x * 2.0 * y,
        2.0 * p2 * b + radial_y * 2.0 * x,
        g + 4.0 * p1 * b + 2.0 * p2 * a + radial_y * 2.0 * y,
    )


@njit(**INLINE)
def _tilt(lens):  # type: ignore[no-untyped-def]
    """The six numbers of the map onto an image plane turned by tx, then ty, and whether it is turned."""
    tx, ty = lens[18], lens[19]
    cos_x, sin_x, cos_y, sin_y = math.cos(tx), math.sin(tx), math.cos(ty), math.sin(ty)
    return cos_x, cos_y, sin_x * sin_y, sin_y, cos_y * sin_x, cos_y * cos_x, tx != 0.0 or ty != 0.0


@njit(**INLINE)
def _onto_tilted(x, y, tilt):  # type: ignore[no-untyped-def]
    scale_x, scale_y, shear, w_x, w_y, w_1, _ = tilt
    w = w_x * x - w_y * y + w_1
    if not w > 0.0:
        return math.nan, math.nan
    return scale_x * x / w, (scale_y * y - shear * x) / w


@njit(**INLINE)
def _from_tilted(x, y, tilt):  # type: ignore[no-untyped-def]
    """Solve the two linear equations that `_onto_tilted` poses."""
    scale_x, scale_y, shear, w_x, w_y, w_1, _ = tilt
    xx, xy = scale_x - x * w_x, x * w_y
    yx, yy = -shear - y * w_x, scale_y + y * w_y
    determinant = xx * yy - xy * yx
    if not determinant > 0.0:
        return math.nan, math.nan
    return (x * yy - xy * y) * w_1 / determinant, (xx * y - yx * x) * w_1 / determinant


@njit(**INLINE)
def _project(x, y, z, fx, fy, cx, cy, terms, tilt, limit_squared):  # type: ignore[no-untyped-def]
    if not z > MINIMUM_DEPTH:
        return math.nan, math.nan
    x, y = x / z, y / z
    if not x * x + y * y < limit_squared:
        return math.nan, math.nan
    x, y, _, _, _, _ = _distort(x, y, terms)
    if tilt[6]:
        x, y = _onto_tilted(x, y, tilt)
    return fx * x + cx, fy * y + cy


@njit(**PART)
def _project_block(flat_points, pose, lens, terms, tilt, columns, rows, depths):  # type: ignore[no-untyped-def]
    """Project as many points as the outputs have room for, without a branch between them."""
    fx, fy, cx, cy, limit_squared = lens[0], lens[1], lens[2], lens[3], lens[20] * lens[20]
    for i in range(len(columns)):
        x, y, z = camera_coordinates(flat_points[3 * i], flat_points[3 * i + 1], flat_points[3 * i + 2], pose)
        x, y = x / z, y / z
        known = (z > MINIMUM_DEPTH) & (x * x + y * y < limit_squared)
        x, y, _, _, _, _ = _distort(x, y, terms)
        if tilt[6]:
            x, y = _onto_tilted(x, y, tilt)
        columns[i] = float32(fx * x + cx) if known else float32(math.nan)
        rows[i], depths[i] = float32(fy * y + cy), float32(z)


@njit(PICTURE_SIGNATURE, **KERNEL)
def project_into_picture(  # type: ignore[no-untyped-def]
    points_world, camera_from_world, lens, width, height, point_ids, pixels, depths
):
    """Keep the points that fall into the picture; see `compiled`."""
    pose, terms, tilt = pose_numbers(camera_from_world), _terms(lens), _tilt(lens)
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
        _project_block(flat_points[3 * start : 3 * (start + size)], pose, lens, terms, tilt, u, v, z)
        count = keep_in_picture(start, u, v, z, width, height, count, point_ids, flat_pixels, depths)
    return int64(count)


@njit(ROWS_SIGNATURE, **KERNEL)
def project_points(points_camera, lens, pixels):  # type: ignore[no-untyped-def]
    """Give a pixel for every point; see `compiled`."""
    terms, tilt = _terms(lens), _tilt(lens)
    for i in range(len(points_camera)):
        x, y, z = points_camera[i, 0], points_camera[i, 1], points_camera[i, 2]
        pixels[i, 0], pixels[i, 1] = _project(
            x, y, z, lens[0], lens[1], lens[2], lens[3], terms, tilt, lens[20] * lens[20]
        )


@njit(**INLINE)
def _undistort(target_x, target_y, terms, limit):  # type: ignore[no-untyped-def]
    """Solve x', y' = target by Newton's method, each step halved until it comes nearer inside the domain."""
    size = math.sqrt(target_x * target_x + target_y * target_y)
    start = 1.0 if size < limit else 0.9 * limit / size
    x, y = start * target_x, start * target_y
    to_x, to_y, xx, xy, yx, yy = _distort(x, y, terms)
    off_x, off_y = to_x - target_x, to_y - target_y
    off = math.sqrt(off_x * off_x + off_y * off_y)
    for _ in range(_ITERATIONS):
        if off <= _EXACT * (1.0 + size):
            break
        determinant = xx * yy - xy * yx
        step_x, step_y = (xy * off_y - yy * off_x) / determinant, (yx * off_x - xx * off_y) / determinant
        before, part = off, 1.0
        while part > _SMALLEST_STEP and not off < before:
            new_x, new_y = x + part * step_x, y + part * step_y
            if new_x * new_x + new_y * new_y < limit * limit:
                to_x, to_y, xx, xy, yx, yy = _distort(new_x, new_y, terms)
                off_x, off_y = to_x - target_x, to_y - target_y
                off = math.sqrt(off_x * off_x + off_y * off_y)
            part *= 0.5
        if not off < before:
            off = before
            break
        x, y = new_x, new_y
    if off <= _GOOD * (1.0 + size):
        return x, y
    return math.nan, math.nan


@njit(ROWS_SIGNATURE, **KERNEL)
def unproject_pixels(pixels, lens, rays):  # type: ignore[no-untyped-def]
    """Give a unit ray for every pixel; see `compiled`."""
    terms, tilt = _terms(lens), _tilt(lens)
    for i in range(len(pixels)):
        x, y = (pixels[i, 0] - lens[2]) / lens[0], (pixels[i, 1] - lens[3]) / lens[1]
        if tilt[6]:
            x, y = _from_tilted(x, y, tilt)
        x, y = _undistort(x, y, terms, lens[20])
        rays[i, 0], rays[i, 1], rays[i, 2] = unit_ray(x, y)
