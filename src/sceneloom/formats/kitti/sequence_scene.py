"""A sequence of KITTI's tracking benchmark as a scene into which labels are put."""

import numpy as np

from sceneloom.errors import OptionError
from sceneloom.formats.kitti.tracking_folder import CAMERA_ID, KittiSequence
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates

EGO_ID = "ego"
"""What the sensor is called whose trajectory is that of the OXTS unit."""


def _no_image(number: int) -> CameraImage:
    raise OptionError(f"image {number}: the sequence has none")


def sequence_scene(sequence: KittiSequence, *, source: str = "kitti") -> Scene:
    """Give the ego trajectory and the camera model and mounting of the camera; lists of detections come without images.

    Where the trajectory of the OXTS unit or its location is not known, the ego is the lidar, and stands at the origin.

    Args:
        sequence: what is known of it.
        source: where it comes from, for messages.
    """
    ego_from_lidar, path = RigidTransform.identity(), Poses.identity()
    if sequence.world_from_ego is not None and sequence.lidar_from_imu is not None:
        ego_from_lidar, path = sequence.lidar_from_imu.inverse(), sequence.world_from_ego
    mount = ego_from_lidar @ sequence.camera_from_lidar.inverse()
    camera = CameraSensor(
        CAMERA_ID,
        sequence.camera,
        LazyFrames(np.zeros(0, np.int64), _no_image),
        poses=Poses(np.zeros(1, np.int64), mount.translation[None], mount.quaternion_xyzw[None]),
        mount=mount,
        coordinates=Coordinates.EGO,
        parent_id=EGO_ID,
    )
    return Scene((OdometrySensor(EGO_ID, path), camera), source=source, format="kitti")
