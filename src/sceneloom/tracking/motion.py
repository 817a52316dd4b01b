r"""How objects move between two moments, and what a box reports their state: a Kalman filter over many objects.

A state is x = (middle 3, size 3, heading, velocity 3, yaw rate), in the world. Between moments objects keep their
velocity, which of vehicles rotates with them, and their yaw rate, which dies down; white noise of the acceleration
makes that uncertain, so that one long step leaves as much doubt as many short ones. A box z of the middle, size and
heading is read by Kalman's update,

    K = P Hᵀ (H P Hᵀ + w R)⁻¹,   x' = x + K (z - H x),   P' = P - K H P,   w = max(1, (ν + d²) / (ν + 7)),

where d² is the square of Mahalanobis' distance of the box and ν degrees of freedom: a box that is far off is taken for
less sure. A vehicle moves along its heading: that its velocity across is 0 is one more thing that is read of it.

Source: Kalman 1960; Bar-Shalom, Li and Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation",
ch. 6.2 for the noise and ch. 11.7 for rotating; Lange, Little and Taylor 1989, "Robust Statistical Modeling Using the t
Distribution", for the weight.
"""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.kernels import object_motion
from sceneloom.tracking.settings import TrackerSettings

SIZE, MEASURED = object_motion.SIZE, object_motion.MEASURED
YAW, ROTATION = 6, 10
FREEDOM = 4.0
"""Degrees of freedom of what boxes are off."""
CLIMB = 0.3
"""Deviation of vertical accelerations [m/s²]."""
SIZE_DRIFT = 0.02
"""How much sizes change as objects are seen from other sides [m after a second]."""
VEHICLE_HEADING_DRIFT, PERSON_HEADING_DRIFT = 0.02, 0.5
"""How much headings change beside rotating [rad after a second]."""
ACROSS = 0.3
"""Acceleration of vehicles across their heading, as a share of that along it."""
ROTATION_TIME = 1.0
"""Time after which a rotation has died down [s]."""


def wrapped(angles: Float64Array) -> Float64Array:
    """Angles as those from -π to π."""
    result: Float64Array = (angles + np.pi) % (2.0 * np.pi) - np.pi
    return result


def predicted(
    means: Float64Array,
    covariances: Float64Array,
    vehicles: BoolArray,
    seconds: float,
    settings: TrackerSettings,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Move states on.

    Args:
        means, covariances: (N, 11) and (N, 11, 11).
        vehicles: (N,), whether they move as vehicles do.
        seconds: how long.
        settings: how strongly they change their motion.

    Returns:
        Means and covariances afterwards, and the slopes (N, 11, 11) of the means.
    """
    fast, slow = settings.vehicle_acceleration, settings.person_acceleration
    rotating = settings.yaw_acceleration
    deviations = np.array(
        [
            [slow, slow, CLIMB, SIZE_DRIFT, PERSON_HEADING_DRIFT, rotating],
            [fast, ACROSS * fast, CLIMB, SIZE_DRIFT, VEHICLE_HEADING_DRIFT, rotating],
        ]
    )
    moved: tuple[Float64Array, Float64Array, Float64Array] = object_motion.predict(
        means, covariances, vehicles, seconds, ROTATION_TIME, deviations**2
    )
    return moved


def read(
    means: Float64Array,
    covariances: Float64Array,
    rows: Int64Array,
    measures: Float64Array,
    noises: Float64Array,
    columns: Int64Array,
) -> None:
    """Read of some states a box each, in place.

    Args:
        means, covariances: (N, 11) and (N, 11, 11).
        rows: (K,), which of them.
        measures, noises: (M, 7) and (M, 7, 7); headings off by more than a right angle are taken the other way round.
        columns: (K,), the box of each.
    """
    object_motion.read_boxes(means, covariances, rows, measures, noises, columns, FREEDOM)


def read_no_slip(
    means: Float64Array, covariances: Float64Array, vehicles: BoolArray, side_slip: float
) -> None:
    """Read of vehicles, in place, that they do not move across their heading, but for so much [m/s]."""
    object_motion.read_no_slip(means, covariances, vehicles, side_slip**2)
