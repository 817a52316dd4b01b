"""How well a chain of motion states fits what was measured, and the normal equations of the step to a better one.

A state is a small rotation about the body's axes, then position, velocity along the world's axes, bias of the
gyroscope, bias of the accelerometer: 15 numbers.
"""

from typing import Any

import numpy as np
from numba import float64, int64, types

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.rotating import (
    right_slope,
    rotation_of_vector,
    rotation_vector,
    times,
    transposed_times,
)
from sceneloom.kernels.surface_map import INNER

SIZE = 15
ROTATION, POSITION, VELOCITY, GYROSCOPE, ACCELEROMETER = (
    slice(0, 3),
    slice(3, 6),
    slice(6, 9),
    slice(9, 12),
    slice(12, 15),
)
"""Where what stands in a state."""

_V, _M, _T = float64[::1], float64[:, ::1], float64[:, :, ::1]
_READ_1D = types.Array(float64, 1, "C", readonly=True)
_READ_2D = types.Array(float64, 2, "C", readonly=True)
_READ_3D = types.Array(float64, 3, "C", readonly=True)
_LOCATIONS = types.Array(int64, 1, "C", readonly=True)
_COMPILED: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}


@kernel(types.void(_M, _M, _READ_2D, _V, _T, _T, _M, int64), **INNER)
def _add_pair(
    first: Float64Array, second: Float64Array, information: Float64Array, residual: Float64Array,
    blocks: Float64Array, couplings: Float64Array, right: Float64Array, i: int,
) -> None:  # fmt: skip
    """Add what a measurement between states i and i + 1 says: slopes (m, 15) each, information (m, m), residual."""
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


@kernel(types.void(_READ_2D, _READ_2D, _READ_2D, _READ_2D, _READ_1D, _V, _M, _M), **INNER)
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
    times(expected, correction, work)
    expected[:] = work
    for a in range(3):
        for b in range(3):
            relative[a, b] = (
                rotation[0, a] * after[0, b] + rotation[1, a] * after[1, b] + rotation[2, a] * after[2, b]
            )
    transposed_times(expected, relative, rest)
    rotation_vector(rest, residual)
    right_slope(residual[0:3], -1.0, inverse)
    right_slope(small, 1.0, forward)
    for a in range(3):
        for b in range(3):
            first[a, b] = -(
                inverse[a, 0] * relative[b, 0]
                + inverse[a, 1] * relative[b, 1]
                + inverse[a, 2] * relative[b, 2]
            )
            second[a, b] = inverse[a, b]
    # by the gyroscope's bias: -J⁻¹ restᵀ J(small) slope
    for a in range(3):
        for b in range(3):
            work[a, b] = inverse[a, 0] * rest[b, 0] + inverse[a, 1] * rest[b, 1] + inverse[a, 2] * rest[b, 2]
    times(work, forward, correction)
    for a in range(3):
        for b in range(3):
            first[a, 9 + b] = -(
                correction[a, 0] * slope[0, b]
                + correction[a, 1] * slope[1, b]
                + correction[a, 2] * slope[2, b]
            )


@kernel(float64(_READ_2D, _READ_2D, _T, _T, _M), **_COMPILED)
def add_walk(
    biases: Float64Array,
    walk: Float64Array,
    blocks: Float64Array,
    couplings: Float64Array,
    right: Float64Array,
) -> float:
    """Add that the biases of neighbouring states are alike.

    Args:
        biases: (K, 6); walk: (K - 1, 6) inverse variances of their changes.
        blocks, couplings, right: normal equations, added to.
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


@kernel(
    float64(
        _READ_3D, _READ_2D, _READ_2D, _READ_2D, _READ_1D, float64, _LOCATIONS, _READ_3D, _READ_2D, _READ_2D, _READ_3D,
        _READ_3D, _READ_2D, _T, _T, _M,
    ),
    **_COMPILED,
)  # fmt: skip
def add_inertial(
    rotations: Float64Array, positions: Float64Array, velocities: Float64Array, biases: Float64Array,
    seconds: Float64Array, gravity: float, locations: Int64Array, delta_rotations: Float64Array, gains: Float64Array,
    trajectories: Float64Array, slopes: Float64Array, information: Float64Array, linearised: Float64Array,
    blocks: Float64Array, couplings: Float64Array, right: Float64Array,
) -> float:  # fmt: skip
    """Add what an IMU measured between neighbouring states.

    Args:
        rotations: (K, 3, 3) `world_from_body`; positions, velocities: (K, 3); biases: (K, 6).
        seconds: (K - 1,) between the states; gravity: down the world's z axis [m/s²].
        locations: (F,) numbers of the states at which measured intervals begin.
        rotates, gains, ways, slopes: (K - 1, …) as `preintegrate` gives them for biases `linearised`, (K - 1, 6).
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
            speed, trajectory = 0.0, 0.0
            for k in range(3):
                down = -gravity if k == 2 else 0.0
                dv = velocities[i + 1, k] - velocities[i, k] - dt * down
                dp = positions[i + 1, k] - positions[i, k] - dt * velocities[i, k] - 0.5 * dt * dt * down
                speed += rotation[k, a] * dv
                trajectory += rotation[k, a] * dp
                second[3 + a, 6 + k] = rotation[k, a]
                first[3 + a, 6 + k] = -rotation[k, a]
                second[6 + a, 3 + k] = rotation[k, a]
                first[6 + a, 3 + k] = -rotation[k, a]
                first[6 + a, 6 + k] = -dt * rotation[k, a]
            residual[3 + a], residual[6 + a] = speed, trajectory
        # by the rotation at i: [Rᵀ d]×
        for row in (3, 6):
            x, y, z = residual[row], residual[row + 1], residual[row + 2]
            first[row, 1], first[row, 2] = -z, y
            first[row + 1, 0], first[row + 1, 2] = z, -x
            first[row + 2, 0], first[row + 2, 1] = -y, x
        for a in range(3):
            residual[3 + a] -= gains[i, a]
            residual[6 + a] -= trajectories[i, a]
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


@kernel(
    float64(
        _READ_3D, _READ_2D, _LOCATIONS, _READ_3D, _READ_2D, _READ_3D, _T, _T, _M, _M,
    ),
    **_COMPILED,
)  # fmt: skip
def add_relative_poses(
    rotations: Float64Array, positions: Float64Array, locations: Int64Array, delta_rotations: Float64Array, trajectories: Float64Array,
    information: Float64Array, blocks: Float64Array, couplings: Float64Array, right: Float64Array,
    residuals: Float64Array,
) -> float:  # fmt: skip
    """Add measured poses of states as seen from those before.

    Args:
        rotations, positions: (K, 3, 3) and (K, 3) of the states.
        locations: (F,) numbers of the earlier states; rotates: (F, 3, 3), ways: (F, 3) [m]: `earlier_from_later`.
        information: (F, 6, 6) of rotation [rad] and trajectory.
        blocks, couplings, right: normal equations, added to.
        residuals: (F, 6), written here: rotate, trajectory.

    Returns:
        The sum of squares of the residuals, weighted.
    """
    residual, no_change, no_slope = np.empty(6), np.zeros(3), np.zeros((3, 3))
    first, second = np.zeros((6, 15)), np.zeros((6, 15))
    cost = 0.0
    for f in range(locations.shape[0]):
        i = locations[f]
        rotation = rotations[i]
        first[:, :] = 0.0
        second[:, :] = 0.0
        _rotation_residual(
            rotation, rotations[i + 1], delta_rotations[f], no_slope, no_change, residual, first, second
        )
        for a in range(3):
            trajectory = 0.0
            for k in range(3):
                trajectory += rotation[k, a] * (positions[i + 1, k] - positions[i, k])
                second[3 + a, 3 + k] = rotation[k, a]
                first[3 + a, 3 + k] = -rotation[k, a]
            residual[3 + a] = trajectory
        x, y, z = residual[3], residual[4], residual[5]
        first[3, 1], first[3, 2] = -z, y
        first[4, 0], first[4, 2] = z, -x
        first[5, 0], first[5, 1] = -y, x
        for a in range(3):
            residual[3 + a] -= trajectories[f, a]
        _add_pair(first, second, information[f], residual, blocks, couplings, right, i)
        for a in range(6):
            residuals[f, a] = residual[a]
            for b in range(6):
                cost += residual[a] * information[f, a, b] * residual[b]
    return cost


@kernel(
    float64(_READ_2D, _READ_2D, _READ_1D, _LOCATIONS, float64, _T, _T, _M),
    **_COMPILED,
)
def add_coasting(
    positions: Float64Array, velocities: Float64Array, seconds: Float64Array, locations: Int64Array, density: float,
    blocks: Float64Array, couplings: Float64Array, right: Float64Array,
) -> float:  # fmt: skip
    """Add, where no IMU measured, that the velocity changes by white acceleration only.

    Args:
        locations: (F,) numbers of the states at which such intervals begin.
        density: of the acceleration, (m/s²)²/Hz; the others as in `add_inertial`.

    Source: Bar-Shalom, Li and Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation", 6.2.2.
    """
    cost = 0.0
    for f in range(locations.shape[0]):
        i = locations[f]
        dt = seconds[i]
        pp, pv, vv = 12.0 / (density * dt**3), -6.0 / (density * dt**2), 4.0 / (density * dt)
        for k in range(3):
            p, v = 3 + k, 6 + k
            trajectory = positions[i + 1, k] - positions[i, k] - dt * velocities[i, k]
            speed = velocities[i + 1, k] - velocities[i, k]
            wp, wv = pp * trajectory + pv * speed, pv * trajectory + vv * speed
            cost += trajectory * wp + speed * wv
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


@kernel(
    float64(
        _READ_3D, _READ_2D, _READ_2D, _READ_2D, _LOCATIONS, _READ_1D, _READ_2D, _READ_2D, _READ_1D, _READ_3D, _READ_2D,
        _READ_2D, _T, _M, _M,
    ),
    **_COMPILED,
)  # fmt: skip
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


@kernel(
    float64(_READ_3D, _READ_2D, _LOCATIONS, _READ_2D, _READ_1D, _READ_1D, _T, _M, _V),
    **_COMPILED,
)
def add_body_speeds(
    rotations: Float64Array, velocities: Float64Array, locations: Int64Array, axes: Float64Array,
    speeds: Float64Array, information: Float64Array, blocks: Float64Array, right: Float64Array,
    residuals: Float64Array,
) -> float:  # fmt: skip
    """Add known speeds along axes of the body.

    Args:
        locations: (F,) numbers of the states; axes: (F, 3) unit vectors in the body; speeds: (F,) [m/s].
        information: (F,) inverse variances.
        residuals: (F,), written here.
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
        residuals[f] = residual
        cost += w * residual * residual
        for r in range(9):
            right[i, r] -= w * slope[r] * residual
            for c in range(9):
                blocks[i, r, c] += w * slope[r] * slope[c]
    return cost
