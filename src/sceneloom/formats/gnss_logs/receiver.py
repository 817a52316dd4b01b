"""Read what a satellite receiver sends, NMEA 0183, UBX and RTCM 3 in any mixture, as a scene with one receiver.

Source: u-blox M8 and F9 interface descriptions (frames, checksum, NAV, ESF, RXM); RTCM 10403 (frames, CRC-24Q).
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import accumulate
from math import radians
from pathlib import Path
from struct import Struct
from types import MappingProxyType
from typing import BinaryIO

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import file_faults, open_file
from sceneloom.formats.gnss_logs.nmea import DAY_NS, LEAST_FIELDS, Fix, NmeaLog, checksum_of, day_of, kind_of
from sceneloom.geometry.euler import rotation_from_cuboid_angles
from sceneloom.geometry.geodesy import enu_from_geodetic
from sceneloom.geometry.rigid import quaternion_from_matrix
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.warnings import WarningKind

_NS, _MS_NS = 1_000_000_000, 1_000_000
_WEEK_MS = 604_800_000
_UNKNOWN = float("nan")


def read_log(path: Path, *, name: str, lenient: bool = False) -> Scene:
    """Read a log: one receiver, its inertial unit where the log has its measurements, and poses where it has attitudes.

    Of UBX the positions are those of NAV-HPPOSLLH, NAV-PVT or NAV-POSLLH, with the deviations of NAV-COV, else of the
    position's message; without such those of GGA, GNS or PUBX,00, whichever there are most of, else of RMC or GLL,
    with the deviations of GST, of PUBX,00, else by dilution and quality.

    Args:
        name: of the format.
        lenient: leave messages out whose checksum is right and whose fields are not, with a count.

    Raises:
        DataError: a message that is used is wrong, or there is no position.
    """
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        log = _Log(path, ledger)
        with file_faults(path), open_file(path) as file:
            log.take(file)
        return log.scene(name)


# frames

_START = re.compile(rb"\$[A-Z]|\xb5\x62|\xd3[\x00-\x03]")
_SENTENCE = re.compile(rb"\$([A-Z][ -#%-)+-~]{0,511})(?:\*([0-9A-Fa-f]{2}))?")
_SIGNED = re.compile(rb"\$[A-Z][ -#%-)+-~]*\*[0-9A-Fa-f]{2}")
_CHUNK, _LONGEST = 1 << 20, (1 << 16) + 8


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        value = byte << 16
        for _ in range(8):
            value = value << 1 ^ (0x1864CFB if value & 0x800000 else 0)
        table.append(value)
    return tuple(table)


_CRC = _crc_table()


def _crc_24q(data: bytes) -> int:
    value = 0
    for byte in data:
        value = (value << 8 & 0xFFFFFF) ^ _CRC[value >> 16 ^ byte]
    return value


def fletcher_8(data: bytes) -> bytes:
    """The two bytes that end a UBX frame, of its class, number, length and payload."""
    return bytes((sum(data) & 255, sum(accumulate(data)) & 255))


@dataclass(slots=True)
class _Frames:
    """Cuts a stream of bytes into messages, and counts what is none.

    Attributes:
        file: to be read on from its start.
        broken: what was cut or has a wrong checksum: how often, and the first place, by what it is.
        other: bytes of no message, blanks and ends of lines left out.
        line: of the message that was given last, counted in ends of lines.
        offset: of its first byte.
    """

    file: BinaryIO
    broken: dict[str, tuple[int, str]] = field(default_factory=dict)
    other: int = 0
    line: int = 1
    offset: int = 0
    _signed: bool = True
    unsigned: int = 0

    def _break(self, what: str, shown: str) -> None:
        count, first = self.broken.get(what, (0, shown))
        self.broken[what] = count + 1, first

    def messages(self) -> Iterator[tuple[str, bytes]]:
        """Give each message whose checksum is right.

        These are ("nmea", between `$` and `*`), ("ubx", class, number, payload) and ("rtcm", payload); and ("wrong",
        between `$` and `*`) are sentences whose checksum is not.
        """
        buffer, at, counted, base, ended = b"", 0, 0, 0, False
        while True:
            if not ended and len(buffer) - at < _LONGEST:
                more = self.file.read(_CHUNK)
                if base == 0 and not buffer:
                    self._signed = _SIGNED.search(more) is not None
                ended = not more
                self.line += buffer.count(b"\n", counted, at)
                buffer, base, at, counted = buffer[at:] + more, base + at, 0, 0
                continue
            found = _START.search(buffer, at)
            start = found.start() if found else len(buffer) if ended else max(at, len(buffer) - 1)
            self.other += len(buffer[at:start].strip(b" \t\r\n\0"))
            if found is None:
                at = start
                if ended:
                    return
                continue
            if not ended and len(buffer) - start < _LONGEST:
                at = start
                continue
            self.line += buffer.count(b"\n", counted, start)
            counted, self.offset = start, base + start
            kind, content, at = self._message(buffer, start)
            if kind:
                yield kind, content

    def _message(self, buffer: bytes, start: int) -> tuple[str, bytes, int]:
        """The message at a place, or "" and where to look on."""
        if buffer[start] == ord("$"):
            return self._sentence(buffer, start)
        if buffer[start] == 0xB5:
            stop = start + 8 + int.from_bytes(buffer[start + 4 : start + 6], "little")
            body = buffer[start + 2 : stop - 2]
            if stop <= len(buffer) and fletcher_8(body) == buffer[stop - 2 : stop]:
                return "ubx", body[:2] + body[4:], stop
            self._break("UBX frames cut or with wrong checksums", f"byte {self.offset}")
            return "", b"", start + 2
        stop = start + 6 + (int.from_bytes(buffer[start + 1 : start + 3], "big") & 1023)
        if stop > start + 7 and stop <= len(buffer):
            body = buffer[start : stop - 3]
            if _crc_24q(body) == int.from_bytes(buffer[stop - 3 : stop], "big"):
                return "rtcm", body[3:], stop
        self.other += 1
        return "", b"", start + 1

    def _sentence(self, buffer: bytes, start: int) -> tuple[str, bytes, int]:
        found = _SENTENCE.match(buffer, start)
        if found is None:  # cannot be: it begins with a letter
            return "", b"", start + 2
        body, stated = found.groups()
        shown = f"line {self.line}: {found[0].decode('ascii')[:90]!r}"
        if stated is not None:
            expected = checksum_of(body.decode("ascii"))
            if stated.upper() == expected.encode():
                return "nmea", body, found.end()
            self._break("sentences with wrong checksums", f"{shown}; expected the checksum *{expected}")
            return "wrong", body, found.end()
        if not self._signed and buffer[found.end() : found.end() + 1] in (b"\r", b"\n", b""):
            self.unsigned += 1
            return "nmea", body, found.end()
        self._break("sentences cut, or without a checksum", shown)
        return "", b"", found.end()


# UBX

_CLASSES = {
    0x01: "NAV", 0x02: "RXM", 0x04: "INF", 0x05: "ACK", 0x06: "CFG", 0x09: "UPD", 0x0A: "MON", 0x0B: "AID",
    0x0D: "TIM", 0x10: "ESF", 0x13: "MGA", 0x21: "LOG", 0x27: "SEC", 0x28: "HNR", 0x29: "NAV2",
}  # fmt: skip
_NAMES = {
    (0x01, 0x04): "DOP", (0x01, 0x12): "VELNED", (0x01, 0x22): "CLOCK", (0x01, 0x35): "SAT", (0x01, 0x61): "EOE",
    (0x02, 0x13): "SFRBX", (0x02, 0x14): "MEASX", (0x02, 0x15): "RAWX", (0x02, 0x32): "RTCM", (0x10, 0x10): "STATUS",
}  # fmt: skip
_DATE = Struct("<HBBBBB")
_LAYOUTS = {
    (0x01, 0x02): ("NAV-POSLLH", Struct("<I4i2I")),  # iTOW, lon, lat, height, hMSL, hAcc, vAcc
    (0x01, 0x03): ("NAV-STATUS", Struct("<IBB")),  # iTOW, gpsFix, flags
    (0x01, 0x05): ("NAV-ATT", Struct("<I4x3i3I")),  # iTOW, roll, pitch, heading, accuracies
    (0x01, 0x06): ("NAV-SOL", Struct("<IihBB")),  # iTOW, fTOW, week, gpsFix, flags
    (0x01, 0x07): ("NAV-PVT", Struct("<I7sBIiBBBB4i2I28xHH")),
    (0x01, 0x14): ("NAV-HPPOSLLH", Struct("<3xBI4i4b2I")),
    (0x01, 0x20): ("NAV-TIMEGPS", Struct("<IihbB")),  # iTOW, fTOW, week, leapS, valid
    (0x01, 0x21): ("NAV-TIMEUTC", Struct("<IIi7sB")),  # iTOW, tAcc, nano, date, valid
    (0x01, 0x36): ("NAV-COV", Struct("<IxBB9x6f")),  # iTOW, valid, valid, NN, NE, ND, EE, ED, DD
    (0x10, 0x02): ("ESF-MEAS", Struct("<IHH")),  # timeTag, flags, id
    (0x10, 0x03): ("ESF-RAW", Struct("<4x")),
    (0x10, 0x15): ("ESF-INS", Struct("<I4xI6i")),  # flags, iTOW, angular rates, accelerations
}
"""The messages that are used: name, and the fields that they begin with."""

_GPS_EPOCH_NS = int(np.datetime64("1980-01-06", "ns").astype(np.int64))
_LEAP_DAYS = np.array(
    [
        *("1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01", "1991-01-01"),
        *("1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01", "1999-01-01", "2006-01-01"),
        *("2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01"),
    ],
    "datetime64[ns]",
).astype(np.int64)
"""When GPS time went a second further ahead of UTC. Source: IERS Bulletin C."""


def utc_from_gps(gps_ns: Int64Array) -> Int64Array:
    """Nanoseconds since 1970 in UTC of such as GPS time counts them, which has no leap seconds."""
    leaps = np.searchsorted(_LEAP_DAYS + np.arange(1, len(_LEAP_DAYS) + 1) * _NS, gps_ns, side="right")
    return gps_ns - leaps.astype(np.int64) * _NS


LAST_WEEK = 10_000
"""No week of GPS time is later: that of 2171."""


def gps_time(week: int, second_ns: int) -> int:
    """Nanoseconds since 1970, as GPS time counts them, of a week and the nanoseconds in it."""
    return _GPS_EPOCH_NS + week * _WEEK_MS * _MS_NS + second_ns


_AXES = {14: ("gyroscope", 0), 13: ("gyroscope", 1), 5: ("gyroscope", 2),
         16: ("accelerometer", 0), 17: ("accelerometer", 1), 18: ("accelerometer", 2)}  # fmt: skip
"""Streams and axes by the type of a datum of ESF-MEAS and ESF-RAW."""

_SCALES = {"gyroscope": radians(2.0**-12), "accelerometer": 2.0**-10}
_SHORT_S = 60.0


@dataclass(slots=True)
class _Inertial:
    """Measurements of an inertial unit by its own ticks, and pairs of ticks and iTOW [ms] that came together."""

    values: dict[str, dict[int, list[float]]] = field(default_factory=lambda: {name: {} for name in _SCALES})
    pairs: list[tuple[int, int]] = field(default_factory=list)
    last: int | None = None
    other: int = 0

    def add(self, tick: int, word: int, kind: int) -> None:
        if self.last is not None:  # counters of 32 bits run over
            tick += round((self.last - tick) / 2**32) * 2**32
        self.last = tick
        if kind not in _AXES:
            self.other += 1
            return
        name, axis = _AXES[kind]
        number = (word & 0xFFFFFF) - (word << 1 & 0x1000000)
        self.values[name].setdefault(tick, [_UNKNOWN] * 3)[axis] = number * _SCALES[name]

    def streams(self, offset_ns: int, *, milliseconds: bool) -> dict[str, VectorSamples]:
        """The streams on the clock of the positions; none where nothing leads to it."""
        pairs = np.array(self.pairs, np.int64).reshape(-1, 2)
        if len(pairs) < 2 or not np.ptp(pairs[:, 0]):
            return {}
        ticks, tows = (pairs - pairs[0]).T.astype(np.float64)
        slope = 1.0
        if not milliseconds or np.ptp(tows) > _SHORT_S * 1e3:
            slope = float(np.polyfit(ticks, tows, 1)[0])
        start_ms = float(np.median(tows - slope * ticks))
        found = {}
        for name, by_tick in self.values.items():
            table = np.array(list(by_tick.values())).reshape(-1, 3)
            stamps = (np.array(list(by_tick), np.int64) - pairs[0, 0]) * slope + start_ms
            times = np.rint(stamps * _MS_NS).astype(np.int64) + offset_ns + int(pairs[0, 1]) * _MS_NS
            whole = np.isfinite(table).all(axis=1)
            times, rows = np.unique(times[whole], return_index=True)
            if len(times):
                found[name] = VectorSamples(read_only(times), read_only(table[whole][rows]))
        return found


@dataclass(slots=True)
class _UbxLog:
    """What UBX messages say, by iTOW [ms], counted on from the first week."""

    fixes: dict[str, dict[int, Fix]] = field(default_factory=dict)
    times: dict[int, int] = field(default_factory=dict)  # nanoseconds since 1970, of NAV-PVT
    covariances: dict[int, tuple[float, float]] = field(default_factory=dict)
    attitudes: dict[int, tuple[float, float, float]] = field(default_factory=dict)
    rates: dict[int, list[float]] = field(default_factory=dict)
    refused: set[int] = field(default_factory=set)  # NAV-STATUS and NAV-SOL say that there is no fix
    offsets: Counter[int] = field(default_factory=Counter)  # of UTC to iTOW, in whole milliseconds
    meas: _Inertial = field(default_factory=_Inertial)
    raw: _Inertial = field(default_factory=_Inertial)
    without: int = 0
    last_tow: int | None = None

    def add(self, name: str, layout: Struct, payload: bytes) -> None:
        """Take a message of `_LAYOUTS`.

        Raises:
            ValueError: it is too short, or a field is wrong.
        """
        if len(payload) < layout.size:
            raise ValueError(f"{len(payload)} bytes; expected at least {layout.size}")
        if name == "ESF-RAW":
            for start in range(4, len(payload) - 7, 8):
                word = int.from_bytes(payload[start : start + 4], "little")
                self.raw.add(int.from_bytes(payload[start + 4 : start + 8], "little"), word, word >> 24)
            return
        if name == "ESF-MEAS":
            tick, flags, _ = layout.unpack_from(payload)
            for start in range(8, min(8 + 4 * (flags >> 11), len(payload) - 3), 4):
                word = int.from_bytes(payload[start : start + 4], "little")
                self.meas.add(tick, word, word >> 24 & 63)
            return
        values = layout.unpack_from(payload)
        tow = values[{"NAV-HPPOSLLH": 1, "ESF-INS": 1}.get(name, 0)]
        if tow >= _WEEK_MS + 2000:
            raise ValueError(f"iTOW {tow} ms; expected less than a week")
        if self.last_tow is not None:
            tow += round((self.last_tow - tow) / _WEEK_MS) * _WEEK_MS
        if tow != self.last_tow:
            for unit in (self.meas, self.raw):
                if unit.last is not None:
                    unit.pairs.append((unit.last, tow))
        self.last_tow = tow
        self._take(name, tow, values)

    def _take(self, name: str, tow: int, values: tuple[float | int | bytes, ...]) -> None:
        v: tuple[int, ...] = values  # type: ignore[assignment]
        match name:
            case "NAV-POSLLH":
                self._put(name, tow, _fix(v[2], v[1], v[3] * 1e-3, v[5] * 1e-3, v[6] * 1e-3))
            case "NAV-HPPOSLLH":
                if v[0] & 1:
                    self.without += 1
                    return
                latitude, longitude, height = v[3] + v[7] * 1e-2, v[2] + v[6] * 1e-2, v[4] * 1e-3 + v[8] * 1e-4
                self._put(name, tow, _fix(latitude, longitude, height, v[10] * 1e-4, v[11] * 1e-4))
            case "NAV-PVT":
                _, date, valid, _, nano, kind, flags, _, _, lon, lat, height, _, h_acc, v_acc, _, flags_3 = v
                if valid & 3 == 3:
                    self._know(tow, date, nano)
                if kind not in (1, 2, 3, 4) or not flags & 1 or flags_3 & 1:
                    self.without += 1
                    return
                self._put(name, tow, _fix(lat, lon, height * 1e-3, h_acc * 1e-3, v_acc * 1e-3))
            case "NAV-COV":
                north, east, down = (float(v[k]) for k in (3, 6, 8))
                if v[1] == 1 and north >= 0.0 and east >= 0.0 and down >= 0.0 and np.isfinite(north + east + down):
                    self.covariances[tow] = ((north + east) / 2.0) ** 0.5, down**0.5
            case "NAV-ATT":
                self.attitudes[tow] = v[3] * 1e-5, v[1] * 1e-5, v[2] * 1e-5
            case "ESF-INS":
                if v[0] >> 8 & 7 == 7:
                    self.rates[tow] = [radians(value * 1e-3) for value in v[2:5]]
            case _:
                self._take_state(name, tow, v)

    def _take_state(self, name: str, tow: int, v: tuple[int, ...]) -> None:
        """Take what says whether there is a fix, or what time iTOW is."""
        match name:
            case "NAV-STATUS":
                self._judge(tow, v[1], v[2])
            case "NAV-SOL":
                self._judge(tow, v[3], v[4])
                if v[4] & 12 == 12:
                    self._know_week(tow, v[2])
            case "NAV-TIMEGPS":
                if v[4] & 3 == 3:
                    self._know_week(tow, v[2], v[3] if v[4] & 4 else None)
            case "NAV-TIMEUTC":
                if v[4] & 4:
                    self._know(tow, v[3], v[2], exact=False)

    def _put(self, name: str, tow: int, fix: Fix) -> None:
        if abs(fix.latitude) > 90.0 or abs(fix.longitude) > 180.0:
            raise ValueError(f"latitude {fix.latitude}, longitude {fix.longitude}; expected degrees of a position")
        self.fixes.setdefault(name, {})[tow] = fix

    def _judge(self, tow: int, kind: int, flags: int) -> None:
        if kind not in (1, 2, 3, 4) or not flags & 1:
            self.refused.add(tow)

    def _know(self, tow: int, date: "bytes | int", nano: int, *, exact: bool = True) -> None:
        year, month, day, hour, minute, second = _DATE.unpack(date)  # type: ignore[arg-type]
        # a second of 60 is a leap second
        moment = datetime(year, month, day, hour, minute, tzinfo=UTC)
        utc_ns = round(moment.timestamp()) * _NS + second * _NS + nano
        if not -_NS <= nano <= _NS or second > 60 or not 1980 <= year < 2200:
            raise ValueError(f"year {year}, second {second}, nano {nano}; expected a time since 1980")
        self.offsets[round((utc_ns - tow * _MS_NS) / _MS_NS)] += 1
        if exact:
            self.times[tow] = utc_ns

    def _know_week(self, tow: int, week: int, leap: int | None = None) -> None:
        if not 0 <= week < LAST_WEEK:
            raise ValueError(f"week {week}; expected one since 1980")
        gps_ns = gps_time(week, (tow % _WEEK_MS) * _MS_NS)
        utc_ns = gps_ns - leap * _NS if leap is not None else int(utc_from_gps(np.array([gps_ns]))[0])
        self.offsets[round((utc_ns - tow * _MS_NS) / _MS_NS)] += 1

    def offset_ns(self) -> int | None:
        """From iTOW to nanoseconds since 1970 in UTC, as most messages say; None where none does."""
        return self.offsets.most_common(1)[0][0] * _MS_NS if self.offsets else None

    def chosen(self) -> dict[int, Fix]:
        """The best position at each iTOW, with the deviations of NAV-COV where there are such."""
        found: dict[int, Fix] = {
            tow: fix for tow, fix in self.fixes.get("NAV-POSLLH", {}).items() if tow not in self.refused
        }
        for name in ("NAV-PVT", "NAV-HPPOSLLH"):
            found |= self.fixes.get(name, {})
        for tow, (across, up) in self.covariances.items():
            if tow in found:
                found[tow] = replace(found[tow], across=across, up=up)
        return found


def _fix(latitude: float, longitude: float, height: float, across: float, up: float) -> Fix:
    """A position of latitude and longitude in 1e-7 degrees; the horizontal accuracy is that of both directions."""
    across, up = (value if 0.0 < value < 4e6 else _UNKNOWN for value in (across / 2.0**0.5, up))
    return Fix(latitude * 1e-7, longitude * 1e-7, height, 0.0, across, up)


# logs


@dataclass(slots=True)
class _Log:
    """A log while it is read."""

    path: Path
    ledger: Ledger
    nmea: NmeaLog = field(default_factory=NmeaLog)
    ubx: _UbxLog = field(default_factory=_UbxLog)
    unused: Counter[str] = field(default_factory=Counter)

    def take(self, file: BinaryIO) -> None:
        """Read a file to its end."""
        frames = _Frames(file)
        for kind, content in frames.messages():
            location = f"line {frames.line}"
            try:
                match kind:
                    case "ubx":
                        location = f"byte {frames.offset}"
                        self._take_ubx(content)
                    case "rtcm":
                        self.unused[f"RTCM {int.from_bytes(content[:2], 'big') >> 4}"] += 1
                    case _:
                        self._take_sentence(content.decode("ascii"), sound=kind == "nmea")
            except (ValueError, OverflowError) as error:
                code = "ubx-message" if kind == "ubx" else "nmea-sentence"
                self.ledger.fault(code, DataError(self.path, location, str(error)))
        where = str(self.path)
        for what, (count, first) in frames.broken.items():
            self.ledger.note(WarningKind.SKIPPED, "messages-broken", f"{where}: {first}", what, count=count)
        if frames.other:
            message = "bytes of no message"
            self.ledger.note(WarningKind.SKIPPED, "bytes-of-no-message", where, message, count=frames.other)
        if frames.unsigned:
            message = "sentences without checksums were taken as sound"
            self.ledger.note(WarningKind.ASSUMED, "nmea-unsigned", where, message, count=frames.unsigned)

    def _take_sentence(self, body: str, *, sound: bool) -> None:
        address, *fields = body.split(",")
        kind, fields = kind_of(address, fields)
        if not sound:
            if kind == "RMC" and len(fields) > 8 and re.fullmatch(r"\d{6}", fields[8]):
                self.nmea.doubtful_days[day_of(fields[8])] += 1
            return
        if kind not in LEAST_FIELDS:
            self.unused[address] += 1
            return
        if len(fields) < LEAST_FIELDS[kind]:
            raise ValueError(f"{body[:90]!r}; expected at least {LEAST_FIELDS[kind]} fields")
        try:
            self.nmea.add(kind, fields)
        except ValueError as error:
            raise ValueError(f"{kind}: {error}") from error

    def _take_ubx(self, content: bytes) -> None:
        key = content[0], content[1]
        if key in _LAYOUTS:
            name, layout = _LAYOUTS[key]
            try:
                self.ubx.add(name, layout, content[2:])
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from error
        else:
            family = _CLASSES.get(key[0], f"class 0x{key[0]:02X}")
            self.unused[f"{family}-{_NAMES.get(key, f'0x{key[1]:02X}')}"] += 1

    def scene(self, name: str) -> Scene:
        """What was read.

        Raises:
            DataError: there is no position.
        """
        ubx, nmea, where = self.ubx.chosen(), self._nmea_fixes(), str(self.path)
        offset_ns = self.ubx.offset_ns()
        by_ubx = 2 * len(ubx) >= len(nmea) and (offset_ns is not None or not nmea)
        if not ubx and not nmea:
            self._note_unused()
            without = self.nmea.without + self.ubx.without
            problem = f"no GGA, GNS, RMC, GLL, PUBX,00 or NAV message has a position ({without} without); expected one"
            raise DataError(self.path, "", problem)
        if by_ubx and offset_ns is None:
            message = "no message states the week, which was taken as that of 1980-01-06"
            self.ledger.note(WarningKind.ASSUMED, "ubx-week", where, message)
            offset_ns = _GPS_EPOCH_NS
        attitudes = dict[int, tuple[float, float, float]]()
        midnight_ns = self._midnight(needed=not by_ubx)
        if midnight_ns is not None:
            attitudes |= {midnight_ns + time_ns: one for time_ns, one in self.nmea.attitudes.items()}
        if offset_ns is not None:
            attitudes |= {self._ubx_time(tow, offset_ns): one for tow, one in self.ubx.attitudes.items()}
        if by_ubx and offset_ns is not None:
            fixes = {self._ubx_time(tow, offset_ns): fix for tow, fix in ubx.items()}
            without, left = self.ubx.without, len(nmea)
        else:
            fixes = {(midnight_ns or 0) + time_ns: fix for time_ns, fix in nmea.items()}
            without, left = self.nmea.without, len(ubx)
        if left:
            self.unused["fixes of NMEA beside those of UBX" if by_ubx else "fixes of UBX beside those of NMEA"] = left
        if without:
            message = "messages without a position"
            self.ledger.note(WarningKind.SKIPPED, "no-reception", where, message, count=without)
        receiver = self._receiver(fixes)
        sensors: list[Sensor] = [receiver]
        streams = self._streams(offset_ns) if offset_ns is not None else {}
        if streams:
            sensors.append(ImuSensor("imu", MappingProxyType(streams)))
        self._note_unused()
        trajectory = self._trajectory(receiver, attitudes)
        warnings = self.ledger.warnings
        if trajectory is None:
            return Scene(tuple(sensors), source=where, format=name, warnings=warnings)
        origin = dict(zip(("latitude", "longitude", "altitude"), receiver.positions_lla[0].tolist(), strict=True))
        return Scene(
            tuple(sensors),
            trajectories=MappingProxyType({trajectory.name: trajectory}),
            metadata=MappingProxyType({"sceneloom": {"enu_origin": origin}}),
            source=where,
            format=name,
            warnings=warnings,
        )

    def _ubx_time(self, tow: int, offset_ns: int) -> int:
        return self.ubx.times.get(tow, offset_ns + tow * _MS_NS)

    def _note_unused(self) -> None:
        for unit in (self.ubx.meas, self.ubx.raw):
            if unit.other:
                self.unused["ESF data of wheels, temperatures, …"] += unit.other
        if self.unused:
            named = ", ".join(f"{name[:40]} ({count})" for name, count in self.unused.most_common(12))
            message, count = f"not used: {named}", self.unused.total()
            self.ledger.note(WarningKind.SKIPPED, "messages-not-used", str(self.path), message, count=count)

    def _nmea_fixes(self) -> dict[int, Fix]:
        """The fixes of the sentence that has most, of those with heights if there are any."""
        found = self.nmea.fixes
        high = max((found.get(kind, {}) for kind in ("GGA", "GNS", "PUBX,00")), key=len)
        fixes = high or found.get("RMC", {}) or found.get("GLL", {})
        chosen = {}
        for time_ns, fix in fixes.items():
            if time_ns in self.nmea.noise:
                north, east, up = self.nmea.noise[time_ns]
                across = ((north**2 + east**2) / 2.0) ** 0.5
                if np.isfinite(across):
                    chosen[time_ns] = replace(fix, across=across, up=up, assumed=False)
                    continue
            up = fix.up * self.nmea.dilutions.get(time_ns, _UNKNOWN) if fix.assumed else fix.up
            chosen[time_ns] = replace(fix, up=up)
        return chosen

    def _midnight(self, *, needed: bool) -> int | None:
        """Nanoseconds since 1970 of the midnight before the first time of NMEA, None where nothing says it."""
        day = self.nmea.first_day
        if day is None and needed:
            day, doubtful = 0, self.nmea.doubtful_days.most_common(1)
            if doubtful:
                day = doubtful[0][0]
            said = (
                "is that of sentences without a fix, or with wrong checksums" if doubtful else "was taken as 1970-01-01"
            )
            message = f"no sound sentence has the date, which {said}"
            self.ledger.note(WarningKind.ASSUMED, "nmea-date", str(self.path), message)
        return None if day is None else day * DAY_NS

    def _receiver(self, fixes: Mapping[int, Fix]) -> GnssSensor:
        where, times = str(self.path), np.array(sorted(fixes), np.int64)
        chosen = [fixes[time_ns] for time_ns in times.tolist()]
        table = np.array(
            [(one.latitude, one.longitude, one.height, one.undulation, one.across, one.up) for one in chosen]
        )
        heights, undulations = table[:, 2:4].T
        flat = np.isfinite(heights) & np.isnan(undulations)
        if flat.any():
            message = "heights above the geoid, without its undulation, were taken as above the ellipsoid"
            self.ledger.note(WarningKind.ASSUMED, "nmea-height", where, message, count=int(flat.sum()))
        assumed = sum(one.assumed and one.across == one.across for one in chosen)
        if assumed:
            message = "without GST the accuracy was taken from dilution and quality"
            self.ledger.note(WarningKind.ASSUMED, "nmea-accuracy", where, message, count=assumed)
        positions = np.column_stack([table[:, :2], heights + np.where(flat, 0.0, undulations)])
        across, up = (read_only(np.ascontiguousarray(column)) for column in table[:, 4:].T)
        return GnssSensor("gnss", read_only(times), read_only(positions), across, up)

    def _streams(self, offset_ns: int) -> dict[str, VectorSamples]:
        where = f"{self.path}: sensors[imu]"
        streams = self.ubx.meas.streams(offset_ns, milliseconds=True)
        streams |= self.ubx.raw.streams(offset_ns, milliseconds=False)
        if streams:
            message = (
                "ticks of ESF measurements became times by the iTOW of the messages after them, so that they may be "
                "some 0.1 s early"
            )
            self.ledger.note(WarningKind.ASSUMED, "imu-clock", where, message)
        if self.ubx.rates and "gyroscope" not in streams:
            times = np.array([self._ubx_time(tow, offset_ns) for tow in self.ubx.rates], np.int64)
            times, rows = np.unique(times, return_index=True)
            values = np.array(list(self.ubx.rates.values()))[rows]
            streams["gyroscope"] = VectorSamples(read_only(times), read_only(values))
            self.unused["accelerations of ESF-INS, which have no gravity"] = len(times)
        elif self.ubx.rates:
            self.unused["ESF-INS"] = len(self.ubx.rates)
        if streams:
            message = "axes of the receiver's inertial unit were taken as those of the ego"
            self.ledger.note(WarningKind.ASSUMED, "imu-axes", where, message)
        return streams

    def _trajectory(
        self, receiver: GnssSensor, attitudes: Mapping[int, tuple[float, float, float]]
    ) -> Trajectory | None:
        """The poses of the fixes that have an attitude, east, north and up of the first fix; None if fewer than two."""
        rows = [k for k, time_ns in enumerate(receiver.timestamps_ns.tolist()) if time_ns in attitudes]
        rows = [k for k in rows if np.isfinite(receiver.positions_lla[k, 2])]
        where = str(self.path)
        if len(attitudes) > len(rows):
            message, count = "attitudes at times without a position", len(attitudes) - len(rows)
            self.ledger.note(WarningKind.SKIPPED, "attitudes-without-position", where, message, count=count)
        if len(rows) < 2 or not np.isfinite(receiver.positions_lla[0]).all():
            return None
        times = receiver.timestamps_ns[rows]
        heading, roll, pitch = np.array([attitudes[time_ns] for time_ns in times.tolist()]).T
        level = np.isnan(roll)
        if level.any():
            message = "of headings alone (HDT, THS) roll and pitch were taken as 0"
            self.ledger.note(WarningKind.ASSUMED, "attitude-level", where, message, count=int(level.sum()))
        positions = enu_from_geodetic(receiver.positions_lla[rows], receiver.positions_lla[0])
        return Trajectory("receiver", read_only(times), read_only(positions), _quaternions(heading, roll, pitch))


def _quaternions(heading: Float64Array, roll: Float64Array, pitch: Float64Array) -> Float64Array:
    """Orientations of x forward, y left, z up in east, north, up, (N, 4).

    Headings are clockwise from north, rolls to the right and pitches upwards positive [deg]; NaN of these two is 0.
    """
    angles = np.column_stack([np.nan_to_num(roll), -np.nan_to_num(pitch), 90.0 - heading])
    return read_only(quaternion_from_matrix(rotation_from_cuboid_angles(angles, order="zyx")))
