"""A Kalman filter over many objects: their states moved on, and boxes read of them.

A state is x = (middle 3, size 3, heading, velocity 3, yaw rate).
"""

import numpy as np
from numba import njit

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel

SIZE, MEASURED = 11, 7
_YAW, _ROTATION = 6, 10


@njit(nogil=True, error_model="numpy", inline="always")
def _wrapped(angle):  # type: ignore[no-untyped-def]
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


@njit(nogil=True, error_model="numpy")
def _move(mean, slope, vehicle, seconds, rotation_time):  # type: ignore[no-untyped-def]
    """Move one state on in place, and write its slopes."""
    slope[:] = 0.0
    for k in range(SIZE):
        slope[k, k] = 1.0
    x, y, rate = mean[7], mean[8], mean[_ROTATION]
    angle = rate * seconds if vehicle else 0.0
    lever = seconds if vehicle else 0.0
    cosine, sine = np.cos(angle), np.sin(angle)
    rotated_x, rotated_y = cosine * x - sine * y, sine * x + cosine * y
    half = seconds / 2.0
    mean[0] += half * (x + rotated_x)
    mean[1] += half * (y + rotated_y)
    mean[2] += seconds * mean[9]
    mean[_YAW] = _wrapped(mean[_YAW] + rate * seconds)
    mean[7], mean[8] = rotated_x, rotated_y
    decay = np.exp(-seconds / rotation_time)
    mean[_ROTATION] = rate * decay
    slope[0, 7], slope[0, 8] = half * (1.0 + cosine), -half * sine
    slope[1, 7], slope[1, 8] = half * sine, half * (1.0 + cosine)
    slope[0, _ROTATION], slope[1, _ROTATION] = -half * lever * rotated_y, half * lever * rotated_x
    slope[2, 9] = seconds
    slope[_YAW, _ROTATION] = seconds
    slope[7, 7], slope[7, 8], slope[7, _ROTATION] = cosine, -sine, -lever * rotated_y
    slope[8, 7], slope[8, 8], slope[8, _ROTATION] = sine, cosine, lever * rotated_x
    slope[_ROTATION, _ROTATION] = decay


@njit(nogil=True, error_model="numpy")
def _shake(covariance, heading, seconds, variances):  # type: ignore[no-untyped-def]
    """Add to one covariance what white noise of accelerations does in so long."""
    along, across, climb, sizes = variances[0], variances[1], variances[2], variances[3]
    yaw, rotation_of_vector = variances[4], variances[5]
    cosine, sine = np.cos(heading), np.sin(heading)
    xx = along * cosine * cosine + across * sine * sine
    yy = along * sine * sine + across * cosine * cosine
    xy = (along - across) * cosine * sine
    cubed, squared = seconds**3 / 3.0, seconds**2 / 2.0
    for i, j, value in ((0, 0, xx), (0, 1, xy), (1, 0, xy), (1, 1, yy), (2, 2, climb)):
        covariance[i, j] += value * cubed
        covariance[i, 7 + j] += value * squared
        covariance[7 + i, j] += value * squared
        covariance[7 + i, 7 + j] += value * seconds
    for k in range(3, 6):
        covariance[k, k] += sizes * seconds
    covariance[_YAW, _YAW] += yaw * seconds + rotation_of_vector * cubed
    covariance[_YAW, _ROTATION] += rotation_of_vector * squared
    covariance[_ROTATION, _YAW] += rotation_of_vector * squared
    covariance[_ROTATION, _ROTATION] += rotation_of_vector * seconds


@kernel(
    "Tuple((float64[:,::1], float64[:,:,::1], float64[:,:,::1]))(float64[:,::1], float64[:,:,::1], boolean[::1], "
    "float64, float64, float64[:,::1])",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def predict(
    means: Float64Array,
    covariances: Float64Array,
    vehicles: BoolArray,
    seconds: float,
    rotation_time: float,
    variances: Float64Array,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Move states on, with the noise of so long.

    Args:
        means, covariances: (N, 11) and (N, 11, 11).
        vehicles: (N,), whether their velocity rotates with them.
        seconds: how long.
        rotation_time: after which rotates have died down [s].
        variances: (2, 6), of people and of vehicles: densities of the noise of acceleration along the heading, across
            it and upwards, of sizes, of the heading and of rotating.

    Returns:
        Means and covariances afterwards, and the slopes (N, 11, 11) of the means.
    """
    count = len(means)
    moved, spread = means.copy(), np.zeros((count, SIZE, SIZE))
    slopes, half = np.empty((count, SIZE, SIZE)), np.empty((SIZE, SIZE))
    for n in range(count):
        noise = variances[1 if vehicles[n] else 0]
        _move(moved[n], slopes[n], vehicles[n], seconds, rotation_time)
        half[:] = 0.0
        for i in range(SIZE):
            for k in range(SIZE):
                if slopes[n, i, k] != 0.0:
                    for j in range(SIZE):
                        half[i, j] += slopes[n, i, k] * covariances[n, k, j]
        for j in range(SIZE):
            for k in range(SIZE):
                if slopes[n, j, k] != 0.0:
                    for i in range(SIZE):
                        spread[n, i, j] += half[i, k] * slopes[n, j, k]
        _shake(spread[n], means[n, _YAW], seconds, noise)
    return moved, spread, slopes


@njit(nogil=True, error_model="numpy")
def _factored(matrix, root):  # type: ignore[no-untyped-def]
    """Write Cholesky's lower triangle of a matrix; False where it is not positive."""
    size = len(matrix)
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            if i > j:
                root[i, j] = total / root[j, j]
            elif total > 0.0:
                root[i, i] = np.sqrt(total)
            else:
                return False
    return True


@njit(nogil=True, error_model="numpy")
def _solve(root, vector):  # type: ignore[no-untyped-def]
    """Solve L Lᵀ x = v in place."""
    size = len(vector)
    for i in range(size):
        for k in range(i):
            vector[i] -= root[i, k] * vector[k]
        vector[i] /= root[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            vector[i] -= root[k, i] * vector[k]
        vector[i] /= root[i, i]


@njit(nogil=True, error_model="numpy")
def _weighed(covariance, noise, apart, root, spread, solved, freedom):  # type: ignore[no-untyped-def]
    """Factor the covariance of a box, wider for one that is far off; False where it is none."""
    wider = 1.0
    for attempt in range(2):
        for i in range(MEASURED):
            for j in range(MEASURED):
                spread[i, j] = covariance[i, j] + noise[i, j] * wider
        if not _factored(spread, root):
            return False
        if attempt == 0:
            solved[:] = apart
            _solve(root, solved)
            wider = (freedom + (apart * solved).sum()) / (freedom + MEASURED)
            if wider <= 1.0:
                break
    return True


@njit(nogil=True, error_model="numpy")
def _read(mean, covariance, apart, root, crossed, gain):  # type: ignore[no-untyped-def]
    """Kalman's update of one state, in place."""
    for i in range(SIZE):
        for j in range(MEASURED):
            crossed[i, j] = gain[i, j] = covariance[i, j]
        _solve(root, gain[i])
        for j in range(MEASURED):
            mean[i] += gain[i, j] * apart[j]
    for i in range(SIZE):
        for j in range(i + 1):
            for k in range(MEASURED):
                covariance[i, j] -= gain[i, k] * crossed[j, k]
            covariance[j, i] = covariance[i, j]
    mean[_YAW] = _wrapped(mean[_YAW])


@kernel(
    "void(float64[:,::1], float64[:,:,::1], int64[::1], float64[:,::1], float64[:,:,::1], int64[::1], float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def read_boxes(
    means: Float64Array,
    covariances: Float64Array,
    rows: Int64Array,
    measures: Float64Array,
    noises: Float64Array,
    columns: Int64Array,
    freedom: float,
) -> None:
    """Read a box of each of some states, in place.

    Headings that are off by more than a right angle are taken the other way round; boxes that are further off than
    their covariances state are taken for less sure, as under Student's distribution.

    Args:
        means, covariances: (N, 11) and (N, 11, 11), are changed.
        rows: (K,), which of them.
        measures, noises: (M, 7) and (M, 7, 7).
        columns: (K,), the box of each.
        freedom: degrees of freedom.
    """
    root, spread = np.zeros((MEASURED, MEASURED)), np.empty((MEASURED, MEASURED))
    apart, solved = np.empty(MEASURED), np.empty(MEASURED)
    crossed, gain = np.empty((SIZE, MEASURED)), np.empty((SIZE, MEASURED))
    for k in range(len(rows)):
        n, m = rows[k], columns[k]
        for i in range(MEASURED):
            apart[i] = measures[m, i] - means[n, i]
        rotation_of_vector = _wrapped(apart[_YAW])
        apart[_YAW] = rotation_of_vector - np.pi * np.round(rotation_of_vector / np.pi)
        if _weighed(covariances[n], noises[m], apart, root, spread, solved, freedom):
            _read(means[n], covariances[n], apart, root, crossed, gain)


@kernel(
    "void(float64[:,::1], float64[:,:,::1], boolean[::1], float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def read_no_slip(
    means: Float64Array, covariances: Float64Array, vehicles: BoolArray, variance: float
) -> None:
    """Read of vehicles that their velocity across their heading is 0, in place.

    Args:
        means, covariances: (N, 11) and (N, 11, 11), are changed.
        vehicles: (N,).
        variance: of that velocity [m²/s²].
    """
    spread = np.empty(SIZE)
    for n in range(len(means)):
        if not vehicles[n]:
            continue
        cosine, sine = np.cos(means[n, _YAW]), np.sin(means[n, _YAW])
        along = cosine * means[n, 7] + sine * means[n, 8]
        across = cosine * means[n, 8] - sine * means[n, 7]
        total = variance
        for i in range(SIZE):
            row = covariances[n, i]
            spread[i] = cosine * row[8] - sine * row[7] - along * row[_YAW]
        total += cosine * spread[8] - sine * spread[7] - along * spread[_YAW]
        for i in range(SIZE):
            means[n, i] -= spread[i] * across / total
            for j in range(SIZE):
                covariances[n, i, j] -= spread[i] * spread[j] / total
        means[n, _YAW] = _wrapped(means[n, _YAW])
