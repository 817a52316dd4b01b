"""Rules about the times of a recording's streams: their order, their rates, their gaps, and that they run together."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.checks.reading import as_read
from sceneloom.checks.recordings.repaired_streams import without_repetitions
from sceneloom.checks.recordings.streams import Kind, Stream, location, location_in_file, streams_of
from sceneloom.checks.rule import Find, Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.formats.recording.column_arrays import line_seconds
from sceneloom.scene.findings import Severity

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
            yield Hit(location_in_file(stream, row), problem, len(back))
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


def _gaps(*, irregular: bool) -> Find:
    def find(subject: Subject) -> Iterator[Hit]:
        for stream in streams_of(subject):
            period = stream.period
            if period is None or (stream.kind in _IRREGULAR) is not irregular:
                continue
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
    """Samples that are missing one by one; where they are many, the stream is uneven.

    And of images all are reported.
    """
    for stream in streams_of(subject):
        period = stream.period
        if (
            period is None
            or stream.kind in _IRREGULAR | _FRAMES
            or _off(stream, period).mean() > JITTER_SHARE
        ):
            continue
        more = stream.intervals - period
        lacking = np.flatnonzero(
            (more > FRAME_GAP_PERIODS * period) & (more <= _gap_threshold(stream, period))
        )
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
        for stream in streams_of(subject):
            period = stream.period
            if period is None or (stream.kind in _IRREGULAR) is not irregular:
                continue
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
    judged = [
        (rate, *RATES_HZ[stream.kind]) for stream, rate in rates.items() if RATES_HZ[stream.kind][0] > 0
    ]
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


RULES: tuple[Rule, ...] = (
    Rule(
        "lines-in-order",
        Severity.WARNING,
        "The lines of a recording stand in the order of their times.",
        "Sort the lines by time; software that replays them in the order of the file drops what comes late.",
        find=_out_of_order,
        fix=as_read,
    ),
    Rule(
        "stream-times-unique",
        Severity.WARNING,
        "No two samples, images or poses of a stream have one time.",
        "Leave one of them out, or write times with all their digits; `--fix` leaves out what stands there twice.",
        find=_of_one_time,
        fix=without_repetitions,
    ),
    Rule(
        "stream-gaps",
        Severity.WARNING,
        "No interval of a recording's stream exceeds the usual one by more than 0.25 s and 10 intervals; of images "
        "and sweeps, by 0.75 intervals where at most 5 % do.",
        "See whether samples were lost: a full disk, a full buffer, a loose cable.",
        find=_gaps(irregular=False),
    ),
    Rule(
        "samples-lost",
        Severity.HINT,
        "No interval of the IMU, of a magnetometer or of a barometer is longer than 1.75 usual ones.",
        "See whether single samples were lost; what integrates them has to go by their times.",
        find=_single_losses,
    ),
    Rule(
        "stream-outages",
        Severity.HINT,
        "No interval between fixes or poses exceeds the usual one by more than 0.25 s and 10 intervals.",
        "Compute with it where these are relied on: there was no reception, or tracking was lost.",
        find=_gaps(irregular=True),
    ),
    Rule(
        "stream-jitter",
        Severity.WARNING,
        "At most 5 % of a stream's intervals are off the usual one by more than a fifth.",
        "Timestamp samples when they are measured, not when they arrive.",
        find=_uneven(irregular=False),
    ),
    Rule(
        "stream-uneven",
        Severity.HINT,
        "At most 5 % of the intervals between fixes or poses are off the usual one by more than a fifth.",
        "Timestamp fixes and poses with the time that they are for, not with that of their arrival.",
        find=_uneven(irregular=True),
    ),
    Rule(
        "stream-rate",
        Severity.WARNING,
        "Streams come at rates that sensors have: cameras and lidars at 1 to 100 Hz, accelerometer and gyroscope at 50 "
        "to 10000, magnetometer and barometer at 1 to 1000, fixes at up to 100, poses at 1 to 10000.",
        "See whether times are seconds; of a slow IMU, record it at its own rate.",
        find=_wrong_rates,
    ),
    Rule(
        "streams-together",
        Severity.WARNING,
        "All streams of a recording start and end within 5 s of each other.",
        "See whether all are on one clock, and whether one of them was cut off.",
        find=_apart,
    ),
)
