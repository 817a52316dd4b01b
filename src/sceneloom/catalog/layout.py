"""Where the files of a catalogue lie: TABLE/scene=NAME/part-0.parquet, as Spark, pandas and polars expect it."""

import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any

from sceneloom.catalog.parquet import write_table
from sceneloom.catalog.tables import TABLES, Rows
from sceneloom.errors import DataError, OutputError

MARKER = "catalog.json"
VERSION = 1
_PARTITION = "scene="
_PART = "part-0.parquet"
_ODD = re.compile(r"[^A-Za-z0-9_]+")
_NAME_LENGTH = 60


def scene_name(path: str, options: Mapping[str, Any]) -> str:
    """Name a drive by its file and a hash of its whole path and how it is read.

    The name holds letters, digits, `_` and one `-` only, so that it means the same in folders, SQL and URLs, and no
    reader takes it for a number or a date.
    """
    told = json.dumps([path, dict(options)], sort_keys=True, default=str)
    code = blake2b(told.encode("utf-8", "surrogateescape"), digest_size=8).hexdigest()
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
            DataError: there is none, or one of a later version.
        """
        try:
            told: Any = json.loads((folder / MARKER).read_text("utf-8"))
        except (FileNotFoundError, NotADirectoryError) as error:
            raise DataError(folder, "", "holds no catalogue; `sceneloom catalog build` makes one") from error
        except ValueError as error:
            raise DataError(folder / MARKER, "", f"is no JSON: {error}") from error
        version = told.get("version") if isinstance(told, dict) else None
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
                f"{folder}: is a catalogue already; bring it up to date with `sceneloom catalog update`, or say "
                "`--overwrite`"
            )
        if not there and folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise OutputError(
                f"{folder}: holds something else; expected a new name, an empty folder or a catalogue"
            )
        try:
            folder.mkdir(exist_ok=True)
            _replaced(
                folder / MARKER, json.dumps({"format": "sceneloom catalogue", "version": VERSION}).encode()
            )
        except OSError as error:
            raise OutputError(f"{folder}: cannot be written: {error.strerror}") from error
        return cls(folder)

    def part(self, table: str, scene: str) -> Path:
        """The file of a table and a scene."""
        return self.folder / table / f"{_PARTITION}{scene}" / _PART

    def pattern(self, table: str) -> str:
        """What all files of a table fit, below the folder."""
        return f"{table}/{_PARTITION}*/{_PART}"

    def scenes(self) -> list[str]:
        """The names of all scenes."""
        return sorted(path.parent.name.removeprefix(_PARTITION) for path in self.files("scenes"))

    def files(self, table: str) -> Iterator[Path]:
        """The files of a table."""
        try:
            entries = sorted(os.scandir(self.folder / table), key=lambda entry: entry.name)
        except FileNotFoundError:
            return
        for entry in entries:
            path = Path(entry.path, _PART)
            if entry.name.startswith(_PARTITION) and path.is_file():
                yield path

    def write(self, scene: str, tables: Mapping[str, Rows]) -> None:
        """Write all tables of a scene, each beside its place and then into it; no other scene is touched.

        The table `scenes`, which holds the fingerprint, comes last: a scene that was left half written is done again.

        Raises:
            OutputError: they cannot be written.
        """
        try:
            for table in [*(name for name in TABLES if name != "scenes"), "scenes"]:
                place = self.part(table, scene)
                place.parent.mkdir(parents=True, exist_ok=True)
                draft = place.with_name(f".{place.name}.{os.getpid()}")
                try:
                    write_table(table, tables[table], draft)
                    draft.replace(place)
                finally:
                    draft.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be written: {error.strerror or error}") from error

    def remove(self, scene: str) -> None:
        """Take a scene out of all tables, its fingerprint first."""
        for table in TABLES:
            shutil.rmtree(self.part(table, scene).parent, ignore_errors=True)


def _replaced(place: Path, content: bytes) -> None:
    draft = place.with_name(f".{place.name}.{os.getpid()}")
    draft.write_bytes(content)
    draft.replace(place)
