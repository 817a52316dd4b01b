"""Preintegrated IMU measurements against the exact motion of a curve, differences, and drawn noise.

Chains of blocks against the same matrix written out.
"""

import numpy as np

from sceneloom.geometry.rigid import quaternion_from_matrix, rotation_vector_from_quaternion
from sceneloom.kernels.imu_chain import chain_covariances, solve_chain
from sceneloom.motion.gnss_imu import InertialSamples
from sceneloom.simulate.drive import GRAVITY, ImuSpec, imu_truth
from sceneloom.simulate.trajectory import PathSpec

PATH = PathSpec(yaw_rate=0.8, speeds=(3.0, 5.0)).plan(np.random.default_rng(0), start_ns=0, duration=10.0)
KNOTS = np.arange(9) * 1_000_000_000 + 333_333_333  # between samples of every rate below


def measured(rate_hz, path=PATH):
    times = np.round(np.arange(int(9.9 * rate_hz)) * 1e9 / rate_hz).astype(np.int64)
    truth = imu_truth(ImuSpec(), path, times, seed=0)
    return times, np.hstack([truth.angular_rates, truth.specific_forces])


def summed(times, values, bias, densities=(1e-8, 1e-6)):
    count = len(KNOTS) - 1
    return InertialSamples(times, values, np.empty((0, 2), np.int64)).preintegrated(
        KNOTS, biases=np.tile(bias, (count, 1)), densities=np.tile(np.array(densities), (count, 1))
    )


def vectors(found, reference):
    apart = np.swapaxes(reference.rotations, 1, 2) @ found.rotations
    rotations = rotation_vector_from_quaternion(quaternion_from_matrix(apart))
    return np.hstack([rotations, found.velocities - reference.velocities, found.positions - reference.positions])


def test_covariances_are_those_of_drawn_noise():
    times, values = measured(200.0)
    rng, deviations = np.random.default_rng(1), np.repeat(np.sqrt(np.array([1e-8, 1e-6]) * 200.0), 3)
    base = summed(times, values, np.zeros(6))
    draws = np.stack(
        [
            vectors(summed(times, values + rng.standard_normal(values.shape) * deviations, np.zeros(6)), base)
            for _ in range(300)
        ]
    )
    whitened = np.linalg.solve(np.linalg.cholesky(base.covariances)[None], draws[..., None])[..., 0]
    # mean of 300 · 8 squares of each: 1 within 5 standard deviations of √(2 / 2400)
    assert np.abs((whitened**2).mean(axis=(0, 1)) - 1.0).max() < 0.15
    correlation = np.einsum("kni,knj->ij", whitened, whitened) / (whitened.shape[0] * whitened.shape[1])
    assert np.abs(correlation - np.eye(9)).max() < 0.15


def test_rotation_gain_and_distance_are_those_of_the_curve_and_slopes_what_small_biases_do():
    for rate_hz, rotation, speed, distance in [
        (10.0, 3e-3, 3e-2, 2e-2),
        (50.0, 1.2e-4, 1.2e-3, 8e-4),
        (200.0, 8e-6, 8e-5, 5e-5),
    ]:
        found, states = summed(*measured(rate_hz), np.zeros(6)), PATH.at(KNOTS)
        before, gravity = states.rotations[:-1], np.array([0.0, 0.0, -GRAVITY])
        rotations = np.swapaxes(before, 1, 2) @ states.rotations[1:]
        gains = np.einsum("nji,nj->ni", before, np.diff(states.velocities, axis=0) - gravity)
        steps = np.diff(states.positions, axis=0) - states.velocities[:-1] - 0.5 * gravity
        assert np.abs(found.rotations - rotations).max() < rotation
        assert np.abs(found.velocities - gains).max() < speed
        assert np.abs(found.positions - np.einsum("nji,nj->ni", before, steps)).max() < distance
    times, values = measured(200.0)
    base = summed(times, values, np.zeros(6))
    for column in range(6):
        bias = np.zeros(6)
        bias[column] = 1e-5
        change = vectors(summed(times, values, bias), base) / 1e-5
        # half a step's worth of the path is neglected in the slopes: 2.5 ms of 5 m/s² over a second
        assert np.abs(change - base.slopes[:, :, column]).max() < 0.02
    times = np.array([400_000_000, 500_000_000], np.int64)
    values = np.tile([0.0, 0.0, 0.1, 1.0, 0.0, 9.8], (2, 1))
    found = summed(times, values, np.zeros(6))
    assert np.allclose(found.rotations[5][:2, :2], [[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]])
    assert np.allclose(found.velocities[:, 2], 9.8)  # a second of that force, rotated about its own axis


def chain(count, n, seed):
    """Blocks, couplings, right side, and the whole matrix: Jᵀ J with J tying neighbours only."""
    rng, whole = np.random.default_rng(seed), np.zeros((count * n, count * n))
    for k in range(count):
        slopes = np.zeros((2 * n, count * n))
        slopes[:, k * n : (k + 2) * n] = rng.standard_normal((2 * n, min(2, count - k) * n))
        whole += slopes.T @ slopes
    grid, rows = whole.reshape(count, n, count, n).swapaxes(1, 2), np.arange(count)
    couplings = np.ascontiguousarray(grid[rows[:-1], rows[1:]])
    return np.ascontiguousarray(grid[rows, rows]), couplings, rng.standard_normal((count, n)), whole


def solved(blocks, couplings, right, damping):
    """The block at which it fails, the solution, and the factors of the covariances."""
    factors, gains, solution = np.empty_like(blocks), np.empty_like(couplings), np.empty_like(right)
    return solve_chain(blocks, couplings, right, damping, factors, gains, solution), solution, (factors, gains)


def test_solution_and_covariances_are_those_of_the_whole_matrix_damped_or_not():
    for count, n in [(1, 3), (2, 15), (40, 15), (100, 4)]:
        blocks, couplings, right, whole = chain(count, n, count)
        failed, solution, factors = solved(blocks, couplings, right, 0.0)
        assert failed == -1
        # float64 with condition numbers of some thousands
        assert np.allclose(solution.ravel(), np.linalg.solve(whole, right.ravel()), rtol=1e-8, atol=1e-9)
        own, between = np.empty_like(blocks), np.empty_like(couplings)
        chain_covariances(*factors, own, between)
        inverse, rows = np.linalg.inv(whole).reshape(count, n, count, n).swapaxes(1, 2), np.arange(count)
        assert np.allclose(own, inverse[rows, rows], rtol=1e-7, atol=1e-9)
        assert np.allclose(between, inverse[rows[:-1], rows[1:]], rtol=1e-7, atol=1e-9)
    blocks, couplings, right, whole = chain(5, 3, 0)
    expected = np.linalg.solve(whole + 0.5 * np.diag(np.diag(whole)), right.ravel())
    assert np.allclose(solved(blocks, couplings, right, 0.5)[1].ravel(), expected, rtol=1e-9)
    blocks[2] -= 1e3 * np.eye(3)
    assert solved(blocks, couplings, right, 0.0)[0] == 2
