"""Where the smoother begins: positions from the fixes alone, then orientations that explain what the IMU felt."""

from dataclasses import replace

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.geometry.rotations import matrix_from_quaternion, quaternion_from_rotation_vector
from sceneloom.motion.gnss_imu.chain import Chain, States
from sceneloom.motion.gnss_imu.robust import Fit, fit_gently, rescaled

_FIRST_TRAJECTORY, _FIRST_SECONDS, _FIRST_KNOTS = 30.0, 10.0, 12
"""The first piece that is fitted lasts so long and reaches so far [m], as far as there is as much."""
_SPAN = 1.0
"""Gains of velocity are compared over this time [s], so that the noise of velocities counts less."""
_QUARTERS = (0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi)
_SURELY_BETTER = 9.0
"""A start that needs the ego to look elsewhere than ahead has to fit better by so much: three standard deviations."""


def coasted(chain: Chain, states: States) -> Fit:
    """Fit the fixes alone, and find their noise."""
    fit = fit_gently(chain, states)
    for _ in range(3):
        fit, _ = rescaled(fit)
        fit = fit_gently(fit.chain, fit.states)
    return fit


def stationary_states(chain: Chain, gyroscope_bias: Float64Array | None = None) -> States:
    """States at the fixes, level, looking east, without speed."""
    count = len(chain.knots_ns)
    fixes = chain.fixes
    start_ns = chain.knots_ns[0]
    seconds, reported = (chain.knots_ns - start_ns) * 1e-9, (fixes.timestamps_ns - start_ns) * 1e-9
    positions = np.stack([np.interp(seconds, reported, column) for column in fixes.positions.T], axis=1)
    biases = np.zeros((count, 6))
    if gyroscope_bias is not None:
        biases[:, :3] = gyroscope_bias
    return States(np.tile(np.eye(3), (count, 1, 1)), positions, np.zeros((count, 3)), biases)


def oriented(chain: Chain, coasting: States) -> Fit:
    """Fit fixes and IMU: a first piece from several headings, then more and more of the drive around it."""
    count = len(chain.knots_ns)
    first, last = _first_piece(chain, coasting)
    fit = _best_of_headings(chain.part(first, last), coasting.part(first, last))
    while first > 0 or last < count:
        length = last - first
        earlier, later = max(first - length, 0), min(last + length, count)
        states = _extended(chain, coasting, fit.states, first, last, earlier, later)
        fit = fit_gently(chain.part(earlier, later), states)
        first, last = earlier, later
    return fit


def _first_piece(chain: Chain, states: States) -> tuple[int, int]:
    """The first knots over which the IMU measured without a gap and the ego moved far enough, else the longest."""
    seconds = np.concatenate([[0.0], np.cumsum(chain.seconds)])
    trajectory = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(states.positions, axis=0), axis=1))])
    longest = (0, min(2, len(seconds)))
    for first, last in _measured_runs(chain):
        enough = (trajectory[first:last] - trajectory[first] >= _FIRST_TRAJECTORY) & (
            seconds[first:last] - seconds[first] >= _FIRST_SECONDS
        )
        enough &= np.arange(last - first) >= _FIRST_KNOTS
        if enough.any():
            stop = first + int(np.argmax(enough)) + 1
            start = int(np.searchsorted(trajectory, trajectory[stop - 1] - 1.5 * _FIRST_TRAJECTORY))
            start = min(start, int(np.searchsorted(seconds, seconds[stop - 1] - _FIRST_SECONDS)))
            return max(first, start), stop
        if trajectory[last - 1] - trajectory[first] > trajectory[longest[1] - 1] - trajectory[longest[0]]:
            longest = (first, last)
    return longest


def _measured_runs(chain: Chain) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chain.measured, [False]]).astype(np.int8)))
    return [(int(start), int(stop) + 1) for start, stop in edges.reshape(-1, 2)]


def _best_of_headings(chain: Chain, states: States) -> Fit:
    """Try where the ego may have looked; where several fit alike, it looked where it went."""
    rotated = _rotated_by_gyroscope(chain)
    level = _wahba(chain, states, rotated)
    headings = [_along_motion(states, level @ rotated)]
    headings += [_about_up(angle) @ level for angle in _QUARTERS]
    fits = []
    for first in headings:
        begun = replace(states, rotations=np.ascontiguousarray(first @ rotated))
        fits.append(fit_gently(chain, begun))
    best = min(fits, key=lambda fit: fit.cost)
    return fits[0] if fits[0].cost <= best.cost + _SURELY_BETTER else best


def _rotated_by_gyroscope(chain: Chain) -> Float64Array:
    """(K, 3, 3) `first_from_body` by the gyroscope alone, as preintegrated."""
    inertial = chain.inertial
    rotated = np.empty((len(chain.knots_ns), 3, 3))
    rotated[0] = np.eye(3)
    for k in range(len(chain.measured)):
        rotated[k + 1] = rotated[k] @ inertial.rotations[k] if chain.measured[k] else rotated[k]
    return rotated


def _wahba(chain: Chain, states: States, rotated: Float64Array) -> Float64Array:
    """The orientation at the first knot by which the felt gains of velocity become those of the fixes, and gravity.

    Source: Wahba 1965, solved as by Markley 1988, "Attitude Determination using Vector Observations and the Singular
    Value Decomposition".
    """
    seconds = chain.seconds
    felt = np.einsum("kij,kj->ki", rotated[:-1], chain.inertial.gains)
    seen = np.diff(states.velocities, axis=0) + seconds[:, None] * [0.0, 0.0, chain.gravity]
    felt, seen = felt[chain.measured], seen[chain.measured]
    span = np.floor(np.cumsum(seconds[chain.measured]) / _SPAN).astype(np.int64)
    felt, seen = _sums(span, felt), _sums(span, seen)
    u, _, vt = np.linalg.svd(seen.T @ felt)
    rotation: Float64Array = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rotation


def _sums(groups: Int64Array, values: Float64Array) -> Float64Array:
    return np.stack([np.bincount(groups, column) for column in values.T], axis=1)


def _along_motion(states: States, rotations: Float64Array) -> Float64Array:
    """The first orientation rotated about up so that on the whole the body looks where it goes."""
    ahead = rotations[:, :2, 0]
    speed = states.velocities[:, :2]
    cosine = (ahead * speed).sum()
    sine = (ahead[:, 0] * speed[:, 1] - ahead[:, 1] * speed[:, 0]).sum()
    rotated: Float64Array = _about_up(float(np.arctan2(sine, cosine))) @ rotations[0]
    return rotated


def _about_up(angle: float) -> Float64Array:
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _extended(
    chain: Chain, coasting: States, known: States, first: int, last: int, earlier: int, later: int
) -> States:
    """Carry orientations on by the gyroscope, beyond both ends of what is known; the rest comes from the fixes."""
    rotations = np.empty((later - earlier, 3, 3))
    rotations[first - earlier : last - earlier] = known.rotations
    biases = np.empty((later - earlier, 6))
    biases[: first - earlier], biases[last - earlier :] = known.biases[0], known.biases[-1]
    biases[first - earlier : last - earlier] = known.biases
    for k in range(last - 1, later - 1):
        rotations[k + 1 - earlier] = rotations[k - earlier] @ _rotation(chain, k, known.biases[-1])
    for k in range(first - 1, earlier - 1, -1):
        rotations[k - earlier] = rotations[k + 1 - earlier] @ _rotation(chain, k, known.biases[0]).T
    before, after = coasting.part(earlier, first), coasting.part(last, later)
    joined = before.joined(known).joined(after)
    return States(rotations, joined.positions, joined.velocities, biases)


def _rotation(chain: Chain, k: int, bias: Float64Array) -> Float64Array:
    if not chain.measured[k]:
        return np.eye(3)
    inertial = chain.inertial
    vector = inertial.slopes[k, :3] @ (bias - inertial.biases[k])
    rotated: Float64Array = inertial.rotations[k] @ matrix_from_quaternion(
        quaternion_from_rotation_vector(vector)
    )
    return rotated
