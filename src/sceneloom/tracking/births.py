"""Objects that are seen for the first time: which boxes stand for one, and what is known of it."""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.scene.tracks import Support
from sceneloom.tracking import motion
from sceneloom.tracking.picture_boxes import overlaps
from sceneloom.tracking.population import ByCamera, Population
from sceneloom.tracking.sightings import Sightings

TWIN_OVERLAP = 0.5
"""Boxes in a picture that overlap by more than this stand for one object."""
TWIN_SHARE = 0.5
"""So do boxes whose middles are nearer to each other than this share of a width."""
_AT_ONCE = 256
"""So many boxes are compared with one another at once."""
SPEEDS = ((10.0, 2.0), (1.5, 1.5))
"""Deviation of the speed of what is seen for the first time, along and across its heading: vehicles, people [m/s]."""
CLIMB, TURN = 0.3, 0.2
"""The same of climbing [m/s] and turning [rad/s]."""


def unclaimed(seen: Sightings, free: BoolArray, objects: Population) -> Int64Array:
    """Give the rows of free boxes that are no second box of an object of this moment, nor of one another.

    Args:
        seen: the boxes of the moment.
        free: (M,), which of them are no object's, and likely enough.
        objects: those with a box at this moment.
    """
    rows = np.flatnonzero(free)
    if len(rows) and len(objects):
        measured = objects.supports != Support.PICTURE
        rows = rows[~_twins(seen, rows, objects.means, measured, objects.corners_xyxy).any(axis=1)]
    rows = rows[np.argsort(-seen.log_odds[rows], kind="stable")]
    kept = [np.zeros(0, np.int64)]
    while len(rows):
        first, rows = rows[:_AT_ONCE], rows[_AT_ONCE:]
        first = first[_surest(_twins_of(seen, first, first))]
        rows = rows[~_twins_of(seen, rows, first).any(axis=1)]
        kept.append(first)
    return np.concatenate(kept)


def _surest(twins: BoolArray) -> BoolArray:
    """Of things in the order of how sure they are those without a surer twin that is kept: (N,) bool of (N, N)."""
    kept = np.ones(len(twins), np.bool_)
    for k in range(1, len(twins)):
        kept[k] = not (twins[k, :k] & kept[:k]).any()
    return kept


def _twins_of(seen: Sightings, rows: Int64Array, others: Int64Array) -> BoolArray:
    corners = {camera_id: boxes[others] for camera_id, boxes in seen.corners_xyxy.items()}
    return _twins(seen, rows, seen.measures[others], seen.measured[others], corners)


def _twins(
    seen: Sightings, rows: Int64Array, numbers: Float64Array, measured: BoolArray, corners: ByCamera
) -> BoolArray:
    """Which boxes (N) are second boxes of which things (M): (N, M).

    Of two that sweeps place apart one may stand before the other, however they overlap in a picture.
    """
    apart = np.hypot(
        seen.measures[rows, None, 0] - numbers[None, :, 0], seen.measures[rows, None, 1] - numbers[None, :, 1]
    )
    twins: BoolArray = seen.measured[rows, None] & (apart < TWIN_SHARE * numbers[None, :, 4])
    placed = seen.measured[rows, None] & measured[None]
    for camera_id, boxes in seen.corners_xyxy.items():
        if camera_id in corners:
            twins |= ~placed & (overlaps(boxes[rows], corners[camera_id]) > TWIN_OVERLAP)
    return twins


def states(seen: Sightings, rows: Int64Array) -> tuple[Float64Array, Float64Array]:
    """States of objects that are seen for the first time, (K, 11) and (K, 11, 11) of `motion`."""
    means = np.zeros((len(rows), motion.SIZE))
    covariances = np.zeros((len(rows), motion.SIZE, motion.SIZE))
    means[:, :7], covariances[:, :7, :7] = seen.measures[rows], seen.covariances[rows]
    covariances[:, 6, 6] = np.minimum(covariances[:, 6, 6], np.pi**2)
    told = np.isfinite(seen.velocities[rows]).all(axis=1)
    means[told, 7:10] = seen.velocities[rows[told]]
    along, across = np.where(seen.vehicles[rows], *(np.array(SPEEDS)[..., None] ** 2))
    across = np.where(seen.measured[rows], across, along)
    cosines, sines = np.cos(means[:, 6]), np.sin(means[:, 6])
    covariances[:, 7, 7] = along * cosines**2 + across * sines**2
    covariances[:, 8, 8] = along * sines**2 + across * cosines**2
    covariances[:, 7, 8] = covariances[:, 8, 7] = (along - across) * cosines * sines
    covariances[:, 9, 9], covariances[:, 10, 10] = CLIMB**2, TURN**2
    return means, covariances
