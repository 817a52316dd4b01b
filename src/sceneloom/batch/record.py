"""The record of a run, a small database beside its outputs with a row for each drive, and a lock on the folder."""

import json
import os
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any, Self

import msgspec

from sceneloom.batch.jobs import READING, Outcome, State
from sceneloom.errors import DataError, OutputError, redacted


@contextmanager
def locked(file: Path, folder: Path) -> Iterator[None]:
    """Have a folder to oneself, until this ends or the process does, however that is.

    Args:
        file: the lock, a database in the folder that is made if it is not there.
        folder: named in errors.

    Raises:
        OutputError: another process has it, or it cannot be written.
        DataError: the file is something else.
    """
    with ExitStack() as holding:
        try:
            lock = holding.enter_context(closing(sqlite3.connect(file, timeout=0.0, isolation_level=None)))
            lock.execute("BEGIN EXCLUSIVE")
        except sqlite3.OperationalError as error:
            if error.sqlite_errorname != "SQLITE_BUSY":
                raise OutputError(f"{folder}: cannot be written: {error}") from error
            raise OutputError(
                f"{folder}: another run is writing into it; wait for it, or choose another folder"
            ) from error
        except sqlite3.DatabaseError as error:
            raise DataError(file, "", f"{error}; expected the lock of a run") from error
        yield


FOLDER = ".sceneloom-run"
_RECORD, _LOCK, _DRAFTS = "record.sqlite", "lock.sqlite", "drafts"
_VERSION = 1

_TABLES = """
CREATE TABLE IF NOT EXISTS run (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS drives (
    number INTEGER PRIMARY KEY,
    input TEXT NOT NULL,
    part TEXT NOT NULL,
    output TEXT NOT NULL UNIQUE,
    state TEXT NOT NULL,
    attempts INTEGER NOT NULL DEFAULT 0,
    fingerprint TEXT NOT NULL DEFAULT '',
    configuration TEXT NOT NULL DEFAULT '',
    finished_ns INTEGER,
    seconds REAL,
    processor_seconds REAL,
    peak_bytes INTEGER,
    worker TEXT,
    kind TEXT,
    error TEXT,
    report TEXT,
    UNIQUE (input, part)
);
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """What the record knows of a drive.

    Attributes:
        number: of the drive.
        input: its path or URL.
        part: what counts for it alone, by name.
        output: name of the output in the folder of the run.
        state: where it is.
        attempts: how often it was tried.
        fingerprint: of the drive when it was done.
        configuration: of what was done.
        seconds, processor_seconds, peak_bytes, worker, kind, error: as of the last `Outcome`.
        finished_ns: when the last try ended [ns since 1970]; None before.
    """

    number: int
    input: str
    part: Mapping[str, Any]
    output: str
    state: State
    attempts: int
    fingerprint: str
    configuration: str
    finished_ns: int | None
    seconds: float | None
    processor_seconds: float | None
    peak_bytes: int | None
    worker: str | None
    kind: str | None
    error: str | None

    @property
    def name(self) -> str:
        """What people call it: its location, and what counts for it alone, which reports drives of a data set apart."""
        own = ", ".join(f"{name.removeprefix(READING)} {value}" for name, value in sorted(self.part.items()))
        return f"{self.input} ({own})" if own else self.input


_COLUMNS = tuple(Row.__dataclass_fields__)


class Record:
    """The record of one run."""

    def __init__(self, folder: Path, connection: sqlite3.Connection) -> None:
        """Hold an open database; use `opened`, or `held` to write."""
        self.folder, self._connection = folder, connection

    @staticmethod
    def folder_for(url: str) -> Path:
        """Where the record of a run is by default whose outputs lie in a store: in a folder of the user's own state.

        Source: XDG Base Directory Specification 0.8, `XDG_STATE_HOME`.
        """
        state = os.environ.get("XDG_STATE_HOME", "")
        base = Path(state) if Path(state).is_absolute() else Path.home() / ".local" / "state"
        shown = redacted(url).rstrip("/")
        name = shown.rpartition("/")[2]
        reported = "".join(sign if sign.isalnum() or sign in "-_." else "_" for sign in name).lstrip(".")[:60]
        return base / "sceneloom" / "runs" / f"{reported}-{blake2b(shown.encode(), digest_size=4).hexdigest()}"

    @classmethod
    @contextmanager
    def opened(cls, folder: Path) -> Iterator[Self]:
        """Read the record of a folder, while the run goes on, too.

        Raises:
            DataError: it has none, or it is damaged or no record of ours.
        """
        file = folder / FOLDER / _RECORD
        if not file.is_file():
            raise DataError(folder, "", f"no record of a run; expected {FOLDER}/{_RECORD}, as `sceneloom batch` leaves")
        with _connected(f"{file.resolve().as_uri()}?mode=ro", file) as connection:
            record = cls(folder, connection)
            record._check()
            yield record

    @classmethod
    @contextmanager
    def held(cls, folder: Path) -> Iterator[Self]:
        """Open or begin the record of a folder, which no other run has meanwhile.

        Raises:
            OutputError: another run has it.
            DataError: what is there is damaged or no record of ours.
        """
        location = folder / FOLDER
        location.mkdir(parents=True, exist_ok=True)
        file = location / _RECORD
        with locked(location / _LOCK, folder), _connected(file.absolute().as_uri(), file) as connection:
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = NORMAL")
            connection.executescript(_TABLES)
            record = cls(folder, connection)
            record.keep("version", _VERSION) if not record.reported() else record._check()
            yield record

    @property
    def drafts(self) -> Path:
        """Where outputs are written before they are whole."""
        return self.folder / FOLDER / _DRAFTS

    def keep(self, name: str, value: Any) -> None:
        """Keep something of the run as a whole."""
        with self._connection:
            self._connection.execute("INSERT OR REPLACE INTO run VALUES (?, ?)", (name, json.dumps(value)))

    def reported(self) -> dict[str, Any]:
        """What is known of the run as a whole."""
        found = self._connection.execute("SELECT * FROM run")
        return {name: self._value(text, f"run: {name}") for name, text in found}

    def rows(self, *states: State) -> list[Row]:
        """The drives, in the order of their numbers; of some states only, if these are named."""
        marks = ", ".join("?" * len(states))
        where = f"WHERE state IN ({marks})" if states else ""
        found = self._connection.execute(
            f"SELECT {', '.join(_COLUMNS)} FROM drives {where} ORDER BY number",  # noqa: S608 - names of our own
            [str(state) for state in states],
        )
        return [self._row(dict(zip(_COLUMNS, one, strict=True))) for one in found]

    def _row(self, found: dict[str, Any]) -> Row:
        location = f"drives: {found['number']}"
        try:
            return msgspec.convert({**found, "part": self._value(found["part"], location)}, Row)
        except msgspec.ValidationError as error:
            raise DataError(self._file, location, f"{error}; expected what a run leaves") from error

    def _value(self, text: Any, location: str) -> Any:
        try:
            return json.loads(text)
        except (TypeError, ValueError, RecursionError) as error:
            raise DataError(self._file, location, f"is no JSON: {error}") from error

    @property
    def _file(self) -> Path:
        return self.folder / FOLDER / _RECORD

    def report(self, number: int) -> Any:
        """What the verb reported a drive, as JSON values; None where it was not done."""
        found = self._connection.execute("SELECT report FROM drives WHERE number = ?", (number,)).fetchone()
        return None if found is None or found[0] is None else self._value(found[0], f"drives: {number}")

    def add(self, drives: Sequence[tuple[str, Mapping[str, Any], str]]) -> None:
        """Add drives that are not there yet: input, part, output."""
        with self._connection:
            self._connection.executemany(
                "INSERT INTO drives (input, part, output, state) VALUES (?, ?, ?, ?)",
                [
                    (location, json.dumps(dict(part), sort_keys=True), name, State.WAITING)
                    for location, part, name in drives
                ],
            )

    def wait_again(self, numbers: Sequence[int]) -> None:
        """Let drives be done anew."""
        with self._connection:
            self._connection.executemany(
                "UPDATE drives SET state = ?, attempts = 0, error = NULL, kind = NULL, report = NULL WHERE number = ?",
                [(State.WAITING, number) for number in numbers],
            )

    def begin(self, number: int, attempt: int) -> None:
        """Report that a drive is being tried."""
        with self._connection:
            self._connection.execute(
                "UPDATE drives SET state = ?, attempts = ? WHERE number = ?", (State.RUNNING, attempt, number)
            )

    def end(
        self, outcome: Outcome, state: State, *, finished_ns: int, fingerprint: str = "", configuration: str = ""
    ) -> None:
        """Keep what came of a try."""
        values = {
            "state": state,
            "fingerprint": fingerprint,
            "configuration": configuration,
            "finished_ns": finished_ns,
            "seconds": outcome.seconds,
            "processor_seconds": outcome.processor_seconds,
            "peak_bytes": outcome.peak_bytes,
            "worker": outcome.worker,
            "kind": outcome.kind,
            "error": outcome.error,
            "report": None if outcome.report is None else json.dumps(outcome.report),
        }
        names = ", ".join(f"{name} = ?" for name in values)
        with self._connection:
            self._connection.execute(
                f"UPDATE drives SET {names} WHERE number = ?",  # noqa: S608 - names of our own
                (*values.values(), outcome.number),
            )

    def _check(self) -> None:
        version = self.reported().get("version")
        if version != _VERSION:
            raise DataError(self._file, "version", f"{version!r}; expected {_VERSION}")


@contextmanager
def _connected(uri: str, file: Path) -> Iterator[sqlite3.Connection]:
    """Open a database; whatever is wrong with it until it is closed is an error of its file."""
    try:
        with closing(sqlite3.connect(uri, uri=True)) as connection:
            yield connection
    except sqlite3.DatabaseError as error:
        raise DataError(file, "", f"{error}; expected the record of a run") from error
