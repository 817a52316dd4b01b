"""The update of a detected 3D box by the sides of its box in an image."""

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import inlined, part


@part
def _find_sides(pixels, n, box, limits, border, sides, m):  # type: ignore[no-untyped-def]
    """Fill in the corners that bound a box in an image, -1 for both of a pair of sides that it may cut."""
    seen = True
    for k in range(8):
        seen = seen and np.isfinite(pixels[n, k, 0]) and np.isfinite(pixels[n, k, 1])
    for axis in range(2):
        low, high, last = 0, 0, limits[axis] - border
        for k in range(1, 8):
            low = k if pixels[n, k, axis] < pixels[n, low, axis] else low
            high = k if pixels[n, k, axis] > pixels[n, high, axis] else high
        whole = pixels[n, low, axis] >= border and pixels[n, high, axis] <= last
        whole = whole and box[axis] >= border and box[axis + 2] <= last
        found = seen and whole
        sides[m, axis], sides[m, axis + 2] = (low, high) if found else (-1, -1)


@kernel(
    "Tuple((int64[::1], int64[:,::1], float64[:,::1]))(float64[:,:,::1], float64[:,:,::1], int64[::1], "
    "float64[:,::1], float64, float64, float64, float64)"
)
def shifted_sides(
    corners: Float64Array, pixels: Float64Array, partners: Int64Array, boxes_xyxy: Float64Array, width: float,
    height: float, border: float, step: float,
) -> tuple[Int64Array, Int64Array, Float64Array]:  # fmt: skip
    """Find the corners that bound boxes in an image, where it cuts neither them nor their partners, and move them.

    Args:
        corners: (N, 8, 3) [m].
        pixels: (N, 8, 2) [px], of the corners; NaN for those that the camera model does not see.
        partners: (N,), which box of the image is a box's partner, -1 for none.
        boxes_xyxy: (M, 4) [px], boxes of the image.
        width, height: of the image [px].
        border: what comes so near to the border may be cut there [px].
        step: how far corners are moved [m].

    Returns:
        rows: (P,) int64, the boxes with a partner; then of these
        sides: (P, 4) int64, the corners at the left, top, right and bottom; -1 for both of a pair of sides that may be
            cut, and for all four where a corner is not seen;
        shifted: (P * 4 * 6, 3) float64 [m], of each of those corners, or any for -1, the location after a move along x,
            y, z of its frame, then back along x, y, z.
    """
    rows = np.flatnonzero(partners >= 0)
    sides, shifted = np.empty((len(rows), 4), np.int64), np.empty((len(rows) * 24, 3))
    for m in range(len(rows)):
        n = rows[m]
        _find_sides(pixels, n, boxes_xyxy[partners[n]], (width, height), border, sides, m)
        for side in range(4):
            for c in range(6):
                row = (m * 4 + side) * 6 + c
                for k in range(3):
                    shifted[row, k] = corners[n, max(sides[m, side], 0), k]
                shifted[row, c % 3] += step if c < 3 else -step
    return rows, sides, shifted


@inlined
def _add_slope(shifted, step, m, side, axis, rotation, axes, n, signs, weight, row):  # type: ignore[no-untyped-def]
    """Add to a row how a side moves with the middle of its box and its sizes, (6,), times a weight."""
    for c in range(3):
        along = weight * (shifted[m, side, c, axis] - shifted[m, side, c + 3, axis]) / (2.0 * step)
        for k in range(3):
            row[k] += along * rotation[c, k]
            row[k + 3] += along * axes[n, c, k] * signs[k] / 2.0


@inlined
def _update(states, covariances, n, row, residual, variance, gain):  # type: ignore[no-untyped-def]
    """One scalar update of a state and its covariance; `gain` is room for six numbers."""
    spread = variance
    for k in range(6):
        gain[k] = 0.0
        for i in range(6):
            gain[k] += covariances[n, k, i] * row[i]
        spread += row[k] * gain[k]
    for k in range(6):
        states[n, k] += gain[k] / spread * residual
    for k in range(6):
        for i in range(k, 6):
            changed = covariances[n, k, i] - gain[k] * gain[i] / spread
            covariances[n, k, i] = changed
            covariances[n, i, k] = changed


@inlined
def _deviation(box, number, sigmas, n):  # type: ignore[no-untyped-def]
    """Deviation of a number of the image: of the middle across or upright, or of the height [px]."""
    scale = box[2] - box[0] if number == 0 else box[3] - box[1]
    return sigmas[n, 2 * number] + sigmas[n, 2 * number + 1] * scale


@kernel(
    "void(float64[:,::1], float64[:,:,::1], Array(float64, 2, 'C', readonly=True), float64[:,:,::1], "
    "Array(float64, 2, 'C', readonly=True), float64[:,:,::1], int64[::1], int64[:,::1], float64[:,:,:,::1], float64, "
    "int64[::1], float64[:,::1], float64[:,::1], float64, float64)"
)
def update_by_sides(
    states: Float64Array, covariances: Float64Array, rotation: Float64Array, axes: Float64Array, signs: Float64Array,
    pixels: Float64Array, rows: Int64Array, sides: Int64Array, shifted: Float64Array, step: float, partners: Int64Array,
    boxes_xyxy: Float64Array, sigmas: Float64Array, farthest: float, least_share: float,
) -> None:  # fmt: skip
    """Update boxes by the middle of their partners in the image, and by the height of those.

    Each of the three numbers z = h(state) + noise is taken by itself, one after the other, with the slopes H of h where
    the box was before all of them. One that is too far from what was expected there is left out.

    Args:
        states: (N, 6 or more) [m]: middle x, y, z, length, width, height; changed.
        covariances: (N, 6, 6) [m²]; changed.
        rotation: (3, 3), from the frame of the middles into the camera's.
        axes: (N, 3, 3), whose columns are the boxes' axes in the camera's frame.
        signs: (8, 3), on which side of the middle each corner lies.
        pixels: (N, 8, 2) [px], of the corners.
        rows, sides: (P,) and (P, 4) of `shifted_sides`.
        shifted: (P, 4, 6, 2) [px], where its corners are in the image.
        step: [m].
        partners: (N,), of `shifted_sides`.
        boxes_xyxy: (M, 4) [px], boxes of the image.
        sigmas: (N, 6), deviations of the middle across: [px], and beside that as a share of the box's width; of the
            middle upright and of the height likewise, as shares of the height.
        farthest: a number farther off than so many deviations is left out.
        least_share: no size shrinks below this share of what it was.

    Source: Kalman 1960, "A New Approach to Linear Filtering and Prediction Problems"; one number after the other:
    Bierman 1977, "Factorization Methods for Discrete Sequential Estimation", ch. II.
    """
    slopes, residuals, taken = np.empty((3, 6)), np.empty(3), np.empty(3, np.bool_)
    gain, before, variances = np.empty(6), np.empty(6), np.empty(3)
    for m in range(len(rows)):
        n, box = rows[m], boxes_xyxy[partners[rows[m]]]
        for number in range(3):
            axis = 0 if number == 0 else 1
            first, last = sides[m, axis], sides[m, axis + 2]
            taken[number] = first >= 0
            if not taken[number]:
                continue
            of_low, of_high = (0.5, 0.5) if number < 2 else (-1.0, 1.0)
            slope = slopes[number]
            slope[:] = 0.0
            _add_slope(shifted, step, m, axis, axis, rotation, axes, n, signs[first], of_low, slope)
            _add_slope(shifted, step, m, axis + 2, axis, rotation, axes, n, signs[last], of_high, slope)
            residuals[number] = of_low * (box[axis] - pixels[n, first, axis])
            residuals[number] += of_high * (box[axis + 2] - pixels[n, last, axis])
            variances[number] = _deviation(box, number, sigmas, n) ** 2
            spread = variances[number]
            for k in range(6):
                for i in range(6):
                    spread += slope[k] * covariances[n, k, i] * slope[i]
            # false for a NaN, too
            taken[number] = residuals[number] * residuals[number] <= farthest * farthest * spread
        before[:] = states[n, :6]
        for number in range(3):
            if taken[number]:
                residual = residuals[number]
                for k in range(6):
                    residual -= slopes[number, k] * (states[n, k] - before[k])
                _update(states, covariances, n, slopes[number], residual, variances[number], gain)
        for k in range(3, 6):
            states[n, k] = max(states[n, k], least_share * before[k])
