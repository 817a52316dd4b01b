"""Ready filters: what is looked for, as SQL."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from types import MappingProxyType
from typing import Any

from sceneloom.errors import OptionError

_FIRST_NS, _LAST_NS = -(2**63), 2**63 - 1

Part = tuple[str, tuple[Any, ...]]
"""A condition with the values for its `?`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """What to look for; all that is stated must hold at a moment.

    Attributes:
        labels: one of these classes; `*` and `?` stand for any text and any character, the case does not count.
        types: one of these types of boxes: "cuboid", "box_2d".
        start: not before: seconds after a drive's first timestamp, or a date and time (ISO 8601, UTC unless stated).
        stop: before.
        near: latitude, longitude [deg], and how far from there the ego may be [m].
        speed: least and greatest speed of the ego [m/s].
        distance: least and greatest distance of boxes from the ego [m].
        count: at least so many boxes at one time.
        attributes: names and values that hold for the scene, a sensor, or the box itself.
        findings: rules that found something in the drive.
    """

    labels: tuple[str, ...] = ()
    types: tuple[str, ...] = ()
    start: float | str | None = None
    stop: float | str | None = None
    near: tuple[float, float, float] | None = None
    speed: tuple[float, float] | None = None
    distance: tuple[float, float] | None = None
    count: int | None = None
    attributes: tuple[tuple[str, str], ...] = ()
    findings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("speed", "distance"):
            bounds = getattr(self, name)
            if bounds is not None and not bounds[0] <= bounds[1]:
                raise OptionError(f"{name} from {bounds[0]} to {bounds[1]}; expected the lesser number first")
        if self.near is not None and not (abs(self.near[0]) <= 90 and abs(self.near[1]) <= 360):
            raise OptionError(
                f"near {self.near[0]}, {self.near[1]}; expected latitude and longitude in degrees"
            )
        if self.near is not None and not self.near[2] >= 0:
            raise OptionError(f"near: {self.near[2]} m; expected 0 or more")
        if self.count is not None and self.count < 1:
            raise OptionError(f"count {self.count}; expected 1 or more")

    @property
    def of_boxes(self) -> bool:
        """Whether boxes are looked for, and not the ego alone."""
        return bool(self.labels or self.types or self.distance or self.count is not None)

    def conditions(self) -> Iterator[Part]:
        """The conditions on a row `m` of annotations, or of frames where no boxes are looked for."""
        if self.labels:
            yield _any_of("lower(m.label) GLOB ?", [label.lower() for label in self.labels])
        if self.types:
            yield _any_of("m.type = ?", self.types)
        for name, column in (("speed", "ego_speed"), ("distance", "distance")):
            if getattr(self, name) is not None:
                yield f"m.{column} BETWEEN ? AND ?", getattr(self, name)
        if self.near is not None:
            yield _near(*self.near)
        for name, sign in (("start", ">="), ("stop", "<")):
            if getattr(self, name) is not None:
                yield _timed(getattr(self, name), name, sign)
        for rule in self.findings:
            yield "m.scene IN (SELECT scene FROM findings WHERE rule = ?)", (rule,)

    def joins(self) -> Iterator[Part]:
        """What a row `m` must have a partner in."""
        for number, (name, value) in enumerate(self.attributes):
            own = _OF_THE_BOX if self.of_boxes else ""
            yield (_ATTRIBUTE + own).format(t=f"a{number}"), (name.lower(), value.lower())


def _any_of(condition: str, values: Any) -> Part:
    return f"({' OR '.join([condition] * len(values))})", tuple(values)


def _timed(value: float | str, name: str, sign: str) -> Part:
    try:
        seconds = float(value)
    except ValueError:
        pass
    else:
        if math.isnan(seconds):
            raise OptionError(f"{name} {value}; expected a number of seconds")
        return f"m.seconds {sign} ?", (seconds,)
    try:
        moment = datetime.fromisoformat(str(value))
    except ValueError as error:
        raise OptionError(
            f"{name} {value!r}; expected seconds after a drive's beginning, or a date and time such as "
            "2024-05-01T08:30:00"
        ) from error
    moment = moment.replace(tzinfo=moment.tzinfo or UTC)
    since = moment - datetime(1970, 1, 1, tzinfo=UTC)
    return f"m.timestamp_ns {sign} ?", (
        (since.days * 86_400 + since.seconds) * 10**9 + since.microseconds * 1000,
    )


def _near(latitude: float, longitude: float, metres: float) -> Part:
    """Within a distance on the ellipsoid, whose curves at the location itself count: good to 1 % up to 100 km.

    Source: NIMA TR8350.2, radii of curvature in the meridian and the prime vertical.
    """
    from sceneloom.geometry.geodesy import FLATTENING, SEMI_MAJOR_AXIS

    eccentricity_2 = FLATTENING * (2 - FLATTENING)
    root = math.sqrt(1 - eccentricity_2 * math.sin(math.radians(latitude)) ** 2)
    north = math.radians(1) * SEMI_MAJOR_AXIS * (1 - eccentricity_2) / root**3
    east = math.radians(1) * SEMI_MAJOR_AXIS / root * math.cos(math.radians(latitude))
    band = metres / north * 1.02
    values = (latitude - band, latitude + band, latitude, north, longitude, east, metres)
    return _NEAR, values


_NEAR = """m.latitude BETWEEN ? AND ? AND
 sqrt(((m.latitude - ?) * ?) ** 2 + (((m.longitude - ? + 900) % 360 - 180) * ?) ** 2) <= ?"""

_ATTRIBUTE = f"""SEMI JOIN (SELECT scene, track, coalesce(start_ns, {_FIRST_NS}) AS start_ns,
 coalesce(stop_ns, {_LAST_NS}) AS stop_ns FROM attributes WHERE lower(name) = ? AND lower(value) = ?) {{t}}
 ON {{t}}.scene = m.scene AND m.timestamp_ns >= {{t}}.start_ns AND m.timestamp_ns < {{t}}.stop_ns"""  # noqa: S608
_OF_THE_BOX = " AND ({t}.track IS NULL OR {t}.track = m.track)"

SHOWN: Mapping[str, str] = MappingProxyType(
    {
        "spans": "drives with the time spans in which all holds",
        "drives": "drives in which all holds at some time",
        "rows": "every box, or frame, for itself",
    }
)
"""What a selection can be shown as."""


def sql_of(selection: Selection, *, show: str = "spans", gap: float = 1.0, margin: float = 0.0) -> Part:
    """Write a selection as SQL.

    Args:
        selection: what is looked for.
        show: one of `SHOWN`.
        gap: moments no more than so many seconds apart are one span.
        margin: spans are so many seconds longer at both ends.

    Raises:
        OptionError: a time is none, gap or margin are below 0, or there is no such way to show it.
    """
    if show not in SHOWN:
        raise OptionError(f"show {show!r}; expected one of {', '.join(SHOWN)}")
    for name, seconds in (("gap", gap), ("margin", margin)):
        if not seconds >= 0:
            raise OptionError(f"{name} {seconds}; expected 0 s or more")
    table = "annotations" if selection.of_boxes else "frames"
    joins, conditions = list(selection.joins()), list(selection.conditions())
    if not selection.of_boxes:
        conditions.append(("m.reference", ()))
    where = " AND ".join(condition for condition, _ in conditions) or "true"
    joined = " ".join(join for join, _ in joins)
    values = tuple(value for _, some in (*conditions, *joins) for value in some)
    columns = "m.*" if show == "rows" else "m.scene, m.timestamp_ns, m.seconds"
    # the joins come after what is cheap: DuckDB would not see that by itself
    chosen = f"SELECT {columns} FROM (SELECT m.* FROM {table} m WHERE {where}) m {joined}"  # noqa: S608
    least = selection.count or 1
    if show == "rows":
        sql = _ROWS.format(chosen=chosen, least=int(least), options=_OPTIONS)
        return sql, values
    sql = _SPANS.format(
        chosen=chosen, least=int(least), options=_OPTIONS, gap=_number(gap), margin=_number(margin)
    )
    return (f"{sql} {_OF_SPANS}" if show == "spans" else f"{sql} {_OF_DRIVES}"), values


def _number(value: float) -> str:
    return f"'{float(value)!r}'::DOUBLE"  # so that "inf" is one, too


_OPTIONS = "nullif(s.options, '{}') AS options"
_ROWS = """SELECT s.path, {options}, c.* FROM ({chosen}) c JOIN scenes s USING (scene)
QUALIFY count(*) OVER (PARTITION BY c.scene, c.timestamp_ns) >= {least} ORDER BY s.path, c.timestamp_ns"""

_SPANS = """WITH chosen AS ({chosen}),
moments AS (SELECT scene, timestamp_ns, any_value(seconds) AS seconds, count(*) AS found FROM chosen
  GROUP BY scene, timestamp_ns HAVING count(*) >= {least}),
marked AS (SELECT m.*, s.path, {options}, s.period, CASE WHEN m.seconds - lag(m.seconds) OVER of_scene
  <= greatest({gap}, 1.5 * s.period) + 2 * {margin} THEN 0 ELSE 1 END AS fresh
  FROM moments m JOIN scenes s USING (scene)
  WINDOW of_scene AS (PARTITION BY m.scene ORDER BY m.timestamp_ns)),
numbered AS (SELECT *, sum(fresh) OVER (PARTITION BY scene ORDER BY timestamp_ns) AS span FROM marked),
spans AS (SELECT path, options, greatest(0.0, min(seconds) - {margin}) AS start,
  max(seconds) + any_value(period) + {margin} AS stop, count(*) AS moments, max(found) AS most
  FROM numbered GROUP BY scene, path, options, span)"""

_OF_SPANS = "SELECT path, options, start, stop, moments, most FROM spans WHERE stop > 0 ORDER BY ALL"
_OF_DRIVES = """SELECT path, options, sum(stop - start) AS seconds, count(*) AS spans, sum(moments)::BIGINT AS moments,
max(most) AS most FROM spans GROUP BY path, options ORDER BY path, options"""
