"""What a detector could see of the objects of some classes: where they are, and how much hides them."""

from collections.abc import Collection

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.scene.detections import Boxes3D
from sceneloom.scene.types import PointsFrame
from sceneloom.simulate.boxes import boxes_of
from sceneloom.simulate.street import Street


def objects_at(street: Street, time_ns: int, labels: Collection[str]) -> tuple[Boxes3D, Int64Array]:
    """Give the exact boxes of all objects of some classes, in the world frame with score 1, and their instances."""
    every = boxes_of(street, np.array([time_ns], np.int64))
    wanted = np.array([label in labels for label in every.labels], np.bool_)
    rows = np.flatnonzero(wanted & every.present[0])
    boxes = Boxes3D(
        time_ns,
        every.centers_world[0, rows],
        every.sizes_lwh[rows],
        every.yaws[0, rows],
        np.ones(len(rows)),
        tuple(every.labels[row] for row in rows),
        velocities=every.velocities[0, rows],
        frame=PointsFrame.WORLD,
    )
    return boxes, every.instances[rows]


def hidden_shares(seen: Float64Array, alone: Int64Array, instances: Int64Array) -> Float64Array:
    """Report which share of each object is hidden behind others.

    Args:
        seen: (N,) float64, points or pixels on each object.
        alone: how many it would have if nothing else were there, by instance number - 1.
        instances: (N,) int64, which they are.

    Returns:
        (N,) float64, 0 in plain view to 1.
    """
    shares: Float64Array = 1.0 - seen / np.maximum(1, alone[instances - 1])
    return np.clip(shares, 0.0, 1.0)
