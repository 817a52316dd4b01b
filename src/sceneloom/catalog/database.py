"""SQL over a catalogue, by DuckDB: reading only, and nothing but the catalogue's own files."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from sceneloom.catalog.layout import Layout
from sceneloom.catalog.parquet import read_footer, read_part
from sceneloom.catalog.tables import TABLES, Kind
from sceneloom.errors import DataError, MissingExtraError, OptionError

_SQL_KINDS = {
    Kind.TEXT: "VARCHAR", Kind.TIME: "BIGINT", Kind.COUNT: "INTEGER", Kind.NUMBER: "DOUBLE", Kind.FLAG: "BOOLEAN",
}  # fmt: skip
_SETTINGS: dict[str, Any] = {
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    "python_enable_replacements": False,
}
_READING = frozenset({"SELECT", "EXPLAIN"})
_WRONG_SQL = (
    "ParserException", "BinderException", "CatalogException", "ConversionException", "PermissionException",
    "OutOfRangeException", "TypeMismatchException", "SyntaxException", "NotSupportedException",
    "NotImplementedException", "InvalidInputException",
)  # fmt: skip
"""DuckDB's errors about what was asked, as against those about what was found."""


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
    """An open catalogue; its tables are views over the Parquet files."""

    def __init__(self, connection: Any, duckdb: Any, layout: Layout) -> None:
        """Hold a connection whose settings are locked."""
        self._connection, self._duckdb, self._layout = connection, duckdb, layout
        self._viewed: set[str] = set()

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
            raise self._told(error) from error
        try:
            self._view_tables(sql)
        except (self._duckdb.Error, UnicodeDecodeError) as error:  # of our own text: the files are at fault
            raise self._damage(error) from error
        try:
            self._connection.execute(statements[0], list(parameters))
            columns = _each_once([column[0] for column in self._connection.description])
            if limit is None or limit > _MOST_ROWS:
                return Result(columns, self._connection.fetchall())
            return Result(columns, self._connection.fetchmany(limit))
        except self._duckdb.Error as error:
            raise self._told(error) from error
        except (OverflowError, ValueError) as error:  # of the way from DuckDB's values to Python's
            raise OptionError(f"SQL: a value that Python cannot hold ({error}); cast it to text") from error

    def _view_tables(self, sql: str) -> None:
        """Make views of the tables that the text names, all where it names none: each looks through its files."""
        named = [table for table in TABLES if table in sql.lower()] or list(TABLES)
        for table in named:
            if table not in self._viewed:
                self._connection.execute(_view(table, self._layout))
                self._viewed.add(table)

    @staticmethod
    def _check(statements: Sequence[Any]) -> None:
        if len(statements) != 1:
            raise OptionError(f"SQL of {len(statements)} statements; expected one")
        kind = statements[0].type.name
        if kind not in _READING:
            raise OptionError(f"SQL that is {kind}; a catalogue is only read: expected SELECT")

    def _told(self, error: Exception) -> Exception:
        """An error of DuckDB's as one of ours: what was asked is wrong, or what was found."""
        asked = tuple(getattr(self._duckdb, name) for name in _WRONG_SQL if hasattr(self._duckdb, name))
        text = " ".join(str(error).split())
        if _NEEDS_ZONES in text:
            return OptionError("SQL: a time with its zone in the result; cast it to TIMESTAMP or to text")
        is_asked = isinstance(error, asked) and _ABOUT_A_FILE.search(text) is None
        return OptionError(f"SQL: {text}") if is_asked else self._damage(error)

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


_ABOUT_A_FILE = re.compile(r"\.parquet\"|in file '[^']*\.parquet'")
"""What DuckDB's messages about files hold, and those about SQL do not."""
_NEEDS_ZONES = "Required module 'pytz'"
"""What DuckDB says where a time with a zone would become an object of Python's."""
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
        raise MissingExtraError(
            "queries need duckdb: install it with `pip install 'sceneloom[catalog]'`"
        ) from error
    with duckdb.connect(":memory:", config=_SETTINGS) as connection:
        database = Database(connection, duckdb, layout)
        folder = str(layout.folder.absolute())
        try:
            # a pattern is looked at before it is resolved, so the folder is allowed in both spellings
            allowed = ", ".join(f"'{_quoted(name)}/'" for name in dict.fromkeys((folder, _literal(folder))))
            connection.execute(f"SET allowed_directories = [{allowed}]")
            connection.execute("SET enable_external_access = false")
            connection.execute("SET parquet_metadata_cache = true")
            connection.execute("SET lock_configuration = true")
        except duckdb.Error as error:
            raise database._told(error) from error  # noqa: SLF001 - of this module
        yield database


def _view(table: str, layout: Layout) -> str:
    kinds = {"scene": "VARCHAR", **{column.name: _SQL_KINDS[column.kind] for column in TABLES[table]}}
    if not layout.files(table):
        nulls = ", ".join(f"NULL::{kind} AS {name}" for name, kind in kinds.items())
        return f"CREATE VIEW {table} AS SELECT {nulls} WHERE false"
    files = _quoted(f"{_literal(str(layout.folder.absolute()))}/{table}/part-*.parquet")
    return f"CREATE VIEW {table} AS SELECT {', '.join(kinds)} FROM read_parquet('{files}')"  # noqa: S608


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


def _literal(path: str) -> str:
    """A path as a pattern that fits it alone."""
    return "".join(f"[{character}]" if character in "*?[" else character for character in path)


def _quoted(text: str) -> str:
    return text.replace("'", "''")
