"""The lines of sensors that are numbers only: IMU, GNSS, trajectories; and lines that are kept as they were."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.formats.loss import Loss
from sceneloom.formats.recording.json_faults import DECODER_FAULTS
from sceneloom.formats.recording.line_shapes import ROOT_KEYS
from sceneloom.formats.recording.merged_lines import LineStream, OneByOne, WrittenLine
from sceneloom.formats.recording.number_texts import number_texts, row_texts, written_seconds
from sceneloom.formats.recording.written_times import TimeWriter, writing_order
from sceneloom.scene import GnssSensor, ImuSensor, Trajectory, VectorSamples

AXES: Mapping[str, int] = {"accelerometer": 3, "gyroscope": 3, "magnetometer": 3}
"""Sensors whose samples must have that many values, lest the vendor's software refuses them."""

_BEFORE_ALL = -(2**63)

_encode = msgspec.json.Encoder().encode
_decode_raw = msgspec.json.Decoder(dict[str, msgspec.Raw]).decode


def make_line(
    fields: Mapping[str, Any], timestamp_ns: int, times: TimeWriter, file_seconds: float | None = None
) -> WrittenLine:
    """Put the time to the fields of a line."""
    time = times.text(timestamp_ns, file_seconds)
    text = _encode({**fields, "time": msgspec.Raw(time.encode())}).decode()
    return WrittenLine(timestamp_ns, float(time), text)


@dataclass(frozen=True, slots=True, eq=False)
class NumberStream:
    """Lines that differ in their numbers only.

    Attributes:
        timestamps_ns: (N,) int64 [ns], ascending.
        seconds: (N,) float64 [s], the numbers that stand in the lines.
        file_seconds: (N,) float64 [s], the numbers that the times were read from, or None.
        values: (N, K) float64, finite.
        template: a line, with `%s` for each value, or one for all of a row with commas between them, and for the time.
        joined: whether all of a row stand together.
        further: by row, the text of a line that once said more than its sample.
        times: writes the times.
    """

    timestamps_ns: Int64Array
    seconds: Float64Array
    file_seconds: Float64Array | None
    values: Float64Array
    template: str
    joined: bool
    further: Mapping[int, str]
    times: TimeWriter

    def lines(self, start: int, stop: int) -> Iterator[str]:
        """Make the lines of some rows."""
        span = slice(start, stop)
        file_seconds = None if self.file_seconds is None else self.file_seconds[span]
        seconds = self.times.texts(self.timestamps_ns[span], file_seconds)
        if self.joined:
            rows = row_texts(self.values[span])
            lines = [self.template % pair for pair in zip(rows, seconds, strict=True)]
        else:
            numbers = iter(number_texts(self.values[span].ravel()))
            columns = [numbers] * self.values.shape[1]
            lines = [self.template % row for row in zip(*columns, seconds, strict=True)]
        for row in self.further.keys() & set(range(start, stop)) if self.further else ():
            lines[row - start] = _completed(lines[row - start], self.further[row])
        return iter(lines)


def _completed(text: str, before: str) -> str:
    """A line with what else it once said."""
    fields: dict[str, msgspec.Raw] = _decode_raw(text)
    time = fields.pop("time")
    own = {key: msgspec.json.decode(value) for key, value in fields.items()}
    return _encode({**with_further_keys(own, before), "time": time}).decode()


class NumberLines:
    """Makes the lines of streams of numbers.

    Attributes:
        losses: what could not be written.
    """

    def __init__(self, times: TimeWriter, further_keys: Mapping[str, Mapping[str, str]]) -> None:
        """Begin.

        Args:
            times: writes the times.
            further_keys: by stream and time [ns], the text of a line that once said more than its sample.
        """
        self.losses: list[Loss] = []
        self._times = times
        self._further_keys = further_keys

    def imu(self, sensor: ImuSensor) -> list[LineStream]:
        """One stream of lines per stream of the IMU."""
        streams: list[LineStream] = []
        for name, samples in sensor.streams.items():
            place = f"sensors[{sensor.id}].streams[{name}]"
            width = samples.values.shape[1]
            if width != AXES.get(name, width):
                what = f"left out: {width} values a sample; the format's {name} has {AXES[name]}"
                self._lose(place, what, len(samples))
                continue
            usable = _finite_rows(samples.values)
            self._lose(place, "left out: a value is not finite", int((~usable).sum()))
            template = f'{{"sensor":{{"type":{_quoted(name)},"values":[%s]}},"time":%s}}'
            streams.append(
                self._stream(f"imu.{name}", samples, samples.values, usable, template, joined=True)
            )
        return streams

    def gnss(self, sensor: GnssSensor) -> LineStream:
        """The fixes of a satellite receiver."""
        usable = _finite_rows(sensor.positions_lla)
        what = "left out: latitude, longitude or altitude is missing, and a fix needs all three"
        self._lose(f"sensors[{sensor.id}]", what, int((~usable).sum()))
        order = writing_order(sensor.timestamps_ns, sensor.file_seconds)
        rows = order[usable[order]]
        return OneByOne(sensor.timestamps_ns[rows], (self._fix(sensor, row) for row in rows.tolist()))

    def _fix(self, sensor: GnssSensor, row: int) -> WrittenLine:
        latitude, longitude, altitude = sensor.positions_lla[row].tolist()
        fix = {"latitude": latitude, "longitude": longitude, "altitude": altitude}
        fix |= _given("accuracy", sensor.accuracies[row])
        fix |= _given("verticalAccuracy", sensor.vertical_accuracies[row])
        fields: dict[str, Any] = {"gps": fix}
        timestamp_ns = int(sensor.timestamps_ns[row])
        further = self._further_keys.get("gnss", {}).get(str(timestamp_ns))
        if further is not None:
            fields = with_further_keys(fields, further)
        seconds = None if sensor.file_seconds is None else float(sensor.file_seconds[row])
        return make_line(fields, timestamp_ns, self._times, seconds)

    def trajectory(self, trajectory: Trajectory, origin: tuple[str, str] | None) -> LineStream:
        """The poses of a trajectory.

        Args:
            trajectory: what to write.
            origin: root key and name under which it was read, or None.
        """
        root, name = origin or _origin_for(trajectory.name)
        values, pose = trajectory.positions, '"position":{"x":%s,"y":%s,"z":%s}'
        if trajectory.quaternions_xyzw is not None:
            values = np.column_stack([values, trajectory.quaternions_xyzw])
            pose += ',"orientation":{"x":%s,"y":%s,"z":%s,"w":%s}'
        if root == "pose" and name != "pose":
            pose = f'"name":{_quoted(name)},{pose}'
        template = f'{{{_quoted(root)}:{{{pose}}},"time":%s}}' if root else f'{{{pose},"time":%s}}'
        every = np.ones(len(values), np.bool_)
        return self._stream(f"trajectories.{trajectory.name}", trajectory, values, every, template)

    def _stream(
        self,
        name: str,
        samples: VectorSamples | Trajectory,
        values: Float64Array,
        usable: BoolArray,
        template: str,
        *,
        joined: bool = False,
    ) -> LineStream:
        order = writing_order(samples.timestamps_ns, samples.file_seconds)
        rows = order[usable[order]]
        stamps = samples.timestamps_ns[rows]
        seconds = None if samples.file_seconds is None else samples.file_seconds[rows]
        texts = self._further_keys.get(name, {})
        further = (
            {k: texts[key] for k, key in enumerate(map(str, stamps.tolist())) if key in texts}
            if texts
            else {}
        )
        written = written_seconds(stamps, seconds)
        return NumberStream(stamps, written, seconds, values[rows], template, joined, further, self._times)

    def _lose(self, field: str, what: str, count: int) -> None:
        if count:
            self.losses.append(Loss(field=field, what=what, count=count))


def other_lines(texts: list[str]) -> list[WrittenLine]:
    """Lines that hold nothing that a scene has a place for, as they were; those without a time come first."""
    lines = []
    for text in texts:
        seconds = _time_of(text)
        stamp = _BEFORE_ALL if seconds is None else round(seconds * 1e9)
        lines.append(WrittenLine(stamp, seconds or 0.0, text.strip()))
    return sorted(lines, key=lambda line: line[:2])


def _time_of(text: str) -> float | None:
    try:
        line = msgspec.json.decode(text)
    except DECODER_FAULTS:
        return None
    seconds = line.get("time") if isinstance(line, dict) else None
    return float(seconds) if isinstance(seconds, int | float) else None


def _finite_rows(values: Float64Array) -> BoolArray:
    return np.asarray(np.isfinite(values).all(axis=1), np.bool_)


def _given(name: str, value: float) -> dict[str, float]:
    return {name: float(value)} if np.isfinite(value) else {}


def _quoted(name: str) -> str:
    """A name as JSON text that can stand in a template."""
    return _encode(name).decode().replace("%", "%%")


def _origin_for(name: str) -> tuple[str, str]:
    """A root key of its own; where the format has another meaning for that key, a `pose` that bears the name."""
    return ("pose", name) if name in ROOT_KEYS - {"groundTruth"} or not name else (name, name)


def with_further_keys(fields: dict[str, Any], text: str) -> dict[str, Any]:
    """Add what the line that a sample was read from said beside it."""
    line = msgspec.json.decode(text)
    own = {*ROOT_KEYS, *fields}
    beside = {key: value for key, value in line.items() if key not in own and not _is_pose(value)}
    before = {key: line[key] for key in fields if isinstance(line.get(key), dict)}
    merged = {key: {**before.get(key, {}), **value} for key, value in fields.items()}
    return {**merged, **beside}


def _is_pose(value: object) -> bool:
    return isinstance(value, dict) and "position" in value
