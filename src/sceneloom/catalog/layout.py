"""Where the files of a catalogue lie: TABLE/part-NUMBER.parquet, which any program reads as one table."""

import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any

from sceneloom.catalog.tables import TABLES
from sceneloom.errors import DataError, OutputError
from sceneloom.formats.files import read_bytes

MARKER = "catalog.json"
VERSION = 2
_LOCK, _DRAFTS = ".lock.sqlite", ".drafts"
_PART = re.compile(r"part-(\d{5,9})\.parquet")
_ODD = re.compile(r"[^A-Za-z0-9_]+")
_NAME_LENGTH = 60


def scene_name(path: str, options: Mapping[str, Any]) -> str:
    """Name a drive by its file and a hash of its whole path and how it is read.

    The name holds letters, digits, `_` and one `-` only, so that it means the same in folders, SQL and URLs, and no
    reader takes it for a number or a date.
    """
    reported = json.dumps([path, dict(options)], sort_keys=True, default=str)
    code = blake2b(reported.encode("utf-8", "surrogateescape"), digest_size=8).hexdigest()
    last = [part for part in re.split(r"[/\\]", path) if part]
    return f"{_ODD.sub('_', last[-1] if last else '')[:_NAME_LENGTH]}-{code}"


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
            raise OutputError(
                f"{folder}: holds something else; expected a new name, an empty folder or a catalogue"
            )
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
        from sceneloom.batch.locks import locked

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
