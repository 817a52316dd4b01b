"""Gaps between the samples of a sparse image, filled from the nearest ones along columns and rows."""

from typing import Any

import numba
import numpy as np
from numba import float32, int64, types, void

from sceneloom.arrays import Float32Array
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
