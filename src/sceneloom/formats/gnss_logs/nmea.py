"""Sentences of NMEA 0183: fields, dates, and what a log of them says of each time.

Source: NMEA 0183 version 4.11 (DTM to ZDA); u-blox M8 protocol specification, `PUBX,00` and `PUBX,04`; the attitude
sentence `PASHR` as receivers with inertial units send it: time, heading, roll, pitch, heave, then their deviations.
"""

import math
from collections import Counter
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import reduce
from operator import xor

RANGE_ERRORS = {1: 2.0, 2: 1.0, 3: 1.0, 4: 0.05, 5: 0.5}
"""Errors of ranges [m] by GGA's quality (autonomous, with corrections, PPS, ambiguities fixed or not), which times HDOP
are the horizontal error. Source: budgets as in Kaplan and Hegarty 2017, "Understanding GPS/GNSS", 10.2; as claimed."""

LEAST_FIELDS = {
    "GGA": 14, "GNS": 12, "RMC": 9, "GLL": 5, "GST": 8, "GSA": 17, "ZDA": 4, "HDT": 1, "THS": 2, "PASHR": 5,
    "PUBX,00": 17, "PUBX,04": 2,
}  # fmt: skip
"""The sentences that are used, and how many fields they have at least."""

_MODES = {"R": 4, "F": 5, "D": 2, "P": 3, "A": 1, "E": 6, "M": 7, "S": 8}
"""GGA's quality by the letters of GNS, the best of which counts."""

_PUBX_WITHOUT = frozenset({"NF", "TT"})  # `navStat` of no fix, and of time alone
_LARGEST = 1e6  # no time, angle, height or deviation is larger
_NS, DAY_NS = 1_000_000_000, 86_400_000_000_000
_UNKNOWN = math.nan


@dataclass(frozen=True, slots=True)
class Fix:
    """A position of a receiver.

    Attributes:
        latitude, longitude: [deg].
        height: [m], above the geoid where there is an undulation, NaN where not reported.
        undulation: of the geoid above the ellipsoid [m]; 0 of heights above the ellipsoid, NaN where not reported.
        across, up: deviations [m], of one horizontal direction and of the height, NaN where not reported.
        assumed: whether the deviations are those of a range times its dilution.
    """

    latitude: float
    longitude: float
    height: float = _UNKNOWN
    undulation: float = _UNKNOWN
    across: float = _UNKNOWN
    up: float = _UNKNOWN
    assumed: bool = False


@dataclass(slots=True)
class NmeaLog:
    """What the sentences of a log say, by nanoseconds since the midnight before its first time.

    Attributes:
        fixes: by sentence, then by time.
        noise: of GST: deviations north, east and up [m].
        dilutions: vertical ones, of GSA.
        attitudes: heading, roll and pitch [deg]; the last two NaN where only a heading is reported.
        first_day: days since 1970 of that midnight, or None.
        doubtful_days: days of sentences without a valid fix, or whose checksums are wrong.
        without: sentences without a position.
    """

    fixes: dict[str, dict[int, Fix]] = field(default_factory=dict)
    noise: dict[int, tuple[float, float, float]] = field(default_factory=dict)
    dilutions: dict[int, float] = field(default_factory=dict)
    attitudes: dict[int, tuple[float, float, float]] = field(default_factory=dict)
    first_day: int | None = None
    doubtful_days: Counter[int] = field(default_factory=Counter)
    without: int = 0
    _last_ns: int | None = None

    def add(self, kind: str, fields: list[str]) -> None:
        """Take a sentence of `LEAST_FIELDS`.

        Raises:
            ValueError: a field is wrong.
        """
        match kind:
            case "GSA":
                if self._last_ns is not None and (vertical := _number(fields[16], "VDOP")) > 0.0:
                    self.dilutions[self._last_ns] = vertical
            case "HDT" | "THS":
                valid = kind == "HDT" or fields[1] in "AE"
                heading = _angle(fields[0], "a heading")
                if self._last_ns is not None and valid and math.isfinite(heading):
                    self.attitudes.setdefault(self._last_ns, (heading, _UNKNOWN, _UNKNOWN))
            case "ZDA":
                date = "".join((fields[1], fields[2], fields[3][2:])) if all(fields[1:4]) else ""
                self._time(fields[0], date, sound=True)
            case "PUBX,04":
                self._time(fields[0], fields[1], sound=True)
            case "RMC":
                self._add_rmc(fields)
            case "GLL":
                time_ns = self._time(fields[4])
                position = position_of(fields[:4])
                if time_ns is not None and position is not None and (fields[5:6] or "A")[0] == "A":
                    self._put(kind, time_ns, Fix(*position))
            case _:
                self._add_timed(kind, fields)

    def _add_timed(self, kind: str, fields: list[str]) -> None:
        time_ns = self._time(fields[0])
        if time_ns is None:
            return
        match kind:
            case "GST":
                north, east, up = (_number(text, "a deviation") for text in fields[5:8])
                self.noise[time_ns] = north, east, up
            case "PASHR":
                heading, roll, pitch = (
                    _angle(fields[1], "a heading"),
                    *(_angle(text, "an angle") for text in fields[3:5]),
                )
                if math.isfinite(heading + roll + pitch):
                    self.attitudes[time_ns] = heading, roll, pitch
            case "PUBX,00":
                self._add_pubx(time_ns, fields)
            case _:  # GGA, GNS
                if kind == "GGA":
                    quality, dilution = int(fields[5] or 0), fields[7]
                else:
                    letters = set(fields[5])
                    quality, dilution = next((_MODES[one] for one in _MODES if one in letters), 0), fields[7]
                position = position_of(fields[1:5])
                if quality == 0 or position is None:
                    self.without += 1
                    return
                height, undulation = (_number(fields[k], "metres") for k in ((8, 10) if kind == "GGA" else (8, 9)))
                error = RANGE_ERRORS.get(quality, _UNKNOWN)
                across = error * _number(dilution, "HDOP") / math.sqrt(2.0)
                # `up` is the error of ranges, until the vertical dilution of its time is known
                self._put(kind, time_ns, Fix(*position, height, undulation, across, error, assumed=True))

    def _add_rmc(self, fields: list[str]) -> None:
        valid = fields[1] == "A"
        time_ns = self._time(fields[0], fields[8], sound=valid)
        position = position_of(fields[2:6])
        if time_ns is not None and valid and position is not None:
            self._put("RMC", time_ns, Fix(*position))

    def _add_pubx(self, time_ns: int, fields: list[str]) -> None:
        position = position_of(fields[1:5])
        if fields[6] in _PUBX_WITHOUT or position is None:
            self.without += 1
            return
        height, across, up = (_number(fields[k], "metres") for k in (5, 7, 8))
        self._put("PUBX,00", time_ns, Fix(*position, height, 0.0, across / math.sqrt(2.0), up))

    def _put(self, kind: str, time_ns: int, fix: Fix) -> None:
        self.fixes.setdefault(kind, {})[time_ns] = fix

    def _time(self, text: str, date: str = "", *, sound: bool = False) -> int | None:
        """The time of a sentence in nanoseconds since the first midnight, None where it has none."""
        time_ns = time_of_day(text)
        if time_ns is None:
            return None
        last_ns = self._last_ns
        if last_ns is not None:  # the day on which it is nearest to the time before
            time_ns += round((last_ns - time_ns) / DAY_NS) * DAY_NS
        if date:
            day = day_of(date)
            if not sound:
                self.doubtful_days[day - time_ns // DAY_NS] += 1
            elif self.first_day is None:
                self.first_day = day - time_ns // DAY_NS
            elif day - self.first_day > time_ns // DAY_NS:  # after a pause of days
                time_ns = (day - self.first_day) * DAY_NS + time_ns % DAY_NS
        self._last_ns = time_ns
        return time_ns


def kind_of(address: str, fields: list[str]) -> tuple[str, list[str]]:
    """The kind of a sentence, without its talker, and the fields behind; of an unknown one, its address."""
    if address == "PUBX" and fields:
        return f"PUBX,{fields[0]}", fields[1:]
    return (address[2:] if len(address) == 5 and address[0] != "P" else address), fields


def checksum_of(body: str) -> str:
    """The two hexadecimal digits that follow `*` in a sentence, of what stands between `$` and it."""
    return f"{reduce(xor, body.encode('ascii', 'replace'), 0):02X}"


def _number(text: str, what: str) -> float:
    """The number of a field, NaN where it is empty."""
    value = float(text) if text else math.nan
    if abs(value) > _LARGEST or "_" in text:
        raise ValueError(f"{text!r}; expected {what}, or nothing")
    return value


def _angle(text: str, what: str) -> float:
    """The angle [deg] of a field, NaN where it is empty."""
    value = _number(text, what)
    if abs(value) > 360.0:
        raise ValueError(f"{text!r}; expected {what} within 360 degrees, or nothing")
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
