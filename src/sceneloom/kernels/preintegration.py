"""What an IMU measured between two moments, summed up in the frame of the first: rotate, gain of speed.

And trajectory.
"""

import numpy as np
from numba import float64, int64, types

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.rotating import rotation_of_vector, times, times_cross, transposed_times
from sceneloom.kernels.surface_map import INNER

ROTATION, SPEED, TRAJECTORY = slice(0, 3), slice(3, 6), slice(6, 9)
"""Rows of what is summed up: rotation vector [rad], velocity [m/s], position [m]."""

_V, _M = float64[::1], float64[:, ::1]
_TIMES = types.Array(int64, 1, "C", readonly=True)
_READ_1D = types.Array(float64, 1, "C", readonly=True)
_READ_2D = types.Array(float64, 2, "C", readonly=True)


@kernel(types.void(_V, _V, float64, _V, _M), **INNER)
def _rotation_between(
    before: Float64Array, after: Float64Array, h: float, v: Float64Array, m: Float64Array
) -> None:
    """Write the rotation over h seconds in which the rate changes evenly. Source: Magnus 1954, second term."""
    c = h * h / 12.0
    v[0] = 0.5 * h * (before[0] + after[0]) + c * (before[1] * after[2] - before[2] * after[1])
    v[1] = 0.5 * h * (before[1] + after[1]) + c * (before[2] * after[0] - before[0] * after[2])
    v[2] = 0.5 * h * (before[2] + after[2]) + c * (before[0] * after[1] - before[1] * after[0])
    rotation_of_vector(v, m)


@kernel(types.void(_M, float64, _M, _M, _V, _V), **INNER)
def _step(
    readings: Float64Array,
    h: float,
    work: Float64Array,
    rotation: Float64Array,
    velocity: Float64Array,
    position: Float64Array,
) -> None:
    """Go on by h seconds in which rate and force change evenly: Simpson's rule over the rotating force.

    Args:
        readings: (4, 3) rate and force at the beginning, rate and force at the end, without biases.
        work: (14, 3): rows 0-2 the rotation of the first half, 3-5 of the whole, 6-8 the rotation at half-time, 9-11
            that at the end, 12 the mean force, 13 scratch; written here.
        rotation, velocity, position: changed in place.
    """
    half, whole, at_half, at_end = work[0:3], work[3:6], work[6:9], work[9:12]
    middle, v = work[12], work[13]
    for k in range(3):
        middle[k] = 0.5 * (readings[0, k] + readings[2, k])
    _rotation_between(readings[0], middle, 0.5 * h, v, half)
    _rotation_between(readings[0], readings[2], h, v, whole)
    times(rotation, half, at_half)
    times(rotation, whole, at_end)
    for k in range(3):
        middle[k] = 0.5 * (readings[1, k] + readings[3, k])
    for i in range(3):
        f0, f1, f2 = 0.0, 0.0, 0.0
        for k in range(3):
            f0 += rotation[i, k] * readings[1, k]
            f1 += at_half[i, k] * middle[k]
            f2 += at_end[i, k] * readings[3, k]
        position[i] += h * velocity[i] + h * h / 6.0 * (f0 + 2.0 * f1)
        velocity[i] += h / 6.0 * (f0 + 4.0 * f1 + f2)
    for i in range(3):
        for k in range(3):
            rotation[i, k] = at_end[i, k]


@kernel(types.void(_M, float64, _M, _M), **INNER)
def _carry_slopes(work: Float64Array, h: float, slopes: Float64Array, pull: Float64Array) -> None:
    """Carry the slopes by the biases, (9, 6), over one step; `pull` is written: how a rotation rotates the force.

    (3, 3).

    Source: Forster, Carlone, Dellaert and Scaramuzza 2017, "On-Manifold Preintegration for Real-Time Visual-Inertial
    Odometry", appendix B, with the force at half-time.
    """
    half, whole, at_half = work[0:3], work[3:6], work[6:9]
    by_rotation, rotated = np.empty((3, 3)), np.empty((3, 3))
    times_cross(at_half, work[12], pull)
    by_rotation[:] = slopes[0:3, 0:3]
    transposed_times(half, by_rotation, rotated)
    for i in range(3):
        rotated[i, i] -= 0.5 * h
    for i in range(3):
        for k in range(3):
            pulled = pull[i, 0] * rotated[0, k] + pull[i, 1] * rotated[1, k] + pull[i, 2] * rotated[2, k]
            slopes[6 + i, k] += h * slopes[3 + i, k] - 0.5 * h * h * pulled
            slopes[3 + i, k] -= h * pulled
            slopes[6 + i, 3 + k] += h * slopes[3 + i, 3 + k] - 0.5 * h * h * at_half[i, k]
            slopes[3 + i, 3 + k] -= h * at_half[i, k]
    transposed_times(whole, by_rotation, rotated)
    for i in range(3):
        for k in range(3):
            slopes[i, k] = rotated[i, k] - (h if i == k else 0.0)


@kernel(types.void(_M, float64, _M, _M, float64, float64), **INNER)
def _carry_covariance(
    work: Float64Array,
    h: float,
    pull: Float64Array,
    covariance: Float64Array,
    gyroscope: float,
    accelerometer: float,
) -> None:
    """Carry the covariance, (9, 9), over one step; noise densities in (rad/s)²/Hz and (m/s²)²/Hz.

    Source: Forster et al. 2017, appendix A, with noise that is white within a step, too.
    """
    half, whole = work[0:3], work[3:6]
    step, moved = np.eye(9), np.empty((9, 9))
    for i in range(3):
        for k in range(3):
            lever = pull[i, 0] * half[k, 0] + pull[i, 1] * half[k, 1] + pull[i, 2] * half[k, 2]
            step[i, k] = whole[k, i]
            step[3 + i, k] = -h * lever
            step[6 + i, k] = -0.5 * h * h * lever
        step[6 + i, 3 + i] = h
    for i in range(9):
        for k in range(9):
            total = 0.0
            for j in range(9):
                total += step[i, j] * covariance[j, k]
            moved[i, k] = total
    for i in range(9):
        for k in range(i + 1):
            total = 0.0
            for j in range(9):
                total += moved[i, j] * step[k, j]
            covariance[i, k] = total
            covariance[k, i] = total
    for i in range(3):
        covariance[i, i] += h * gyroscope
        covariance[3 + i, 3 + i] += h * accelerometer
        covariance[6 + i, 6 + i] += h * h * h / 3.0 * accelerometer
        covariance[3 + i, 6 + i] += h * h / 2.0 * accelerometer
        covariance[6 + i, 3 + i] += h * h / 2.0 * accelerometer


@kernel(types.void(_TIMES, _READ_2D, int64, int64, _READ_1D, _V, _V), **INNER)
def _reading_at(
    times_ns: Int64Array, samples: Float64Array, after: int, time_ns: int, bias: Float64Array,
    rate: Float64Array, force: Float64Array,
) -> None:  # fmt: skip
    """Write what the IMU reported at a time, without biases: between the samples before `after` and at it, evenly."""
    last = times_ns.shape[0] - 1
    one = min(max(after, 1), last)
    share = (time_ns - times_ns[one - 1]) / (times_ns[one] - times_ns[one - 1])
    share = min(max(share, 0.0), 1.0)
    for k in range(3):
        rate[k] = samples[one - 1, k] + share * (samples[one, k] - samples[one - 1, k]) - bias[k]
        force[k] = (
            samples[one - 1, 3 + k] + share * (samples[one, 3 + k] - samples[one - 1, 3 + k]) - bias[3 + k]
        )


@kernel(
    types.void(
        _TIMES, _READ_2D, _TIMES, _READ_2D, _READ_2D, float64[:, :, ::1], _M, _M, float64[:, :, ::1],
        float64[:, :, ::1],
    ),
    cache=True,
    nogil=True,
    error_model="numpy",
)  # fmt: skip
def preintegrate(
    times_ns: Int64Array,
    samples: Float64Array,
    knots_ns: Int64Array,
    biases: Float64Array,
    densities: Float64Array,
    rotations: Float64Array,
    velocities: Float64Array,
    positions: Float64Array,
    slopes: Float64Array,
    covariances: Float64Array,
) -> None:
    """Sum up what an IMU measured from each knot to the next.

    Args:
        times_ns: (N,) [ns], strictly increasing, N >= 2.
        samples: (N, 6) yaw rate [rad/s] and specific force [m/s²].
        knots_ns: (K,) [ns], strictly increasing; beyond the first and the last sample these hold.
        biases: (K - 1, 6) to take off, as the samples.
        densities: (K - 1, 2) white noise of the rate, (rad/s)²/Hz, and of the force, (m/s²)²/Hz.
        rotations: (K - 1, 3, 3), `first_from_second`, written here, as all further ones.
        velocities, positions: (K - 1, 3), gain of speed [m/s] and trajectory [m] without gravity and without the speed
            at the first knot, in the axes of the first knot.
        slopes: (K - 1, 9, 6) by the biases: of rotation (on the right side), velocity and position.
        covariances: (K - 1, 9, 9) of the same.
    """
    readings, work, pull = np.empty((4, 3)), np.empty((14, 3)), np.empty((3, 3))
    after = 0
    for i in range(knots_ns.shape[0] - 1):
        start, stop, bias = knots_ns[i], knots_ns[i + 1], biases[i]
        for j in range(3):
            for k in range(3):
                rotations[i, j, k] = 1.0 if j == k else 0.0
        velocities[i, :] = 0.0
        positions[i, :] = 0.0
        slopes[i, :, :] = 0.0
        covariances[i, :, :] = 0.0
        while after < times_ns.shape[0] and times_ns[after] <= start:
            after += 1
        _reading_at(times_ns, samples, after, start, bias, readings[0], readings[1])
        now = start
        while now < stop:
            here = stop if after >= times_ns.shape[0] else min(stop, times_ns[after])
            _reading_at(times_ns, samples, after, here, bias, readings[2], readings[3])
            h = (here - now) * 1e-9
            _step(readings, h, work, rotations[i], velocities[i], positions[i])
            _carry_slopes(work, h, slopes[i], pull)
            _carry_covariance(work, h, pull, covariances[i], densities[i, 0], densities[i, 1])
            for k in range(3):
                readings[0, k], readings[1, k] = readings[2, k], readings[3, k]
            now = here
            if after < times_ns.shape[0] and times_ns[after] <= now:
                after += 1


@kernel(
    types.void(
        _TIMES, _READ_2D, _TIMES, _READ_2D, _TIMES, _TIMES, float64[:, :, ::1], _M, _M, float64[:, :, ::1]
    ),
    cache=True,
    nogil=True,
    error_model="numpy",
)  # fmt: skip
def preintegrate_until(
    times_ns: Int64Array,
    samples: Float64Array,
    knots_ns: Int64Array,
    biases: Float64Array,
    wanted_ns: Int64Array,
    knots: Int64Array,
    rotations: Float64Array,
    velocities: Float64Array,
    positions: Float64Array,
    slopes: Float64Array,
) -> None:
    """Sum up what an IMU measured from knots to moments between them and the next.

    Args:
        times_ns, samples, knots_ns, biases: as in `preintegrate`.
        wanted_ns: (W,) [ns], ascending.
        knots: (W,) the last knot at or before each, at most K - 2.
        rotations, velocities, positions: (W, 3, 3) and (W, 3), written here as in `preintegrate`.
        slopes: (W, 9, 6) by the biases, written here as there; (0, 9, 6) where they are not wanted.
    """
    readings, work, pull = np.empty((4, 3)), np.empty((14, 3)), np.empty((3, 3))
    slope, sloping = np.zeros((9, 6)), slopes.shape[0] > 0
    rotation, velocity, position = np.empty((3, 3)), np.empty(3), np.empty(3)
    after, now, knot = 0, int64(0), int64(-1)
    for w in range(wanted_ns.shape[0]):
        if knots[w] != knot:
            knot = knots[w]
            now = knots_ns[knot]
            rotation[:] = np.eye(3)
            velocity[:] = 0.0
            position[:] = 0.0
            slope[:, :] = 0.0
            while after < times_ns.shape[0] and times_ns[after] <= now:
                after += 1
            while after > 0 and times_ns[after - 1] > now:
                after -= 1
            _reading_at(times_ns, samples, after, now, biases[knot], readings[0], readings[1])
        while now < wanted_ns[w]:
            here = wanted_ns[w] if after >= times_ns.shape[0] else min(wanted_ns[w], times_ns[after])
            _reading_at(times_ns, samples, after, here, biases[knot], readings[2], readings[3])
            h = (here - now) * 1e-9
            _step(readings, h, work, rotation, velocity, position)
            if sloping:
                _carry_slopes(work, h, slope, pull)
            for k in range(3):
                readings[0, k], readings[1, k] = readings[2, k], readings[3, k]
            now = here
            if after < times_ns.shape[0] and times_ns[after] <= now:
                after += 1
        rotations[w], velocities[w], positions[w] = rotation, velocity, position
        if sloping:
            slopes[w] = slope
