"""A file in the making: heads of objects, and what is stated for them frame by frame."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any
from uuid import NAMESPACE_URL, uuid5

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.formats.openlabel.words import UID
from sceneloom.formats.openlabel.written_data import Datum
from sceneloom.scene.types import Identifier, Key, key_of


@dataclass(slots=True)
class Uids:
    """Keys of the elements of a file, which are whole numbers or UUIDs."""

    taken: set[str] = field(default_factory=set)
    by_id: dict[Key, str] = field(default_factory=dict)

    def give(self, identifier: Identifier) -> str:
        """A key for an id: the id itself where the schema takes it, else a UUID made of it."""
        text = str(identifier)
        uid = text
        attempt = 0
        while not UID.fullmatch(uid) or uid in self.taken:
            uid = str(uuid5(NAMESPACE_URL, f"sceneloom:{type(identifier).__name__}:{attempt}:{text}"))
            attempt += 1
        self.taken.add(uid)
        self.by_id[key_of(identifier)] = uid
        return uid


@dataclass(slots=True, eq=False)
class Draft:
    """The members of a file.

    Attributes:
        times: (N,) int64 [ns] of the frames, ascending.
        heads: entries of the root, by "object" or "event" and key.
        frames: what is stated in each frame, by its number, then as `heads`: the data by type.
        ours: what only we understand of them.
        names: of the data of each object, by its key.
    """

    times: Int64Array
    heads: dict[str, dict[str, dict[str, Any]]] = field(default_factory=lambda: {"object": {}, "event": {}})
    frames: dict[int, dict[str, dict[str, dict[str, list[dict[str, Any]]]]]] = field(default_factory=dict)
    ours: dict[str, dict[str, Any]] = field(default_factory=dict)
    names: dict[str, set[str]] = field(default_factory=dict)

    def renamed(self, uid: str, data: Iterable[Datum], identifier: Identifier) -> list[Datum]:
        """Give elements of data names that nothing else of the object has, made of an id where they are taken."""
        taken, given, found = self.names.setdefault(uid, set()), dict[str, str](), list[Datum]()
        for time_ns, kind, element in data:
            name = element["name"]
            if name not in given:
                attempt, free = 1, name
                while free in taken or free in given.values():
                    free = f"{name}:{identifier}" if attempt == 1 else f"{name}:{identifier}:{attempt}"
                    attempt += 1
                given[name] = free
            found.append((time_ns, kind, {**element, "name": given[name]}))
        taken.update(given.values())
        return found

    def number(self, time_ns: int) -> int:
        """The number of the frame of a time."""
        return int(np.searchsorted(self.times, time_ns))

    def state(self, kind: str, uid: str, data: Iterable[Datum]) -> None:
        """Put elements of data where they belong: into the frames of their times, or the head."""
        for time_ns, name, element in data:
            if time_ns is None:
                location = self.heads[kind][uid].setdefault(f"{kind}_data", {})
            else:
                frame = self.frames.setdefault(self.number(time_ns), {}).setdefault(kind, {})
                location = frame.setdefault(uid, {})
            location.setdefault(name, []).append(element)

    def close(self) -> None:
        """Report in the heads which frames speak of them, and of which data."""
        for kind in ("object", "event"):
            pointers: dict[str, dict[str, tuple[str, list[int]]]] = {}
            numbers: dict[str, list[int]] = {}
            for number in sorted(self.frames):
                for uid, data in self.frames[number].get(kind, {}).items():
                    numbers.setdefault(uid, []).append(number)
                    for name, elements in data.items():
                        for element in elements:
                            found = pointers.setdefault(uid, {}).setdefault(element["name"], (name, []))
                            if not found[1] or found[1][-1] != number:
                                found[1].append(number)
            for uid, known in numbers.items():
                self.heads[kind][uid].setdefault("frame_intervals", intervals(known))
            for uid, reported in pointers.items():
                self.heads[kind][uid][f"{kind}_data_pointers"] = {
                    name: {"type": type_, "frame_intervals": intervals(known)}
                    for name, (type_, known) in reported.items()
                }


def intervals(numbers: list[int]) -> list[dict[str, int]]:
    """Numbers in order as intervals, both ends included."""
    if not numbers:
        return []
    steps = np.flatnonzero(np.diff(numbers) > 1)
    starts = [numbers[0], *(numbers[k + 1] for k in steps.tolist())]
    stops = [*(numbers[k] for k in steps.tolist()), numbers[-1]]
    return [{"frame_start": start, "frame_end": stop} for start, stop in zip(starts, stops, strict=True)]
