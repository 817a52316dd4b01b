"""Read a log of NMEA 0183 as a scene with one satellite receiver.

Source: NMEA 0183 version 4.11, sentences GGA, GST and RMC.
"""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np

from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import read_bytes
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.scene import Scene
from sceneloom.warnings import WarningKind

_FIELDS = {"GGA": 14, "GST": 8, "RMC": 9}
"""The sentences that are used, and how many fields they have at least."""

_RANGE_ERRORS = {1: 2.0, 2: 1.0, 3: 1.0, 4: 0.05, 5: 0.5}
"""Errors of ranges [m] by GGA's quality (autonomous, with corrections, PPS, ambiguities fixed or not), which times HDOP
are the horizontal error. Source: budgets as in Kaplan and Hegarty 2017, "Understanding GPS/GNSS", 10.2; as claimed."""

_LARGEST = 1e6  # no time, angle, height or deviation is larger
_NS, _DAY_NS = 1_000_000_000, 86_400_000_000_000


@dataclass(frozen=True, slots=True)
class _Sentence:
    """A sentence that is used: its kind, its fields without the address, and the number of its line."""

    kind: str
    fields: list[str]
    line: int


def read_nmea(path: Path, *, lenient: bool = False) -> Scene:
    """Read the fixes of a log: GGA, or RMC where there is none, with the accuracy of GST, else by HDOP and quality.

    Args:
        lenient: leave broken sentences out, with a count.

    Raises:
        DataError: a sentence that is used is broken, or there is no position.
    """
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        sensor = _fixes(path, ledger)
    return Scene((sensor,), source=str(path), format="nmea", warnings=ledger.warnings)


def _sentences(path: Path, ledger: Ledger, broken_dates: Counter[str]) -> Iterator[_Sentence]:
    """The sentences that are used, in order; others are counted."""
    unused: Counter[str] = Counter()
    for number, raw in enumerate(read_bytes(path).split(b"\n"), 1):
        start = raw.rfind(b"$")
        text = raw[start:].strip().decode("ascii", "replace") if start >= 0 else ""
        body, star, checksum = text[1:].partition("*")
        address, *fields = body.split(",")
        kind = address[2:]
        if len(address) != 5 or kind not in _FIELDS:
            if raw.strip():
                unused[address if text else "lines that are no sentences"] += 1
            continue
        found = checksum_of(body)
        if not star or checksum.upper() != found:
            if kind == "RMC" and len(fields) > 8:
                broken_dates[fields[8]] += 1
            problem = f"{text[:90]!r}; expected the checksum *{found}"
            ledger.fault("nmea-sentence", DataError(path, f"line {number}", problem))
        elif len(fields) < _FIELDS[kind]:
            problem = f"{text[:90]!r}; expected at least {_FIELDS[kind]} fields"
            ledger.fault("nmea-sentence", DataError(path, f"line {number}", problem))
        else:
            yield _Sentence(kind, fields, number)
    if unused:
        message = f"not used: {', '.join(f'{name[:20]} ({count})' for name, count in unused.most_common(12))}"
        ledger.note(WarningKind.SKIPPED, "nmea-sentences-not-used", str(path), message, count=unused.total())


@dataclass(slots=True)
class _Log:
    """What a log has, by nanoseconds since the midnight before its first time."""

    fixes: dict[int, list[float]] = field(default_factory=dict)  # of GGA: degrees, height, undulation, accuracy [m]
    courses: dict[int, list[float]] = field(default_factory=dict)  # the same of RMC
    noise: dict[int, list[float]] = field(default_factory=dict)  # of GST: deviations north, east, up [m]
    first_day: int | None = None  # days since 1970 of that midnight
    without: int = 0  # GGA sentences without a position
    last_ns: int | None = None

    def add(self, one: _Sentence) -> None:
        """Take a sentence.

        Raises:
            ValueError: a field is wrong.
        """
        time_ns = time_of_day(one.fields[0])
        if time_ns is None:
            return
        if self.last_ns is not None:  # the day on which it is nearest to the time before
            time_ns += round((self.last_ns - time_ns) / _DAY_NS) * _DAY_NS
        self.last_ns = time_ns
        if one.kind == "GST":
            self.noise[time_ns] = [_number(text, "a deviation") for text in one.fields[5:8]]
        elif one.kind == "RMC":
            position = position_of(one.fields[2:6])
            if one.fields[8] and self.first_day is None:
                self.first_day = day_of(one.fields[8]) - time_ns // _DAY_NS
            if one.fields[1] == "A" and position is not None:
                self.courses[time_ns] = [*position, *3 * [math.nan]]
        else:
            position, quality = position_of(one.fields[1:5]), int(one.fields[5] or 0)
            if quality == 0 or position is None:
                self.without += 1
                return
            height, undulation = (_number(one.fields[k], "metres") for k in (8, 10))
            accuracy = _RANGE_ERRORS.get(quality, math.nan) * _number(one.fields[7], "HDOP") / math.sqrt(2.0)
            self.fixes[time_ns] = [*position, height, undulation, accuracy]


def _fixes(path: Path, ledger: Ledger) -> GnssSensor:
    log, broken_dates = _Log(), Counter[str]()
    for one in _sentences(path, ledger, broken_dates):
        try:
            log.add(one)
        except ValueError as error:
            ledger.fault("nmea-sentence", DataError(path, f"line {one.line}", f"{one.kind}: {error}"))
    found, location = log.fixes or log.courses, str(path)
    if not found:
        raise DataError(path, "", f"no GGA or RMC sentence has a position ({log.without} GGA without); expected one")
    day = log.first_day
    if day is None:
        day = _most_frequent_day(broken_dates)
        said = "is that of sentences with wrong checksums" if day else "was taken as 1970-01-01"
        ledger.note(WarningKind.ASSUMED, "nmea-date", location, f"no sound RMC sentence has the date, which {said}")
    if log.without:
        message = "GGA sentences without a position"
        ledger.note(WarningKind.SKIPPED, "nmea-without-position", location, message, count=log.without)
    times = np.array(sorted(found), np.int64)
    table = np.array([found[time] for time in times.tolist()])
    heights, undulations, by_hdop = table[:, 2:].T
    flat = np.isfinite(heights) & np.isnan(undulations)
    if flat.any():
        message = "heights above the geoid, without its undulation, were taken as above the ellipsoid"
        ledger.note(WarningKind.ASSUMED, "nmea-height", location, message, count=int(flat.sum()))
    deviations = np.array([log.noise.get(time, 3 * [math.nan]) for time in times.tolist()])
    across = np.sqrt((deviations[:, :2] ** 2).mean(axis=1))
    assumed = np.isnan(across) & np.isfinite(by_hdop)
    if assumed.any():
        message = "without GST the accuracy was taken from HDOP and the quality"
        ledger.note(WarningKind.ASSUMED, "nmea-accuracy", location, message, count=int(assumed.sum()))
    positions = np.column_stack([table[:, :2], heights + np.where(flat, 0.0, undulations)])
    return GnssSensor(
        "gnss", day * _DAY_NS + times, positions, np.where(assumed, by_hdop, across), deviations[:, 2].copy()
    )


def checksum_of(body: str) -> str:
    """The two hexadecimal digits that follow `*` in a sentence, of what stands between `$` and it."""
    return f"{reduce(xor, body.encode('ascii', 'replace'), 0):02X}"


def _number(text: str, what: str) -> float:
    """The number of a field, NaN where it is empty."""
    value = float(text) if text else math.nan
    if abs(value) > _LARGEST or "_" in text:
        raise ValueError(f"{text!r}; expected {what}, or nothing")
    return value


def time_of_day(text: str) -> int | None:
    """Nanoseconds since midnight of `hhmmss.ss`, None where it is empty; ValueError where it is none."""
    if not text:
        return None
    hours, minutes, seconds = int(text[:2]), int(text[2:4]), _number(text[4:], "seconds")
    if not (text[:4].isdigit() and hours < 24 and minutes < 60 and 0.0 <= seconds < 61.0):
        raise ValueError(f"time {text!r}; expected hhmmss.ss")
    return (hours * 3600 + minutes * 60) * _NS + round(seconds * _NS)


def position_of(fields: list[str]) -> tuple[float, float] | None:
    """Latitude and longitude [deg] of `ddmm.mm,N,dddmm.mm,E`, None where one is empty; ValueError where one is none."""
    if not all(fields):
        return None
    degrees = []
    for text, half, signs, most in zip(fields[::2], fields[1::2], ("NS", "EW"), (90.0, 180.0), strict=True):
        value = _number(text, "ddmm.mm")
        angle = value // 100.0 + (value % 100.0) / 60.0
        if half not in signs or value % 100.0 >= 60.0 or not 0.0 <= angle <= most:
            problem = f"expected degrees and minutes, then {signs[0]} or {signs[1]}"
            raise ValueError(f"position {text!r}, {half!r}; {problem}")
        degrees.append(angle if half == signs[0] else -angle)
    return degrees[0], degrees[1]


def day_of(text: str) -> int:
    """Days since 1970 of `ddmmyy`, ValueError where it is none; GPS began in 1980, years below are of this century."""
    if len(text) != 6 or not text.isdigit():
        raise ValueError(f"date {text!r}; expected ddmmyy")
    year = int(text[4:])
    moment = datetime(year + (2000 if year < 80 else 1900), int(text[2:4]), int(text[:2]), tzinfo=UTC)
    return (moment - datetime(1970, 1, 1, tzinfo=UTC)).days


def _most_frequent_day(dates: Counter[str]) -> int:
    for text, _ in dates.most_common(1):
        try:
            return day_of(text)
        except ValueError:
            break
    return 0
