"""The lines of sensors that are numbers only: IMU, GNSS, trajectories; and lines that are kept as they were."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.formats.loss import Loss
from sceneloom.formats.recording.json_faults import DECODER_FAULTS
from sceneloom.formats.recording.line_shapes import ROOT_KEYS
from sceneloom.formats.recording.written_times import TimeWriter, writing_order
from sceneloom.scene import GnssSensor, ImuSensor, Trajectory, VectorSamples

AXES: Mapping[str, int] = {"accelerometer": 3, "gyroscope": 3, "magnetometer": 3}
"""Sensors whose samples must have that many values, lest the vendor's software refuses them."""

_BEFORE_ALL = -(2**63)

_encode = msgspec.json.Encoder().encode


class WrittenLine(NamedTuple):
    """A line, and by what it is put among the others."""

    timestamp_ns: int
    seconds: float
    text: bytes


def make_line(
    fields: Mapping[str, Any], timestamp_ns: int, times: TimeWriter, file_seconds: float | None = None
) -> WrittenLine:
    """Put the time to the fields of a line."""
    text = times.text(timestamp_ns, file_seconds)
    return WrittenLine(timestamp_ns, float(text), _encode({**fields, "time": msgspec.Raw(text.encode())}))


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

    def imu(self, sensor: ImuSensor) -> list[Iterator[WrittenLine]]:
        """One stream of lines per stream of the IMU."""
        streams = []
        for name, samples in sensor.streams.items():
            width = samples.values.shape[1]
            if width != AXES.get(name, width):
                what = f"left out: {width} values a sample; the format's {name} has {AXES[name]}"
                self._lose(f"sensors[{sensor.id}].streams[{name}]", what, len(samples))
                continue
            streams.append(self._samples(name, samples, f"sensors[{sensor.id}].streams[{name}]"))
        return streams

    def gnss(self, sensor: GnssSensor) -> Iterator[WrittenLine]:
        """The fixes of a satellite receiver."""
        usable = _finite_rows(sensor.positions_lla)
        what = "left out: latitude, longitude or altitude is missing, and a fix needs all three"
        self._lose(f"sensors[{sensor.id}]", what, int((~usable).sum()))
        for row in writing_order(sensor.timestamps_ns, sensor.file_seconds):
            if usable[row]:
                latitude, longitude, altitude = sensor.positions_lla[row].tolist()
                fix = {"latitude": latitude, "longitude": longitude, "altitude": altitude}
                fix |= _given("accuracy", sensor.accuracies[row])
                fix |= _given("verticalAccuracy", sensor.vertical_accuracies[row])
                yield self._line("gnss", {"gps": fix}, sensor, row)

    def trajectory(self, trajectory: Trajectory, origin: tuple[str, str] | None) -> Iterator[WrittenLine]:
        """The poses of a trajectory.

        Args:
            trajectory: what to write.
            origin: root key and name under which it was read, or None.
        """
        root, name = origin or _origin_for(trajectory.name)
        for row in range(len(trajectory.timestamps_ns)):
            pose: dict[str, Any] = {
                "position": dict(zip("xyz", trajectory.positions[row].tolist(), strict=True))
            }
            if trajectory.quaternions_xyzw is not None:
                quaternion = trajectory.quaternions_xyzw[row].tolist()
                pose["orientation"] = dict(zip("xyzw", quaternion, strict=True))
            if root == "pose" and name != "pose":
                pose = {"name": name, **pose}
            fields = {root: pose} if root else pose
            yield self._line(f"trajectories.{trajectory.name}", fields, trajectory, row)

    def _samples(self, name: str, samples: VectorSamples, place: str) -> Iterator[WrittenLine]:
        usable = _finite_rows(samples.values)
        self._lose(place, "left out: a value is not finite", int((~usable).sum()))
        for row in writing_order(samples.timestamps_ns, samples.file_seconds):
            if usable[row]:
                sample = {"type": name, "values": samples.values[row].tolist()}
                yield self._line(f"imu.{name}", {"sensor": sample}, samples, row)

    def _line(
        self, stream: str, fields: dict[str, Any], samples: VectorSamples | GnssSensor | Trajectory, row: int
    ) -> WrittenLine:
        timestamp_ns = int(samples.timestamps_ns[row])
        further = self._further_keys.get(stream, {}).get(str(timestamp_ns))
        if further is not None:
            fields = with_further_keys(fields, further)
        seconds = None if samples.file_seconds is None else float(samples.file_seconds[row])
        return make_line(fields, timestamp_ns, self._times, seconds)

    def _lose(self, field: str, what: str, count: int) -> None:
        if count:
            self.losses.append(Loss(field=field, what=what, count=count))


def other_lines(texts: list[str]) -> list[WrittenLine]:
    """Lines that hold nothing that a scene has a place for, as they were; those without a time come first."""
    lines = []
    for text in texts:
        seconds = _time_of(text)
        stamp = _BEFORE_ALL if seconds is None else round(seconds * 1e9)
        lines.append(WrittenLine(stamp, seconds or 0.0, text.strip().encode()))
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
