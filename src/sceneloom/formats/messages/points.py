"""Messages of points as sweeps of a lidar or cycles of a radar, and back: packed fields, times of points."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.text_tables import UNITS_NS
from sceneloom.formats.messages.compressed_points import unpacked
from sceneloom.formats.messages.records import CloudRecord, PackedCloudRecord, PackedField, Topic, TopicLog
from sceneloom.formats.messages.survey import Survey, in_order
from sceneloom.formats.points.cloud import ALIASES, MOST_POINTS, Cloud, find_roles, unique_names
from sceneloom.formats.points.mapping import (
    IntensityScale,
    PointMapping,
    PointTimes,
    SweepClock,
    detect_scale,
    points_of,
)
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import (
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointsSensor,
    RadarFrame,
    RadarPoints,
    RadarSensor,
    white_where_unseen,
)
from sceneloom.scene.frames import LazyFrames
from sceneloom.warnings import WarningKind

_PADDING = "_"


def _unpack(record: CloudRecord, owner: str, location: str) -> Cloud:
    """Take the points of a message apart into columns; `owner` is what messages call the log."""
    rows = _rows(record, owner, location)
    named = zip(unique_names([field.name for field in record.fields]), record.fields, strict=True)
    columns = {name: _column(rows, field) for name, field in named if not name.startswith(_PADDING)}
    return Cloud(Path(owner), len(rows), columns)


def _rows(record: CloudRecord, owner: str, location: str) -> AnyArray:
    """(N, stride) uint8, the bytes of each point; a view, unless rows are longer than their points."""
    stride, content = record.stride, np.frombuffer(record.data, np.uint8)
    if stride <= 0 and (len(content) or record.count):
        raise DataError(owner, location, f"{stride} bytes from point to point; expected a positive number")
    for field in record.fields:
        end = field.offset + field.dtype.itemsize * field.count
        if field.offset < 0 or end > stride:
            problem = f"field {field.name!r} takes bytes {field.offset} to {end} of each point, which has {stride}"
            raise DataError(owner, location, f"{problem}; expected fields inside the point")
    stride = max(stride, 1)
    count = len(content) // stride if record.count is None else record.count
    if not 0 <= count <= MOST_POINTS:
        raise DataError(owner, location, f"{count} points; expected 0 to {MOST_POINTS}")
    if record.row_bytes is None or record.row_bytes[0] == record.row_bytes[1] * stride:
        if len(content) < count * stride:
            problem = f"{len(content)} bytes for {count} points of {stride}; expected {count * stride}"
            raise DataError(owner, location, problem)
        return content[: count * stride].reshape(count, stride)
    length, width = record.row_bytes
    height = count // width if width else 0
    if length < width * stride or len(content) < height * length:
        problem = (
            f"{height} rows of {length} bytes for {width} points of {stride}, {len(content)} bytes in all; "
            f"expected rows of {width * stride} or more, and all of them"
        )
        raise DataError(owner, location, problem)
    rows = content[: height * length].reshape(height, length)[:, : width * stride]
    return np.ascontiguousarray(rows).reshape(count, stride)


def _column(rows: AnyArray, field: PackedField) -> AnyArray:
    shape = (len(rows),) if field.count == 1 else (len(rows), field.count)
    strides = (rows.strides[0], field.dtype.itemsize)[: len(shape)]
    if len(rows) == 0:
        return np.zeros(shape, field.dtype.newbyteorder("="))
    # numbers picked out of the points one by one: copying the bytes of each takes ten times as long
    column = np.ndarray(shape, field.dtype, rows, field.offset, strides)
    native: AnyArray = column.astype(field.dtype.newbyteorder("="), order="C")
    return native


def scan_record(
    timestamp_ns: int,
    frame_id: str,
    ranges: Float64Array,
    intensities: Float64Array,
    *,
    angles: tuple[float, float],
    limits: tuple[float, float] = (0.0, np.inf),
    step_s: float = 0.0,
    beams: Int64Array | None = None,
    echoes: Int64Array | None = None,
    frame_from_points: RigidTransform | None = None,
) -> CloudRecord:
    """The points of a lidar of one line, in the plane z = 0; those without a range have none.

    Args:
        timestamp_ns: of the first beam [ns].
        frame_id: of the points.
        ranges: (N,) [m]; infinite, NaN, and not above 0 where nothing was measured.
        intensities: (N,), or none.
        angles: of the first beam, and from beam to beam [rad], counterclockwise about z from x.
        limits: smallest and largest range that was measured [m].
        step_s: from beam to beam [s]; 0 where it is not stated.
        beams: (N,) number of the beam of each range; None for one range of each.
        echoes: (N,) number of the range among those of its beam, or None.
        frame_from_points: where the lidar is in the frame.

    Source: sensor_msgs/LaserScan and MultiEchoLaserScan; REP 117.
    """
    beams = np.arange(len(ranges), dtype=np.int64) if beams is None else beams
    columns: dict[str, tuple[str, AnyArray]] = {}
    with np.errstate(invalid="ignore", over="ignore"):
        measured = np.isfinite(ranges) & (ranges > 0) & (ranges >= limits[0]) & (ranges <= limits[1])
        kept = np.where(measured, ranges, np.nan)
        bearings = angles[0] + angles[1] * beams
        for name, values in (("x", np.cos(bearings)), ("y", np.sin(bearings)), ("z", np.zeros(len(beams)))):
            columns[name] = "<f4", kept * values
        if len(intensities) == len(ranges) > 0:
            columns["intensity"] = "<f4", intensities
        offsets_ns = np.rint(beams * (step_s * 1e9))
        if step_s > 0 and offsets_ns.max(initial=0) < 1 << 32:
            columns["t"] = "<u4", offsets_ns
        elif step_s:
            columns["time"] = "<f8", beams * step_s
        if echoes is not None:
            columns["echo"] = "<u1", np.minimum(echoes, 255)
        rows = np.empty(len(ranges), np.dtype([(name, dtype) for name, (dtype, _) in columns.items()]))
        for name, (_, values) in columns.items():
            rows[name] = values
    offsets: Any = rows.dtype.fields
    fields = tuple(PackedField(name, int(offsets[name][1]), offsets[name][0]) for name in columns)
    data = rows.view(np.uint8).data.cast("B")
    return CloudRecord(
        timestamp_ns, frame_id, fields, rows.dtype.itemsize, data, len(rows), frame_from_points=frame_from_points
    )


@dataclass(frozen=True, slots=True, eq=False)
class _KeptPoints:
    """The points of a message of ours, which can be copied into another as they are."""

    reader: "_CloudReader"
    row: int
    record: CloudRecord
    count: int

    def __len__(self) -> int:
        return self.count

    def unpacked(self) -> LidarPoints:
        """Take them apart."""
        return self.reader.unpacked(self.row, self.record)[0]


def _can_be_kept(record: CloudRecord) -> bool:
    """Whether a message is as we write them: nothing in it has to be brought to another scale or location."""
    intensity = next((field for field in record.fields if field.name == "intensity"), None)
    return (
        (record.frame_from_points is None or np.array_equal(record.frame_from_points.matrix, np.eye(4)))
        and record.row_bytes is None
        and (intensity is None or intensity.dtype.str[1:] in ("u1", "f4"))
    )


_LONGEST_SWEEP_NS = 1_500_000_000  # no lidar rotates more slowly
_SHORTEST_SWEEP_NS = 1_000_000  # times over less than this are not those of a sweep, but one time with noise
_USUAL_SWEEP_NS = 100_000_000
_SAME_PACE, _PACE_JITTER_NS = 0.1, 20_000_000  # clocks that differ by more, of what passes and beside it, do not agree
_CERTAIN = 10.0  # sweeps that last so many times longer or shorter than from message to message may be of another unit

_ORDERS = {
    "f": ("seconds", "milliseconds", "microseconds", "nanoseconds"),
    "i": ("nanoseconds", "microseconds", "milliseconds", "seconds"),
    "u": ("nanoseconds", "microseconds", "milliseconds", "seconds"),
}
"""Units by kind of number, the likeliest first."""

_REFERENCES = ("timestamp", "clock", "own")
"""What times count from, the likeliest first: the message's timestamp, zero of the clock that timestamps messages, and
zero of another clock, of which only differences are known."""


class _FoundTimes(NamedTuple):
    """What the times of points may mean: unit, one of `_REFERENCES`, and where they lie from the timestamp [ns]."""

    unit: str
    reference: str
    first_ns: int
    last_ns: int
    low_ns: int = 0  # the least value itself

    def off(self, sweep_ns: int) -> float:
        """How many times longer or shorter than `sweep_ns` the sweep is."""
        ratio = (self.last_ns - self.first_ns) / sweep_ns
        return max(ratio, 1 / ratio)


def _possible_times(values: AnyArray, timestamp_ns: int) -> dict[tuple[str, str], _FoundTimes]:
    """Readings of times of points, (N,), by unit and reference: over 1 ms to 1.5 s, and as near to their message."""
    if values.ndim != 1 or values.dtype.kind not in _ORDERS or len(values) < 2:
        return {}
    exact = values.dtype.kind != "f"
    ends = values.min(), values.max()
    if not exact and not np.isfinite(ends).all():
        return {}
    found = {}
    for unit in _ORDERS[values.dtype.kind]:
        low, high = (int(v) * UNITS_NS[unit] if exact else round(float(v) * UNITS_NS[unit]) for v in ends)
        if not _SHORTEST_SWEEP_NS <= high - low <= _LONGEST_SWEEP_NS:
            continue
        for reference, zero_ns in zip(_REFERENCES, (0, timestamp_ns, low), strict=True):
            first, last = low - zero_ns, high - zero_ns
            if max(abs(first), abs(last)) <= _LONGEST_SWEEP_NS:
                found[unit, reference] = _FoundTimes(unit, reference, first, last, low)
    return found


SPEED_COLUMNS = ("velocity", "doppler", "radial_speed", "range_rate", "v_doppler_mps", "speed_radial")
"""Names of the speed along the line of sight."""

DIRECTION_COLUMNS = ("direction_x", "direction_y", "direction_z")
"""Names of the direction that a speed is measured along, in messages of ours."""

OLD_TIME_COLUMN = "offset_ns"  # name of the times of points in messages that we wrote before `t`

TIME_COLUMNS: Mapping[tuple[str, str], str] = MappingProxyType({("t", "u4"): "nanoseconds", ("time", "f8"): "seconds"})
"""Names and dtypes of the times of points from their sweep's timestamp, in messages of ours, and their units.
Source: drivers of Ouster (`t`) and Velodyne (`time`, with 32 bits); KISS-ICP and LIO-SAM know both by name."""

_OURS = PointMapping(scale=IntensityScale(255.0))
_LOOKED_AT = 10


@dataclass(frozen=True, slots=True, eq=False)
class _CloudReader:
    """Reads the messages of points of one topic."""

    log: TopicLog
    topic: Topic
    rows: Int64Array  # number of each message in its topic
    timestamps_ns: Int64Array  # as the messages state, in order
    starts_ns: Int64Array  # start of each sweep
    mapping: PointMapping = field(default_factory=PointMapping)
    whole: bool = False  # points at the origin are points: in messages of ours they are
    own_clock: bool = False  # times of points are of another clock than those of messages

    def record(self, k: int) -> CloudRecord:
        """Read message `k`."""
        record = self.log.read(self.topic, int(self.rows[k]))[0]
        if isinstance(record, PackedCloudRecord):
            try:
                return unpacked(record)
            except ValueError as error:
                raise DataError(self.log.name, self.location(k), str(error)) from error
        if not isinstance(record, CloudRecord):
            raise DataError(self.log.name, self.location(k), "no points; expected a cloud")
        return record

    def stated_ns(self, k: int) -> int:
        """The timestamp that message `k` has, or that counts where it has none."""
        return self.record(k).timestamp_ns or int(self.timestamps_ns[k])

    def location(self, k: int) -> str:
        """Where message `k` stands, for messages."""
        return f"{self.topic.name}[{int(self.rows[k])}]"

    def cloud(self, k: int) -> Cloud:
        """Read the columns of message `k`."""
        return _unpack(self.record(k), self.log.name, self.location(k))

    def points(self, k: int) -> tuple[LidarPoints, dict[str, Any]]:
        """Read the points of message `k`, and what was left out of them."""
        record = self.record(k)
        if self.whole and _can_be_kept(record):
            rows = _rows(record, self.log.name, self.location(k))
            return LidarPoints.of_packed(_KeptPoints(self, k, record, len(rows))), {}
        return self.unpacked(k, record)

    def unpacked(self, k: int, record: CloudRecord) -> tuple[LidarPoints, dict[str, Any]]:
        """Take the points of message `k` apart, and count what was left out of them."""
        cloud = _unpack(record, self.log.name, self.location(k))
        mapping = _ours(cloud) if self.whole else self.mapping
        if mapping.times is not None and mapping.times.field not in cloud.columns:
            mapping = replace(mapping, times=None)
        clock = SweepClock(int(self.timestamps_ns[k]), int(self.starts_ns[k]), self._zero_ns(k, record, cloud))
        try:
            read = points_of(cloud, mapping, clock, keep_all=self.whole)
        except DataError as error:
            location = ": ".join(filter(None, (self.location(k), error.location)))
            raise DataError(self.log.name, location, error.problem) from None
        counts = {"dropped_points": read.dropped, "clipped_intensities": read.clipped}
        points = _placed(read.points, record.frame_from_points)
        return self._with_cameras(points), {n: c for n, c in counts.items() if c}

    def _zero_ns(self, k: int, record: CloudRecord, cloud: Cloud) -> int:
        """Where zero of the clock that times of points count from lies on the scene's clock [ns]."""
        if self.own_clock and self.mapping.times is not None:
            low = _counted(cloud, str(self.mapping.times.field)).min(initial=np.inf)
            low_ns = 0 if not np.isfinite(low) else round(low.item() * UNITS_NS[self.mapping.times.unit])
            return int(self.timestamps_ns[k]) - low_ns
        # messages whose own timestamps do not count are moved with the times of their points
        settled_ns = int(self.timestamps_ns[k])
        stamp_ns = record.timestamp_ns or settled_ns
        return settled_ns - stamp_ns + (_base_ns(record, stamp_ns) or 0)

    def _with_cameras(self, points: LidarPoints) -> LidarPoints:
        """Take what coloured the points out of the further columns of a message of ours."""
        if not self.whole:
            return points
        further = dict(points.extras)
        if points.colors is not None:
            further.pop("alpha", None)  # which viewers ask for, and says nothing
        index = points.extras.get("camera_index")
        if index is not None and index.dtype == np.uint8:
            colors = None if points.colors is None else white_where_unseen(points.colors, index)
            points = replace(points, colors=colors, camera_index=further.pop("camera_index"))
        return replace(points, extras=MappingProxyType(further))

    def lidar_frame(self, k: int) -> LidarFrame:
        """Read sweep `k` of a lidar."""
        points, extras = self.points(k)
        return LidarFrame(int(self.starts_ns[k]), points, MappingProxyType(extras))

    def radar_frame(self, k: int) -> RadarFrame:
        """Read cycle `k` of a radar, whose speeds go along the line of sight unless a message says otherwise."""
        points, extras = self.points(k)
        further = {"intensity": points.intensities, "ring": points.rings, "camera_index": points.camera_index}
        columns = {**points.extras, **{name: values for name, values in further.items() if values is not None}}
        speed = _speed_column(columns)
        lengths = None if speed is None else read_only(columns.pop(speed), np.float32)
        directions = None if lengths is None else _directions(columns, points.positions)
        times, columns_left = points.timestamps_ns, MappingProxyType(columns)
        radar = RadarPoints(points.positions, directions, lengths, times, columns_left)
        return RadarFrame(int(self.starts_ns[k]), radar, MappingProxyType(extras))


def _ours(cloud: Cloud) -> PointMapping:
    """What the columns of a message of ours mean."""
    if OLD_TIME_COLUMN in cloud.columns:
        return replace(_OURS, times=PointTimes("nanoseconds", "timestamp", OLD_TIME_COLUMN))
    for (name, dtype), unit in TIME_COLUMNS.items():
        if name in cloud.columns and cloud.columns[name].dtype.str[1:] == dtype:
            return replace(_OURS, times=PointTimes(unit, "timestamp", name))
    return _OURS


def _placed(points: LidarPoints, frame_from_points: RigidTransform | None) -> LidarPoints:
    if frame_from_points is None or np.array_equal(frame_from_points.matrix, np.eye(4)):
        return points
    return replace(points, positions=read_only(frame_from_points.apply(points.positions), np.float32))


def _speed_column(columns: Iterable[str]) -> str | None:
    """The column of speeds along the line of sight, or None."""
    lower = {name.lower(): name for name in columns}
    return next((lower[name] for name in SPEED_COLUMNS if name in lower), None)


def _directions(columns: dict[str, AnyArray], positions: AnyArray) -> AnyArray:
    if all(name in columns for name in DIRECTION_COLUMNS):
        reported = [columns.pop(name) for name in DIRECTION_COLUMNS]
        return read_only(np.stack(reported, axis=1), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        distances = np.linalg.norm(positions, axis=1, keepdims=True)
    ahead = np.divide(positions, distances, out=np.zeros_like(positions), where=distances > 0)
    return read_only(ahead, np.float32)


def _understood(reader: _CloudReader, ledger: Ledger) -> _CloudReader:
    """Settle what brightness and times of a lidar mean, looking at its first messages."""
    if reader.whole:
        return replace(reader, mapping=_OURS)
    if len(reader.rows) == 0:
        return reader
    where = f"{reader.log.name}: {reader.topic.name}"
    k, cloud = _telling(reader)
    roles = find_roles(cloud.columns, {})
    mapping = reader.mapping
    if "intensity" in roles:
        mapping = replace(mapping, scale=_scale(cloud.columns[roles["intensity"]], roles["intensity"], where, ledger))
    reader = replace(reader, mapping=mapping)
    return _with_times(reader, cloud, k, where, ledger)


def _telling(reader: _CloudReader) -> tuple[int, Cloud]:
    """The first of the first messages that has any points in it, else the first."""
    first = reader.cloud(0)
    for k in range(min(len(reader.rows), _LOOKED_AT)):
        cloud = first if k == 0 else reader.cloud(k)
        if cloud.count > 1:
            return k, cloud
    return 0, first


def _scale(values: AnyArray, name: str, where: str, ledger: Ledger) -> Any:
    scale = detect_scale(values) if values.dtype.kind in "iuf" and values.ndim == 1 else None
    if scale is None:
        top = f" goes up to {values.max():g} and" if values.dtype.kind in "iuf" and len(values) else ""
        message = f"{name}{top} is of no usual scale; it is kept as it is, and is no brightness"
        ledger.note(WarningKind.SKIPPED, "intensity-not-used", where, message)
    elif values.dtype != np.uint8:
        message = f"{name} goes up to {values.max(initial=0):g}, so {scale.maximum:g} becomes 255"
        ledger.note(WarningKind.ASSUMED, "intensity-scale", where, message)
    return scale


def _base_ns(record: CloudRecord, stamp_ns: int) -> int | None:
    """What the times of points count from, where the message states it: its timestamp, if the two are far apart."""
    if record.base_ns is None or abs(record.base_ns - stamp_ns) <= _LONGEST_SWEEP_NS:
        return record.base_ns
    return stamp_ns


def _counted(cloud: Cloud, name: str) -> AnyArray:
    """The values of a column that are finite and of points with a return."""
    values = cloud.columns[name]
    kept = np.isfinite(values) if values.dtype.kind == "f" else np.ones(values.shape, np.bool_)
    axes = [cloud.columns[axis] for axis in "xyz" if axis in cloud.columns and cloud.columns[axis].ndim == 1]
    if len(axes) == 3 and values.ndim == 1:
        kept &= np.isfinite(axes).all(axis=0) & (np.array(axes) != 0).any(axis=0)
    return np.asarray(values[kept])


def _with_times(reader: _CloudReader, cloud: Cloud, k: int, where: str, ledger: Ledger) -> _CloudReader:
    """Settle what times of points are there and mean, by two messages as far apart as can be."""
    record = reader.record(k)
    stated = record.base_ns is not None
    lower = {name.lower(): name for name in reversed([*cloud.columns])}
    names = [lower[alias] for alias in ALIASES["time"] if alias in lower]
    if not names:
        return reader
    far = len(reader.rows) - 1 - k
    other = next((at for at in range(k + far, max(k, k + far - _LOOKED_AT), -1) if reader.cloud(at).count > 1), None)
    sweep_ns = int(np.median(np.diff(reader.timestamps_ns))) if len(reader.timestamps_ns) > 1 else 0
    for name in names:
        if stated:
            found = _stated_times(record, reader.stated_ns(k), cloud, name)
        else:
            found = _found_times(reader, cloud, k, other, name, sweep_ns)
        if found is not None:
            break
    else:
        message = f"field {names[0]!r} is no time of points in any unit, relative or absolute; it is kept as it is"
        ledger.note(WarningKind.SKIPPED, "point-times-not-used", where, message)
        return reader
    if stated and abs(off_ns := (record.base_ns or 0) - reader.stated_ns(k)) > _LONGEST_SWEEP_NS:
        message = f"{name!r} counts from {off_ns / 1e9:+.3f} s off the message's timestamp, from which it is counted"
        ledger.note(WarningKind.ASSUMED, "point-times-other-clock", where, message)
    elif not stated:
        _note_times(found, name, sweep_ns, where, ledger)
    if found.reference == "timestamp" and _falls(_counted(cloud, name)):
        message = f"field {name!r} falls from the first point to the last; it is not taken to count back from an end"
        ledger.note(WarningKind.ASSUMED, "point-times-fall", where, message)
    times = PointTimes(found.unit, "timestamp" if found.reference == "timestamp" else "clock", name)
    own = found.reference == "own"
    reader = replace(reader, mapping=replace(reader.mapping, times=times), own_clock=own)
    if not found.first_ns < -_EARLY_NS:
        return reader
    message = (
        f"sweeps begin {-found.first_ns / 1e9:.6f} s before the timestamps of their messages, and are timestamped so"
    )
    ledger.note(WarningKind.ASSUMED, "timestamps-after-start", where, message)
    return replace(reader, starts_ns=read_only(reader.timestamps_ns + found.first_ns))


def _stated_times(record: CloudRecord, stamp_ns: int, cloud: Cloud, name: str) -> _FoundTimes | None:
    """Times whose meaning the type of the message states: nanoseconds from `base_ns`."""
    values = _counted(cloud, name)
    if values.dtype.kind not in "iu":
        return None
    if not len(values):
        return _FoundTimes("nanoseconds", "clock", 0, 0)
    base_ns = (_base_ns(record, stamp_ns) or 0) - stamp_ns
    return _FoundTimes("nanoseconds", "clock", base_ns + int(values.min()), base_ns + int(values.max()))


def _found_times(
    reader: _CloudReader, cloud: Cloud, k: int, other: int | None, name: str, sweep_ns: int
) -> _FoundTimes | None:
    """The likeliest reading of a column that fits two messages; of another clock if it runs as that of messages."""
    found = _possible_times(_counted(cloud, name), reader.stated_ns(k))
    own = {key: one for key, one in found.items() if key[1] == "own"}
    usual = {key: one for key, one in found.items() if key not in own}
    if other is not None:
        later = reader.cloud(other)
        again = {} if name not in later.columns else _possible_times(_counted(later, name), reader.stated_ns(other))
        usual = {key: one for key, one in usual.items() if key in again}
        passed = reader.stated_ns(other) - reader.stated_ns(k)
        most = _SAME_PACE * passed + _PACE_JITTER_NS
        own = {
            key: one for key, one in own.items() if key in again and abs(again[key].low_ns - one.low_ns - passed) < most
        }
    else:
        own = {}
    likely = usual or own
    # of equal ones the first: units and references are in the order of how likely they are
    return min(likely.values(), key=lambda one: round(np.log(one.off(sweep_ns or _USUAL_SWEEP_NS)), 1), default=None)


def _note_times(found: _FoundTimes, name: str, sweep_ns: int, where: str, ledger: Ledger) -> None:
    """Report what the times of points were taken for."""
    bases = {"timestamp": "the message's timestamp", "clock": "the clock's zero", "own": "another clock's zero"}
    message = f"field {name!r} is taken for times of points: {found.unit} from {bases[found.reference]}"
    ledger.note(WarningKind.ASSUMED, "point-times-assumed", where, message)
    if found.reference == "own":
        message = f"{name!r} is of another clock than timestamps; the first point of a sweep is taken to be at its own"
        ledger.note(WarningKind.ASSUMED, "point-times-other-clock", where, message)
    if sweep_ns > 0 and found.off(sweep_ns) > _CERTAIN:
        lasts = (found.last_ns - found.first_ns) / 1e9
        message = f"by {name!r} sweeps last {lasts:.6f} s, one every {sweep_ns / 1e9:.6f} s; its unit is not certain"
        ledger.note(WarningKind.ASSUMED, "point-times-uncertain", where, message)


def _falls(values: AnyArray) -> bool:
    """Whether times fall from the first point to the last, but for noise."""
    tenth = max(len(values) // 10, 1)
    first, last = values[:tenth].mean(), values[-tenth:].mean()
    return bool(len(values) > 1 and last < first - 0.5 * float(values.max() - values.min()))


_EARLY_NS = 1_000_000  # points may be this much earlier than the timestamp of their sweep: drivers round


@dataclass(frozen=True, slots=True, eq=False)
class CloudDraft:
    """A topic of points before it is placed.

    Attributes:
        reader: of its messages.
        frame_id: of its points.
        is_radar: whether its points have speeds along the line of sight.
    """

    reader: _CloudReader
    frame_id: str
    is_radar: bool

    @classmethod
    def of(cls, survey: Survey, topic: Topic) -> "CloudDraft":
        """Find out what a topic of points holds; its first messages are read.

        Raises:
            DataError: the first message is damaged.
        """
        timestamps = survey.times_ns[topic.number]
        rows = in_order(timestamps, f"{survey.log.name}: {topic.name}", survey.ledger)
        ours = survey.notes.ours and any(note.get("topic") == topic.name for note in survey.notes.sensors)
        reader = _CloudReader(survey.log, topic, rows, timestamps[rows], timestamps[rows], whole=ours)
        first = reader.record(0)
        if first.left_out:
            message = f"fields {', '.join(first.left_out)}, which the library of Draco would round, are left out"
            survey.ledger.note(WarningKind.SKIPPED, "fields-rounded", f"{survey.log.name}: {topic.name}", message)
        names = {field.name for field in first.fields}
        # a radar's points have speeds, and the topic or our own fields report it
        is_radar = "radar" in topic.name.lower() or names.issuperset(DIRECTION_COLUMNS)
        is_radar = is_radar and _speed_column(names) is not None
        return cls(_understood(reader, survey.ledger), first.frame_id, is_radar)

    def sensor(self, sensor_id: str | int, *, radar: bool | None = None, **fields: Any) -> LidarSensor | RadarSensor:
        """The sensor, with further fields."""
        times = self.reader.starts_ns
        if self.is_radar if radar is None else radar:
            fields.pop("model", None)
            return RadarSensor(sensor_id, LazyFrames(times, self.reader.radar_frame), **fields)
        return LidarSensor(sensor_id, LazyFrames(times, self.reader.lidar_frame), **fields)

    def points(self, sensor_id: str | int, **fields: Any) -> PointsSensor:
        """The map that the only message holds."""
        points = self.reader.points(0)[0]
        return PointsSensor(sensor_id, points.positions, points.colors, **fields)
