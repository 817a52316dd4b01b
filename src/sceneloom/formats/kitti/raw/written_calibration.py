"""The three calibration files of a day, of the sensors that are written."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import SceneloomError
from sceneloom.formats.kitti.raw.calibration import CAM_TO_CAM, IMU_TO_VELO, VELO_TO_CAM, read_raw_calibration
from sceneloom.formats.kitti.written.calibration_text import CAMERAS, Mounted, files_lidar_from_lidar
from sceneloom.geometry.rigid import RigidTransform

_SPARE = Camera("pinhole", 1242, 375, 721.5377, 721.5377, 609.5593, 172.854)


def write_raw_calibration(
    folder: Path, mounted: Mounted, kept: Mapping[str, Any] | None, *, rectified: bool
) -> None:
    """Write the files: as the scene was read with them where they still hold, else such that state the same.

    Args:
        folder: of the day.
        mounted: how the sensors lie.
        kept: what stood in the files that the scene was read with.
        rectified: whether images are rectified.
    """
    if kept and all(isinstance(texts, Mapping) for texts in kept.values()):
        for name, texts in kept.items():
            if name in (CAM_TO_CAM, VELO_TO_CAM, IMU_TO_VELO):
                lines = "".join(f"{key}: {text}\n" for key, text in texts.items())
                (folder / name).write_text(lines, "utf-8", newline="\n")
        if _says(folder, mounted, rectified=rectified):
            return
        for name in (CAM_TO_CAM, VELO_TO_CAM, IMU_TO_VELO):
            (folder / name).unlink(missing_ok=True)
    for name, entries in _built(mounted, rectified=rectified).items():
        lines = "".join(f"{key}: {text}\n" for key, text in entries.items())
        (folder / name).write_text(lines, "utf-8", newline="\n")


def _says(folder: Path, mounted: Mounted, *, rectified: bool) -> bool:
    """Whether the files of a folder state what the scene says."""
    try:
        read = read_raw_calibration(folder, tuple(mounted.camera_models), rectified=rectified)
    except SceneloomError:
        return False
    if any(
        read.camera_models[number] != camera_model for number, camera_model in mounted.camera_models.items()
    ):
        return False
    return files_lidar_from_lidar(read.camera_from_lidar, read.lidar_from_imu, mounted) is not None


def _built(mounted: Mounted, *, rectified: bool) -> dict[str, dict[str, str]]:
    """Entries of the files: the reference camera stands for camera 0, unless there is one."""
    base = mounted.camera_from_lidar.get(0, mounted.rectified_from_lidar)
    reference = mounted.camera_models.get(mounted.reference or 0, _SPARE)
    between: dict[str, str] = {"calib_time": "01-Jan-1970 00:00:00", "corner_dist": "0.0"}
    for number in range(CAMERAS):
        camera_model = mounted.camera_models.get(number, reference)
        placed = RigidTransform.identity()
        if number in mounted.camera_from_lidar and mounted.camera_from_lidar[number] is not base:
            placed = mounted.camera_from_lidar[number] @ base.inverse()
        between |= _camera_entries(number, camera_model, placed, rectified=rectified)
    files = {CAM_TO_CAM: between, VELO_TO_CAM: {**_rigid(base), "delta_f": "0 0", "delta_c": "0 0"}}
    if mounted.lidar_from_imu is not None:
        files[IMU_TO_VELO] = _rigid(mounted.lidar_from_imu)
    return files


def _camera_entries(
    number: int, camera_model: Camera, camera_from_first: RigidTransform, *, rectified: bool
) -> dict[str, str]:
    """The entries of a camera, before and after rectification.

    Of rectified images both are the same. Of others, rectification is the rotation back to the first camera's axes,
    with the camera model's own matrix.
    """
    rotation = np.eye(3) if rectified else camera_from_first.rotation.T
    shift = rotation @ camera_from_first.translation
    projection = np.column_stack([camera_model.matrix, camera_model.matrix @ shift])
    distortion = [*camera_model.coefficients[:5], *(0.0,) * (5 - len(camera_model.coefficients[:5]))]
    entries: dict[str, Any] = {
        "S": (float(camera_model.width), float(camera_model.height)),
        "K": camera_model.matrix,
        "D": distortion,
        "R": camera_from_first.rotation,
        "T": camera_from_first.translation,
        "S_rect": (float(camera_model.width), float(camera_model.height)),
        "R_rect": rotation,
        "P_rect": projection,
    }
    return {f"{name}_{number:02d}": _numbers(values) for name, values in entries.items()}


def _rigid(transform: RigidTransform) -> dict[str, str]:
    return {"R": _numbers(transform.rotation), "T": _numbers(transform.translation)}


def _numbers(values: Any) -> str:
    flat: Float64Array = np.asarray(values, np.float64).reshape(-1)
    return " ".join(map(repr, flat.tolist()))
