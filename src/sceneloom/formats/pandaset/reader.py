"""Read a drive of PandaSet: two lidars in one file, cameras, satellite fixes, cuboids and classes of points."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast, overload

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.images import ImageReader, images_image_size
from sceneloom.formats.base.json_files import read_json
from sceneloom.formats.base.poses import lengths_of
from sceneloom.formats.base.spec import choose_drive, drives_in
from sceneloom.formats.pandaset.pickles import PickledFrame, read_pickled_frame
from sceneloom.formats.pandaset.spec import is_drive
from sceneloom.formats.points.mapping import FARTHEST_WORLD
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions, normalise_quaternion
from sceneloom.scene.annotations import (
    Annotation,
    AttributePath,
    CuboidAnnotation,
    CuboidPath,
    LabeledPoints,
    LabeledPointsAnnotation,
)
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import PointsFrame
from sceneloom.warnings import WarningKind

_NANOSECONDS = 1_000_000_000

_LATEST_SECONDS = 9_000_000_000
"""Times beyond this [s] are in another unit."""


class Location(msgspec.Struct):
    """A location [m]."""

    x: float
    y: float
    z: float


class Heading(msgspec.Struct):
    """A rotation, scalar first."""

    w: float
    x: float
    y: float
    z: float


class Pose(msgspec.Struct):
    """World from sensor."""

    position: Location
    heading: Heading


class _CameraModel(msgspec.Struct):
    """A pinhole [px]."""

    fx: float
    fy: float
    cx: float
    cy: float


class _Fix(msgspec.Struct):
    """A satellite fix: degrees, metres, metres a second."""

    lat: float
    long: float
    height: float
    xvel: float | None = None
    yvel: float | None = None


def _read_times(path: Path, count: int) -> Int64Array:
    """Read times [s] of `count` frames as nanoseconds, exactly as they are written."""
    seconds = read_json(path, list[Decimal])
    if len(seconds) != count:
        raise DataError(path, "", f"{len(seconds)} times; expected {count}, one for each frame")
    for k, time in enumerate(seconds):
        if not abs(time) <= _LATEST_SECONDS:
            raise DataError(path, f"[{k}]", f"{time}; expected seconds")
        if k and time <= seconds[k - 1]:
            raise DataError(path, f"[{k}]", f"{time} after {seconds[k - 1]}; expected later times")
    return np.array([round(time * _NANOSECONDS) for time in seconds], np.int64)


def _read_poses(path: Path, count: int) -> tuple[Float64Array, Float64Array]:
    """Read poses of `count` frames: positions (N, 3) [m] and unit quaternions (N, 4), scalar last."""
    poses = read_json(path, list[Pose])
    if len(poses) != count:
        raise DataError(path, "", f"{len(poses)} poses; expected {count}, one for each frame")
    positions = np.array([[p.position.x, p.position.y, p.position.z] for p in poses]).reshape(-1, 3)
    quaternions = np.array([[p.heading.x, p.heading.y, p.heading.z, p.heading.w] for p in poses])
    quaternions = quaternions.reshape(-1, 4)
    wrong = np.flatnonzero(lengths_of(quaternions)[1])
    if len(wrong):
        k = int(wrong[0])
        w, *xyz = np.roll(quaternions[k], 1).tolist()
        raise DataError(path, f"[{k}].heading", f"w, x, y, z = {[w, *xyz]}; expected length 1")
    return positions, normalise_quaternion(quaternions) if count else quaternions


def _as_dict(row: Any) -> dict[str, Any]:
    """The fields of a row."""
    return msgspec.structs.asdict(row)


_LIDARS = ("main_pandar64", "front_gt")
"""The lidars by their number in the column `d`; the names are those of the published static calibration."""

_TRAJECTORY = "pose"
"""The name of the ego trajectory."""

_LIDAR_FROM_EGO = RigidTransform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
"""PandaSet's own frame has x right and y forward; an ego here has x forward and y left."""

_LARGEST_BYTE = 255


@dataclass(frozen=True, slots=True, eq=False)
class _Sweeps:
    """The files with the points of both lidars.

    Attributes:
        folder: `lidar` of the drive.
        files: of each sweep.
        timestamps_ns: (N,) int64 [ns].
        poses: world from main lidar, at each sweep.
    """

    folder: Path
    files: tuple[Path, ...]
    timestamps_ns: Int64Array
    poses: Poses


def _read_sweeps(drive: Path) -> _Sweeps:
    """Find the sweeps of a drive, their times and poses; no point is read."""
    folder = drive / "lidar"
    files = tuple(_numbered_files(folder, r"\.pkl(\.gz)?"))
    if not files:
        raise DataError(folder, "", "no sweep; expected files such as 00.pkl.gz")
    timestamps_ns = _read_times(folder / "timestamps.json", len(files))
    positions, quaternions = _read_poses(folder / "poses.json", len(files))
    return _Sweeps(folder, files, timestamps_ns, Poses(timestamps_ns, positions, quaternions))


def _trajectory_of(sweeps: _Sweeps) -> Trajectory:
    """The ego trajectory: where the main lidar was, with x forward."""
    rotation = _LIDAR_FROM_EGO.quaternion_xyzw
    quaternions = multiply_quaternions(sweeps.poses.quaternions_xyzw, rotation)
    return Trajectory(_TRAJECTORY, sweeps.timestamps_ns, sweeps.poses.positions, quaternions)


def _rows_of_lidar(frame: PickledFrame, number: int) -> BoolArray:
    """(N,) bool: which rows of a sweep are points of a lidar; without a column `d` all are the main lidar's."""
    if "d" not in frame.columns:
        return np.full(frame.count, number == 0)
    chosen: BoolArray = frame.numbers("d") == number
    return chosen


@dataclass(frozen=True, slots=True, eq=False)
class SweepFiles:
    """Reads the sweeps of one lidar out of files that hold those of both.

    Attributes:
        files: of each sweep.
        timestamps_ns: (N,) int64 [ns].
        number: of the lidar in the column `d`.
    """

    files: tuple[Path, ...]
    timestamps_ns: Int64Array
    number: int

    def __call__(self, k: int) -> LidarFrame:
        """Read sweep `k`."""
        frame = read_pickled_frame(self.files[k])
        chosen = _rows_of_lidar(frame, self.number)
        positions = np.stack([frame.numbers(axis)[chosen] for axis in "xyz"], axis=1)
        if len(positions) and np.abs(positions).max() > FARTHEST_WORLD:
            problem = f"points {np.abs(positions).max():.0f} m from the world's origin; expected {FARTHEST_WORLD:g} m"
            raise DataError(self.files[k], "", f"{problem} at most")
        extras: dict[str, AnyArray] = {}
        points = LidarPoints(
            positions=read_only(positions, np.float32),
            intensities=self._intensities(frame, chosen, extras),
            timestamps_ns=self._times(frame, chosen),
            extras=MappingProxyType(extras),
        )
        timestamp_ns = int(self.timestamps_ns[k])
        return LidarFrame(timestamp_ns, points, MappingProxyType({"file": f"lidar/{self.files[k].name}"}))

    @staticmethod
    def _intensities(frame: PickledFrame, chosen: BoolArray, extras: dict[str, AnyArray]) -> AnyArray:
        """Brightness from 0 to 255; what rounding changes of it is kept beside it."""
        given = frame.numbers("i")[chosen]
        rounded = np.clip(np.rint(given), 0, _LARGEST_BYTE)
        if not np.array_equal(rounded, given):
            extras["i"] = read_only(given)
        return read_only(rounded, np.uint8)

    @staticmethod
    def _times(frame: PickledFrame, chosen: BoolArray) -> AnyArray:
        seconds = frame.numbers("t")[chosen]
        if len(seconds) and np.abs(seconds).max() > _LATEST_SECONDS:
            raise DataError(frame.file, "t", f"{seconds.max():g}; expected seconds")
        return read_only(np.rint(seconds * _NANOSECONDS), np.int64)


def _build_lidars(sweeps: _Sweeps) -> list[Sensor]:
    """Build the lidar that rotations and the one that looks ahead; of the latter the location is not reported."""
    main, front = (
        LazyFrames(sweeps.timestamps_ns, SweepFiles(sweeps.files, sweeps.timestamps_ns, number))
        for number in range(len(_LIDARS))
    )
    mount = _LIDAR_FROM_EGO.inverse()
    return [
        LidarSensor(_LIDARS[0], main, sweeps.poses, mount, points_frame=PointsFrame.WORLD, model="Pandar64"),
        LidarSensor(_LIDARS[1], front, points_frame=PointsFrame.WORLD, model="PandarGT"),
    ]


def _build_cameras(drive: Path, ledger: Ledger) -> list[Sensor]:
    """Build the cameras, each with its own poses at its own times."""
    folders = sorted(child for child in (drive / "camera").glob("*") if child.is_dir())
    if not folders:
        message = "no camera; only sweeps are read"
        ledger.note(WarningKind.SKIPPED, "cameras-missing", str(drive / "camera"), message)
    return [_camera(folder) for folder in folders]


def _camera(folder: Path) -> CameraSensor:
    files = tuple(_numbered_files(folder, r"\.jpg"))
    if not files:
        raise DataError(folder, "", "no image; expected files such as 00.jpg")
    timestamps_ns = _read_times(folder / "timestamps.json", len(files))
    positions, quaternions = _read_poses(folder / "poses.json", len(files))
    camera_model = read_json(folder / "intrinsics.json", _CameraModel)
    try:
        camera = Camera(
            "pinhole",
            *images_image_size(files[0]),
            camera_model.fx,
            camera_model.fy,
            camera_model.cx,
            camera_model.cy,
        )
    except CalibrationError as error:
        raise DataError(folder / "intrinsics.json", "", str(error)) from error
    names = tuple(f"camera/{folder.name}/{file.name}" for file in files)
    return CameraSensor(
        id=folder.name,
        camera=camera,
        images=LazyFrames(timestamps_ns, ImageReader(files, names, timestamps_ns, camera)),
        poses=Poses(timestamps_ns, positions, quaternions),
    )


def _build_receiver(drive: Path) -> list[Sensor]:
    """Build the satellite receiver; [] where the drive has no fixes."""
    file = drive / "meta" / "gps.json"
    if not file.is_file():
        return []
    fixes = read_json(file, list[_Fix])
    timestamps_ns = _read_times(drive / "meta" / "timestamps.json", len(fixes))
    locations = np.array([[fix.lat, fix.long, fix.height] for fix in fixes]).reshape(-1, 3)
    unknown = np.full(len(fixes), np.nan)
    velocities = {
        name: tuple(_as_dict(fix)[name] for fix in fixes)
        for name in ("xvel", "yvel")
        if any(_as_dict(fix)[name] is not None for fix in fixes)
    }
    return [GnssSensor("gps", timestamps_ns, locations, unknown, unknown, extras=MappingProxyType(velocities))]


_LABEL = "label"
_STATED = ("camera_used",)
_STATED_PREFIXES = ("attributes.", "cuboids.")

_NOTHING = ("None", "", "-", "nan", "-1")
"""Values, as texts, by which the files state nothing."""


@dataclass(slots=True)
class _Track:
    """What is stated about one object, sweep by sweep."""

    label: str
    stationary: bool | None
    timestamps_ns: list[int] = field(default_factory=list)
    values: list[Float64Array] = field(default_factory=list)
    stated: dict[str, dict[int, Any]] = field(default_factory=dict)

    def says(self, key: str) -> bool:
        """Whether something is stated at all; of the label, whether it changes."""
        values = [str(value) for value in self.stated[key].values()]
        return len(set(values)) > 1 if key == _LABEL else any(value not in _NOTHING for value in values)


def _build_cuboids(drive: Path, sweeps: _Sweeps, ledger: Ledger) -> tuple[CuboidAnnotation, ...]:
    """Build a cuboid for each uuid, in the order in which they come up; () where there are no annotations."""
    timestamps = _timestamps_of(drive / "annotations" / "cuboids", sweeps)
    tracks: dict[str, _Track] = {}
    for file, timestamp_ns in timestamps.items():
        try:
            _add(tracks, read_pickled_frame(file), timestamp_ns)
        except DataError as error:
            ledger.fault("cuboids", error)
    return tuple(_cuboid(name, track) for name, track in tracks.items())


def _timestamps_of(folder: Path, sweeps: _Sweeps) -> dict[Path, int]:
    """The files of annotations, and the time of the sweep with the same number [ns]."""
    times = {_number(file): int(t) for file, t in zip(sweeps.files, sweeps.timestamps_ns, strict=True)}
    files = _numbered_files(folder, r"\.pkl(\.gz)?")
    lost = [file for file in files if _number(file) not in times]
    if lost:
        raise DataError(lost[0], "", f"there is no sweep of this number in {sweeps.folder}")
    return {file: times[_number(file)] for file in files}


def _number(file: Path) -> int:
    return int(file.name.partition(".")[0])


def _add(tracks: dict[str, _Track], frame: PickledFrame, timestamp_ns: int) -> None:
    values = _values(frame)
    uuids = [str(name) for name in frame.column("uuid").tolist()]
    labels = frame.column("label").tolist()
    still = frame.columns["stationary"].tolist() if "stationary" in frame.columns else [None] * frame.count
    further = {
        name: column.tolist()
        for name, column in frame.columns.items()
        if name in _STATED or name.startswith(_STATED_PREFIXES)
    }
    if len(set(uuids)) != len(uuids):
        twice = next(name for name in uuids if uuids.count(name) > 1)
        raise DataError(frame.file, "uuid", f"{twice!r} stands twice; expected each object once")
    for row, name in enumerate(uuids):
        known = still[row] if isinstance(still[row], bool) else None
        track = tracks.setdefault(name, _Track(str(labels[row]), known))
        track.timestamps_ns.append(timestamp_ns)
        track.values.append(values[row])
        for key, column in further.items():
            track.stated.setdefault(key, {})[timestamp_ns] = column[row]
        track.stated.setdefault(_LABEL, {})[timestamp_ns] = str(labels[row])


def _values(frame: PickledFrame) -> Float64Array:
    """Rows `dx dy dz px py pz roll pitch yaw`, degrees.

    `dimensions.x` is the width, `dimensions.y` the length, and a box of yaw 0 looks along the world's y.

    Source: class Cuboids of the development kit, and its function of a box's corners.
    """
    width, length, height = (frame.numbers(f"dimensions.{axis}") for axis in "xyz")
    positions = [frame.numbers(f"position.{axis}") for axis in "xyz"]
    sizes = np.stack([length, width, height], axis=1)
    if (sizes <= 0).any():
        k = int(np.argmax((sizes <= 0).any(axis=1)))
        raise DataError(frame.file, f"row {k}: dimensions", f"{sizes[k].tolist()}; expected sizes above 0")
    yaws = np.degrees(frame.numbers("yaw")) + 90.0
    level = np.zeros(frame.count)
    return np.concatenate([sizes, np.stack([*positions, level, level, yaws], axis=1)], axis=1)


def _cuboid(name: str, track: _Track) -> CuboidAnnotation:
    timestamps_ns = np.array(track.timestamps_ns, np.int64)
    return CuboidAnnotation(
        id=name,
        path=CuboidPath(timestamps_ns, np.stack(track.values)),
        label=track.label,
        stationary=track.stationary,
        attributes=tuple(_attribute(key, stated) for key, stated in track.stated.items() if track.says(key)),
    )


def _attribute(key: str, stated: dict[int, Any]) -> AttributePath:
    """What is stated, at the times when that changes; where a text is missing it is empty."""
    name = key.removeprefix("attributes.").removeprefix("cuboids.")
    times = list(stated)
    values = [_value(name, value) for value in stated.values()]
    changes = [k for k in range(len(values)) if k == 0 or values[k] != values[k - 1]]
    return AttributePath(name, tuple(values[k] for k in changes), np.array([times[k] for k in changes], np.int64))


def _value(name: str, value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int):
        return "" if str(value) in _NOTHING else value
    return _LIDARS[value] if name == "sensor_id" and value in (0, 1) else value


_ID_PREFIX = "semseg:"
"""What ids of the annotations begin with, before the name of the class."""


class LabelFiles:
    """The classes of all points of a drive: a table for each sweep, in memory from the first use on.

    Classes of one drive are a byte a point, while finding them takes seconds, and each class asks for all.
    """

    def __init__(self, files: Mapping[int, tuple[Path, Path]], classes: Mapping[int, str]) -> None:
        """Take the files of classes and of points by number of the sweep; nothing is read."""
        self.files, self.classes = files, classes
        self._found: dict[int, list[LabeledPoints]] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_found": None}

    def of(self, number: int) -> list[LabeledPoints]:
        """The points of a class.

        Raises:
            DataError: a file is wrong, or has another number of rows than its sweep.
        """
        if self._found is None:
            self._found = self._read()
        return self._found.get(number, [])

    def _read(self) -> dict[int, list[LabeledPoints]]:
        found: dict[int, list[LabeledPoints]] = {}
        for k, (labels, points) in self.files.items():
            table, cloud = read_pickled_frame(labels), read_pickled_frame(points)
            numbers = self._numbers(table, cloud)
            for lidar, name in enumerate(_LIDARS):
                own = numbers[_rows_of_lidar(cloud, lidar)]
                order = np.argsort(own, kind="stable").astype(np.uint32)
                kinds, starts = np.unique(own[order], return_index=True)
                for kind, rows in zip(kinds.tolist(), np.split(order, starts[1:]), strict=True):
                    found.setdefault(kind, []).append(LabeledPoints(name, rows, k))
        return found

    def _numbers(self, table: PickledFrame, cloud: PickledFrame) -> Int64Array:
        """(N,) int64, the class of each point; files have them as numbers or as texts of numbers."""
        column = table.column("class")
        try:
            numbers = column.astype(np.int64)
        except (ValueError, TypeError, OverflowError) as error:
            raise DataError(table.file, "class", f"expected numbers of classes: {error}") from error
        if len(numbers) != cloud.count:
            problem = f"{len(numbers)} rows; expected {cloud.count}, one for each point of {cloud.file.name}"
            raise DataError(table.file, "", problem)
        unknown = set(np.unique(numbers).tolist()) - set(self.classes)
        if unknown:
            raise DataError(table.file, "class", f"{min(unknown)}; expected a number out of classes.json")
        return numbers


@dataclass(frozen=True, slots=True, eq=False)
class ClassPoints(Sequence[LabeledPoints]):
    """The points of one class, sweep by sweep."""

    labels: LabelFiles
    number: int

    def __len__(self) -> int:
        return len(self.labels.of(self.number))

    def __iter__(self) -> Iterator[LabeledPoints]:
        return iter(self.labels.of(self.number))

    @overload
    def __getitem__(self, index: int) -> LabeledPoints: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[LabeledPoints]: ...
    def __getitem__(self, index: int | slice) -> LabeledPoints | Sequence[LabeledPoints]:
        return self.labels.of(self.number)[index]


def _build_labelled_points(drive: Path, sweeps: _Sweeps) -> tuple[LabeledPointsAnnotation, ...]:
    """Build an annotation for each class that classes.json names; () where the drive has no such labels."""
    folder = drive / "annotations" / "semseg"
    timestamps = _timestamps_of(folder, sweeps)
    if not timestamps:
        return ()
    names = read_json(folder / "classes.json", dict[int, str])
    rows = {int(t): k for k, t in enumerate(sweeps.timestamps_ns)}
    files = {rows[t]: (file, sweeps.files[rows[t]]) for file, t in timestamps.items()}
    labels = LabelFiles(files, names)
    return tuple(
        LabeledPointsAnnotation(
            id=f"{_ID_PREFIX}{name}",
            labeled_points=cast("tuple[LabeledPoints, ...]", ClassPoints(labels, number)),
            label=name,
            is_instance=False,
        )
        for number, name in sorted(names.items())
    )


_ANGLES = MappingProxyType({"euler_unit": "degrees", "euler_order": "xyz"})


def open_pandaset(path: Path, *, sequence: str | None = None, lenient: bool = False) -> Scene:
    """Open a drive; images, points and their classes are read when asked for, boxes at once.

    Args:
        path: the folder of a drive (`002`), or one of several.
        sequence: name of the drive, where there are several.
        lenient: leave out files of boxes that are at fault, and count them.

    Raises:
        DataError: a file is missing or wrong.
        OptionError: there is no such drive, or none was chosen of several.
    """
    drive = choose_drive(
        path,
        drives_in(path, is_drive),
        sequence,
        called="drive",
        expected="lidar/00.pkl.gz, lidar/poses.json, camera/",
    )
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        sweeps = _read_sweeps(drive)
        trajectory = _trajectory_of(sweeps)
        sensors = (*_build_lidars(sweeps), *_build_cameras(drive, ledger), *_build_receiver(drive))
        annotations: tuple[Annotation, ...] = (
            *_build_cuboids(drive, sweeps, ledger),
            *_build_labelled_points(drive, sweeps),
        )
    return Scene(
        sensors=sensors,
        annotations=annotations,
        trajectories=MappingProxyType({trajectory.name: trajectory}),
        metadata=MappingProxyType({"pandaset": {"sequence": drive.name}, "sceneloom": dict(_ANGLES)}),
        source=str(drive),
        format="pandaset",
        warnings=ledger.warnings,
    )


def _numbered_files(folder: Path, pattern: str) -> list[Path]:
    """The files of a folder that are named by numbers, in their order.

    Args:
        folder: may be missing.
        pattern: of the whole name, after the number.
    """
    if not folder.is_dir():
        return []
    name = re.compile(rf"\d+{pattern}")
    found = [file for file in folder.iterdir() if name.fullmatch(file.name)]
    return sorted(found, key=lambda file: int(file.name.partition(".")[0]))
