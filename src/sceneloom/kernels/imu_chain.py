"""Kernels of the GNSS/IMU smoother: IMU preintegration, and normal equations of a chain of motion states.

The equations are solved in linear time. A state is a small rotation about the body's axes, then position and velocity
along the world's axes, bias of the gyroscope, bias of the accelerometer: 15 numbers.
"""

import math

import numpy as np
from numba import boolean, float64, int64, types

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.poses import rotation_of_vector
from sceneloom.kernels.signatures import IN_F64_1D, IN_F64_2D, IN_F64_3D, IN_I64_1D

SIZE = 15
ROTATION, POSITION, VELOCITY, GYROSCOPE, ACCELEROMETER = (slice(k, k + 3) for k in range(0, SIZE, 3))
"""Rows of a state."""

DELTA_ROTATION, DELTA_POSITION = slice(0, 3), slice(6, 9)
"""Rows of what is preintegrated: rotation vector [rad], velocity [m/s], position [m]."""

_V, _M, _T = float64[::1], float64[:, ::1], float64[:, :, ::1]


@kernel(types.void(_V, _V, float64, _V, _M))
def _rotation_between(before: Float64Array, after: Float64Array, h: float, v: Float64Array, m: Float64Array) -> None:
    """Write the rotation over h seconds in which the rate changes linearly. Source: Magnus 1954, second term."""
    c = h * h / 12.0
    v[0] = 0.5 * h * (before[0] + after[0]) + c * (before[1] * after[2] - before[2] * after[1])
    v[1] = 0.5 * h * (before[1] + after[1]) + c * (before[2] * after[0] - before[0] * after[2])
    v[2] = 0.5 * h * (before[2] + after[2]) + c * (before[0] * after[1] - before[1] * after[0])
    rotation_of_vector(v, m)


@kernel(types.void(_M, float64, _M, _M, _V, _V))
def _step(
    readings: Float64Array, h: float, work: Float64Array, rotation: Float64Array, velocity: Float64Array,
    position: Float64Array,
) -> None:  # fmt: skip
    """Go on by h seconds in which rate and force change linearly: Simpson's rule over the rotating force.

    `readings` (4, 3) rate and force at the beginning, rate and force at the end, without biases; `work` (14, 3): rows
    0-2 the rotation of the first half, 3-5 of the whole, 6-8 the rotation at half-time, 9-11 that at the end, 12 the
    mean force, 13 scratch; written here; `rotation`, `velocity`, `position`: changed in place.
    """
    half, whole, at_half, at_end = work[0:3], work[3:6], work[6:9], work[9:12]
    middle, v = work[12], work[13]
    for k in range(3):
        middle[k] = 0.5 * (readings[0, k] + readings[2, k])
    _rotation_between(readings[0], middle, 0.5 * h, v, half)
    _rotation_between(readings[0], readings[2], h, v, whole)
    _times(rotation, half, at_half)
    _times(rotation, whole, at_end)
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


@kernel(types.void(_M, float64, _M, _M))
def _carry_slopes(work: Float64Array, h: float, slopes: Float64Array, pull: Float64Array) -> None:
    """Carry the slopes by the biases, (9, 6), over one step; write `pull`, (3, 3): the force's slope by a rotation.

    Source: Forster, Carlone, Dellaert and Scaramuzza 2017, "On-Manifold Preintegration for Real-Time Visual-Inertial
    Odometry", appendix B, with the force at half-time.
    """
    half, whole, at_half = work[0:3], work[3:6], work[6:9]
    by_rotation, rotated = np.empty((3, 3)), np.empty((3, 3))
    _times_cross(at_half, work[12], pull)
    by_rotation[:] = slopes[0:3, 0:3]
    _transposed_times(half, by_rotation, rotated)
    for i in range(3):
        rotated[i, i] -= 0.5 * h
    for i in range(3):
        for k in range(3):
            pulled = pull[i, 0] * rotated[0, k] + pull[i, 1] * rotated[1, k] + pull[i, 2] * rotated[2, k]
            slopes[6 + i, k] += h * slopes[3 + i, k] - 0.5 * h * h * pulled
            slopes[3 + i, k] -= h * pulled
            slopes[6 + i, 3 + k] += h * slopes[3 + i, 3 + k] - 0.5 * h * h * at_half[i, k]
            slopes[3 + i, 3 + k] -= h * at_half[i, k]
    _transposed_times(whole, by_rotation, rotated)
    for i in range(3):
        for k in range(3):
            slopes[i, k] = rotated[i, k] - (h if i == k else 0.0)


@kernel(types.void(_M, float64, _M, _M, float64, float64))
def _carry_covariance(
    work: Float64Array, h: float, pull: Float64Array, covariance: Float64Array, gyroscope: float, accelerometer: float
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


@kernel(types.void(IN_I64_1D, IN_F64_2D, int64, int64, IN_F64_1D, _V, _V))
def _reading_at(
    times_ns: Int64Array, samples: Float64Array, after: int, time_ns: int, bias: Float64Array,
    rate: Float64Array, force: Float64Array,
) -> None:  # fmt: skip
    """Write the IMU's values at a time, without biases: linearly between the samples before `after` and at it."""
    last = times_ns.shape[0] - 1
    one = min(max(after, 1), last)
    share = (time_ns - times_ns[one - 1]) / (times_ns[one] - times_ns[one - 1])
    share = min(max(share, 0.0), 1.0)
    for k in range(3):
        rate[k] = samples[one - 1, k] + share * (samples[one, k] - samples[one - 1, k]) - bias[k]
        force[k] = samples[one - 1, 3 + k] + share * (samples[one, 3 + k] - samples[one - 1, 3 + k]) - bias[3 + k]


@kernel(types.void(IN_I64_1D, IN_F64_2D, IN_I64_1D, IN_F64_2D, IN_F64_2D, IN_I64_1D, IN_I64_1D, _T, _M, _M, _T, _T))
def preintegrate(
    times_ns: Int64Array, samples: Float64Array, knots_ns: Int64Array, biases: Float64Array, densities: Float64Array,
    wanted_ns: Int64Array, knots: Int64Array, rotations: Float64Array, velocities: Float64Array,
    positions: Float64Array, slopes: Float64Array, covariances: Float64Array,
) -> None:  # fmt: skip
    """Preintegrate IMU samples from knots to times between them and the next.

    Args:
        times_ns: (N,) [ns], strictly increasing, N >= 2.
        samples: (N, 6) angular velocity [rad/s] and specific force [m/s²].
        knots_ns: (K,) [ns], strictly increasing; beyond the first and the last sample these hold.
        biases: (K - 1, 6) to subtract from the samples.
        densities: (K - 1, 2) white noise of the rate, (rad/s)²/Hz, and of the force, (m/s²)²/Hz.
        wanted_ns: (W,) [ns], ascending.
        knots: (W,) the last knot before each, at most K - 2.
        rotations: (W, 3, 3), `first_from_second`, written here, as all further ones.
        velocities, positions: (W, 3), gain of velocity [m/s] and distance [m] without gravity and without the velocity
            at the knot, in the body axes there.
        slopes: (W, 9, 6) by the biases: of rotation (on the right side), velocity and position; (0, 9, 6) for none.
        covariances: (W, 9, 9) of the same; (0, 9, 9) for none.
    """
    readings, work, pull = np.empty((4, 3)), np.empty((14, 3)), np.empty((3, 3))
    slope, sloping = np.zeros((9, 6)), slopes.shape[0] > 0
    covariance, spreading = np.zeros((9, 9)), covariances.shape[0] > 0
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
            covariance[:, :] = 0.0
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
            if spreading:
                _carry_covariance(work, h, pull, covariance, densities[knot, 0], densities[knot, 1])
            for k in range(3):
                readings[0, k], readings[1, k] = readings[2, k], readings[3, k]
            now = here
            if after < times_ns.shape[0] and times_ns[after] <= now:
                after += 1
        rotations[w], velocities[w], positions[w] = rotation, velocity, position
        if sloping:
            slopes[w] = slope
        if spreading:
            covariances[w] = covariance


@kernel(types.void(_M, _M, IN_F64_2D, _V, _T, _T, _M, int64))
def _add_pair(
    first: Float64Array, second: Float64Array, information: Float64Array, residual: Float64Array,
    blocks: Float64Array, couplings: Float64Array, right: Float64Array, i: int,
) -> None:  # fmt: skip
    """Add a measurement between states i and i + 1: slopes (m, 15) each, information (m, m), residual (m,)."""
    m, n = first.shape
    weighted_first, weighted_second, weighted = np.zeros((m, n)), np.zeros((m, n)), np.zeros(m)
    for a in range(m):
        for b in range(m):
            w = information[a, b]
            if w == 0.0:
                continue
            weighted[a] += w * residual[b]
            for c in range(n):
                weighted_first[a, c] += w * first[b, c]
                weighted_second[a, c] += w * second[b, c]
    for a in range(m):
        for r in range(n):
            one, other = first[a, r], second[a, r]
            if one != 0.0:
                right[i, r] -= one * weighted[a]
                for c in range(n):
                    blocks[i, r, c] += one * weighted_first[a, c]
                    couplings[i, r, c] += one * weighted_second[a, c]
            if other != 0.0:
                right[i + 1, r] -= other * weighted[a]
                for c in range(n):
                    blocks[i + 1, r, c] += other * weighted_second[a, c]


@kernel(types.void(IN_F64_2D, IN_F64_2D, IN_F64_2D, IN_F64_2D, IN_F64_1D, _V, _M, _M))
def _rotation_residual(
    rotation: Float64Array, after: Float64Array, measured: Float64Array, slope: Float64Array, change: Float64Array,
    residual: Float64Array, first: Float64Array, second: Float64Array,
) -> None:  # fmt: skip
    """Write rows 0-2: Log((measured Exp(slope · change))ᵀ Rᵀ R'), and its slopes by the two rotations and the bias.

    Source: Forster et al. 2017, eq. 37 and appendix C.
    """
    small, correction, expected = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    relative, rest, work = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    inverse, forward = np.empty((3, 3)), np.empty((3, 3))
    for k in range(3):
        small[k] = slope[k, 0] * change[0] + slope[k, 1] * change[1] + slope[k, 2] * change[2]
    rotation_of_vector(small, correction)
    expected[:] = measured
    _times(expected, correction, work)
    expected[:] = work
    for a in range(3):
        for b in range(3):
            relative[a, b] = rotation[0, a] * after[0, b] + rotation[1, a] * after[1, b] + rotation[2, a] * after[2, b]
    _transposed_times(expected, relative, rest)
    _rotation_vector(rest, residual)
    _right_slope(residual[0:3], -1.0, inverse)
    _right_slope(small, 1.0, forward)
    for a in range(3):
        for b in range(3):
            first[a, b] = -(
                inverse[a, 0] * relative[b, 0] + inverse[a, 1] * relative[b, 1] + inverse[a, 2] * relative[b, 2]
            )
            second[a, b] = inverse[a, b]
    # by the gyroscope's bias: -J⁻¹ restᵀ J(small) slope
    for a in range(3):
        for b in range(3):
            work[a, b] = inverse[a, 0] * rest[b, 0] + inverse[a, 1] * rest[b, 1] + inverse[a, 2] * rest[b, 2]
    _times(work, forward, correction)
    for a in range(3):
        for b in range(3):
            first[a, 9 + b] = -(
                correction[a, 0] * slope[0, b] + correction[a, 1] * slope[1, b] + correction[a, 2] * slope[2, b]
            )


@kernel(float64(IN_F64_2D, IN_F64_2D, _T, _T, _M))
def add_walk(
    biases: Float64Array, walk: Float64Array, blocks: Float64Array, couplings: Float64Array, right: Float64Array
) -> float:
    """Add the random walk of the biases.

    `biases` (K, 6); walk: (K - 1, 6) inverse variances of their changes; `blocks`, `couplings`, `right`: normal
    equations, added to.
    """
    cost = 0.0
    for i in range(walk.shape[0]):
        for k in range(6):
            at, w, drift = 9 + k, walk[i, k], biases[i + 1, k] - biases[i, k]
            cost += w * drift * drift
            blocks[i, at, at] += w
            blocks[i + 1, at, at] += w
            couplings[i, at, at] -= w
            right[i, at] += w * drift
            right[i + 1, at] -= w * drift
    return cost


@kernel(float64(
    IN_F64_3D, IN_F64_2D, IN_F64_2D, IN_F64_2D, IN_F64_1D, float64, IN_I64_1D, IN_F64_3D, IN_F64_2D, IN_F64_2D,
    IN_F64_3D, IN_F64_3D, IN_F64_2D, _T, _T, _M
))  # fmt: skip
def add_inertial(
    rotations: Float64Array, positions: Float64Array, velocities: Float64Array, biases: Float64Array,
    seconds: Float64Array, gravity: float, locations: Int64Array, delta_rotations: Float64Array, gains: Float64Array,
    distances: Float64Array, slopes: Float64Array, information: Float64Array, linearised: Float64Array,
    blocks: Float64Array, couplings: Float64Array, right: Float64Array,
) -> float:  # fmt: skip
    """Add preintegrated samples between neighbouring states.

    Args:
        rotations: (K, 3, 3) `world_from_body`; positions, velocities: (K, 3); biases: (K, 6).
        seconds: (K - 1,) between the states; gravity: down the world's z axis [m/s²].
        locations: (F,) numbers of the states at which measured intervals begin.
        delta_rotations, gains, distances, slopes: (K - 1, …) as `preintegrate` gives them for biases `linearised`,
            (K - 1, 6).
        information: (K - 1, 9, 9) of rotation, velocity, position.
        blocks, couplings, right: normal equations, added to.

    Returns:
        The sum of squares of the residuals, weighted.

    Source: Forster et al. 2017, eq. 37 and 45, appendix C; position and velocity are stepped along the world's axes.
    """
    residual, change = np.empty(9), np.empty(6)
    first, second = np.zeros((9, 15)), np.zeros((9, 15))
    cost = 0.0
    for f in range(locations.shape[0]):
        i = locations[f]
        dt, rotation = seconds[i], rotations[i]
        first[:, :] = 0.0
        second[:, :] = 0.0
        for k in range(6):
            change[k] = biases[i, k] - linearised[i, k]
        _rotation_residual(
            rotation, rotations[i + 1], delta_rotations[i], slopes[i, 0:3], change, residual, first, second
        )
        for a in range(3):
            speed, distance = 0.0, 0.0
            for k in range(3):
                down = -gravity if k == 2 else 0.0
                dv = velocities[i + 1, k] - velocities[i, k] - dt * down
                dp = positions[i + 1, k] - positions[i, k] - dt * velocities[i, k] - 0.5 * dt * dt * down
                speed += rotation[k, a] * dv
                distance += rotation[k, a] * dp
                second[3 + a, 6 + k] = rotation[k, a]
                first[3 + a, 6 + k] = -rotation[k, a]
                second[6 + a, 3 + k] = rotation[k, a]
                first[6 + a, 3 + k] = -rotation[k, a]
                first[6 + a, 6 + k] = -dt * rotation[k, a]
            residual[3 + a], residual[6 + a] = speed, distance
        # by the rotation at i: [Rᵀ d]×
        for row in (3, 6):
            x, y, z = residual[row], residual[row + 1], residual[row + 2]
            first[row, 1], first[row, 2] = -z, y
            first[row + 1, 0], first[row + 1, 2] = z, -x
            first[row + 2, 0], first[row + 2, 1] = -y, x
        for a in range(3):
            residual[3 + a] -= gains[i, a]
            residual[6 + a] -= distances[i, a]
            for k in range(6):
                residual[3 + a] -= slopes[i, 3 + a, k] * change[k]
                residual[6 + a] -= slopes[i, 6 + a, k] * change[k]
                first[3 + a, 9 + k] = -slopes[i, 3 + a, k]
                first[6 + a, 9 + k] = -slopes[i, 6 + a, k]
        _add_pair(first, second, information[i], residual, blocks, couplings, right, i)
        for a in range(9):
            for b in range(9):
                cost += residual[a] * information[i, a, b] * residual[b]
    return cost


@kernel(float64(IN_F64_3D, IN_F64_2D, IN_I64_1D, IN_F64_3D, IN_F64_2D, IN_F64_3D, _T, _T, _M))
def add_relative_poses(
    rotations: Float64Array, positions: Float64Array, locations: Int64Array, delta_rotations: Float64Array,
    translations: Float64Array, information: Float64Array, blocks: Float64Array, couplings: Float64Array,
    right: Float64Array,
) -> float:  # fmt: skip
    """Add measured poses of states relative to those before.

    `rotations`, `positions` (K, 3, 3) and (K, 3) of the states; `locations` (F,) numbers of the earlier states;
    `delta_rotations` (F, 3, 3) and `translations` (F, 3) [m], `earlier_from_later`; `information` (F, 6, 6) of rotation
    [rad] and translation; `blocks`, `couplings`, `right`: normal equations, added to. Returns the sum of squares of the
    residuals, weighted.
    """
    residual, no_change, no_slope = np.empty(6), np.zeros(3), np.zeros((3, 3))
    first, second = np.zeros((6, 15)), np.zeros((6, 15))
    cost = 0.0
    for f in range(locations.shape[0]):
        i = locations[f]
        rotation = rotations[i]
        first[:, :] = 0.0
        second[:, :] = 0.0
        _rotation_residual(rotation, rotations[i + 1], delta_rotations[f], no_slope, no_change, residual, first, second)
        for a in range(3):
            distance = 0.0
            for k in range(3):
                distance += rotation[k, a] * (positions[i + 1, k] - positions[i, k])
                second[3 + a, 3 + k] = rotation[k, a]
                first[3 + a, 3 + k] = -rotation[k, a]
            residual[3 + a] = distance
        x, y, z = residual[3], residual[4], residual[5]
        first[3, 1], first[3, 2] = -z, y
        first[4, 0], first[4, 2] = z, -x
        first[5, 0], first[5, 1] = -y, x
        for a in range(3):
            residual[3 + a] -= translations[f, a]
        _add_pair(first, second, information[f], residual, blocks, couplings, right, i)
        for a in range(6):
            for b in range(6):
                cost += residual[a] * information[f, a, b] * residual[b]
    return cost


@kernel(float64(IN_F64_2D, IN_F64_2D, IN_F64_1D, IN_I64_1D, float64, _T, _T, _M))
def add_coasting(
    positions: Float64Array, velocities: Float64Array, seconds: Float64Array, locations: Int64Array, density: float,
    blocks: Float64Array, couplings: Float64Array, right: Float64Array,
) -> float:  # fmt: skip
    """Add, where no IMU measured, that the velocity changes by white acceleration only.

    `locations` (F,) numbers of the states at which such intervals begin; `density`: of the acceleration, (m/s²)²/Hz;
    the others as in `add_inertial`.

    Source: Bar-Shalom, Li and Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation", 6.2.2.
    """
    cost = 0.0
    for f in range(locations.shape[0]):
        i = locations[f]
        dt = seconds[i]
        pp, pv, vv = 12.0 / (density * dt**3), -6.0 / (density * dt**2), 4.0 / (density * dt)
        for k in range(3):
            p, v = 3 + k, 6 + k
            distance = positions[i + 1, k] - positions[i, k] - dt * velocities[i, k]
            speed = velocities[i + 1, k] - velocities[i, k]
            wp, wv = pp * distance + pv * speed, pv * distance + vv * speed
            cost += distance * wp + speed * wv
            blocks[i, p, p] += pp
            blocks[i, p, v] += pp * dt + pv
            blocks[i, v, p] += pp * dt + pv
            blocks[i, v, v] += pp * dt * dt + 2.0 * pv * dt + vv
            couplings[i, p, p] -= pp
            couplings[i, p, v] -= pv
            couplings[i, v, p] -= pp * dt + pv
            couplings[i, v, v] -= pv * dt + vv
            blocks[i + 1, p, p] += pp
            blocks[i + 1, p, v] += pv
            blocks[i + 1, v, p] += pv
            blocks[i + 1, v, v] += vv
            right[i, p] += wp
            right[i, v] += dt * wp + wv
            right[i + 1, p] -= wp
            right[i + 1, v] -= wv
    return cost


@kernel(float64(
    IN_F64_3D, IN_F64_2D, IN_F64_2D, IN_F64_2D, IN_I64_1D, IN_F64_1D, IN_F64_2D, IN_F64_2D, IN_F64_1D, IN_F64_3D,
    IN_F64_2D, IN_F64_2D, _T, _M, _M
))  # fmt: skip
def add_fixes(
    rotations: Float64Array, positions: Float64Array, velocities: Float64Array, biases: Float64Array,
    locations: Int64Array, seconds: Float64Array, fixes: Float64Array, levers: Float64Array, falls: Float64Array,
    slopes: Float64Array, linearised: Float64Array, information: Float64Array, blocks: Float64Array,
    right: Float64Array, residuals: Float64Array,
) -> float:  # fmt: skip
    """Add measured positions of antennas, each led on from the state before it.

    Args:
        rotations: (K, 3, 3) `world_from_body`; positions, velocities: (K, 3); biases: (K, 6).
        locations: (F,) numbers of the states; seconds: (F,) from these to the fixes.
        fixes: (F, 3) [m], world; levers: (F, 3) [m], the antenna in the body's axes at the state, for biases
            `linearised`, (F, 6), by which it changes with `slopes`, (F, 3, 6).
        falls: (F,) [m] down the world's z axis.
        information: (F, 3) inverse variances along the world's axes.
        blocks, right: normal equations, added to.
        residuals: (F, 3), written here.
    """
    cost = 0.0
    slope, lever = np.zeros(15), np.empty(3)
    for f in range(locations.shape[0]):
        i, t, rotation = locations[f], seconds[f], rotations[locations[f]]
        for a in range(3):
            lever[a] = levers[f, a]
            for k in range(6):
                lever[a] += slopes[f, a, k] * (biases[i, k] - linearised[f, k])
        x, y, z = lever[0], lever[1], lever[2]
        for a in range(3):
            reach = rotation[a, 0] * x + rotation[a, 1] * y + rotation[a, 2] * z
            apart = positions[i, a] + t * velocities[i, a] + reach - fixes[f, a]
            if a == 2:
                apart -= falls[f]
            residuals[f, a] = apart
            # by the rotation: -R [lever]×
            slope[0] = -(rotation[a, 1] * z - rotation[a, 2] * y)
            slope[1] = -(rotation[a, 2] * x - rotation[a, 0] * z)
            slope[2] = -(rotation[a, 0] * y - rotation[a, 1] * x)
            for k in range(3):
                slope[3 + k] = 1.0 if k == a else 0.0
                slope[6 + k] = t if k == a else 0.0
            for k in range(6):
                slope[9 + k] = 0.0
                for b in range(3):
                    slope[9 + k] += rotation[a, b] * slopes[f, b, k]
            w = information[f, a]
            cost += w * apart * apart
            for r in range(15):
                if slope[r] == 0.0:
                    continue
                weighted = w * slope[r]
                right[i, r] -= weighted * apart
                for c in range(15):
                    blocks[i, r, c] += weighted * slope[c]
    return cost


@kernel(float64(IN_F64_3D, IN_F64_2D, IN_I64_1D, IN_F64_2D, IN_F64_1D, IN_F64_1D, _T, _M))
def add_body_speeds(
    rotations: Float64Array, velocities: Float64Array, locations: Int64Array, axes: Float64Array,
    speeds: Float64Array, information: Float64Array, blocks: Float64Array, right: Float64Array,
) -> float:  # fmt: skip
    """Add known speeds along axes of the body.

    `locations` (F,) numbers of the states; axes: (F, 3) unit vectors in the body; speeds: (F,) [m/s]; `information`
    (F,) inverse variances.
    """
    cost = 0.0
    slope, inside = np.empty(9), np.empty(3)
    for f in range(locations.shape[0]):
        i, w = locations[f], information[f]
        rotation = rotations[i]
        x, y, z = axes[f, 0], axes[f, 1], axes[f, 2]
        for a in range(3):
            inside[a] = (
                rotation[0, a] * velocities[i, 0]
                + rotation[1, a] * velocities[i, 1]
                + rotation[2, a] * velocities[i, 2]
            )
            slope[6 + a] = rotation[a, 0] * x + rotation[a, 1] * y + rotation[a, 2] * z
            slope[3 + a] = 0.0
        # axis · [Rᵀ v]×
        slope[0] = y * inside[2] - z * inside[1]
        slope[1] = z * inside[0] - x * inside[2]
        slope[2] = x * inside[1] - y * inside[0]
        residual = x * inside[0] + y * inside[1] + z * inside[2] - speeds[f]
        cost += w * residual * residual
        for r in range(9):
            right[i, r] -= w * slope[r] * residual
            for c in range(9):
                blocks[i, r, c] += w * slope[r] * slope[c]
    return cost


@kernel(boolean(_M))
def _factor(matrix: Float64Array) -> bool:
    """Overwrite the lower half by the Cholesky factor; False where the matrix is not positive definite."""
    n = matrix.shape[0]
    for j in range(n):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k]
        if not pivot > 0.0:
            return False
        root = math.sqrt(pivot)
        matrix[j, j] = root
        for i in range(j + 1, n):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total / root
    return True


@kernel(types.void(_M, _M))
def _solve_columns(factor: Float64Array, right: Float64Array) -> None:
    """Overwrite B, (n, m), by the solution of L Lᵀ X = B."""
    n, m = right.shape
    for i in range(n):
        for k in range(i):
            share = factor[i, k]
            for j in range(m):
                right[i, j] -= share * right[k, j]
        scale = 1.0 / factor[i, i]
        for j in range(m):
            right[i, j] *= scale
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            share = factor[k, i]
            for j in range(m):
                right[i, j] -= share * right[k, j]
        scale = 1.0 / factor[i, i]
        for j in range(m):
            right[i, j] *= scale


@kernel(int64(IN_F64_3D, IN_F64_3D, IN_F64_2D, float64, _T, _T, _M))
def solve_chain(
    blocks: Float64Array, couplings: Float64Array, right: Float64Array, damping: float, factors: Float64Array,
    gains: Float64Array, solution: Float64Array,
) -> int:  # fmt: skip
    """Solve H x = b for a symmetric H of blocks on the diagonal and beside it.

    `blocks` (K, n, n) the diagonal; `damping` times their own diagonals are added; `couplings` (K - 1, n, n), row block
    i, column block i + 1; `right` (K, n); `factors` (K, n, n), written here: Cholesky factors of the pivots, in the
    lower halves; `gains` (K - 1, n, n), written here: pivot⁻¹ · coupling; `solution` (K, n), written here. Returns -1,
    or the first block at which H is not positive definite.

    Source: Golub and Van Loan 2013, "Matrix Computations", 4.5, block elimination.
    """
    count, n = right.shape
    column = np.empty((n, 1))
    for i in range(count):
        factors[i] = blocks[i]
        for k in range(n):
            factors[i, k, k] += damping * blocks[i, k, k]
            solution[i, k] = right[i, k]
        if i > 0:
            coupling, gain = couplings[i - 1], gains[i - 1]
            for j in range(n):
                for r in range(n):
                    tied = coupling[j, r]
                    if tied != 0.0:
                        for c in range(r + 1):
                            factors[i, r, c] -= tied * gain[j, c]
                        solution[i, r] -= tied * column[j, 0]
        if not _factor(factors[i]):
            return i
        if i + 1 < count:
            gains[i] = couplings[i]
            _solve_columns(factors[i], gains[i])
        column[:, 0] = solution[i]
        _solve_columns(factors[i], column)
        solution[i] = column[:, 0]
    for i in range(count - 2, -1, -1):
        for r in range(n):
            total = solution[i, r]
            for c in range(n):
                total -= gains[i, r, c] * solution[i + 1, c]
            solution[i, r] = total
    return -1


@kernel(types.void(IN_F64_3D, IN_F64_3D, _T, _T))
def chain_covariances(
    factors: Float64Array, gains: Float64Array, covariances: Float64Array, between: Float64Array
) -> None:
    """Give those blocks of H⁻¹ that lie where H has some, from what `solve_chain` left with no damping.

    `factors`, `gains`: as there; `covariances` (K, n, n), written here: of each state; `between` (K - 1, n, n), written
    here: of each state with the next.

    Source: Takahashi, Fagan and Chin 1973, the entries of the inverse of a sparse matrix; for a chain the same as the
    smoother of Rauch, Tung and Striebel 1965.
    """
    count, n = factors.shape[0], factors.shape[1]
    pivot = np.empty((n, n))
    for i in range(count - 1, -1, -1):
        pivot[:] = factors[i]
        own = np.eye(n)
        _solve_columns(pivot, own)
        covariances[i] = own
        if i + 1 == count:
            continue
        for r in range(n):
            for c in range(n):
                total = 0.0
                for k in range(n):
                    total -= gains[i, r, k] * covariances[i + 1, k, c]
                between[i, r, c] = total
        for r in range(n):
            for c in range(r + 1):
                total = 0.0
                for k in range(n):
                    total -= between[i, r, k] * gains[i, c, k]
                covariances[i, r, c] += total
                if c != r:
                    covariances[i, c, r] = covariances[i, r, c]


_SMALL = 1e-5  # angles [rad] below which the next term of the series is below rounding


@kernel(types.void(_M, _V))
def _rotation_vector(matrix: Float64Array, vector: Float64Array) -> None:
    """Write the rotation vector of a rotation matrix, its angle at most π."""
    x, y, z = matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]
    sine2, cosine2 = math.sqrt(x * x + y * y + z * z), matrix[0, 0] + matrix[1, 1] + matrix[2, 2] - 1.0
    angle = math.atan2(sine2, cosine2)
    if cosine2 > -1.999:
        scale = 0.5 if sine2 < _SMALL else angle / sine2
        vector[0], vector[1], vector[2] = scale * x, scale * y, scale * z
        return
    # near half a rotation the axis is the column of R + Rᵀ + (1 - trace) I with the largest diagonal
    best = 0
    for k in range(1, 3):
        if matrix[k, k] > matrix[best, best]:
            best = k
    norm2 = 0.0
    for k in range(3):
        vector[k] = matrix[k, best] + matrix[best, k]
    vector[best] += 1.0 - (matrix[0, 0] + matrix[1, 1] + matrix[2, 2])
    for k in range(3):
        norm2 += vector[k] * vector[k]
    sign = 1.0 if vector[0] * x + vector[1] * y + vector[2] * z >= 0.0 else -1.0
    scale = sign * angle / math.sqrt(norm2)
    for k in range(3):
        vector[k] *= scale


@kernel(types.void(_V, float64, _M))
def _right_slope(vector: Float64Array, sign: float, matrix: Float64Array) -> None:
    """Write J with Exp(v + δ) ≈ Exp(v) Exp(J δ) for sign 1, and for sign -1 the inverse of it.

    Source: Chirikjian 2012, "Stochastic Models, Information Theory, and Lie Groups 2", section 10.6.
    """
    x, y, z = vector[0], vector[1], vector[2]
    angle2 = x * x + y * y + z * z
    if sign > 0.0:
        if angle2 < _SMALL * _SMALL:
            a, b = -0.5, 1.0 / 6.0
        else:
            angle = math.sqrt(angle2)
            a, b = -(1.0 - math.cos(angle)) / angle2, (angle - math.sin(angle)) / (angle2 * angle)
    elif angle2 < _SMALL * _SMALL:
        a, b = 0.5, 1.0 / 12.0
    else:
        angle = math.sqrt(angle2)
        a = 0.5
        b = 1.0 / angle2 - 0.5 / (angle * math.tan(0.5 * angle))
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = 1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)


@kernel(types.void(_M, _M, _M))
def _times(first: Float64Array, second: Float64Array, product: Float64Array) -> None:
    """Write the product of two (3, 3) matrices into a third."""
    for i in range(3):
        for j in range(3):
            product[i, j] = first[i, 0] * second[0, j] + first[i, 1] * second[1, j] + first[i, 2] * second[2, j]


@kernel(types.void(_M, _M, _M))
def _transposed_times(first: Float64Array, second: Float64Array, product: Float64Array) -> None:
    """Write the product of the transposed first and the second (3, 3) matrix into a third."""
    for i in range(3):
        for j in range(3):
            product[i, j] = first[0, i] * second[0, j] + first[1, i] * second[1, j] + first[2, i] * second[2, j]


@kernel(types.void(_M, _V, _M))
def _times_cross(matrix: Float64Array, vector: Float64Array, product: Float64Array) -> None:
    """Write matrix · [vector]×, (3, 3), where [v]× w = v × w."""
    x, y, z = vector[0], vector[1], vector[2]
    for i in range(3):
        a, b, c = matrix[i, 0], matrix[i, 1], matrix[i, 2]
        product[i, 0], product[i, 1], product[i, 2] = b * z - c * y, c * x - a * z, a * y - b * x
