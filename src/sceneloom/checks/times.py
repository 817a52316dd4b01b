"""Rules about times: of frames and images, of the points of a sweep, and of annotations."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Int64Array
from sceneloom.checks.faults import as_read, warnings_of_code
from sceneloom.checks.rule import (
    ERROR,
    HINT,
    PART_KINDS,
    WARNING,
    Find,
    FrameInHand,
    Hit,
    PartTable,
    Rule,
    Subject,
    annotation_parts,
    camera_rows,
    frames_path,
    period_ns,
    seconds,
    timestamps_of,
    unless_recording,
    with_each,
)
from sceneloom.formats.sfs.clock import READABLE_TICKS_NS, UINT32_MAX, FileClock, chosen_offset_ns, point_times_dtype
from sceneloom.formats.sfs.container import RawBytes
from sceneloom.scene.annotations import (
    AttributePath,
    CameraCalibration,
    CuboidAnnotation,
    EventAnnotation,
    LocalizationAdjustment,
    PointsAnnotation,
)
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.point_times import PointTimes, RawTimes, timed_frame
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene, scene_period_ns, time_span
from sceneloom.scene.time_range import TIMED_COLUMNS, select_rows

HIGHEST_RATE_HZ = 100
"""More frames a second, on average, are no frames. Source: `MAX_FPS` of Scale's validator."""

LATEST_START_NS = 100_000_000_000
"""A file's timestamps count from somewhere near its beginning. Source: `max_init_frame_ts` of Scale's validator."""

_EARLIEST_EPOCH_NS = 631_152_000_000_000_000
"""1990-01-01 since 1970: timestamps beyond it are dates, not times of a drive [ns]."""

_GAP = 1.75
_DOUBLED = 0.1
_JITTER = 0.25
_FPS_TOLERANCE = 0.05
_FEWEST_FOR_A_RATE = 4


def _out_of_order(*, in_videos: bool) -> Find:
    """Frames that go back in time; those of videos cannot be sorted without encoding the video anew."""

    def find(subject: Subject) -> Iterator[Hit]:
        for path, sensor in subject.sensors():
            timestamps_ns = timestamps_of(sensor)
            if (getattr(sensor, "video", None) is not None) is in_videos:
                for k in np.flatnonzero(timestamps_ns[1:] < timestamps_ns[:-1]).tolist():
                    problem = f"{timestamps_ns[k + 1]} ns after {timestamps_ns[k]} ns; expected a later time"
                    yield Hit(f"{frames_path(path, sensor)}[{k + 1}]", problem)

    return find


def _with_sorted_frames(scene: Scene) -> Scene:
    """Sort the frames of every sensor by time; images of a video stay, since the video has its own order."""
    return with_each(scene, "sensors", _sorted)


def _sorted(sensor: Any) -> Any:
    name = "images" if isinstance(sensor, CameraSensor) else "frames"
    frames = getattr(sensor, name, None)
    if frames is None or getattr(sensor, "video", None) is not None:
        return sensor
    chosen = frames.chosen(np.argsort(frames.timestamps_ns, kind="stable"))
    return sensor if chosen is frames else replace(sensor, **{name: chosen})


def _of_one_time(subject: Subject) -> Iterator[Hit]:
    for path, sensor in subject.sensors():
        timestamps_ns = timestamps_of(sensor)
        order = np.argsort(timestamps_ns, kind="stable")
        for k in np.flatnonzero(np.diff(timestamps_ns[order]) == 0).tolist():
            first, second = int(order[k]), int(order[k + 1])
            problem = f"{timestamps_ns[second]} ns, as frame {first}; expected a time of its own"
            yield Hit(f"{frames_path(path, sensor)}[{second}]", problem)


def _too_many_a_second(subject: Subject) -> Iterator[Hit]:
    for path, sensor in subject.sensors():
        timestamps_ns = timestamps_of(sensor)
        if len(timestamps_ns) > 1:
            mean_ns = float(np.mean(np.diff(timestamps_ns)))
            if 0 <= mean_ns < 1e9 / HIGHEST_RATE_HZ:
                rate = f"{1e9 / mean_ns:.1f}" if mean_ns else "endlessly many"
                yield Hit(frames_path(path, sensor), f"{rate} frames a second; expected at most {HIGHEST_RATE_HZ}")


def _intervals(subject: Subject) -> Iterator[tuple[str, Int64Array, float]]:
    """Path of the frames, intervals between them, and the usual one [ns], of sensors with frames enough for a rate."""
    for path, sensor in subject.sensors():
        timestamps_ns = timestamps_of(sensor)
        if len(timestamps_ns) >= _FEWEST_FOR_A_RATE:
            yield frames_path(path, sensor), np.diff(timestamps_ns), period_ns(timestamps_ns)


def _gaps(subject: Subject) -> Iterator[Hit]:
    for path, intervals, usual in _intervals(subject):
        for k in np.flatnonzero(intervals > _GAP * usual).tolist():
            missing = round(intervals[k] / usual) - 1
            problem = f"{seconds(intervals[k])} to the next frame, {seconds(usual)} usually; {missing} seem missing"
            yield Hit(f"{path}[{k}]", problem, max(missing, 1))


def _doubled(subject: Subject) -> Iterator[Hit]:
    for path, intervals, usual in _intervals(subject):
        for k in np.flatnonzero((intervals > 0) & (intervals < _DOUBLED * usual)).tolist():
            yield Hit(f"{path}[{k + 1}]", f"{seconds(intervals[k])} after the frame before, {seconds(usual)} usually")


def _uneven(subject: Subject) -> Iterator[Hit]:
    for path, intervals, usual in _intervals(subject):
        plain = intervals[(intervals <= _GAP * usual) & (intervals >= _DOUBLED * usual)]
        if len(plain) < _FEWEST_FOR_A_RATE:
            continue
        spread_ns = float(np.std(plain))
        if spread_ns > _JITTER * usual:
            yield Hit(path, f"intervals of {seconds(usual)} vary by {seconds(spread_ns)} (one standard deviation)")


def _fps_differs(subject: Subject) -> Iterator[Hit]:
    for path, sensor in subject.sensors():
        if not isinstance(sensor, CameraSensor | DepthCameraSensor) or sensor.fps is None:
            continue
        if len(timestamps_of(sensor)) < 2:
            continue
        rate = 1e9 / period_ns(timestamps_of(sensor))
        if abs(sensor.fps - rate) > _FPS_TOLERANCE * rate:
            yield Hit(f"{path}.video.fps", f"{sensor.fps:g}; the timestamps report {rate:.4g} images a second")


def _timestamps_are_dates(subject: Subject) -> Iterator[Hit]:
    """Whether a scene file counts from 1970, where its clock should begin near the scene."""
    span = _file_span(subject.scene)
    if span is not None and span[0] >= _EARLIEST_EPOCH_NS:
        after = f"{span[0] / 1e9:.0f} s after the clock's zero"
        yield Hit("time_offset", f"timestamps begin {after}; expected a time_offset that takes most of it")


def _starts_late(subject: Subject) -> Iterator[Hit]:
    span = _file_span(subject.scene)
    if span is not None and LATEST_START_NS < span[0] < _EARLIEST_EPOCH_NS:
        problem = (
            f"timestamps begin {seconds(span[0])} after the clock's zero; expected at most {seconds(LATEST_START_NS)}"
        )
        yield Hit("time_offset", problem)


def _file_span(scene: Scene) -> tuple[int, int] | None:
    """First and last time of a scene file on its own clock [ns]."""
    span = time_span(scene) if scene.format == "sfs" else None
    return None if span is None else (span[0] - scene.time_offset_ns, span[1] - scene.time_offset_ns)


def _with_time_offset(scene: Scene) -> Scene:
    span = time_span(scene)
    return scene if span is None else replace(scene, time_offset_ns=chosen_offset_ns(span[0]))


# fmt: off
TIME_RULES: tuple[Rule, ...] = (
    Rule("frame-times-increasing", ERROR, "Frames and images of a sensor stand in the order of their times.",
         "Sort them by time.", find=_out_of_order(in_videos=False), fix=_with_sorted_frames),
    Rule("video-times-increasing", ERROR, "The timestamps of a video stand in the order of its images.",
         "Find out which images the timestamps belong to.", find=_out_of_order(in_videos=True)),
    Rule("frame-times-unique", ERROR, "No two frames or images of a sensor have one time.",
         "Keep one of them, or give each the time at which it was measured.", find=unless_recording(_of_one_time)),
    Rule("frame-rate", WARNING, "A sensor has at most 100 frames a second on average.",
         "See whether the timestamps are in the unit that `time_unit` says.",
         find=unless_recording(_too_many_a_second)),
    Rule("frame-doubled", WARNING, "No frame follows the one before within a tenth of the usual interval.",
         "See whether a frame was recorded twice, or timestamped when it was received and not when it was measured.",
         find=_doubled),
    Rule("frame-gaps", WARNING, "The frames of a sensor follow each other without gaps.",
         "See whether frames were lost; programs that count frames to report the time will be off.",
         find=unless_recording(_gaps)),
    Rule("frame-jitter", HINT, "The intervals between frames are even.",
         "Timestamp frames when they are measured, not when they arrive.", find=unless_recording(_uneven)),
    Rule("video-fps", WARNING, "`fps` of a video agrees with the timestamps of its images, within 5 %.",
         "Leave `fps` out, or write what the timestamps report: the timestamps are what counts.", find=_fps_differs),
    Rule("epoch-times", WARNING,
         "The timestamps of a scene file count from somewhere near its beginning, not from 1970.",
         "Take whole seconds off all timestamps and write them as `time_offset`; absolute times stay the same.",
         find=_timestamps_are_dates, fix=_with_time_offset),
    Rule("late-start", HINT, "A scene file begins within 100 s of its clock's zero.",
         "Write a `time_offset`: timestamps of points in microseconds end after 71 minutes.", find=_starts_late,
         fix=_with_time_offset),
)
# fmt: on

_WRAP_NS = (UINT32_MAX + 1) * 1_000  # what microseconds in 32 bits run over at [ns]
_NEAR_NS = 1_000_000_000
_ROUNDING_NS = 1_000  # timestamps in microseconds may be so late [ns]
_ON_ANOTHER_CLOCK = 100  # times so many periods away are not late, but of another clock, which another rule reports


@dataclass(slots=True)
class _Observation:
    """The first frame of a sensor in which something was seen, and how many there are."""

    path: str
    problem: str
    frames: int = 0


def _observations(subject: Subject, rule: str) -> dict[str, _Observation]:
    return subject.table(f"observations of {rule}", lambda _: {})


def _note_observation(subject: Subject, rule: str, frame: FrameInHand, problem: str) -> None:
    """Remember a problem with the times of a frame's points; the first one of a sensor is reported."""
    first = _Observation(f"{frame.path}.points.timestamps", problem)
    _observations(subject, rule).setdefault(frame.sensor_path, first).frames += 1


def _observations_of(rule: str) -> Find:
    """Report what was remembered for a rule: one hit for each sensor."""

    def conclude(subject: Subject) -> Iterator[Hit]:
        return (Hit(seen.path, seen.problem, seen.frames) for seen in _observations(subject, rule).values())

    return conclude


_WHAT: dict[PointTimes, str] = {
    PointTimes.RELATIVE: "count from the frame's own timestamp; expected times on the scene's clock",
    PointTimes.OTHER_CLOCK: "are on another clock than the frame's timestamp",
    PointTimes.UNKNOWN: "are not those of a sweep at the frame's timestamp",
}


def _not_on_the_clock(subject: Subject, frame: FrameInHand) -> Iterable[Hit]:
    if not isinstance(frame.sensor, LidarSensor) or not isinstance(frame.frame, LidarFrame):
        return ()
    usual_ns = round(period_ns(frame.sensor.frames.timestamps_ns))
    previous: dict[str, RawTimes | None] = subject.table("raw point times by sensor", lambda _: {})
    timed = timed_frame(frame.frame, usual_ns, previous=previous.get(frame.sensor_path))
    previous[frame.sensor_path] = timed.raw
    if timed.raw is None:
        return ()
    wraps = _wraps(timed.raw, subject.scene.time_offset_ns)
    problem = _WHAT.get(timed.verdict)
    if wraps:
        problem = f"lie {wraps} times 2^32 µs before the frame; 32 bits have run over"
    elif timed.verdict is PointTimes.WRONG_UNIT:
        factor = timed.found.factor
        problem = f"are {float(max(factor, 1 / factor)):g} times too {'large' if factor > 1 else 'small'}"
    if problem is not None:
        problem = f"they {problem}; the first is {timed.raw.first_ns} ns"
        _note_observation(subject, "point-times-clock", frame, problem)
    return ()


def _widths(subject: Subject) -> Iterator[Hit]:
    """Point times whose dtype is not the one that the description says for the file's unit; others are unreadable."""
    header = subject.header or {}
    unit = header.get("time_unit")
    tick_ns = READABLE_TICKS_NS.get(unit, 1_000) if isinstance(unit, str) else 1_000
    expected = point_times_dtype(FileClock(tick_ns, 0))
    sensors = header.get("sensors")
    for k, sensor in enumerate(sensors if isinstance(sensors, list) else []):
        frames = sensor.get("frames") if isinstance(sensor, dict) else None
        odd = [
            (n, times.dtype)
            for n, frame in enumerate(frames if isinstance(frames, list) else [])
            if isinstance(times := _file_times(frame), np.ndarray)
            and times.dtype.kind in "iu"
            and times.dtype.newbyteorder("=") != expected
        ]
        if odd:
            number, dtype = odd[0]
            problem = f"{dtype.name}; expected {expected.name}, as time_unit is {unit or 'microseconds'}"
            yield Hit(f"sensors[{k}].frames[{number}].points.timestamps", problem, count=len(odd))


def _file_times(frame: Any) -> Any:
    points = frame.get("points") if isinstance(frame, dict) else None
    times = points.get("timestamps") if isinstance(points, dict) else None
    return None if isinstance(times, RawBytes) else times


def _wraps(raw: RawTimes, zero_ns: int) -> int:
    """How often microseconds in 32 bits have run over between a frame's timestamp and its first point; 0 for not."""
    if not 0 <= raw.first_ns - zero_ns < _WRAP_NS:
        return 0
    late_ns = raw.timestamp_ns - raw.first_ns
    rotations = round(late_ns / _WRAP_NS)
    return rotations if abs(late_ns - rotations * _WRAP_NS) < _NEAR_NS else 0


def _all_equal(subject: Subject, frame: FrameInHand) -> Iterable[Hit]:
    if isinstance(frame.frame, LidarFrame):
        times = frame.frame.points.timestamps_ns
        if times is not None and len(times) > 1 and times.min() == times.max():
            problem = f"all {len(times)} are {int(times[0])} ns; they state nothing about the motion in the sweep"
            _note_observation(subject, "point-times-equal", frame, problem)
    return ()


def _outside_the_sweep(subject: Subject, frame: FrameInHand) -> Iterable[Hit]:
    if not isinstance(frame.frame, LidarFrame | RadarFrame):
        return ()
    times, sensor = frame.frame.points.timestamps_ns, frame.sensor
    if times is None or not len(times) or not isinstance(sensor, LidarSensor | RadarSensor):
        return ()
    start_ns, usual_ns = frame.frame.timestamp_ns, period_ns(sensor.frames.timestamps_ns)
    early, late = start_ns - int(times.min()), int(times.max()) - start_ns - 2 * usual_ns
    if max(early, late) > _ON_ANOTHER_CLOCK * usual_ns:
        return ()
    problem = None
    if early > _ROUNDING_NS:
        count = int(np.count_nonzero(times < start_ns))
        problem = f"{count} of {len(times)} points lie before their frame, by up to {seconds(early)}"
    elif late > 0:
        problem = f"points reach to {seconds(late)} beyond the end of the next sweep"
    if problem is not None:
        _note_observation(subject, "point-times-frame", frame, problem)
    return ()


# fmt: off
POINT_TIME_RULES: tuple[Rule, ...] = (
    Rule("point-times-width", ERROR, "Times of points are uint64 where the unit is the nanosecond, else uint32.",
         "Write the scene again: programs that follow the description read the bytes by the unit, not by the dtype.",
         find=_widths, fix=as_read),
    Rule("point-times-clock", WARNING, "Times of points are on the clock of their frames, in its unit.",
         "Write absolute times; in microseconds of 32 bits choose a time_offset, or write nanoseconds.",
         find=warnings_of_code("relative-point-times"), look=_not_on_the_clock,
         conclude=_observations_of("point-times-clock")),
    Rule("point-times-frame", HINT, "No point lies before its frame, nor after the next one.",
         "Timestamp frames at their earliest point: writing the scene does.", look=_outside_the_sweep,
         conclude=_observations_of("point-times-frame")),
    Rule("point-times-equal", HINT, "Points of a sweep have times of their own.",
         "Leave the times out if the sensor gives none; with them, the motion during a sweep can be undone.",
         look=_all_equal, conclude=_observations_of("point-times-equal")),
)
# fmt: on

_LEAST_TOLERANCE_NS = 1_000_000
"""Times are written in microseconds and images are moved by half an exposure: a millisecond is no difference."""

_BESIDE_NS = 1_000_000_000  # what lies no farther than a second from the scene was cut off with it, or comes after it
_SAME_IMAGE = 4  # a time within this part of an image's interval means that image


def _timed_parts(subject: Subject) -> PartTable:
    """Everything of annotations that has timestamps, attributes and poses included."""
    return subject.table("timed parts of annotations", _all_timed_parts)


def _all_timed_parts(subject: Subject) -> PartTable:
    entries: list[tuple[int, str, Any]] = [
        (int(number), suffix, part)
        for table in (annotation_parts(subject, kind) for kind in PART_KINDS)
        for number, suffix, part in zip(table.numbers, table.suffixes, table.parts, strict=True)
    ]
    for number, annotation in enumerate(subject.scene.annotations):
        for k, attribute in enumerate(getattr(annotation, "attributes", ())):
            if attribute.timestamps_ns is not None:
                entries.append((number, f".attributes[{k}]", attribute))
        poses = annotation.poses if isinstance(annotation, LocalizationAdjustment | CameraCalibration) else None
        if poses is not None:
            entries.append((number, ".poses", poses))
    return PartTable.of(entries)


def _not_increasing(subject: Subject) -> Iterator[Hit]:
    table = _timed_parts(subject)
    times = table.timestamps_ns
    bad = np.zeros(len(times), bool)
    bad[1:] = (times[1:] <= times[:-1]) & table.inner

    def state(row: int) -> str:
        return f"{times[row]} ns after {times[row - 1]} ns; expected later times than those before"

    yield from table.hits(subject, bad, state, within=".timestamps")
    for k, attribute in enumerate(subject.scene.attributes):
        own = attribute.timestamps_ns
        rows = [] if own is None else np.flatnonzero(own[1:] <= own[:-1]).tolist()
        if own is not None and rows:
            row = rows[0] + 1
            problem = f"{own[row]} ns after {own[row - 1]} ns; expected later times than those before"
            yield Hit(f"attributes[{k}].timestamps[{row}]", problem, count=len(rows))


def _sorted_times(scene: Scene) -> Scene:
    """Sort paths by time and drop repeated rows; a path with two different rows at one time stays as it is."""
    return with_each(with_each(scene, "annotations", _with_sorted_parts), "attributes", _ordered)


_PARTS = ("path", "paths", "activations", "projections", "attributes")


def _with_sorted_parts(annotation: Any) -> Any:
    changed = {}
    for name in _PARTS:
        part = getattr(annotation, name, None)
        ordered = _ordered(part)
        if ordered is not part:
            changed[name] = ordered
    return replace(annotation, **changed) if changed else annotation


def _ordered(part: Any) -> Any:
    if isinstance(part, tuple):
        inner = tuple(_ordered(item) for item in part)
        return part if all(new is old for new, old in zip(inner, part, strict=True)) else inner
    times = getattr(part, "timestamps_ns", None)
    if times is None or len(times) < 2 or (times[1:] > times[:-1]).all():
        return part
    columns = [getattr(part, name) for name in TIMED_COLUMNS[type(part)] if getattr(part, name) is not None]
    if any(len(column) != len(times) for column in columns):
        return part
    rows = _rows_in_order(times, columns)
    return part if rows is None else select_rows(part, np.array(rows))


def _rows_in_order(times: Int64Array, columns: Sequence[Any]) -> list[int] | None:
    """The rows by time, each time once; None where two rows of one time differ."""
    rows: list[int] = []
    for row in np.argsort(times, kind="stable").tolist():
        if not rows or times[row] != times[rows[-1]]:
            rows.append(row)
        elif any(not _alike(column[row], column[rows[-1]]) for column in columns):
            return None
    return rows


def _alike(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=True)
    return bool(one == other)


def _empty(subject: Subject) -> Iterator[Hit]:
    table = _timed_parts(subject)
    for part in np.flatnonzero(np.diff(table.starts) == 0).tolist():
        if table.suffixes[part].startswith(".path"):
            yield Hit(table.location(subject, part), "no keyframes; expected at least one")
    for path, annotation in subject.annotations_of(PointsAnnotation):
        if not annotation.paths:
            yield Hit(f"{path}.paths", "no points; expected at least one")


def _bounds(subject: Subject) -> tuple[int, int] | None:
    """When annotations may begin and end [ns]: within the sensors' times and one sweep more at each end."""
    span = subject.table("the scene's time", lambda inner: time_span(inner.scene))
    if span is None:
        return None
    period_ns = scene_period_ns(subject.scene)
    return max(span[0] - period_ns, -(2**63)), min(span[1] + period_ns, 2**63 - 1)


def _outside(subject: Subject) -> Iterator[Hit]:
    """Find what lies outside as a whole, and not just beside the scene."""
    bounds, table = _bounds(subject), _timed_parts(subject)
    if bounds is None:
        return
    for part in np.flatnonzero(np.diff(table.starts) > 0).tolist() if _may_be_outside(table, bounds) else ():
        times = table.timestamps_ns[table.starts[part] : table.starts[part + 1]]
        outside = _is_outside(int(times.min()), int(times.max()), bounds)
        if outside and not _holds_always(subject, table, part):
            nearest = int(times.min()) if times.min() > bounds[1] else int(times.max())
            yield Hit(f"{table.location(subject, part)}.timestamps", _stated_outside(nearest, bounds), len(times))
    for path, event in subject.annotations_of(EventAnnotation):
        length_ns = event.duration_ns or 0
        stop_ns = event.start_ns + (int(length_ns) if 0 < length_ns < np.inf else 0)
        if _is_outside(event.start_ns, stop_ns, bounds):
            yield Hit(f"{path}.start", _stated_outside(event.start_ns, bounds))


def _is_outside(first_ns: int, last_ns: int, bounds: tuple[int, int]) -> bool:
    return first_ns > bounds[1] + _BESIDE_NS or last_ns < bounds[0] - _BESIDE_NS


def _may_be_outside(table: PartTable, bounds: tuple[int, int]) -> bool:
    """Whether any time lies that far out; most scenes need no look at each part."""
    times = table.timestamps_ns
    return len(times) > 0 and _is_outside(int(times.max()), int(times.min()), bounds)


def _beyond(subject: Subject) -> Iterator[Hit]:
    """Count the parts that reach beyond the scene, or lie just beside it, and name the one that reaches farthest."""
    bounds, table = _bounds(subject), _timed_parts(subject)
    if bounds is None:
        return
    times = table.timestamps_ns
    rows = np.flatnonzero((times < bounds[0]) | (times > bounds[1]))
    parts = np.searchsorted(table.starts, rows, side="right") - 1
    reported = {
        part
        for part in np.unique(parts).tolist()
        if not _holds_always(subject, table, part)
        and not _part_is_outside(table, part, bounds)
        and not isinstance(table.parts[part], Poses)  # corrections have poses around what they correct
    }
    rows = rows[np.isin(parts, list(reported))]
    if len(rows):
        far = times[rows].astype(np.float64)  # differences of int64 may be none of int64
        row = int(rows[np.argmax(np.maximum(bounds[0] - far, far - bounds[1]))])
        part = int(np.searchsorted(table.starts, row, side="right") - 1)
        others = f"; of {len(reported)} that reach beyond, it reaches farthest" if len(reported) > 1 else ""
        location = f"{table.location(subject, part)}.timestamps[{row - int(table.starts[part])}]"
        yield Hit(location, _stated_outside(int(times[row]), bounds) + others, count=len(reported))


def _part_is_outside(table: PartTable, part: int, bounds: tuple[int, int]) -> bool:
    times = table.timestamps_ns[table.starts[part] : table.starts[part + 1]]
    return _is_outside(int(times.min()), int(times.max()), bounds)


def _holds_always(subject: Subject, table: PartTable, part: int) -> bool:
    """Whether a part holds at all times: of something that is stationary, or a static attribute."""
    annotation, found = subject.scene.annotations[int(table.numbers[part])], table.parts[part]
    return bool(getattr(annotation, "stationary", None)) or (isinstance(found, AttributePath) and bool(found.static))


def _stated_outside(time_ns: int, bounds: tuple[int, int]) -> str:
    first_ns, last_ns = bounds
    away = (first_ns - time_ns if time_ns < first_ns else time_ns - last_ns) / 1e9
    side = "before the scene begins" if time_ns < first_ns else "after the scene ends"
    return f"{away:.3f} s {side} ({time_ns} ns; the sensors' times are {first_ns} to {last_ns} ns)"


def _negative_durations(subject: Subject) -> Iterator[Hit]:
    for path, event in subject.annotations_of(EventAnnotation):
        if event.duration_ns is not None and not event.duration_ns >= 0:
            yield Hit(f"{path}.duration", f"{event.duration_ns} ns; expected a duration of 0 or more")
    for path, cuboid in subject.annotations_of(CuboidAnnotation):
        for k, activation in enumerate(cuboid.activations):
            bad = [row for row, length in enumerate(activation.durations_ns or ()) if not length >= 0]
            if bad:
                length = (activation.durations_ns or ())[bad[0]]
                location = f"{path}.activations[{k}].durations[{bad[0]}]"
                yield Hit(location, f"{length} ns; expected a duration of 0 or more", count=len(bad))


def _without_image(subject: Subject) -> Iterator[Hit]:
    for table in (annotation_parts(subject, "projections"), annotation_parts(subject, "point_projections")):
        times_ns, bad = table.timestamps_ns, np.zeros(len(table.timestamps_ns), bool)
        for camera, rows in camera_rows(subject, table):
            bad[rows] = _far_from_images(camera.images.timestamps_ns, times_ns[rows])

        def state(row: int, times_ns: Int64Array = times_ns) -> str:
            return f"the camera has no image at {times_ns[row]} ns"

        yield from table.hits(subject, bad, state, within=".timestamps")


def _far_from_images(images_ns: Int64Array, times_ns: Int64Array) -> BoolArray:
    if len(images_ns) == 0:
        return np.zeros(len(times_ns), bool)
    images_ns = np.sort(images_ns)
    interval_ns = int(np.median(np.diff(images_ns))) if len(images_ns) > 1 else 0
    after = np.searchsorted(images_ns, times_ns)
    before_ns = times_ns - images_ns[(after - 1).clip(0)]
    after_ns = images_ns[after.clip(max=len(images_ns) - 1)] - times_ns
    away_ns = np.minimum(np.abs(before_ns), np.abs(after_ns))
    far: BoolArray = away_ns > max(_LEAST_TOLERANCE_NS, interval_ns // _SAME_IMAGE)
    return far


# fmt: off
ANNOTATION_TIME_RULES: tuple[Rule, ...] = (
    Rule("annotation-times-increasing", ERROR,
         "The keyframes of a path, and the times of activations, projections and attributes, those of the scene "
         "among them, strictly increase.", "Sort them by time; of two at one time, decide which is meant.",
         find=_not_increasing, fix=_sorted_times),
    Rule("annotation-path-empty", WARNING, "Every path has at least one keyframe.",
         "Give it keyframes, or take the annotation out.", find=_empty),
    Rule("annotation-outside-scene", WARNING, "No annotation lies outside the time of the scene by more than a second.",
         "Look whether the annotations count time in another unit or from another start than the sensors.",
         find=_outside),
    Rule("annotation-beyond-scene", HINT, "Annotations lie within the time of the scene, give or take one sweep.",
         "Cut the scene with its annotations (`sceneloom edit crop`) if the rest is of no use.", find=_beyond),
    Rule("annotation-duration", ERROR, "Events and activations end no sooner than they begin.",
         "Set the duration to how long it lasts.", find=_negative_durations),
    Rule("projection-without-image", WARNING, "The times of a projection are times of images of its camera.",
         "Project at the times of the images.", find=_without_image),
)
# fmt: on
