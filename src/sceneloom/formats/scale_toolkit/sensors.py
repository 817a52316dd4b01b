"""Lidar, radar and cameras of a folder."""

from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.clouds.points import PointMapping, detect_scale
from sceneloom.formats.clouds.roles import find_roles
from sceneloom.formats.clouds.table import read_cloud
from sceneloom.formats.files import read_bytes
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.pandaset.text_files import read_json
from sceneloom.formats.quaternion_lengths import lengths_of
from sceneloom.formats.rig.images import IMAGE_SUFFIXES, ImageReader, image_size
from sceneloom.formats.rig.sweep_reader import SweepReader
from sceneloom.formats.scale_toolkit.frame_names import frame_names
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarFrame, RadarPoints, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.pose_source import poses_along
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Sensor
from sceneloom.scene.types import PointsFrame
from sceneloom.scene.warnings import WarningKind

_CAMERA_MODEL = ("fx", "fy", "cx", "cy")
_RADAR_COLUMNS = 7
_LARGEST = 1e9
"""No location and no speed of a return is larger than this."""


def read_pose(path: Path) -> RigidTransform:
    """Read `heading` [w, x, y, z] and `position` [x, y, z].

    Raises:
        DataError: the file is missing, a value is missing, or the heading is no rotation.
    """
    record = read_json(path, dict[str, Any])
    heading, position = (
        _numbers(path, record, name, count) for name, count in (("heading", 4), ("position", 3))
    )
    norms, is_off = lengths_of(heading[None])
    if is_off[0]:
        raise DataError(
            path, "heading", f"{heading.tolist()} has the length {norms[0]:.4f}; expected w, x, y, z of 1"
        )
    return RigidTransform.from_quaternion(position, heading[[1, 2, 3, 0]])


def _numbers(path: Path, record: dict[str, Any], name: str, count: int) -> Float64Array:
    values = record.get(name)
    fits = isinstance(values, list) and len(values) == count
    if not (fits and all(isinstance(v, float | int) and not isinstance(v, bool) for v in values or ())):
        raise DataError(path, name, f"{values!r}; expected {count} numbers")
    return np.array(values, np.float64)


def build_lidar(clouds: dict[str, Path], timestamps_ns: Int64Array, trajectory: Poses | None) -> LidarSensor:
    """Build the lidar; its points are in the ego's frame. The first file is read, to see how bright it is.

    Raises:
        DataError: the first cloud is wrong.
    """
    files = tuple(clouds.values())
    first = read_cloud(files[0])
    name = find_roles(first.columns, {}).get("intensity")
    scale = None if name is None else detect_scale(first.columns[name])
    reader = SweepReader(
        files=files,
        names=tuple(f"{file.parent.name}/{file.name}" for file in files),
        clocks_ns=np.stack([timestamps_ns, timestamps_ns], axis=1),
        timestamps_ns=timestamps_ns,
        zero_ns=0,
        layout=None,
        mapping=PointMapping(scale=scale),
    )
    return LidarSensor(
        id="lidar",
        frames=LazyFrames(timestamps_ns, reader),
        poses=_placed(trajectory, RigidTransform.identity(), timestamps_ns),
        mount=RigidTransform.identity(),
        points_frame=PointsFrame.EGO,
        extras=MappingProxyType({} if scale is None else {"intensity_max": scale.maximum}),
    )


def _placed(trajectory: Poses | None, mount: RigidTransform, timestamps_ns: Int64Array) -> Poses | None:
    return poses_along(trajectory, {0: mount}, np.zeros(len(timestamps_ns), np.int64), timestamps_ns)


def build_camera(
    folder: Path, times: dict[str, int], trajectory: Poses | None, ledger: Ledger
) -> CameraSensor:
    """Build a camera; images of frames without a cloud are left out and reported.

    Raises:
        DataError: calibration or images are missing or wrong.
    """
    found = frame_names(folder, IMAGE_SUFFIXES)
    kept = {name: file for name, file in found.items() if name in times}
    _note_without(ledger, folder, "images", len(found) - len(kept))
    if not kept:
        raise DataError(folder, "", "no image with the name of a cloud; expected such as pointcloud/ has")
    files, timestamps_ns = tuple(kept.values()), np.array([times[name] for name in kept], np.int64)
    mount = read_pose(folder / "extrinsics.json")
    record = read_json(folder / "intrinsics.json", dict[str, Any])
    camera = _camera_model(folder / "intrinsics.json", record, image_size(files[0]))
    further = {name: value for name, value in record.items() if name not in _CAMERA_MODEL}
    if further:
        message = f"{', '.join(further)}: kept in the camera's extras, and not used"
        ledger.note(WarningKind.SKIPPED, "camera-model-entries", str(folder / "intrinsics.json"), message)
    names = tuple(f"cameras/{folder.name}/{file.name}" for file in files)
    return CameraSensor(
        id=folder.name,
        camera=camera,
        images=LazyFrames(timestamps_ns, ImageReader(files, names, timestamps_ns, camera)),
        poses=_placed(trajectory, mount, timestamps_ns),
        mount=mount,
        extras=MappingProxyType(further),
    )


def _note_without(ledger: Ledger, folder: Path, what: str, count: int) -> None:
    if count:
        message = f"{what} of frames without a cloud are left out"
        ledger.note(WarningKind.SKIPPED, f"{what}-without-cloud", str(folder), message, count=count)


def _camera_model(path: Path, record: dict[str, Any], size: tuple[int, int]) -> Camera:
    values = [record.get(name) for name in _CAMERA_MODEL]
    if not all(isinstance(v, float | int) and not isinstance(v, bool) for v in values):
        raise DataError(path, "", f"fx, fy, cx, cy are {values}; expected numbers")
    fx, fy, cx, cy = (float(v) for v in values if v is not None)
    try:
        return Camera("pinhole", *size, fx, fy, cx, cy)
    except CalibrationError as error:
        raise DataError(path, "", str(error)) from error


@dataclass(frozen=True, slots=True, eq=False)
class CycleTexts:
    """Reads the cycles of the radar, which are lines of text.

    Attributes:
        files: of each cycle.
        timestamps_ns: (N,) int64 [ns].
    """

    files: tuple[Path, ...]
    timestamps_ns: Int64Array

    def __call__(self, k: int) -> RadarFrame:
        """Read cycle `k`: position, direction and size of each point.

        Raises:
            DataError: a line is no seven numbers.
        """
        rows = _radar_rows(self.files[k])
        norms = np.linalg.norm(rows[:, 3:6], axis=1)
        directions = np.where(norms[:, None] > 0, rows[:, 3:6], [1.0, 0.0, 0.0])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        points = RadarPoints(
            read_only(rows[:, :3], np.float32),
            read_only(directions, np.float32),
            read_only(np.where(norms > 0, rows[:, 6], 0.0), np.float32),
            extras=MappingProxyType({"direction_as_given": read_only(rows[:, 3:6])}),
        )
        name = MappingProxyType({"file": f"radar_points/{self.files[k].name}"})
        return RadarFrame(int(self.timestamps_ns[k]), points, name)


def _radar_rows(path: Path) -> Float64Array:
    rows = []
    for number, line in enumerate(read_bytes(path).decode("latin-1").splitlines(), 1):
        if not line.strip():
            continue
        try:
            row = [float(word) for word in line.split(",")]
        except ValueError:
            row = []
        if len(row) != _RADAR_COLUMNS or not np.abs(row).max() <= _LARGEST:
            raise DataError(
                path, f"line {number}", f"{line[:60]!r}; expected x, y, z, direction x, y, z, size"
            )
        rows.append(row)
    return np.array(rows, np.float64).reshape(-1, _RADAR_COLUMNS)


def build_radar(
    folder: Path, times: dict[str, int], trajectory: Poses | None, ledger: Ledger
) -> list[Sensor]:
    """Build the radar; [] where there are no points of one."""
    found = frame_names(folder, (".txt",))
    kept = {name: file for name, file in found.items() if name in times}
    _note_without(ledger, folder, "radar-points", len(found) - len(kept))
    if not kept:
        return []
    timestamps_ns = np.array([times[name] for name in kept], np.int64)
    return [
        RadarSensor(
            id="radar",
            frames=LazyFrames(timestamps_ns, CycleTexts(tuple(kept.values()), timestamps_ns)),
            poses=_placed(trajectory, RigidTransform.identity(), timestamps_ns),
            mount=RigidTransform.identity(),
            points_frame=PointsFrame.EGO,
        )
    ]
