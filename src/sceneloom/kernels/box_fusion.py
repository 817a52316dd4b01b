"""Short lists of detected boxes: which are valid, how far off they are, and their form for messages.

A sweep has some tens of boxes, for which a call of NumPy takes longer than all that it computes.
"""

import numpy as np
from numba import boolean, float32, float64, int64

from sceneloom.arrays import Float32Array, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import IN_F64_1D, IN_F64_2D, IN_F64_3D, IN_I64_1D, tuple_of

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


@kernel(tuple_of(float64[:, ::1], int64[::1])(IN_F64_2D, IN_F64_2D, IN_F64_1D))
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


@kernel(tuple_of(float64[:, ::1], int64[::1])(IN_F64_2D))
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


@kernel(tuple_of(float64[:, :, ::1], float64[::1])(float64[:, ::1], float64[::1], int64[::1], IN_F64_2D))
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
    tuple_of(
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
