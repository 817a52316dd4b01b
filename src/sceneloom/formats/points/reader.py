"""Open files of points as a scene with a lidar for each folder of them."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from types import MappingProxyType
from typing import Any
from urllib.parse import unquote

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.text_tables import UNITS_NS, line_timestamps
from sceneloom.formats.points.cloud import Cloud, FieldLayout, find_roles
from sceneloom.formats.points.files import default_layout, read_cloud
from sceneloom.formats.points.mapping import (
    IntensityScale,
    PointMapping,
    PointTimes,
    SweepClock,
    detect_scale,
    points_of,
)
from sceneloom.formats.points.spec import (
    BESIDE,
    DEFAULT_ID,
    EGO_POSES,
    SENSOR_POSES,
    TIME_FILES,
    CloudKind,
    CloudReading,
    entries,
)
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarFrame, LidarSensor, white_where_unseen
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import PointsFrame
from sceneloom.warnings import WarningKind

_LOOKED_AT = 10  # files that are looked through for one that is bright enough to show the scale of intensity

_FARTHEST_EXACT = 4000.0
"""Farther from 0 than this [m], float32 is coarser than a quarter of a millimetre: points count from an origin."""

_RELATIVE = ("offset_ns", "nanoseconds")
"""The column of times that our files have, from the frame's time on, and its unit."""

_MEANINGS: Mapping[str, tuple[PointTimes, ...]] = MappingProxyType(
    {
        "f": (PointTimes("seconds"), PointTimes("seconds", "clock"), PointTimes("microseconds")),
        "u": (PointTimes("nanoseconds"), PointTimes("nanoseconds", "clock"), PointTimes("microseconds", "clock")),
        "i": (PointTimes("nanoseconds"), PointTimes("nanoseconds", "clock"), PointTimes("microseconds", "clock")),
    }
)  # fmt: skip
"""Meanings of columns of times, by the kind of their numbers, the likeliest first."""

_NEAR_NS = 2e9
_NOTHING_STATED = PointMapping()

_FIRST_NS, _LAST_NS = 631_152_000e9, 4_102_444_800e9  # the beginnings of the years 1990 and 2100

_DEFAULT_RATE_HZ = 10.0  # how fast most lidars rotate: taken for files whose names are plain numbers

_EGO_TRAJECTORY = "pose"


def open_clouds(path: Path, *, kind: CloudKind, options: CloudReading) -> Scene:
    """Open a file, a folder of files, or a folder of folders of files; the first file of each is read.

    Raises:
        DataError: there are none, one is damaged, or their times are.
    """
    ledger = Ledger(lenient=options.lenient)
    trajectories: dict[str, Trajectory] = {}
    with ledger.telling():
        folders = _find_folders(path, kind, options, ledger)
        sensors = tuple(_build_lidar(folder, trajectories) for folder in folders)
    return Scene(sensors, trajectories=trajectories, source=str(path), format=kind.name, warnings=ledger.warnings)


@dataclass(frozen=True, slots=True)
class _CloudFolder:
    """The files of one lidar, in the order of their names."""

    kind: CloudKind
    options: CloudReading
    ledger: Ledger
    location: Path  # the folder, or the only file
    files: tuple[Path, ...]  # at least one
    beside: dict[str, Path]  # files that state more about them, by name
    sensor_id: str = DEFAULT_ID

    def note(self, kind: WarningKind, code: str, message: str, *, of_first: bool = False, count: int = 1) -> None:
        """Note something about the folder, or about its first file."""
        self.ledger.note(kind, code, str(self.files[0] if of_first else self.location), message, count=count)


def _find_folders(path: Path, kind: CloudKind, options: CloudReading, ledger: Ledger) -> list[_CloudFolder]:
    """Find the files of each lidar."""
    if path.is_file():
        return [_CloudFolder(kind, options, ledger, path, (path,), {})]

    def folder_of(location: Path) -> _CloudFolder | None:
        found = sorted((entry for entry in entries(location) if entry.is_file()), key=lambda entry: entry.name)
        files = tuple(location / entry.name for entry in found if kind.has_name(entry.name))
        beside = {entry.name: location / entry.name for entry in found if entry.name in BESIDE}
        if location.name == "data" and not beside:
            # KITTI's raw data have the times beside the folder of the files
            beside = {name: there for name in TIME_FILES if (there := location.parent / name).is_file()}
        return _CloudFolder(kind, options, ledger, location, files, beside) if files else None

    try:
        own = folder_of(path)
        if own is not None:
            return [own]
        folders = sorted(path / entry.name for entry in entries(path) if entry.is_dir())
        found = [folder for folder in map(folder_of, folders) if folder is not None]
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror or error}") from error
    if not found:
        raise DataError(path, "", f"has no files of points; expected {kind.reported}")
    return [replace(folder, sensor_id=unquote(folder.location.name)) for folder in found]


def _build_lidar(folder: _CloudFolder, trajectories: dict[str, Trajectory]) -> LidarSensor:
    layout = default_layout(folder.files[0]) if folder.kind.has_layout else None
    frames = replace(_frames(folder), layout=layout)
    if folder.options.lenient:
        frames = _readable(frames, folder.ledger)
    first = frames.cloud(0)
    if len(frames.files) == 1 and not frames.timestamps_ns[0]:
        frames = replace(frames, timestamps_ns=np.array([_first_time_ns(first) or 0], np.int64))
    frames = _with_mapping(folder, replace(frames, origin=_origin_of(first)))
    _note_first(folder, frames)
    scale, origin = frames.mapping.scale, frames.origin
    sensor = LidarSensor(
        folder.sensor_id,
        LazyFrames(frames.timestamps_ns, frames),
        extras=MappingProxyType({} if scale is None else {"intensity_max": scale.maximum}),
    )
    if origin is None:
        return _placed(sensor, folder, trajectories)
    distance = np.linalg.norm(origin)
    message = f"points lie {distance:.0f} m from 0: the sensor is put there, the points count from it"
    folder.note(WarningKind.ASSUMED, "cloud-origin", message, of_first=True)
    at_origin = Poses(np.zeros(1, np.int64), read_only(origin[None]), np.array([[0.0, 0.0, 0.0, 1.0]]), static=True)
    return replace(sensor, poses=at_origin)


def _placed(sensor: LidarSensor, folder: _CloudFolder, trajectories: dict[str, Trajectory]) -> LidarSensor:
    """The sensor with the poses that stand beside its files, and the frame of its points."""
    stated = folder.options.points_frame
    frame = None if stated is None else PointsFrame(stated)
    if EGO_POSES in folder.beside and frame in {None, PointsFrame.EGO}:
        if _EGO_TRAJECTORY not in trajectories:
            trajectories[_EGO_TRAJECTORY] = _read_trajectory(folder, EGO_POSES)
        poses = trajectories[_EGO_TRAJECTORY].poses
        return replace(sensor, poses=poses, points_frame=PointsFrame.EGO, mount=RigidTransform.identity())
    if SENSOR_POSES in folder.beside and frame in {None, PointsFrame.SENSOR}:
        return replace(sensor, poses=_read_trajectory(folder, SENSOR_POSES).poses)
    if frame is None:
        message = "the frame of the points is not stated; taken as on the ego, `--points-frame` sets another"
        folder.note(WarningKind.ASSUMED, "cloud-frame-assumed", message)
    if frame is PointsFrame.WORLD:
        return replace(sensor, points_frame=frame)
    return replace(sensor, points_frame=frame or PointsFrame.SENSOR, mount=RigidTransform.identity())


def _read_trajectory(folder: _CloudFolder, name: str) -> Trajectory:
    from sceneloom.formats.trajectories.text_formats import TUM
    from sceneloom.formats.trajectories.trajectory_file import Reading

    return TUM.read(folder.beside[name], Reading(name=_EGO_TRAJECTORY), folder.ledger).trajectory


@dataclass(frozen=True, slots=True, eq=False)
class _CloudFrames:
    """Reads the frames of one lidar."""

    files: tuple[Path, ...]
    timestamps_ns: Int64Array
    layout: FieldLayout | None = None  # columns of files that do not state them
    mapping: PointMapping = _NOTHING_STATED  # meaning of the columns
    origin: Float64Array | None = None  # (3,) [m], subtracted from positions in the files
    keep_all: bool = False  # points that are no returns are points, too: their rows are counted elsewhere

    def __call__(self, k: int) -> LidarFrame:
        """Read frame `k`."""
        cloud, timestamp_ns = self.cloud(k), int(self.timestamps_ns[k])
        read = points_of(cloud, self.mapping, SweepClock(timestamp_ns, timestamp_ns, 0), keep_all=self.keep_all)
        extras = {name: column for name, column in read.points.extras.items() if name != "camera_index"}
        cameras = read.points.extras.get("camera_index")
        if cameras is not None and (cameras.dtype != np.uint8 or cameras.ndim != 1):
            extras["camera_index"], cameras = cameras, None
        colors = read.points.colors
        points = replace(
            read.points,
            colors=None if colors is None else white_where_unseen(colors, cameras),
            camera_index=cameras,
            extras=MappingProxyType({**extras, **_kept_intensities(cloud, self.mapping, read.dropped)}),
        )
        reported: dict[str, Any] = {"file": self.files[k].name, **({"head": dict(cloud.head)} if cloud.head else {})}
        counts = {"dropped_points": read.dropped, "clipped_intensities": read.clipped}
        reported |= {name: count for name, count in counts.items() if count}
        return LidarFrame(timestamp_ns, points, MappingProxyType(reported))

    def cloud(self, k: int) -> Cloud:
        """Columns of frame `k` without absolute times beside our exact ones and dimensions that state nothing."""
        cloud = read_cloud(self.files[k], layout=self.layout)
        columns = dict(cloud.columns)
        if _RELATIVE[0] in columns:
            columns.pop("time", None)
        columns = {name: column for name, column in columns.items() if name not in _LAS_DIMENSIONS or column.any()}
        if self.origin is not None:
            for axis, start in zip("xyz", self.origin.tolist(), strict=True):
                if axis in columns:
                    columns[axis] = columns[axis].astype(np.float64) - start
        return replace(cloud, columns=columns)


_LAS_DIMENSIONS = frozenset(
    {
        "bit_fields", "raw_classification", "return_number", "number_of_returns", "scan_direction_flag",
        "edge_of_flight_line", "synthetic", "key_point", "withheld", "overlap", "scanner_channel", "classification",
        "classification_flags", "user_data", "scan_angle", "scan_angle_rank", "point_source_id",
    }
)  # fmt: skip
"""Dimensions that every point of a LAS file has; all zero where the writer did not fill them in."""


def _kept_intensities(cloud: Cloud, mapping: PointMapping, dropped: int) -> dict[str, AnyArray]:
    """The intensities as the file has them, where 0 to 255 do not state them all."""
    roles = find_roles(cloud.columns, mapping.named)
    name = roles.get("intensity")
    if name is None or mapping.scale is None:
        return {}
    values = cloud.columns[name]
    if dropped:
        values = points_of(cloud, PointMapping(mapping.named), SweepClock(0, 0, 0)).points.extras[name]
    bytes_, clipped = mapping.scale.apply(values)
    back = bytes_ * (mapping.scale.maximum / 255.0)
    back = np.rint(back) if values.dtype.kind in "iu" else back
    same = not clipped and np.array_equal(back.astype(values.dtype), values)
    return {} if same else {name: read_only(values)}


def _origin_of(cloud: Cloud) -> Float64Array | None:
    """Whole metres near the points of a file, where they lie too far from 0 for float32; None where they do not."""
    columns = [cloud.columns.get(axis) for axis in "xyz"]
    if any(column is None or column.dtype != np.float64 for column in columns):
        return None
    positions = np.stack([column for column in columns if column is not None], axis=1)
    finite = positions[np.isfinite(positions).all(axis=1)]
    if not len(finite) or np.abs(finite).max() <= _FARTHEST_EXACT:
        return None
    origin: Float64Array = np.floor(finite.mean(axis=0))
    return origin


def _readable(frames: _CloudFrames, ledger: Ledger) -> _CloudFrames:
    """Leave out the files that cannot be read."""
    kept, first_error = [], None
    for k, path in enumerate(frames.files):
        try:
            read_cloud(path, layout=frames.layout)
            kept.append(k)
        except DataError as error:
            first_error = first_error or error
            ledger.fault("unreadable-files", error)
    if not kept and first_error is not None:
        raise first_error
    timestamps_ns = read_only(frames.timestamps_ns[kept])
    return replace(frames, files=tuple(frames.files[k] for k in kept), timestamps_ns=timestamps_ns)


def _frames(folder: _CloudFolder) -> _CloudFrames:
    """The files in the order of their times."""
    times, files = _times(folder)
    order = np.argsort(times, kind="stable")
    times = times[order]
    repeated = np.flatnonzero(np.diff(times) == 0) + 1
    if len(repeated):
        k = int(repeated[0])
        before, after = (files[int(order[row])].name for row in (k - 1, k))
        problem = f"{before!r} and {after!r} have the same time, {times[k] / 1e9:.9f} s; expected one file per time"
        folder.ledger.fault("repeated-times", DataError(folder.location, "", problem), count=len(repeated))
        order, times = np.delete(order, repeated), np.delete(times, repeated)
    return _CloudFrames(tuple(files[k] for k in order.tolist()), read_only(times))


def _times(folder: _CloudFolder) -> tuple[Int64Array, tuple[Path, ...]]:
    """The times of the files: of a list beside them, of their names, or at an even rate."""
    files, stems = folder.files, [stem_of(path.name) for path in folder.files]
    listed = next((folder.beside[name] for name in TIME_FILES if name in folder.beside), None)
    numbers = numbers_of_names(stems)
    if listed is not None:
        # lists count in the order of numbers, which is not that of names of different length
        rank = range(len(files)) if numbers is None else np.argsort(np.array(numbers)).tolist()
        listed_ns = line_timestamps(listed, None)
        if len(listed_ns) != len(files):
            problem, apart = f"{len(listed_ns)} times for {len(files)} files; expected as many", len(files)
            folder.ledger.fault("counts-disagree", DataError(listed, "", problem), count=abs(len(listed_ns) - apart))
        used = min(len(listed_ns), len(files))
        if not used:
            raise DataError(listed, "", f"no times for {len(files)} files")
        return listed_ns[:used], tuple(files[k] for k in rank)[:used]
    times = times_of_names(stems)
    if times is not None:
        return np.array(times, np.int64), files
    if len(files) == 1:
        return np.zeros(1, np.int64), files
    rate_hz = folder.options.rate_hz or _DEFAULT_RATE_HZ
    counted = range(len(files)) if numbers is None else numbers
    if folder.options.rate_hz is None:
        message = f"names have no times: number k is taken as {1 / rate_hz:g} k s, "
        message += "`--input-option rate_hz=HZ` sets another rate"
        folder.note(WarningKind.ASSUMED, "cloud-times-assumed", message, count=len(files))
    if max(counted) / rate_hz > 9e9:
        raise DataError(folder.location, "", f"number {max(counted)} at {rate_hz:g} Hz is a time beyond the year 2255")
    return np.array([round(number * 1e9 / rate_hz) for number in counted], np.int64), files


def _with_mapping(folder: _CloudFolder, frames: _CloudFrames) -> _CloudFrames:
    """Settle the meaning of intensities and times, by the first files."""
    scale = _noted_scale(frames, folder.location, folder.ledger)
    if scale is not None and folder.kind.name == "nuscenes-bin":
        scale = IntensityScale(max(scale.maximum, 255.0))
    times = _times_of(frames.cloud(0), int(frames.timestamps_ns[0]))
    if times is not None and times.field != _RELATIVE[0]:
        message = f"column {times.field!r} is taken for point times: {times.unit} relative to the {times.relative_to}"
        folder.note(WarningKind.ASSUMED, "point-times-assumed", message)
    return replace(frames, mapping=PointMapping(scale=scale, times=times))


def _noted_scale(frames: _CloudFrames, location: Path, ledger: Ledger) -> IntensityScale | None:
    scale, name = _scale_of(frames)
    if name is not None and scale is None:
        message = f"column {name!r} fits no scale of intensity; kept as it is among the extra values"
        ledger.note(WarningKind.SKIPPED, "intensity-not-used", str(location), message)
    return scale


def listed_frames(
    files: Sequence[Path], timestamps_ns: Int64Array, ledger: Ledger, *, keep_all: bool = False
) -> tuple[LazyFrames[LidarFrame], Mapping[str, Any]]:
    """Give the frames of files whose times are known otherwise, read on demand; the first files are read for columns.

    Columns of times are kept as they are: what is stated of such a frame holds for all its points.

    Args:
        files: at least one.
        timestamps_ns: (N,) int64 [ns], ascending, one per file.
        ledger: takes what is assumed of the columns.
        keep_all: points that are not finite or at the origin are points, too, since labels count the rows of a file.

    Returns:
        frames: the sweeps.
        extras: what their sensor states: `intensity_max`, where intensities have a scale.

    Raises:
        DataError: the first file cannot be read.
    """
    frames = _CloudFrames(tuple(files), read_only(timestamps_ns), keep_all=keep_all)
    scale = _noted_scale(frames, files[0].parent, ledger)
    frames = replace(frames, mapping=PointMapping(scale=scale))
    return LazyFrames(frames.timestamps_ns, frames), MappingProxyType(
        {} if scale is None else {"intensity_max": scale.maximum}
    )


def _scale_of(frames: _CloudFrames) -> tuple[IntensityScale | None, str | None]:
    """The scale of intensity, by the first file that has any, and the column; None where there is none."""
    for k in range(min(len(frames.files), _LOOKED_AT)):
        columns = frames.cloud(k).columns
        name = find_roles(columns, {}).get("intensity")
        if name is None or columns[name].ndim != 1:
            return None, None
        if (columns[name] > 0).any() or k == min(len(frames.files), _LOOKED_AT) - 1:
            return (None if (columns[name] < 0).any() else detect_scale(columns[name])), name
    return None, None


def _times_of(cloud: Cloud, timestamp_ns: int) -> PointTimes | None:
    """The meaning of the times of a file's points, where a column has them and they lie around its time [ns]."""
    name = find_roles(cloud.columns, {}).get("time")
    if name is None or cloud.columns[name].ndim != 1 or not cloud.count:
        return None
    if name == _RELATIVE[0]:
        return PointTimes(_RELATIVE[1], "timestamp", name)
    values = cloud.columns[name].astype(np.float64)
    if not np.isfinite(values).all():
        return None
    for meaning in _MEANINGS.get(cloud.columns[name].dtype.kind, ()):
        base_ns = float(timestamp_ns) if meaning.relative_to == "clock" else 0.0
        if np.abs(values * UNITS_NS[meaning.unit] - base_ns).max() < _NEAR_NS:
            return replace(meaning, field=name)
    return None


def _first_time_ns(cloud: Cloud) -> int | None:
    """The time of the first point of a file [ns], where a column has dates; None where none does."""
    name = find_roles(cloud.columns, {}).get("time")
    if name is None or name == _RELATIVE[0] or cloud.columns[name].ndim != 1 or not cloud.count:
        return None
    first = cloud.columns[name].min()
    for unit_ns in UNITS_NS.values():
        if _FIRST_NS <= float(first) * unit_ns <= _LAST_NS:
            return int(first) * unit_ns if first.dtype.kind in "iu" else round(float(first) * unit_ns)
    return None


def _note_first(folder: _CloudFolder, frames: _CloudFrames) -> None:
    """Check the first frame, and note what was left out of it."""
    extras = frames(0).extras
    for name, message in (
        ("dropped_points", "points that are not finite, or exactly at the origin, are no returns and are left out"),
        ("clipped_intensities", "intensities beyond their scale are clipped to it"),
    ):
        if name in extras:
            code, location = name.replace("_", "-"), str(frames.files[0])
            folder.ledger.note(WarningKind.SKIPPED, code, location, message, count=int(extras[name]))
    head = extras.get("head", {})
    if head.get("other_bounds"):
        found = f"the bounds in the header are not those of the points ({head['other_bounds']} off)"
        message = f"{found}; the points are read as they are"
        folder.ledger.note(WarningKind.ASSUMED, "other-bounds", str(frames.files[0]), message)
    if head.get("elements_left_out"):
        listed = ", ".join(f"{count} {name}" for name, count in head["elements_left_out"].items())
        message = f"only vertices are points: {listed} left out of the first file"
        folder.note(WarningKind.SKIPPED, "elements-left-out", message)


_NANOSECOND_DIGITS = 19
"""So many digits, zeros before them included, are nanoseconds whatever they state: all of an int64 in order."""

_NUMBER = re.compile(r"(?P<number>(?:^-)?\d+(?:\.\d+)?)$", re.ASCII)
_PAIR = re.compile(r"(?:^|\D)(?P<seconds>\d{9,10})[_.-](?P<nanoseconds>\d{9})$", re.ASCII)

_FIRST_S, _LAST_S = 631_152_000, 4_102_444_800
"""A number that lies between the years 1990 and 2100 in some unit is a time in that unit [s]."""

_FARTHEST_NS = 9_200_000_000_000_000_000

_SUFFIXES: Mapping[str, int] = MappingProxyType({".pcd.bin": 2})  # endings of several parts, and how many they have


def stem_of(name: str) -> str:
    """The name of a file without its ending."""
    parts = next((count for ending, count in _SUFFIXES.items() if name.lower().endswith(ending)), 1)
    for _ in range(parts):
        name = name.rpartition(".")[0] or name
    return name


def times_of_names(stems: Sequence[str]) -> list[int] | None:
    """Read the times [ns] that names end with; None where one of them does not, or they are plain numbers.

    A time is a number of 19 digits (nanoseconds), one with a point (seconds), seconds and nanoseconds with a sign
    between, or a whole number that lies between the years 1990 and 2100 in some unit, the same for all names.
    """
    pairs = [_PAIR.search(stem) for stem in stems]
    if stems and all(pairs):
        return [int(pair["seconds"]) * 10**9 + int(pair["nanoseconds"]) for pair in pairs if pair is not None]
    numbers = _trailing(stems)
    unit_ns = None if not numbers else _unit_ns(numbers)
    if numbers is None or unit_ns is None:
        return None
    times = [int((Decimal(number) * unit_ns).to_integral_value()) for number in numbers]
    return times if max(map(abs, times)) <= _FARTHEST_NS else None


def numbers_of_names(stems: Sequence[str]) -> list[int] | None:
    """Read the whole numbers that names end with; None where one has none, or two have the same."""
    found = _trailing(stems)
    if found is None or any("." in number or len(number) > 18 for number in found):
        return None
    numbers = [int(number) for number in found]
    return numbers if len(set(numbers)) == len(numbers) and min(numbers, default=0) >= 0 else None


def _trailing(stems: Sequence[str]) -> list[str] | None:
    found = [_NUMBER.search(stem) for stem in stems]
    return [match["number"] for match in found if match is not None] if all(found) else None


def _unit_ns(numbers: Sequence[str]) -> int | None:
    """Nanoseconds in the unit of some numbers; None where they are no times."""
    if any("." in number for number in numbers):
        return UNITS_NS["seconds"]
    if all(len(number.lstrip("-")) == _NANOSECOND_DIGITS for number in numbers):
        return 1
    values = [int(number) for number in numbers]
    for unit_ns in UNITS_NS.values():
        per_second = 10**9 // unit_ns
        if all(_FIRST_S <= value // per_second <= _LAST_S for value in values):
            return unit_ns
    return None
