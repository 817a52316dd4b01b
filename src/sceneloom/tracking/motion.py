r"""How objects move between two moments, and what a box tells of their state: a Kalman filter over many objects.

A state is x = (middle 3, size 3, heading, velocity 3, turn rate), in the world. Between moments objects keep their
velocity, which turns with them, and their turn rate; white noise of the acceleration makes that uncertain, so that one
long step leaves as much doubt as many short ones. A box z of the middle, size and heading is read by Kalman's update.
A vehicle moves along its heading: that its velocity across is 0 is one more thing that is known of it.

Source: Kalman 1960; Bar-Shalom, Li and Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation",
ch. 6.2 for the noise, ch. 11.7 for turning.
"""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.tracking.settings import TrackerSettings

SIZE = 11
MEASURED = 7
YAW, TURN = 6, 10
_CLIMB = 0.3
"""Deviation of vertical accelerations [m/s²]."""
_SIZE_DRIFT = 0.02
"""How much sizes change as they are seen from other sides [m after a second]."""
_HEADING_DRIFT = (0.02, 0.5)
"""How much headings change without turning, of vehicles and people [rad after a second]."""
_ACROSS = 0.3
"""Acceleration of vehicles across their heading, as a share of that along it."""
_TURN_DECAY = 1.0
"""Time after which a turn has died down [s]."""


FREEDOM = 4.0


def wrapped(angles: Float64Array) -> Float64Array:
    """Angles as those from -π to π."""
    result: Float64Array = (angles + np.pi) % (2.0 * np.pi) - np.pi
    return result


def transition(means: Float64Array, vehicles: BoolArray, seconds: float) -> tuple[Float64Array, Float64Array]:
    """Move states on.

    Args:
        means: (N, 11).
        vehicles: (N,), whether their velocity turns with them.
        seconds: how long.

    Returns:
        Means afterwards, and the slopes (N, 11, 11) of them.
    """
    slopes = np.broadcast_to(np.eye(SIZE), (len(means), SIZE, SIZE)).copy()
    moved = means.copy()
    decay = np.exp(-seconds / _TURN_DECAY)
    angles = np.where(vehicles, means[:, TURN] * seconds, 0.0)
    cosines, sines = np.cos(angles), np.sin(angles)
    across = np.column_stack([-means[:, 8], means[:, 7]])
    turned = means[:, 7:9] * cosines[:, None] + across * sines[:, None]
    moved[:, 0:2] += (means[:, 7:9] + turned) * (seconds / 2.0)
    moved[:, 2] += means[:, 9] * seconds
    moved[:, YAW] = wrapped(means[:, YAW] + means[:, TURN] * seconds)
    moved[:, 7:9] = turned
    moved[:, TURN] *= decay
    slopes[:, (0, 1, 2), (7, 8, 9)] = seconds
    slopes[:, YAW, TURN] = seconds
    slopes[:, TURN, TURN] = decay
    slopes[:, 7, 7] = slopes[:, 8, 8] = cosines
    slopes[:, 7, 8], slopes[:, 8, 7] = -sines, sines
    lever = np.where(vehicles, seconds, 0.0)
    slopes[:, 7:9, TURN] = lever[:, None] * across
    slopes[:, 0:2, TURN] = (lever * seconds / 2.0)[:, None] * across
    return moved, slopes


def process_noise(
    means: Float64Array, vehicles: BoolArray, seconds: float, settings: TrackerSettings
) -> Float64Array:
    """How uncertain a step of so long makes states, (N, 11, 11)."""
    noise = np.zeros((len(means), SIZE, SIZE))
    along = np.where(vehicles, settings.vehicle_acceleration, settings.person_acceleration) ** 2
    across = np.where(vehicles, _ACROSS**2, 1.0) * along
    cosines, sines = np.cos(means[:, YAW]), np.sin(means[:, YAW])
    accelerations = np.zeros((len(means), 3, 3))
    accelerations[:, 0, 0] = along * cosines**2 + across * sines**2
    accelerations[:, 1, 1] = along * sines**2 + across * cosines**2
    accelerations[:, 0, 1] = accelerations[:, 1, 0] = (along - across) * cosines * sines
    accelerations[:, 2, 2] = _CLIMB**2
    noise[:, :3, :3] = accelerations * (seconds**3 / 3.0)
    noise[:, :3, 7:10] = noise[:, 7:10, :3] = accelerations * (seconds**2 / 2.0)
    noise[:, 7:10, 7:10] = accelerations * seconds
    noise[:, (3, 4, 5), (3, 4, 5)] = _SIZE_DRIFT**2 * seconds
    turning = settings.turn_acceleration**2
    noise[:, YAW, YAW] = np.where(vehicles, *_HEADING_DRIFT) ** 2 * seconds + turning * seconds**3 / 3.0
    noise[:, YAW, TURN] = noise[:, TURN, YAW] = turning * seconds**2 / 2.0
    noise[:, TURN, TURN] = turning * seconds
    return noise


def updated(
    means: Float64Array, covariances: Float64Array, measures: Float64Array, noises: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Read one box for each state.

    Args:
        means, covariances: (N, 11) and (N, 11, 11).
        measures, noises: (N, 7) and (N, 7, 7); headings off by more than a right angle are taken the other way round.
    """
    if len(means) == 0:
        return means, covariances
    apart = measures - means[:, :MEASURED]
    turns = wrapped(apart[:, YAW])
    apart[:, YAW] = turns - np.pi * np.round(turns / np.pi)
    crossed = covariances[:, :, :MEASURED]
    spread = crossed[:, :MEASURED] + noises
    squares = (apart[:, None] @ np.linalg.solve(spread, apart[:, :, None]))[:, 0, 0]
    wider = np.maximum((FREEDOM + squares) / (FREEDOM + MEASURED), 1.0)
    spread = crossed[:, :MEASURED] + noises * wider[:, None, None]
    gains = np.linalg.solve(spread, crossed.transpose(0, 2, 1)).transpose(0, 2, 1)
    means = means + (gains @ apart[:, :, None])[:, :, 0]
    means[:, YAW] = wrapped(means[:, YAW])
    covariances = covariances - gains @ crossed.transpose(0, 2, 1)
    return means, (covariances + covariances.transpose(0, 2, 1)) / 2.0


def along_heading(
    means: Float64Array, covariances: Float64Array, side_slip: float
) -> tuple[Float64Array, Float64Array]:
    """Read of vehicles that they do not move across their heading, but for so much [m/s]."""
    cosines, sines = np.cos(means[:, YAW]), np.sin(means[:, YAW])
    slopes = np.zeros((len(means), SIZE))
    slopes[:, 7], slopes[:, 8] = -sines, cosines
    across = (slopes[:, 7:9] * means[:, 7:9]).sum(axis=1)
    slopes[:, YAW] = -(cosines * means[:, 7] + sines * means[:, 8])
    spread = (covariances @ slopes[:, :, None])[:, :, 0]
    gains = spread / ((slopes * spread).sum(axis=1) + side_slip**2)[:, None]
    means = means - gains * across[:, None]
    return means, covariances - gains[:, :, None] * spread[:, None]
