"""Warnings and faults of reading: what was assumed, repaired or left out, counted by kind.

And faults with their locations.
"""

import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from sceneloom.errors import DataError, SceneloomError
from sceneloom.warnings import DataWarning, WarningKind


@dataclass(slots=True)
class _Entry:
    kind: WarningKind
    code: str
    location: str
    message: str
    count: int


class Ledger:
    """Collects warnings; a fault is raised, or counted and passed over in a lenient reading.

    Attributes:
        lenient: whether faults are passed over.
    """

    def __init__(self, *, lenient: bool) -> None:
        """Begin with no warnings."""
        self.lenient = lenient
        self._entries: dict[str, _Entry] = {}

    def fault(self, code: str, error: SceneloomError, *, count: int = 1) -> None:
        """Raise the error, or count it as something left out.

        Args:
            code: kind of fault, kebab case; faults of one code become one warning that quotes the first.
            error: names file, location, value and what was expected.
            count: how many things a lenient reading leaves out for it.
        """
        if not self.lenient:
            raise error
        location = ": ".join(filter(None, (error.file, error.location))) if isinstance(error, DataError) else ""
        problem = error.problem if isinstance(error, DataError) else str(error)
        self._add(code, WarningKind.SKIPPED, code, location, f"left out: {problem}", count)

    def refuse(self, code: str, error: SceneloomError) -> None:
        """Raise the error even in a lenient reading: what the rest means depends on the part that is at fault.

        Args:
            code: kind of fault, kebab case.
            error: as for `fault`.
        """
        del code
        raise error

    def note(self, kind: WarningKind, code: str, location: str, message: str, *, count: int = 1) -> None:
        """Add a warning; of several with one message the first one's location is kept, and the counts are added."""
        self._add(f"{code}: {message}", kind, code, location, message, count)

    def _add(self, key: str, kind: WarningKind, code: str, location: str, message: str, count: int) -> None:
        entry = self._entries.setdefault(key, _Entry(kind, code, location, message, 0))
        entry.count += count

    @contextmanager
    def telling(self) -> Iterator[None]:
        """Let errors take along what was noticed before them."""
        try:
            yield
        except SceneloomError as error:
            error.remember(self.warnings)
            raise

    @property
    def warnings(self) -> tuple[DataWarning, ...]:
        """All warnings, in the order in which they first came up."""
        return tuple(
            DataWarning(
                kind=entry.kind, code=entry.code, location=entry.location, message=entry.message, count=entry.count
            )
            for entry in self._entries.values()
        )


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
        # lidar files are known by where links lead
        top = folder if error.file.startswith(folder) else f"{Path(folder).resolve()}/"
        file = error.file.removeprefix(top).lstrip("/")
        return PlacedFault(": ".join(filter(None, (file, error.location))), error.problem, code)
    text = str(error)
    if not text.startswith(f"{folder}/"):
        return PlacedFault("", text, code)
    location = _LOCATION.match(text.removeprefix(f"{folder}/"))
    if location is None:
        return PlacedFault("", text.removeprefix(f"{folder}/"), code)
    return PlacedFault(location[0].removesuffix(": "), text.removeprefix(f"{folder}/{location[0]}"), code)


_LOCATION = re.compile(r"(?:(?:line \d+|[^\s:]+): )+")  # file, line and path with which a message begins
