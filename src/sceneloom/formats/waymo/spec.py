"""Waymo Open Dataset, version 2 (perception): a folder for each component, in it a parquet file for each segment.

Only read. A data set is a folder::

    vehicle_pose/<segment>.parquet                              poses of the vehicle
    lidar/, lidar_calibration/, lidar_pose/                     range images, and what makes points of them
    camera_image/, camera_calibration/                          JPEG images with their times and poses
    lidar_box/, camera_box/, lidar_segmentation/                labels, optional
    stats/                                                      time of day, location and weather, optional

Source: https://waymo.com/open/data/perception and the columns that the public package `waymo_open_dataset.v2` declares.
"""

from itertools import islice
from pathlib import Path

from sceneloom.formats.base.spec import FormatSpec

VEHICLE_POSE, STATS = "vehicle_pose", "stats"
LIDAR, LIDAR_CALIBRATION, LIDAR_POSE = "lidar", "lidar_calibration", "lidar_pose"
CAMERA_IMAGE, CAMERA_CALIBRATION = "camera_image", "camera_calibration"
LIDAR_BOX, CAMERA_BOX, LIDAR_SEGMENTATION = "lidar_box", "camera_box", "lidar_segmentation"

UNREAD = (
    *("camera_hkp", "camera_segmentation", "camera_to_lidar_box_association", "lidar_camera_projection"),
    *("lidar_camera_synced_box", "lidar_flow", "lidar_hkp", "projected_lidar_box"),
)
"""Components that are named in a warning, and not read."""

_SUFFIX = ".parquet"
_MOST = 10_000  # segments of a data set


def file_of(root: Path, component: str, segment: str) -> Path:
    """Where a component of a segment is."""
    return root / component / f"{segment}{_SUFFIX}"


def segments_of(path: Path) -> list[str]:
    """Names of the segments of a folder: those with poses, sweeps or images."""
    found = set()
    for component in (VEHICLE_POSE, LIDAR, CAMERA_IMAGE):
        if (path / component).is_dir():
            files = islice((path / component).glob(f"*{_SUFFIX}"), _MOST)
            found |= {file.stem for file in files}
    return sorted(found)


def _is_waymo(path: Path) -> bool:
    """Whether a folder has a component of this name that no other format has, and in it a parquet file."""
    if not path.is_dir():
        return False
    own = (VEHICLE_POSE, LIDAR_CALIBRATION, CAMERA_CALIBRATION)
    return bool(segments_of(path)) and any(any((path / name).glob(f"*{_SUFFIX}")) for name in own)


def _near_miss(path: Path) -> str | None:
    if path.is_dir() and not _is_waymo(path) and segments_of(path):
        return (
            f"parquet files in {LIDAR}/ or {CAMERA_IMAGE}/ as the Waymo Open Dataset v2 has them, but no "
            f"{VEHICLE_POSE}/, {LIDAR_CALIBRATION}/ or {CAMERA_CALIBRATION}/ beside them"
        )
    if path.is_file() and path.suffix == ".tfrecord":
        return "a .tfrecord file of the Waymo Open Dataset v1; the parquet files of v2 are read"
    return None


FORMAT = FormatSpec(
    name="waymo",
    title="the Waymo Open Dataset v2",
    looks_like=(
        "a folder with vehicle_pose/, lidar/, camera_image/ and other components of the Waymo Open Dataset v2, in them "
        "SEGMENT.parquet (built to the description)"
    ),
    suffixes=(".waymo",),
    sniff=_is_waymo,
    near_miss=_near_miss,
    drives=segments_of,
    reader="sceneloom.formats.waymo.reader:open_waymo",
    read_options=("lenient", "sequence"),
    extra="argoverse",
    needs=("pyarrow.parquet",),
    instead="the Waymo Open Dataset is only read; write a scene file (drive.sfs) or a recording (a folder) instead",
)
