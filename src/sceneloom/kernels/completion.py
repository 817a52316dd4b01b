"""Depth completion: gaps filled along columns and rows, interpolated triangles, edge-aware smoothing.

And the confidence of each pixel.

Along each row and column the values x that minimise Σ (x - value)² + λ Σ link (x - next x)² follow from one
tridiagonal system; rows and columns take rotates while λ falls. With weights, values and weights are smoothed alike and
divided, so that what is trusted flows into what is not.

Source: Min et al. 2014, "Fast Global Image Smoothing Based on Weighted Least Squares", IEEE TIP 23 (12), eq. 9 and 11
(λ of rotation t of T: 1.5 · 4^(T-t) / (4^T - 1) · λ).
"""

import math
from typing import Any

import numba
import numpy as np
from numba import boolean, float32, int32, int64, types, uint8, void

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, UInt8Array
from sceneloom.kernels.cache import kernel

_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)

_KERNEL: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}

_PART: dict[str, Any] = {"nogil": True, "inline": "always", "error_model": "numpy"}

_FAR = np.float32(1e6)

_NOTHING = np.float32(0)

_EVEN, _SUDDEN = np.float32(0.85), np.float32(1 / 0.45)
"""Up to 0.85 of the steepest slope two samples are of one surface; from 1.3 on there is a jump between them."""

_BEYOND = np.float32(0.3)
"""How far another surface may be, as a share of the depth, where only one side is known."""


@kernel(void(_IN_F32_2D, int64, float32[:, ::1]), **_KERNEL)
def widen_samples(sparse: Float32Array, slack: int, widened: Float32Array) -> None:
    """Widen each sample along its row, by at most `slack` pixels; what lies between two is shared out by halves.

    Args:
        sparse: (H, W) [m], 0 for nothing.
        slack: [px].
        widened: (H, W) [m], written.
    """
    height, width = sparse.shape
    for row in range(height):
        last = -1
        for column in range(width):
            widened[row, column] = 0
        for column in range(width):
            depth = sparse[row, column]
            if not depth > 0:
                continue
            first = max(0, column - slack)
            if last >= 0:
                first = max(first, (last + column) // 2 + 1)
            for k in range(first, min(width, column + slack + 1)):
                widened[row, k] = depth
            last = column


@kernel(void(_IN_F32_2D, float32[:, ::1], float32[:, ::1]), **_KERNEL)
def look_up(widened: Float32Array, depths: Float32Array, distances: Float32Array) -> None:
    """Give the next sample above each pixel, itself included, and how many rows it is away.

    Args:
        widened: (H, W) [m], 0 for nothing.
        depths: (H, W) [m], written; 0 for none.
        distances: (H, W) [px], written; very large for none.
    """
    height, width = widened.shape
    for column in range(width):
        depths[0, column] = widened[0, column]
        distances[0, column] = _NOTHING if widened[0, column] > 0 else _FAR
    for row in range(1, height):
        for column in range(width):
            here = widened[row, column]
            known = here > 0
            depths[row, column] = here if known else depths[row - 1, column]
            distances[row, column] = _NOTHING if known else distances[row - 1, column] + np.float32(1)


@numba.njit(**_PART)
def _join(near: float, to_near: float, other: float, to_other: float, steepest: float) -> tuple[Any, Any]:
    """Give depth and trust of a pixel between two samples that lie so many pixels from it."""
    one = np.float32(1)
    gap = to_near + to_other
    share = to_other / gap
    inverse_near, inverse_other = one / near, one / other
    inverse = share * inverse_near + (one - share) * inverse_other
    steepness = abs(inverse_near - inverse_other) / (gap * steepest)
    jump = min(one, max(_NOTHING, _SUDDEN * (steepness - _EVEN)))
    return (one - jump) / inverse + jump * (share * near + (one - share) * other), one - jump


@kernel(
    void(
        _IN_F32_2D, _IN_F32_2D, _IN_F32_2D, float32, float32, float32,
        float32[:, ::1], float32[:, ::1], float32[:, ::1], float32[:, ::1],
    ),
    **_KERNEL,
)  # fmt: skip
def fill_down(
    widened: Float32Array,
    depths_above: Float32Array,
    distances_above: Float32Array,
    longest: float,
    reach: float,
    steepest: float,
    depth_image: Float32Array,
    trust_image: Float32Array,
    spread_image: Float32Array,
    gap_image: Float32Array,
) -> None:
    """Fill gaps along columns: between two samples by both, beyond the last one a little trajectory by this one.

    Args:
        widened: (H, W) [m], the samples, 0 for nothing.
        depths_above, distances_above: (H, W), as `look_up` gives them.
        longest: the longest gap that is filled [px].
        reach: how far the last sample of a column reaches [px].
        steepest: how much the inverse depth of one surface changes at most from pixel to pixel [1/m/px].
        depth_image: (H, W) [m], written; 0 where nothing is near.
        trust_image: (H, W), written: 1 for one surface, 0 for a jump, and beyond the last sample.
        spread_image: (H, W) [m], written: how far apart the two depths are.
        gap_image: (H, W) [px], written: the gap's length, twice the distance beyond the last sample.
    """
    height, width = widened.shape
    below, distances = np.zeros(width, np.float32), np.full(width, _FAR, np.float32)
    one = np.float32(1)
    for row in range(height - 1, -1, -1):
        for column in range(width):
            here, above, to_above = (
                widened[row, column],
                depths_above[row, column],
                distances_above[row, column],
            )
            known = here > 0
            other = here if known else below[column]
            to_other = _NOTHING if known else distances[column] + one
            below[column], distances[column] = other, to_other
            depth, trust, spread, gap = here, one, _NOTHING, _NOTHING
            if not known:
                nearest, gap = min(to_above, to_other), to_above + to_other
                if gap <= longest:
                    depth, trust = _join(above, to_above, other, to_other, steepest)
                    spread = abs(above - other)
                elif nearest <= reach:
                    depth, trust, gap = (above if to_above < to_other else other), _NOTHING, nearest + nearest
                    spread = depth * _BEYOND
            depth_image[row, column], trust_image[row, column] = depth, trust
            spread_image[row, column], gap_image[row, column] = spread, gap


@kernel(
    void(
        _IN_F32_2D, float32, float32, float32[:, ::1], float32[:, ::1], float32[:, ::1], float32[:, ::1],
    ),
    **_KERNEL,
)  # fmt: skip
def fill_across(
    sparse: Float32Array,
    longest: float,
    steepest: float,
    depth_image: Float32Array,
    trust_image: Float32Array,
    spread_image: Float32Array,
    gap_image: Float32Array,
) -> None:
    """Fill gaps along rows where that is the shorter arc, as `fill_down` does along columns.

    Args:
        sparse: (H, W) [m], the samples, 0 for nothing.
        longest: the longest gap that is filled [px].
        steepest: how much the inverse depth of one surface changes at most from pixel to pixel [1/m/px].
        depth_image, trust_image, spread_image, gap_image: (H, W), what is known already; written.
    """
    height, width = sparse.shape
    for row in range(height):
        last = -1
        for column in range(width):
            if not sparse[row, column] > 0:
                continue
            gap = np.float32(column - last)
            if last >= 0 and gap <= longest:
                left, right = sparse[row, last], sparse[row, column]
                for k in range(last + 1, column):
                    if depth_image[row, k] > 0 and gap_image[row, k] <= gap:
                        continue
                    depth_image[row, k], trust_image[row, k] = _join(
                        left, np.float32(k - last), right, np.float32(column - k), steepest
                    )
                    spread_image[row, k], gap_image[row, k] = abs(left - right), gap
            last = column


@kernel(void(_IN_F32_2D, float32[:, ::1], float32[:, ::1]), **_KERNEL)
def blend_neighbours(depth_image: Float32Array, room: Float32Array, blended: Float32Array) -> None:
    """Average each filled pixel with the filled ones beside it, weighted 1 4 6 4 1 along both axes.

    Args:
        depth_image: (H, W) [m], 0 for nothing.
        room: (2, H * W), overwritten.
        blended: (H, W) [m], written; 0 where `depth_image` is.

    Source: Burt 1981, Computer Graphics and Image Processing 16, the binomial kernel of five.
    """
    height, width = depth_image.shape
    four, six = np.float32(4), np.float32(6)
    sums, weights = room[0].reshape(height, width), room[1].reshape(height, width)
    padded, present = np.zeros(width + 4, np.float32), np.zeros(width + 4, np.float32)
    for row in range(height):
        for column in range(width):
            depth = depth_image[row, column]
            padded[column + 2] = depth
            present[column + 2] = np.float32(1) if depth > 0 else _NOTHING
        for column in range(width):
            sums[row, column] = (
                padded[column] + padded[column + 4] + four * (padded[column + 1] + padded[column + 3])
                + six * padded[column + 2]
            )  # fmt: skip
            weights[row, column] = (
                present[column] + present[column + 4] + four * (present[column + 1] + present[column + 3])
                + six * present[column + 2]
            )  # fmt: skip
    for row in range(height):
        a, b = max(row - 2, 0), max(row - 1, 0)
        d, e = min(row + 1, height - 1), min(row + 2, height - 1)
        for column in range(width):
            total = (
                sums[a, column] + sums[e, column] + four * (sums[b, column] + sums[d, column])
                + six * sums[row, column]
            )  # fmt: skip
            weight = (
                weights[a, column] + weights[e, column] + four * (weights[b, column] + weights[d, column])
                + six * weights[row, column]
            )  # fmt: skip
            blended[row, column] = total / weight if depth_image[row, column] > 0 else _NOTHING


_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)

_IN_I32_2D = types.Array(int32, 2, "C", readonly=True)

_IN_BOOL_1D = types.Array(boolean, 1, "C", readonly=True)

_TRIANGLE_FILLING_KERNEL: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}

_TRIANGLE_FILLING_PART: dict[str, Any] = {"nogil": True, "inline": "always", "error_model": "numpy"}

_TRIANGLE_FILLING_NOTHING, _HALF = np.float32(0.0), np.float32(0.5)

_SLIVER = np.float32(0.1)
"""Twice the least area of a triangle that reports a slope [px²]."""

_ROUNDING = np.float32(1e-4)
"""How far outside a triangle a pixel may lie and still be filled by it, as a share of the triangle."""


@kernel(void(_IN_F32_2D, _IN_F32_1D, _IN_I32_2D, float32[:, ::1]), **_TRIANGLE_FILLING_KERNEL)
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


@kernel(
    void(_IN_F32_2D, _IN_F32_1D, _IN_I32_2D, _IN_F32_1D, float32[:, ::1], float32[::1]),
    **_TRIANGLE_FILLING_KERNEL,
)
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
    slopes[:], weights[:] = _TRIANGLE_FILLING_NOTHING, _TRIANGLE_FILLING_NOTHING
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


@numba.njit(**_TRIANGLE_FILLING_PART)
def _span(value: float, step: float, columns: int) -> tuple[int, int]:
    """First and last of so many columns in which a value that grows by `step` is not below the rounding."""
    if step > 0:
        return max(0, math.ceil((-_ROUNDING - value) / step)), columns
    if step < 0:
        return 0, min(columns, math.floor((-_ROUNDING - value) / step))
    return 0, columns if value >= -_ROUNDING else -1


@numba.njit(**_TRIANGLE_FILLING_PART)
def _rise(slopes: Float32Array, corner: int, across: float, down: float) -> Any:
    """What a corner's slope adds so many pixels away."""
    return slopes[corner, 0] * across + slopes[corner, 1] * down


@numba.njit(**_TRIANGLE_FILLING_PART)
def _evenness(
    pixels: Float32Array, slopes: Float32Array, corners: tuple[Any, ...], inverses: tuple[Any, ...]
) -> Any:
    """Give how far depth itself counts as linear: where slopes miss the other corners, and depths are unlike."""
    least, most, off = min(inverses), max(inverses), _TRIANGLE_FILLING_NOTHING
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
    **_TRIANGLE_FILLING_KERNEL,
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


_IN_U8_3D = types.Array(uint8, 3, "C", readonly=True)

_EDGE_AWARE_KERNEL: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "arcp"},
}

_LANES = 16


@kernel(void(_IN_U8_3D, _IN_F32_1D, float32[:, ::1], float32[:, ::1]), cache=True, nogil=True)
def link_pixels(
    rgb: UInt8Array, link_of_difference: Float32Array, rightward: Float32Array, downward: Float32Array
) -> None:
    """Give the strength of the links between neighbouring pixels.

    Args:
        rgb: (H, W, 3).
        link_of_difference: (766,), by the sum of the differences of the three channels.
        rightward, downward: (H, W), written: of each pixel to the next one; 0 in the last column or row.
    """
    height, width = rightward.shape
    for row in range(height):
        for column in range(width):
            right, down = 0, 0
            if column + 1 < width:
                for k in range(3):
                    right += abs(int64(rgb[row, column, k]) - int64(rgb[row, column + 1, k]))
                rightward[row, column] = link_of_difference[right]
            else:
                rightward[row, column] = 0
            if row + 1 < height:
                for k in range(3):
                    down += abs(int64(rgb[row, column, k]) - int64(rgb[row + 1, column, k]))
                downward[row, column] = link_of_difference[down]
            else:
                downward[row, column] = 0


@kernel(void(_IN_F32_2D, float32, float32[:, ::1], float32[:, ::1], float32[:, ::1]), **_EDGE_AWARE_KERNEL)
def smooth_downward(
    links: Float32Array, strength: float, first: Float32Array, second: Float32Array, room: Float32Array
) -> None:
    """Smooth two images along axis 0, all columns side by side.

    Args:
        links: (N, M), of each row to the next; 0 in the last.
        strength: λ.
        first, second: (N, M), smoothed in place.
        room: (N, M), overwritten.
    """
    count, lanes = first.shape
    one = np.float32(1)
    for column in range(lanes):
        link = strength * links[0, column]
        scale = one / (one + link)
        room[0, column] = link * scale
        first[0, column] *= scale
        second[0, column] *= scale
    for row in range(1, count):
        for column in range(lanes):
            above, link = strength * links[row - 1, column], strength * links[row, column]
            scale = one / (one + above + link - above * room[row - 1, column])
            room[row, column] = link * scale
            first[row, column] = (first[row, column] + above * first[row - 1, column]) * scale
            second[row, column] = (second[row, column] + above * second[row - 1, column]) * scale
    for row in range(count - 2, -1, -1):
        for column in range(lanes):
            first[row, column] += room[row, column] * first[row + 1, column]
            second[row, column] += room[row, column] * second[row + 1, column]


@kernel(void(_IN_F32_2D, float32, float32[:, ::1], float32[:, ::1]), **_EDGE_AWARE_KERNEL)
def smooth_rightward(links: Float32Array, strength: float, first: Float32Array, second: Float32Array) -> None:
    """Smooth two images along axis 1: some rows at a time are laid side by side.

    Args:
        links: (H, W), of each pixel to the next; 0 in the last column.
        strength: λ.
        first, second: (H, W), smoothed in place.
    """
    height, width = first.shape
    laid = np.zeros((4, width, _LANES), np.float32)
    for top in range(0, height, _LANES):
        rows = min(_LANES, height - top)
        for k in range(rows):
            for column in range(width):
                laid[0, column, k] = links[top + k, column]
                laid[1, column, k] = first[top + k, column]
                laid[2, column, k] = second[top + k, column]
        smooth_downward(laid[0], strength, laid[1], laid[2], laid[3])
        for k in range(rows):
            for column in range(width):
                first[top + k, column] = laid[1, column, k]
                second[top + k, column] = laid[2, column, k]


@kernel(
    void(
        _IN_F32_2D, _IN_F32_2D, _IN_F32_2D, _IN_F32_2D, float32, float32, float32, float32,
        _IN_F32_1D, _IN_F32_1D, _IN_F32_2D, float32[:, ::1],
    ),
    cache=True,
    nogil=True,
    error_model="numpy",
)  # fmt: skip
def grade_depths(
    depths: Float32Array,
    trusts: Float32Array,
    spreads: Float32Array,
    gaps: Float32Array,
    spacing: float,
    tolerance: float,
    tolerance_share: float,
    slope_share: float,
    doubt_steps: Float32Array,
    gap_steps: Float32Array,
    table: Float32Array,
    confidence: Float32Array,
) -> None:
    """Look up the confidence of each pixel by its doubt and its gap.

    The doubt is the spread of the depths around the pixel, in tolerances; where these are of one surface, only
    `slope_share` of it counts.

    Args:
        depths: (H, W) [m], 0 for none, which has no confidence.
        trusts: (H, W), 1 on one surface, 0 across a jump.
        spreads: (H, W) [m].
        gaps: (H, W) [px].
        spacing: [px], the unit of the gaps.
        tolerance: [m], or …
        tolerance_share: … this share of the depth where that is more.
        slope_share: of the spread on one surface.
        doubt_steps: (D - 1,) rising, the borders of the table's rows.
        gap_steps: (G - 1,) rising, the borders of its columns.
        table: (D, G).
        confidence: (H, W), written.
    """
    height, width = depths.shape
    one = np.float32(1)
    for row in range(height):
        for column in range(width):
            depth = depths[row, column]
            if not depth > 0:
                confidence[row, column] = 0
                continue
            allowed = max(tolerance, tolerance_share * depth)
            share = one - trusts[row, column] * (one - slope_share)
            doubt, gap = share * spreads[row, column] / allowed, gaps[row, column] / spacing
            d, g = 0, 0
            for k in range(doubt_steps.shape[0]):
                d += doubt >= doubt_steps[k]
            for k in range(gap_steps.shape[0]):
                g += gap >= gap_steps[k]
            confidence[row, column] = table[d, g]
