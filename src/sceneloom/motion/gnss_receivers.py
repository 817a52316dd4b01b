"""Which satellite receivers of a scene tell where it was."""

import numpy as np

from sceneloom.arrays import BoolArray
from sceneloom.scene import GnssSensor, Scene


def gnss_receivers(scene: Scene) -> tuple[GnssSensor, ...]:
    """The receivers of a scene that have at least two usable fixes."""
    return tuple(s for s in scene.sensors if isinstance(s, GnssSensor) and usable_fixes(s).sum() >= 2)


def usable_fixes(receiver: GnssSensor) -> BoolArray:
    """(N,) fixes that are places; a receiver without reception tells 0, 0."""
    latitude, longitude = receiver.positions_lla[:, 0], receiver.positions_lla[:, 1]
    with np.errstate(invalid="ignore"):
        usable: BoolArray = (np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 360.0)
    usable &= (latitude != 0.0) | (longitude != 0.0)
    return usable
