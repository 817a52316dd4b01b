"""Rules about the times of the points of a sweep: on the scene's clock, and within the sweep."""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from sceneloom.checks.observations import note_observation, observations_of
from sceneloom.checks.reading import as_read
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.sensor_times import period_ns, seconds
from sceneloom.checks.subject import FrameInHand, Subject
from sceneloom.formats.sfs.container import RawBytes
from sceneloom.formats.sfs.times import READABLE_TICKS_NS, UINT32_MAX, FileClock, point_times_dtype
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.findings import Severity
from sceneloom.scene.point_times import PointTimes, RawTimes, timed_frame

_WRAP_NS = (UINT32_MAX + 1) * 1_000
"""What microseconds in 32 bits run over at [ns]."""

_NEAR_NS = 1_000_000_000

_ROUNDING_NS = 1_000
"""Timestamps in microseconds may be so late [ns]."""

_ON_ANOTHER_CLOCK = 100
"""Times so many periods away are not late, but of another clock, which another rule reports."""

_WHAT: dict[PointTimes, str] = {
    PointTimes.RELATIVE: "count from the frame's own timestamp; expected times on the scene's clock",
    PointTimes.OTHER_CLOCK: "are on another clock than the frame's timestamp",
    PointTimes.UNKNOWN: "are not those of a sweep at the frame's timestamp",
}


def _relative_in_file(subject: Subject) -> Iterator[Hit]:
    """What the reader of scene files has put right already."""
    for warning in subject.notes:
        if warning.code == "relative-point-times":
            yield Hit(warning.location, warning.message, warning.count)


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
        note_observation(subject, "point-times-clock", frame, "points.timestamps", problem)
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
            problem = (
                f"all {len(times)} are {int(times[0])} ns; they state nothing about the motion in the sweep"
            )
            note_observation(subject, "point-times-equal", frame, "points.timestamps", problem)
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
        note_observation(subject, "point-times-frame", frame, "points.timestamps", problem)
    return ()


RULES: tuple[Rule, ...] = (
    Rule(
        "point-times-width",
        Severity.ERROR,
        "Times of points are uint64 where the unit is the nanosecond, else uint32.",
        "Write the scene again: programs that follow the description read the bytes by the unit, not by the dtype.",
        find=_widths,
        fix=as_read,
    ),
    Rule(
        "point-times-clock",
        Severity.WARNING,
        "Times of points are on the clock of their frames, in its unit.",
        "Write absolute times; in microseconds of 32 bits choose a time_offset, or write nanoseconds.",
        find=_relative_in_file,
        look=_not_on_the_clock,
        conclude=observations_of("point-times-clock"),
    ),
    Rule(
        "point-times-frame",
        Severity.HINT,
        "No point lies before its frame, nor after the next one.",
        "Timestamp frames at their earliest point: writing the scene does.",
        look=_outside_the_sweep,
        conclude=observations_of("point-times-frame"),
    ),
    Rule(
        "point-times-equal",
        Severity.HINT,
        "Points of a sweep have times of their own.",
        "Leave the times out if the sensor gives none; with them, the motion during a sweep can be undone.",
        look=_all_equal,
        conclude=observations_of("point-times-equal"),
    ),
)
