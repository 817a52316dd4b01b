"""What is known of an ego on wheels: it moves along one axis of its own, neither sideways nor up."""

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.motion_chain import ROTATION, VELOCITY
from sceneloom.motion.gnss_imu.chain import BodySpeeds, Chain, States
from sceneloom.motion.gnss_imu.robust import Fit
from sceneloom.motion.gnss_imu.samples import InertialSamples

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
    slopes[:, ROTATION] = np.cross(axes, u)
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
