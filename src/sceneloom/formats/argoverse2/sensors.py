"""The sensors of a log: two lidars whose points stand in one file, and cameras."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.table import MODELS
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.argoverse2.feather import POSE_COLUMNS, poses_of, read_columns
from sceneloom.formats.argoverse2.spec import CAMERA_MODELS, CAMERAS, LIDAR, MOUNTS
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.rig.images import ImageReader
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.pose_source import poses_along
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Sensor
from sceneloom.scene.types import PointsFrame
from sceneloom.scene.warnings import WarningKind

UP, DOWN, BOTH = "up_lidar", "down_lidar", "lidar"
_LASERS = {UP: (0, 32), DOWN: (32, 64), BOTH: (0, 256)}
"""The numbers of the lasers of each lidar. That the first half is the upper one's shows in the data: seen from its
lidar, and not from the other, every laser keeps its elevation."""

_POINT_COLUMNS = {
    **dict.fromkeys("xyz", np.float32),
    "intensity": np.uint8,
    "laser_number": np.uint8,
    "offset_ns": np.int32,
}
_CAMERA_MODEL_COLUMNS = {
    "sensor_name": str,
    **dict.fromkeys(("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3"), np.float64),
    **dict.fromkeys(("height_px", "width_px"), np.int64),
}


def read_mounts(log: Path, ledger: Ledger) -> dict[str, RigidTransform]:
    """`ego_from_sensor` by the sensor's name; {} in a lenient reading without them.

    Raises:
        DataError: the file is missing or wrong.
    """
    path = log / MOUNTS
    try:
        columns = read_columns(path, {"sensor_name": str, **POSE_COLUMNS})
        positions, quaternions = poses_of(path, columns)
    except DataError as error:
        ledger.fault("mountings-missing", error)
        return {}
    return {
        name: RigidTransform.from_quaternion(positions[k], quaternions[k])
        for k, name in enumerate(columns["sensor_name"].tolist())
    }


@dataclass(frozen=True, slots=True, eq=False)
class SweepFiles:
    """Reads the sweeps of one lidar out of files that hold those of both.

    Points were moved to where the ego was at the timestamp, which therefore is the time of all of them; when each was
    measured stands in `extras` as `offset_ns` from the timestamp.

    Attributes:
        files: of each sweep.
        timestamps_ns: (N,) int64 [ns].
        sensor_id: whose points: `UP`, `DOWN` or `BOTH`.
    """

    files: tuple[Path, ...]
    timestamps_ns: Int64Array
    sensor_id: str

    def __call__(self, k: int) -> LidarFrame:
        """Read sweep `k`.

        Raises:
            DataError: its file is missing, cut off or has other columns.
        """
        columns = read_columns(self.files[k], _POINT_COLUMNS)
        low, high = _LASERS[self.sensor_id]
        chosen = (columns["laser_number"] >= low) & (columns["laser_number"] < high)
        own: dict[str, AnyArray] = {name: column[chosen] for name, column in columns.items()}
        timestamp_ns = int(self.timestamps_ns[k])
        points = LidarPoints(
            positions=read_only(np.stack([own[axis] for axis in "xyz"], axis=1)),
            intensities=read_only(own["intensity"]),
            timestamps_ns=read_only(np.full(int(chosen.sum()), timestamp_ns, np.int64)),
            rings=read_only(own["laser_number"], np.uint16),
            extras=MappingProxyType({"offset_ns": read_only(own["offset_ns"])}),
        )
        return LidarFrame(timestamp_ns, points, MappingProxyType({"file": f"{LIDAR}/{self.files[k].name}"}))


def build_lidars(
    log: Path, mounts: Mapping[str, RigidTransform], path: Poses | None, *, one_lidar: bool, ledger: Ledger
) -> list[Sensor]:
    """Build the upper and the lower lidar, or one that stands for both.

    Raises:
        DataError: there is no sweep, or a mounting is missing.
    """
    found = _timestamped_files(log / LIDAR, ".feather")
    if not found:
        raise DataError(log / LIDAR, "", "no sweep; expected files such as 315966265259836000.feather")
    timestamps_ns = np.array([timestamp for timestamp, _ in found], np.int64)
    files = tuple(file for _, file in found)
    if one_lidar:
        message = "points of two lidars are given as those of one, mounted where the upper one is"
        ledger.note(WarningKind.ASSUMED, "lidars-joined", str(log / LIDAR), message)
    sensors: list[Sensor] = []
    for name in (BOTH,) if one_lidar else (UP, DOWN):
        mount = _mount(log, mounts, UP if one_lidar else name, ledger)
        sensors.append(
            LidarSensor(
                id=name,
                frames=LazyFrames(timestamps_ns, SweepFiles(files, timestamps_ns, name)),
                poses=_poses(path, mount, timestamps_ns),
                mount=mount,
                points_frame=PointsFrame.EGO,
            )
        )
    return sensors


def _mount(
    log: Path, mounts: Mapping[str, RigidTransform], name: str, ledger: Ledger
) -> RigidTransform | None:
    if name not in mounts:
        problem = f"no sensor {name!r}; it has {', '.join(mounts) or 'none'}"
        ledger.fault("mountings-missing", DataError(log / MOUNTS, "", problem))
    return mounts.get(name)


def _poses(path: Poses | None, mount: RigidTransform | None, timestamps_ns: Int64Array) -> Poses | None:
    if mount is None:
        return None
    return poses_along(path, {0: mount}, np.zeros(len(timestamps_ns), np.int64), timestamps_ns)


def build_cameras(
    log: Path, mounts: Mapping[str, RigidTransform], path: Poses | None, *, distorted: bool, ledger: Ledger
) -> list[Sensor]:
    """Build the cameras that have a camera model, with their images as far as there are.

    () where no camera model is reported.

    Args:
        log: the folder.
        mounts: `ego_from_sensor`.
        path: `world_from_ego`.
        distorted: use the coefficients of the camera models, which the images, being undistorted, do not show any more.
        ledger: takes warnings.

    Raises:
        DataError: a file is wrong, or images have no camera model.
    """
    folders = sorted(child.name for child in (log / CAMERAS).glob("*") if child.is_dir())
    if not (log / CAMERA_MODELS).is_file():
        if folders:
            problem = f"is not there; expected the camera models of {', '.join(folders)}"
            ledger.fault(
                "camera-models-missing", DataError(log / CAMERA_MODELS, "", problem), count=len(folders)
            )
        return []
    try:
        columns = read_columns(log / CAMERA_MODELS, _CAMERA_MODEL_COLUMNS)
    except DataError as error:
        ledger.fault("camera-models-missing", error, count=len(folders))
        return []
    names = columns["sensor_name"].tolist()
    unknown = sorted(set(folders) - set(names))
    if unknown:
        problem = f"no camera {unknown[0]!r}; it has {', '.join(names) or 'none'}"
        ledger.fault("camera-models-missing", DataError(log / CAMERA_MODELS, "", problem), count=len(unknown))
    _note_cameras(log, names, folders, distorted=distorted, ledger=ledger)
    return [
        _camera(
            log,
            {key: column[k] for key, column in columns.items()},
            _mount(log, mounts, names[k], ledger),
            path,
            distorted=distorted,
        )
        for k in range(len(names))
    ]


def _note_cameras(
    log: Path, names: list[str], folders: list[str], *, distorted: bool, ledger: Ledger
) -> None:
    without = [name for name in names if name not in folders]
    if without:
        message = f"no images of {', '.join(without)}; only camera model and mounting are known"
        ledger.note(WarningKind.SKIPPED, "images-missing", str(log / CAMERAS), message, count=len(without))
    if not distorted:
        message = (
            "images of this data set are undistorted: k1, k2 and k3 are in the cameras' extras and not used"
        )
        ledger.note(WarningKind.ASSUMED, "undistorted", str(log / CAMERA_MODELS), message, count=len(names))


def _camera(
    log: Path,
    row: Mapping[str, Any],
    mount: RigidTransform | None,
    path: Poses | None,
    *,
    distorted: bool,
) -> CameraSensor:
    name = str(row["sensor_name"])
    fx, fy, cx, cy = (float(row[f"{key}_px"]) for key in ("fx", "fy", "cx", "cy"))
    size = int(row["width_px"]), int(row["height_px"])
    model = "brown_conrady" if distorted else "pinhole"
    try:
        camera_model = Camera(model, *size, fx, fy, cx, cy, _camera_model_numbers(row, distorted=distorted))
    except CalibrationError as error:
        raise DataError(log / CAMERA_MODELS, name, str(error)) from error
    found = _timestamped_files(log / CAMERAS / name, ".jpg")
    timestamps_ns = np.array([timestamp for timestamp, _ in found], np.int64)
    files = tuple(file for _, file in found)
    names = tuple(f"{CAMERAS}/{name}/{file.name}" for file in files)
    return CameraSensor(
        id=name,
        camera=camera_model,
        images=LazyFrames(timestamps_ns, ImageReader(files, names, timestamps_ns, camera_model)),
        poses=_poses(path, mount, timestamps_ns) if found else None,
        mount=mount,
        extras=MappingProxyType({name: float(row[name]) for name in ("k1", "k2", "k3")}),
    )


def _camera_model_numbers(row: Mapping[str, Any], *, distorted: bool) -> tuple[float, ...]:
    """Coefficients k1 k2 p1 p2 k3 … of `brown_conrady`, or none."""
    if not distorted:
        return ()
    known = {name: float(row[name]) for name in ("k1", "k2", "k3")}
    return tuple(known.get(name, 0.0) for name in MODELS["brown_conrady"].coefficient_names)


def _timestamped_files(folder: Path, suffix: str) -> list[tuple[int, Path]]:
    """The files of a folder that are named after their time [ns], in its order.

    Raises:
        DataError: one is named otherwise.
    """
    found = []
    for file in folder.glob(f"*{suffix}"):
        if not (
            file.stem.isascii() and file.stem.isdigit() and len(file.stem) < 20 and int(file.stem) < 1 << 63
        ):
            problem = f"expected files named after their time in nanoseconds, as 315966265259836000{suffix}"
            raise DataError(file, "", problem)
        found.append((int(file.stem), file))
    return sorted(found)
