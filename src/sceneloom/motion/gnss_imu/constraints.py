"""Further constraints on the states: stationary intervals, the direction of travel of a wheeled vehicle.

And lidar odometry.
"""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.kernels.imu_chain import MOTION_CHAIN_ROTATION, VELOCITY
from sceneloom.motion.gnss_imu.chain import BodySpeeds, Chain, RelativePoses, States
from sceneloom.motion.gnss_imu.measurements import Fixes, InertialSamples
from sceneloom.motion.gnss_imu.robust import Fit
from sceneloom.motion.imu import QUIET_FORCE, QUIET_RATE, WHITE
from sceneloom.scene.poses import Trajectory

_SECONDS, _LEAST_SAMPLES = 1.0, 15
"""The IMU is judged over so long, and so many samples at least."""

_YAW_RATE = 0.02
"""Mean yaw rate of a stand, the bias taken off, at most [rad/s]."""

_SPEED, _DEVIATIONS = 0.2, 3.0
"""Speed that fixes may leave to a stand: at most this [m/s] and so many standard deviations more."""

_STILL_SPEED, _STILL_ROTATION, _STILL_TRAJECTORY = 0.02, 2e-4, 2e-3
"""How far a stand is none [m/s], and from one state to the next [rad] and [m]."""

_WIDE = 1.5
"""Excess of the variance over that of white noise that a low number of samples leaves to chance."""


def stops(
    fit: Fit, own: Float64Array, samples: InertialSamples
) -> tuple[tuple[BodySpeeds, ...], tuple[RelativePoses, ...]]:
    """Give what is known of the states at which the ego stands, as measurements.

    The IMU is quiet, and what is left is noise without sway; the fixes leave no speed. A smooth even drive passes the
    first test, hence the second.

    Args:
        own: (K, 15, 15) covariances of the states.

    Source: Skog, Händel, Nilsson and Rantakokko 2010, "Zero-Velocity Detection - An Algorithm Evaluation"; as in
    `motion.stationary`.
    """
    still = _stands(fit, own, samples)
    rows = np.flatnonzero(still)
    if len(rows) < 2:
        return (), ()
    axes = np.tile(np.eye(3), (len(rows), 1))
    count = len(axes)
    speeds = BodySpeeds(np.repeat(rows, 3), axes, np.zeros(count), np.full(count, _STILL_SPEED))
    locations = np.flatnonzero(still[:-1] & still[1:])
    information = np.diag(np.repeat([_STILL_ROTATION**-2, _STILL_TRAJECTORY**-2], 3))
    relative = RelativePoses(
        locations,
        np.tile(np.eye(3), (len(locations), 1, 1)),
        np.zeros((len(locations), 3)),
        np.tile(information, (len(locations), 1, 1)),
    )
    return (speeds,), (relative,)


def _stands(fit: Fit, own: Float64Array, samples: InertialSamples) -> BoolArray:
    chain, states = fit.chain, fit.states
    quiet = _quiet(samples, chain.knots_ns, states.biases)
    speed = np.linalg.norm(states.velocities, axis=1)
    unsure = np.sqrt(np.einsum("kii->k", own[:, VELOCITY, VELOCITY]))
    inside = np.ones(len(quiet), np.bool_)
    inside[:-1] &= chain.measured
    inside[1:] &= chain.measured
    still: BoolArray = quiet & inside & (speed < _SPEED + _DEVIATIONS * unsure)
    return still


def _quiet(samples: InertialSamples, knots_ns: Int64Array, biases: Float64Array) -> BoolArray:
    """Whether the IMU is quiet around each state."""
    count = len(samples.timestamps_ns)
    width = max(round(_SECONDS / samples.period), _LEAST_SAMPLES)
    if count <= width:
        return np.zeros(len(knots_ns), np.bool_)
    values = samples.values - samples.values.mean(axis=0)
    sums = _running(values)
    squares = _running(values**2)
    steps = _running(np.vstack([np.diff(values, axis=0) ** 2, np.zeros((1, 6))]))
    middle = np.searchsorted(samples.timestamps_ns, knots_ns)
    first = np.clip(middle - width // 2, 0, count - width)
    mean = (sums[first + width] - sums[first]) / width
    variance = np.maximum((squares[first + width] - squares[first]) / width - mean**2, 0.0)
    successive = (steps[first + width - 1] - steps[first]) / (width - 1)
    calm = (variance < np.repeat([QUIET_RATE**2, QUIET_FORCE**2], 3)).all(axis=1)
    white = (variance <= _WIDE * WHITE * successive / 2 + 1e-20).all(axis=1)
    rate = mean[:, :3] + samples.values.mean(axis=0)[:3] - biases[:, :3]
    quiet: BoolArray = calm & white & (np.abs(rate) < _YAW_RATE).all(axis=1)
    return quiet


def _running(values: Float64Array) -> Float64Array:
    sums: Float64Array = np.vstack([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    return sums


_EVERY = 1.0
"""The knowledge is used this often [s]: what is wrong with it stays wrong for about so long."""

_SLIP, _AXIS, _LEVER = 0.1, 0.02, 0.5
"""It is wrong by a slip [m/s], a share of the speed since the axis is not exactly the body's, and the yaw rate times a
lever [m], since the axle that does not slip is elsewhere."""

_MOVING = 2.0
"""Speed from which on a direction of motion counts [m/s]."""

_LEAST_ROTATION, _LEAST_KNOTS = np.radians(40.0), 8
"""To show that it holds, the ego has to rotate so far while it moves, over so many states."""

_FAST = 5.0
"""Or it moves so fast on the whole [m/s], along its x axis."""

_LARGEST_SHARE = 0.3
"""Sideways speeds have to be known to be below this share of the speed."""

_LARGEST_MISFIT = 2.0
"""Mean square of sideways speeds in units of what they may be."""


def vehicle_speeds(
    fit: Fit, own: Float64Array, samples: InertialSamples, *, asked: bool | None
) -> BodySpeeds | None:
    """Give the knowledge as measurements, if the states show that it holds, or if it is asked for.

    It has to be seen in rotations, or at speed along the x axis: on a straight trajectory every body moves along one of
        its axes.

    Args:
        own: (K, 15, 15) covariances of the states.
        asked: True to have it in any case, False to have it in none, None for the states to decide.

    Source: Dissanayake, Sukkarieh, Nebot and Durrant-Whyte 2001, "The Aiding of a Low-Cost Strapdown Inertial
    Measurement Unit Using Vehicle Model Constraints for Land Vehicle Applications"; the test is ours.
    """
    if asked is False:
        return None
    chain, states = fit.chain, fit.states
    inside = np.einsum("nji,nj->ni", states.rotations, states.velocities)
    rates = _rates(chain, states, samples)
    rows = _spread_out(chain)
    if asked:
        return _speeds(rows, np.array([1.0, 0.0, 0.0]), inside, rates)
    for axis in _axes(inside):
        speeds = _speeds(rows, axis, inside, rates)
        if _shows(speeds, states, own, inside):
            return speeds
    return None


def misfit(speeds: BodySpeeds, states: States) -> float:
    """Mean square of how far states are from it, in units of what they may be."""
    inside = np.einsum("nji,nj->ni", states.rotations[speeds.locations], states.velocities[speeds.locations])
    apart = (speeds.axes * inside).sum(axis=1) - speeds.speeds
    return float(((apart / speeds.sigmas) ** 2).mean())


def _axes(inside: Float64Array) -> list[Float64Array]:
    """The axes along which the body may move: its own x, and that along which it did most."""
    found = np.linalg.eigh(inside.T @ inside)[1][:, 2]
    return [np.array([1.0, 0.0, 0.0]), found * np.sign(inside.sum(axis=0) @ found or 1.0)]


def _spread_out(chain: Chain) -> Int64Array:
    seconds = (chain.knots_ns - chain.knots_ns[0]) * 1e-9
    _, rows = np.unique(np.floor(seconds / _EVERY + 1e-6), return_index=True)
    chosen: Int64Array = rows
    return chosen


def _rates(chain: Chain, states: States, samples: InertialSamples) -> Float64Array:
    """(K, 3) yaw rates at the states [rad/s]."""
    start = samples.timestamps_ns[0]
    times, knots = (samples.timestamps_ns - start) * 1e-9, (chain.knots_ns - start) * 1e-9
    rates = np.stack([np.interp(knots, times, samples.values[:, k]) for k in range(3)], axis=1)
    rotating: Float64Array = rates - states.biases[:, :3]
    return rotating


def _speeds(rows: Int64Array, axis: Float64Array, inside: Float64Array, rates: Float64Array) -> BodySpeeds:
    """No speed across an axis, at some states."""
    across = np.linalg.svd(axis[None])[2][1:]
    sigma = np.sqrt(
        _SLIP**2
        + (_AXIS * np.linalg.norm(inside[rows], axis=1)) ** 2
        + (_LEVER * np.linalg.norm(rates[rows], axis=1)) ** 2
    )
    locations = np.repeat(rows, 2)
    return BodySpeeds(
        locations, np.tile(across, (len(rows), 1)), np.zeros(len(locations)), np.repeat(sigma, 2)
    )


def _shows(speeds: BodySpeeds, states: States, own: Float64Array, inside: Float64Array) -> bool:
    locations, axes = speeds.locations, speeds.axes
    speed = np.linalg.norm(inside[locations], axis=1)
    moving = speed > _MOVING
    if moving.sum() < 2 * _LEAST_KNOTS:
        return False
    rotating = _rotated(states, np.unique(locations[moving])) >= _LEAST_ROTATION
    fast = speed[moving].mean() >= _FAST and abs(axes[:, 0]).max() < 1e-6
    if not (rotating or fast):
        return False
    u = inside[locations]
    slopes = np.zeros((len(locations), 15))
    slopes[:, MOTION_CHAIN_ROTATION] = np.cross(axes, u)
    slopes[:, VELOCITY] = np.einsum("nij,nj->ni", states.rotations[locations], axes)
    variance = np.einsum("ni,nij,nj->n", slopes, own[locations], slopes)
    sideways = (axes * u).sum(axis=1)
    known = np.sqrt((sideways**2 + variance)[moving].mean()) < _LARGEST_SHARE * np.sqrt(
        (speed[moving] ** 2).mean()
    )
    agrees = (sideways**2 / (variance + speeds.sigmas**2))[moving].mean() < _LARGEST_MISFIT
    return bool(known and agrees)


def _rotated(states: States, rows: Int64Array) -> float:
    """By how much the directions of motion at some states span [rad]."""
    direction = np.unwrap(np.arctan2(states.velocities[rows, 1], states.velocities[rows, 0]))
    return float(np.ptp(direction))


_LIDAR_STEPS_LEAST_ROTATION, _LEAST_TRAJECTORY = 3e-4, 5e-3
"""No step is believed to be better [rad] and [m]: what a fit onto the map repeats to."""

_ROUNDS = 8
"""Rounds of weighting the fixes by how they agree (L1)."""


def lidar_steps(lidar: Trajectory, knots_ns: Int64Array) -> RelativePoses:
    """Give the steps from each state to the next within the odometry's trajectory, with what they add to its errors."""
    found = lidar.poses.interpolate(knots_ns)
    inside = found.coverage == 0
    locations = np.flatnonzero(inside[:-1] & inside[1:])
    rotations = np.full((len(knots_ns), 3, 3), np.nan)
    rotations[inside] = matrix_from_quaternion(found.quaternions_xyzw[inside])
    before, after = rotations[locations], rotations[locations + 1]
    steps = found.positions[locations + 1] - found.positions[locations]
    delta_rotations = np.swapaxes(before, 1, 2) @ after
    trajectories = np.einsum("nji,nj->ni", before, steps)
    added = _added(lidar, knots_ns, locations, steps)
    covariances = np.zeros((len(locations), 6, 6))
    covariances[:, :3, :3] = np.swapaxes(after, 1, 2) @ added[:, :3, :3] @ after
    covariances[:, 3:, 3:] = np.swapaxes(before, 1, 2) @ added[:, 3:, 3:] @ before
    covariances += np.diag(np.repeat([_LIDAR_STEPS_LEAST_ROTATION**2, _LEAST_TRAJECTORY**2], 3))
    return RelativePoses(
        locations, delta_rotations, trajectories, np.asarray(np.linalg.inv(covariances), np.float64)
    )


def _added(
    lidar: Trajectory, knots_ns: Int64Array, locations: Int64Array, steps: Float64Array
) -> Float64Array:
    """What the odometry's covariance grows by in each step beyond what the error before it makes of it, (F, 6, 6)."""
    if lidar.covariances is None:
        return np.zeros((len(locations), 6, 6))
    rows = np.clip(np.searchsorted(lidar.timestamps_ns, knots_ns), 0, len(lidar.timestamps_ns) - 1)
    known = lidar.covariances[rows]
    levers = np.tile(np.eye(6), (len(locations), 1, 1))
    x, y, z = steps.T
    nothing = np.zeros(len(locations))
    levers[:, 3:, :3] = np.stack([nothing, z, -y, -z, nothing, x, y, -x, nothing], axis=1).reshape(-1, 3, 3)
    grown = known[locations + 1] - levers @ known[locations] @ np.swapaxes(levers, 1, 2)
    values, axes = np.linalg.eigh(0.5 * (grown + np.swapaxes(grown, 1, 2)))
    positive: Float64Array = (axes * np.maximum(values, 0.0)[:, None, :]) @ np.swapaxes(axes, 1, 2)
    return positive


def led_by_lidar(lidar: Trajectory, knots_ns: Int64Array, fixes: Fixes) -> Float64Array:
    """Give orientations of the states, (K, 3, 3): the odometry's, its world rotated about up onto the fixes."""
    known = lidar.poses.held(knots_ns)
    here, there = known.positions[fixes.locations, :2], fixes.positions[:, :2]
    weights = np.ones(len(fixes))
    angle = 0.0
    for _ in range(_ROUNDS):
        share = weights / weights.sum()
        one, other = here - share @ here, there - share @ there
        dot = (share[:, None] * one * other).sum()
        cross = (share * (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])).sum()
        angle = float(np.arctan2(cross, dot))
        cosine, sine = np.cos(angle), np.sin(angle)
        apart = np.hypot(*(one @ np.array([[cosine, sine], [-sine, cosine]]) - other).T)
        weights = 1.0 / np.maximum(apart, 0.1)
    delta_rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    rotations: Float64Array = delta_rotation @ matrix_from_quaternion(known.quaternions_xyzw)
    return rotations
