"""Warnings and faults of reading: what was assumed, repaired or left out, counted by kind.

And faults with their locations.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

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
