"""Calibration files of the object, tracking and odometry benchmarks: as they were read, where they still hold."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import SceneloomError
from sceneloom.formats.kitti.calibration import RECTIFIED_FROM_VELODYNE, read_calibration
from sceneloom.geometry.rigid import RigidTransform

CAMERAS = 4
_SAME = 1e-9
_NAMES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "object": ("R0_rect", "Tr_velo_to_cam", "Tr_imu_to_velo"),
        "tracking": ("R_rect", "Tr_velo_cam", "Tr_imu_velo"),
        "odometry": ("", RECTIFIED_FROM_VELODYNE, ""),
    }
)
"""What each benchmark calls the rectification, and where the lidar and the OXTS unit are."""

_PLAIN_NAMES = frozenset({"R_rect", "Tr_velo_cam", "Tr_imu_velo"})
"""Entries that stand without a colon behind."""


@dataclass(frozen=True, slots=True, eq=False)
class Mounted:
    """What a calibration says.

    Attributes:
        camera_models: by KITTI's number of the camera.
        camera_from_lidar: by number.
        lidar_from_imu: None where the ego is the lidar.
        reference: the camera whose frame is the rectified one; None without cameras.
        has_lidar: whether there is one; else its frame is the ego's, and files may position it elsewhere.
    """

    camera_models: Mapping[int, Camera]
    camera_from_lidar: Mapping[int, RigidTransform]
    lidar_from_imu: RigidTransform | None
    reference: int | None
    has_lidar: bool = True

    @property
    def rectified_from_lidar(self) -> RigidTransform:
        """Takes the lidar's frame into the one that labels are in, where no file says otherwise.

        Without cameras that is the frame of one that would look ahead from where the lidar is: labels stand upright in
        it.
        """
        if self.reference is None:
            return _AHEAD_FROM_LIDAR
        return self.camera_from_lidar[self.reference]


_AHEAD_FROM_LIDAR = RigidTransform(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.zeros(3))
"""x right, y down, z forward, out of x forward, y left, z up."""


def write_calibration(
    path: Path, benchmark: str, mounted: Mounted, kept: Mapping[str, Any] | None
) -> RigidTransform:
    """Write a calibration file; gives what takes the lidar's frame into the one that labels are in.

    Args:
        path: the file.
        benchmark: whose, which decides what entries are called.
        mounted: how the sensors lie.
        kept: entries that the scene was read with; they are written where they mean the same.
    """
    if kept:
        path.write_text(_text(_renamed(kept, benchmark)), "utf-8", newline="\n")
        found = _rectified_if_same(path, mounted)
        if found is not None:
            return found
    path.write_text(_text(_built(benchmark, mounted)), "utf-8", newline="\n")
    return mounted.rectified_from_lidar


def _rectified_if_same(path: Path, mounted: Mounted) -> RigidTransform | None:
    """What a file says of labels' frame, if it says the same as the scene of all else; None if not."""
    try:
        read = read_calibration(path)
        mounts = {number: read.camera_from_lidar(number) for number in mounted.camera_models}
        camera_models = {
            number: read.camera(number, (camera_model.width, camera_model.height))
            for number, camera_model in mounted.camera_models.items()
        }
    except (SceneloomError, KeyError):
        return None
    if not all(
        _same_camera_model(camera_models[number], camera_model)
        for number, camera_model in mounted.camera_models.items()
    ):
        return None
    between = files_lidar_from_lidar(mounts, read.lidar_from_imu, mounted)
    return None if between is None else read.rectified_from_lidar @ between


def files_lidar_from_lidar(
    camera_from_lidar: Mapping[int, RigidTransform], lidar_from_imu: RigidTransform | None, mounted: Mounted
) -> RigidTransform | None:
    """Compare how sensors lie in files with how they lie in a scene.

    Returns:
        What takes the scene's lidar frame into that of the files, which differ only where the scene has no lidar; None
        where sensors lie elsewhere.
    """
    same = RigidTransform.identity()
    between = same
    if not mounted.has_lidar:
        between = (lidar_from_imu or same) @ (mounted.lidar_from_imu or same).inverse()
    elif mounted.lidar_from_imu is not None and (
        lidar_from_imu is None or not _same(lidar_from_imu, mounted.lidar_from_imu)
    ):
        return None
    pairs = [
        (camera_from_lidar[number] @ between, mounted.camera_from_lidar[number])
        for number in mounted.camera_models
    ]
    return between if all(_same(a, b) for a, b in pairs) else None


def _same(a: RigidTransform, b: RigidTransform) -> bool:
    return bool(np.abs(a.matrix - b.matrix).max() <= _SAME)


def _same_camera_model(a: Camera, b: Camera) -> bool:
    return bool(np.abs(a.matrix - b.matrix).max() <= _SAME) and b.model == "pinhole"


def _renamed(kept: Mapping[str, Any], benchmark: str) -> dict[str, list[float]]:
    """Entries under the names of a benchmark; a rectified frame's rotation is multiplied in where it has no name."""
    meanings = {name: k for names in _NAMES.values() for k, name in enumerate(names) if name}
    found: dict[str, list[float]] = {}
    by_meaning: dict[int, Float64Array] = {}
    for name, row in kept.items():
        values = np.asarray(row, np.float64)
        if name in meanings:
            by_meaning[meanings[name]] = values
        elif name[:1] == "P" and name[1:].isdigit():
            found[name] = values.tolist()
    rectification, lidar, unit = _NAMES[benchmark]
    rotation = by_meaning.get(0)
    placed = by_meaning.get(1)
    if placed is not None and RECTIFIED_FROM_VELODYNE in kept:
        rotation = np.eye(3).reshape(-1)
    if placed is not None and not rectification and rotation is not None:
        placed = (rotation.reshape(3, 3) @ placed.reshape(3, 4)).reshape(-1)
    for name, numbers in ((rectification, rotation), (lidar, placed), (unit, by_meaning.get(2))):
        if name and numbers is not None:
            found[name] = numbers.tolist()
    return found


def _built(benchmark: str, mounted: Mounted) -> dict[str, list[float]]:
    """Entries that state what a scene says: the reference camera's frame is the rectified one."""
    base = mounted.rectified_from_lidar
    found = {}
    spare = next(
        iter(mounted.camera_models.values()),
        Camera("pinhole", 1242, 375, 721.5377, 721.5377, 609.5593, 172.854),
    )
    for number in range(CAMERAS):
        camera_model = mounted.camera_models.get(
            number, mounted.camera_models.get(mounted.reference or 0, spare)
        )
        shift = np.zeros(3)
        if number in mounted.camera_from_lidar and number != mounted.reference:
            shift = (mounted.camera_from_lidar[number] @ base.inverse()).translation
        found[f"P{number}"] = (
            np.column_stack([camera_model.matrix, camera_model.matrix @ shift]).reshape(-1).tolist()
        )
    rectification, lidar, unit = _NAMES[benchmark]
    if rectification:
        found[rectification] = np.eye(3).reshape(-1).tolist()
    found[lidar] = base.matrix[:3].reshape(-1).tolist()
    if unit and mounted.lidar_from_imu is not None:
        found[unit] = mounted.lidar_from_imu.matrix[:3].reshape(-1).tolist()
    return found


def _text(entries: Mapping[str, list[float]]) -> str:
    """The lines of a file, all digits."""
    lines = []
    for name, values in entries.items():
        colon = "" if name in _PLAIN_NAMES else ":"
        lines.append(f"{name}{colon} {' '.join(map(repr, values))}\n")
    return "".join(lines)
