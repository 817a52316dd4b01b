"""Folders that one process at a time writes into."""

import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

from sceneloom.errors import DataError, OutputError


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
