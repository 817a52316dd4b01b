"""Streams of a recording as rules look at them, and rules about their times: order, rates, gaps, overlap.

And the fixes.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, read_only
from sceneloom.checks.faults import as_read
from sceneloom.checks.rule import HINT, WARNING, Find, Hit, Rule, Subject
from sceneloom.formats.recording.lines import Columns, RecordingColumns, is_sorted, line_seconds, time_order
from sceneloom.formats.recording.reader import RECEIVER, imu_streams, receivers
from sceneloom.geometry.rotations import normalise_quaternion
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.time_range import select_rows

_FEWEST_FOR_A_RATE = 4
"""Fewer samples do not report what is usual."""

_SAME_TIME = 0.5e-9
"""Times closer than this [s] are one time: the scene counts nanoseconds."""


class Kind(StrEnum):
    """What a stream is of; a sensor's word is the format's own."""

    CAMERA = "camera"
    LIDAR = "lidar"
    ACCELEROMETER = "accelerometer"
    GYROSCOPE = "gyroscope"
    MAGNETOMETER = "magnetometer"
    BAROMETER = "barometer"
    TEMPERATURE = "imuTemperature"
    GNSS = "gnss"
    POSES = "poses"
    OTHER = "other"

    @classmethod
    def of_sensor(cls, name: str) -> "Kind":
        """The kind of `sensor` lines of a type."""
        return cls(name) if name in _SENSORS else cls.OTHER


_SENSORS = frozenset({"accelerometer", "gyroscope", "magnetometer", "barometer", "imuTemperature"})


@dataclass(frozen=True, eq=False)
class Stream:
    """A stream in the order of its times.

    Attributes:
        name: as messages state it: "accelerometer", "gps", "groundTruth", "camera0", "lidar".
        kind: what it is of.
        file_seconds: (N,) float64 [s], in the order of the file.
        file_values: (N, K) float64 in the order of the file; None for images and sweeps.
        file_lines: (N,) int64, line of each in the order of the file; None where it cannot be reported.
        file: name of the file that it stands in.
    """

    name: str
    kind: Kind
    file_seconds: Float64Array
    file_values: Float64Array | None = None
    file_lines: Int64Array | None = None
    file: str = "data.jsonl"

    def __len__(self) -> int:
        return len(self.file_seconds)

    @cached_property
    def order(self) -> Int64Array:
        """(N,) int64, row of the file's order that each row was."""
        return time_order(self.file_seconds)

    @cached_property
    def seconds(self) -> Float64Array:
        """(N,) float64 [s], ascending."""
        return self.file_seconds if is_sorted(self.file_seconds) else self.file_seconds[self.order]

    @property
    def values(self) -> Float64Array:
        """(N, K) float64, in the order of `seconds`; (N, 0) for images and sweeps."""
        if self.file_values is None:
            return np.zeros((len(self), 0))
        return self.file_values if is_sorted(self.file_seconds) else self.file_values[self.order]

    @cached_property
    def intervals(self) -> Float64Array:
        """(N - 1,) float64 [s], from each time to the next; 0 for one and the same time."""
        steps = np.diff(self.seconds)
        steps[steps < _SAME_TIME] = 0.0
        return steps

    @cached_property
    def period(self) -> float | None:
        """The usual interval [s]; None where the times report none."""
        if len(self) < _FEWEST_FOR_A_RATE:
            return None
        median = float(np.median(self.intervals))
        return median if median > 0 else None

    @property
    def whole(self) -> str:
        """Where findings about all of it are reported."""
        return f"{self.file}: {self.name}"

    def at(self, row: int) -> str:
        """A sample in words; `row` counts in the order of `seconds`."""
        return f"{self.name} at {self.seconds[row]:.6f} s"


def streams_of(subject: Subject) -> tuple[Stream, ...]:
    """All streams of the recording that have samples; none where the subject is no recording."""
    return subject.table("streams of the recording", _make_streams)


def streams_of_kind(subject: Subject, *kinds: Kind) -> Iterator[Stream]:
    """Those of some kinds."""
    return (stream for stream in streams_of(subject) if stream.kind in kinds)


def location(stream: Stream, row: int) -> str:
    """Where a sample stands: its line, if that is known; `row` counts in the order of `seconds`."""
    return _location_in_file(stream, int(stream.order[row]))


def _location_in_file(stream: Stream, row: int) -> str:
    """As `location`; `row` counts in the order of the file."""
    lines = stream.file_lines
    return stream.whole if lines is None else f"{stream.file}: line {lines[row]}"


def _make_streams(subject: Subject) -> tuple[Stream, ...]:
    if subject.recording is None:
        return ()
    columns, file = subject.recording.columns, subject.recording.data_name
    found = (*_frames(columns), *_lidars(columns), *_sensors(columns), *_fixes(columns), *_poses(columns))
    return tuple(replace(stream, file=file) for stream in found if len(stream))


def _frames(columns: RecordingColumns) -> Iterator[Stream]:
    lines = np.asarray(columns.frames.lines, np.int64)
    for index, camera in sorted(columns.frames.cameras.items()):
        there = np.asarray(camera.missing, np.int8) == 0
        rows = np.asarray(camera.rows, np.int64)[there]
        seconds = np.asarray(camera.seconds, np.float64)[there]
        yield Stream(f"camera{index}", Kind.CAMERA, seconds, file_lines=lines[rows])


def _lidars(columns: RecordingColumns) -> Iterator[Stream]:
    for index, lidar in sorted(columns.lidars.items()):
        name = f"lidar{index}" if len(columns.lidars) > 1 else "lidar"
        yield Stream(name, Kind.LIDAR, np.asarray(lidar.seconds), file_lines=np.asarray(lidar.lines, np.int64))


def _sensors(columns: RecordingColumns) -> Iterator[Stream]:
    for name, stream in imu_streams(columns).items():
        yield _of_columns(name, Kind.of_sensor(name), stream)


def _fixes(columns: RecordingColumns) -> Iterator[Stream]:
    for name, (_, stream) in receivers(columns).items():
        yield _of_columns("gps" if name == RECEIVER else name, Kind.GNSS, stream)


def _poses(columns: RecordingColumns) -> Iterator[Stream]:
    for (root, name), poses in columns.poses.items():
        reported = name if name == root or not root else f"{root} {name}"
        yield _of_columns(reported, Kind.POSES, poses)


def _of_columns(name: str, kind: Kind, columns: Columns) -> Stream:
    seconds = np.asarray(columns.seconds, np.float64)
    values = np.asarray(columns.values, np.float64).reshape(len(seconds), columns.width)
    return Stream(name, kind, seconds, values, np.asarray(columns.lines, np.int64))


NORM_TOLERANCE = 1e-3
"""Lengths of quaternions that are off by no more [1] are rounding."""


def without_repetitions(scene: Scene) -> Scene:
    """Leave out samples, fixes and images that state the same as the one before at the same time."""
    sensors = tuple(map(_reported_once, scene.sensors))
    if any(new is not old for new, old in zip(sensors, scene.sensors, strict=True)):
        scene = replace(scene, sensors=sensors)
    return _without_kept_poses(scene)


def _without_kept_poses(scene: Scene) -> Scene:
    """Leave out lines that are kept as text and state a pose once more that a trajectory has."""
    kept = scene.metadata.get("recording")
    texts = kept.get("other_lines") if isinstance(kept, Mapping) else None
    if not isinstance(kept, Mapping) or not isinstance(texts, list):
        return scene
    origins = kept.get("trajectory_origins", {})
    known = {tuple(origins.get(name, (name, name))): trajectory for name, trajectory in scene.trajectories.items()}
    stay = [k for k, text in enumerate(texts) if not _is_known_pose(text, known)]
    if len(stay) == len(texts):
        return scene
    seconds = kept.get("other_seconds", {})
    anchors = {str(new): seconds[str(old)] for new, old in enumerate(stay) if str(old) in seconds}
    rest = {**kept, "other_lines": [texts[k] for k in stay], "other_seconds": anchors}
    return replace(scene, metadata=MappingProxyType({**scene.metadata, "recording": MappingProxyType(rest)}))


def _is_known_pose(text: str, known: Mapping[tuple[str, ...], Trajectory]) -> bool:
    """Whether a line says nothing but a pose that its trajectory has at that time."""
    try:
        line = msgspec.json.decode(text, type=dict[str, Any])
        seconds = float(line.pop("time"))
        (root, pose), *others = line.items()
    except (msgspec.MsgspecError, KeyError, TypeError, ValueError):
        return False
    trajectory = known.get((root, pose.get("name", root))) if isinstance(pose, dict) and not others else None
    if trajectory is None or not set(pose) <= {"name", "position", "orientation"}:
        return False
    row = int(np.searchsorted(trajectory.timestamps_ns, round(seconds * 1e9)))
    if row == len(trajectory.timestamps_ns) or trajectory.timestamps_ns[row] != round(seconds * 1e9):
        return False
    rotation = None if trajectory.quaternions_xyzw is None else trajectory.quaternions_xyzw[row]
    wanted = dict(zip("xyz", trajectory.positions[row].tolist(), strict=True))
    orientation = None if rotation is None else dict(zip("xyzw", rotation.tolist(), strict=True))
    return bool(pose.get("position") == wanted and pose.get("orientation") == orientation)


def _reported_once(sensor: Sensor) -> Sensor:
    if isinstance(sensor, ImuSensor):
        streams = {name: _samples_once(samples) for name, samples in sensor.streams.items()}
        if all(streams[name] is samples for name, samples in sensor.streams.items()):
            return sensor
        return replace(sensor, streams=MappingProxyType(streams))
    if isinstance(sensor, CameraSensor):
        return _images_once(sensor)
    return _fixes_once(sensor) if isinstance(sensor, GnssSensor) else sensor


def _images_once(camera: CameraSensor) -> CameraSensor:
    """Of entries that mean one image of a video, keep the first."""
    video = camera.video
    if video is None or video.frame_indices is None:
        return camera
    indices = np.array(video.frame_indices, np.float64)[:, None]
    kept = np.flatnonzero(_first_of_equals(camera.images.timestamps_ns, indices))
    if len(kept) == len(indices):
        return camera
    chosen = tuple(video.frame_indices[k] for k in kept.tolist())
    images = camera.images.chosen(kept.astype(np.int64))
    return replace(camera, images=images, video=replace(video, frame_indices=chosen))


def _samples_once(samples: VectorSamples) -> VectorSamples:
    kept = _first_of_equals(samples.timestamps_ns, samples.values)
    return samples if kept.all() else select_rows(samples, kept)


def _fixes_once(sensor: GnssSensor) -> GnssSensor:
    values = np.column_stack([sensor.positions_lla, sensor.accuracies, sensor.vertical_accuracies])
    kept = _first_of_equals(sensor.timestamps_ns, values)
    return sensor if kept.all() else select_rows(sensor, kept)


def _first_of_equals(timestamps_ns: Int64Array, values: Float64Array) -> BoolArray:
    """Which rows differ from the one before in time or value, (N,) bool."""
    kept = np.ones(len(timestamps_ns), np.bool_)
    alike = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    kept[1:] = (np.diff(timestamps_ns) != 0) | ~alike.all(axis=1)
    return kept


def _lengths(subject: Subject) -> Iterator[Hit]:
    if subject.recording is None:
        return
    for name, trajectory in subject.scene.trajectories.items():
        if trajectory.quaternions_xyzw is not None:
            errors = _norm_errors(trajectory.quaternions_xyzw)
            off = np.flatnonzero(errors > NORM_TOLERANCE)
            if len(off):
                worst = int(errors.argmax())
                length = float(np.linalg.norm(trajectory.quaternions_xyzw[worst]))
                reported = f"{len(off)} of {len(errors)} orientations are not of length 1, the worst {length:.5f}"
                yield Hit(
                    f"trajectories[{name}]",
                    f"{reported} at {trajectory.timestamps_ns[worst] / 1e9:.6f} s",
                    len(off),
                )


def _norm_errors(quaternions_xyzw: Float64Array) -> Float64Array:
    errors: Float64Array = np.abs(np.linalg.norm(quaternions_xyzw, axis=1) - 1.0)
    return errors


def with_unit_orientations(scene: Scene) -> Scene:
    """Scale orientations to length 1 that are off by more than rounding; the others stay as they are."""
    trajectories = {name: _with_unit_orientations(trajectory) for name, trajectory in scene.trajectories.items()}
    if all(trajectories[name] is trajectory for name, trajectory in scene.trajectories.items()):
        return scene
    return replace(scene, trajectories=MappingProxyType(trajectories))


def _with_unit_orientations(trajectory: Trajectory) -> Trajectory:
    quaternions = trajectory.quaternions_xyzw
    if quaternions is None:
        return trajectory
    off = _norm_errors(quaternions) > NORM_TOLERANCE
    if not off.any():
        return trajectory
    units = np.where(off[:, None], normalise_quaternion(quaternions), quaternions)
    return replace(trajectory, quaternions_xyzw=read_only(units))


# fmt: off
ORIENTATION_RULES: tuple[Rule, ...] = (
    Rule("orientation-norm", WARNING,
         f"Orientations of poses have length 1, within {NORM_TOLERANCE:g}; beyond 0.01 they are refused.",
         "Write quaternions with more digits; `--fix` scales them to length 1.", find=_lengths,
         fix=with_unit_orientations),
)
# fmt: on

GAP_SECONDS = 0.25

GAP_PERIODS = 10.0
"""An interval that exceeds the usual one by more than both is a gap."""

FRAME_GAP_PERIODS = 0.75
"""Of images and sweeps a single one that is missing is reported: an interval of 1.75 usual ones."""

_FEW_FRAMES = 40
"""Of fewer, one or two that are missing make more than `JITTER_SHARE`."""

JITTER_PERIODS = 0.2

JITTER_SHARE = 0.05
"""More intervals than this share that differ by more than this part of the usual one."""

APART_SECONDS = 5.0
"""Streams start and end within so long of each other."""

RATES_HZ: Mapping[Kind, tuple[float, float]] = MappingProxyType(
    {
        Kind.CAMERA: (1.0, 100.0),
        Kind.LIDAR: (1.0, 100.0),
        Kind.ACCELEROMETER: (50.0, 10_000.0),
        Kind.GYROSCOPE: (50.0, 10_000.0),
        Kind.MAGNETOMETER: (1.0, 1000.0),
        Kind.BAROMETER: (1.0, 1000.0),
        Kind.GNSS: (0.0, 100.0),
        Kind.POSES: (1.0, 10_000.0),
    }
)
"""The rates between which the vendor's diagnosis lets streams pass, sweeps as images."""

_RATE_TOLERANCE = 0.01
_FRAMES = frozenset({Kind.CAMERA, Kind.LIDAR})

_IRREGULAR = frozenset({Kind.GNSS, Kind.POSES, Kind.TEMPERATURE, Kind.OTHER})
"""Kinds that come when they can: when satellites are seen, when a method has found a pose."""

_WRONG_UNITS = ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds"))


def _out_of_order(subject: Subject) -> Iterator[Hit]:
    """Streams that go back in time; where each by itself is in order, lines that do."""
    is_reported = False
    for stream in streams_of(subject):
        steps = np.diff(stream.file_seconds)
        back = np.flatnonzero(steps < 0)
        if len(back):
            is_reported = True
            row = int(back[0]) + 1
            problem = (
                f"{stream.name} at {stream.file_seconds[row]:.6f} s comes after the one at "
                f"{stream.file_seconds[row - 1]:.6f} s; such steps go back by up to {-steps.min():.6f} s"
            )
            yield Hit(_location_in_file(stream, row), problem, len(back))
    if subject.recording is not None and not is_reported:
        yield from _lines_out_of_order(subject.recording.data_name, line_seconds(subject.recording.columns))


def _lines_out_of_order(file: str, seconds: Float64Array) -> Iterator[Hit]:
    """Lines that go back in time, while each stream by itself is in order."""
    lines = np.flatnonzero(np.isfinite(seconds))
    steps = np.diff(seconds[lines])
    back = np.flatnonzero(steps < 0)
    if len(back):
        before, line = lines[back[0]], lines[back[0] + 1]
        problem = (
            f"{seconds[line]:.6f} s comes after {seconds[before]:.6f} s; such steps go back by up to "
            f"{-steps.min():.6f} s, while each stream by itself is in order"
        )
        yield Hit(f"{file}: line {line + 1}", problem, len(back))


def _of_one_time(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of(subject):
        same = np.flatnonzero(stream.intervals == 0)
        if len(same):
            row = int(same[0]) + 1
            problem = f"{stream.at(row)} has the time of the one before; expected a time of its own"
            yield Hit(location(stream, row), problem, len(same))


def _gap_threshold(stream: Stream, period: float) -> float:
    """By how much an interval exceeds the usual one that is a gap [s].

    Cameras that expose longer in the dark have many long intervals: such are uneven, and lack nothing.
    """
    if stream.kind in _FRAMES:
        single = FRAME_GAP_PERIODS * period
        if float((stream.intervals - period > single).mean()) <= JITTER_SHARE or len(stream) < _FEW_FRAMES:
            return single
    return max(GAP_SECONDS, GAP_PERIODS * period)


def _with_periods(subject: Subject, *, irregular: bool) -> Iterator[tuple[Stream, float]]:
    """The streams of kinds that come regularly, or of those that do not, with their usual intervals [s]."""
    for stream in streams_of(subject):
        if stream.period is not None and (stream.kind in _IRREGULAR) is irregular:
            yield stream, stream.period


def _gaps(*, irregular: bool) -> Find:
    def find(subject: Subject) -> Iterator[Hit]:
        for stream, period in _with_periods(subject, irregular=irregular):
            gaps = np.flatnonzero(stream.intervals - period > _gap_threshold(stream, period))
            for row in gaps.tolist():
                length = float(stream.intervals[row])
                missing = max(round(length / period) - 1, 1)
                problem = (
                    f"{stream.at(row)}: {length:.6f} s to the next, {period:.6f} s usually; "
                    f"{missing} {'seems' if missing == 1 else 'seem'} missing"
                )
                yield Hit(location(stream, row), problem)

    return find


def _single_losses(subject: Subject) -> Iterator[Hit]:
    """Samples that are missing one by one; where they are many the stream is uneven, and of images all are reported."""
    for stream, period in _with_periods(subject, irregular=False):
        if stream.kind in _FRAMES or _off(stream, period).mean() > JITTER_SHARE:
            continue
        more = stream.intervals - period
        lacking = np.flatnonzero((more > FRAME_GAP_PERIODS * period) & (more <= _gap_threshold(stream, period)))
        if len(lacking):
            row = int(lacking[0])
            count = int(np.rint(stream.intervals[lacking] / period - 1).sum())
            problem = (
                f"{stream.at(row)}: {stream.intervals[row]:.6f} s to the next, {period:.6f} s usually; in all, "
                f"{count} {'seems' if count == 1 else 'seem'} missing at {len(lacking)} "
                f"location{'s' * (len(lacking) > 1)}"
            )
            yield Hit(location(stream, row), problem)


def _uneven(*, irregular: bool) -> Find:
    def find(subject: Subject) -> Iterator[Hit]:
        for stream, period in _with_periods(subject, irregular=irregular):
            off = _off(stream, period)
            share = float(off.mean())
            if share > JITTER_SHARE:
                row = int(np.flatnonzero(off)[0])
                problem = (
                    f"{share:.1%} of the intervals are off the usual {period * 1e3:.3f} ms by more than "
                    f"{JITTER_PERIODS:.0%}, the first after {stream.at(row)}: {stream.intervals[row] * 1e3:.3f} ms"
                )
                yield Hit(stream.whole, problem)

    return find


def _off(stream: Stream, period: float) -> BoolArray:
    """Which intervals are uneven; not those that are a gap or none at all, which others report."""
    away = np.abs(stream.intervals - period)
    is_gap = stream.intervals - period > _gap_threshold(stream, period)
    off: BoolArray = (away > JITTER_PERIODS * period) & (stream.intervals > 0) & ~is_gap
    return off


def _wrong_rates(subject: Subject) -> Iterator[Hit]:
    rates = {
        stream: 1.0 / stream.period
        for stream in streams_of(subject)
        if stream.kind in RATES_HZ and stream.period is not None
    }
    guess = _unit_in_question(rates)
    for stream, rate in rates.items():
        lowest, highest = RATES_HZ[stream.kind]
        if not lowest * (1 - _RATE_TOLERANCE) <= rate <= highest * (1 + _RATE_TOLERANCE):
            problem = f"comes at {rate:.4g} Hz; expected {lowest:g} to {highest:g} Hz"
            yield Hit(stream.whole, f"{problem}{guess}")


def _unit_in_question(rates: Mapping[Stream, float]) -> str:
    """What unit times are in, where all streams that have a lowest rate come too seldom, and would not in that unit."""
    judged = [(rate, *RATES_HZ[stream.kind]) for stream, rate in rates.items() if RATES_HZ[stream.kind][0] > 0]
    if len(judged) > 1 and all(rate < lowest for rate, lowest, _ in judged):
        for factor, unit in _WRONG_UNITS:
            if all(lowest <= rate * factor <= highest for rate, lowest, highest in judged) and all(
                rate * factor <= RATES_HZ[stream.kind][1] for stream, rate in rates.items()
            ):
                return f": are the times {unit}? They have to be seconds"
    return ""


def _apart(subject: Subject) -> Iterator[Hit]:
    """Streams that start or end away from where most do."""
    streams = [stream for stream in streams_of(subject) if len(stream) > 1]
    if len(streams) < 2:
        return
    for word, ends in (
        ("starts", [float(stream.seconds[0]) for stream in streams]),
        ("ends", [float(stream.seconds[-1]) for stream in streams]),
    ):
        usual = sorted(ends)[(len(ends) - 1) // 2]
        for stream, end in zip(streams, ends, strict=True):
            if abs(end - usual) > APART_SECONDS:
                later = "later" if end > usual else "earlier"
                problem = (
                    f"{word} at {end:.3f} s, {abs(end - usual):.3f} s {later} than others; "
                    f"expected within {APART_SECONDS:g} s"
                )
                yield Hit(stream.whole, problem)


# fmt: off
STREAM_RULES: tuple[Rule, ...] = (
    Rule("lines-in-order", WARNING, "The lines of a recording stand in the order of their times.",
         "Sort the lines by time; software that replays them in the order of the file drops what comes late.",
         find=_out_of_order, fix=as_read),
    Rule("stream-times-unique", WARNING, "No two samples, images or poses of a stream have one time.",
         "Leave one of them out, or write times with all their digits; `--fix` leaves out what stands there twice.",
         find=_of_one_time, fix=without_repetitions),
    Rule("stream-gaps", WARNING,
         "No interval of a recording's stream exceeds the usual one by more than 0.25 s and 10 intervals; of "
         "images and sweeps, by 0.75 intervals where at most 5 % do.",
         "See whether samples were lost: a full disk, a full buffer, a loose cable.",
         find=_gaps(irregular=False)),
    Rule("samples-lost", HINT,
         "No interval of the IMU, of a magnetometer or of a barometer is longer than 1.75 usual ones.",
         "See whether single samples were lost; what integrates them has to go by their times.",
         find=_single_losses),
    Rule("stream-outages", HINT,
         "No interval between fixes or poses exceeds the usual one by more than 0.25 s and 10 intervals.",
         "Compute with it where these are relied on: there was no reception, or tracking was lost.",
         find=_gaps(irregular=True)),
    Rule("stream-jitter", WARNING,
         "At most 5 % of a stream's intervals are off the usual one by more than a fifth.",
         "Timestamp samples when they are measured, not when they arrive.", find=_uneven(irregular=False)),
    Rule("stream-uneven", HINT,
         "At most 5 % of the intervals between fixes or poses are off the usual one by more than a fifth.",
         "Timestamp fixes and poses with the time that they are for, not with that of their arrival.",
         find=_uneven(irregular=True)),
    Rule("stream-rate", WARNING,
         "Streams come at rates that sensors have: cameras and lidars at 1 to 100 Hz, accelerometer and gyroscope "
         "at 50 to 10000, magnetometer and barometer at 1 to 1000, fixes at up to 100, poses at 1 to 10000.",
         "See whether times are seconds; of a slow IMU, record it at its own rate.", find=_wrong_rates),
    Rule("streams-together", WARNING, "All streams of a recording start and end within 5 s of each other.",
         "See whether all are on one clock, and whether one of them was cut off.", find=_apart),
)
# fmt: on
