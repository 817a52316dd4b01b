"""The Parquet files of a catalogue, by pyarrow: where they lie, and parts that hold many scenes each."""

import json
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

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


_ROWS_OF_GROUP = 131_072

_SCENES = b"sceneloom.scenes"
"""Under which name a footer reports the scenes."""


def _write_part(table: Any, scenes: Any, path: Path) -> None:
    """Write a file.

    Args:
        table: rows, as a table of pyarrow.
        scenes: what its footer lists, as values that JSON has.
        path: of the file.
    """
    _, parquet = pyarrow()
    reported = {_SCENES: json.dumps(scenes).encode()}
    texts = [column.name for column in table.schema if str(column.type) == "string"]
    parquet.write_table(
        table.replace_schema_metadata(reported),
        path,
        compression="zstd",
        row_group_size=_ROWS_OF_GROUP,
        use_dictionary=[*texts, *(name for name in _TIMES if name in table.schema.names)],
    )


_TIMES = ("timestamp_ns", "seconds", "track")
"""Numbers that many rows share, and all other numbers few."""


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
        return footer.num_rows, json.loads((footer.metadata or {})[_SCENES])
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


def read_draft(folder: Path, table: str) -> Any:
    """Read the rows of a table, as a table of pyarrow."""
    pa, _ = pyarrow()
    with pa.OSFile(str(folder / table), "rb") as file:
        return pa.ipc.open_file(file).read_all()


PART_ROWS = 131_072
"""Rows of its longest table up to which a part takes further scenes: writing so many takes some 0.1 s."""

_PART_SCENES = 1024
_IN_ORDER = (*(table for table in TABLES if table != "scenes"), "scenes")


class Entry(msgspec.Struct, frozen=True, array_like=True):
    """What each file that holds a scene states of it.

    Attributes:
        path: where its drive is.
        options: how that is read.
        timestamp: what reports the drive from what it was at another time; "" where that is not known.
    """

    path: str
    options: dict[str, Any]
    timestamp: str


@dataclass(frozen=True, slots=True)
class Fresh:
    """A scene that was read.

    Attributes:
        scene: its name.
        entry: what files state of it.
        folder: its rows (`write_draft`).
        rows: how many the longest table has.
    """

    scene: str
    entry: Entry
    folder: Path
    rows: int


@dataclass(slots=True)
class _Part:
    """What is known of a part: the scenes by tables whose file is whole, rows of the longest, damage."""

    held: dict[str, dict[str, Entry]] = field(default_factory=dict)
    rows: int = 0
    damage: list[DataError] = field(default_factory=list)

    @property
    def entries(self) -> dict[str, Entry]:
        return {scene: entry for table in _IN_ORDER for scene, entry in self.held.get(table, {}).items()}

    def has_whole(self, scene: str, entry: Entry) -> bool:
        return all(self.held.get(table, {}).get(scene) == entry for table in TABLES)


class Parts:
    """The parts of a catalogue; one process at a time may have them (`Layout.held`)."""

    def __init__(self, layout: Layout) -> None:
        """Read the footers of all files."""
        self._layout = layout
        self._parts = {number: _read(layout, number) for number in layout.numbers()}

    @property
    def entries(self) -> dict[str, Entry]:
        """The entries of all scenes, by their names."""
        return {scene: entry for part in self._parts.values() for scene, entry in part.entries.items()}

    @property
    def lost(self) -> list[DataError]:
        """The damage of parts of which no file is whole, so that none reports what was in them."""
        return [part.damage[0] for part in self._parts.values() if part.damage and not part.held]

    def whole(self) -> dict[str, Entry]:
        """Those scenes of which all tables report the same."""
        return {
            scene: entry
            for part in self._parts.values()
            for scene, entry in part.entries.items()
            if part.has_whole(scene, entry)
        }

    def put(self, scenes: Iterable[Fresh]) -> set[str]:
        """Put scenes in, each into the part where it is, else into one that has room.

        Returns:
            the names of other scenes that must be read again, since a file of their part was damaged.

        Raises:
            OutputError: a file cannot be written.
        """
        known = {scene: number for number, part in self._parts.items() for scene in part.entries}
        chosen: dict[int, list[Fresh]] = {}
        for one in scenes:
            number = known.get(one.scene)
            number = self._with_room(one.rows, chosen) if number is None else number
            chosen.setdefault(number, []).append(one)
        return {name for number, some in chosen.items() for name in self._rewrite(number, some)}

    def remove(self, scenes: AbstractSet[str]) -> None:
        """Take scenes out.

        Raises:
            OutputError: a file cannot be written.
        """
        for number, part in list(self._parts.items()):
            if scenes & set(part.entries):
                self._rewrite(number, (), gone=scenes)

    def _with_room(self, rows: int, chosen: Mapping[int, list[Fresh]]) -> int:
        """The first part that takes so many rows beside what is chosen for it, or a new one."""
        for number, part in self._parts.items():
            coming = chosen.get(number, ())
            has_room = part.rows + sum(one.rows for one in coming) + rows <= PART_ROWS
            if has_room and not part.damage and len(part.entries) + len(coming) < _PART_SCENES:
                return number
        number = max(self._parts, default=-1) + 1
        self._parts[number] = _Part()
        return number

    def _rewrite(self, number: int, fresh: Iterable[Fresh], *, gone: AbstractSet[str] = frozenset()) -> set[str]:
        before, coming, now = self._parts[number], {one.scene: one for one in fresh}, _Part()
        staying = set(before.entries) - set(coming) - gone
        lost: set[str] = set()
        for table in _IN_ORDER:
            held = before.held.get(table, {})
            kept = {scene: entry for scene, entry in held.items() if scene in staying}
            location = self._layout.part(table, number)
            try:
                rows = _kept_rows(location, table, kept, some=len(kept) < len(held))
            except DataError:
                rows, kept = [], {}
            lost |= staying - set(kept)
            now.held[table] = kept | {scene: one.entry for scene, one in coming.items()}
            rows += [read_draft(one.folder, table) for one in coming.values()]
            now.rows = max(now.rows, _replaced(location, rows, now.held[table]))
        self._parts[number] = now
        if not now.entries:
            del self._parts[number]
        return lost


def _read(layout: Layout, number: int) -> _Part:
    part = _Part()
    for table in TABLES:
        location = layout.part(table, number)
        try:
            rows, reported = read_footer(location)
            part.held[table] = msgspec.convert(reported, dict[str, Entry])
            part.rows = max(part.rows, rows)
        except DataError as error:
            part.damage.append(error)
        except msgspec.ValidationError as error:
            part.damage.append(DataError(location, "", f"lists scenes that cannot be: {error}"))
    return part


def _kept_rows(location: Path, table: str, kept: Mapping[str, Entry], *, some: bool) -> list[Any]:
    """The rows of scenes that stay; `some`: others are there, too."""
    if not kept:
        return []
    pa, _ = pyarrow()
    rows = read_part(location)
    if rows.schema.names != ["scene", *(column.name for column in TABLES[table])]:
        raise DataError(location, "", f"columns {', '.join(rows.schema.names)}; expected those of {table}")
    if some:
        from pyarrow import compute

        rows = rows.filter(compute.is_in(rows["scene"], value_set=pa.array(list(kept))))
    return [rows]


def _replaced(location: Path, rows: list[Any], held: Mapping[str, Entry]) -> int:
    """Write a file beside its location and then into it, or take it away where it holds nothing.

    How many rows it has.
    """
    pa, _ = pyarrow()
    draft = location.with_name(f".{location.name}.{os.getpid()}")
    try:
        if not held:
            location.unlink(missing_ok=True)
            return 0
        location.parent.mkdir(parents=True, exist_ok=True)
        table = pa.concat_tables(rows)
        _write_part(table, msgspec.to_builtins(held), draft)
        draft.replace(location)
    except OSError as error:
        raise OutputError(f"{location}: cannot be written: {error.strerror or error}") from error
    finally:
        draft.unlink(missing_ok=True)
    return int(table.num_rows)
