"""Query a catalogue by SQL or by filters, with DuckDB, and format the results."""

import csv
import io
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal
from itertools import count
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sceneloom.catalog.storage import TABLES, Layout, arrow_type, pyarrow, read_footer, read_part
from sceneloom.errors import DataError, MissingExtraError, OptionError, check_choice, how_to_install

_AT_THE_START: dict[str, Any] = {
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    "allow_persistent_secrets": False,
    "python_enable_replacements": False,
    "temp_directory": "",
}

_SEALED = (
    "SET enable_external_access = false",
    "SET disabled_filesystems = 'LocalFileSystem'",
    "SET lock_configuration = true",
)

_READING = frozenset({"SELECT", "EXPLAIN"})
"""Statements that are let through. For a clear message only: what keeps a query from writing are the settings."""


@dataclass(frozen=True, slots=True)
class Result:
    """What a query gives.

    Attributes:
        columns: their names.
        rows: the rows.
    """

    columns: tuple[str, ...]
    rows: list[tuple[Any, ...]]


class Database:
    """An open catalogue; its tables are views of data sets over the Parquet files."""

    def __init__(self, connection: Any, duckdb: Any, layout: Layout) -> None:
        """Hold a connection whose settings are locked."""
        self._connection, self._duckdb, self._layout = connection, duckdb, layout
        self._viewed = False

    def query(self, sql: str, parameters: Sequence[Any] = (), *, limit: int | None = None) -> Result:
        """Run one statement that reads.

        Args:
            sql: the statement.
            parameters: values for its `?`.
            limit: at most so many rows; None for all.

        Raises:
            OptionError: the SQL is wrong, writes, wants other files or gives what Python has no value for.
            DataError: files of the catalogue are damaged.
        """
        _check_text(sql)
        if limit is not None and limit < 0:
            raise OptionError(f"limit {limit}; expected 0 or more")
        try:
            statements = self._connection.extract_statements(sql)
            self._check(statements)
        except self._duckdb.Error as error:
            raise self._reported(error) from error
        self._view_tables()
        self._connection.execute("BEGIN TRANSACTION READ ONLY")
        try:
            self._connection.execute(statements[0], list(parameters))
            columns = _each_once([column[0] for column in self._connection.description])
            if limit is None or limit > _MOST_ROWS:
                return Result(columns, self._connection.fetchall())
            return Result(columns, self._connection.fetchmany(limit))
        except self._duckdb.Error as error:
            raise self._reported(error) from error
        except (OverflowError, ValueError) as error:  # of the trajectory from DuckDB's values to Python's
            raise OptionError(f"SQL: a value that Python cannot hold ({error}); cast it to text") from error
        finally:
            self._connection.execute("ROLLBACK")

    def _view_tables(self) -> None:
        """Make views of the tables, whose files are listed here, and opened by what reads them."""
        for table in TABLES if not self._viewed else ():
            self._connection.register(table, _data_set(table, self._layout))
        self._viewed = True

    @staticmethod
    def _check(statements: Sequence[Any]) -> None:
        if len(statements) != 1:
            raise OptionError(f"SQL of {len(statements)} statements; expected one")
        kind = statements[0].type.name
        if kind not in _READING:
            raise OptionError(f"SQL that is {kind}; a catalogue is only read: expected SELECT")

    def _reported(self, error: Exception) -> Exception:
        """An error of DuckDB's as one of ours: what was asked is wrong, or what was found."""
        text = " ".join(str(error).split())
        if any(words in text for words in _ABOUT_A_FILE):
            return self._damage(error)
        if _NEEDS_ZONES in text:
            return OptionError("SQL: a time with its zone in the result; cast it to TIMESTAMP or to text")
        if isinstance(error, self._duckdb.OutOfMemoryException):
            short = text.split(" Database is launched")[0]
            return OptionError(f"SQL: {short}; ask for fewer rows or columns at once")
        return OptionError(f"SQL: {text}")

    def _damage(self, error: Exception) -> DataError:
        """Name the file that is at fault: first by the ends of all files, then by what is in them."""
        files = [file for table in TABLES for file in self._layout.files(table)]
        for check in (read_footer, read_part):
            for file in files:
                try:
                    check(file)
                except DataError as damage:
                    return DataError(damage.file, "", f"{damage.problem}; {_REMEDY}")
        return DataError(self._layout.folder, "", f"{' '.join(str(error).split())}; {_REMEDY}")


_ABOUT_A_FILE = ("reading the stream registered as", "arrow_scan: ")
"""What DuckDB's messages about data sets hold, and those about SQL do not."""

_NEEDS_ZONES = "Required module 'pytz'"  # what DuckDB says where a time with a zone would become an object of Python's

_MOST_ROWS = 2**31 - 1
_REMEDY = "delete the file, and `sceneloom catalog update CATALOGUE` makes it anew"


@contextmanager
def opened(catalogue: str | Path) -> Iterator[Database]:
    """Open a catalogue for queries.

    Raises:
        DataError: there is none, or a file of it is damaged.
        MissingExtraError: duckdb is not installed.
    """
    layout = Layout.found(Path(catalogue))
    try:
        import duckdb
    except ImportError as error:
        raise MissingExtraError(f"queries need duckdb: install it with {how_to_install('catalog')}") from error
    with duckdb.connect(":memory:", config=_AT_THE_START) as connection:
        database = Database(connection, duckdb, layout)
        try:
            for setting in _SEALED:
                connection.execute(setting)
        except duckdb.Error as error:
            raise database._reported(error) from error  # noqa: SLF001 - of this module
        yield database


def _data_set(table: str, layout: Layout) -> Any:
    """The rows of a table as a data set of pyarrow, which reads what a query needs of them."""
    pa, _ = pyarrow()
    from pyarrow import dataset, fs

    columns = [("scene", pa.string()), *((column.name, arrow_type(column.kind)) for column in TABLES[table])]
    try:
        return dataset.FileSystemDataset.from_paths(
            [str(file.absolute()) for file in layout.files(table)],
            schema=pa.schema(columns),
            format=dataset.ParquetFileFormat(),
            filesystem=fs.LocalFileSystem(),
        )
    except UnicodeEncodeError as error:
        raise DataError(layout.folder, "", "its path is no Unicode, which queries need; rename it") from error


def _each_once(names: Sequence[str]) -> tuple[str, ...]:
    """Names of columns; those that stand there a second time are numbered, as DuckDB does in tables."""
    taken: list[str] = []
    for name in names:
        numbered = (f"{name}_{number}" for number in count(1))
        taken.append(name if name not in taken else next(own for own in numbered if own not in taken))
    return tuple(taken)


def _check_text(sql: str) -> None:
    try:
        sql.encode()
    except UnicodeEncodeError as error:
        raise OptionError(f"SQL {sql!r}: is no text in Unicode ({error.reason})") from error


_FIRST_NS, _LAST_NS = -(2**63), 2**63 - 1

_Part = tuple[str, tuple[Any, ...]]  # a condition with the values for its `?`


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
            raise OptionError(f"near {self.near[0]}, {self.near[1]}; expected latitude and longitude in degrees")
        if self.near is not None and not self.near[2] >= 0:
            raise OptionError(f"near: {self.near[2]} m; expected 0 or more")
        if self.count is not None and self.count < 1:
            raise OptionError(f"count {self.count}; expected 1 or more")

    @property
    def of_boxes(self) -> bool:
        """Whether boxes are looked for, and not the ego alone."""
        return bool(self.labels or self.types or self.distance or self.count is not None)

    def conditions(self) -> Iterator[_Part]:
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

    def joins(self) -> Iterator[_Part]:
        """What a row `m` must have a partner in."""
        for number, (name, value) in enumerate(self.attributes):
            own = _OF_THE_BOX if self.of_boxes else ""
            yield (_ATTRIBUTE + own).format(t=f"a{number}"), (name.lower(), value.lower())


def _any_of(condition: str, values: Any) -> _Part:
    return f"({' OR '.join([condition] * len(values))})", tuple(values)


def _timed(value: float | str, name: str, sign: str) -> _Part:
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
    return f"m.timestamp_ns {sign} ?", ((since.days * 86_400 + since.seconds) * 10**9 + since.microseconds * 1000,)


def _near(latitude: float, longitude: float, metres: float) -> _Part:
    """Within a distance on the ellipsoid, whose curves at the location itself count: good to 1 % up to 100 km."""
    # Source: NIMA TR8350.2, radii of curvature in the meridian and the prime vertical
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


def sql_of(selection: Selection, *, show: str = "spans", gap: float = 1.0, margin: float = 0.0) -> _Part:
    """Write a selection as SQL.

    Args:
        selection: what is looked for.
        show: one of `SHOWN`.
        gap: moments no more than so many seconds apart are one span.
        margin: spans are so many seconds longer at both ends.

    Raises:
        OptionError: a time is none, gap or margin are below 0, or there is no such way to show it.
    """
    check_choice("show", show, SHOWN)
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
    sql = _SPANS.format(chosen=chosen, least=int(least), options=_OPTIONS, gap=_number(gap), margin=_number(margin))
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


def query(
    catalogue: str | Path,
    wanted: str | Selection,
    *,
    show: str = "spans",
    gap: float = 1.0,
    margin: float = 0.0,
    limit: int | None = None,
) -> Result:
    """Ask a catalogue.

    Args:
        catalogue: its folder.
        wanted: one SQL statement that reads, or what is looked for.
        show: of a selection: "spans", "drives" or "rows".
        gap: of a selection: moments no more than so many seconds apart are one span.
        margin: of a selection: spans are so many seconds longer at both ends.
        limit: at most so many rows; None for all.

    Raises:
        OptionError: the SQL is wrong, writes or wants other files, or the selection cannot be.
        DataError: there is no catalogue, or a file of it is damaged.
        MissingExtraError: duckdb or pyarrow is not installed.
    """
    with opened(catalogue) as database:
        if isinstance(wanted, str):
            return database.query(wanted, limit=limit)
        sql, values = sql_of(wanted, show=show, gap=gap, margin=margin)
        return _without_idle_options(database.query(sql, values, limit=limit))


def _without_idle_options(result: Result) -> Result:
    """Leave out how drives are read, where all are read as they come."""
    column = result.columns.index("options")
    if any(row[column] is not None for row in result.rows):
        return result
    columns = result.columns[:column] + result.columns[column + 1 :]
    return Result(columns, [row[:column] + row[column + 1 :] for row in result.rows])


_SPAN = ("start", "stop")


def records(result: Result) -> list[dict[str, Any]]:
    """Give the rows as mappings that JSON can hold; numbers that are none are null, decimals are floats."""
    return [dict(zip(result.columns, map(_plain, row), strict=True)) for row in result.rows]


def format_csv(result: Result) -> str:
    """Write a line for each row after one with the columns' names; null is empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(result.columns)
    writer.writerows([_cell(value) for value in row] for row in result.rows)
    return text.getvalue()


def iter_list(result: Result) -> Iterator[str]:
    """Give a line of JSON for each drive, or time span of one, without what was stated before.

    Raises:
        OptionError: the result has no column `path`, or a row of it has none.
    """
    if "path" not in result.columns:
        raise OptionError(
            f"a list of drives needs the column `path`, and takes `start`, `stop` and `options`; the result has "
            f"{', '.join(result.columns)}"
        )
    seen: set[str] = set()
    for row in records(result):
        if not isinstance(row["path"], str):
            raise OptionError(f"path {row['path']!r}; expected the path of a drive in each row")
        part = {name: row[name] for name in _SPAN if row.get(name) is not None}
        line = json.dumps({"path": row["path"], **part, **_reading(row.get("options"))}, ensure_ascii=False)
        if line not in seen:
            seen.add(line)
            yield line


def _reading(options: Any) -> dict[str, Any]:
    """How a drive is to be opened, out of the column `options` of `scenes`."""
    try:
        stated = json.loads(options) if isinstance(options, str) else None
    except (ValueError, RecursionError) as error:
        raise OptionError(f"options {options!r}; expected an object of JSON, as in `scenes`") from error
    return {"reading": stated} if stated else {}


def format_cell(value: Any) -> str:
    """A value for people: numbers with three locations, null as nothing."""
    if isinstance(value, float):
        return f"{value:.3f}"
    return _cell(value)


def _cell(value: Any) -> str:
    plain = str(value) if isinstance(value, Decimal) else _plain(value)
    if plain is None:
        return ""
    return json.dumps(plain, ensure_ascii=False) if isinstance(plain, list | dict) else str(plain)


def _plain(value: Any) -> Any:
    if isinstance(value, float | Decimal):  # DuckDB's 0.5 is a decimal
        return float(value) if math.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, dict):
        return {str(key): _plain(one) for key, one in value.items()}
    return value if value is None or isinstance(value, str | int) else str(value)
