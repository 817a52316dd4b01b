"""Argoverse 2: logs of the sensor and lidar data sets, as feather tables and JPEG images. Only read.

A log is a folder::

    city_SE3_egovehicle.feather                  poses of the ego in the city frame
    calibration/egovehicle_SE3_sensor.feather    extrinsics of lidars and cameras
    calibration/intrinsics.feather               intrinsics of the cameras
    annotations.feather                          cuboids in the ego frame, optional
    sensors/lidar/<ns>.feather                   sweeps of both lidars, in the ego frame
    sensors/cameras/<camera>/<ns>.jpg            undistorted images

Source: https://argoverse.github.io/user-guide/datasets/sensor.html and the package `av2`.
"""

from functools import partial
from pathlib import Path

from sceneloom.formats.base.spec import FormatSpec, any_drive, drives_in

POSES = "city_SE3_egovehicle.feather"
MOUNTS = "calibration/egovehicle_SE3_sensor.feather"
CAMERA_MODELS = "calibration/intrinsics.feather"
ANNOTATIONS = "annotations.feather"
LIDAR = "sensors/lidar"
CAMERAS = "sensors/cameras"


def _is_log(path: Path) -> bool:
    """Whether a folder is a log, complete or not: no other format has files of these names."""
    return path.is_dir() and ((path / POSES).is_file() or (path / MOUNTS).is_file())


LOGS_IN = partial(drives_in, is_drive=_is_log)
"""The logs of a folder."""


def _near_miss(path: Path) -> str | None:
    if path.is_dir() and (path / LIDAR).is_dir() and any((path / LIDAR).glob("*.feather")):
        return f"it has {LIDAR}/*.feather as Argoverse 2 has, but neither {POSES} nor {MOUNTS}"
    return None


FORMAT = FormatSpec(
    name="argoverse2",
    title="Argoverse 2",
    looks_like=f"a folder with {POSES}, calibration/ and sensors/lidar/*.feather",
    suffixes=(".argoverse2",),
    sniff=partial(any_drive, is_drive=_is_log),
    near_miss=_near_miss,
    drives=LOGS_IN,
    reader="sceneloom.formats.argoverse2.reader:open_argoverse2",
    read_options=("lenient", "sequence", "one_lidar", "distorted"),
    instead="Argoverse 2 is only read; write a scene file (drive.sfs) or a recording (a folder) instead",
)
