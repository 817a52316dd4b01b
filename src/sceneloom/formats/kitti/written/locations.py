"""Where the sensors of a choice are in the world at each frame, and how they lie for a calibration file."""

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.formats.kitti.written.calibration_text import Mounted
from sceneloom.formats.kitti.written.choice import Choice
from sceneloom.geometry.rigid import RigidTransform

_IDENTICAL = 1e-12


def mounted_of(choice: Choice, *, with_imu: bool) -> Mounted:
    """How the sensors lie: one calibration for all frames.

    Args:
        choice: the sensors.
        with_imu: whether the file reports where the ego is.
    """
    inverse = choice.ego_from_lidar.inverse()
    return Mounted(
        {number: camera.camera for number, camera in choice.cameras.items()},
        {number: mount.inverse() @ choice.ego_from_lidar for number, mount in choice.ego_from_camera.items()},
        inverse if with_imu else None,
        choice.reference,
        choice.lidar is not None,
    )


def is_lidar(choice: Choice) -> bool:
    """Whether the ego is the lidar."""
    matrix = choice.ego_from_lidar.matrix
    return bool(np.abs(matrix - np.eye(4)).max() <= _IDENTICAL)


def egos_at(choice: Choice, timestamps_ns: Int64Array) -> list[RigidTransform]:
    """`world_from_ego` at each time; beyond the trajectory its end poses hold, and without one the ego stands."""
    if choice.ego_path is None:
        return [RigidTransform.identity()] * len(timestamps_ns)
    held = choice.ego_path.held(timestamps_ns)
    return [
        RigidTransform.from_quaternion(location, rotation)
        for location, rotation in zip(held.positions, held.quaternions_xyzw, strict=True)
    ]
