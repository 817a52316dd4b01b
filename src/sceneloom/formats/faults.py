"""What is wrong at a location of a file, and the ledger that keeps every such fault."""

import re
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats.ledger import Ledger

MALFORMED = "malformed"
"""The code of a fault that has no code of its own."""

MOST_LOCATIONS = 1000
"""So many faults of one code a ledger keeps with their locations; further ones are counted."""


@dataclass(frozen=True, slots=True)
class PlacedFault:
    """One thing that is wrong in a file.

    Attributes:
        path: where (`sensors[3].frames[12].points.colors` of a header, `data.jsonl: line 12` of a folder).
        problem: what, with the value and what was expected.
        code: the kind of fault, kebab case.
        repaired: whether it was brought into order on reading.
        vital: whether no scene can do without the part that is at fault.
        item: number of the item that fills the location, where it is an array of a scene file.
        count: how many faults it stands for.
        costs: what cannot be read because of it, for people (`frame 12 of lidar 'top'`); empty where that is not known.
    """

    path: str
    problem: str
    code: str = MALFORMED
    repaired: bool = False
    vital: bool = False
    item: int | None = None
    count: int = 1
    costs: str = ""

    @property
    def where(self) -> str:
        """The path, with the item's number where there is one."""
        return self.path if self.item is None else f"{self.path} ($items[{self.item}])"


@dataclass(slots=True)
class _Further:
    """Faults of one code that are only counted, and the last of them."""

    count: int
    last: SceneloomError


class FaultLedger(Ledger):
    """A ledger that passes over faults and keeps each with its location; of very many, it counts those beyond."""

    def __init__(self, folder: object) -> None:
        """Begin with none.

        Args:
            folder: what is read; locations are distinguished from there on.
        """
        super().__init__(lenient=True)
        self._kept: list[PlacedFault] = []
        self._counts: Counter[str] = Counter()
        self._further: dict[str, _Further] = {}
        self._folder = str(folder)

    def fault(self, code: str, error: SceneloomError, *, count: int = 1) -> None:
        """Keep a fault."""
        del count
        self._counts[code] += 1
        if self._counts[code] <= MOST_LOCATIONS:
            self._kept.append(placed(error, code, self._folder))
            return
        further = self._further.setdefault(code, _Further(0, error))
        further.count += 1
        further.last = error

    def refuse(self, code: str, error: SceneloomError) -> None:
        """Keep a fault that decides what the rest means."""
        self._kept.append(replace(placed(error, code, self._folder), vital=True))

    @property
    def faults(self) -> tuple[PlacedFault, ...]:
        """In the order in which they came up; after them, those that were only counted, one for each code."""
        return (*self._kept, *(self._counted(code, further) for code, further in self._further.items()))

    def _counted(self, code: str, further: _Further) -> PlacedFault:
        last = placed(further.last, code, self._folder)
        problem = f"the last of {further.count} more: {last.problem}"
        return replace(last, problem=problem, count=further.count)


def placed(error: SceneloomError, code: str, folder: str) -> PlacedFault:
    """An error as a fault, its file distinguished from the folder on."""
    if isinstance(error, DataError):
        file = _from(folder, error.file)
        return PlacedFault(": ".join(filter(None, (file, error.location))), error.problem, code)
    text = str(error)
    if not text.startswith(f"{folder}/"):
        return PlacedFault("", text, code)
    location = _LOCATION.match(text.removeprefix(f"{folder}/"))
    if location is None:
        return PlacedFault("", text.removeprefix(f"{folder}/"), code)
    return PlacedFault(location[0].removesuffix(": "), text.removeprefix(f"{folder}/{location[0]}"), code)


def _from(folder: str, file: str) -> str:
    """A file distinguished from the folder on; lidar files are known by where links lead."""
    links_resolved = f"{Path(folder).resolve()}/"
    return file.removeprefix(folder if file.startswith(folder) else links_resolved).lstrip("/")


_LOCATION = re.compile(r"(?:(?:line \d+|[^\s:]+): )+")
"""File, line and path with which a message begins."""
