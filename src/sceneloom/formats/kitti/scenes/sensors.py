"""Lidars and cameras of KITTI's folders, placed along the way of the ego."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.formats.kitti.scenes.numbered import NumberedFiles
from sceneloom.formats.kitti.scenes.sweeps import SweepFiles, TurnTimes, scale_of
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.rig.pictures import PictureReader
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor, Picture
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.notices import NoticeKind
from sceneloom.scene.pose_source import poses_along
from sceneloom.scene.poses import PosePath, Trajectory

LIDAR_ID = "velodyne"
STANDING = "standing"
"""The name of a way that is none: the ego stands still, since nothing tells how it moved."""


def camera_id(number: int) -> str:
    """What a camera is called: its number is that of KITTI's."""
    return f"camera{number}"


def lidar_sensor(
    files: NumberedFiles,
    stamps_ns: Int64Array,
    mount: RigidTransform,
    path: PosePath | None,
    ledger: Ledger,
    *,
    turns: TurnTimes | None = None,
) -> LidarSensor:
    """The lidar.

    Args:
        files: its sweeps.
        stamps_ns: of each, (N,) int64 [ns].
        mount: `ego_from_lidar`.
        path: `world_from_ego`, or None.
        ledger: told if the reflectance has another scale.
        turns: when sweeps began and ended.

    Raises:
        DataError: the first sweep is wrong.
    """
    stamps = read_only(stamps_ns)
    reader = SweepFiles(files.paths, files.names, stamps, scale_of(files.paths[0], ledger), turns)
    return LidarSensor(
        LIDAR_ID,
        LazyFrames(stamps, reader),
        poses=poses_along(path, {0: mount}, np.zeros(len(stamps), np.int64), stamps),
        mount=mount,
    )


def camera_sensor(
    number: int,
    files: NumberedFiles,
    stamps_ns: Int64Array,
    lens: Camera,
    mount: RigidTransform,
    path: PosePath | None,
) -> CameraSensor:
    """A camera whose pictures have one lens and one mounting; it may have no pictures.

    Args:
        number: KITTI's.
        files: its pictures.
        stamps_ns: of each, (N,) int64 [ns].
        lens: of all pictures.
        mount: `ego_from_camera`.
        path: `world_from_ego`, or None.
    """
    stamps = read_only(stamps_ns)
    pictures: LazyFrames[Picture] = LazyFrames(stamps, PictureReader(files.paths, files.names, stamps, lens))
    return CameraSensor(
        camera_id(number),
        lens,
        pictures,
        poses=poses_along(path, {0: mount}, np.zeros(len(stamps), np.int64), stamps),
        mount=mount,
    )


def standing(stamps_ns: Int64Array, place: Path | str, reason: str, ledger: Ledger) -> Trajectory:
    """The way of an ego that stands still, with a notice: boxes need a world, and nothing tells the ego's way in it.

    Args:
        stamps_ns: (N,) int64 [ns], N >= 1, of all that is placed.
        place: for the notice.
        reason: why the way is not known.
        ledger: told of it.
    """
    ledger.note(
        NoticeKind.ASSUMED, "ego-stands", str(place), f"{reason}: boxes are placed as if the ego stood still"
    )
    times = np.unique(np.array([stamps_ns.min(), stamps_ns.max()], np.int64))
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
    return Trajectory(STANDING, read_only(times), read_only(np.zeros((len(times), 3))), read_only(turns))


def kitti_metadata(benchmark: str, **told: Any) -> Mapping[str, Any]:
    """What a scene keeps of where it was read: `metadata["kitti"]`, and how the angles of its boxes are meant.

    Args:
        benchmark: "raw", "object", "tracking" or "odometry".
        told: further fields; those that are None are left out.
    """
    from sceneloom.formats.kitti.scenes.boxes import ANGLES

    about = {"benchmark": benchmark, **{name: value for name, value in told.items() if value is not None}}
    return MappingProxyType({"sceneloom": dict(ANGLES), "kitti": about})
