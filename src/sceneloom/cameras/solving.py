"""Undoing a distortion: Newton's method, first a few steps without a test, then carefully where they did not do.

Within its domain a camera model takes no two locations to one (see `domain`), so a solution that lies inside is the
one.
"""

import math

from numba import njit

from sceneloom.cameras.compiled import INLINE, PART
from sceneloom.cameras.formulas import distance_at, distort

_QUICK_STEPS = 4
_ITERATIONS = 60
_ANYWHERE, _INSIDE_ONLY = False, True
_SMALLEST_STEP = 1e-4
_EXACT = 1e-14
_GOOD = 1e-12
_ROUNDING = 1e-15
_INSIDE = 1.0 - 1e-12


@njit(**INLINE)
def approach_angle(distance, camera_model):  # type: ignore[no-untyped-def]
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
def angle_at(distance, camera_model):  # type: ignore[no-untyped-def]
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
def approach_location(x, y, camera_model):  # type: ignore[no-untyped-def]
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
def position_at(x, y, camera_model):  # type: ignore[no-untyped-def]
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
