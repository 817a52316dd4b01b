"""Objects of detection fusion as the numbers of 32 bits that are told of them, and whether all of these can be told."""

import numpy as np
from numba import njit

from sceneloom.arrays import Float32Array, Float64Array, Int64Array, UInt32Array
from sceneloom.kernels.cache import kernel

_IN = tuple(f"Array(float64, {n}, 'C', readonly=True)" for n in (1, 2, 3))
_SIGNATURE = (
    "Tuple((float32[::1], float32[:,::1], float32[:,:,::1], float32[:,::1], float32[:,:,::1], float32[:,::1], "
    "float32[::1], float32[:,::1], uint32[:,::1], boolean))"
    f"({_IN[0]}, {_IN[1]}, {_IN[2]}, {_IN[1]}, {_IN[2]}, {_IN[0]}, {_IN[1]}, {_IN[1]}, "
    f"Array(int64, 1, 'C', readonly=True), {_IN[1]}, {_IN[0]})"
)

_F = Float32Array
Declared = tuple[_F, _F, _F, _F, _F, _F, _F, _F, UInt32Array, bool]
"""What `declare_objects` gives."""


@njit(nogil=True, error_model="numpy", inline="always")
def _turn(rotation, vector, turned):  # type: ignore[no-untyped-def]
    for i in range(3):
        turned[i] = rotation[i, 0] * vector[0] + rotation[i, 1] * vector[1] + rotation[i, 2] * vector[2]


@njit(nogil=True, error_model="numpy", inline="always")
def _whole(corners, n, limits, pixels):  # type: ignore[no-untyped-def]
    """Round a box outwards to whole pixels, cut at the picture; zeros where an edge is not finite."""
    finite = True
    for k in range(4):
        finite = finite and np.isfinite(corners[n, k])
    for k in range(4):
        edge = 0.0 if not finite else np.floor(corners[n, k]) if k < 2 else np.ceil(corners[n, k])
        pixels[n, k] = np.uint32(min(max(edge, 0.0), limits[k % 2]))


@njit(nogil=True, error_model="numpy", inline="always")
def _turn_covariance(rotation, covariance, half, whole):  # type: ignore[no-untyped-def]
    for i in range(3):
        _turn(rotation, covariance[i], half[i])
    for j in range(3):
        _turn(rotation, half[:, j], whole[:, j])


@njit(nogil=True, error_model="numpy", inline="always")
def _settle(covariance, settled):  # type: ignore[no-untyped-def]
    """Give the mean of a matrix and its transpose."""
    for i in range(3):
        for j in range(3):
            settled[i, j] = (covariance[i, j] + covariance[j, i]) / 2.0


@njit(nogil=True, error_model="numpy", inline="always")
def _makes_sense(n, seen, lengths, middle_covs, length_covs, headings, pixels):  # type: ignore[no-untyped-def]
    good = pixels[n, 0] <= pixels[n, 2] and pixels[n, 1] <= pixels[n, 3]
    for i in range(3):
        low = min(lengths[n, i], middle_covs[n, i, i], length_covs[n, i, i])
        good = good and low >= 0.0 and (lengths[n, i] > 0.0 or not seen)
    heads = headings[n, 0] != 0.0 or headings[n, 1] != 0.0 or headings[n, 2] != 0.0
    return good and (heads or not seen)


@njit(nogil=True, error_model="numpy", inline="always")
def _sum_of_sizes(values):  # type: ignore[no-untyped-def]
    """The sum of the absolute values, which is finite where all are, but for sums beyond all numbers."""
    total = 0.0
    for value in values.flat:
        total += abs(value)
    return total


@kernel(_SIGNATURE, nogil=True, cache=True, error_model="numpy")
def declare_objects(
    scores: Float64Array,
    centers: Float64Array,
    center_covs: Float64Array,
    sizes: Float64Array,
    size_covs: Float64Array,
    yaws: Float64Array,
    velocities: Float64Array,
    corners: Float64Array,
    rows_3d: Int64Array,
    turn: Float64Array,
    limits: Float64Array,
) -> Declared:
    """Take objects into declared axes, and round them.

    Args:
        scores: (N,), cut to 0 to 1.
        centers: (N, 3) [m].
        center_covs: (N, 3, 3) [m²]; the mean of each and its transpose counts.
        sizes: (N, 3) [m].
        size_covs: (N, 3, 3) [m²], as above.
        yaws: (N,) [rad].
        velocities: (N, 3) [m/s].
        corners: (N, 4) [px], left, upper, right and lower edge.
        rows_3d: (N,), 0 or more for what a lidar saw.
        turn: (3, 3), a signed permutation, takes coordinates into the declared axes.
        limits: (2,), width and height of the picture [px].

    Returns:
        Scores, middles and their covariances, sizes and theirs, directions (N, 3), speeds along them (N,), velocities,
        whole corners; and whether all are finite and make sense: no size or variance below 0, a size and a direction
        where a lidar saw it, no box inside out.
    """
    count = len(scores)
    confidence, speeds = np.empty(count, np.float32), np.empty(count, np.float32)
    middles, lengths = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    middle_covs, length_covs = np.empty((count, 3, 3), np.float32), np.empty((count, 3, 3), np.float32)
    headings, vectors = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    pixels = np.empty((count, 4), np.uint32)
    heading, half, whole = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    sound = True
    for n in range(count):
        confidence[n] = min(max(scores[n], 0.0), 1.0) if scores[n] == scores[n] else np.nan
        heading[0], heading[1], heading[2] = np.cos(yaws[n]), np.sin(yaws[n]), 0.0
        _turn(turn, centers[n], middles[n])
        _turn(turn, heading, headings[n])
        _turn(turn, velocities[n], vectors[n])
        speeds[n] = (
            velocities[n, 0] * heading[0] + velocities[n, 1] * heading[1] + velocities[n, 2] * heading[2]
        )
        _turn_covariance(turn, center_covs[n], half, whole)
        _settle(whole, middle_covs[n])
        _settle(size_covs[n], length_covs[n])
        lengths[n] = sizes[n]
        _whole(corners, n, limits, pixels)
        sound = sound and _makes_sense(
            n, rows_3d[n] >= 0, lengths, middle_covs, length_covs, headings, pixels
        )
    total = (
        _sum_of_sizes(confidence) + _sum_of_sizes(speeds) + _sum_of_sizes(middles) + _sum_of_sizes(lengths)
    )
    total += _sum_of_sizes(headings) + _sum_of_sizes(vectors)
    total += _sum_of_sizes(middle_covs) + _sum_of_sizes(length_covs)
    sound = sound and np.isfinite(total)
    return confidence, middles, middle_covs, lengths, length_covs, headings, speeds, vectors, pixels, sound
