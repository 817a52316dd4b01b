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
FREEDOM = 4.0
"""Degrees of freedom of what boxes are off: their tails are heavier than a normal distribution's."""
LEAST_OVERLAP = 0.3
"""An object takes a box of a picture alone that overlaps with its own by so much at least."""
FITTING_OVERLAP = 0.4


def gains(
    means: Float64Array,
    covariances: Float64Array,
    codes: Int64Array,
    foreseen: dict[Identifier, Float64Array],
    seen: Sightings,
    density: float,
) -> Float64Array:
    """How much likelier it is that each box is of each object than that it is of something else, (N, M) logarithms."""
    gained = _in_space(means, covariances, seen) - np.log(density) + np.minimum(seen.log_odds, 0.0)
    for camera_id, corners in seen.corners_xyxy.items():
        if camera_id in foreseen:
            shares = overlaps(foreseen[camera_id], corners)
            off = heavy(((1.0 - shares) / OVERLAP_SIGMA) ** 2, 1) - heavy(
                (FITTING_OVERLAP / OVERLAP_SIGMA) ** 2, 1
            )
            gained -= np.where(np.isnan(shares), 0.0, off / 2.0)
            alone = ~seen.measured & ~np.isnan(corners[:, 0])
            gained[:, alone] = np.where(shares[:, alone] >= LEAST_OVERLAP, gained[:, alone], 0.0)
    gained[~may_be_one(codes, seen.codes)] = 0.0
    return np.maximum(gained, 0.0)


def _in_space(means: Float64Array, covariances: Float64Array, seen: Sightings) -> Float64Array:
    apart = means[:, None, :3] - seen.measures[None, :, :3]
    spread = covariances[:, None, :3, :3] + seen.covariances[None, :, :3, :3] + LEAST_SIGMA**2 * np.eye(3)
    solved = np.linalg.solve(spread, apart[..., None])[..., 0]
    area = spread[..., 0, 0] * spread[..., 1, 1] - spread[..., 0, 1] ** 2
    far: Float64Array = heavy((apart * solved).sum(axis=2), 3)
    return -np.log(2.0 * np.pi) - 0.5 * (np.log(area) + far)


def heavy(squares: Float64Array, count: int) -> Float64Array:
    """Squares of deviations as a distribution with heavy tails takes them: near 0 the same, far away their logarithm."""
    return (FREEDOM + count) * np.log1p(squares / FREEDOM)


def pair(gained: Float64Array) -> tuple[Int64Array, Int64Array]:
    """Pair objects with boxes: (K,) rows and columns of (N, M) gains, 0 for what is no pair."""
    columns = best_columns(gained)
    rows = np.flatnonzero(columns >= 0)
    rows = rows[gained[rows, columns[rows]] > 0.0]
    return rows, columns[rows]
