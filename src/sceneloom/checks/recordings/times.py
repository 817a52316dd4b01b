"""Streams of a recording as rules look at them, and rules about their times: order, rates, gaps, overlap."""

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
from sceneloom.checks.rule import HINT, WARNING, Find, Hit, Rule, Subject, with_each
from sceneloom.formats.recording.contents import RECEIVER, Columns, line_seconds, time_order
from sceneloom.geometry.rigid import normalise_quaternion
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.time_range import select_rows

_FEWEST_FOR_A_RATE = 4  # fewer samples do not show what is usual
_SAME_TIME = 0.5e-9  # times closer than this [s] are one time: the scene counts nanoseconds

NORM_TOLERANCE = 1e-3
"""Lengths of quaternions that are off by no more [1] are rounding."""

GAP_SECONDS, GAP_PERIODS = 0.25, 10.0
"""An interval that exceeds the usual one by more than both is a gap."""

FRAME_GAP_PERIODS = 0.75
"""Of images and sweeps a single one that is missing is reported: an interval of 1.75 usual ones."""

_FEW_FRAMES = 40  # of fewer, one or two that are missing make more than `JITTER_SHARE`

JITTER_PERIODS, JITTER_SHARE = 0.2, 0.05
"""A stream is uneven if more intervals than this share differ by more than this part of the usual one."""

APART_SECONDS = 5.0
"""Streams start and end within so long of each other."""

_RATE_TOLERANCE = 0.01
_WRONG_UNITS = ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds"))


class Kind(StrEnum):
    """The kind of a stream; a sensor's word is the format's own."""

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


_SENSORS = frozenset({"accelerometer", "gyroscope", "magnetometer", "barometer", "imuTemperature"})
_FRAMES = frozenset({Kind.CAMERA, Kind.LIDAR})
_IRREGULAR = frozenset({Kind.GNSS, Kind.POSES, Kind.TEMPERATURE, Kind.OTHER})
"""Kinds without a rate of their own: fixes need satellites in view, poses a method that finds them."""

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


@dataclass(frozen=True, eq=False)
class Stream:
    """A stream in the order of its times.

    Attributes:
        name: as in messages: "accelerometer", "gps", "groundTruth", "camera0", "lidar".
        kind: of the stream.
        file_seconds: (N,) float64 [s], in the order of the file.
        file_values: (N, K) float64 in the order of the file; None for images and sweeps.
        file_lines: (N,) int64, line of each in the order of the file; None where it is not known.
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
        return self.file_seconds[self.order]

    @property
    def values(self) -> Float64Array:
        """(N, K) float64, in the order of `seconds`; (N, 0) for images and sweeps."""
        if self.file_values is None:
            return np.zeros((len(self), 0))
        return self.file_values[self.order]

    @cached_property
    def intervals(self) -> Float64Array:
        """(N - 1,) float64 [s], from each time to the next; 0 for one and the same time."""
        steps = np.diff(self.seconds)
        steps[steps < _SAME_TIME] = 0.0
        return steps

    @cached_property
    def period(self) -> float | None:
        """The usual interval [s]; None where the times show none."""
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

    def hit(self, row: int, problem: str, count: int = 1) -> Hit:
        """A hit at a sample; `row` counts in the order of `seconds`."""
        return self.hit_in_file(int(self.order[row]), problem, count)

    def hit_in_file(self, row: int, problem: str, count: int) -> Hit:
        """A hit at a sample, by its line if that is known; `row` counts in the order of the file."""
        lines = self.file_lines
        return Hit(self.whole if lines is None else f"{self.file}: line {lines[row]}", problem, count)


def _streams_of(subject: Subject) -> tuple[Stream, ...]:
    """All streams of the recording that have samples; none where the subject is no recording."""
    return subject.table("streams of the recording", _make_streams)


def streams_of_kind(subject: Subject, *kinds: Kind) -> Iterator[Stream]:
    """Those of some kinds."""
    return (stream for stream in _streams_of(subject) if stream.kind in kinds)


def _make_streams(subject: Subject) -> tuple[Stream, ...]:
    if subject.recording is None:
        return ()
    columns, file, found = subject.recording.columns, subject.recording.data_name, list[Stream]()

    def add(name: str, kind: Kind, stream: Columns) -> None:
        seconds = np.asarray(stream.seconds, np.float64)
        values = np.asarray(stream.values, np.float64).reshape(len(seconds), stream.width)
        found.append(Stream(name, kind, seconds, values, np.asarray(stream.lines, np.int64), file))

    frame_lines = np.asarray(columns.frames.lines, np.int64)
    for index, camera in sorted(columns.frames.cameras.items()):
        there = np.asarray(camera.missing, np.int8) == 0
        seconds, lines = np.asarray(camera.seconds)[there], frame_lines[np.asarray(camera.rows, np.int64)[there]]
        found.append(Stream(f"camera{index}", Kind.CAMERA, seconds, None, lines, file))
    for index, lidar in sorted(columns.lidars.items()):
        name, lines = f"lidar{index}" if len(columns.lidars) > 1 else "lidar", np.asarray(lidar.lines, np.int64)
        found.append(Stream(name, Kind.LIDAR, np.asarray(lidar.seconds), None, lines, file))
    for name, stream in columns.imu_streams().items():
        add(name, Kind(name) if name in _SENSORS else Kind.OTHER, stream)
    for name, (_, stream) in columns.satellite_receivers().items():
        add("gps" if name == RECEIVER else name, Kind.GNSS, stream)
    for (root, name), poses in columns.poses.items():
        add(name if name == root or not root else f"{root} {name}", Kind.POSES, poses)
    return tuple(stream for stream in found if len(stream))


def without_repetitions(scene: Scene) -> Scene:
    """Leave out samples, fixes and images that repeat the one before at the same time."""
    return _without_kept_poses(with_each(scene, "sensors", _without_repeated_rows))


def _without_repeated_rows(sensor: Sensor) -> Sensor:
    if isinstance(sensor, ImuSensor):
        streams = {}
        for name, samples in sensor.streams.items():
            kept = _first_of_equals(samples.timestamps_ns, samples.values)
            streams[name] = samples if kept.all() else select_rows(samples, kept)
        if all(streams[name] is samples for name, samples in sensor.streams.items()):
            return sensor
        return replace(sensor, streams=MappingProxyType(streams))
    if isinstance(sensor, GnssSensor):
        values = np.column_stack([sensor.positions_lla, sensor.accuracies, sensor.vertical_accuracies])
        kept = _first_of_equals(sensor.timestamps_ns, values)
        return sensor if kept.all() else select_rows(sensor, kept)
    if isinstance(sensor, CameraSensor) and sensor.video is not None and sensor.video.frame_indices is not None:
        # entries that mean one image of a video
        indices = np.array(sensor.video.frame_indices, np.int64)
        kept = _first_of_equals(sensor.images.timestamps_ns, indices[:, None].astype(np.float64))
        if not kept.all():
            video = replace(sensor.video, frame_indices=tuple(indices[kept].tolist()))
            return replace(sensor, images=sensor.images.chosen(np.flatnonzero(kept)), video=video)
    return sensor


def _first_of_equals(timestamps_ns: Int64Array, values: Float64Array) -> BoolArray:
    """Which rows differ from the one before in time or value, (N,) bool."""
    kept = np.ones(len(timestamps_ns), np.bool_)
    alike = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    kept[1:] = (np.diff(timestamps_ns) != 0) | ~alike.all(axis=1)
    return kept


def _without_kept_poses(scene: Scene) -> Scene:
    """Leave out lines that are kept as text and repeat a pose of a trajectory."""
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
    """Whether a line contains nothing but a pose that its trajectory has at that time."""
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


def _lengths(subject: Subject) -> Iterator[Hit]:
    for name, trajectory in subject.scene.trajectories.items() if subject.recording is not None else ():
        errors = _norm_errors(trajectory)
        off = int(np.count_nonzero(errors > NORM_TOLERANCE))
        if off and trajectory.quaternions_xyzw is not None:
            worst = int(errors.argmax())
            problem = (
                f"{off} of {len(errors)} orientations are not of length 1, the worst "
                f"{float(np.linalg.norm(trajectory.quaternions_xyzw[worst])):.5f} at "
                f"{trajectory.timestamps_ns[worst] / 1e9:.6f} s"
            )
            yield Hit(f"trajectories[{name}]", problem, off)


def _norm_errors(trajectory: Trajectory) -> Float64Array:
    quaternions = trajectory.quaternions_xyzw
    return np.zeros(0) if quaternions is None else np.asarray(np.abs(np.linalg.norm(quaternions, axis=1) - 1.0))


def with_unit_orientations(scene: Scene) -> Scene:
    """Scale orientations to length 1 that are off by more than rounding; the others stay as they are."""
    changed = {}
    for name, trajectory in scene.trajectories.items():
        off, quaternions = _norm_errors(trajectory) > NORM_TOLERANCE, trajectory.quaternions_xyzw
        if off.any() and quaternions is not None:
            units = np.where(off[:, None], normalise_quaternion(quaternions), quaternions)
            changed[name] = replace(trajectory, quaternions_xyzw=read_only(units))
    return replace(scene, trajectories=MappingProxyType({**scene.trajectories, **changed})) if changed else scene


def _out_of_order(subject: Subject) -> Iterator[Hit]:
    """Streams that go back in time; where each by itself is in order, lines that do."""
    is_reported = False
    for stream in _streams_of(subject):
        steps = np.diff(stream.file_seconds)
        back = np.flatnonzero(steps < 0)
        if len(back):
            is_reported = True
            row = int(back[0]) + 1
            problem = (
                f"{stream.name} at {stream.file_seconds[row]:.6f} s comes after the one at "
                f"{stream.file_seconds[row - 1]:.6f} s; such steps go back by up to {-steps.min():.6f} s"
            )
            yield stream.hit_in_file(row, problem, len(back))
    if subject.recording is None or is_reported:
        return
    seconds = line_seconds(subject.recording.columns)
    lines = np.flatnonzero(np.isfinite(seconds))
    steps = np.diff(seconds[lines])
    back = np.flatnonzero(steps < 0)
    if len(back):
        before, line = lines[back[0]], lines[back[0] + 1]
        problem = (
            f"{seconds[line]:.6f} s comes after {seconds[before]:.6f} s; such steps go back by up to "
            f"{-steps.min():.6f} s, while each stream by itself is in order"
        )
        yield Hit(f"{subject.recording.data_name}: line {line + 1}", problem, len(back))


def _of_one_time(subject: Subject) -> Iterator[Hit]:
    for stream in _streams_of(subject):
        same = np.flatnonzero(stream.intervals == 0)
        if len(same):
            row = int(same[0]) + 1
            problem = f"{stream.at(row)} has the time of the one before; expected a time of its own"
            yield stream.hit(row, problem, len(same))


def _gap_threshold(stream: Stream, period: float) -> float:
    """By how much an interval exceeds the usual one that is a gap [s]."""
    # cameras that expose longer in the dark have many long intervals: such are uneven, and lack nothing
    if stream.kind in _FRAMES:
        single = FRAME_GAP_PERIODS * period
        if float((stream.intervals - period > single).mean()) <= JITTER_SHARE or len(stream) < _FEW_FRAMES:
            return single
    return max(GAP_SECONDS, GAP_PERIODS * period)


def _with_periods(subject: Subject, *, irregular: bool) -> Iterator[tuple[Stream, float, float]]:
    """The streams of kinds with a rate, or of those without, with their usual intervals and gap thresholds [s]."""
    for stream in _streams_of(subject):
        if stream.period is not None and (stream.kind in _IRREGULAR) is irregular:
            yield stream, stream.period, _gap_threshold(stream, stream.period)


def _gaps(*, irregular: bool) -> Find:
    def find(subject: Subject) -> Iterator[Hit]:
        for stream, period, threshold in _with_periods(subject, irregular=irregular):
            for row in np.flatnonzero(stream.intervals - period > threshold).tolist():
                length = float(stream.intervals[row])
                missing = max(round(length / period) - 1, 1)
                problem = (
                    f"{stream.at(row)}: {length:.6f} s to the next, {period:.6f} s usually; "
                    f"{missing} {'seems' if missing == 1 else 'seem'} missing"
                )
                yield stream.hit(row, problem)

    return find


def _single_losses(subject: Subject) -> Iterator[Hit]:
    """Samples that are missing one by one; where they are many the stream is uneven, and of images all are reported."""
    for stream, period, threshold in _with_periods(subject, irregular=False):
        if stream.kind in _FRAMES or _off(stream, period, threshold).mean() > JITTER_SHARE:
            continue
        more = stream.intervals - period
        lacking = np.flatnonzero((more > FRAME_GAP_PERIODS * period) & (more <= threshold))
        if len(lacking):
            row = int(lacking[0])
            count = int(np.rint(stream.intervals[lacking] / period - 1).sum())
            problem = (
                f"{stream.at(row)}: {stream.intervals[row]:.6f} s to the next, {period:.6f} s usually; in all, "
                f"{count} {'seems' if count == 1 else 'seem'} missing at {len(lacking)} "
                f"location{'s' * (len(lacking) > 1)}"
            )
            yield stream.hit(row, problem)


def _uneven(*, irregular: bool) -> Find:
    def find(subject: Subject) -> Iterator[Hit]:
        for stream, period, threshold in _with_periods(subject, irregular=irregular):
            off = _off(stream, period, threshold)
            share = float(off.mean())
            if share > JITTER_SHARE:
                row = int(np.flatnonzero(off)[0])
                problem = (
                    f"{share:.1%} of the intervals are off the usual {period * 1e3:.3f} ms by more than "
                    f"{JITTER_PERIODS:.0%}, the first after {stream.at(row)}: {stream.intervals[row] * 1e3:.3f} ms"
                )
                yield Hit(stream.whole, problem)

    return find


def _off(stream: Stream, period: float, threshold: float) -> BoolArray:
    """Which intervals are uneven; not those that are a gap or none at all, which others report."""
    more = stream.intervals - period
    return np.asarray((np.abs(more) > JITTER_PERIODS * period) & (stream.intervals > 0) & ~(more > threshold))


def _wrong_rates(subject: Subject) -> Iterator[Hit]:
    rates = [(stream, 1.0 / stream.period) for stream in streams_of_kind(subject, *RATES_HZ) if stream.period]
    unit = _unit_in_question([(rate, *RATES_HZ[stream.kind]) for stream, rate in rates])
    for stream, rate in rates:
        lowest, highest = RATES_HZ[stream.kind]
        if not lowest * (1 - _RATE_TOLERANCE) <= rate <= highest * (1 + _RATE_TOLERANCE):
            yield Hit(stream.whole, f"comes at {rate:.4g} Hz; expected {lowest:g} to {highest:g} Hz{unit}")


def _unit_in_question(rates: list[tuple[float, float, float]]) -> str:
    """What unit times are in, if all (rate, lowest, highest) are too low, except where 0 is allowed, and fit in it."""
    judged = [(rate, lowest) for rate, lowest, _ in rates if lowest > 0]
    if len(judged) > 1 and all(rate < lowest for rate, lowest in judged):
        for factor, unit in _WRONG_UNITS:
            if all(lowest <= rate * factor <= highest for rate, lowest, highest in rates):
                return f": are the times {unit}? They have to be seconds"
    return ""


def _apart(subject: Subject) -> Iterator[Hit]:
    """Streams that start or end away from where most do."""
    streams = [stream for stream in _streams_of(subject) if len(stream) > 1]
    for word, row in (("starts", 0), ("ends", -1)) if len(streams) > 1 else ():
        ends = [float(stream.seconds[row]) for stream in streams]
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
         "Leave one of them out, or write times with all their digits; `--fix` leaves out repetitions.",
         find=_of_one_time, fix=without_repetitions),
    Rule("stream-gaps", WARNING,
         "No interval of a recording's stream exceeds the usual one by more than 0.25 s and 10 intervals; of "
         "images and sweeps, by 0.75 intervals where at most 5 % do.",
         "Check whether samples were lost: a full disk, a full buffer, a loose cable.", find=_gaps(irregular=False)),
    Rule("samples-lost", HINT,
         "No interval of the IMU, of a magnetometer or of a barometer is longer than 1.75 usual ones.",
         "Check whether single samples were lost; integrate them by their times.", find=_single_losses),
    Rule("stream-outages", HINT,
         "No interval between fixes or poses exceeds the usual one by more than 0.25 s and 10 intervals.",
         "Take it into account where these are relied on: there was no reception, or tracking was lost.",
         find=_gaps(irregular=True)),
    Rule("stream-jitter", WARNING, "At most 5 % of a stream's intervals are off the usual one by more than a fifth.",
         "Timestamp samples when they are measured, not when they arrive.", find=_uneven(irregular=False)),
    Rule("stream-uneven", HINT,
         "At most 5 % of the intervals between fixes or poses are off the usual one by more than a fifth.",
         "Timestamp fixes and poses with the time that they are for, not with that of their arrival.",
         find=_uneven(irregular=True)),
    Rule("stream-rate", WARNING,
         "Streams come at rates that sensors have: cameras and lidars at 1 to 100 Hz, accelerometer and gyroscope "
         "at 50 to 10000, magnetometer and barometer at 1 to 1000, fixes at up to 100, poses at 1 to 10000.",
         "Check whether times are seconds; of a slow IMU, record it at its own rate.", find=_wrong_rates),
    Rule("streams-together", WARNING, "All streams of a recording start and end within 5 s of each other.",
         "Check whether all are on one clock, and whether one of them was cut off.", find=_apart),
)

ORIENTATION_RULES: tuple[Rule, ...] = (
    Rule("orientation-norm", WARNING,
         f"Orientations of poses have length 1, within {NORM_TOLERANCE:g}; beyond 0.01 they are refused.",
         "Write quaternions with more digits; `--fix` scales them to length 1.", find=_lengths,
         fix=with_unit_orientations),
)
# fmt: on
