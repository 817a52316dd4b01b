"""The pose path that a scene file gets for a sensor: thin, yet true to where the sensor was."""

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.geometry.interpolation import thin_poses
from sceneloom.motion.pose_source import PoseSource
from sceneloom.scene.poses import PosePath

_BETWEEN = 4
"""Looks between two poses of the path: a mounted sensor moves on an arc there, not on a line."""


def sensor_path(source: PoseSource, frame_times_ns: Int64Array) -> PosePath | None:
    """Give `world_from_sensor` at each frame's time, and wherever else interpolation would miss it.

    Between the first and the last frame the result stays within 1 mm and 0.01 degrees of the source.

    Args:
        frame_times_ns: (F,) int64 [ns]; times beyond the source's reach get no pose.

    Returns:
        The path, or None where no frame's time is within reach.
    """
    frames = np.unique(frame_times_ns)
    frames = frames[source.at(frames).coverage < 2]
    if len(frames) == 0:
        return None
    dense_ns = _dense_times(source.path.timestamps_ns, frames)
    dense = source.at(dense_ns)
    extra = thin_poses(dense_ns, dense.positions, dense.quaternions_xyzw, frames)
    times = np.union1d(frames, dense_ns[extra])
    poses = source.at(times)
    return PosePath(times, poses.positions, poses.quaternions_xyzw)


def _dense_times(path_ns: Int64Array, frames_ns: Int64Array) -> Int64Array:
    """The frames' times, the path's own between them, and a few between each two of all these."""
    inside = path_ns[(path_ns > frames_ns[0]) & (path_ns < frames_ns[-1])]
    knots = np.union1d(inside, frames_ns)
    steps = np.diff(knots)
    between = [knots[:-1] + steps * part // _BETWEEN for part in range(1, _BETWEEN)]
    return np.unique(np.concatenate([knots, *between]))
