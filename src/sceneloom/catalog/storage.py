"""The Parquet files of a catalogue, by pyarrow: where they lie, and what they hold."""

import json
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sceneloom.catalog.tables import TABLES, Kind
from sceneloom.errors import DataError, MissingExtraError, OutputError, how_to_install
from sceneloom.formats.base.files import check_regular, check_unpacked, read_bytes

MARKER = "catalog.json"
VERSION = 2
_LOCK, _DRAFTS = ".lock.sqlite", ".drafts"
_PART = re.compile(r"part-(\d{5,9})\.parquet")


@dataclass(frozen=True, slots=True)
class Layout:
    """The folder of a catalogue."""

    folder: Path

    @classmethod
    def found(cls, folder: Path) -> "Layout":
        """Take a folder in which a catalogue is.

        Raises:
            DataError: there is none, or one of another version.
        """
        try:
            reported: Any = json.loads(read_bytes(folder / MARKER))
        except DataError as error:
            if not isinstance(error.__cause__, FileNotFoundError | NotADirectoryError):
                raise
            raise DataError(folder, "", "holds no catalogue; `sceneloom catalog build` makes one") from error
        except (ValueError, RecursionError) as error:
            raise DataError(folder / MARKER, "", f"is no JSON: {error}") from error
        version = reported.get("version") if isinstance(reported, dict) else None
        if version != VERSION:
            raise DataError(folder / MARKER, "version", f"{version!r}; expected {VERSION}: build it anew")
        return cls(folder)

    @classmethod
    def made(cls, folder: Path, *, overwrite: bool) -> "Layout":
        """Make a folder for a catalogue.

        Raises:
            OutputError: there is something else, or a catalogue that may not be replaced.
        """
        there = (folder / MARKER).is_file()
        if there and not overwrite:
            raise OutputError(
                f"{folder}: is a catalogue already; bring it up to date with `sceneloom catalog update`, or state "
                "`--overwrite`"
            )
        if not there and folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise OutputError(f"{folder}: holds something else; expected a new name, an empty folder or a catalogue")
        try:
            folder.mkdir(exist_ok=True)
            draft = folder / f".{MARKER}.{os.getpid()}"
            draft.write_text(json.dumps({"format": "sceneloom catalogue", "version": VERSION}), "utf-8")
            draft.replace(folder / MARKER)
        except OSError as error:
            raise OutputError(f"{folder}: cannot be written: {error.strerror}") from error
        return cls(folder)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Be the only one that writes; what is drafted meanwhile, or was before, is taken away in the end.

        Raises:
            OutputError: another process writes, or the folder cannot be written.
        """
        from sceneloom.batch.record import locked

        with locked(self.folder / _LOCK, self.folder):
            try:
                yield
            finally:
                shutil.rmtree(self.drafts, ignore_errors=True)

    @property
    def drafts(self) -> Path:
        """Where scenes are written before they are put into parts."""
        return self.folder / _DRAFTS

    def part(self, table: str, number: int) -> Path:
        """The file of a table and a part."""
        return self.folder / table / f"part-{number:05d}.parquet"

    def numbers(self) -> list[int]:
        """The numbers of all parts of which a file is there."""
        files = (file for table in TABLES for file in self.files(table))
        return sorted({int(found[1]) for file in files if (found := _PART.fullmatch(file.name))})

    def files(self, table: str) -> list[Path]:
        """The files of a table."""
        try:
            with os.scandir(self.folder / table) as entries:
                return sorted(Path(entry.path) for entry in entries if _PART.fullmatch(entry.name))
        except FileNotFoundError:
            return []

    def clear(self) -> None:
        """Take out all scenes."""
        for table in ("scenes", *TABLES):
            shutil.rmtree(self.folder / table, ignore_errors=True)


SCENES_KEY = b"sceneloom.scenes"
"""Under which name a footer reports the scenes."""


def read_part(path: Path) -> Any:
    """Read the rows of a file, as a table of pyarrow.

    Raises:
        DataError: it is not there, or damaged.
    """
    pa, parquet = pyarrow()
    try:
        check_regular(path)
        # one file, not a data set: the folder's name is no column here
        file = parquet.ParquetFile(path)
        _check_unpacked(path, file.metadata)
        return file.read().replace_schema_metadata(None)
    except (pa.ArrowException, OSError) as error:
        raise DataError(path, "", _problem(error)) from error


def read_footer(path: Path) -> tuple[int, Any]:
    """Read how many rows a file has, and the scenes that its footer lists.

    Raises:
        DataError: it is not there, is no Parquet file, ends before its end, or states nothing of scenes.
        MissingExtraError: pyarrow is not installed.
    """
    pa, parquet = pyarrow()
    try:
        check_regular(path)
        footer = parquet.read_metadata(path)
        _check_unpacked(path, footer)
        return footer.num_rows, json.loads((footer.metadata or {})[SCENES_KEY])
    except (pa.ArrowException, OSError) as error:
        raise DataError(path, "", _problem(error)) from error
    except (KeyError, ValueError, RecursionError) as error:
        raise DataError(path, "", "does not report which scenes it holds; expected a file of a catalogue") from error


def _check_unpacked(path: Path, footer: Any) -> None:
    """Refuse a file whose rows would take far more memory than its bytes: by what it declares, and 8 bytes a number."""
    groups = sum(max(footer.row_group(k).total_byte_size, 0) for k in range(footer.num_row_groups))
    check_unpacked(path, "", path.stat().st_size, max(groups, 8 * footer.num_rows * footer.num_columns))


def arrow_type(kind: Kind) -> Any:
    """What values of a kind are to pyarrow."""
    pa, _ = pyarrow()
    return {
        Kind.TEXT: pa.string(), Kind.TIME: pa.int64(), Kind.COUNT: pa.int32(), Kind.NUMBER: pa.float64(),
        Kind.FLAG: pa.bool_(),
    }[kind]  # fmt: skip


def _problem(error: Exception) -> str:
    return f"is no whole Parquet file ({' '.join(str(error).split())})"


def pyarrow() -> tuple[Any, Any]:
    """The modules `pyarrow` and `pyarrow.parquet`.

    Raises:
        MissingExtraError: pyarrow is not installed.
    """
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise MissingExtraError(f"catalogues need pyarrow: install it with {how_to_install('catalog')}") from error
    return pa, parquet
