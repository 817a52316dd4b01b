"""Which satellite receivers of a scene tell where it was."""

import numpy as np

from sceneloom.arrays import BoolArray
from sceneloom.scene import GnssSensor, Scene

HIGHEST = 1e6
"""Heights beyond it [m] no receiver tells that is carried by an ego; NaN stands for one that is not told."""


def gnss_receivers(scene: Scene) -> tuple[GnssSensor, ...]:
    """The receivers of a scene that have at least two usable fixes."""
    return tuple(s for s in scene.sensors if isinstance(s, GnssSensor) and usable_fixes(s).sum() >= 2)


def usable_fixes(receiver: GnssSensor) -> BoolArray:
    """(N,) fixes that are places; a receiver without reception tells 0, 0."""
    latitude, longitude, height = receiver.positions_lla.T
    usable: BoolArray = (np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 360.0)
    usable &= (latitude != 0.0) | (longitude != 0.0)
    usable &= np.isnan(height) | (np.abs(height) <= HIGHEST)
    return usable
