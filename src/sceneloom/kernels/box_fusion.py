"""Detection fusion of short lists of boxes: as images see them, how far off they are, and their update by an image.

A sweep has some tens of boxes, for which a call of NumPy takes longer than all that it computes.
"""

from typing import Any

import numpy as np
from numba import boolean, float32, float64, int64, types

from sceneloom.arrays import Float32Array, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import IN_F64_1D, IN_F64_2D, IN_F64_3D, IN_I64_1D, inlined, part

LOW, HIGH, BASE = 0, 1, 2
"""The first columns of the table of box noise: how low and how high scores count, as logarithms of odds, and the
logarithms of the deviations of x, y, z along the axes of the box, length, width, height [m] and heading [rad], at score
0 and `USUAL`."""

BY_SCORE, BY_RANGE = BASE + 7, BASE + 14
"""How much those grow with the score, and with the logarithm of the range, seven columns each."""

AGREED = BASE + 21
"""By how much the covariances of middle and size of a box with a partner in the image are multiplied."""

IMAGE = AGREED + 2
"""Deviations of the partner in the image: of its middle across, of its middle upright and of its height, in pixels
and beside that as a share of its own size there, six columns."""

COLUMNS = IMAGE + 6

USUAL = 20.0
"""The range at which `BASE` holds [m]."""

NEAREST = 5.0
"""What is nearer counts as so far away [m]."""


def _tuple(*kinds: Any) -> Any:
    return types.Tuple(kinds)  # type: ignore[no-untyped-call]


@kernel(_tuple(float64[:, ::1], int64[::1])(IN_F64_2D, IN_F64_2D, IN_F64_1D))
def boxes_with_position(
    centers: Float64Array, sizes: Float64Array, yaws: Float64Array
) -> tuple[Float64Array, Int64Array]:
    """Those of N boxes in space that have finite numbers, and sizes above 0.

    Returns:
        (M, 7) float64, middle, size [m] and heading [rad] of those, and (M,) int64, which they are.
    """
    boxes, rows, count = np.empty((len(yaws), 7)), np.empty(len(yaws), np.int64), 0
    for n in range(len(yaws)):
        sound = np.isfinite(yaws[n])
        for k in range(3):
            sound = sound and np.isfinite(centers[n, k]) and np.isfinite(sizes[n, k]) and sizes[n, k] > 0.0
            boxes[count, k], boxes[count, 3 + k] = centers[n, k], sizes[n, k]
        boxes[count, 6], rows[count] = yaws[n], n
        count += sound
    return boxes[:count], rows[:count]


@kernel(_tuple(float64[:, ::1], int64[::1])(IN_F64_2D))
def boxes_with_area(corners: Float64Array) -> tuple[Float64Array, Int64Array]:
    """Those of (N, 4) boxes in an image [px] that have finite edges, right and lower ones beyond left and upper ones.

    Returns:
        (M, 4) float64 [px], their edges, and (M,) int64, which they are.
    """
    boxes, rows, count = np.empty((len(corners), 4)), np.empty(len(corners), np.int64), 0
    for n in range(len(corners)):
        sound = corners[n, 2] > corners[n, 0] and corners[n, 3] > corners[n, 1]
        for k in range(4):
            sound = sound and np.isfinite(corners[n, k])
            boxes[count, k] = corners[n, k]
        rows[count] = n
        count += sound
    return boxes[:count], rows[:count]


@kernel(
    _tuple(float64[:, :, ::1], float64[:, :, ::1], float64[::1], float64[::1])(
        IN_F64_2D, IN_F64_1D, IN_F64_2D, IN_F64_2D
    )
)
def boxes_from_eye(
    rotation: Float64Array, translation: Float64Array, signs: Float64Array, boxes: Float64Array
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Take upright boxes into the frame of an eye.

    Args:
        rotation, translation: (3, 3) and (3,) [m], into that frame.
        signs: (8, 3), on which side of the middle each corner lies.
        boxes: (N, 7), middle, size [m] and heading [rad].

    Returns:
        (N, 3, 3), whose columns are the axes of the boxes; (N, 8, 3) [m], their corners; (N,) [m], how far their
        middles are from the eye, and (N,) [m], how far they themselves.
    """
    count = len(boxes)
    axes, corners, distances, gaps = np.empty((count, 3, 3)), np.empty((count, 8, 3)), np.empty(count), np.empty(count)
    middle = np.empty(3)
    for n in range(count):
        cosine, sine, distance, gap = np.cos(boxes[n, 6]), np.sin(boxes[n, 6]), 0.0, 0.0
        for k in range(3):
            axes[n, k, 0] = rotation[k, 0] * cosine + rotation[k, 1] * sine
            axes[n, k, 1] = rotation[k, 1] * cosine - rotation[k, 0] * sine
            axes[n, k, 2] = rotation[k, 2]
            middle[k] = translation[k]
            for i in range(3):
                middle[k] += rotation[k, i] * boxes[n, i]
            distance += middle[k] * middle[k]
        for k in range(3):
            along = axes[n, 0, k] * middle[0] + axes[n, 1, k] * middle[1] + axes[n, 2, k] * middle[2]
            gap += max(abs(along) - boxes[n, 3 + k] / 2.0, 0.0) ** 2
        for c in range(8):
            for k in range(3):
                corners[n, c, k] = middle[k]
                for i in range(3):
                    corners[n, c, k] += signs[c, i] * boxes[n, 3 + i] / 2.0 * axes[n, k, i]
        distances[n], gaps[n] = np.sqrt(distance), np.sqrt(gap)
    return axes, corners, distances, gaps


@kernel(_tuple(int64[::1], int64[::1], int64[::1], int64[::1])(float64[:, ::1]))
def pair_uncontested(gains: Float64Array) -> tuple[Int64Array, Int64Array, Int64Array, Int64Array]:
    """Pair rows of (N, M) gains with columns that gain with no other row, nor the rows with another column.

    Returns:
        (N,) int64, the column of each row, and (M,) int64, the row of each column; -1 for none; and the rows and the
        columns, rising, that gain something, too, and are not paired.
    """
    partners, others = np.full(gains.shape[0], -1, np.int64), np.full(gains.shape[1], -1, np.int64)
    of_rows, of_columns = np.zeros(gains.shape[0], np.int64), np.zeros(gains.shape[1], np.int64)
    for i in range(gains.shape[0]):
        for j in range(gains.shape[1]):
            if gains[i, j] > 0.0:
                of_rows[i] += 1
                of_columns[j] += 1
                partners[i], others[j] = j, i
    for i in range(gains.shape[0]):
        if of_rows[i] != 1 or of_columns[partners[i]] != 1:
            partners[i] = -1
    for j in range(gains.shape[1]):
        if of_columns[j] != 1 or of_rows[others[j]] != 1:
            others[j] = -1
    return (
        partners,
        others,
        np.flatnonzero((partners < 0) & (of_rows > 0)),
        np.flatnonzero((others < 0) & (of_columns > 0)),
    )


@kernel(_tuple(float64[:, :, ::1], float64[::1])(float64[:, ::1], float64[::1], int64[::1], IN_F64_2D))
def usual_covariances(
    boxes: Float64Array, scores: Float64Array, kinds: Int64Array, table: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """The covariances of middles and sizes of boxes by the table of box noise, and the variances of headings.

    Args:
        boxes: (N, 7), middle, size [m] and heading [rad], in the frame of the sensor.
        scores: (N,), logarithms of odds as the detector reports them; one that is no number is as uncertain as the
            lowest.
        kinds, table: (N,) rows of the table, and the (K, COLUMNS) table.

    Returns:
        (N, 6, 6) [m²]: middle in the frame of the boxes, then length, width, height; and (N,) [rad²].
    """
    covariances, of_yaws, variances = np.zeros((len(boxes), 6, 6)), np.empty(len(boxes)), np.empty(7)
    for n in range(len(boxes)):
        numbers, score = table[kinds[n]], scores[n]
        held = min(max(score, numbers[LOW]), numbers[HIGH]) if not np.isnan(score) else numbers[LOW]
        distance = np.sqrt(boxes[n, 0] ** 2 + boxes[n, 1] ** 2 + boxes[n, 2] ** 2)
        far = np.log(max(distance, NEAREST) / USUAL)
        for k in range(7):
            variances[k] = np.exp(numbers[BASE + k] + numbers[BY_SCORE + k] * held + numbers[BY_RANGE + k] * far) ** 2
        along, across, of_yaws[n] = variances[0], variances[1], variances[6]
        cosine, sine = np.cos(boxes[n, 6]), np.sin(boxes[n, 6])
        covariances[n, 0, 0] = along * cosine * cosine + across * sine * sine
        covariances[n, 1, 1] = along * sine * sine + across * cosine * cosine
        covariances[n, 0, 1] = covariances[n, 1, 0] = (along - across) * cosine * sine
        for k in range(2, 6):
            covariances[n, k, k] = variances[k]
    return covariances, of_yaws


@kernel(
    _tuple(int64[::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1], float64[:, :, ::1], float64[::1])(
        float64[:, ::1],
        float64[:, :, ::1],
        int64[::1],
        IN_F64_2D,
        IN_F64_2D,
        IN_F64_1D,
        float64,
        float64,
        float64,
        float64,
        float64,
    )
)
def positions_by_height(
    boxes_xyxy: Float64Array, rays: Float64Array, rows: Int64Array, sizes: Float64Array, rotation: Float64Array,
    translation: Float64Array, image_height: float, border: float, edge_share: float, edge_px: float, cut_sigma: float,
) -> tuple[Int64Array, Float64Array, Float64Array, Float64Array, Float64Array, Float64Array]:  # fmt: skip
    """Estimate where objects are by how high and wide an image shows them.

    Args:
        boxes_xyxy: (M, 4) [px].
        rays: (L, 5, 3), unit, of the middle of each box that is asked for, of its top, bottom, left and right; NaN
            where the camera model has none.
        rows: (L,), which boxes these are.
        sizes: (M, 6) [m], usual length, width and height of their classes, and the deviations of those.
        rotation, translation: camera from lidar, (3, 3) and (3,) [m].
        image_height: [px]; `border` [px], what comes so near to it may be cut.
        edge_share, edge_px: deviation of an edge, as a share of its side, plus so many pixels.
        cut_sigma: deviation of the distance of what may be cut at top or bottom, as a share of it.

    Returns:
        (P,) int64, boxes along which the camera model has rays; (P, 3) [m], positions in the lidar frame, (P, 3, 3)
        [m²], their covariances; (P, 3) [m] sizes, (P, 3, 3) [m²] of them, and (P,) [m], distances from the camera.
    """
    most = len(rows)
    kept, centers, spreads = np.empty(most, np.int64), np.empty((most, 3)), np.empty((most, 3, 3))
    own, of_sizes, ranges = np.empty((most, 3)), np.zeros((most, 3, 3)), np.empty(most)
    angles, ray, count = np.empty(2), np.empty(3), 0
    for m in range(most):
        box, size, five = boxes_xyxy[rows[m]], sizes[rows[m]], rays[m]
        for pair in range(2):
            chord = 0.0
            for k in range(3):
                chord += (five[1 + 2 * pair, k] - five[2 + 2 * pair, k]) ** 2
            angles[pair] = 2.0 * np.arcsin(min(np.sqrt(chord) / 2.0, 1.0)) if np.isfinite(chord) else 0.0
        if not (np.isfinite(five).all() and angles[0] > 0.0):
            continue
        distance = size[2] / (2.0 * np.tan(min(angles[0], 3.0) / 2.0)) + size[1] / 2.0
        # variances along the ray and across, as shares of the distance squared
        upright = (edge_share + edge_px / (box[3] - box[1])) ** 2
        sideways = (edge_share + edge_px / (box[2] - box[0])) ** 2
        along = (size[5] / size[2]) ** 2 + 2.0 * upright
        if box[1] < border or box[3] > image_height - border:
            along += cut_sigma**2
        across = max(sideways * angles[1] ** 2, upright * angles[0] ** 2)
        for k in range(3):
            ray[k] = five[0, 0] * rotation[0, k] + five[0, 1] * rotation[1, k] + five[0, 2] * rotation[2, k]
            eye = translation[0] * rotation[0, k] + translation[1] * rotation[1, k] + translation[2] * rotation[2, k]
            centers[count, k] = distance * ray[k] - eye
            own[count, k], of_sizes[count, k, k] = size[k], size[3 + k] ** 2
        for k in range(3):
            for i in range(3):
                spreads[count, k, i] = distance**2 * (along - across) * (ray[k] * ray[i])
            spreads[count, k, k] += distance**2 * across
        kept[count], ranges[count] = rows[m], distance
        count += 1
    return kept[:count], centers[:count], spreads[:count], own[:count], of_sizes[:count], ranges[:count]


@kernel(
    _tuple(
        *(float32[::1], float32[:, ::1], float32[:, :, ::1], float32[:, ::1], float32[:, :, ::1]),
        *(float32[:, ::1], float32[::1], float32[:, ::1], boolean),
    )(*(IN_F64_1D, IN_F64_2D, IN_F64_3D, IN_F64_2D, IN_F64_3D, IN_F64_1D, IN_F64_2D, IN_I64_1D, IN_F64_2D))
)
def single_precision(
    scores: Float64Array, centers: Float64Array, center_covariances: Float64Array, sizes: Float64Array,
    size_covariances: Float64Array, yaws: Float64Array, velocities: Float64Array, rows_3d: Int64Array,
    rotation: Float64Array,
) -> tuple[
    Float32Array, Float32Array, Float32Array, Float32Array, Float32Array, Float32Array, Float32Array, Float32Array, bool
]:  # fmt: skip
    """Round fused objects to single precision, in other axes.

    Args:
        scores: (N,), cut to 0 to 1.
        centers, center_covariances: (N, 3) [m] and (N, 3, 3) [m²], which become symmetric.
        sizes, size_covariances: (N, 3) [m] and (N, 3, 3) [m²].
        yaws: (N,) [rad].
        velocities: (N, 3) [m/s].
        rows_3d: (N,), the box of the sweep that each is, below 0 for none.
        rotation: (3, 3), into the other axes.

    Returns:
        scores, positions, their covariances, sizes, their covariances, (N, 3) unit vectors along the headings, (N,)
        speeds along them [m/s] and (N, 3) velocities, all float32; and whether all are finite, no size or variance is
        below 0, and objects of the sweep have a size.
    """
    count, sound = len(scores), True
    shares, speeds = np.empty(count, np.float32), np.empty(count, np.float32)
    places, lengths = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    headings, motions = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    of_places, of_lengths = np.empty((count, 3, 3), np.float32), np.empty((count, 3, 3), np.float32)
    turned = np.empty((3, 3))
    for n in range(count):
        score, cosine, sine = scores[n], np.cos(yaws[n]), np.sin(yaws[n])
        shares[n] = min(max(score, 0.0), 1.0) if not np.isnan(score) else score
        speeds[n] = velocities[n, 0] * cosine + velocities[n, 1] * sine + velocities[n, 2] * 0.0
        sound = sound and np.isfinite(shares[n]) and np.isfinite(speeds[n])
        for k in range(3):
            place, motion = 0.0, 0.0
            for i in range(3):
                place += centers[n, i] * rotation[k, i]
                motion += velocities[n, i] * rotation[k, i]
                turned[k, i] = 0.0
                for j in range(3):
                    turned[k, i] += rotation[k, j] * center_covariances[n, j, i]
            places[n, k], motions[n, k], lengths[n, k] = place, motion, sizes[n, k]
            headings[n, k] = cosine * rotation[k, 0] + sine * rotation[k, 1]
            sound = sound and np.isfinite(places[n, k]) and np.isfinite(motions[n, k]) and np.isfinite(headings[n, k])
            sound = sound and np.isfinite(lengths[n, k]) and lengths[n, k] >= 0.0
            sound = sound and (lengths[n, k] > 0.0 or rows_3d[n] < 0)
        for k in range(3):
            for i in range(3):
                one, other = 0.0, 0.0
                for j in range(3):
                    one += turned[k, j] * rotation[i, j]
                    other += turned[i, j] * rotation[k, j]
                of_places[n, k, i] = (one + other) / 2.0
                of_lengths[n, k, i] = (size_covariances[n, k, i] + size_covariances[n, i, k]) / 2.0
                sound = sound and np.isfinite(of_places[n, k, i]) and np.isfinite(of_lengths[n, k, i])
            sound = sound and of_places[n, k, k] >= 0.0 and of_lengths[n, k, k] >= 0.0
    return shares, places, of_places, lengths, of_lengths, headings, speeds, motions, sound


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
        for k in range(6):
            before[k] = states[n, k]
        for number in range(3):
            if taken[number]:
                residual = residuals[number]
                for k in range(6):
                    residual -= slopes[number, k] * (states[n, k] - before[k])
                _update(states, covariances, n, slopes[number], residual, variances[number], gain)
        for k in range(3, 6):
            states[n, k] = max(states[n, k], least_share * before[k])
