"""Triangles over an image: how steep they are, and what they report the pixels in them."""

import math
from typing import Any

import numba
import numpy as np
from numba import boolean, float32, int32, types, void

from sceneloom.arrays import AnyArray, BoolArray, Float32Array
from sceneloom.kernels.cache import kernel

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)
_IN_I32_2D = types.Array(int32, 2, "C", readonly=True)
_IN_BOOL_1D = types.Array(boolean, 1, "C", readonly=True)
_KERNEL: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
_PART: dict[str, Any] = {"nogil": True, "inline": "always", "error_model": "numpy"}

_NOTHING, _HALF = np.float32(0.0), np.float32(0.5)
_SLIVER = np.float32(0.1)
"""Twice the least area of a triangle that reports a slope [px²]."""

_ROUNDING = np.float32(1e-4)
"""How far outside a triangle a pixel may lie and still be filled by it, as a share of the triangle."""


@kernel(void(_IN_F32_2D, _IN_F32_1D, _IN_I32_2D, float32[:, ::1]), **_KERNEL)
def measure_triangles(
    pixels: Float32Array, inverse_depths: Float32Array, triangles: AnyArray, measures: Float32Array
) -> None:
    """Measure each triangle.

    Args:
        pixels: (N, 2) [px].
        inverse_depths: (N,) [1/m].
        triangles: (T, 3).
        measures: (T, 3), written: area [px²]; length of the longest side [px]; how much the inverse depth changes for
            a pixel, the steepest trajectory [1/m/px], infinite for triangles without area.
    """
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        bu, bv = pixels[b, 0] - pixels[a, 0], pixels[b, 1] - pixels[a, 1]
        cu, cv = pixels[c, 0] - pixels[a, 0], pixels[c, 1] - pixels[a, 1]
        twice = bu * cv - bv * cu
        longest = max(bu * bu + bv * bv, cu * cu + cv * cv, (bu - cu) ** 2 + (bv - cv) ** 2)
        db, dc = inverse_depths[b] - inverse_depths[a], inverse_depths[c] - inverse_depths[a]
        slope_u, slope_v = (db * cv - dc * bv) / twice, (dc * bu - db * cu) / twice
        measures[t, 0] = 0.5 * abs(twice)
        measures[t, 1] = math.sqrt(longest)
        measures[t, 2] = math.sqrt(slope_u * slope_u + slope_v * slope_v) if twice != 0 else math.inf


@kernel(void(_IN_F32_2D, _IN_F32_1D, _IN_I32_2D, _IN_F32_1D, float32[:, ::1], float32[::1]), **_KERNEL)
def measure_slopes(
    pixels: Float32Array,
    inverse_depths: Float32Array,
    triangles: AnyArray,
    trusts: Float32Array,
    slopes: Float32Array,
    weights: Float32Array,
) -> None:
    """Measure how the inverse depth changes around each point: the mean of its triangles, the smallest before all.

    Args:
        pixels: (N, 2) [px].
        inverse_depths: (N,) [1/m].
        triangles: (T, 3).
        trusts: (T,), 1 for one surface, 0 for a jump, which does not count.
        slopes: (N, 2) [1/m/px], written: rightward and downward; 0 where no triangle reports.
        weights: (N,), overwritten.
    """
    slopes[:], weights[:] = _NOTHING, _NOTHING
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        bu, bv = pixels[b, 0] - pixels[a, 0], pixels[b, 1] - pixels[a, 1]
        cu, cv = pixels[c, 0] - pixels[a, 0], pixels[c, 1] - pixels[a, 1]
        twice = bu * cv - bv * cu
        if abs(twice) < _SLIVER or trusts[t] <= 0:
            continue
        longest = max(bu * bu + bv * bv, cu * cu + cv * cv, (bu - cu) ** 2 + (bv - cv) ** 2)
        db, dc = inverse_depths[b] - inverse_depths[a], inverse_depths[c] - inverse_depths[a]
        room = longest + np.float32(1)
        weight = trusts[t] * abs(twice) / (room * room * room)
        slope_u, slope_v = weight * (db * cv - dc * bv) / twice, weight * (dc * bu - db * cu) / twice
        for k in (a, b, c):
            slopes[k, 0] += slope_u
            slopes[k, 1] += slope_v
            weights[k] += weight
    for k in range(slopes.shape[0]):
        if weights[k] > 0:
            slopes[k, 0] /= weights[k]
            slopes[k, 1] /= weights[k]


@numba.njit(**_PART)
def _span(value: float, step: float, columns: int) -> tuple[int, int]:
    """First and last of so many columns in which a value that grows by `step` is not below the rounding."""
    if step > 0:
        return max(0, math.ceil((-_ROUNDING - value) / step)), columns
    if step < 0:
        return 0, min(columns, math.floor((-_ROUNDING - value) / step))
    return 0, columns if value >= -_ROUNDING else -1


@numba.njit(**_PART)
def _rise(slopes: Float32Array, corner: int, across: float, down: float) -> Any:
    """What a corner's slope adds so many pixels away."""
    return slopes[corner, 0] * across + slopes[corner, 1] * down


@numba.njit(**_PART)
def _evenness(
    pixels: Float32Array, slopes: Float32Array, corners: tuple[Any, ...], inverses: tuple[Any, ...]
) -> Any:
    """Give how far depth itself counts as linear: where slopes miss the other corners, and depths are unlike."""
    least, most, off = min(inverses), max(inverses), _NOTHING
    for own in range(3):
        for other in range(3):
            k, m = corners[own], corners[other]
            reported = _rise(slopes, k, pixels[m, 0] - pixels[k, 0], pixels[m, 1] - pixels[k, 1])
            off = max(off, abs(inverses[other] - inverses[own] - reported))
    one = np.float32(1)
    return min(one, most / least - one) * (min(one, off / (most - least)) if most > least else one)


@kernel(
    void(
        _IN_F32_2D, _IN_F32_1D, _IN_F32_2D, _IN_I32_2D, _IN_BOOL_1D, _IN_F32_1D, _IN_F32_1D,
        float32[:, ::1], float32[:, ::1], float32[:, ::1], float32[:, ::1],
    ),
    **_KERNEL,
)  # fmt: skip
def fill_triangles(
    pixels: Float32Array,
    depths: Float32Array,
    slopes: Float32Array,
    triangles: AnyArray,
    filled: BoolArray,
    trusts: Float32Array,
    lengths: Float32Array,
    depth_image: Float32Array,
    trust_image: Float32Array,
    spread_image: Float32Array,
    length_image: Float32Array,
) -> None:
    """Fill the pixels of triangles: in inverse depth where these are trusted.

    On one surface, each corner reports its inverse depth and half of what its slope adds on the way to the pixel, and
    the pixel's shares in the triangle weigh the three: exact for planes and for what bends evenly. Nothing leaves the
    range of the corners. Where slopes miss the other corners, and these are unlike in depth, depths are linear, which
    errs least where nobody knows: entirely so where they miss by all there is, and one corner is twice as far as
    another.

    Across jumps, what the image reported already stays, and where it reported nothing, depths are linear.

    Args:
        pixels: (N, 2) [px].
        depths: (N,) [m].
        slopes: (N, 2) [1/m/px], how the inverse depth changes rightward and downward.
        triangles: (T, 3).
        filled: (T,), others are left out.
        trusts: (T,), 1 for one surface, 0 for a jump.
        lengths: (T,), longest sides [px].
        depth_image: (H, W) [m], 0 for nothing; written where a triangle is.
        trust_image: (H, W), the triangle's trust.
        spread_image: (H, W) [m], how far apart the triangle's depths are.
        length_image: (H, W) [px], the triangle's longest side.
    """
    height, width = depth_image.shape
    one = np.float32(1.0)
    for t in range(triangles.shape[0]):
        if not filled[t]:
            continue
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        au, av, bu, bv, cu, cv = (
            pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1], pixels[c, 0], pixels[c, 1]
        )  # fmt: skip
        left, right = max(0, math.ceil(min(au, bu, cu))), min(width - 1, math.floor(max(au, bu, cu)))
        top, bottom = max(0, math.ceil(min(av, bv, cv))), min(height - 1, math.floor(max(av, bv, cv)))
        twice = (bu - au) * (cv - av) - (bv - av) * (cu - au)
        if twice == 0:
            continue
        step_b, step_c = (cv - av) / twice, -(bv - av) / twice
        za, zb, zc = depths[a], depths[b], depths[c]
        spread, trust = max(za, zb, zc) - min(za, zb, zc), trusts[t]
        ya, yb, yc = one / za, one / zb, one / zc
        least, most = min(ya, yb, yc), max(ya, yb, yc)
        even = _evenness(pixels, slopes, (a, b, c), (ya, yb, yc))
        for row in range(top, bottom + 1):
            du, dv = np.float32(left) - au, np.float32(row) - av
            share_b = (du * (cv - av) - dv * (cu - au)) / twice
            share_c = (dv * (bu - au) - du * (bv - av)) / twice
            count = right - left
            first_b, last_b = _span(share_b, step_b, count)
            first_c, last_c = _span(share_c, step_c, count)
            first_a, last_a = _span(one - share_b - share_c, -step_b - step_c, count)
            for column in range(max(first_a, first_b, first_c), min(last_a, last_b, last_c) + 1):
                of_b, of_c = share_b + np.float32(column) * step_b, share_c + np.float32(column) * step_c
                of_a = one - of_b - of_c
                u = left + column
                across, down = np.float32(u), np.float32(row)
                bent = of_a * _rise(slopes, a, across - au, down - av)
                bent += of_b * _rise(slopes, b, across - bu, down - bv)
                bent += of_c * _rise(slopes, c, across - cu, down - cv)
                inverse = min(most, max(least, of_a * ya + of_b * yb + of_c * yc + _HALF * bent))
                linear = of_a * za + of_b * zb + of_c * zc
                surface = (one - even) / inverse + even * linear
                reported = depth_image[row, u]
                between = reported if reported > 0 else linear
                depth_image[row, u] = trust * surface + (one - trust) * between
                trust_image[row, u] = trust
                spread_image[row, u] = spread
                length_image[row, u] = lengths[t]
