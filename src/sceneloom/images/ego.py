"""Where the ego stands in an image of a cloud, and which way it faces."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, FloatArray
from sceneloom.colouring.results import FusedView
from sceneloom.geometry.rigid import RigidTransform

_AROUND = 5.0
_MOVED = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class EgoPosition:
    """A location on the ego trajectory.

    Attributes:
        position_world: (3,) float64 [m].
        forward_world: (3,) float64, unit, level.
    """

    position_world: Float64Array
    forward_world: Float64Array

    def arrow(self, length: float) -> Float64Array:
        """Give the (4, 3) corners of a level arrowhead of that length [m] around the position."""
        left = np.array([-self.forward_world[1], self.forward_world[0], 0.0])
        shape = np.array([[0.6, 0.0], [-0.4, 0.36], [-0.22, 0.0], [-0.4, -0.36]]) * length
        return np.asarray(self.position_world + shape[:, :1] * self.forward_world + shape[:, 1:] * left)


def find_ego(
    world_from_ego: RigidTransform | None, ego_path: FloatArray | None, views: Sequence[FusedView]
) -> EgoPosition | None:
    """Find where the ego stands and which way it faces, by what is known; None where nothing is.

    The axes of an ego frame need not point along the car (it may be the frame of an IMU mounted in any way), so
    forward is where the path leads; of an ego that is stationary, where its first camera looks.

    Args:
        ego_path: (K, 3) float [m], the trajectory through the world.
        views: what cameras saw; they stand in for an ego that is not known.
    """
    poses = [
        pose for pose in (world_from_ego, *(view.world_from_camera for view in views)) if pose is not None
    ]
    if not poses:
        return None
    position = poses[0].translation
    directions = [] if ego_path is None else [_path_direction(ego_path, position)]
    directions += [view.world_from_camera.rotation[:, 2] for view in views[:1]]
    directions += [pose.rotation[:, 0] for pose in poses[:1]]
    return EgoPosition(position, _first_level(directions))


def middle_of(points_world: Float64Array) -> EgoPosition:
    """Give the middle of (N, 3) points [m], facing along x of the world, instead of an ego that is not known."""
    middle = np.median(points_world, axis=0) if len(points_world) else np.zeros(3)
    return EgoPosition(middle, np.array([1.0, 0.0, 0.0]))


def _path_direction(ego_path: FloatArray, position_world: Float64Array) -> Float64Array:
    """Give where the path leads around a location [m]; zero where it hardly moves there."""
    known = ego_path[np.isfinite(ego_path).all(axis=1)].astype(np.float64)
    if len(known) < 2:
        return np.zeros(3)
    nearest = int(np.argmin(np.linalg.norm(known - position_world, axis=1)))
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(known, axis=0), axis=1))])
    first = int(np.searchsorted(lengths, lengths[nearest] - _AROUND))
    last = int(np.searchsorted(lengths, lengths[nearest] + _AROUND, side="right")) - 1
    step = known[last] - known[first]
    return step if np.linalg.norm(step[:2]) >= _MOVED else np.zeros(3)


def _first_level(directions: Sequence[Float64Array]) -> Float64Array:
    """Give the first direction that is not upright, made level; x of the world if none."""
    for direction in directions:
        length = float(np.hypot(direction[0], direction[1]))
        if length > 0.1:
            return np.array([direction[0] / length, direction[1] / length, 0.0])
    return np.array([1.0, 0.0, 0.0])
