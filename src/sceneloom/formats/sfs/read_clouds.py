"""Lidar, radar and points sensors of a file."""

from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.sfs.container import format_keys
from sceneloom.formats.sfs.poses import further_of_poses, mount_of, repaired_path_of
from sceneloom.formats.sfs.records import Faults, FieldError, Location
from sceneloom.formats.sfs.source import Source
from sceneloom.formats.sfs.times import TimeRangeError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import (
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointsSensor,
    RadarFrame,
    RadarPoints,
    RadarSensor,
)
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import Coordinates, PointsFrame
from sceneloom.scene.warnings import WarningKind

Record = dict[str, Any]

_LIDAR_ARRAYS = {
    "positions": "positions",
    "colors": "colors",
    "intensities": "intensities",
    "ring": "rings",
    "camera_index": "camera_index",
}
_RADAR_ARRAYS = {"positions": "positions", "directions": "directions", "lengths": "lengths"}
_OURS = {"ring": np.dtype(np.uint16), "camera_index": np.dtype(np.uint8)}
_OTHER_WIDTH = {4: "uint64", 8: "uint32"}
_TYPICAL_PERIOD_NS = 100_000_000


def read_lidar(source: Source, values: Record, location: Location, faults: Faults) -> LidarSensor | None:
    """Make a lidar of its record."""
    frames = values.pop("frames")
    relative = _check_frames(source, frames, location, faults)
    moving = read_moving(source, values, location, faults, frame_count=len(frames))
    if faults.unmended:
        return None
    note = source.note(values["id"])
    read = _frame_reader(source, frames, location, relative=relative, make=_lidar_frame)
    return LidarSensor(
        values.pop("id"),
        LazyFrames(_timestamps(frames), read),
        points_frame=points_frame(source, note, moving["coordinates"], location),
        model=note.get("model"),
        **moving,
        extras=rest_of(values),
    )


def read_radar(source: Source, values: Record, location: Location, faults: Faults) -> RadarSensor | None:
    """Make a radar of its record."""
    frames = values.pop("frames")
    note = source.note(values["id"])
    _restore_lengths(frames, note, faults)
    relative = _check_frames(source, frames, location, faults)
    moving = read_moving(source, values, location, faults, frame_count=len(frames))
    if faults.unmended:
        return None
    read = _frame_reader(source, frames, location, relative=relative, make=_radar_frame)
    return RadarSensor(
        values.pop("id"),
        LazyFrames(_timestamps(frames), read),
        points_frame=points_frame(source, note, moving["coordinates"], location),
        **moving,
        extras=rest_of(values),
    )


def read_points(source: Source, values: Record, location: Location, faults: Faults) -> PointsSensor | None:
    """Make a points sensor of its record."""
    del source, location
    points = values.pop("points")
    _check_counts(points, ("points",), faults)
    if faults:
        return None
    extras = rest_of(values)
    further = {name: array for name, array in points.items() if name not in {"positions", "colors"}}
    if further:
        extras["points"] = further
    return PointsSensor(
        values["id"],
        _aligned(points["positions"]),
        None if points.get("colors") is None else _aligned(points["colors"]),
        parent_id=values.get("parent_id"),
        extras=extras,
    )


def rest_of(values: Record) -> Record:
    """The fields that no attribute of the model takes."""
    taken = {"id", "type", "parent_id", "poses", "coordinates", "points", "frames"}
    further = {name: value for name, value in values.items() if name not in taken}
    return {**further, **further_of_poses(values)}


def read_moving(
    source: Source, values: Record, location: Location, faults: Faults, *, frame_count: int
) -> Record:
    """Read what every sensor with poses has: `poses`, `mount`, `coordinates`, `parent_id`."""
    note = source.note(values["id"])
    coordinates = values.get("coordinates") or Coordinates.WORLD.value
    if coordinates not in set(Coordinates):
        faults.add(("coordinates",), f"{coordinates!r}; expected one of {', '.join(Coordinates)}")
        return {}
    poses = _poses(source, values, location, faults)
    mount = _mount(note, faults)
    if note.get("poses_from_mount"):
        poses, coordinates = None, note.get("coordinates", Coordinates.WORLD.value)
    elif poses is not None and len(poses.timestamps_ns) == 1:
        stationary = note.get("poses_static", coordinates == Coordinates.EGO or frame_count != 1)
        poses = Poses(poses.timestamps_ns, poses.positions, poses.quaternions_xyzw, static=bool(stationary))
        if stationary and "poses_static" not in note:
            message = "a single pose; taken to hold at all times"
            source.warning(WarningKind.ASSUMED, "single-pose", (*location, "poses"), message)
    return {
        "poses": poses,
        "mount": mount,
        "coordinates": Coordinates(coordinates),
        "parent_id": values.get("parent_id"),
    }


def _poses(source: Source, values: Record, location: Location, faults: Faults) -> Poses | None:
    record = values.get("poses")
    found = Faults()
    path = None if record is None else repaired_path_of(record, found)
    faults.extend(found)
    if path is None and not found:
        message = "no poses; expected where the sensor was"
        source.warning(WarningKind.SKIPPED, "no-poses", (*location, "poses"), message)
    return path


def _mount(note: Mapping[str, Any], faults: Faults) -> RigidTransform | None:
    try:
        return None if note.get("mount") is None else mount_of(note["mount"])
    except FieldError as error:
        faults.add(("mount",), f"our note: {error}")
        return None


def points_frame(
    source: Source, note: Mapping[str, Any], coordinates: Coordinates, location: Location
) -> PointsFrame:
    """Report in which frame the points are: as the caller says, else as recorded, else as `coordinates` says."""
    if source.options.points_frame is not None:
        return PointsFrame(source.options.points_frame)
    recorded = note.get("points_frame")
    if recorded in set(PointsFrame):
        return PointsFrame(recorded)
    message = f"the frame of the points is not stated; taken to be the {coordinates.value} frame"
    source.warning(WarningKind.ASSUMED, "points-frame", location, message)
    return PointsFrame(coordinates.value)


def _timestamps(frames: list[Record]) -> Int64Array:
    return np.array([frame["timestamp"] for frame in frames], np.int64)


def _frame_reader(
    source: Source, frames: list[Record], location: Location, *, relative: bool, make: Callable[..., Any]
) -> Callable[[int], Any]:
    container, clock = source.container, source.clock

    def read(index: int) -> Any:
        where = format_keys((*location, "frames", index))
        container.check_open(where)
        frame = container.fetch(frames[index])
        try:
            times_ns = _point_times(frame, clock.absolute_array, clock.tick_ns, relative=relative)
        except TimeRangeError as error:
            raise DataError(container.file, f"{where}.points.timestamps", str(error)) from None
        extras = {name: value for name, value in frame.items() if name not in {"timestamp", "points"}}
        return make(frame["timestamp"], frame["points"], times_ns, extras)

    return source.parts.keep(format_keys((*location, "frames")), read)


def _point_times(
    frame: Record, absolute: Callable[[AnyArray], Int64Array], tick_ns: int, *, relative: bool
) -> Int64Array | None:
    timestamps = frame["points"].get("timestamps")
    if timestamps is None:
        return None
    if relative:
        return read_only(timestamps.astype(np.int64) * tick_ns + frame["timestamp"])
    return read_only(absolute(timestamps))


def _lidar_frame(
    timestamp_ns: int, points: Record, times_ns: Int64Array | None, extras: Record
) -> LidarFrame:
    arrays, further = _known_arrays(points, _LIDAR_ARRAYS)
    return LidarFrame(timestamp_ns, LidarPoints(**arrays, timestamps_ns=times_ns, extras=further), extras)


def _radar_frame(
    timestamp_ns: int, points: Record, times_ns: Int64Array | None, extras: Record
) -> RadarFrame:
    arrays, further = _known_arrays(points, _RADAR_ARRAYS)
    return RadarFrame(timestamp_ns, RadarPoints(**arrays, timestamps_ns=times_ns, extras=further), extras)


def _known_arrays(points: Record, names: Mapping[str, str]) -> tuple[Record, Record]:
    """Part the arrays that the model knows from those that it only carries along."""
    known, further = {}, {}
    for name, value in points.items():
        if name in names and value is not None and _is_ours_or_known(name, value, points):
            known[names[name]] = _aligned(value)
        elif name != "timestamps" and not (name in names and value is None):
            further[name] = value
    return known, further


def _is_ours_or_known(name: str, value: Any, points: Record) -> bool:
    """Whether an array is what its name says; `ring` and `camera_index` may be a stranger's."""
    if name not in _OURS:
        return True
    return (
        isinstance(value, np.ndarray)
        and value.dtype == _OURS[name]
        and value.shape == points["positions"].shape[:1]
    )


def _aligned(array: AnyArray) -> AnyArray:
    """Copy an array whose items lie at odd addresses: compiled functions cannot take it."""
    return array if array.flags.aligned else read_only(array.copy())


def _check_frames(source: Source, frames: list[Record], location: Location, faults: Faults) -> bool:
    """Check that the arrays of each frame are of one length.

    Report whether point times count from the frame's start.
    """
    if faults.unmended:
        return False
    for index, frame in enumerate(frames):
        _check_counts(frame["points"], ("frames", index, "points"), faults)
    relative = not faults and _times_are_relative(source, frames)
    if relative:
        message = (
            "point times lie before their frame and within one period; read as counted from the frame's start"
        )
        source.warning(WarningKind.ASSUMED, "relative-point-times", (*location, "frames"), message)
    return relative


def note_further_faults(values: Record, faults: Faults) -> None:
    """Look through a sensor that is at fault for what else is wrong in its frames and poses."""
    frames = values.get("frames")
    for index, frame in enumerate(frames if isinstance(frames, list) else []):
        points = frame.get("points") if isinstance(frame, dict) else None
        if isinstance(points, dict) and isinstance(points.get("positions"), np.ndarray):
            _check_counts(points, ("frames", index, "points"), faults)
    poses = values.get("poses")
    if isinstance(poses, dict) and not any(poses.get(name) is None for name in ("timestamps", "values")):
        repaired_path_of(poses, faults)


def _check_counts(points: Record, location: Location, faults: Faults) -> None:
    count = len(points["positions"])
    for name in ("colors", "intensities", "timestamps", "directions", "lengths"):
        array = points.get(name)
        if isinstance(array, np.ndarray) and len(array) != count:
            problem = f"{len(array)} values for {count} points; expected as many"
            if name == "timestamps" and len(array) in {2 * count, count / 2}:
                problem += f": the bytes fit {_OTHER_WIDTH.get(array.dtype.itemsize, 'another width')}, not "
                problem += (
                    f"{array.dtype.name}; see `time_unit` of the scene, which decides where no dtype says it"
                )
            faults.add((*location, name), problem)


def _times_are_relative(source: Source, frames: list[Record]) -> bool:
    """Judge by the last frame that has point times: all of them below its start and within one period."""
    timestamps_ns = sorted(frame["timestamp"] for frame in frames)
    gaps_ns = sorted(after - before for before, after in pairwise(timestamps_ns))
    period_ns = gaps_ns[len(gaps_ns) // 2] if gaps_ns else _TYPICAL_PERIOD_NS
    tick_ns, offset_ns = source.clock.tick_ns, source.clock.offset_ns
    for frame in reversed(frames):
        times = frame["points"].get("timestamps")
        if isinstance(times, np.ndarray) and times.size:
            latest_ns = int(source.container.fetch(times).max()) * tick_ns
            return latest_ns < frame["timestamp"] - offset_ns and latest_ns <= period_ns
    return False


def _restore_lengths(frames: list[Record], note: Mapping[str, Any], faults: Faults) -> None:
    """Put back the lengths that the profile `scale` keeps under our metadata."""
    lengths = note.get("lengths")
    if lengths is None:
        return
    if len(lengths) != len(frames):
        faults.add(("frames",), f"our note holds lengths of {len(lengths)} frames; expected {len(frames)}")
        return
    for frame, values in zip(frames, lengths, strict=True):
        if isinstance(values, np.ndarray) and values.dtype == np.float32 and values.ndim == 1:
            frame.setdefault("points", {}).setdefault("lengths", values)
