"""Messages of points as the sweeps of a lidar or the cycles of a radar, each read when it is asked for."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.clouds.cloud import Cloud
from sceneloom.formats.clouds.points import (
    IntensityScale,
    PointMapping,
    PointTimes,
    SweepClock,
    detect_scale,
    points_of,
)
from sceneloom.formats.clouds.roles import find_roles
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.topics.kept_points import KeptPoints, can_be_kept
from sceneloom.formats.topics.log import Topic, TopicLog
from sceneloom.formats.topics.packed_points import checked_rows, unpack
from sceneloom.formats.topics.point_times import find_point_times
from sceneloom.formats.topics.records import CloudRecord
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarFrame, LidarPoints, RadarFrame, RadarPoints, white_where_unseen
from sceneloom.scene.warnings import WarningKind

SPEED_COLUMNS = ("velocity", "doppler", "radial_speed", "range_rate", "v_doppler_mps", "speed_radial")
"""Names of the speed along the line of sight."""

DIRECTION_COLUMNS = ("direction_x", "direction_y", "direction_z")
"""Names of the direction that a speed is measured along, in messages of ours."""

OLD_TIME_COLUMN = "offset_ns"
"""Name of the times of points in messages that we wrote before `t`."""

TIME_COLUMNS: Mapping[tuple[str, str], str] = MappingProxyType(
    {("t", "u4"): "nanoseconds", ("time", "f8"): "seconds"}
)
"""Names and dtypes of the times of points from their sweep's timestamp, in messages of ours, and their units.

Source: `t` as the drivers of Ouster write it, `time` as those of Velodyne do, but with 64 bits; programs that read
clouds of others (KISS-ICP, LIO-SAM) know both by their names.
"""

_OURS = PointMapping(scale=IntensityScale(255.0))

_LOOKED_AT = 10


@dataclass(frozen=True, slots=True, eq=False)
class CloudReader:
    """Reads messages of points.

    Attributes:
        log: that they are in.
        topic: that they are of.
        rows: (N,) int64, number of each message in its topic.
        timestamps_ns: (N,) int64 [ns], as the messages state, in order.
        starts_ns: (N,) int64 [ns], start of each sweep.
        mapping: what the columns mean.
        whole: whether points at the origin are points: in messages of ours they are.
    """

    log: TopicLog
    topic: Topic
    rows: Int64Array
    timestamps_ns: Int64Array
    starts_ns: Int64Array
    mapping: PointMapping = field(default_factory=PointMapping)
    whole: bool = False

    def record(self, k: int) -> CloudRecord:
        """Read message `k`."""
        record = self.log.read(self.topic, int(self.rows[k]))[0]
        if not isinstance(record, CloudRecord):
            raise DataError(self.log.name, self.location(k), "no points; expected a cloud")
        return record

    def location(self, k: int) -> str:
        """Where message `k` stands, for messages."""
        return f"{self.topic.name}[{int(self.rows[k])}]"

    def cloud(self, k: int) -> Cloud:
        """Read the columns of message `k`."""
        return unpack(self.record(k), self.log.name, self.location(k))

    def points(self, k: int) -> tuple[LidarPoints, dict[str, Any]]:
        """Read the points of message `k`, and what was left out of them."""
        record = self.record(k)
        if self.whole and can_be_kept(record):
            rows = checked_rows(record, self.log.name, self.location(k))
            return LidarPoints.of_packed(KeptPoints(self, k, record, len(rows))), {}
        return self.unpacked(k, record)

    def unpacked(self, k: int, record: CloudRecord) -> tuple[LidarPoints, dict[str, Any]]:
        """Take the points of message `k` apart, and count what was left out of them."""
        cloud = unpack(record, self.log.name, self.location(k))
        clock = SweepClock(int(self.timestamps_ns[k]), int(self.starts_ns[k]), 0)
        mapping = _ours(cloud) if self.whole else self.mapping
        if mapping.times is not None and mapping.times.field not in cloud.columns:
            mapping = replace(mapping, times=None)
        try:
            read = points_of(cloud, mapping, clock, keep_all=self.whole)
        except DataError as error:
            location = ": ".join(filter(None, (self.location(k), error.location)))
            raise DataError(self.log.name, location, error.problem) from None
        counts = {"dropped_points": read.dropped, "clipped_intensities": read.clipped}
        points = _placed(read.points, record.frame_from_points)
        return self._with_cameras(points), {n: c for n, c in counts.items() if c}

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


@dataclass(frozen=True, slots=True, eq=False)
class LidarReader:
    """Makes the sweeps of a lidar."""

    clouds: CloudReader

    def __call__(self, k: int) -> LidarFrame:
        """Read sweep `k`.

        Raises:
            DataError: its message is wrong.
        """
        points, extras = self.clouds.points(k)
        return LidarFrame(int(self.clouds.starts_ns[k]), points, MappingProxyType(extras))


@dataclass(frozen=True, slots=True, eq=False)
class RadarReader:
    """Makes the cycles of a radar, whose speeds go along the line of sight unless a message says otherwise."""

    clouds: CloudReader

    def __call__(self, k: int) -> RadarFrame:
        """Read cycle `k`.

        Raises:
            DataError: its message is wrong.
        """
        points, extras = self.clouds.points(k)
        columns = dict(points.extras)
        further = {
            "intensity": points.intensities,
            "ring": points.rings,
            "camera_index": points.camera_index,
        }
        columns |= {name: values for name, values in further.items() if values is not None}
        speed = speed_column(columns)
        lengths = None if speed is None else columns.pop(speed)
        directions = _directions(columns, points.positions) if lengths is not None else None
        radar = RadarPoints(
            points.positions,
            directions,
            None if lengths is None else read_only(lengths, np.float32),
            points.timestamps_ns,
            MappingProxyType(columns),
        )
        return RadarFrame(int(self.clouds.starts_ns[k]), radar, MappingProxyType(extras))


def speed_column(columns: Mapping[str, AnyArray]) -> str | None:
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


def understood(reader: CloudReader, ledger: Ledger) -> CloudReader:
    """Settle what brightness and times of a lidar mean, looking at its first messages.

    Raises:
        DataError: the first message is wrong.
    """
    if reader.whole:
        return replace(reader, mapping=_OURS)
    if len(reader.rows) == 0:
        return reader
    where = f"{reader.log.name}: {reader.topic.name}"
    k, cloud = _telling(reader)
    roles = find_roles(cloud.columns, {})
    mapping = reader.mapping
    if "intensity" in roles:
        mapping = replace(
            mapping, scale=_scale(cloud.columns[roles["intensity"]], roles["intensity"], where, ledger)
        )
    reader = replace(reader, mapping=mapping)
    return _with_times(reader, cloud, k, roles["time"], where, ledger) if "time" in roles else reader


def _telling(reader: CloudReader) -> tuple[int, Cloud]:
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


def _with_times(
    reader: CloudReader, cloud: Cloud, k: int, name: str, where: str, ledger: Ledger
) -> CloudReader:
    sweep_ns = int(np.median(np.diff(reader.timestamps_ns))) if len(reader.timestamps_ns) > 1 else None
    values = cloud.columns[name]
    found = find_point_times(name, values, int(reader.timestamps_ns[k]), sweep_ns or None)
    if found is None:
        message = (
            f"field {name!r} is no time of points in any unit, relative or absolute; it is kept as it is"
        )
        ledger.note(WarningKind.SKIPPED, "point-times-not-used", where, message)
        return reader
    meaning = found.meaning
    base = "the message's timestamp" if meaning.relative_to == "timestamp" else "the clock's zero"
    message = f"field {name!r} is taken for times of points: {meaning.unit} from {base}"
    ledger.note(WarningKind.ASSUMED, "point-times-assumed", where, message)
    reader = replace(reader, mapping=replace(reader.mapping, times=meaning))
    if not found.first_ns < -_EARLY_NS:
        return reader
    message = f"sweeps begin {-found.first_ns / 1e9:.6f} s before the timestamps of their messages, and are timestamped so"
    ledger.note(WarningKind.ASSUMED, "timestamps-after-start", where, message)
    return replace(reader, starts_ns=read_only(reader.timestamps_ns + found.first_ns))


_EARLY_NS = 1_000_000
"""Points may be this much earlier than the timestamp of their sweep: drivers round."""
