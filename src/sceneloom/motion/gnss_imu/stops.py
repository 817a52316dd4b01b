"""When the ego stands, as fixes and IMU report together, and what is known then: that it neither moves nor rotates."""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.kernels.motion_chain import VELOCITY
from sceneloom.motion.gnss_imu.chain import BodySpeeds, RelativePoses
from sceneloom.motion.gnss_imu.robust import Fit
from sceneloom.motion.gnss_imu.samples import InertialSamples
from sceneloom.motion.stationary import QUIET_FORCE, QUIET_RATE, WHITE

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
