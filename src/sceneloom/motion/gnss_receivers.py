"""Which satellite receivers of a scene report where it was."""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.scene import Scene

HIGHEST = 1e6
"""Heights beyond it [m] no receiver reports that is carried by an ego; NaN stands for one that is not reported."""


def gnss_receivers(scene: Scene) -> tuple[GnssSensor, ...]:
    """The receivers of a scene that have at least two usable fixes."""
    return tuple(s for s in scene.sensors if isinstance(s, GnssSensor) and usable_fixes(s).sum() >= 2)


def usable_fixes(receiver: GnssSensor) -> BoolArray:
    """(N,) fixes that are locations; a receiver without reception reports 0, 0."""
    latitude, longitude, height = receiver.positions_lla.T
    usable: BoolArray = (np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 360.0)
    usable &= (latitude != 0.0) | (longitude != 0.0)
    usable &= np.isnan(height) | (np.abs(height) <= HIGHEST)
    return usable


def usable_positions(receiver: GnssSensor) -> tuple[Int64Array, Float64Array]:
    """The rows (M,) of usable fixes, and their locations (M, 3): latitude, longitude [deg] and height [m].

    A height that is not reported is the median of those that are, 0 where none is.
    """
    rows = np.flatnonzero(usable_fixes(receiver))
    locations = receiver.positions_lla[rows]
    untold = np.isnan(locations[:, 2])
    locations[untold, 2] = 0.0 if untold.all() else np.median(locations[~untold, 2])
    return rows, locations
