"""The lines of sensors that are numbers only: IMU, GNSS, trajectories."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, finite_rows
from sceneloom.formats.loss import Loss
from sceneloom.formats.recording.kept_texts import SharedLines, completed, rows_of
from sceneloom.formats.recording.line_shapes import ROOT_KEYS
from sceneloom.formats.recording.line_templates import (
    ROW,
    TIME,
    LineTemplate,
    Slot,
    line_template,
)
from sceneloom.formats.recording.merged_lines import LineStream, OneByOne, WrittenLine
from sceneloom.formats.recording.number_sensors import BAROMETER, GPS_ORIGIN, RECEIVER
from sceneloom.formats.recording.number_texts import number_texts, row_texts, written_seconds
from sceneloom.formats.recording.unwritten import main_receiver
from sceneloom.formats.recording.written_times import TimeWriter, writing_order
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Trajectory

AXES: Mapping[str, int] = {"accelerometer": 3, "gyroscope": 3, "magnetometer": 3}
"""Sensors whose samples must have that many values, lest the vendor's software refuses them."""

_encode = msgspec.json.Encoder().encode


def make_line(
    fields: Mapping[str, Any],
    timestamp_ns: int,
    times: TimeWriter,
    file_seconds: float | None = None,
) -> WrittenLine:
    """Put the time to the fields of a line."""
    time = times.text(timestamp_ns, file_seconds)
    line = {**fields, "time": msgspec.Raw(time.encode())}
    return WrittenLine(timestamp_ns, float(time), _encode(line).decode())


@dataclass(frozen=True, slots=True, eq=False)
class NumberStream:
    """Lines that differ in their numbers only.

    Attributes:
        timestamps_ns: (N,) int64 [ns], ascending.
        seconds: (N,) float64 [s], the numbers that stand in the lines.
        file_seconds: (N,) float64 [s], the numbers that the times were read from, or None.
        values: (N, K) float64, finite.
        template: a line with gaps for its numbers.
        further: by row, the text of a line that once stated more than its sample.
        times: writes the times.
        name: of the stream.
    """

    timestamps_ns: Int64Array
    seconds: Float64Array
    file_seconds: Float64Array | None
    values: Float64Array
    template: LineTemplate
    further: Mapping[int, str]
    times: TimeWriter
    name: str = ""

    def lines(self, start: int, stop: int) -> Iterator[str]:
        """Make the lines of some rows."""
        span = slice(start, stop)
        file_seconds = None if self.file_seconds is None else self.file_seconds[span]
        seconds = self.times.texts(self.timestamps_ns[span], file_seconds)
        if ROW in self.template.slots:
            texts = {ROW: row_texts(self.values[span]), TIME: seconds}
        else:
            width, numbers = self.values.shape[1], number_texts(self.values[span].ravel())
            texts = {**{k: numbers[k::width] for k in range(width)}, TIME: seconds}
        rows = zip(*(texts[slot] for slot in self.template.slots), strict=True)
        lines = [self.template.text % row for row in rows]
        for row in self.further.keys() & set(range(start, stop)) if self.further else ():
            lines[row - start] = completed(lines[row - start], self.further[row])
        return iter(lines)


class NumberLines:
    """Makes the lines of streams of numbers.

    Attributes:
        losses: what could not be written.
    """

    def __init__(
        self,
        times: TimeWriter,
        further_keys: Mapping[str, Mapping[str, str]],
        *,
        shared: SharedLines | None = None,
        sensor_barometer: bool = False,
    ) -> None:
        """Begin.

        Args:
            times: writes the times.
            further_keys: by stream and key of a row, the text of a line that once stated more than its sample.
            shared: takes the rows that are written in one line with others.
            sensor_barometer: whether the air pressure goes into `sensor` lines.
        """
        self.losses: list[Loss] = []
        self._times = times
        self._further_keys = further_keys
        self._shared = shared or SharedLines((), {})
        self._sensor_barometer = sensor_barometer

    def imu(self, sensor: ImuSensor) -> list[LineStream]:
        """One stream of lines per stream of the IMU."""
        streams: list[LineStream] = []
        for name, samples in sensor.streams.items():
            location = f"sensors[{sensor.id}].streams[{name}]"
            width = samples.values.shape[1]
            if width != AXES.get(name, width):
                what = f"left out: {width} values a sample; the format's {name} has {AXES[name]}"
                self._lose(location, what, len(samples))
                continue
            usable = finite_rows(samples.values)
            self._lose(location, "left out: a value is not finite", int((~usable).sum()))
            fields = self._sample_fields(name, width)
            streams.append(self._stream(f"imu.{name}", samples, samples.values, usable, fields))
        return streams

    def _sample_fields(self, name: str, width: int) -> dict[str, Any]:
        """The air pressure has lines of its own, unless it was read from others."""
        if name == BAROMETER and width == 1 and not self._sensor_barometer:
            return {BAROMETER: {"pressureHectopascals": Slot(0)}}
        return {"sensor": {"type": name.removeprefix("sensor:"), "values": Slot(ROW)}}

    def gnss(self, sensor: GnssSensor, origin: tuple[str, str] = ("gps", "gps")) -> LineStream:
        """The fixes of a satellite receiver.

        Args:
            sensor: what to write.
            origin: root key and name of its lines.
        """
        usable = finite_rows(sensor.positions_lla)
        what = "left out: latitude, longitude or altitude is missing, and a fix needs all three"
        self._lose(f"sensors[{sensor.id}]", what, int((~usable).sum()))
        order = writing_order(sensor.timestamps_ns, sensor.file_seconds)
        rows = order[usable[order]]
        name = receiver_stream(sensor)
        timestamps = sensor.timestamps_ns[rows]
        texts = self._further_keys.get(name, {})
        further = {row: texts[key] for key, row in rows_of(texts, timestamps).items()}
        lines = (
            _and_further(self._fix(sensor, row, origin), further.get(location))
            for location, row in enumerate(rows.tolist())
        )
        taken = self._shared.rows(name, timestamps)
        if not taken:
            return OneByOne(timestamps, lines, name)
        made = list(lines)
        for row, location in taken.items():
            self._shared.give(location, made[row].text)
        kept = [row for row in range(len(made)) if row not in taken]
        return OneByOne(timestamps[kept], (made[row] for row in kept), name)

    def _fix(self, sensor: GnssSensor, row: int, origin: tuple[str, str]) -> WrittenLine:
        root, name = origin
        latitude, longitude, altitude = sensor.positions_lla[row].tolist()
        fix: dict[str, Any] = {"name": name} if root == "pose" and name != "pose" else {}
        fix |= {"latitude": latitude, "longitude": longitude, "altitude": altitude}
        fix |= _given("accuracy", sensor.accuracies[row])
        fix |= _given("verticalAccuracy", sensor.vertical_accuracies[row])
        seconds = None if sensor.file_seconds is None else float(sensor.file_seconds[row])
        timestamp_ns = int(sensor.timestamps_ns[row])
        return make_line({root: fix}, timestamp_ns, self._times, seconds)

    def trajectory(self, trajectory: Trajectory, origin: tuple[str, str] | None) -> LineStream:
        """The poses of a trajectory.

        Args:
            trajectory: what to write.
            origin: root key and name under which it was read, or None.
        """
        root, name = origin or origin_for(trajectory.name)
        values = trajectory.positions
        pose: dict[str, Any] = {"position": {axis: Slot(k) for k, axis in enumerate("xyz")}}
        if trajectory.quaternions_xyzw is not None:
            values = np.column_stack([values, trajectory.quaternions_xyzw])
            pose["orientation"] = {axis: Slot(3 + k) for k, axis in enumerate("xyzw")}
        if root == "pose" and name != "pose":
            pose = {"name": name, **pose}
        if root == "gnssEnu" and trajectory.quaternions_xyzw is None:
            pose = {"mean": [Slot(k) for k in range(3)]}
        every = np.ones(len(values), np.bool_)
        fields = {root: pose} if root else pose
        return self._stream(f"trajectories.{trajectory.name}", trajectory, values, every, fields)

    def _stream(
        self,
        name: str,
        samples: VectorSamples | Trajectory,
        values: Float64Array,
        usable: BoolArray,
        fields: Mapping[str, Any],
    ) -> LineStream:
        order = writing_order(samples.timestamps_ns, samples.file_seconds)
        rows = order[usable[order]]
        template = line_template({**fields, "time": Slot(TIME)})
        whole = self._rows(name, samples, values, rows, template)
        taken = self._shared.rows(name, whole.timestamps_ns)
        if not taken:
            return whole
        for row, location in taken.items():
            self._shared.give(location, next(whole.lines(row, row + 1)))
        kept = np.setdiff1d(np.arange(len(rows)), list(taken))
        locations = {row: location for location, row in enumerate(kept.tolist())}
        further = {locations[row]: text for row, text in whole.further.items() if row in locations}
        return replace(self._rows(name, samples, values, rows[kept], template), further=further)

    def _rows(
        self,
        name: str,
        samples: VectorSamples | Trajectory,
        values: Float64Array,
        rows: Int64Array,
        template: LineTemplate,
    ) -> NumberStream:
        timestamps = samples.timestamps_ns[rows]
        seconds = None if samples.file_seconds is None else samples.file_seconds[rows]
        texts = self._further_keys.get(name, {})
        further = {row: texts[key] for key, row in rows_of(texts, timestamps).items()}
        written = written_seconds(timestamps, seconds)
        return NumberStream(timestamps, written, seconds, values[rows], template, further, self._times, name)

    def _lose(self, field: str, what: str, count: int) -> None:
        if count:
            self.losses.append(Loss(field=field, what=what, count=count))


def receiver_stream(sensor: GnssSensor) -> str:
    """The name under which more is kept of a receiver's lines."""
    return RECEIVER if sensor.id == RECEIVER else f"{RECEIVER}.{sensor.id}"


def receiver_origin(
    sensor: GnssSensor, origins: Mapping[str, tuple[str, str]], receivers: Sequence[GnssSensor]
) -> tuple[str, str]:
    """Root key and name of a receiver's lines: those that it was read under, `gps` for the first one, else its id."""
    name = str(sensor.id)
    if name in origins:
        return origins[name]
    if sensor in main_receiver([other for other in receivers if str(other.id) not in origins]):
        return GPS_ORIGIN
    return ("pose", name) if name in ROOT_KEYS - {"groundTruth"} else (name, name)


def _and_further(line: WrittenLine, before: str | None) -> WrittenLine:
    return line if before is None else line._replace(text=completed(line.text, before))


def _given(name: str, value: float) -> dict[str, float]:
    return {name: float(value)} if np.isfinite(value) else {}


def origin_for(name: str) -> tuple[str, str]:
    """A root key of its own; where the format has another meaning for that key, a `pose` that bears the name."""
    return ("pose", name) if name in ROOT_KEYS - {"groundTruth"} or not name else (name, name)
