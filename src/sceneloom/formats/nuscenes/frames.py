"""Sweeps, radar cycles and images of nuScenes, each read when it is asked for."""

from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError
from sceneloom.formats.clouds.bin import read_bin
from sceneloom.formats.clouds.cloud import Cloud
from sceneloom.formats.clouds.layout import NUSCENES
from sceneloom.formats.clouds.pcd import read_pcd
from sceneloom.formats.rig.images import ImageFile, is_jpeg
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarFrame, LidarPoints, RadarFrame, RadarPoints

Facts = tuple[tuple[str, Any], ...]
"""What the tables state about a file, as pairs of name and value."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameFiles:
    """The files of one sensor.

    Attributes:
        files: of each frame.
        timestamps_ns: (N,) int64 [ns].
        facts: of each frame, for its `extras`.
    """

    files: tuple[Path, ...]
    timestamps_ns: Int64Array
    facts: tuple[Facts, ...]

    def timestamp(self, k: int) -> int:
        """The time of frame `k` [ns]."""
        return int(self.timestamps_ns[k])

    def extras(self, k: int) -> MappingProxyType[str, Any]:
        """What the tables state about frame `k`."""
        return MappingProxyType(dict(self.facts[k]))


@dataclass(frozen=True, slots=True, eq=False)
class SweepFiles:
    """Reads the sweeps of a lidar; every row of a file stays a point, since labels count the rows."""

    frames: FrameFiles

    def __call__(self, k: int) -> LidarFrame:
        """Read sweep `k`.

        Raises:
            DataError: the file is missing, cut off or no cloud.
        """
        return LidarFrame(
            self.frames.timestamp(k), _lidar_points(self.frames.files[k]), self.frames.extras(k)
        )


def _lidar_points(file: Path) -> LidarPoints:
    is_pcd = file.suffix.lower() == ".pcd"
    cloud = read_pcd(file) if is_pcd else read_bin(file, layout=NUSCENES)
    extras: dict[str, AnyArray] = {}
    return LidarPoints(
        positions=_positions(cloud),
        intensities=_whole(cloud, "intensity", np.uint8, extras),
        rings=_whole(cloud, "ring", np.uint16, extras),
        extras=MappingProxyType(extras),
    )


def _positions(cloud: Cloud) -> Float32Array:
    missing = [axis for axis in "xyz" if axis not in cloud.columns]
    if missing:
        problem = f"no column {' or '.join(missing)}; it has {' '.join(cloud.columns) or 'none'}"
        raise DataError(cloud.file, "", problem)
    return read_only(np.stack([cloud.columns[axis] for axis in "xyz"], axis=1), np.float32)


def _whole(cloud: Cloud, name: str, dtype: type[Any], extras: dict[str, AnyArray]) -> Any:
    """A column as whole numbers; what that changes of it is kept beside it."""
    column = cloud.columns.get(name)
    if column is None:
        return None
    limit = np.iinfo(dtype)
    rounded = np.clip(np.rint(np.nan_to_num(column, nan=0.0)), limit.min, limit.max)
    if not np.array_equal(rounded, column):
        extras[name] = read_only(column)
    return read_only(rounded, dtype)


@dataclass(frozen=True, slots=True, eq=False)
class CycleFiles:
    """Reads the cycles of a radar."""

    frames: FrameFiles

    def __call__(self, k: int) -> RadarFrame:
        """Read cycle `k`.

        Raises:
            DataError: the file is missing, cut off or no cloud.
        """
        cloud = _returns(read_pcd(self.frames.files[k]))
        positions = _positions(cloud)
        directions, lengths = _velocities(cloud, positions)
        further = {name: read_only(c) for name, c in cloud.columns.items() if name not in "xyz"}
        points = RadarPoints(positions, directions, lengths, extras=MappingProxyType(further))
        return RadarFrame(self.frames.timestamp(k), points, self.frames.extras(k))


def _returns(cloud: Cloud) -> Cloud:
    """The returns of a cycle: one without any has a single row that is no number.

    Source: class RadarPointCloud of the development kit.
    """
    first = [cloud.columns[axis][:1] for axis in "xyz" if axis in cloud.columns]
    if not any(np.isnan(value).any() for value in first):
        return cloud
    return Cloud(cloud.file, 0, {name: column[:0] for name, column in cloud.columns.items()})


def _velocities(cloud: Cloud, positions: Float32Array) -> tuple[Float32Array | None, Float32Array | None]:
    """Direction and length of `vx`, `vy`; what does not move points along the line of sight.

    Source: class RadarPointCloud of the development kit: vx and vy are measured, vx_comp and vy_comp compensated.
    """
    if not {"vx", "vy"} <= cloud.columns.keys():
        return None, None
    velocities = np.zeros((cloud.count, 3))
    velocities[:, 0], velocities[:, 1] = cloud.columns["vx"], cloud.columns["vy"]
    lengths = np.linalg.norm(velocities, axis=1)
    distances = np.linalg.norm(positions.astype(np.float64), axis=1)
    directions = np.tile([1.0, 0.0, 0.0], (cloud.count, 1))
    placed, moving = distances > 0, lengths > 0
    directions[placed] = positions[placed] / distances[placed, None]
    directions[moving] = velocities[moving] / lengths[moving, None]
    return read_only(directions, np.float32), read_only(lengths, np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class ImageFiles:
    """Reads the images of a camera.

    Attributes:
        cameras: camera model of each image.
        mounts: `ego_from_camera` of each image, None where it is the camera's.
    """

    frames: FrameFiles
    cameras: tuple[Camera, ...]
    mounts: tuple[RigidTransform | None, ...]

    def __call__(self, k: int) -> CameraImage:
        """Make image `k` without decoding it."""
        camera = self.cameras[k]
        file = ImageFile(self.frames.files[k], camera.width, camera.height)
        encoded = file.encoded if is_jpeg(file.path) else None
        return CameraImage(
            self.frames.timestamp(k),
            camera,
            file,
            self.mounts[k],
            extras=self.frames.extras(k),
            encoded=encoded,
        )
