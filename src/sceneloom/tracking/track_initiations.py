"""Objects that are seen for the first time: which boxes stand for one, and what is known of it."""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.kernels.twin_boxes import without_twins
from sceneloom.scene.tracks import Support
from sceneloom.tracking import motion
from sceneloom.tracking.observations import Observations
from sceneloom.tracking.population import ByCamera, Population, no_boxes

TWIN_OVERLAP = 0.5
"""Boxes in an image that overlap by more than this stand for one object."""
TWIN_SHARE = 0.5
"""So do boxes whose middles are nearer to each other than this share of a width."""
_LOCATION = [0, 1, 4]
"""What says where a box is on the ground, and how wide."""
SPEEDS = ((10.0, 2.0), (1.5, 1.5))
"""Deviation of the speed of what is seen for the first time, along and across its heading: vehicles, people [m/s]."""
CLIMB, ROTATION = 0.3, 0.2
"""The same of climbing [m/s] and rotating [rad/s]."""


def unclaimed(seen: Observations, free: BoolArray, objects: Population) -> Int64Array:
    """Give the rows of free boxes that are no second box of an object of this moment, nor of one another.

    Args:
        seen: the boxes of the moment.
        free: (M,), which of them are no object's, and likely enough.
        objects: those with a box at this moment.
    """
    rows = np.flatnonzero(free)
    rows = rows[np.argsort(-seen.log_odds[rows], kind="stable")]
    known = {name: objects.corners_xyxy.get(name, no_boxes(len(objects))) for name in seen.corners_xyxy}
    kept: Int64Array = without_twins(
        rows,
        np.ascontiguousarray(seen.measures[:, _LOCATION]),
        seen.measured,
        _stacked(seen.corners_xyxy, len(seen)),
        np.ascontiguousarray(objects.means[:, _LOCATION]),
        objects.supports != Support.IMAGE,
        _stacked(known, len(objects)),
        TWIN_SHARE,
        TWIN_OVERLAP,
    )
    return kept


def _stacked(corners: ByCamera, count: int) -> Float64Array:
    """Boxes of all images, (C, N, 4)."""
    return np.array(list(corners.values())).reshape(len(corners), count, 4)


def states(seen: Observations, rows: Int64Array) -> tuple[Float64Array, Float64Array]:
    """States of objects that are seen for the first time, (K, 11) and (K, 11, 11) of `motion`."""
    means = np.zeros((len(rows), motion.SIZE))
    covariances = np.zeros((len(rows), motion.SIZE, motion.SIZE))
    means[:, :7], covariances[:, :7, :7] = seen.measures[rows], seen.covariances[rows]
    covariances[:, 6, 6] = np.minimum(covariances[:, 6, 6], np.pi**2)
    reported = np.isfinite(seen.velocities[rows]).all(axis=1)
    means[reported, 7:10] = seen.velocities[rows[reported]]
    along, across = np.where(seen.vehicles[rows], *(np.array(SPEEDS)[..., None] ** 2))
    across = np.where(seen.measured[rows], across, along)
    cosines, sines = np.cos(means[:, 6]), np.sin(means[:, 6])
    covariances[:, 7, 7] = along * cosines**2 + across * sines**2
    covariances[:, 8, 8] = along * sines**2 + across * cosines**2
    covariances[:, 7, 8] = covariances[:, 8, 7] = (along - across) * cosines * sines
    covariances[:, 9, 9], covariances[:, 10, 10] = CLIMB**2, ROTATION**2
    return means, covariances
