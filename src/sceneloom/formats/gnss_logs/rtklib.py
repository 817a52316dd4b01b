"""Read positions of RTKLIB (`.pos`) as a scene with one receiver, or of baselines without a base as a trajectory.

Source: RTKLIB 2.4.2 manual, appendix B.1: lines of comments (`%`), times, coordinates, Q, ns, deviations of which those
of two axes are the square root of the covariance's amount with its sign, age, ratio; and velocities after these.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import file_faults, open_file
from sceneloom.formats.gnss_logs.receiver import LAST_WEEK, gps_time, utc_from_gps
from sceneloom.geometry.geodesy import ecef_from_enu, geodetic_from_ecef
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene
from sceneloom.warnings import WarningKind

_NS = 1_000_000_000
_JST_NS = 9 * 3600 * _NS
_FARTHEST = 1e9  # [m]
_MOST_CHARACTERS = 4096
_SEPARATORS = re.compile(r"[\s,;]+")
_COLUMN = re.compile(r"\([^)]*\)")
_QUALITIES = {1: "fix", 2: "float", 3: "sbas", 4: "dgps", 5: "single", 6: "ppp", 7: "dead reckoning"}
_SIGHTS = {"latitude": "lla", "x-ecef": "ecef", "e-baseline": "enu"}


@dataclass(frozen=True, slots=True)
class _Columns:
    """What the values of a line are.

    Attributes:
        scale: "GPST", "UTC" or "JST".
        frame: "lla", "ecef" or "enu".
        sexagesimal: whether angles are three values, degrees, minutes and seconds.
        geodetic: whether heights are above the geoid.
        base: of a baseline: latitude, longitude [deg] and height [m], or None.
    """

    scale: str
    frame: str
    sexagesimal: bool = False
    geodetic: bool = False
    base: tuple[float, float, float] | None = None


def read_pos(path: Path, *, lenient: bool = False) -> Scene:
    """Read the positions of a file, with their deviations.

    Args:
        lenient: leave lines out that cannot be read, with a count.

    Raises:
        DataError: a line is wrong, or there is none.
    """
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        columns, times, rows, qualities = _lines(path, ledger)
        if not rows:
            raise DataError(path, "", "no line of a position; expected a time and three coordinates a line")
        order = np.argsort(np.array(times, np.int64), kind="stable")
        times_ns, first = np.unique(np.array(times, np.int64)[order], return_index=True)
        if len(times_ns) < len(times):
            message, count = "positions at a time that stands in the file before", len(times) - len(times_ns)
            ledger.note(WarningKind.SKIPPED, "pos-repeated", str(path), message, count=count)
        table = np.array(rows)[order][first]
        times_ns = _utc(times_ns, columns.scale)
        _note(path, ledger, columns, qualities)
        return _scene(path, ledger, columns, times_ns, table)


def _lines(path: Path, ledger: Ledger) -> tuple[_Columns, list[int], list[list[float]], Counter[int]]:
    """What the columns are; and of each line the time in the scale of the file, six numbers and Q.

    The numbers are three coordinates and three variances along the axes of the frame (north, east, up of `lla`), with
    the three covariances of `ecef`: NaN where not reported.
    """
    head: list[str] = []
    columns: _Columns | None = None
    times: list[int] = []
    rows: list[list[float]] = []
    qualities = Counter[int]()
    with file_faults(path), open_file(path) as file:
        for number, raw in enumerate(iter(lambda: file.readline(_MOST_CHARACTERS), b""), 1):
            line = raw.decode("ascii", "replace").strip()
            if line.startswith(("%", "+")):
                head.append(line)
                continue
            if not line:
                continue
            try:
                words = _SEPARATORS.split(line)
                if columns is None or (head and _names(head) is not None):
                    columns, head = _columns(path, ledger, head, words, columns), []
                time_ns, values, quality = _parse(words, columns)
            except (ValueError, OverflowError, IndexError) as error:
                problem = f"{line[:90]!r}: {error}; expected a time, three coordinates, Q, ns and deviations"
                ledger.fault("pos-line", DataError(path, f"line {number}", problem))
                continue
            times.append(time_ns)
            rows.append(values)
            qualities[quality] += 1
    return columns or _Columns("GPST", "lla"), times, rows, qualities


def _names(head: Sequence[str]) -> list[str] | None:
    """The names of the columns, of the last line that has them."""
    for line in reversed(head):
        words = _SEPARATORS.split(line.lstrip("%+ ").strip())
        if any(_COLUMN.sub("", word) in _SIGHTS for word in words):
            return words
    return None


def _columns(
    path: Path, ledger: Ledger, head: Sequence[str], words: Sequence[str], before: _Columns | None
) -> _Columns:
    names, text = _names(head), "\n".join(head)
    if names is None:
        numbers = list(map(float, words[2:5]))
        length = math.hypot(*numbers)
        frame = "lla" if abs(numbers[0]) <= 90.0 and abs(numbers[1]) <= 360.0 else "ecef" if length > 5e6 else "enu"
        message = f"no line of names of columns: taken as GPS time and {frame}"
        ledger.note(WarningKind.ASSUMED, "pos-without-names", f"{path}", message)
        return _Columns("GPST", frame)
    scale = next((name for name in names if name in ("GPST", "UTC", "JST")), "GPST")
    sight = next(name for name in names if _COLUMN.sub("", name) in _SIGHTS)
    frame = _SIGHTS[_COLUMN.sub("", sight)]
    if before is not None and (before.scale, before.frame) != (scale, frame):
        raise DataError(path, "", f"columns of {before.scale}, {before.frame} and {scale}, {frame}; expected one kind")
    datum = re.search(r"lat/lon/height=([^/,)]*)/([a-z]*)", text)
    if datum is not None and not datum[1].upper().startswith("WGS"):
        message = f"positions of the datum {datum[1][:40]} were taken as WGS84"
        ledger.note(WarningKind.ASSUMED, "pos-datum", f"{path}", message)
    return _Columns(scale, frame, "'" in sight, datum is not None and datum[2] == "geodetic", _base(text))


def _base(text: str) -> tuple[float, float, float] | None:
    """The position of the base of a head: degrees and height, degrees, minutes, seconds and height, or ecef."""
    found = re.search(r"^%\s*ref pos\s*:\s*(.*)$", text, re.MULTILINE)
    if found is None:
        return None
    try:
        numbers = [float(word) for word in _SEPARATORS.split(found[1].strip())]
    except ValueError:
        return None
    if len(numbers) == 7:
        numbers = [_degrees(numbers[:3]), _degrees(numbers[3:6]), numbers[6]]
    if len(numbers) != 3 or not np.isfinite(numbers).all():
        return None
    if math.hypot(*numbers) > 5e6 and math.hypot(*numbers) < _FARTHEST:
        numbers = geodetic_from_ecef(np.array(numbers)).tolist()
    latitude, longitude, height = numbers
    return (latitude, longitude, height) if abs(latitude) <= 90.0 and abs(longitude) <= 360.0 else None


def _degrees(parts: Sequence[float]) -> float:
    degrees, minutes, seconds = parts
    if not (0.0 <= minutes < 60.0 and 0.0 <= seconds <= 60.0):
        raise ValueError(f"minutes {minutes}, seconds {seconds}; expected less than 60")
    return math.copysign(abs(degrees) + minutes / 60.0 + seconds / 3600.0, degrees)


def _parse(words: Sequence[str], columns: _Columns) -> tuple[int, list[float], int]:
    """The time of a line in the scale of the file, three coordinates with variances and covariances, and Q.

    Raises:
        ValueError, IndexError: a value is wrong, or missing.
    """
    if "/" in words[0]:
        year, month, day = map(int, words[0].split("/"))
        hour, minute, second = words[1].split(":")
        moment = datetime(year, month, day, tzinfo=UTC).timestamp()
        time_ns = (round(moment) + int(hour) * 3600 + int(minute) * 60) * _NS + round(float(second) * _NS)
        in_range = 1970 <= year < 2200 and int(hour) < 24 and int(minute) < 60 and 0.0 <= float(second) < 61.0
    else:
        week, second_of_week = int(words[0]), float(words[1])
        time_ns = gps_time(week, round(second_of_week * _NS))
        in_range = 0 <= week < LAST_WEEK and 0.0 <= second_of_week <= 604_800.0
    if not in_range:
        raise ValueError(f"time {' '.join(words[:2])!r}")
    values = [float(word) for word in words[2:]]
    coordinates, rest = values[:3], values[3:]
    if columns.sexagesimal:
        # the sign of -0 degrees is that of its text
        coordinates, rest = [_degrees(values[:3]), _degrees(values[3:6]), values[6]], values[7:]
    limits = (90.0, 360.0, _FARTHEST) if columns.frame == "lla" else (_FARTHEST,) * 3
    if len(coordinates) < 3 or not all(abs(one) <= most for one, most in zip(coordinates, limits, strict=True)):
        raise ValueError(f"coordinates {coordinates}")
    if columns.frame == "ecef" and math.hypot(*coordinates) < 1e6:
        raise ValueError(f"coordinates {coordinates}; expected a position on or above the earth")
    deviations = rest[2:8] if len(rest) >= 8 else [*rest[2:5], *[math.nan] * 3] if len(rest) >= 5 else [math.nan] * 6
    return time_ns, [*coordinates, *(one * abs(one) for one in deviations)], int(rest[0]) if rest else 0


def _utc(times_ns: Int64Array, scale: str) -> Int64Array:
    """Times in UTC."""
    if scale == "GPST":
        return utc_from_gps(times_ns)
    return times_ns - _JST_NS if scale == "JST" else times_ns


def _note(path: Path, ledger: Ledger, columns: _Columns, qualities: Mapping[int, int]) -> None:
    found = ", ".join(f"{_QUALITIES.get(k, f'Q {k}')} ({count})" for k, count in sorted(qualities.items()))
    message = f"satellites, age and ratio; quality: {found}"
    ledger.note(WarningKind.SKIPPED, "pos-not-used", str(path), f"not used: {message}", count=sum(qualities.values()))
    if columns.geodetic:
        message = "heights above the geoid, without its undulation, were taken as above the ellipsoid"
        ledger.note(WarningKind.ASSUMED, "pos-height", str(path), message, count=sum(qualities.values()))


def _scene(path: Path, ledger: Ledger, columns: _Columns, times_ns: Int64Array, table: Float64Array) -> Scene:
    positions, variances = table[:, :3], table[:, 3:6]
    base = columns.base
    if columns.frame == "enu" and base is None:
        message = "a baseline without the position of its base (`ref pos`): no fixes, a trajectory around it"
        ledger.note(WarningKind.ASSUMED, "pos-without-base", str(path), message)
        trajectory = Trajectory("baseline", read_only(times_ns), read_only(np.ascontiguousarray(positions)))
        named = MappingProxyType({trajectory.name: trajectory})
        return Scene((), trajectories=named, source=str(path), format="rtklib", warnings=ledger.warnings)
    if columns.frame == "enu" and base is not None:
        positions = geodetic_from_ecef(ecef_from_enu(positions, base))
    elif columns.frame == "ecef":
        positions = geodetic_from_ecef(positions)
        variances = _level(positions, table[:, 3:9])
    with np.errstate(invalid="ignore"):
        # north, east, up of latitudes; east, north, up of baselines
        across = np.sqrt((variances[:, 0] + variances[:, 1]) / 2.0)
        up = np.sqrt(variances[:, 2])
    unknown = ~(across > 0.0)  # where deviations are all 0, none is stated
    across[unknown], up[unknown] = np.nan, np.nan
    gnss = GnssSensor(
        "gnss",
        read_only(times_ns),
        read_only(np.ascontiguousarray(positions)),
        read_only(np.ascontiguousarray(across)),
        read_only(np.ascontiguousarray(up)),
    )
    return Scene((gnss,), source=str(path), format="rtklib", warnings=ledger.warnings)


def _level(positions_lla: Float64Array, moments: Float64Array) -> Float64Array:
    """Variances east, north and up, (N, 3), of those of x, y, z and covariances xy, yz, zx, (N, 6)."""
    xx, yy, zz, xy, yz, zx = moments.T
    matrices = np.stack([xx, xy, zx, xy, yy, yz, zx, yz, zz], axis=1).reshape(-1, 3, 3)
    latitude, longitude = np.radians(positions_lla[:, :2]).T
    sin_n, cos_n, sin_e, cos_e = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    zero = np.zeros_like(sin_n)
    rows = [-sin_e, cos_e, zero, -sin_n * cos_e, -sin_n * sin_e, cos_n, cos_n * cos_e, cos_n * sin_e, sin_n]
    axes = np.stack(rows, axis=1).reshape(-1, 3, 3)
    found: Float64Array = np.einsum("nij,njk,nik->ni", axes, matrices, axes)
    return np.maximum(found, 0.0)
