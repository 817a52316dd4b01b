"""Lidar points into the world: every point by the sensor's pose at the point's own time."""

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import PoseError
from sceneloom.geometry.rotations import rotate_vectors
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.pose_source import PoseSource


def points_to_world(frame: LidarFrame, source: PoseSource) -> tuple[Float64Array, bool]:
    """Take the points of one sweep from the sensor's frame into the world, undoing the motion during the sweep.

    Args:
        frame: points in the frame that `source.mount` mounts; without point times all have the frame's time.

    Returns:
        positions_world: (N, 3) float64 [m].
        extrapolated: whether poses beyond the path's ends were used.

    Raises:
        PoseError: a point's time lies beyond the reach of the path.
    """
    times = frame.points.timestamps_ns
    if times is None or len(times) == 0:
        times = np.full(len(frame.points), frame.timestamp_ns, np.int64)
    if len(times) == 0:
        return np.zeros((0, 3)), False
    span_ns = np.array([times.min(), times.max()], np.int64)
    knots_ns = _knots_within(source.path.timestamps_ns, span_ns)
    body = source.path.interpolate(knots_ns, reach_ns=source.reach_ns)
    if (body.coverage == 2).any():
        raise PoseError(
            f"points from {span_ns[0]} to {span_ns[1]} ns; the poses reach from "
            f"{source.path.start_ns} to {source.path.stop_ns} ns and {source.reach_ns} ns beyond"
        )
    extrapolated = bool((body.coverage == 1).any())
    positions = frame.points.positions
    if len(knots_ns) == 1:
        moved = source.mount.apply(positions)
        return rotate_vectors(body.quaternions_xyzw, moved) + body.positions, extrapolated
    from sceneloom.kernels.path_transform import transform_by_path

    positions_world = np.empty((len(positions), 3))
    transform_by_path(
        np.ascontiguousarray(positions),
        np.ascontiguousarray(times),
        np.ascontiguousarray(source.mount.matrix[:3]),
        knots_ns,
        body.positions,
        body.quaternions_xyzw,
        positions_world,
    )
    return positions_world, extrapolated


def _knots_within(path_ns: Int64Array, span_ns: Int64Array) -> Int64Array:
    """The path's own times inside the span, and the span's ends."""
    first, last = np.searchsorted(path_ns, span_ns, side="right")
    return np.unique(np.concatenate([span_ns, path_ns[first:last]]))
