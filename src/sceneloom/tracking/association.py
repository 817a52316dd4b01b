"""Which box is of which object: what a box says in space and in pictures, weighed together.

A box is as far from an object as the square of Mahalanobis' distance of their middles says, on the ground and in
height, plus what the pictures say: the share by which the box in the picture and the one that is foreseen there fail to
overlap, in its own deviations, squared. Boxes beyond the gate are not the object's. Of all ways to pair them the one is
taken whose distances to the gate add up to the most.

Source: Bar-Shalom, Li and Kirubarajan 2001, ch. 2.6 for the distance; Bernardin and Stiefelhagen 2008 for gates.
"""

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.assignment import best_columns
from sceneloom.scene.types import Identifier
from sceneloom.tracking.kinds import may_be_one
from sceneloom.tracking.picture_boxes import overlaps
from sceneloom.tracking.sightings import Sightings

OVERLAP_SIGMA = 0.25
"""Deviation of the share by which boxes in pictures fail to overlap that are one object's."""
LEAST_SIGMA = 0.3
"""No middle of a box is where it is expected to within less than this [m]."""
LEAST_OVERLAP = 0.3
"""An object takes a box of a picture alone that overlaps with its own by so much at least."""


def distances(
    means: Float64Array,
    covariances: Float64Array,
    codes: Int64Array,
    foreseen: dict[Identifier, Float64Array],
    seen: Sightings,
) -> Float64Array:
    """How far each box is from each object, (N, M) in squares of deviations; infinite where they cannot be one."""
    far = _in_space(means, covariances, seen)
    for camera_id, corners in seen.corners_xyxy.items():
        if camera_id in foreseen:
            shares = overlaps(foreseen[camera_id], corners)
            far += np.where(np.isnan(shares), 0.0, ((1.0 - shares) / OVERLAP_SIGMA) ** 2)
            alone = ~seen.measured & ~np.isnan(corners[:, 0])
            far[:, alone] = np.where(shares[:, alone] >= LEAST_OVERLAP, far[:, alone], np.inf)
    far[~may_be_one(codes, seen.codes)] = np.inf
    return far


def _in_space(means: Float64Array, covariances: Float64Array, seen: Sightings) -> Float64Array:
    apart = means[:, None, :3] - seen.measures[None, :, :3]
    spread = covariances[:, None, :3, :3] + seen.covariances[None, :, :3, :3] + LEAST_SIGMA**2 * np.eye(3)
    solved = np.linalg.solve(spread, apart[..., None])[..., 0]
    far: Float64Array = (apart * solved).sum(axis=2)
    return far


def pair(far: Float64Array, gate: float) -> tuple[Int64Array, Int64Array]:
    """Pair objects with boxes within the gate: (K,) rows and columns of (N, M) distances."""
    gains = np.where(far < gate, gate - far, 0.0)
    columns = best_columns(gains)
    rows = np.flatnonzero(columns >= 0)
    rows = rows[gains[rows, columns[rows]] > 0.0]
    return rows, columns[rows]
