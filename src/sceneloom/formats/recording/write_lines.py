"""The lines of a recording in the order of their times: IMU, GNSS, trajectories and lines kept as text."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, finite_rows
from sceneloom.formats.base.losses import Loss
from sceneloom.formats.base.text_tables import (
    TimeWriter,
    exact_seconds,
    number_texts,
    written_seconds,
)
from sceneloom.formats.recording.json_faults import DECODER_FAULTS
from sceneloom.formats.recording.lines import RECORD_KEYS, ROOT_KEYS
from sceneloom.formats.recording.reader import BAROMETER, GPS_ORIGIN, RECEIVER
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Trajectory

_TIME, _ROW = -1, -2
"""Slots of the time, and of all numbers of a row with commas between them."""


@dataclass(frozen=True, slots=True)
class _Slot:
    """Where a number goes.

    Attributes:
        source: which number of a row, or `_TIME`, or `_ROW`.
    """

    source: int


@dataclass(frozen=True, slots=True)
class _LineTemplate:
    """A line with gaps.

    Attributes:
        text: with `%s` for each gap.
        slots: what goes into each, in order.
    """

    text: str
    slots: tuple[int, ...]


def _line_template(fields: Mapping[str, Any]) -> _LineTemplate:
    """Make a template of the fields of a line, with slots for its numbers."""
    slots: list[int] = []
    text = _text(fields, slots)
    return _LineTemplate(text, tuple(slots))


def _text(value: object, slots: list[int]) -> str:
    if isinstance(value, _Slot):
        slots.append(value.source)
        return "[%s]" if value.source == _ROW else "%s"
    if isinstance(value, dict):
        return "{" + ",".join(f"{_quoted(key)}:{_text(part, slots)}" for key, part in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ",".join(_text(part, slots) for part in value) + "]"
    return _quoted(value)


def _quoted(value: object) -> str:
    """A constant as JSON text that can stand in a template."""
    return msgspec.json.encode(value).decode().replace("%", "%%")


_BEFORE_ALL_NS = -(2**63)
"""Stands for the time of lines without one that no line with one comes before."""

FRAMES = "frames"
"""Name of the stream of images."""

_BLOCK = 2048
"""Lines that are in memory together, or as many more as have one time."""


class LineStream(Protocol):
    """Lines in the order of their times.

    Attributes:
        timestamps_ns: (N,) int64 [ns], ascending.
        seconds: (N,) float64 [s], the numbers that stand in the lines, or what is known of them.
        name: of the stream.
    """

    @property
    def name(self) -> str:
        """As above."""
        ...

    @property
    def timestamps_ns(self) -> Int64Array:
        """As above."""
        ...

    @property
    def seconds(self) -> Float64Array:
        """As above."""
        ...

    def lines(self, start: int, stop: int) -> Iterator[str]:
        """Make the lines of some rows; called for all rows, in order."""
        ...


class WrittenLine(NamedTuple):
    """A line, and by what it is put among the others."""

    timestamp_ns: int
    seconds: float
    text: str


class OneByOne:
    """A stream of lines that are made one after the other, whose numbers are known then only."""

    def __init__(self, timestamps_ns: Int64Array, lines: Iterable[WrittenLine], name: str = "") -> None:
        """Begin.

        Args:
            timestamps_ns: (N,) int64 [ns], ascending.
            lines: as many, with these times.
            name: of the stream.
        """
        self.name = name
        self.timestamps_ns = timestamps_ns
        self.seconds = exact_seconds(timestamps_ns)
        self._lines = iter(lines)

    def lines(self, start: int, stop: int) -> Iterator[str]:
        """Make lines, and note down the numbers that stand in them."""
        for row in range(start, stop):
            line = next(self._lines)
            self.seconds[row] = line.seconds
            yield line.text


def merged_lines(streams: Sequence[LineStream]) -> Iterator[list[str]]:
    """Give the lines of all streams, which are in the order of lines of one time, block after block."""
    timestamps = np.concatenate([stream.timestamps_ns for stream in streams] or [np.zeros(0, np.int64)])
    known = np.concatenate([stream.seconds for stream in streams] or [np.zeros(0)])
    ranks = np.repeat(np.arange(len(streams)), [len(stream.timestamps_ns) for stream in streams])
    order = np.lexsort((ranks, known, timestamps))
    timestamps, ranks, known = timestamps[order], ranks[order], known[order]
    done = np.zeros(len(streams), np.int64)
    start = 0
    while start < len(timestamps):
        stop = _end_of_block(timestamps, start)
        counts = np.bincount(ranks[start:stop], minlength=len(streams))
        span = slice(start, stop)
        yield _block(streams, done, counts, timestamps[span], ranks[span], known[span])
        done += counts
        start = stop


def _end_of_block(timestamps: Int64Array, start: int) -> int:
    """The end of a block, which parts no lines of one time."""
    last = min(start + _BLOCK, len(timestamps)) - 1
    return int(np.searchsorted(timestamps, timestamps[last], side="right"))


def _block(
    streams: Sequence[LineStream],
    done: Int64Array,
    counts: Int64Array,
    timestamps: Int64Array,
    ranks: Int64Array,
    known: Float64Array,
) -> list[str]:
    spans = [slice(begin, begin + count) for begin, count in zip(done.tolist(), counts.tolist(), strict=True)]
    makers = [stream.lines(span.start, span.stop) for stream, span in zip(streams, spans, strict=True)]
    lines = [next(makers[rank]) for rank in ranks.tolist()]
    reported = np.empty(len(lines))
    for rank, (stream, span) in enumerate(zip(streams, spans, strict=True)):
        reported[ranks == rank] = stream.seconds[span]
    if np.array_equal(reported, known):
        return lines
    return [lines[k] for k in np.lexsort((ranks, reported, timestamps)).tolist()]


_encode = msgspec.json.Encoder().encode
_decode = msgspec.json.Decoder(dict[str, Any]).decode
_decode_raw = msgspec.json.Decoder(dict[str, msgspec.Raw]).decode


def completed(text: str, before: str) -> str:
    """Write a line with what else it once stated.

    Args:
        text: the line as it is made from its sample.
        before: the line that the sample was read from.
    """
    merged = _over(_decode(before), _decode(text))
    # the time may have more decimals than a 64-bit number
    return _encode({**merged, "time": _decode_raw(text)["time"]}).decode()


def _over(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    both = {
        key: _over(old[key], value) if isinstance(value, dict) and isinstance(old.get(key), dict) else value
        for key, value in new.items()
    }
    return {**old, **both}


def rows_of(keys: Iterable[str], timestamps_ns: Int64Array) -> dict[str, int]:
    """Find the rows that keys name (`TIME`, or `TIME#1` for the second of that time); some may be there no longer.

    Args:
        keys: as `Columns.row_keys` makes them.
        timestamps_ns: (N,) int64 [ns], ascending.
    """
    found = {}
    for key in keys:
        timestamp, _, count = key.partition("#")
        if not (timestamp.removeprefix("-").isdecimal() and (count or "0").isdecimal()):
            continue
        row = int(np.searchsorted(timestamps_ns, int(timestamp))) + int(count or 0)
        if row < len(timestamps_ns) and timestamps_ns[row] == int(timestamp):
            found[key] = row
    return found


class SharedText(msgspec.Struct):
    """A line that several streams have a part in.

    Attributes:
        text: the line.
        records: stream and key of each part.
    """

    text: str
    records: list[tuple[str, str]] = []


class SharedLines:
    """Brings the samples of lines that several streams have a part in back into one line.

    A line that reports a sweep or of images is written with these; all others are written here.
    """

    def __init__(self, entries: Sequence[SharedText], hosts: Mapping[str, Int64Array]) -> None:
        """Begin.

        Args:
            entries: the lines.
            hosts: times of sweeps and images that are written, by their streams' names, (N,) int64 [ns], ascending.
        """
        self._texts = [entry.text for entry in entries]
        self._parts: list[list[str]] = [[] for _ in entries]
        self._index: dict[str, dict[str, int]] = {}
        self._hosted: dict[int, str] = {}
        self._of_hosts: dict[str, dict[str, str]] = {}
        for location, entry in enumerate(entries):
            for stream, key in entry.records:
                self._index.setdefault(stream, {})[key] = location
                if stream in hosts and rows_of([key], hosts[stream]):
                    self._hosted[location] = stream
                    self._of_hosts.setdefault(stream, {})[key] = entry.text
            timestamp = _timestamp_of(entry.text)
            images = hosts.get(FRAMES, np.zeros(0, np.int64))
            if timestamp is not None and "frames" in _keys_of(entry.text) and rows_of([str(timestamp)], images):
                self._hosted[location] = FRAMES

    def texts_for(self, stream: str) -> dict[str, str]:
        """Give the lines that are written with the sweeps of a lidar, by their keys."""
        return self._of_hosts.get(stream, {})

    def rows(self, stream: str, timestamps_ns: Int64Array) -> dict[int, int]:
        """Find the rows of a stream, at times (N,) [ns], that have a part in such lines.

        Each with the line's location.
        """
        keys = self._index.get(stream, {})
        return {row: keys[key] for key, row in rows_of(keys, timestamps_ns).items()}

    def give(self, location: int, text: str) -> None:
        """Hand over a part: the line that would be made of it alone."""
        self._parts[location].append(text)

    def lines(self) -> list[WrittenLine]:
        """Give the lines in the order of their times."""
        lines = []
        for location, (text, parts) in enumerate(zip(self._texts, self._parts, strict=True)):
            if parts and location not in self._hosted:
                whole = _without_hosts(text)
                for part in parts:
                    whole = completed(part, whole)
                lines.append(_written_line(whole))
        return sorted(lines, key=lambda line: line[:2])


def _without_hosts(text: str) -> str:
    """A line that no sweep and no image is written with says nothing of any."""
    fields = _decode_raw(text)
    kept = {key: value for key, value in fields.items() if key not in {"frames", "number", "lidar"}}
    return text if len(kept) == len(fields) or not kept.keys() & RECORD_KEYS else _encode(kept).decode()


def timed_lines(texts: Sequence[str]) -> list[WrittenLine]:
    """Lines that hold nothing that a scene has a location for, as they were; those that have a time."""
    lines = [_written_line(text) for text in texts]
    return sorted((line for line in lines if line.timestamp_ns != _BEFORE_ALL_NS), key=lambda line: line[:2])


def untimed_lines(texts: Sequence[str], anchors: Mapping[str, float]) -> list[WrittenLine]:
    """The others, which follow the lines of another time.

    Args:
        texts: all such lines, in the order of the file.
        anchors: by index in `texts`, the time of the line before [s]; lines that have none come first.
    """
    lines = []
    for location, text in enumerate(texts):
        if _written_line(text).timestamp_ns == _BEFORE_ALL_NS:
            seconds = anchors.get(str(location))
            timestamp = (_BEFORE_ALL_NS, 0.0) if seconds is None else (round(seconds * 1e9), seconds)
            lines.append(WrittenLine(*timestamp, text.strip()))
    return sorted(lines, key=lambda line: line[:2])


def _written_line(text: str) -> WrittenLine:
    """A line with its time."""
    found = _seconds_of(text)
    if found is None:
        return WrittenLine(_BEFORE_ALL_NS, 0.0, text.strip())
    return WrittenLine(round(found * 1e9), found, text.strip())


def _timestamp_of(text: str) -> int | None:
    seconds = _seconds_of(text)
    return None if seconds is None else round(seconds * 1e9)


def _keys_of(text: str) -> frozenset[str]:
    try:
        return frozenset(_decode_raw(text))
    except DECODER_FAULTS:
        return frozenset()


def _seconds_of(text: str) -> float | None:
    try:
        line = msgspec.json.decode(text)
    except DECODER_FAULTS:
        return None
    seconds = line.get("time") if isinstance(line, dict) else None
    return float(seconds) if isinstance(seconds, int | float) and abs(seconds) < 9.2e9 else None


_AXES: Mapping[str, int] = {"accelerometer": 3, "gyroscope": 3, "magnetometer": 3}
"""Sensors whose samples must have that many values, lest the vendor's software refuses them."""


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
    template: _LineTemplate
    further: Mapping[int, str]
    times: TimeWriter
    name: str = ""

    def lines(self, start: int, stop: int) -> Iterator[str]:
        """Make the lines of some rows."""
        span = slice(start, stop)
        file_seconds = None if self.file_seconds is None else self.file_seconds[span]
        seconds = self.times.texts(self.timestamps_ns[span], file_seconds)
        if _ROW in self.template.slots:
            texts = {_ROW: row_texts(self.values[span]), _TIME: seconds}
        else:
            width, numbers = self.values.shape[1], number_texts(self.values[span].ravel())
            texts = {**{k: numbers[k::width] for k in range(width)}, _TIME: seconds}
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
            if width != _AXES.get(name, width):
                what = f"left out: {width} values a sample; the format's {name} has {_AXES[name]}"
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
            return {BAROMETER: {"pressureHectopascals": _Slot(0)}}
        return {"sensor": {"type": name.removeprefix("sensor:"), "values": _Slot(_ROW)}}

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
        name = _receiver_stream(sensor)
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
        pose: dict[str, Any] = {"position": {axis: _Slot(k) for k, axis in enumerate("xyz")}}
        if trajectory.quaternions_xyzw is not None:
            values = np.column_stack([values, trajectory.quaternions_xyzw])
            pose["orientation"] = {axis: _Slot(3 + k) for k, axis in enumerate("xyzw")}
        if root == "pose" and name != "pose":
            pose = {"name": name, **pose}
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
        order = writing_order(samples.timestamps_ns, samples.file_seconds)
        rows = order[usable[order]]
        template = _line_template({**fields, "time": _Slot(_TIME)})
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
        template: _LineTemplate,
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


def _receiver_stream(sensor: GnssSensor) -> str:
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


def main_receiver(receivers: Sequence[GnssSensor]) -> list[GnssSensor]:
    """Give the one whose lines are `gps` lines: the one that is called so, else the first that has no other name."""
    others = [sensor for sensor in receivers if sensor.id != "rtkgps"]
    return [sensor for sensor in others if sensor.id == "gnss"][:1] or others[:1]


def row_texts(rows: Float64Array) -> list[str]:
    """Write rows of finite numbers, (N, K) float64, each as its numbers with commas between them."""
    return msgspec.json.encode(rows.tolist()).decode()[2:-2].split("],[") if len(rows) else []


def writing_order(timestamps_ns: Int64Array, file_seconds: Float64Array | None) -> Int64Array:
    """The order in which samples are written: by time, those of one nanosecond by the numbers that they came from.

    Args:
        timestamps_ns: (N,) int64 [ns].
        file_seconds: (N,) float64 [s], the numbers, or None where there are none.

    Returns:
        (N,) int64, row that stands at each location.
    """
    if file_seconds is None:
        return np.argsort(timestamps_ns, kind="stable").astype(np.int64)
    return np.lexsort((file_seconds, timestamps_ns)).astype(np.int64)
