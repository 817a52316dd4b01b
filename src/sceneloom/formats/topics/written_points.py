"""Sweeps, cycles and maps as clouds of messages."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.formats.topics.dialect import Losses
from sceneloom.formats.topics.kept_points import kept_record
from sceneloom.formats.topics.packed_points import pack
from sceneloom.formats.topics.records import CloudRecord
from sceneloom.formats.topics.streams import Stated
from sceneloom.formats.topics.sweeps import (
    DIRECTION_COLUMNS,
    OLD_TIME_COLUMN,
    SPEED_COLUMNS,
    TIME_COLUMNS,
)
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor, grey_where_unseen

Columns = dict[tuple[str, ...], AnyArray]
"""Columns on their trajectory into a message, (N,), or (N, k) by their k names."""

_HELD = frozenset(["u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8"])
_MOST_NS = 2**32 - 1


@dataclass(slots=True)
class CloudWriter:
    """Makes the records of a sensor of points; counts what has no location in them.

    Attributes:
        topic: of the messages.
        frame_id: of the points.
        field: what the model calls the sensor's frames, for losses.
        losses: takes what is lost.
        intensity: dtype of intensities.
    """

    topic: str
    frame_id: str
    field: str
    losses: Losses
    intensity: str = "u1"

    def lidar(self, sensor: LidarSensor, k: int) -> Iterator[Stated]:
        """Make the record of sweep `k`."""
        frame = sensor.frames[k]
        points = frame.points
        kept = kept_record(points, frame.timestamp_ns)
        if kept is not None and self._is_as_written(kept):
            self._note_frame(frame.extras)
            yield self.topic, replace(kept, frame_id=self.frame_id)
            return
        columns = _positions(points.positions)
        if points.intensities is not None:
            columns["intensity",] = points.intensities.astype(self.intensity, copy=False)
        if points.rings is not None:
            columns["ring",] = points.rings
        if points.timestamps_ns is not None:
            columns |= _offsets(points.timestamps_ns, frame.timestamp_ns)
        if points.colors is not None:
            columns |= _colours(grey_where_unseen(points.colors, points.camera_index))
        if points.camera_index is not None:
            columns["camera_index",] = points.camera_index
        self._add_extras(columns, points.extras)
        self._note_frame(frame.extras)
        yield self.topic, self._record(columns, len(points), frame.timestamp_ns)

    def radar(self, sensor: RadarSensor, k: int) -> Iterator[Stated]:
        """Make the record of cycle `k`."""
        frame = sensor.frames[k]
        points = frame.points
        columns = _positions(points.positions)
        if points.directions is not None:
            columns[DIRECTION_COLUMNS] = points.directions
        if points.lengths is not None:
            columns[SPEED_COLUMNS[0],] = points.lengths
        if points.timestamps_ns is not None:
            columns |= _offsets(points.timestamps_ns, frame.timestamp_ns)
        self._add_extras(columns, points.extras)
        self._note_frame(frame.extras)
        yield self.topic, self._record(columns, len(points), frame.timestamp_ns)

    def map(self, sensor: PointsSensor, timestamp_ns: int) -> Iterator[Stated]:
        """Make the only record of a map."""
        columns = _positions(sensor.positions)
        if sensor.colors is not None:
            columns |= _colours(sensor.colors)
        yield self.topic, self._record(columns, len(sensor.positions), timestamp_ns)

    def _is_as_written(self, record: CloudRecord) -> bool:
        """Whether a message of ours has the types that this one would have."""
        dtypes = {field.name: field.dtype.str[1:] for field in record.fields}
        return dtypes.get("intensity", self.intensity) == self.intensity and OLD_TIME_COLUMN not in dtypes

    def _record(self, columns: Columns, count: int, timestamp_ns: int) -> CloudRecord:
        packed = pack(columns, count)
        return CloudRecord(
            timestamp_ns, self.frame_id, packed.fields, packed.stride, packed.data, packed.count
        )

    def _add_extras(self, columns: Columns, extras: Mapping[str, AnyArray]) -> None:
        taken = {name for names in columns for name in names}
        for name, column in extras.items():
            location = f"{self.field}.points.extras.{name}"
            stated = (name.lower(), column.dtype.str[1:])
            if (
                column.ndim != 1
                or name in taken
                or name.lower() in _TAKEN
                or stated in TIME_COLUMNS
                or name.startswith("_")
            ):
                self.losses.dropped(
                    location, "not one number for each point, or of a name that means something else"
                )
            elif column.dtype.str[1:] in _HELD:
                columns[name,] = column
            elif column.dtype.kind in "iufb":
                self._add_converted(columns, name, column, location)
            else:
                self.losses.dropped(location, f"values of type {column.dtype}")

    def _add_converted(self, columns: Columns, name: str, column: AnyArray, location: str) -> None:
        numbers = column.astype(np.uint8 if column.dtype.kind == "b" else np.float64)
        error = float(np.abs(column.astype(np.longdouble) - numbers.astype(np.longdouble)).max(initial=0))
        what = f"values of type {column.dtype} written as {numbers.dtype}"
        (self.losses.approximated if error else self.losses.converted)(location, what, error=error)
        columns[name,] = numbers

    def _note_frame(self, extras: Mapping[str, object]) -> None:
        self.losses.dropped(f"{self.field}.extras", "further fields of a sweep", count=bool(extras))


_TAKEN = frozenset(
    {
        "x",
        "y",
        "z",
        "positions",
        "intensity",
        "ring",
        "red",
        "green",
        "blue",
        "rgb",
        "colors",
        OLD_TIME_COLUMN,
    }
)


def _positions(positions: AnyArray) -> Columns:
    return {("x", "y", "z"): positions}


def _colours(colors: AnyArray) -> Columns:
    """Colours as viewers know them, which ask for an alpha value beside the three."""
    return {("red", "green", "blue"): colors, ("alpha",): np.full(len(colors), 255, np.uint8)}


def _offsets(timestamps_ns: AnyArray, timestamp_ns: int) -> Columns:
    """Times of points from their sweep's timestamp, in the names and units that other programs look for.

    `t` in whole nanoseconds; `time` in seconds where some are earlier than the timestamp or later than 32 bits report,
    exact to the nanosecond over 52 days.
    """
    span_ns = (
        (int(timestamps_ns.min()), int(timestamps_ns.max()))
        if len(timestamps_ns)
        else (timestamp_ns, timestamp_ns)
    )
    if span_ns[0] < timestamp_ns or span_ns[1] > timestamp_ns + _MOST_NS:
        return {("time",): (timestamps_ns - timestamp_ns).astype(np.float64) / 1e9}
    offsets = np.empty(len(timestamps_ns), np.uint32)
    np.subtract(timestamps_ns, timestamp_ns, out=offsets, casting="unsafe")
    return {("t",): offsets}
