"""Parts: many scenes together in a file for each table, so that a thousand drives are not a thousand files of each.

A scene stays in the part into which it was put. A part is written anew, beside its files and then into their locations,
when a scene of it changes. Each file reports in its footer which scenes it holds and what their drives were like: a
scene of which all tables report the same is whole, and any other, whatever was stopped, damaged or deleted, is read
again.
"""

import os
from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.catalog.drafts import read_draft
from sceneloom.catalog.layout import Layout
from sceneloom.catalog.parquet import pyarrow, read_footer, read_part, write_part
from sceneloom.catalog.tables import TABLES
from sceneloom.errors import DataError, OutputError

PART_ROWS = 131_072
"""Rows of its longest table up to which a part takes further scenes: writing so many takes some 0.1 s."""
_PART_SCENES = 1024
_IN_ORDER = (*(table for table in TABLES if table != "scenes"), "scenes")


class Entry(msgspec.Struct, frozen=True, array_like=True):
    """What is reported a scene in each file that holds it.

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
        entry: what is reported it.
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
        """What is reported all scenes, by their names."""
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

    def _rewrite(
        self, number: int, fresh: Iterable[Fresh], *, gone: AbstractSet[str] = frozenset()
    ) -> set[str]:
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
            part.damage.append(DataError(location, "", f"reports its scenes what cannot be: {error}"))
    return part


def _kept_rows(location: Path, table: str, kept: Mapping[str, Entry], *, some: bool) -> list[Any]:
    """The rows of scenes that stay; `some`: others are there, too.

    Raises:
        DataError: the file is damaged.
    """
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
        write_part(table, msgspec.to_builtins(held), draft)
        draft.replace(location)
    except OSError as error:
        raise OutputError(f"{location}: cannot be written: {error.strerror or error}") from error
    finally:
        draft.unlink(missing_ok=True)
    return int(table.num_rows)
