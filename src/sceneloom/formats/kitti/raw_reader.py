"""Read a drive of KITTI's raw data: calibration, timestamps, sweeps, images, OXTS and tracklets."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from xml.etree import ElementTree as ET

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.errors import CalibrationError, DataError, OptionError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.base.images import images_image_size
from sceneloom.formats.base.text_tables import TimestampError, parse_timestamp
from sceneloom.formats.base.xml_files import xml_root
from sceneloom.formats.kitti.calibration import KittiCalibration, rotation_of
from sceneloom.formats.kitti.oxts import oxts_sensors, read_fields
from sceneloom.formats.kitti.sensors import LIDAR_ID, camera_sensor, kitti_metadata, lidar_sensor, stationary
from sceneloom.formats.kitti.spec import CALIBRATION_FILES, DRIVE_NAME, IMAGES, RAW_CAMERAS, SWEEPS, TEXTS, raw_drives
from sceneloom.formats.kitti.text import (
    LARGEST,
    NumberedFiles,
    as_table,
    frames_within,
    note_unread,
    numbered_files,
    read_entries,
    read_lines,
)
from sceneloom.geometry.euler import AngleUnit, cuboid_angles_from_rotation, rotation_from_cuboid_angles
from sceneloom.geometry.rigid import RigidTransform, matrix_from_quaternion
from sceneloom.scene.annotations import Annotation, AttributePath, CuboidAnnotation, CuboidPath
from sceneloom.scene.motion import ImuSensor
from sceneloom.scene.poses import Poses, PoseSource, Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.warnings import WarningKind

CAM_TO_CAM, VELO_TO_CAM, IMU_TO_VELO = CALIBRATION_FILES

_COUNTS = {"S": 2, "K": 9, "D": 5, "R": 9, "T": 3, "S_rect": 2, "R_rect": 9, "P_rect": 12}
"""How many numbers each entry of a camera has. Source: the readme of the raw data's development kit."""


class _RawFile:
    """One file of named numbers."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise DataError(path, "", "is missing; the calibration of a day is beside its drives")
        self.path, self.lines = path, read_entries(path)

    def numbers(self, name: str) -> Float64Array:
        """The numbers of an entry; of one of a camera, `name` ends with the camera's number."""
        if name not in self.lines:
            raise DataError(self.path, "", f"no {name}; it has {', '.join(self.lines) or 'nothing'}")
        kind, _, number = name.rpartition("_")
        return self.lines[name].entry(_COUNTS[kind if number.isdigit() else name])

    def rigid(self, ending: str = "") -> RigidTransform:
        """The transform of the entries R and T, with an ending."""
        rotation = f"R{ending}"
        matrix = self.numbers(rotation).reshape(3, 3)
        try:
            return RigidTransform(rotation_of(self.lines[rotation], matrix), self.numbers(f"T{ending}"))
        except CalibrationError as error:
            raise self.lines[rotation].fault(str(error)) from error

    def size(self, name: str) -> tuple[int, int]:
        """Width and height of images [px]."""
        width, height = self.numbers(name).tolist()
        if not (width == int(width) > 0 and height == int(height) > 0):
            raise self.lines[name].fault(f"{width:g} {height:g}; expected whole numbers of pixels above 0")
        return int(width), int(height)

    @property
    def texts(self) -> dict[str, str]:
        """The text behind each name."""
        return {name: " ".join(line.words[1:]) for name, line in self.lines.items()}


@dataclass(frozen=True, slots=True, eq=False)
class _RawCalibration:
    """Calibration of a drive; camera models and `camera_from_lidar` by number of the camera."""

    camera_models: Mapping[int, Camera]
    camera_from_lidar: Mapping[int, RigidTransform]
    lidar_from_imu: RigidTransform | None  # None where the day has no such file
    texts: dict[str, dict[str, str]]  # entries of the files, by file and name


def read_raw_calibration(folder: Path, cameras: tuple[int, ...], *, rectified: bool) -> _RawCalibration:
    """Read the calibration of a day.

    Args:
        folder: of the files.
        cameras: numbers of those that are needed; without any, the cameras' files may be missing.
        rectified: whether images are rectified, or as the cameras took them.

    Raises:
        DataError: a file or an entry is missing or wrong.
    """
    texts: dict[str, dict[str, str]] = {}
    camera_models: dict[int, Camera] = {}
    mounts: dict[int, RigidTransform] = {}
    if cameras:
        between, lidar = _RawFile(folder / CAM_TO_CAM), _RawFile(folder / VELO_TO_CAM)
        texts |= {CAM_TO_CAM: between.texts, VELO_TO_CAM: lidar.texts}
        first_from_lidar = lidar.rigid()
        read = _rectified_camera if rectified else _recorded_camera
        for number in cameras:
            camera_models[number], camera_from_first = read(between, f"_{number:02d}")
            mounts[number] = camera_from_first @ first_from_lidar
    lidar_from_imu = None
    if (folder / IMU_TO_VELO).is_file():
        unit = _RawFile(folder / IMU_TO_VELO)
        texts[IMU_TO_VELO] = unit.texts
        lidar_from_imu = unit.rigid()
    return _RawCalibration(camera_models, mounts, lidar_from_imu, texts)


def _rectified_camera(file: _RawFile, ending: str) -> tuple[Camera, RigidTransform]:
    """The camera model of a rectified camera, and what takes the frame of camera 0, as recorded, into its own."""
    file.numbers(f"P_rect{ending}")
    rectified = KittiCalibration.of_projection(file.lines[f"P_rect{ending}"])
    numbers = file.numbers("R_rect_00").reshape(3, 3)
    rotation = rotation_of(file.lines["R_rect_00"], numbers)
    camera_from_first = rectified.camera_from_lidar(0) @ RigidTransform(rotation, np.zeros(3))
    return rectified.camera(0, file.size(f"S_rect{ending}")), camera_from_first


def _recorded_camera(file: _RawFile, ending: str) -> tuple[Camera, RigidTransform]:
    """The model of a camera as it recorded (OpenCV's k1 k2 p1 p2 k3), and what takes camera 0's frame into its own."""
    k = file.numbers(f"K{ending}").reshape(3, 3)
    if not (k[0, 0] > 0 and k[1, 1] > 0 and k[2].tolist() == [0, 0, 1] and k[0, 1] == k[1, 0] == 0):
        expected = "rows (f, 0, c), (0, f, c), (0, 0, 1) with focal lengths above 0"
        raise file.lines[f"K{ending}"].fault(f"{k.tolist()}; expected {expected}")
    pinhole = Camera("pinhole", *file.size(f"S{ending}"), *k[[0, 1, 0, 1], [0, 1, 2, 2]].tolist())
    distortion = file.numbers(f"D{ending}").tolist()
    if not any(distortion):
        return pinhole, file.rigid(ending)
    # `brown_conrady` begins as OpenCV's; further coefficients are 0
    count = len(MODELS["brown_conrady"].coefficient_names)
    coefficients = (*distortion, *(0.0,) * (count - len(distortion)))
    return replace(pinhole, model="brown_conrady", coefficients=coefficients), file.rigid(ending)


@dataclass(frozen=True, slots=True, eq=False)
class TimestampFile:
    """The times of one stream, by number of the frame."""

    path: Path
    values_ns: Int64Array
    reported: BoolArray  # false where the line is blank: the frame is not there

    @classmethod
    def read(cls, path: Path) -> "TimestampFile":
        """Read a file of times."""
        if not path.is_file():
            raise DataError(path, "", "is missing; expected the time of each frame, a line each")
        lines = read_lines(path)
        if not lines:
            raise DataError(path, "", "is empty; expected the time of each frame, a line each")
        values = np.zeros(len(lines), np.int64)
        for k, line in enumerate(lines):
            try:
                values[k] = parse_timestamp(" ".join(line.words), None) if line.words else 0
            except TimestampError as error:
                raise line.fault(str(error)) from None
        return cls(path, values, np.array([bool(line.words) for line in lines], np.bool_))


def timestamped(files: NumberedFiles, timestamps: TimestampFile, ledger: Ledger) -> NumberedFiles:
    """The files that have a time; frames without a file between others are left out with a warning."""
    count = len(timestamps.values_ns)
    files = frames_within(files, count, timestamps.path, ledger)
    untold = [number for number in files.numbers.tolist() if not timestamps.reported[number]]
    if untold:
        fault = DataError(
            timestamps.path, f"line {untold[0] + 1}", "is blank; expected the time of a file that is there"
        )
        ledger.fault("files-without-time", fault, count=len(untold))
        files = files.only([bool(timestamps.reported[number]) for number in files.numbers.tolist()])
    missing = np.setdiff1d(np.flatnonzero(timestamps.reported), files.numbers)
    if len(missing) and (not len(files) or missing[-1] > files.numbers[-1]):
        problem = (
            f"{len(files)} files for {count} times of {timestamps.path.name}, the last of them is missing (number "
            f"{int(missing[-1])}); expected as many"
        )
        ledger.fault("counts-disagree", DataError(files.folder, "", problem), count=len(missing))
    elif len(missing):
        message = f"frames without a file, number {int(missing[0])} the first of them"
        ledger.note(WarningKind.SKIPPED, "frames-missing", str(files.folder), message, count=len(missing))
    return files


def in_order(numbers: Int64Array, timestamps: TimestampFile, ledger: Ledger) -> Int64Array:
    """Give the rows of numbers in the order of their times; of two of one time the first stays."""
    times = timestamps.values_ns[numbers]
    _, rows = np.unique(times, return_index=True)
    back = int((np.diff(times) < 0).sum())
    if back:
        message = "times run backwards in the order of the numbers; sorted by time"
        ledger.note(WarningKind.REPAIRED, "files-sorted", str(timestamps.path), message, count=back)
    if len(rows) < len(numbers):
        message, lost = "frames with the time of another one", len(numbers) - len(rows)
        ledger.note(WarningKind.SKIPPED, "repeated-times", str(timestamps.path), message, count=lost)
    return rows.astype(np.int64)


FILE = "tracklet_labels.xml"
POSE_FIELDS = ("tx", "ty", "tz", "rx", "ry", "rz", "state", "occlusion", "occlusion_kf", "truncation")

FURTHER_FIELDS = ("amt_occlusion", "amt_occlusion_kf", "amt_border_l", "amt_border_r", "amt_border_kf")
"""Fields of a pose: position of the centre of the bottom face and angles in the lidar's frame, and its visibility;
then what several annotators stated of it, which old files lack. Source: the development kit's tracklets.h."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracklet:
    """One object.

    Attributes:
        label: its class.
        size_hwl: height, width, length [m].
        first_frame: number of its first frame.
        poses: (N, 15) float64, `POSE_FIELDS` and `FURTHER_FIELDS`, one row a frame; -1 where nothing is reported.
    """

    label: str
    size_hwl: tuple[float, float, float]
    first_frame: int
    poses: Float64Array


def _read_tracklets(path: Path) -> list[Tracklet]:
    """Read a file of tracklets."""
    root = xml_root(path, read_bytes(path))
    listed = root.find("tracklets")
    if listed is None:
        raise DataError(path, root.tag, "holds no `tracklets`; expected boost_serialization/tracklets")
    return [_tracklet(path, f"tracklets/item[{k}]", item) for k, item in enumerate(listed.findall("item"))]


def _tracklet(path: Path, location: str, item: ET.Element) -> Tracklet:
    label = (item.findtext("objectType") or "").strip()
    if not label:
        raise DataError(path, location, "no objectType; expected a class, as Car")
    height, width, length = (_number(path, location, item, name) for name in "hwl")
    if min(height, width, length) <= 0:
        raise DataError(path, location, f"h {height:g}, w {width:g}, l {length:g}; expected sizes above 0")
    first = _number(path, location, item, "first_frame")
    if first != int(first) or first < 0:
        raise DataError(path, f"{location}/first_frame", f"{first:g}; expected a whole number of 0 or more")
    poses = item.find("poses")
    rows = [] if poses is None else poses.findall("item")
    if not rows:
        raise DataError(path, f"{location}/poses", "holds none; expected one for each frame")
    return Tracklet(label, (height, width, length), int(first), _poses(path, f"{location}/poses", rows))


def _poses(path: Path, location: str, rows: Sequence[ET.Element]) -> Float64Array:
    values = np.full((len(rows), len(POSE_FIELDS) + len(FURTHER_FIELDS)), -1.0)
    for k, row in enumerate(rows):
        for column, name in enumerate(POSE_FIELDS):
            values[k, column] = _number(path, f"{location}/item[{k}]", row, name)
        for column, name in enumerate(FURTHER_FIELDS, len(POSE_FIELDS)):
            if row.find(name) is not None:
                values[k, column] = _number(path, f"{location}/item[{k}]", row, name)
    return values


def _number(path: Path, location: str, item: ET.Element, name: str) -> float:
    text = item.findtext(name)
    try:
        value = float(text or "")
    except ValueError:
        value = float("nan")
    if not abs(value) <= LARGEST:
        shown = "nothing" if text is None else repr(text[:40])
        raise DataError(path, f"{location}/{name}", f"{shown}; expected a number within ±{LARGEST:g}")
    return value


ORDER = "zyx"
"""Of a pose's three angles, Rz(rz) Ry(ry) Rx(rx); KITTI's own files have none but rz."""

STATES = (*POSE_FIELDS[6:], *FURTHER_FIELDS)
"""What poses state beside locations: attributes of the boxes."""


def _tracklet_annotations(
    tracklets: Sequence[Tracklet],
    path: Path,
    times_ns: Mapping[int, int],
    trajectory: Poses | None,
    ego_from_lidar: RigidTransform,
    ledger: Ledger,
) -> tuple[Annotation, ...]:
    """A cuboid for each tracklet, its location in the file as id; `times_ns` by number of the frame."""
    source = None if trajectory is None else PoseSource(trajectory, ego_from_lidar)
    last = max(times_ns, default=-1)
    found: list[Annotation] = []
    for k, tracklet in enumerate(tracklets):
        numbers = range(tracklet.first_frame, tracklet.first_frame + len(tracklet.poses))
        if numbers[-1] > last:
            fault = DataError(path, f"tracklets/item[{k}]", f"frame {numbers[-1]}; the drive's last is {last}")
            ledger.fault("frames-beyond", fault)
        rows = [row for row, number in enumerate(numbers) if number in times_ns]
        timestamps = np.array([times_ns[numbers[row]] for row in rows], np.int64)
        if source is None or not rows:
            continue
        lidar = source.at(timestamps)
        values = _rows(tracklet, tracklet.poses[rows], _matrix_from_known(lidar.quaternions_xyzw), lidar.positions)
        known = np.isfinite(values).all(axis=1)
        if not known.all():
            message = "boxes in frames beyond the ego trajectory"
            ledger.note(WarningKind.SKIPPED, "boxes-beyond-trajectory", str(path), message, count=int((~known).sum()))
        if known.any():
            poses = tracklet.poses[rows][known]
            box = CuboidAnnotation(k, CuboidPath(timestamps[known], values[known]), label=tracklet.label)
            reported = _reported(poses, timestamps[known])
            found.append(replace(box, attributes=reported))
    return tuple(found)


def _reported(poses: Float64Array, timestamps_ns: Int64Array) -> tuple[AttributePath, ...]:
    """What poses state beside locations; -1 says nothing."""
    columns = {name: poses[:, 6 + column].tolist() for column, name in enumerate(STATES)}
    columns = {name: tuple(int(v) if v == int(v) else v for v in values) for name, values in columns.items()}
    return tuple(
        AttributePath(name, values, timestamps_ns, LIDAR_ID)
        for name, values in columns.items()
        if any(value != -1 for value in values)
    )


def _matrix_from_known(quaternions_xyzw: Float64Array) -> Float64Array:
    """(N, 3, 3) rotations of (N, 4) quaternions; NaN where these are."""
    known = np.isfinite(quaternions_xyzw[:, 0])
    matrices = np.full((len(quaternions_xyzw), 3, 3), np.nan)
    if known.any():
        matrices[known] = matrix_from_quaternion(quaternions_xyzw[known])
    return matrices


def _rows(
    tracklet: Tracklet, poses: Float64Array, world_from_lidar: Float64Array, origins_world: Float64Array
) -> Float64Array:
    """Rows of a cuboid, (N, 9) float64; NaN where the lidar's location is not known."""
    height, width, length = tracklet.size_hwl
    lidar_from_box = rotation_from_cuboid_angles(poses[:, 3:6], unit=AngleUnit.RADIANS, order=ORDER)
    centers_lidar = poses[:, :3] + lidar_from_box @ np.array([0.0, 0.0, height / 2])
    centers = np.einsum("nij,nj->ni", world_from_lidar, centers_lidar) + origins_world
    angles = cuboid_angles_from_rotation(world_from_lidar @ lidar_from_box)
    sizes = np.tile([length, width, height], (len(poses), 1))
    return np.concatenate([sizes, centers, angles], axis=1)


@dataclass(frozen=True, slots=True)
class _RawDrive:
    """A drive's folder, and that of its calibration files.

    Its kind is "sync" (rectified images, one of each sensor in each frame), "extract" (as recorded), or None where the
    folder's name does not state it.
    """

    folder: Path
    calibration: Path
    kind: str | None


def _find_drive(path: Path, wanted: str | None = None) -> _RawDrive:
    """Find the only drive of a folder, or the wanted one: the drive's own folder, that of its day, or the one above."""
    found = raw_drives(path)
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


def _drive(folder: Path) -> _RawDrive:
    match = DRIVE_NAME.fullmatch(folder.resolve().name)
    locations = (folder, folder / "calib", folder.resolve().parent)
    calibration = next(
        (location for location in locations if any((location / name).is_file() for name in CALIBRATION_FILES)),
        locations[-1],
    )
    return _RawDrive(folder, calibration, None if match is None else match["kind"])


@dataclass(frozen=True, slots=True, eq=False)
class _Stream:
    """Files of one sensor in the order of their times."""

    files: NumberedFiles
    timestamps_ns: Int64Array
    timestamps: TimestampFile


def open_raw(path: Path, *, sequence: str | None = None, lenient: bool = False) -> Scene:
    """Open a drive: its own folder, that of its day, or one of days.

    Args:
        sequence: the drive, as `0001`, `0001_sync` or its folder's name, where there are several.

    Raises:
        OptionError: there are several drives and none was chosen.
    """
    drive = _find_drive(path, sequence)
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        return _open(drive, ledger)


def _open(drive: _RawDrive, ledger: Ledger) -> Scene:
    note_unread(drive.folder, (*RAW_CAMERAS, "velodyne_points", "oxts", FILE, *CALIBRATION_FILES), ledger)
    cameras = {
        number: stream
        for number, name in enumerate(RAW_CAMERAS)
        if (stream := _stream(drive.folder / name, IMAGES, ledger)) is not None
    }
    sweeps = _stream(drive.folder / "velodyne_points", (*SWEEPS, *TEXTS), ledger)
    lines = _stream(drive.folder / "oxts", TEXTS, ledger)
    if not cameras and sweeps is None and lines is None:
        raise DataError(drive.folder, "", "holds no files; expected those of image_02, velodyne_points or oxts")
    rectified = _is_rectified(drive, cameras, ledger)
    needed = tuple(cameras) if cameras or sweeps is None or lines is None else ()
    calibration = read_raw_calibration(drive.calibration, needed, rectified=rectified)
    own, trajectory = _oxts(drive, lines, calibration, ledger, others=bool(cameras) or sweeps is not None)
    tracklets = drive.folder / FILE
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
        sensors.append(lidar_sensor(sweeps.files, timestamps, ego_from_lidar, poses, ledger, rotations=rotations))
    for number, stream in cameras.items():
        mount = ego_from_lidar @ calibration.camera_from_lidar[number].inverse()
        camera_model = calibration.camera_models[number]
        sensors.append(camera_sensor(number, stream.files, stream.timestamps_ns, camera_model, mount, poses))
    annotations: tuple[Annotation, ...] = ()
    if tracklets.is_file() and reference is not None:
        frames = dict(zip(reference.files.numbers.tolist(), reference.timestamps_ns.tolist(), strict=True))
        found = _read_tracklets(tracklets)
        annotations = _tracklet_annotations(found, tracklets, frames, poses, ego_from_lidar, ledger)
    reported = {"drive": drive.folder.resolve().name, "rectified": rectified, "calibration": calibration.texts}
    return Scene(
        (*sensors, *own),
        annotations=annotations,
        trajectories=MappingProxyType({} if trajectory is None else {trajectory.name: trajectory}),
        metadata=kitti_metadata("raw", **reported),
        source=str(drive.folder),
        format="kitti-raw",
        warnings=ledger.warnings,
    )


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


def _is_rectified(drive: _RawDrive, cameras: Mapping[int, _Stream], ledger: Ledger) -> bool:
    """Whether images are rectified: the folder's name says it, else the images' size."""
    if drive.kind is not None or not cameras:
        return drive.kind != "extract"
    number, stream = next(iter(cameras.items()))
    file = _RawFile(drive.calibration / CAM_TO_CAM)
    size = images_image_size(stream.files.paths[0])
    found = file.size(f"S_rect_{number:02d}") == size or file.size(f"S_{number:02d}") != size
    kind = "rectified" if found else "as recorded"
    message = f"the folder's name says neither sync nor extract: by their size, images are taken as {kind}"
    ledger.note(WarningKind.ASSUMED, "rectified", str(drive.folder), message)
    return found


def _rotations(
    folder: Path, sweeps: _Stream, ledger: Ledger
) -> tuple[Int64Array, tuple[Int64Array, Int64Array, Int64Array] | None]:
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
            counts = f"{len(timestamps.values_ns)} times for {len(sweeps.timestamps.values_ns)} of timestamps.txt"
            raise DataError(location, "", f"{counts}; expected as many")
        found.append(timestamps.values_ns[sweeps.files.numbers])
    starts, ends = found
    wrong = np.flatnonzero((starts > sweeps.timestamps_ns) | (ends < sweeps.timestamps_ns) | (starts >= ends))
    if len(wrong):
        number = int(sweeps.files.numbers[wrong[0]])
        problem = "start, forward and end of the sweep are not in this order; expected rising times"
        ledger.fault("rotations-out-of-order", DataError(locations[0], f"line {number + 1}", problem), count=len(wrong))
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
    return starts, (starts, sweeps.timestamps_ns, ends)


def _oxts(
    drive: _RawDrive, lines: _Stream | None, calibration: _RawCalibration, ledger: Ledger, *, others: bool
) -> tuple[tuple[Sensor, ...], Trajectory | None]:
    """The sensors and the trajectory of the OXTS unit; without its mounting, only the receiver."""
    if lines is None:
        return (), None
    values = as_table([_one_line(path) for path in lines.files.paths], 30)
    location = str(drive.folder / "oxts")
    values, timestamps = _rising(values, lines.timestamps_ns, location, ledger)
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


def _rising(
    values: Float64Array, timestamps_ns: Int64Array, location: str, ledger: Ledger
) -> tuple[Float64Array, Int64Array]:
    """Bring lines into the order of their times; of several of one time the first stays."""
    back = int((np.diff(timestamps_ns) < 0).sum())
    if back:
        ledger.note(WarningKind.REPAIRED, "samples-sorted", location, "times run backwards; sorted by time", count=back)
    times, rows = np.unique(timestamps_ns, return_index=True)
    lost = len(timestamps_ns) - len(times)
    if lost:
        ledger.note(WarningKind.SKIPPED, "repeated-times", location, "lines with the time of another one", count=lost)
    return values[rows], times.astype(np.int64)
