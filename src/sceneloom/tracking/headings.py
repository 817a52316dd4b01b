"""Which way round objects head: boxes, their motion and their neighbours vote.

Detectors know the axis of a box better than its front, and the outline in an image is the same both ways round. Each
box votes for its own heading, each moment of motion for its direction; the sum is remembered. Neighbours of the lane
whose heading is known are asked anew each time, and count only where the rest is undecided.
"""

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.tracking import motion
from sceneloom.tracking.observations import Observations
from sceneloom.tracking.population import Population

MOST_VOTES = 5.0
"""So many looks at a heading are remembered."""
MOVING = 1.5
"""What is faster than this shows by its motion where it heads [m/s]."""
SURE_HEADING = 1.0
"""A heading with a larger variance than this says nothing [rad²]."""
OUTVOTED = -1.0
"""With fewer votes than this a heading is reversed."""
NEIGHBOURS = 2.0
"""So many votes have the neighbours together."""
KNOWN = 3.0
"""So many votes make a neighbour's heading known."""
HALF_LANE, AHEAD = 1.75, 50.0
"""How far across and along its heading a neighbour of the same lane is [m]."""
PARALLEL = 0.95
"""Least cosine between the axes of neighbours."""


def rotation_round(objects: Population, rows: Int64Array, seen: Observations, columns: Int64Array) -> None:
    """Let boxes, motion and neighbours vote on headings, in place, and rotate those round that are outvoted.

    Args:
        objects: all of them.
        rows: (K,), those of which a box was seen.
        seen: boxes.
        columns: (K,), the box of each.
    """
    sure = seen.covariances[columns, 6, 6] < SURE_HEADING
    rows, columns = rows[sure], columns[sure]
    objects.heading_votes[rows] += np.cos(seen.measures[columns, 6] - objects.means[rows, motion.YAW])
    headings = objects.means[:, motion.YAW]
    forward = np.cos(headings) * objects.means[:, 7] + np.sin(headings) * objects.means[:, 8]
    objects.heading_votes += np.sign(forward) * (np.abs(forward) > MOVING)
    objects.heading_votes = np.clip(objects.heading_votes, -MOST_VOTES, MOST_VOTES)
    doubtful = np.flatnonzero(objects.vehicles & (objects.heading_votes < OUTVOTED + NEIGHBOURS))
    votes = objects.heading_votes[doubtful]
    wrong = np.union1d(
        doubtful[votes + NEIGHBOURS * _of_neighbours(objects, doubtful) < OUTVOTED],
        np.flatnonzero(~objects.vehicles & (objects.heading_votes < OUTVOTED)),
    )
    objects.means[wrong, motion.YAW] = motion.wrapped(objects.means[wrong, motion.YAW] + np.pi)
    objects.heading_votes[wrong] *= -1.0


def _of_neighbours(objects: Population, rows: Int64Array) -> Float64Array:
    """How much vehicles of the same lane speak for the headings of some, (K,), from -1 to 1."""
    known = np.flatnonzero(objects.vehicles & (objects.heading_votes >= KNOWN))
    apart = objects.means[known, :2] - objects.means[rows, None, :2]
    headings = objects.means[rows, motion.YAW, None]
    cosines, sines = np.cos(headings), np.sin(headings)
    along = cosines * apart[..., 0] + sines * apart[..., 1]
    across = cosines * apart[..., 1] - sines * apart[..., 0]
    rotations = np.cos(objects.means[known, motion.YAW] - headings)
    of_lane = (np.abs(across) < HALF_LANE) & (np.abs(along) < AHEAD) & (np.abs(rotations) > PARALLEL)
    reported: Float64Array = np.clip(np.sum(rotations, axis=1, where=of_lane), -1.0, 1.0)
    return reported
