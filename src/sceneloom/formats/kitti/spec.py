"""KITTI's raw data, and its object, tracking and odometry benchmarks, with SemanticKITTI's labels.

Source: the development kits of the benchmarks and of the raw data, and semantic-kitti.org.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from sceneloom.formats.base.losses import KEPT, Supports, approximated, converted, dropped
from sceneloom.formats.base.spec import FormatSpec

IMAGES = (".png", ".jpg", ".jpeg")
SWEEPS = (".bin",)
TEXTS = (".txt",)
LABELS = (".label",)
"""Endings of the files of each kind."""

NUMBER = re.compile(r"[0-9]{1,10}")
"""What the names of frames' files are."""


def _has_numbered(folder: Path, suffixes: tuple[str, ...]) -> bool:
    """Whether a folder has a file that is named by a number."""
    if not folder.is_dir():
        return False
    try:
        return any(path.suffix.lower() in suffixes and NUMBER.fullmatch(path.stem) for path in folder.iterdir())
    except OSError:
        return False


# Raw data: `2011_09_26/2011_09_26_drive_0001_sync`, the day's calibration beside it.

RAW_CAMERAS = tuple(f"image_{number:02d}" for number in range(4))
"""What the folders of the four cameras are called, by number."""

CALIBRATION_FILES = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt")
"""The day's files: calibration of the cameras, the lidar and the OXTS unit."""

DRIVE_NAME = re.compile(r"(?P<date>\d{4}_\d\d_\d\d)_drive_(?P<number>\d{4})_(?P<kind>sync|extract)")
_DATE = re.compile(r"\d{4}_\d\d_\d\d")


def _is_raw_drive(path: Path) -> bool:
    """Whether a folder has a sensor's folder as drives of the raw data have them."""
    return any((path / name / "data").is_dir() for name in (*RAW_CAMERAS, "velodyne_points", "oxts"))


def raw_drives(path: Path) -> list[Path]:
    """The drive that a folder is, or the drives of a day's folder, or of a folder of days, by name."""
    if _is_raw_drive(path):
        return [path if path.name else path.resolve()]  # by a path that ends in its name
    return [child for child in _children(path) if DRIVE_NAME.fullmatch(child.name) and _is_raw_drive(child)]


def _children(path: Path) -> list[Path]:
    """The folders in a folder, and those in the days among them."""
    try:
        children = sorted(child for child in path.iterdir() if child.is_dir())
        days = [child for child in children if _DATE.fullmatch(child.name)]
        return [*children, *(child for day in days for child in sorted(day.iterdir()) if child.is_dir())]
    except OSError:
        return []


def _is_raw(path: Path) -> bool:
    return path.is_dir() and bool(raw_drives(path))


def _raw_near_miss(path: Path) -> str | None:
    if not path.is_dir() or _is_raw(path):
        return None
    empty = [child.name for child in (path, *_children(path)) if DRIVE_NAME.fullmatch(child.name)]
    if empty:
        return (
            "the folder of a drive of KITTI's without data: expected velodyne_points/data, image_02/data or oxts/data "
            f"in {empty[0]}"
        )
    calibration = [name for name in CALIBRATION_FILES if (path / name).is_file()]
    if calibration:
        return (
            f"{calibration[0]} of KITTI's raw data without drives: expected folders as 2011_09_26_drive_0001_sync "
            "beside it"
        )
    return None


# Object and tracking benchmarks: `training/`, `testing/`, or a folder with their sensors.

PARTS = ("training", "testing")

OBJECT_CAMERAS = {2: "image_2", 3: "image_3"}
"""Folders of the images of the object benchmark, by the camera's number."""

TRACKING_CAMERAS = {2: "image_02", 3: "image_03"}
"""Folders of the images of the tracking benchmark, by the camera's number: a folder for each sequence in them."""

_TRACKING_NAME = re.compile(r"\d{4}")
_OF_FOLDERS = ("velodyne", *TRACKING_CAMERAS.values())
_OF_TEXTS = ("label_02", "oxts")


def _locations(path: Path) -> Iterator[Path]:
    """The folder itself, then its parts."""
    yield path
    yield from (path / part for part in PARTS)


def object_folders(path: Path) -> list[Path]:
    """The folders with sensors of the object benchmark: files of frames, named by their numbers."""
    return [folder for folder in _locations(path) if _has_frames(folder)]


def _has_frames(folder: Path) -> bool:
    has_images = any(_has_numbered(folder / name, IMAGES) for name in OBJECT_CAMERAS.values())
    has_sweeps = _has_numbered(folder / "velodyne", SWEEPS) and not (folder / "times.txt").is_file()
    return has_images or has_sweeps or (_has_labels(folder) and _has_calibrations(folder))


def _has_labels(folder: Path) -> bool:
    return _has_numbered(folder / "label_2", TEXTS)


def _has_calibrations(folder: Path) -> bool:
    return _has_numbered(folder / "calib", TEXTS)


def _is_object(path: Path) -> bool:
    return path.is_dir() and any(map(_has_calibrations, object_folders(path)))


def _object_near_miss(path: Path) -> str | None:
    if not path.is_dir() or _is_object(path):
        return None
    for folder in _locations(path):
        expected = f"expected {folder.name}/calib/000000.txt for each frame"
        if _has_frames(folder) and not (folder / "times.txt").is_file():
            return f"frames of KITTI's object benchmark without calibration: {expected}"
        if _has_labels(folder):
            return f"labels of KITTI's object benchmark without calibration: {expected}"
    return None


def tracking_sequences(path: Path) -> dict[Path, tuple[str, ...]]:
    """By the folder, names of the sequences of the tracking benchmark of which more than a calibration is there."""
    found = {
        folder: {name for kind in (*_OF_FOLDERS, *_OF_TEXTS) for name in _tracking_names(folder / kind)}
        for folder in _locations(path)
    }
    return {folder: tuple(sorted(names)) for folder, names in found.items() if names}


def _tracking_names(folder: Path) -> set[str]:
    if not folder.is_dir():
        return set()
    wants_folders = folder.name in _OF_FOLDERS
    try:
        return {
            path.stem
            for path in folder.iterdir()
            if _TRACKING_NAME.fullmatch(path.stem) and (path.is_dir() if wants_folders else path.suffix == ".txt")
        }
    except OSError:
        return set()


def _is_tracking(path: Path) -> bool:
    return path.is_dir() and any(_tracking_names(folder / "calib") for folder in tracking_sequences(path))


def _tracking_near_miss(path: Path) -> str | None:
    if not path.is_dir() or _is_tracking(path):
        return None
    for folder in tracking_sequences(path):
        return (
            "sequences of KITTI's tracking benchmark without calibration: expected "
            f"{folder.name}/calib/0000.txt for each"
        )
    return None


# Odometry benchmark: `sequences/00`, with `poses/00.txt` beside the former.

ODOMETRY_CAMERAS = {number: f"image_{number}" for number in range(4)}
"""Folders of the images of the odometry benchmark, by the camera's number."""

_ODOMETRY_NAME = re.compile(r"\d{2}")


@dataclass(frozen=True, slots=True)
class OdometrySequence:
    """One sequence of the odometry benchmark.

    Attributes:
        name: "00".
        folder: of its sensors.
        poses: where its poses would be.
    """

    name: str
    folder: Path
    poses: Path


def odometry_sequences(path: Path) -> dict[str, Path]:
    """The sequences of a folder by name: itself, those in it, or those in its `sequences`."""
    if _is_odometry_sequence(path):
        return {path.resolve().name: path}
    for folder in (path / "sequences", path):
        if folder.is_dir():
            found = {
                child.name: child
                for child in sorted(folder.iterdir())
                if _ODOMETRY_NAME.fullmatch(child.name) and _is_odometry_sequence(child)
            }
            if found:
                return found
    return {}


def _is_odometry_sequence(folder: Path) -> bool:
    """Whether a folder has sensors of the odometry benchmark, beside the calibration or the times of all."""
    has_text = (folder / "calib.txt").is_file() or (folder / "times.txt").is_file()
    return has_text and (
        any(_has_numbered(folder / name, IMAGES) for name in ODOMETRY_CAMERAS.values())
        or _has_numbered(folder / "velodyne", SWEEPS)
        or _has_numbered(folder / "labels", LABELS)
    )


def _is_odometry(path: Path) -> bool:
    try:
        return path.is_dir() and bool(odometry_sequences(path))
    except OSError:
        return False


def _odometry_near_miss(path: Path) -> str | None:
    if not path.is_dir() or _is_odometry(path) or not (path / "sequences").is_dir():
        return None
    return (
        "a folder `sequences` as of KITTI's odometry benchmark, but no sequence in it: expected sequences/00 with "
        "calib.txt, times.txt and velodyne or image_0 to image_3"
    )


# KITTI-360: `data_2d_raw/2013_05_28_drive_0000_sync` and so on, a folder for each kind of data.

IMAGES_360, POINTS_360, POSES_360, BOXES_360 = "data_2d_raw", "data_3d_raw", "data_poses", "data_3d_bboxes"


def sequences_360(path: Path) -> tuple[str, ...]:
    """Names of the sequences with images, sweeps or poses."""
    found: set[str] = set()
    for kind in (IMAGES_360, POINTS_360, POSES_360):
        folder = path / kind
        try:
            found |= {child.name for child in folder.iterdir() if DRIVE_NAME.fullmatch(child.name) and child.is_dir()}
        except OSError:
            continue
    return tuple(sorted(found))


def _is_360(path: Path) -> bool:
    return path.is_dir() and bool(sequences_360(path))


# Supported fields: what all of them have in common, and what each has besides.

_NO_POSITION = dropped("the folder has no field for it")
_NUMBERED = converted("cameras are numbered 0 to 3, the lidar is `velodyne`")
_BY_NAME = dropped("it is given anew from where files are")
_TEXT = converted("decimals of text, all digits")
_LABEL = approximated("six decimals of text; boxes go with images that are resampled")
_FRAMES = approximated("numbers of frames, whose times count")
_ALONG = approximated("along the ego trajectory with the mounting, at the frames' times")
_FROM_LIDAR = approximated("as seen from the lidar: no file says where the ego is")

_SENSORS: Supports = MappingProxyType(
    {
        "": _NO_POSITION,
        "sensors.order": converted("the lidar, then cameras by number"),
        "sensors.lidar.id": _NUMBERED,
        "sensors.lidar.poses": converted("along the ego trajectory with the mounting"),
        "sensors.lidar.coordinates": converted("poses lead into the world"),
        "sensors.lidar.mount": _TEXT,
        "sensors.lidar.points_frame": converted("points are in the lidar's own frame"),
        "sensors.lidar.frames.timestamp_ns": KEPT,
        "sensors.lidar.frames.points.positions": KEPT,
        "sensors.lidar.frames.points.intensities": converted("reflectance from 0 to 1"),
        "sensors.lidar.frames.points.timestamps_ns": dropped("points have no times"),
        "sensors.lidar.frames.extras": _BY_NAME,
        "sensors.camera.id": _NUMBERED,
        "sensors.camera.poses": converted("along the ego trajectory with the mounting"),
        "sensors.camera.coordinates": converted("poses lead into the world"),
        "sensors.camera.mount": _TEXT,
        "sensors.camera.camera": approximated("pinholes; images of other camera models are resampled"),
        "sensors.camera.video": converted("decoded, a PNG for each image"),
        "sensors.camera.images.timestamp_ns": KEPT,
        "sensors.camera.images.rgb": KEPT,
        "sensors.camera.images.encoded": converted("decoded, a PNG for each image"),
        "sensors.camera.images.extras": _BY_NAME,
        "metadata": dropped("only what was read from such a folder is written again"),
    }
)

_MOTION: Supports = MappingProxyType(
    {
        "sensors.imu.id": converted("it is `imu`"),
        "sensors.imu.streams.accelerometer": approximated("a value for each line"),
        "sensors.imu.streams.gyroscope": approximated("a value for each line"),
        "sensors.imu.streams.other": approximated("those of the OXTS unit, of its own lines; others are dropped"),
        "sensors.imu.streams.other.file_seconds": _NO_POSITION,
        "sensors.imu.streams.accelerometer.file_seconds": _NO_POSITION,
        "sensors.imu.streams.gyroscope.file_seconds": _NO_POSITION,
        "sensors.gnss.id": converted("it is `gnss`"),
        "sensors.gnss.timestamps_ns": approximated("a fix for each line"),
        "sensors.gnss.positions_lla": approximated("the positions of the ego trajectory"),
        "sensors.gnss.accuracies": approximated("an accuracy for each line"),
        "sensors.odometry.poses": approximated("a pose for each line, where no trajectory is reported"),
        "trajectories.name": converted("it is `oxts`"),
        "trajectories.timestamps_ns": approximated("a pose for each line"),
        "trajectories.positions": converted("latitude, longitude and altitude"),
        "trajectories.quaternions_xyzw": converted("roll, pitch and yaw"),
    }
)

_BOXES: Supports = MappingProxyType(
    {
        "annotations.order": converted("by frame, then as they were"),
        "annotations.cuboid.label": converted("a word without blanks"),
        "annotations.cuboid.path.timestamps_ns": _FRAMES,
        "annotations.cuboid.path.values": approximated("upright boxes in frames whose images show them"),
        "annotations.cuboid.attributes": approximated("truncated, occluded, alpha and score; others are dropped"),
        "annotations.cuboid.projections.sensor_id": converted("the reference camera"),
        "annotations.cuboid.projections.timestamps_ns": _FRAMES,
        "annotations.cuboid.projections.boxes": _LABEL,
        "annotations.box_2d.label": converted("a word without blanks"),
        "annotations.box_2d.sensor_id": converted("the reference camera"),
        "annotations.box_2d.path.timestamps_ns": _FRAMES,
        "annotations.box_2d.path.values": _LABEL,
        "annotations.box_2d.attributes": approximated("truncated, occluded and alpha; others are dropped"),
    }
)

_ONE_TIME = approximated("a frame has one time for all sensors")
_NO_TIME = dropped("frames have numbers and no times")

_RAW_SUPPORTS: Supports = MappingProxyType(
    {
        **_SENSORS,
        **_MOTION,
        "sensors.lidar.frames.points.timestamps_ns": approximated("reported by directions, where that holds"),
        "sensors.camera.camera": approximated("brown_conrady's k1 k2 p1 p2 k3 in `extract`, else pinholes"),
        "annotations.order": KEPT,
        "annotations.cuboid.id": dropped("tracklets have none"),
        "annotations.cuboid.label": KEPT,
        "annotations.cuboid.path.timestamps_ns": _FRAMES,
        "annotations.cuboid.path.values": approximated("one size, in the lidar's frame, in all frames of a run"),
        "annotations.cuboid.attributes": approximated("the states of tracklets; others are dropped"),
    }
)

_TRACKING_SUPPORTS: Supports = MappingProxyType(
    {
        **_SENSORS,
        **_MOTION,
        **_BOXES,
        "sensors.lidar.poses": _ALONG,
        "sensors.camera.poses": _ALONG,
        "sensors.lidar.frames.timestamp_ns": _ONE_TIME,
        "sensors.camera.images.timestamp_ns": _ONE_TIME,
        "annotations.cuboid.id": converted("numbers of tracks"),
        "annotations.box_2d.id": converted("numbers of tracks"),
    }
)

_OBJECT_SUPPORTS: Supports = MappingProxyType(
    {
        **_SENSORS,
        **_BOXES,
        "sensors.lidar.mount": _FROM_LIDAR,
        "sensors.camera.mount": _FROM_LIDAR,
        "sensors.lidar.poses": dropped("every frame's world is its own lidar's frame"),
        "sensors.camera.poses": dropped("every frame's world is its own lidar's frame"),
        "sensors.lidar.frames.timestamp_ns": _NO_TIME,
        "sensors.camera.images.timestamp_ns": _NO_TIME,
        "sensors.camera.images.camera": converted("a calibration for each frame"),
        "sensors.camera.images.mount": _FROM_LIDAR,
        "annotations.cuboid.id": dropped("frames know nothing of each other"),
        "annotations.box_2d.id": dropped("frames know nothing of each other"),
    }
)

_ODOMETRY_SUPPORTS: Supports = MappingProxyType(
    {
        **_SENSORS,
        "sensors.lidar.poses": _ALONG,
        "sensors.camera.poses": _ALONG,
        "sensors.lidar.frames.timestamp_ns": _ONE_TIME,
        "sensors.camera.images.timestamp_ns": _ONE_TIME,
        "sensors.lidar.mount": _FROM_LIDAR,
        "sensors.camera.mount": _FROM_LIDAR,
        "sensors.odometry.poses": approximated("a pose for each frame, where no trajectory is reported"),
        "trajectories.name": converted("it is `groundTruth`"),
        "trajectories.timestamps_ns": approximated("a pose for each frame"),
        "trajectories.positions": converted("of camera 0, seen from its first pose"),
        "trajectories.quaternions_xyzw": converted("rows of a matrix"),
        "annotations.order": converted("by number"),
        "annotations.labeled_points.id": converted("names and numbers of SemanticKITTI"),
        "annotations.labeled_points.label": converted("a number of SemanticKITTI, where it has one"),
        "annotations.labeled_points.is_instance": converted("whether it has a number of its own"),
        "annotations.labeled_points.labeled_points": approximated("points of sweeps whose class has a number"),
        "annotations.labeled_points.labeled_points.sensor_id": _NUMBERED,
        "annotations.labeled_points.labeled_points.extras": _NO_POSITION,
    }
)

RAW = FormatSpec(
    name="kitti-raw",
    title="KITTI's raw data",
    looks_like="a drive of KITTI's raw data (2011_09_26_drive_0001_sync), or the folder of its day",
    sniff=_is_raw,
    near_miss=_raw_near_miss,
    drives=raw_drives,
    reader="sceneloom.formats.kitti.raw_reader:open_raw",
    read_options=("sequence", "lenient"),
    writer="sceneloom.formats.kitti.raw_writer:write_raw",
    write_options=("kind", "sequence"),
    supports=_RAW_SUPPORTS,
)

OBJECT = FormatSpec(
    name="kitti-object",
    title="KITTI's object benchmark",
    looks_like="frames of KITTI's object benchmark (velodyne, image_2, calib, label_2)",
    sniff=_is_object,
    near_miss=_object_near_miss,
    reader="sceneloom.formats.kitti.object_reader:open_object",
    read_options=("lenient",),
    writer="sceneloom.formats.kitti.benchmark_writer:write_object",
    supports=_OBJECT_SUPPORTS,
)

TRACKING = FormatSpec(
    name="kitti-tracking",
    title="KITTI's tracking benchmark",
    looks_like="sequences of KITTI's tracking benchmark (velodyne/0000, image_02/0000, label_02, calib)",
    sniff=_is_tracking,
    near_miss=_tracking_near_miss,
    drives=lambda path: next(iter(tracking_sequences(path).values()), ()),
    reader="sceneloom.formats.kitti.tracking_reader:open_tracking",
    read_options=("sequence", "lenient"),
    writer="sceneloom.formats.kitti.benchmark_writer:write_tracking",
    write_options=("sequence",),
    supports=_TRACKING_SUPPORTS,
)

ODOMETRY = FormatSpec(
    name="kitti-odometry",
    title="KITTI's odometry benchmark",
    looks_like="sequences of KITTI's odometry benchmark (sequences/00, poses/00.txt), with SemanticKITTI's labels",
    sniff=_is_odometry,
    near_miss=_odometry_near_miss,
    drives=lambda path: tuple(odometry_sequences(path).values()),
    reader="sceneloom.formats.kitti.odometry_reader:open_odometry",
    read_options=("sequence", "labels", "lenient"),
    writer="sceneloom.formats.kitti.odometry_writer:write_odometry",
    write_options=("sequence",),
    supports=_ODOMETRY_SUPPORTS,
)

KITTI_360 = FormatSpec(
    name="kitti-360",
    title="KITTI-360",
    looks_like=(
        "a folder with data_2d_raw/ or data_3d_raw/ of KITTI-360 (in them 2013_05_28_drive_0000_sync), calibration/, "
        "data_poses/ (built to the description)"
    ),
    sniff=_is_360,
    drives=sequences_360,
    reader="sceneloom.formats.kitti.kitti360_reader:open_360",
    read_options=("sequence", "lenient"),
    instead="KITTI-360 is only read; write a scene file (drive.sfs), a recording (a folder) or kitti-raw instead",
)
