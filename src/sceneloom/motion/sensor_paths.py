"""The pose path that a scene file gets for a sensor: thin, yet true to where the sensor was."""

from itertools import groupby

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.geometry.interpolation import thin_poses
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.depth import DepthFrame
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses

_BETWEEN = 4
"""Looks between two poses of the path: a mounted sensor moves on an arc there, not on a line."""

_FRAMES_AT_ONCE = 256
"""Poses between two frames depend on nothing beyond these, so long drives are looked at piece by piece."""


def sensor_path(source: PoseSource, frame_times_ns: Int64Array) -> Poses | None:
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
    starts = range(0, len(frames) - 1, _FRAMES_AT_ONCE)
    between = [_times_between(source, frames[k : k + _FRAMES_AT_ONCE + 1]) for k in starts]
    times = np.unique(np.concatenate([frames, *between]))
    poses = source.at(times)
    return Poses(times, poses.positions, poses.quaternions_xyzw)


def camera_path(source: PoseSource, images: LazyFrames[CameraImage] | LazyFrames[DepthFrame]) -> Poses | None:
    """Give `world_from_camera` as `sensor_path` does, each image's pose by its own mounting where it has one.

    Raises:
        DataError: an image's record cannot be read.
    """
    if source.own:
        return sensor_path(source, images.timestamps_ns)
    mounts = [image.mount for image in images]
    timestamped = zip(images.timestamps_ns.tolist(), mounts, strict=True)
    paths = []
    for _, run in groupby(timestamped, key=lambda entry: _key(entry[1])):
        times, same = zip(*run, strict=True)
        path = sensor_path(source.mounted(same[0]), np.array(times, np.int64))
        if path is not None:
            paths.append(path)
    return _joined(paths) if paths else None


def _key(mount: RigidTransform | None) -> bytes:
    return b"" if mount is None else mount.matrix.tobytes()


def _joined(paths: list[Poses]) -> Poses:
    """One path after the other; of poses at one time the first counts."""
    times, rows = np.unique(np.concatenate([path.timestamps_ns for path in paths]), return_index=True)
    return Poses(
        times,
        np.concatenate([path.positions for path in paths])[rows],
        np.concatenate([path.quaternions_xyzw for path in paths])[rows],
    )


def _times_between(source: PoseSource, frames_ns: Int64Array) -> Int64Array:
    """The times between some frames at which interpolation between the frames' poses would miss the sensor."""
    dense_ns = _dense_times(source.path.timestamps_ns, frames_ns)
    dense = source.at(dense_ns)
    return dense_ns[thin_poses(dense_ns, dense.positions, dense.quaternions_xyzw, frames_ns)]


def _dense_times(path_ns: Int64Array, frames_ns: Int64Array) -> Int64Array:
    """The frames' times, the path's own between them, and a few between each two of all these."""
    first, last = np.searchsorted(path_ns, frames_ns[[0, -1]])
    knots = np.union1d(path_ns[first:last], frames_ns)
    steps = np.diff(knots)
    between = [knots[:-1] + steps * part // _BETWEEN for part in range(1, _BETWEEN)]
    return np.unique(np.concatenate([knots, *between]))
