"""A drive of KITTI's raw data as a scene."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.kitti.number_lines import as_table
from sceneloom.formats.kitti.oxts import read_fields
from sceneloom.formats.kitti.raw.calibration import RawCalibration, image_sizes, read_raw_calibration
from sceneloom.formats.kitti.raw.timestamps import TimestampFile, in_order, timestamped
from sceneloom.formats.kitti.raw.tracked_boxes import tracklet_annotations
from sceneloom.formats.kitti.raw.tracklets import FILE as TRACKLETS
from sceneloom.formats.kitti.raw.tracklets import read_tracklets
from sceneloom.formats.kitti.scenes.inertial import oxts_sensors, rising
from sceneloom.formats.kitti.scenes.numbered import NumberedFiles, note_unread, numbered_files
from sceneloom.formats.kitti.scenes.sensors import camera_sensor, kitti_metadata, lidar_sensor, stationary
from sceneloom.formats.kitti.scenes.sweeps import RotationTimes
from sceneloom.formats.kitti.spec import (
    CALIBRATION_FILES,
    DRIVE_NAME,
    IMAGES,
    RAW_CAMERAS,
    SWEEPS,
    TEXTS,
    is_raw_drive,
    raw_drives_below,
)
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.rig.images import image_size
from sceneloom.formats.spec import named_folder
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.motion import ImuSensor
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.warnings import WarningKind


@dataclass(frozen=True, slots=True)
class RawDrive:
    """A drive's folder.

    Attributes:
        folder: of its sensors.
        calibration: the folder of its calibration files.
        kind: "sync" (rectified images, one of each sensor in each frame), "extract" (as recorded), or None where the
            folder's name does not state it.
    """

    folder: Path
    calibration: Path
    kind: str | None


def find_drive(path: Path, wanted: str | None = None) -> RawDrive:
    """Find the only drive of a folder, or the wanted one: the drive's own folder, that of its day, or the one above.

    Raises:
        DataError: there is none.
        OptionError: there are several and none was chosen, or the chosen one is not there.
    """
    found = [named_folder(path)] if is_raw_drive(path) else raw_drives_below(path)
    if wanted is not None:
        chosen = [drive for drive in found if wanted in _names(drive)]
        if len(chosen) != 1:
            names = ", ".join(drive.name for drive in found) or "none"
            raise OptionError(f"drive {wanted!r}: {path} has {len(chosen)} of that name; it has {names}")
        found = chosen
    if not found:
        raise DataError(path, "", "holds no drive; expected folders as 2011_09_26_drive_0001_sync")
    if len(found) > 1:
        names = ", ".join(drive.name for drive in found)
        raise OptionError(f"{path} has several drives: {names}; choose one with `--sequence NAME`")
    return _drive(found[0])


def _names(drive: Path) -> set[str]:
    match = DRIVE_NAME.fullmatch(drive.name)
    if match is None:
        return {drive.name}
    number = match["number"]
    return {drive.name, number, f"{number}_{match['kind']}", f"{match['date']}_drive_{number}"}


def _drive(folder: Path) -> RawDrive:
    match = DRIVE_NAME.fullmatch(folder.resolve().name)
    locations = (folder, folder / "calib", folder.resolve().parent)
    calibration = next(
        (
            location
            for location in locations
            if any((location / name).is_file() for name in CALIBRATION_FILES)
        ),
        locations[-1],
    )
    return RawDrive(folder, calibration, None if match is None else match["kind"])


@dataclass(frozen=True, slots=True, eq=False)
class _Stream:
    """Files of one sensor in the order of their times."""

    files: NumberedFiles
    timestamps_ns: Int64Array
    timestamps: TimestampFile


def open_raw(path: Path, *, sequence: str | None = None, lenient: bool = False) -> Scene:
    """Open a drive: its own folder, that of its day, or one of days.

    Args:
        path: the folder.
        sequence: the drive, as `0001`, `0001_sync` or its folder's name, where there are several.
        lenient: leave out files without a time and times without a file, and count them.

    Raises:
        DataError: something is missing or wrong.
        OptionError: there are several drives and none was chosen.
    """
    drive = find_drive(path, sequence)
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        return _open(drive, ledger)


def _open(drive: RawDrive, ledger: Ledger) -> Scene:
    note_unread(
        drive.folder, (*RAW_CAMERAS, "velodyne_points", "oxts", TRACKLETS, *CALIBRATION_FILES), ledger
    )
    cameras = {
        number: stream
        for number, name in enumerate(RAW_CAMERAS)
        if (stream := _stream(drive.folder / name, IMAGES, ledger)) is not None
    }
    sweeps = _stream(drive.folder / "velodyne_points", (*SWEEPS, *TEXTS), ledger)
    lines = _stream(drive.folder / "oxts", TEXTS, ledger)
    if not cameras and sweeps is None and lines is None:
        raise DataError(
            drive.folder, "", "holds no files; expected those of image_02, velodyne_points or oxts"
        )
    rectified = _is_rectified(drive, cameras, ledger)
    needed = tuple(cameras) if cameras or sweeps is None or lines is None else ()
    calibration = read_raw_calibration(drive.calibration, needed, rectified=rectified)
    own, trajectory = _oxts(drive, lines, calibration, ledger, others=bool(cameras) or sweeps is not None)
    tracklets = drive.folder / TRACKLETS
    reference = sweeps or cameras.get(2) or next(iter(cameras.values()), None)
    if trajectory is None and tracklets.is_file() and reference is not None:
        trajectory = stationary(
            reference.timestamps_ns, tracklets, "the trajectory of the OXTS unit is not known", ledger
        )
    poses = None if trajectory is None else trajectory.poses
    ego_from_lidar = RigidTransform.identity()
    if calibration.lidar_from_imu is not None:
        ego_from_lidar = calibration.lidar_from_imu.inverse()
    sensors: list[Sensor] = []
    if sweeps is not None:
        timestamps, rotations = _rotations(drive.folder / "velodyne_points", sweeps, ledger)
        sensors.append(
            lidar_sensor(sweeps.files, timestamps, ego_from_lidar, poses, ledger, rotations=rotations)
        )
    for number, stream in cameras.items():
        mount = ego_from_lidar @ calibration.camera_from_lidar[number].inverse()
        camera_model = calibration.camera_models[number]
        sensors.append(camera_sensor(number, stream.files, stream.timestamps_ns, camera_model, mount, poses))
    annotations: tuple[Annotation, ...] = ()
    if tracklets.is_file() and reference is not None:
        frames = dict(zip(reference.files.numbers.tolist(), reference.timestamps_ns.tolist(), strict=True))
        found = read_tracklets(tracklets)
        annotations = tracklet_annotations(found, tracklets, frames, poses, ego_from_lidar, ledger)
    reported = {
        "drive": drive.folder.resolve().name,
        "rectified": rectified,
        "calibration": _plain(calibration),
    }
    return Scene(
        (*sensors, *own),
        annotations=annotations,
        trajectories=MappingProxyType({} if trajectory is None else {trajectory.name: trajectory}),
        metadata=kitti_metadata("raw", **reported),
        source=str(drive.folder),
        format="kitti-raw",
        warnings=ledger.warnings,
    )


def _plain(calibration: RawCalibration) -> dict[str, dict[str, str]]:
    return {name: dict(texts) for name, texts in calibration.texts.items()}


def _stream(folder: Path, suffixes: tuple[str, ...], ledger: Ledger) -> _Stream | None:
    """The files of a sensor's folder with their times; None where there are none."""
    if not folder.is_dir():
        return None
    files = numbered_files(folder / "data", suffixes, ledger)
    if not len(files):
        if (folder / "timestamps.txt").is_file():
            problem = f"holds no {' or '.join(suffixes)}; expected a file for each line of timestamps.txt"
            ledger.fault("counts-disagree", DataError(folder / "data", "", problem))
        return None
    timestamps = TimestampFile.read(folder / "timestamps.txt")
    files = timestamped(files, timestamps, ledger)
    if not len(files):
        return None
    rows = in_order(files.numbers, timestamps, ledger)
    files = NumberedFiles(files.folder, files.numbers[rows], tuple(files.paths[k] for k in rows.tolist()))
    return _Stream(files, timestamps.values_ns[files.numbers], timestamps)


def _is_rectified(drive: RawDrive, cameras: Mapping[int, _Stream], ledger: Ledger) -> bool:
    """Whether images are rectified: the folder's name says it, else the images' size."""
    if drive.kind is not None or not cameras:
        return drive.kind != "extract"
    number, stream = next(iter(cameras.items()))
    sizes = image_sizes(drive.calibration, number)
    size = image_size(stream.files.paths[0])
    found = sizes[True] == size or sizes[False] != size
    kind = "rectified" if found else "as recorded"
    message = f"the folder's name says neither sync nor extract: by their size, images are taken as {kind}"
    ledger.note(WarningKind.ASSUMED, "rectified", str(drive.folder), message)
    return found


def _rotations(folder: Path, sweeps: _Stream, ledger: Ledger) -> tuple[Int64Array, RotationTimes | None]:
    """When sweeps began, and their rotations: by the files of starts and ends, where there are both."""
    locations = [folder / f"timestamps_{name}.txt" for name in ("start", "end")]
    if not all(location.is_file() for location in locations):
        message = (
            "no timestamps_start.txt and timestamps_end.txt: the time at which the lidar looks ahead is taken as the "
            "sweep's start"
        )
        ledger.note(WarningKind.ASSUMED, "sweep-start", str(folder), message)
        return sweeps.timestamps_ns, None
    found = []
    for location in locations:
        timestamps = TimestampFile.read(location)
        if len(timestamps.values_ns) < len(sweeps.timestamps.values_ns):
            counts = (
                f"{len(timestamps.values_ns)} times for {len(sweeps.timestamps.values_ns)} of timestamps.txt"
            )
            raise DataError(location, "", f"{counts}; expected as many")
        found.append(timestamps.values_ns[sweeps.files.numbers])
    starts, ends = found
    wrong = np.flatnonzero((starts > sweeps.timestamps_ns) | (ends < sweeps.timestamps_ns) | (starts >= ends))
    if len(wrong):
        number = int(sweeps.files.numbers[wrong[0]])
        problem = "start, forward and end of the sweep are not in this order; expected rising times"
        ledger.fault(
            "rotations-out-of-order", DataError(locations[0], f"line {number + 1}", problem), count=len(wrong)
        )
        return sweeps.timestamps_ns, None
    message = (
        "times of points are derived from their directions: the scanner rotates counter-clockwise from "
        "timestamps_start, "
        "looks ahead at timestamps, and ends at timestamps_end"
    )
    ledger.note(WarningKind.ASSUMED, "point-times", str(folder), message)
    order = np.diff(starts) <= 0
    if order.any():
        number = int(sweeps.files.numbers[int(np.argmax(order)) + 1])
        raise DataError(
            locations[0], f"line {number + 1}", "is not later than the frame's before; expected rising times"
        )
    return starts, RotationTimes(starts, sweeps.timestamps_ns, ends)


def _oxts(
    drive: RawDrive, lines: _Stream | None, calibration: RawCalibration, ledger: Ledger, *, others: bool
) -> tuple[tuple[Sensor, ...], Trajectory | None]:
    """The sensors and the trajectory of the OXTS unit; without its mounting, only the receiver."""
    if lines is None:
        return (), None
    values = as_table([_one_line(path) for path in lines.files.paths], 30)
    location = str(drive.folder / "oxts")
    values, timestamps = rising(values, lines.timestamps_ns, location, ledger)
    sensors, trajectory = oxts_sensors(values, timestamps, location, ledger)
    if calibration.lidar_from_imu is not None or not others:
        return sensors, trajectory
    message = "no calib_imu_to_velo.txt: the trajectory and the IMU of the OXTS unit cannot be used"
    ledger.note(WarningKind.SKIPPED, "no-imu-mounting", str(drive.calibration), message)
    return tuple(sensor for sensor in sensors if not isinstance(sensor, ImuSensor)), None


def _one_line(path: Path) -> list[float]:
    values: Float64Array = read_fields(path)
    if len(values) != 1:
        raise DataError(path, "", f"{len(values)} lines; expected one")
    row: list[float] = values[0].tolist()
    return row
