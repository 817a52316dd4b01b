"""Rules about the times of frames and images, and of the scene's clock."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sceneloom.checks.reordering import with_sorted_frames
from sceneloom.checks.rule import Find, Hit, Rule, unless_recording
from sceneloom.checks.sensor_times import frames_path, period_ns, seconds, timestamps_of
from sceneloom.checks.subject import Subject
from sceneloom.formats.sfs.times import chosen_offset_ns
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.findings import Severity
from sceneloom.scene.scene import Scene
from sceneloom.scene.span import time_span

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
                problem = f"{rate} frames a second; expected at most {HIGHEST_RATE_HZ}"
                yield Hit(frames_path(path, sensor), problem)


def _gaps(subject: Subject) -> Iterator[Hit]:
    for path, sensor in subject.sensors():
        timestamps_ns = timestamps_of(sensor)
        if len(timestamps_ns) < _FEWEST_FOR_A_RATE:
            continue
        intervals, usual = np.diff(timestamps_ns), period_ns(timestamps_ns)
        for k in np.flatnonzero(intervals > _GAP * usual).tolist():
            missing = round(intervals[k] / usual) - 1
            problem = (
                f"{seconds(intervals[k])} to the next frame, {seconds(usual)} usually; {missing} seem missing"
            )
            yield Hit(f"{frames_path(path, sensor)}[{k}]", problem, max(missing, 1))


def _doubled(subject: Subject) -> Iterator[Hit]:
    for path, sensor in subject.sensors():
        timestamps_ns = timestamps_of(sensor)
        if len(timestamps_ns) < _FEWEST_FOR_A_RATE:
            continue
        intervals, usual = np.diff(timestamps_ns), period_ns(timestamps_ns)
        for k in np.flatnonzero((intervals > 0) & (intervals < _DOUBLED * usual)).tolist():
            problem = f"{seconds(intervals[k])} after the frame before, {seconds(usual)} usually"
            yield Hit(f"{frames_path(path, sensor)}[{k + 1}]", problem)


def _uneven(subject: Subject) -> Iterator[Hit]:
    for path, sensor in subject.sensors():
        timestamps_ns = timestamps_of(sensor)
        usual = period_ns(timestamps_ns)
        intervals = np.diff(timestamps_ns)
        plain = intervals[(intervals <= _GAP * usual) & (intervals >= _DOUBLED * usual)]
        if len(plain) < _FEWEST_FOR_A_RATE:
            continue
        spread_ns = float(np.std(plain))
        if spread_ns > _JITTER * usual:
            problem = f"intervals of {seconds(usual)} vary by {seconds(spread_ns)} (one standard deviation)"
            yield Hit(frames_path(path, sensor), problem)


def _fps_differs(subject: Subject) -> Iterator[Hit]:
    for path, sensor in subject.sensors():
        if not isinstance(sensor, CameraSensor | DepthCameraSensor) or sensor.fps is None:
            continue
        if len(timestamps_of(sensor)) < 2:
            continue
        rate = 1e9 / period_ns(timestamps_of(sensor))
        if abs(sensor.fps - rate) > _FPS_TOLERANCE * rate:
            problem = f"{sensor.fps:g}; the timestamps report {rate:.4g} images a second"
            yield Hit(f"{path}.video.fps", problem)


def _timestamps_are_dates(subject: Subject) -> Iterator[Hit]:
    """Whether a scene file counts from 1970, where its clock should begin near the scene."""
    span = _file_span(subject.scene)
    if span is not None and span[0] >= _EARLIEST_EPOCH_NS:
        after = f"{span[0] / 1e9:.0f} s after the clock's zero"
        yield Hit("time_offset", f"timestamps begin {after}; expected a time_offset that takes most of it")


def _starts_late(subject: Subject) -> Iterator[Hit]:
    span = _file_span(subject.scene)
    if span is not None and LATEST_START_NS < span[0] < _EARLIEST_EPOCH_NS:
        problem = f"timestamps begin {seconds(span[0])} after the clock's zero; expected at most {seconds(LATEST_START_NS)}"
        yield Hit("time_offset", problem)


def _file_span(scene: Scene) -> tuple[int, int] | None:
    """First and last time of a scene file on its own clock [ns]."""
    span = time_span(scene) if scene.format == "sfs" else None
    return None if span is None else (span[0] - scene.time_offset_ns, span[1] - scene.time_offset_ns)


def _with_time_offset(scene: Scene) -> Scene:
    span = time_span(scene)
    return scene if span is None else replace(scene, time_offset_ns=chosen_offset_ns(span[0]))


RULES: tuple[Rule, ...] = (
    Rule(
        "frame-times-increasing",
        Severity.ERROR,
        "Frames and images of a sensor stand in the order of their times.",
        "Sort them by time.",
        find=_out_of_order(in_videos=False),
        fix=with_sorted_frames,
    ),
    Rule(
        "video-times-increasing",
        Severity.ERROR,
        "The timestamps of a video stand in the order of its images.",
        "Find out which images the timestamps belong to.",
        find=_out_of_order(in_videos=True),
    ),
    Rule(
        "frame-times-unique",
        Severity.ERROR,
        "No two frames or images of a sensor have one time.",
        "Keep one of them, or give each the time at which it was measured.",
        find=unless_recording(_of_one_time),
    ),
    Rule(
        "frame-rate",
        Severity.WARNING,
        "A sensor has at most 100 frames a second on average.",
        "See whether the timestamps are in the unit that `time_unit` says.",
        find=unless_recording(_too_many_a_second),
    ),
    Rule(
        "frame-doubled",
        Severity.WARNING,
        "No frame follows the one before within a tenth of the usual interval.",
        "See whether a frame was recorded twice, or timestamped when it was received and not when it was measured.",
        find=_doubled,
    ),
    Rule(
        "frame-gaps",
        Severity.WARNING,
        "The frames of a sensor follow each other without gaps.",
        "See whether frames were lost; programs that count frames to report the time will be off.",
        find=unless_recording(_gaps),
    ),
    Rule(
        "frame-jitter",
        Severity.HINT,
        "The intervals between frames are even.",
        "Timestamp frames when they are measured, not when they arrive.",
        find=unless_recording(_uneven),
    ),
    Rule(
        "video-fps",
        Severity.WARNING,
        "`fps` of a video agrees with the timestamps of its images, within 5 %.",
        "Leave `fps` out, or write what the timestamps report: the timestamps are what counts.",
        find=_fps_differs,
    ),
    Rule(
        "epoch-times",
        Severity.WARNING,
        "The timestamps of a scene file count from somewhere near its beginning, not from 1970.",
        "Take whole seconds off all timestamps and write them as `time_offset`; absolute times stay the same.",
        find=_timestamps_are_dates,
        fix=_with_time_offset,
    ),
    Rule(
        "late-start",
        Severity.HINT,
        "A scene file begins within 100 s of its clock's zero.",
        "Write a `time_offset`: timestamps of points in microseconds end after 71 minutes.",
        find=_starts_late,
        fix=_with_time_offset,
    ),
)
