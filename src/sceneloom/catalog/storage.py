"""The Parquet files of a catalogue, by pyarrow: where they lie, and what they hold."""

import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sceneloom.errors import DataError, MissingExtraError, OutputError, how_to_install
from sceneloom.formats.base.files import check_regular, check_unpacked, read_bytes


class Kind(StrEnum):
    """What a column holds; every one may be null."""

    TEXT = "text"
    TIME = "int64"
    COUNT = "int32"
    NUMBER = "float64"
    FLAG = "bool"


@dataclass(frozen=True, slots=True)
class Column:
    """A column.

    Attributes:
        name: in SQL.
        kind: what it holds.
        words: what it means, with the unit.
    """

    name: str
    kind: Kind
    words: str


def _columns(*rows: tuple[str, Kind, str]) -> tuple[Column, ...]:
    return tuple(Column(*row) for row in rows)


_EGO = (
    ("latitude", Kind.NUMBER, "ego [deg, WGS84]"),
    ("longitude", Kind.NUMBER, "ego [deg, WGS84]"),
    ("ego_speed", Kind.NUMBER, "over half a second [m/s]"),
)

TABLES: Mapping[str, tuple[Column, ...]] = MappingProxyType(
    {
        "scenes": _columns(
            ("path", Kind.TEXT, "drive"),
            ("options", Kind.TEXT, "reading options, JSON"),
            ("format", Kind.TEXT, "format"),
            ("start_ns", Kind.TIME, "first timestamp [ns]"),
            ("duration", Kind.NUMBER, "[s]"),
            ("period", Kind.NUMBER, "median time between moments [s]"),
            ("moments_of", Kind.TEXT, "sensor that defines the moments"),
            ("metres", Kind.NUMBER, "length of the ego trajectory [m]"),
            ("latitude", Kind.NUMBER, "start [deg, WGS84]"),
            ("longitude", Kind.NUMBER, "start [deg, WGS84]"),
            ("sensors", Kind.COUNT, "number"),
            ("frames", Kind.COUNT, "number, all sensors"),
            ("tracks", Kind.COUNT, "number of annotations"),
            ("boxes", Kind.COUNT, "rows of `annotations`"),
            ("findings", Kind.COUNT, "number, repetitions included"),
            ("size_bytes", Kind.TIME, "size on disk"),
            ("fingerprint", Kind.TEXT, "file names, sizes, times and settings, hashed"),
        ),
        "sensors": _columns(
            ("sensor", Kind.TEXT, "id"),
            ("type", Kind.TEXT, "lidar, camera, …"),
            ("count", Kind.COUNT, "frames, images, poses or samples"),
            ("rate_hz", Kind.NUMBER, "1 / median interval [Hz]"),
            ("start", Kind.NUMBER, "first timestamp, from the scene's first [s]"),
            ("stop", Kind.NUMBER, "last timestamp [s]"),
            ("gaps", Kind.COUNT, "intervals above 1.5 medians"),
            ("camera_model", Kind.TEXT, "model and image size"),
            ("video", Kind.TEXT, "codec"),
            ("mounted", Kind.FLAG, "extrinsics known"),
        ),
        "frames": _columns(
            ("sensor", Kind.TEXT, "id"),
            ("type", Kind.TEXT, "sensor type"),
            ("reference", Kind.FLAG, "defines the moments"),
            ("frame", Kind.COUNT, "number from 0"),
            ("timestamp_ns", Kind.TIME, "time [ns]"),
            ("seconds", Kind.NUMBER, "from the scene's first timestamp [s]"),
            ("x", Kind.NUMBER, "ego in the world [m]"),
            ("y", Kind.NUMBER, "[m]"),
            ("z", Kind.NUMBER, "[m]"),
            *_EGO,
        ),
        "annotations": _columns(
            ("track", Kind.COUNT, "key of `tracks`"),
            ("annotation", Kind.TEXT, "id"),
            ("type", Kind.TEXT, "cuboid or box_2d"),
            ("label", Kind.TEXT, "class"),
            ("sensor", Kind.TEXT, "camera of a 2D box"),
            ("timestamp_ns", Kind.TIME, "[ns]"),
            ("seconds", Kind.NUMBER, "from the scene's first timestamp [s]"),
            ("x", Kind.NUMBER, "centre, frame of the annotations [m]"),
            ("y", Kind.NUMBER, "[m]"),
            ("z", Kind.NUMBER, "[m]"),
            ("length", Kind.NUMBER, "[m]"),
            ("width", Kind.NUMBER, "[m]"),
            ("height", Kind.NUMBER, "[m]"),
            ("yaw", Kind.NUMBER, "heading, from x to y [rad]"),
            ("speed", Kind.NUMBER, "[m/s]"),
            ("distance", Kind.NUMBER, "from the ego [m]"),
            ("left_px", Kind.NUMBER, "2D box [px]"),
            ("top_px", Kind.NUMBER, "[px]"),
            ("width_px", Kind.NUMBER, "[px]"),
            ("height_px", Kind.NUMBER, "[px]"),
            *_EGO,
        ),
        "tracks": _columns(
            ("track", Kind.COUNT, "number from 0"),
            ("annotation", Kind.TEXT, "id"),
            ("type", Kind.TEXT, "cuboid, box_2d, event, …"),
            ("label", Kind.TEXT, "class"),
            ("parent", Kind.TEXT, "id of the parent annotation"),
            ("sensor", Kind.TEXT, "its only sensor"),
            ("stationary", Kind.FLAG, "marked stationary"),
            ("boxes", Kind.COUNT, "rows of `annotations`"),
            ("start", Kind.NUMBER, "from the scene's first timestamp [s]"),
            ("stop", Kind.NUMBER, "[s]"),
            ("metres", Kind.NUMBER, "length of its path [m]"),
            ("nearest", Kind.NUMBER, "smallest distance [m]"),
        ),
        "attributes": _columns(
            ("owner", Kind.TEXT, "scene, sensor or annotation"),
            ("track", Kind.COUNT, "annotation"),
            ("sensor", Kind.TEXT, "id"),
            ("name", Kind.TEXT, "attribute"),
            ("value", Kind.TEXT, "as text, a row per value"),
            ("number", Kind.NUMBER, "numeric value"),
            ("start_ns", Kind.TIME, "start of validity [ns]; null: always"),
            ("stop_ns", Kind.TIME, "end of validity [ns]; null: to the end"),
        ),
        "findings": _columns(
            ("rule", Kind.TEXT, "id"),
            ("severity", Kind.TEXT, "error, warning or hint"),
            ("location", Kind.TEXT, "path, or line"),
            ("message", Kind.TEXT, "finding"),
            ("remedy", Kind.TEXT, "remedy"),
            ("count", Kind.COUNT, "occurrences"),
            ("fixable", Kind.FLAG, "by `validate --fix`"),
        ),
    }
)
"""Columns by tables; every table has a further one before them, `scene`."""


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
