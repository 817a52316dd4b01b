"""Open files of points as a scene with a lidar for each folder of them."""

import re
from collections.abc import Callable, Mapping, Sequence
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
from sceneloom.formats.base.text_tables import UNITS_NS
from sceneloom.formats.points.cloud import Cloud, FieldLayout, find_roles
from sceneloom.formats.points.files import read_cloud
from sceneloom.formats.points.mapping import (
    IntensityScale,
    PointMapping,
    PointTimes,
    SweepClock,
    detect_scale,
    points_of,
)
from sceneloom.formats.points.npz import default_layout
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


@dataclass(frozen=True, slots=True)
class _CloudFolder:
    """The files of one lidar, in the order of their names.

    Attributes:
        sensor_id: what the lidar is called.
        location: the folder, or the only file.
        files: at least one.
        beside: files that state more about them, by name.
    """

    sensor_id: str
    location: Path
    files: tuple[Path, ...]
    beside: dict[str, Path]


_LOOKED_AT = 10
"""Files that are looked through for one that is bright enough to report the scale of brightness."""

_FARTHEST_EXACT = 4000.0
"""Farther from 0 than this [m], float32 is coarser than a quarter of a millimetre: points count from an origin."""

_RELATIVE = ("offset_ns", "nanoseconds")
"""The column of times that our files have, from the frame's time on, and its unit."""

_TRAJECTORIES: Mapping[str, tuple[PointTimes, ...]] = MappingProxyType(
    {
        "f": (PointTimes("seconds"), PointTimes("seconds", "clock"), PointTimes("microseconds")),
        "u": (PointTimes("nanoseconds"), PointTimes("nanoseconds", "clock"), PointTimes("microseconds", "clock")),
        "i": (PointTimes("nanoseconds"), PointTimes("nanoseconds", "clock"), PointTimes("microseconds", "clock")),
    }
)  # fmt: skip
"""What columns of times can mean, by the kind of their numbers, the likeliest first."""

_NEAR_NS = 2e9
_NOTHING_STATED = PointMapping()

_FIRST_NS, _LAST_NS = 631_152_000e9, 4_102_444_800e9
"""The beginnings of the years 1990 and 2100."""


@dataclass(frozen=True, slots=True, eq=False)
class _CloudFrames:
    """Reads the frames of one lidar.

    Attributes:
        files: of each frame.
        timestamps_ns: (N,) int64 [ns].
        layout: columns of files that do not state them.
        mapping: what the columns mean.
        origin: (3,) float64 [m], taken off the locations in the files; None for nothing.
    """

    files: tuple[Path, ...]
    timestamps_ns: Int64Array
    layout: FieldLayout | None = None
    mapping: PointMapping = _NOTHING_STATED
    origin: Float64Array | None = None

    def __call__(self, k: int) -> LidarFrame:
        """Read frame `k`.

        Raises:
            DataError: its file is missing or wrong.
        """
        cloud, timestamp_ns = self.cloud(k), int(self.timestamps_ns[k])
        read = points_of(cloud, self.mapping, SweepClock(timestamp_ns, timestamp_ns, 0))
        kept = _kept_brightness(cloud, self.mapping, read.dropped)
        extras = {name: column for name, column in read.points.extras.items() if name != "camera_index"}
        cameras = read.points.extras.get("camera_index")
        if cameras is not None and (cameras.dtype != np.uint8 or cameras.ndim != 1):
            extras["camera_index"], cameras = cameras, None
        colors = read.points.colors
        points = replace(
            read.points,
            colors=None if colors is None else white_where_unseen(colors, cameras),
            camera_index=cameras,
            extras=MappingProxyType({**extras, **kept}),
        )
        reported: dict[str, Any] = {
            "file": self.files[k].name,
            **({"head": dict(cloud.head)} if cloud.head else {}),
        }
        counts = {"dropped_points": read.dropped, "clipped_intensities": read.clipped}
        reported.update({name: count for name, count in counts.items() if count})
        return LidarFrame(timestamp_ns, points, MappingProxyType(reported))

    def cloud(self, k: int) -> Cloud:
        """Read the columns of frame `k`, locations from the origin on."""
        cloud = read_cloud(self.files[k], layout=self.layout)
        columns = _without_redundant(cloud.columns)
        if self.origin is not None:
            columns.update(
                {
                    axis: columns[axis].astype(np.float64) - start
                    for axis, start in zip("xyz", self.origin.tolist(), strict=True)
                    if axis in columns
                }
            )
        return replace(cloud, columns=columns)


def _without_redundant(columns: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """Leave out the absolute times beside our own exact ones, and dimensions that state nothing."""
    found = dict(columns)
    if _RELATIVE[0] in found:
        found.pop("time", None)
    return {name: column for name, column in found.items() if name not in _LAS_DIMENSIONS or column.any()}


_LAS_DIMENSIONS = frozenset(
    {
        "bit_fields", "raw_classification", "return_number", "number_of_returns", "scan_direction_flag",
        "edge_of_flight_line", "synthetic", "key_point", "withheld", "overlap", "scanner_channel", "classification",
        "classification_flags", "user_data", "scan_angle", "scan_angle_rank", "point_source_id",
    }
)  # fmt: skip
"""Dimensions that every point of a LAS file has; all zero where the writer did not fill them in."""


def _kept_brightness(cloud: Cloud, mapping: PointMapping, dropped: int) -> dict[str, AnyArray]:
    """The brightness as the file has it, where 0 to 255 do not state it all."""
    name = find_roles(cloud.columns, mapping.named).get("intensity")
    if name is None or mapping.scale is None:
        return {}
    values = cloud.columns[name]
    if dropped:
        values = values[_returns(cloud)]
    bytes_, clipped = mapping.scale.apply(values)
    back = bytes_ * (mapping.scale.maximum / 255.0)
    back = np.rint(back) if values.dtype.kind in "iu" else back
    same = np.array_equal(back.astype(values.dtype), values) if not clipped else False
    return {} if same else {name: read_only(values)}


def _returns(cloud: Cloud) -> AnyArray:
    """Which points are returns, as `points_of` has it."""
    roles = find_roles(cloud.columns, {})
    if "positions" in roles and any(axis not in roles for axis in "xyz"):
        locations = cloud.columns[roles["positions"]].astype(np.float32)
    else:
        with np.errstate(over="ignore"):
            locations = np.stack([cloud.columns[roles[axis]].astype(np.float32) for axis in "xyz"], axis=1)
    kept: AnyArray = np.isfinite(locations).all(axis=1) & (locations != 0).any(axis=1)
    return kept


def _origin_of(cloud: Cloud) -> Float64Array | None:
    """Whole metres near the points of a file, where they lie too far from 0 for float32; None where they do not."""
    columns = [cloud.columns.get(axis) for axis in "xyz"]
    if any(column is None or column.dtype != np.float64 for column in columns):
        return None
    locations = np.stack([column for column in columns if column is not None], axis=1)
    finite = locations[np.isfinite(locations).all(axis=1)]
    if not len(finite) or np.abs(finite).max() <= _FARTHEST_EXACT:
        return None
    origin: Float64Array = np.floor(finite.mean(axis=0))
    return origin


def _scale_of(frames: _CloudFrames) -> tuple[IntensityScale | None, str | None]:
    """The scale of brightness, by the first file that has any, and the column; None where there is none."""
    for k in range(min(len(frames.files), _LOOKED_AT)):
        columns = frames.cloud(k).columns
        name = find_roles(columns, {}).get("intensity")
        if name is None or columns[name].ndim != 1:
            return None, None
        if (columns[name] > 0).any() or k == min(len(frames.files), _LOOKED_AT) - 1:
            return (None if (columns[name] < 0).any() else detect_scale(columns[name])), name
    return None, None


def _times_of(cloud: Cloud, timestamp_ns: int | None) -> PointTimes | None:
    """What the times of a file's points mean, where they are reported by a column and lie around its time.

    Args:
        cloud: the file.
        timestamp_ns: its time [ns], or None where it is not known.
    """
    name = find_roles(cloud.columns, {}).get("time")
    if name is None or cloud.columns[name].ndim != 1 or not cloud.count:
        return None
    if name == _RELATIVE[0]:
        return PointTimes(_RELATIVE[1], "timestamp", name)
    values = cloud.columns[name].astype(np.float64)
    if not np.isfinite(values).all():
        return None
    for trajectory in _TRAJECTORIES.get(cloud.columns[name].dtype.kind, ()):
        if timestamp_ns is None and trajectory.relative_to == "clock":
            continue
        base_ns = float(timestamp_ns or 0) if trajectory.relative_to == "clock" else 0.0
        if np.abs(values * UNITS_NS[trajectory.unit] - base_ns).max() < _NEAR_NS:
            return replace(trajectory, field=name)
    return None


def _first_time_ns(cloud: Cloud) -> int | None:
    """The time of the first point of a file [ns], where a column reports times of day; None where none does."""
    name = find_roles(cloud.columns, {}).get("time")
    if name is None or name == _RELATIVE[0] or cloud.columns[name].ndim != 1 or not cloud.count:
        return None
    first = float(cloud.columns[name].min())
    for unit_ns in UNITS_NS.values():
        if _FIRST_NS <= first * unit_ns <= _LAST_NS:
            whole = cloud.columns[name].dtype.kind in "iu"
            return int(cloud.columns[name].min()) * unit_ns if whole else round(first * unit_ns)
    return None


def _readable(files: Sequence[Path], layout: FieldLayout | None) -> list[DataError | None]:
    """Read every file, and give what is wrong with each."""
    found: list[DataError | None] = []
    for path in files:
        try:
            read_cloud(path, layout=layout)
        except DataError as error:
            found.append(error)
        else:
            found.append(None)
    return found


_NANOSECOND_DIGITS = 19
"""So many digits, zeros before them included, are nanoseconds whatever they state: all of an int64 in order."""

_NUMBER = re.compile(r"(?P<number>(?:^-)?\d+(?:\.\d+)?)$", re.ASCII)
_PAIR = re.compile(r"(?:^|\D)(?P<seconds>\d{9,10})[_.-](?P<nanoseconds>\d{9})$", re.ASCII)

_FIRST_S, _LAST_S = 631_152_000, 4_102_444_800
"""A number that lies between the years 1990 and 2100 in some unit is a time in that unit [s]."""

_FARTHEST_NS = 9_200_000_000_000_000_000

_SUFFIXES: Mapping[str, int] = MappingProxyType({".pcd.bin": 2})
"""Endings of several parts, and how many they have."""


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


def name_of_time(timestamp_ns: int) -> str:
    """The name of a file of a time [ns], which is read back as that time."""
    return f"{timestamp_ns:020d}" if timestamp_ns < 0 else f"{timestamp_ns:019d}"


_DEFAULT_RATE_HZ = 10.0
"""How fast most lidars rotate: taken for files whose names are plain numbers."""

_EGO_TRAJECTORY = "pose"


def open_clouds(path: Path, *, kind: CloudKind, options: CloudReading) -> Scene:
    """Open a file, a folder of files, or a folder of folders of files; the first file of each is read.

    Raises:
        DataError: there are none, one is damaged, or their times are.
    """
    ledger = Ledger(lenient=options.lenient)
    trajectories: dict[str, Trajectory] = {}
    with ledger.telling():
        sensors = tuple(_lidar(folder, kind, options, ledger, trajectories) for folder in _find_folders(path, kind))
    return Scene(sensors, trajectories=trajectories, source=str(path), format=kind.name, warnings=ledger.warnings)


def _lidar(
    folder: _CloudFolder,
    kind: CloudKind,
    reading: CloudReading,
    ledger: Ledger,
    trajectories: dict[str, Trajectory],
) -> LidarSensor:
    layout = default_layout(folder.files[0]) if kind.layout else None
    frames = _frames(folder, reading, ledger)
    frames = replace(frames, layout=layout)
    if reading.lenient:
        frames = _sound(frames, ledger)
    first = frames.cloud(0)
    if len(frames.files) == 1 and not frames.timestamps_ns[0]:
        frames = replace(frames, timestamps_ns=np.array([_first_time_ns(first) or 0], np.int64))
    origin = _origin_of(first)
    frames = replace(frames, origin=origin)
    frames, maximum = _with_mapping(folder, kind, frames, ledger)
    _note_first(folder, frames, ledger)
    sensor = LidarSensor(
        folder.sensor_id,
        LazyFrames(frames.timestamps_ns, frames),
        extras=MappingProxyType({} if maximum is None else {"intensity_max": maximum}),
    )
    if origin is not None:
        reported = (
            f"points lie {np.linalg.norm(origin):.0f} m from 0: the sensor is put there, the points count from it"
        )
        ledger.note(WarningKind.ASSUMED, "cloud-origin", str(folder.files[0]), reported)
        at_origin = Poses(np.zeros(1, np.int64), read_only(origin[None]), np.array([[0.0, 0.0, 0.0, 1.0]]), static=True)
        return replace(sensor, poses=at_origin)
    return _placed(sensor, folder, reading, ledger, trajectories)


def _placed(
    sensor: LidarSensor,
    folder: _CloudFolder,
    reading: CloudReading,
    ledger: Ledger,
    trajectories: dict[str, Trajectory],
) -> LidarSensor:
    """The sensor with the poses that stand beside its files, and the frame of its points."""
    frame = None if reading.points_frame is None else PointsFrame(reading.points_frame)
    if EGO_POSES in folder.beside and frame in {None, PointsFrame.EGO}:
        trajectory = trajectories.setdefault(_EGO_TRAJECTORY, _trajectory(folder.beside[EGO_POSES], ledger))
        return replace(sensor, poses=trajectory.poses, points_frame=PointsFrame.EGO, mount=RigidTransform.identity())
    if SENSOR_POSES in folder.beside and frame in {None, PointsFrame.SENSOR}:
        return replace(sensor, poses=_trajectory(folder.beside[SENSOR_POSES], ledger).poses)
    if frame is None:
        reported = "the frame of the points is not stated; taken as on the ego, `--points-frame` sets another"
        ledger.note(WarningKind.ASSUMED, "cloud-frame-assumed", str(folder.location), reported)
    if frame is PointsFrame.WORLD:
        return replace(sensor, points_frame=frame)
    return replace(sensor, points_frame=frame or PointsFrame.SENSOR, mount=RigidTransform.identity())


def _trajectory(path: Path, ledger: Ledger) -> Trajectory:
    from sceneloom.formats.trajectories.text_formats import TUM
    from sceneloom.formats.trajectories.trajectory_file import Reading

    return TUM.read(path, Reading(name=_EGO_TRAJECTORY), ledger).trajectory


def _sound(frames: _CloudFrames, ledger: Ledger) -> _CloudFrames:
    """Leave out the files that cannot be read."""
    errors = _readable(frames.files, frames.layout)
    for error in filter(None, errors):
        ledger.fault("unreadable-files", error)
    kept = [k for k, error in enumerate(errors) if error is None]
    if not kept:
        raise next(error for error in errors if error is not None)
    return replace(
        frames,
        files=tuple(frames.files[k] for k in kept),
        timestamps_ns=read_only(frames.timestamps_ns[kept]),
    )


def _frames(folder: _CloudFolder, reading: CloudReading, ledger: Ledger) -> _CloudFrames:
    """The files in the order of their times."""
    times, files = _times(folder, reading, ledger)
    order = np.argsort(times, kind="stable")
    times = times[order]
    repeated = np.flatnonzero(np.diff(times) == 0) + 1
    if len(repeated):
        k = int(repeated[0])
        names = [files[int(order[row])].name for row in (k - 1, k)]
        reported = f"{names[0]!r} and {names[1]!r} have the same time"
        problem = f"{reported}, {times[k] / 1e9:.9f} s; expected one file per time"
        ledger.fault("repeated-times", DataError(folder.location, "", problem), count=len(repeated))
        order, times = np.delete(order, repeated), np.delete(times, repeated)
    return _CloudFrames(tuple(files[k] for k in order.tolist()), read_only(times))


def _times(folder: _CloudFolder, reading: CloudReading, ledger: Ledger) -> tuple[Int64Array, tuple[Path, ...]]:
    stems = [stem_of(path.name) for path in folder.files]
    listed = next((folder.beside[name] for name in TIME_FILES if name in folder.beside), None)
    numbers = numbers_of_names(stems)
    files = folder.files
    if listed is not None:
        # lists count in the order of numbers, which is not that of names of different length
        rank = range(len(files)) if numbers is None else np.argsort(np.array(numbers)).tolist()
        return _listed_times(listed, tuple(files[k] for k in rank), ledger)
    times = times_of_names(stems)
    if times is not None:
        return np.array(times, np.int64), files
    if len(files) > 1:
        rate_hz = reading.rate_hz or _DEFAULT_RATE_HZ
        counted = numbers if numbers is not None else list(range(len(files)))
        if reading.rate_hz is None:
            reported = (
                f"names report no times: number k is taken as {1 / rate_hz:g} k s, "
                "`--input-option rate_hz=HZ` sets another rate"
            )
            ledger.note(WarningKind.ASSUMED, "cloud-times-assumed", str(folder.location), reported, count=len(files))
        return _counted_times(folder, counted, rate_hz), files
    return np.zeros(1, np.int64), files


def _counted_times(folder: _CloudFolder, numbers: list[int], rate_hz: float) -> Int64Array:
    if max(numbers) / rate_hz > 9e9:
        raise DataError(folder.location, "", f"number {max(numbers)} at {rate_hz:g} Hz is a time beyond the year 2255")
    return np.array([round(number * 1e9 / rate_hz) for number in numbers], np.int64)


def _listed_times(listed: Path, files: tuple[Path, ...], ledger: Ledger) -> tuple[Int64Array, tuple[Path, ...]]:
    from sceneloom.formats.base.text_tables import line_timestamps

    times = line_timestamps(listed, None)
    if len(times) != len(files):
        problem = f"{len(times)} times for {len(files)} files; expected as many"
        ledger.fault("counts-disagree", DataError(listed, "", problem), count=abs(len(times) - len(files)))
    used = min(len(times), len(files))
    if not used:
        raise DataError(listed, "", f"no times for {len(files)} files")
    return times[:used], files[:used]


def _with_mapping(
    folder: _CloudFolder, kind: CloudKind, frames: _CloudFrames, ledger: Ledger
) -> tuple[_CloudFrames, float | None]:
    """Settle what brightness and times mean, by the first files."""
    scale, name = _scale_of(frames)
    if name is not None and scale is None:
        reported = f"column {name!r} fits no scale of brightness; kept as it is among the further values"
        ledger.note(WarningKind.SKIPPED, "intensity-not-used", str(folder.location), reported)
    if kind.layout and scale is not None and kind.name == "nuscenes-bin":
        scale = IntensityScale(max(scale.maximum, 255.0))
    first = frames.cloud(0)
    times = _times_of(first, int(frames.timestamps_ns[0]))
    if times is not None and times.field != "offset_ns":
        reported = (
            f"column {times.field!r} is taken for times of points: {times.unit} relative to the {times.relative_to}"
        )
        ledger.note(WarningKind.ASSUMED, "point-times-assumed", str(folder.location), reported)
    settled = replace(frames, mapping=PointMapping(scale=scale, times=times))
    return settled, None if scale is None else scale.maximum


def _note_first(folder: _CloudFolder, frames: _CloudFrames, ledger: Ledger) -> None:
    """Look at the first frame, and state what was left out of it."""
    frame = frames(0)
    notes: dict[str, tuple[str, Callable[[Any], int]]] = {
        "dropped_points": (
            "points that are not finite, or exactly at the origin, are no returns and are left out",
            int,
        ),
        "clipped_intensities": ("brightness beyond its scale is cut to it", int),
    }
    for name, (message, count) in notes.items():
        if name in frame.extras:
            location = str(frames.files[0])
            ledger.note(
                WarningKind.SKIPPED,
                name.replace("_", "-"),
                location,
                message,
                count=count(frame.extras[name]),
            )
    apart = frame.extras.get("head", {}).get("other_bounds")
    if apart:
        reported = (
            f"the bounds in the header are not those of the points ({apart} off); the points are read as they are"
        )
        ledger.note(WarningKind.ASSUMED, "other-bounds", str(frames.files[0]), reported)
    others = frame.extras.get("head", {}).get("elements_left_out")
    if others:
        listed = ", ".join(f"{count} {name}" for name, count in others.items())
        reported = f"only vertices are points: {listed} left out of the first file"
        ledger.note(WarningKind.SKIPPED, "elements-left-out", str(folder.location), reported)


def _find_folders(path: Path, kind: CloudKind) -> list[_CloudFolder]:
    """Find the files of each lidar.

    Raises:
        DataError: there are none.
    """
    if path.is_file():
        return [_CloudFolder(DEFAULT_ID, path, (path,), {})]
    try:
        folders = sorted(path / entry.name for entry in entries(path) if entry.is_dir())
        own = _files(path, kind)
        found = [] if own is None else [own]
        if own is None:
            found = [one for folder in folders if (one := _files(folder, kind)) is not None]
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror or error}") from error
    if not found:
        raise DataError(path, "", f"has no files of points; expected {kind.reported}")
    if len(found) == 1 and found[0].location == path:
        return found
    return [_CloudFolder(unquote(one.location.name), one.location, one.files, one.beside) for one in found]


def _files(folder: Path, kind: CloudKind) -> _CloudFolder | None:
    found = [entry for entry in entries(folder) if entry.is_file()]
    files = tuple(folder / entry.name for entry in sorted(found, key=lambda one: one.name) if kind.has_name(entry.name))
    beside = {entry.name: folder / entry.name for entry in found if entry.name in BESIDE}
    if folder.name == "data" and not beside:
        # KITTI's raw data have the times beside the folder of the files
        beside = {name: there for name in TIME_FILES if (there := folder.parent / name).is_file()}
    return _CloudFolder(DEFAULT_ID, folder, files, beside) if files else None
