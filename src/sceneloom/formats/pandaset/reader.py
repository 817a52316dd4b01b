"""Read a drive of PandaSet: two lidars in one file, cameras, satellite fixes, cuboids and classes of points."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from functools import partial
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
from sceneloom.formats.base.spec import choose_drive
from sceneloom.formats.pandaset.pickles import PickledFrame
from sceneloom.formats.pandaset.spec import DRIVES_IN
from sceneloom.formats.points.mapping import FARTHEST_WORLD
from sceneloom.geometry.rigid import RigidTransform, multiply_quaternions, normalise_quaternion
from sceneloom.scene.annotations import (
    Annotation,
    AttributePath,
    CuboidAnnotation,
    CuboidPath,
    LabeledPoints,
    LabeledPointsAnnotation,
)
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import PointsFrame
from sceneloom.warnings import WarningKind

_NANOSECONDS = 1_000_000_000
_LATEST_SECONDS = 9_000_000_000  # times beyond this [s] are in another unit

_LIDARS = ("main_pandar64", "front_gt")
"""The lidars by their number in the column `d`; the names are those of the published static calibration."""

_TRAJECTORY = "pose"

_LIDAR_FROM_EGO = RigidTransform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
"""PandaSet's own frame has x right and y forward; an ego here has x forward and y left."""

_FRAME, _IMAGE = r"\d+\.pkl(\.gz)?", r"\d+\.jpg"
_LABEL = "label"
_STATED = ("camera_used",)
_STATED_PREFIXES = ("attributes.", "cuboids.")
_NOTHING = ("None", "", "-", "nan", "-1")  # values, as texts, by which the files state nothing


class _Vector(msgspec.Struct):
    """A position [m]."""

    x: float
    y: float
    z: float


class _Rotation(_Vector):
    w: float


class _Pose(msgspec.Struct):
    """World from sensor."""

    position: _Vector
    heading: _Rotation


class _Intrinsics(msgspec.Struct):
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


def open_pandaset(path: Path, *, sequence: str | None = None, lenient: bool = False) -> Scene:
    """Open a drive; images, points and their classes are read when asked for, boxes at once.

    Args:
        path: the folder of a drive (`002`), or one of several.
        sequence: name of the drive, where there are several.

    Raises:
        OptionError: there is no such drive, or none was chosen of several.
    """
    expected = "lidar/00.pkl.gz, lidar/poses.json, camera/"
    drive = choose_drive(path, DRIVES_IN(path), sequence, called="drive", expected=expected)
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        return _Drive(drive, ledger).scene()


class _Drive:
    """A drive and the files with the points of both its lidars; no point is read. `poses`: world from main lidar."""

    def __init__(self, folder: Path, ledger: Ledger) -> None:
        self.folder, self.ledger = folder, ledger
        self.sweeps = _numbered_files(folder / "lidar", _FRAME)
        if not self.sweeps:
            raise DataError(folder / "lidar", "", "no sweep; expected files such as 00.pkl.gz")
        self.timestamps_ns, self.poses = _read_poses(folder / "lidar", len(self.sweeps))

    def scene(self) -> Scene:
        rotation = multiply_quaternions(self.poses.quaternions_xyzw, _LIDAR_FROM_EGO.quaternion_xyzw)
        trajectory = Trajectory(_TRAJECTORY, self.timestamps_ns, self.poses.positions, rotation)
        sensors = (*self._lidars(), *self._cameras(), *self._receiver())
        annotations: tuple[Annotation, ...] = (*self._cuboids(), *self._labelled_points())
        angles = CuboidAngles()
        convention = {"euler_unit": str(angles.unit), "euler_order": angles.order}
        return Scene(
            sensors=sensors,
            annotations=annotations,
            trajectories=MappingProxyType({trajectory.name: trajectory}),
            metadata=MappingProxyType({"pandaset": {"sequence": self.folder.name}, "sceneloom": convention}),
            source=str(self.folder),
            format="pandaset",
            warnings=self.ledger.warnings,
        )

    def _lidars(self) -> list[Sensor]:
        """The rotating lidar and the one that looks ahead; of the latter the pose is not reported."""
        main, front = (
            LazyFrames(self.timestamps_ns, partial(_read_sweep, self.sweeps, self.timestamps_ns, number))
            for number in range(len(_LIDARS))
        )
        mount = _LIDAR_FROM_EGO.inverse()
        return [
            LidarSensor(_LIDARS[0], main, self.poses, mount, points_frame=PointsFrame.WORLD, model="Pandar64"),
            LidarSensor(_LIDARS[1], front, points_frame=PointsFrame.WORLD, model="PandarGT"),
        ]

    def _cameras(self) -> list[Sensor]:
        """The cameras, each with its own poses at its own times."""
        folders = sorted(child for child in (self.folder / "camera").glob("*") if child.is_dir())
        if not folders:
            message = "no camera; only sweeps are read"
            self.ledger.note(WarningKind.SKIPPED, "cameras-missing", str(self.folder / "camera"), message)
        return [_camera(folder) for folder in folders]

    def _receiver(self) -> list[Sensor]:
        """The satellite receiver; [] where the drive has no fixes."""
        file = self.folder / "meta" / "gps.json"
        if not file.is_file():
            return []
        fixes = read_json(file, list[_Fix])
        timestamps_ns = _read_times(self.folder / "meta" / "timestamps.json", len(fixes))
        positions_lla = np.array([[fix.lat, fix.long, fix.height] for fix in fixes]).reshape(-1, 3)
        unknown = np.full(len(fixes), np.nan)
        velocities = {name: tuple(getattr(fix, name) for fix in fixes) for name in ("xvel", "yvel")}
        known = {name: values for name, values in velocities.items() if any(one is not None for one in values)}
        extras = MappingProxyType(known)
        return [GnssSensor("gps", timestamps_ns, positions_lla, unknown, unknown, extras=extras)]

    def _cuboids(self) -> list[CuboidAnnotation]:
        """A cuboid for each uuid, in the order in which they come up."""
        tracks: dict[str, _Track] = {}
        for file, k in self._annotated("cuboids").items():
            try:
                _add_boxes(tracks, PickledFrame.read(file), int(self.timestamps_ns[k]))
            except DataError as error:
                self.ledger.fault("cuboids", error)
        return [track.cuboid(name) for name, track in tracks.items()]

    def _annotated(self, kind: str) -> dict[Path, int]:
        """The files of annotations of a kind, and the rows of the sweeps with the same numbers."""
        rows = {_number(file): k for k, file in enumerate(self.sweeps)}
        files = _numbered_files(self.folder / "annotations" / kind, _FRAME)
        lost = [file for file in files if _number(file) not in rows]
        if lost:
            raise DataError(lost[0], "", f"there is no sweep of this number in {self.folder / 'lidar'}")
        return {file: rows[_number(file)] for file in files}

    def _labelled_points(self) -> list[LabeledPointsAnnotation]:
        """An annotation for each class that classes.json names; none where the drive has no such labels."""
        found = self._annotated("semseg")
        if not found:
            return []
        names = read_json(self.folder / "annotations" / "semseg" / "classes.json", dict[int, str])
        labels = _LabelFiles({k: (file, self.sweeps[k]) for file, k in found.items()}, names)
        return [
            LabeledPointsAnnotation(
                id=f"semseg:{name}",
                labeled_points=cast("tuple[LabeledPoints, ...]", _ClassPoints(labels, number)),
                label=name,
                is_instance=False,
            )
            for number, name in sorted(names.items())
        ]


# files


def _numbered_files(folder: Path, pattern: str) -> tuple[Path, ...]:
    """The files of a folder, which may be missing, with names that fit a pattern, by their numbers."""
    found = [file for file in folder.iterdir() if re.fullmatch(pattern, file.name)] if folder.is_dir() else []
    return tuple(sorted(found, key=_number))


def _number(file: Path) -> int:
    return int(file.name.partition(".")[0])


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


def _read_poses(folder: Path, count: int) -> tuple[Int64Array, Poses]:
    """Read times and poses of the `count` frames of a sensor."""
    timestamps_ns, path = _read_times(folder / "timestamps.json", count), folder / "poses.json"
    poses = read_json(path, list[_Pose])
    if len(poses) != count:
        raise DataError(path, "", f"{len(poses)} poses; expected {count}, one for each frame")
    positions = np.array([[getattr(pose.position, axis) for axis in "xyz"] for pose in poses]).reshape(-1, 3)
    quaternions = np.array([[getattr(pose.heading, axis) for axis in "xyzw"] for pose in poses]).reshape(-1, 4)
    for k in np.flatnonzero(lengths_of(quaternions)[1])[:1].tolist():
        heading = np.roll(quaternions[k], 1).tolist()
        raise DataError(path, f"[{k}].heading", f"w, x, y, z = {heading}; expected length 1")
    return timestamps_ns, Poses(timestamps_ns, positions, normalise_quaternion(quaternions))


def _camera(folder: Path) -> CameraSensor:
    files = _numbered_files(folder, _IMAGE)
    if not files:
        raise DataError(folder, "", "no image; expected files such as 00.jpg")
    timestamps_ns, poses = _read_poses(folder, len(files))
    intrinsics = read_json(folder / "intrinsics.json", _Intrinsics)
    try:
        camera = Camera("pinhole", *images_image_size(files[0]), *msgspec.structs.astuple(intrinsics))
    except CalibrationError as error:
        raise DataError(folder / "intrinsics.json", "", str(error)) from error
    names = tuple(f"camera/{folder.name}/{file.name}" for file in files)
    images = LazyFrames(timestamps_ns, ImageReader(files, names, timestamps_ns, camera))
    return CameraSensor(id=folder.name, camera=camera, images=images, poses=poses)


# points


def _read_sweep(files: tuple[Path, ...], timestamps_ns: Int64Array, number: int, k: int) -> LidarFrame:
    """Read sweep `k` of one lidar, by its number in the column `d`, out of a file that holds those of both."""
    frame = PickledFrame.read(files[k])
    chosen = _rows_of_lidar(frame, number)
    positions = np.stack([frame.numbers(axis)[chosen] for axis in "xyz"], axis=1)
    if len(positions) and np.abs(positions).max() > FARTHEST_WORLD:
        problem = f"points {np.abs(positions).max():.0f} m from the world's origin; expected {FARTHEST_WORLD:g} m"
        raise DataError(files[k], "", f"{problem} at most")
    extras: dict[str, AnyArray] = {}
    given = frame.numbers("i")[chosen]
    intensities = np.clip(np.rint(given), 0, np.iinfo(np.uint8).max)
    if not np.array_equal(intensities, given):
        extras["i"] = read_only(given)
    seconds = frame.numbers("t")[chosen]
    if len(seconds) and np.abs(seconds).max() > _LATEST_SECONDS:
        raise DataError(frame.file, "t", f"{seconds.max():g}; expected seconds")
    points = LidarPoints(
        positions=read_only(positions, np.float32),
        intensities=read_only(intensities, np.uint8),
        timestamps_ns=read_only(np.rint(seconds * _NANOSECONDS), np.int64),
        extras=MappingProxyType(extras),
    )
    return LidarFrame(int(timestamps_ns[k]), points, MappingProxyType({"file": f"lidar/{files[k].name}"}))


def _rows_of_lidar(frame: PickledFrame, number: int) -> BoolArray:
    """(N,) bool: which rows of a sweep are points of a lidar; without a column `d` all are the main lidar's."""
    if "d" not in frame.columns:
        return np.full(frame.count, number == 0)
    chosen: BoolArray = frame.numbers("d") == number
    return chosen


class _LabelFiles:
    """Classes of all points, in memory from the first use on: a byte a point; each class asks for all, in seconds."""

    def __init__(self, files: Mapping[int, tuple[Path, Path]], classes: Mapping[int, str]) -> None:
        """Take the files of classes and of points by number of the sweep; nothing is read."""
        self.files, self.classes = files, classes
        self._found: dict[int, list[LabeledPoints]] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_found": None}

    def of(self, number: int) -> list[LabeledPoints]:
        """The points of a class; DataError if a file is wrong, or has another number of rows than its sweep."""
        if self._found is None:
            self._found = self._read()
        return self._found.get(number, [])

    def _read(self) -> dict[int, list[LabeledPoints]]:
        found: dict[int, list[LabeledPoints]] = {}
        for k, (labels, points) in self.files.items():
            table, cloud = PickledFrame.read(labels), PickledFrame.read(points)
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
class _ClassPoints(Sequence[LabeledPoints]):
    """The points of one class, sweep by sweep."""

    labels: _LabelFiles
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


# boxes


@dataclass(slots=True)
class _Track:
    """What is stated about one object, sweep by sweep."""

    label: str
    stationary: bool | None
    timestamps_ns: list[int] = field(default_factory=list)
    values: list[Float64Array] = field(default_factory=list)
    stated: dict[str, dict[int, Any]] = field(default_factory=dict)

    def cuboid(self, name: str) -> CuboidAnnotation:
        path = CuboidPath(np.array(self.timestamps_ns, np.int64), np.stack(self.values))
        attributes = tuple(_attribute(key, stated) for key, stated in self.stated.items() if _is_stated(key, stated))
        return CuboidAnnotation(name, path, self.label, self.stationary, attributes=attributes)


def _add_boxes(tracks: dict[str, _Track], frame: PickledFrame, timestamp_ns: int) -> None:
    values = _values(frame)
    uuids = [str(name) for name in frame.column("uuid").tolist()]
    labels = [str(label) for label in frame.column("label").tolist()]
    stationary = frame.columns["stationary"].tolist() if "stationary" in frame.columns else [None] * frame.count
    stated = {
        name: column.tolist()
        for name, column in frame.columns.items()
        if name in _STATED or name.startswith(_STATED_PREFIXES)
    } | {_LABEL: labels}
    if len(set(uuids)) != len(uuids):
        twice = next(name for name in uuids if uuids.count(name) > 1)
        raise DataError(frame.file, "uuid", f"{twice!r} is there twice; expected each object once")
    for row, name in enumerate(uuids):
        known = stationary[row] if isinstance(stationary[row], bool) else None
        track = tracks.setdefault(name, _Track(labels[row], known))
        track.timestamps_ns.append(timestamp_ns)
        track.values.append(values[row])
        for key, column in stated.items():
            track.stated.setdefault(key, {})[timestamp_ns] = column[row]


def _values(frame: PickledFrame) -> Float64Array:
    """Rows `dx dy dz px py pz roll pitch yaw` [deg]; dx is the width, dy the length, yaw 0 is along the world's y."""
    # Source: class Cuboids of the development kit, and its function of a box's corners.
    width, length, height = (frame.numbers(f"dimensions.{axis}") for axis in "xyz")
    positions = [frame.numbers(f"position.{axis}") for axis in "xyz"]
    sizes = np.stack([length, width, height], axis=1)
    if (sizes <= 0).any():
        k = int(np.argmax((sizes <= 0).any(axis=1)))
        raise DataError(frame.file, f"row {k}: dimensions", f"{sizes[k].tolist()}; expected sizes above 0")
    yaws = np.degrees(frame.numbers("yaw")) + 90.0
    level = np.zeros(frame.count)
    return np.concatenate([sizes, np.stack([*positions, level, level, yaws], axis=1)], axis=1)


def _is_stated(key: str, stated: Mapping[int, Any]) -> bool:
    """Whether anything is stated at all; of the label, whether it changes."""
    values = [str(value) for value in stated.values()]
    return len(set(values)) > 1 if key == _LABEL else any(value not in _NOTHING for value in values)


def _attribute(key: str, stated: Mapping[int, Any]) -> AttributePath:
    """What is stated, at the times when that changes; where a text is missing it is empty."""
    name = key.removeprefix("attributes.").removeprefix("cuboids.")
    values = [_value(name, value) for value in stated.values()]
    changes = [k for k in range(len(values)) if k == 0 or values[k] != values[k - 1]]
    times = np.array(list(stated), np.int64)[changes]
    return AttributePath(name, tuple(values[k] for k in changes), times)


def _value(name: str, value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int):
        return "" if str(value) in _NOTHING else value
    return _LIDARS[value] if name == "sensor_id" and value in (0, 1) else value
