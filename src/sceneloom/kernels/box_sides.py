"""What the sides of a box in a picture tell of where the box is in space and how large, by Kalman's update."""

import numpy as np
from numba import njit

from sceneloom.arrays import Float64Array, Int64Array


@njit(
    "int64[:,::1](float64[:,:,::1], float64[:,::1], float64, float64, float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def bounding_corners(
    pixels: Float64Array, boxes_xyxy: Float64Array, width: float, height: float, border: float
) -> Int64Array:
    """Find the corners that bound boxes in a picture, where it cuts neither them nor their partners.

    Args:
        pixels: (M, 8, 2) [px], of the corners; NaN for those that the lens does not see.
        boxes_xyxy: (M, 4) [px], the partners.
        width, height: of the picture [px].
        border: what comes so near to the border may be cut there [px].

    Returns:
        (M, 4) int64: the corners at the left, top, right and bottom; -1 for both of a pair of sides that may be cut,
        and for all four where a corner is not seen.
    """
    sides = np.full((len(pixels), 4), -1, np.int64)
    for m in range(len(pixels)):
        seen = True
        for k in range(8):
            seen = seen and np.isfinite(pixels[m, k, 0]) and np.isfinite(pixels[m, k, 1])
        for axis in range(2):
            low, high = 0, 0
            for k in range(1, 8):
                low = k if pixels[m, k, axis] < pixels[m, low, axis] else low
                high = k if pixels[m, k, axis] > pixels[m, high, axis] else high
            last = (width if axis == 0 else height) - border
            whole = pixels[m, low, axis] >= border and pixels[m, high, axis] <= last
            whole = whole and boxes_xyxy[m, axis] >= border and boxes_xyxy[m, axis + 2] <= last
            if seen and whole:
                sides[m, axis], sides[m, axis + 2] = low, high
    return sides


@njit("float64[:,::1](float64[:,:,::1], int64[:,::1], float64)", nogil=True, cache=True, error_model="numpy")
def shifted_corners(corners: Float64Array, sides: Int64Array, step: float) -> Float64Array:
    """Move the corners at the sides of boxes along the axes of their frame, to either side.

    Args:
        corners: (M, 8, 3) [m].
        sides: (M, 4) of `bounding_corners`; any corner stands for -1.
        step: how far [m].

    Returns:
        (M * 4 * 6, 3) float64 [m]: of each corner those moved along x, y, z, then back along x, y, z.
    """
    shifted = np.empty((len(corners) * 24, 3))
    for m in range(len(corners)):
        for side in range(4):
            for c in range(6):
                row = (m * 4 + side) * 6 + c
                for k in range(3):
                    shifted[row, k] = corners[m, max(sides[m, side], 0), k]
                shifted[row, c % 3] += step if c < 3 else -step
    return shifted


@njit(nogil=True, error_model="numpy", inline="always")
def _slope(shifted, step, m, side, axis, turn, signs, corner, row):  # type: ignore[no-untyped-def]
    """Fill a row with how a side moves with the middle of its box and its sizes, (6,)."""
    for k in range(6):
        row[k] = 0.0
    for c in range(3):
        along = (shifted[m, side, c, axis] - shifted[m, side, c + 3, axis]) / (2.0 * step)
        for k in range(3):
            row[k] += along * turn[0, c, k]
            row[k + 3] += along * turn[1, c, k] * signs[corner, k] / 2.0


@njit(nogil=True, error_model="numpy", inline="always")
def _update(states, covariances, m, row, residual, variance, gain):  # type: ignore[no-untyped-def]
    """One scalar update of a state and its covariance; `gain` is room for six numbers."""
    spread = variance
    for k in range(6):
        gain[k] = 0.0
        for n in range(6):
            gain[k] += covariances[m, k, n] * row[n]
        spread += row[k] * gain[k]
    for k in range(6):
        states[m, k] += gain[k] / spread * residual
    for k in range(6):
        for n in range(k, 6):
            changed = covariances[m, k, n] - gain[k] * gain[n] / spread
            covariances[m, k, n] = changed
            covariances[m, n, k] = changed


@njit(
    "void(float64[:,::1], float64[:,:,::1], float64[:,:,:,::1], Array(float64, 2, 'C', readonly=True), "
    "float64[:,:,::1], int64[:,::1], float64[:,:,:,::1], float64, float64[:,::1], float64[:,::1], float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def update_by_sides(
    states: Float64Array,
    covariances: Float64Array,
    turns: Float64Array,
    signs: Float64Array,
    pixels: Float64Array,
    sides: Int64Array,
    shifted: Float64Array,
    step: float,
    boxes_xyxy: Float64Array,
    sigmas: Float64Array,
    farthest: float,
) -> None:
    """Update boxes by the middle of their partners in the picture, and by the height of those.

    Each of the three numbers z = h(state) + noise is taken by itself, one after the other, with the slopes H of h where
    the box was before all of them. One that is too far from what was expected there is left out.

    Args:
        states: (M, 6) [m]: middle x, y, z, length, width, height; changed.
        covariances: (M, 6, 6) [m²]; changed.
        turns: (M, 2, 3, 3): rotations from the frame of the middles, and from that of the sizes, into the camera's.
        signs: (8, 3), on which side of the middle each corner lies.
        pixels: (M, 8, 2) [px], of the corners.
        sides: (M, 4) of `bounding_corners`.
        shifted: (M, 4, 6, 2) [px], of the corner at each side, moved by `step` along the camera's axes: x, y, z, and
            back along x, y, z.
        step: [m].
        boxes_xyxy: (M, 4) [px], the partners.
        sigmas: (M, 3) [px], deviations of the middle across and upright, and of the height.
        farthest: a number farther off than so many deviations is left out.

    Source: Kalman 1960, "A New Approach to Linear Filtering and Prediction Problems"; one number after the other:
    Bierman 1977, "Factorization Methods for Discrete Sequential Estimation", ch. II.
    """
    rows, residuals, taken = np.empty((3, 6)), np.empty(3), np.empty(3, np.bool_)
    low, high, gain, before = np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    for m in range(len(states)):
        for k in range(6):
            before[k] = states[m, k]
        for n in range(3):
            axis = 0 if n == 0 else 1
            taken[n] = sides[m, axis] >= 0
            if not taken[n]:
                continue
            first, last = sides[m, axis], sides[m, axis + 2]
            _slope(shifted, step, m, axis, axis, turns[m], signs, first, low)
            _slope(shifted, step, m, axis + 2, axis, turns[m], signs, last, high)
            of_low, of_high = (0.5, 0.5) if n < 2 else (-1.0, 1.0)
            residuals[n] = of_low * (boxes_xyxy[m, axis] - pixels[m, first, axis]) + of_high * (
                boxes_xyxy[m, axis + 2] - pixels[m, last, axis]
            )
            spread = sigmas[m, n] ** 2
            for k in range(6):
                rows[n, k] = of_low * low[k] + of_high * high[k]
            for k in range(6):
                for i in range(6):
                    spread += rows[n, k] * covariances[m, k, i] * rows[n, i]
            # false for a NaN, too
            taken[n] = residuals[n] * residuals[n] <= farthest * farthest * spread
        for n in range(3):
            if taken[n]:
                residual = residuals[n]
                for k in range(6):
                    residual -= rows[n, k] * (states[m, k] - before[k])
                _update(states, covariances, m, rows[n], residual, sigmas[m, n] ** 2, gain)
