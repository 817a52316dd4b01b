"""SQL over a catalogue, by DuckDB: reading only, and nothing but the catalogue's own tables.

DuckDB itself opens no file: the tables come to it as data sets of pyarrow, its file systems are switched off, its
settings locked, and a query runs in a read-only transaction. So no statement, however it is nested, can write.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from sceneloom.catalog.layout import Layout
from sceneloom.catalog.parquet import arrow_type, pyarrow, read_footer, read_part
from sceneloom.catalog.tables import TABLES
from sceneloom.errors import DataError, MissingExtraError, OptionError, how_to_install

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
            f"queries need duckdb: install it with {how_to_install('catalog')}"
        ) from error
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
