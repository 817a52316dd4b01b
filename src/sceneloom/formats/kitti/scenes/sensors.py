"""Lidars and cameras of KITTI's folders, placed along the ego trajectory."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.formats.kitti.scenes.numbered import NumberedFiles
from sceneloom.formats.kitti.scenes.sweeps import RotationTimes, SweepFiles, scale_of
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.rig.images import ImageReader
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.pose_source import poses_along
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.warnings import WarningKind

LIDAR_ID = "velodyne"
STATIONARY = "stationary"
"""The name of a trajectory that is none: the ego is stationary, since nothing reports how it moved."""


def camera_id(number: int) -> str:
    """What a camera is called: its number is that of KITTI's."""
    return f"camera{number}"


def lidar_sensor(
    files: NumberedFiles,
    timestamps_ns: Int64Array,
    mount: RigidTransform,
    path: Poses | None,
    ledger: Ledger,
    *,
    rotations: RotationTimes | None = None,
) -> LidarSensor:
    """The lidar.

    Args:
        files: its sweeps.
        timestamps_ns: of each, (N,) int64 [ns].
        mount: `ego_from_lidar`.
        path: `world_from_ego`, or None.
        ledger: reported if the reflectance has another scale.
        rotations: when sweeps began and ended.

    Raises:
        DataError: the first sweep is wrong.
    """
    timestamps = read_only(timestamps_ns)
    reader = SweepFiles(files.paths, files.names, timestamps, scale_of(files.paths[0], ledger), rotations)
    return LidarSensor(
        LIDAR_ID,
        LazyFrames(timestamps, reader),
        poses=poses_along(path, {0: mount}, np.zeros(len(timestamps), np.int64), timestamps),
        mount=mount,
    )


def camera_sensor(
    number: int,
    files: NumberedFiles,
    timestamps_ns: Int64Array,
    camera_model: Camera,
    mount: RigidTransform,
    path: Poses | None,
) -> CameraSensor:
    """A camera whose images have one camera model and one mounting; it may have no images.

    Args:
        number: KITTI's.
        files: its images.
        timestamps_ns: of each, (N,) int64 [ns].
        camera_model: of all images.
        mount: `ego_from_camera`.
        path: `world_from_ego`, or None.
    """
    timestamps = read_only(timestamps_ns)
    images: LazyFrames[CameraImage] = LazyFrames(
        timestamps, ImageReader(files.paths, files.names, timestamps, camera_model)
    )
    return CameraSensor(
        camera_id(number),
        camera_model,
        images,
        poses=poses_along(path, {0: mount}, np.zeros(len(timestamps), np.int64), timestamps),
        mount=mount,
    )


def stationary(timestamps_ns: Int64Array, location: Path | str, reason: str, ledger: Ledger) -> Trajectory:
    """The trajectory of an ego that is stationary, with a warning: boxes need a world.

    And nothing reports the ego trajectory in it.

    Args:
        timestamps_ns: (N,) int64 [ns], N >= 1, of all that is placed.
        location: for the warning.
        reason: why the trajectory is not known.
        ledger: reported it.
    """
    ledger.note(
        WarningKind.ASSUMED,
        "ego-stands",
        str(location),
        f"{reason}: boxes are placed as if the ego was stationary",
    )
    times = np.unique(np.array([timestamps_ns.min(), timestamps_ns.max()], np.int64))
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
    return Trajectory(
        STATIONARY, read_only(times), read_only(np.zeros((len(times), 3))), read_only(rotations)
    )


def kitti_metadata(benchmark: str, **reported: Any) -> Mapping[str, Any]:
    """What a scene keeps of where it was read: `metadata["kitti"]`, and how the angles of its boxes are meant.

    Args:
        benchmark: "raw", "object", "tracking" or "odometry".
        reported: further fields; those that are None are left out.
    """
    from sceneloom.formats.kitti.scenes.boxes import ANGLES

    about = {"benchmark": benchmark, **{name: value for name, value in reported.items() if value is not None}}
    return MappingProxyType({"sceneloom": dict(ANGLES), "kitti": about})
