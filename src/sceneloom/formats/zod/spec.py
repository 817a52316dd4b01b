"""Zenseact Open Dataset: frames, sequences and drives. Only read.

A frame, a sequence or a drive is a folder::

    calibration.json                                       the front camera and the lidar on the ego
    camera_front_blur/000000_romeo_2022-06-14T13:23:10.194720Z.jpg (or camera_front_dnat, camera_front_original)
    lidar_velodyne/000000_romeo_2022-06-14T13:23:10.194720Z.npy
    ego_motion.json                                        poses of the ego
    annotations/object_detection.json, info.json, metadata.json

Source: https://zod.zenseact.com and its public development kit, `zenseact/zod`.
"""

from functools import partial
from pathlib import Path

from sceneloom.formats.base.spec import FormatSpec, any_drive, drives_in

CALIBRATION, EGO_MOTION, INFO, METADATA = "calibration.json", "ego_motion.json", "info.json", "metadata.json"
OBJECTS = "annotations/object_detection.json"
LIDAR = "lidar_velodyne"
CAMERAS = ("camera_front_blur", "camera_front_dnat", "camera_front_original")
"""Folders of images of the front camera, by how they were anonymised; the first that is there is read."""


def _is_zod(path: Path) -> bool:
    return (path / CALIBRATION).is_file() and any((path / name).is_dir() for name in (LIDAR, *CAMERAS))


DRIVES_IN = partial(drives_in, is_drive=_is_zod)
"""The frames, sequences or drives of a folder."""


def _near_miss(path: Path) -> str | None:
    if path.is_dir() and not _is_zod(path) and any((path / name).is_dir() for name in (LIDAR, *CAMERAS)):
        return f"it has {LIDAR}/ or {CAMERAS[0]}/ as the Zenseact Open Dataset has, but no {CALIBRATION}"
    return None


FORMAT = FormatSpec(
    name="zod",
    title="the Zenseact Open Dataset",
    looks_like=(
        "a folder with calibration.json, lidar_velodyne/ and camera_front_blur/ of the Zenseact Open Dataset, or a "
        "folder of such (built to the description)"
    ),
    suffixes=(".zod",),
    sniff=partial(any_drive, is_drive=_is_zod),
    near_miss=_near_miss,
    drives=DRIVES_IN,
    reader="sceneloom.formats.zod.reader:open_zod",
    read_options=("lenient", "sequence"),
    instead="the Zenseact Open Dataset is only read; write a scene file (drive.sfs) or a recording (a folder) instead",
)
