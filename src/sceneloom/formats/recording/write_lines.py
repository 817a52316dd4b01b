"""The lines of a recording in the order of their times: IMU, GNSS, trajectories and lines kept as text."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, finite_rows
from sceneloom.formats.base.losses import Loss
from sceneloom.formats.base.text_tables import TimeWriter
from sceneloom.formats.recording.lines import GPS_ORIGIN, ROOT_KEYS, Origin
from sceneloom.formats.recording.reader import BAROMETER, RECEIVER
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Trajectory

_BLOCK = 2048  # lines that are in memory together

_AXES: Mapping[str, int] = {"accelerometer": 3, "gyroscope": 3, "magnetometer": 3}
"""Sensors whose samples must have that many values, lest the vendor's software refuses them."""

_encode = msgspec.json.Encoder().encode
_decode = msgspec.json.Decoder(dict[str, Any]).decode
_decode_raw = msgspec.json.Decoder(dict[str, msgspec.Raw]).decode


class LineStream(NamedTuple):
    """Lines in the order of their times, (N,) int64 [ns]; each is made when it is asked for."""

    timestamps_ns: Int64Array
    texts: Iterator[str]


def merged_lines(streams: Sequence[LineStream]) -> Iterator[list[str]]:
    """Give the lines of all streams by time, those of one time in the order of the streams, block after block."""
    timestamps = np.concatenate([stream.timestamps_ns for stream in streams] or [np.zeros(0, np.int64)])
    ranks = np.repeat(np.arange(len(streams)), [len(stream.timestamps_ns) for stream in streams])
    ranks = ranks[np.argsort(timestamps, kind="stable")]
    for start in range(0, len(ranks), _BLOCK):
        yield [next(streams[rank].texts) for rank in ranks[start : start + _BLOCK].tolist()]


def make_line(
    fields: Mapping[str, Any],
    timestamp_ns: int,
    times: TimeWriter,
    file_seconds: float | None = None,
    before: str | None = None,
) -> str:
    """Put the time to the fields of a line.

    Args:
        file_seconds: the number that the time was read from [s].
        before: the line that the fields were read from, whose unknown keys are kept.
    """
    line = {**fields, "time": times.raw(timestamp_ns, file_seconds)}
    text = _encode(line).decode()
    return text if before is None else _completed(text, before)


def _completed(text: str, before: str) -> str:
    """A line as it is made from its sample, with what else it once stated."""

    def over(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
        pairs = {
            k: over(old[k], v) if isinstance(v, dict) and isinstance(old.get(k), dict) else v for k, v in new.items()
        }
        return {**old, **pairs}

    # the time may have more decimals than a 64-bit number
    return _encode({**over(_decode(before), _decode(text)), "time": _decode_raw(text)["time"]}).decode()


def rows_of(texts: Mapping[str, str], timestamps_ns: Int64Array) -> dict[int, str]:
    """Find the rows that keys name: `TIME` [ns], or `TIME#1` for the second of that time; some may be gone.

    Args:
        texts: by key.
        timestamps_ns: (N,) int64 [ns], ascending.
    """
    found = {}
    for key, text in texts.items():
        timestamp, _, count = key.partition("#")
        if not (timestamp.removeprefix("-").isdecimal() and (count or "0").isdecimal()):
            continue
        row = int(np.searchsorted(timestamps_ns, int(timestamp))) + int(count or 0)
        if row < len(timestamps_ns) and timestamps_ns[row] == int(timestamp):
            found[row] = text
    return found


_TIME, _ROW = -1, -2  # slots of the time, and of all numbers of a row with commas between them


class _Slot(NamedTuple):
    """Where a number of a line goes: which one of a row, or `_TIME`, or `_ROW`."""

    source: int


def _template(value: object, slots: list[int]) -> str:
    """JSON text with `%s` for each slot in it; the slots are added to `slots`."""
    if isinstance(value, _Slot):
        slots.append(value.source)
        return "[%s]" if value.source == _ROW else "%s"
    if isinstance(value, dict):
        parts = [f"{_template(key, slots)}:{_template(part, slots)}" for key, part in value.items()]
        return "{" + ",".join(parts) + "}"
    if isinstance(value, list):
        return "[" + ",".join(_template(part, slots) for part in value) + "]"
    return _encode(value).decode().replace("%", "%%")


class NumberLines:
    """Makes the lines of streams of numbers.

    Attributes:
        losses: what could not be written.
    """

    def __init__(
        self, times: TimeWriter, further_keys: Mapping[str, Mapping[str, str]], *, sensor_barometer: bool = False
    ) -> None:
        """Begin.

        Args:
            times: writes the times.
            further_keys: by stream and key of a row, the text of a line that once stated more than its sample.
            sensor_barometer: whether the air pressure goes into `sensor` lines.
        """
        self.losses: list[Loss] = []
        self._times, self._further_keys, self._sensor_barometer = times, further_keys, sensor_barometer

    def imu(self, sensor: ImuSensor) -> list[LineStream]:
        """One stream of lines per stream of the IMU."""
        streams: list[LineStream] = []
        for name, samples in sensor.streams.items():
            location = f"sensors[{sensor.id}].streams[{name}]"
            width = samples.values.shape[1]
            if width != _AXES.get(name, width):
                what = f"left out: {width} values a sample; the format's {name} has {_AXES[name]}"
                self._lose(location, what, len(samples))
                continue
            usable = finite_rows(samples.values)
            self._lose(location, "left out: a value is not finite", int((~usable).sum()))
            fields: dict[str, Any] = {"sensor": {"type": name.removeprefix("sensor:"), "values": _Slot(_ROW)}}
            if name == BAROMETER and width == 1 and not self._sensor_barometer:
                fields = {BAROMETER: {"pressureHectopascals": _Slot(0)}}
            streams.append(self._stream(f"imu.{name}", samples, samples.values, usable, fields))
        return streams

    def gnss(self, sensor: GnssSensor, origin: Origin = GPS_ORIGIN) -> LineStream:
        """The fixes of a satellite receiver, under the root key and name of its lines."""
        usable = finite_rows(sensor.positions_lla)
        what = "left out: latitude, longitude or altitude is missing, and a fix needs all three"
        self._lose(f"sensors[{sensor.id}]", what, int((~usable).sum()))
        order = np.argsort(sensor.timestamps_ns, kind="stable")
        rows = order[usable[order]]
        name, timestamps = RECEIVER if sensor.id == RECEIVER else f"{RECEIVER}.{sensor.id}", sensor.timestamps_ns[rows]
        further = rows_of(self._further_keys.get(name, {}), timestamps)

        def texts() -> Iterator[str]:
            for k, row in enumerate(rows.tolist()):
                latitude, longitude, altitude = sensor.positions_lla[row].tolist()
                fix: dict[str, Any] = _name_field(origin)
                fix |= {"latitude": latitude, "longitude": longitude, "altitude": altitude}
                accuracies = {"accuracy": sensor.accuracies[row], "verticalAccuracy": sensor.vertical_accuracies[row]}
                fix |= {key: float(value) for key, value in accuracies.items() if np.isfinite(value)}
                seconds = None if sensor.file_seconds is None else float(sensor.file_seconds[row])
                yield make_line({origin[0]: fix}, int(timestamps[k]), self._times, seconds, further.get(k))

        return LineStream(timestamps, texts())

    def trajectory(self, trajectory: Trajectory, origin: Origin | None) -> LineStream:
        """The poses of a trajectory, under the root key and name that it was read with, or new ones."""
        root, name = origin or origin_for(trajectory.name)
        values = trajectory.positions
        pose: dict[str, Any] = {"position": {axis: _Slot(k) for k, axis in enumerate("xyz")}}
        if trajectory.quaternions_xyzw is not None:
            values = np.column_stack([values, trajectory.quaternions_xyzw])
            pose["orientation"] = {axis: _Slot(3 + k) for k, axis in enumerate("xyzw")}
        pose = _name_field((root, name)) | pose
        if root == "gnssEnu" and trajectory.quaternions_xyzw is None:
            pose = {"mean": [_Slot(k) for k in range(3)]}
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
        """Lines that differ in their numbers only; `values` are (N, K)."""
        order = np.argsort(samples.timestamps_ns, kind="stable")
        rows = order[usable[order]]
        timestamps, values = samples.timestamps_ns[rows], values[rows]
        file_seconds = None if samples.file_seconds is None else samples.file_seconds[rows]
        further = rows_of(self._further_keys.get(name, {}), timestamps)
        slots: list[int] = []
        template = _template({**fields, "time": _Slot(_TIME)}, slots)

        def texts() -> Iterator[str]:
            for start in range(0, len(rows), _BLOCK):
                span = slice(start, start + _BLOCK)
                columns: dict[int, Sequence[str]] = {
                    _TIME: self._times.texts(timestamps[span], None if file_seconds is None else file_seconds[span])
                }
                if _ROW in slots:
                    columns[_ROW] = row_texts(values[span])
                else:
                    width = values.shape[1]
                    numbers = msgspec.json.encode(values[span].ravel().tolist()).decode()[1:-1].split(",")
                    columns |= {k: numbers[k::width] for k in range(width)}
                numbered = enumerate(zip(*(columns[slot] for slot in slots), strict=True), start)
                for row, numbers_of_row in numbered:
                    line = template % numbers_of_row
                    yield _completed(line, further[row]) if row in further else line

        return LineStream(timestamps, texts())

    def _lose(self, field: str, what: str, count: int) -> None:
        if count:
            self.losses.append(Loss(field=field, what=what, count=count))


def _name_field(origin: Origin) -> dict[str, Any]:
    """The name of a method that a `pose` line bears."""
    root, name = origin
    return {"name": name} if root == "pose" and name != "pose" else {}


def origin_for(name: str) -> Origin:
    """A root key of its own; where the format has another meaning for that key, a `pose` that bears the name."""
    return ("pose", name) if name in ROOT_KEYS - {"groundTruth"} or not name else (name, name)


def row_texts(rows: Float64Array) -> list[str]:
    """Write rows of finite numbers, (N, K) float64, each as its numbers with commas between them."""
    return msgspec.json.encode(rows.tolist()).decode()[2:-2].split("],[") if len(rows) else []
