"""What is wrong at a place of a file, and the ledger that keeps every such fault."""

from dataclasses import dataclass

from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats.ledger import Ledger

MALFORMED = "malformed"
"""The code of a fault that has no code of its own."""


@dataclass(frozen=True, slots=True)
class PlacedFault:
    """One thing that is wrong in a file.

    Attributes:
        path: where (`sensors[3].frames[12].points.colors` of a header, `data.jsonl: line 12` of a folder).
        problem: what, with the value and what was expected.
        code: the kind of fault, kebab case.
        mended: whether it was brought into order on reading.
        vital: whether no scene can do without the part that is at fault.
        item: number of the item that fills the place, where it is an array of a scene file.
    """

    path: str
    problem: str
    code: str = MALFORMED
    mended: bool = False
    vital: bool = False
    item: int | None = None

    @property
    def where(self) -> str:
        """The path, with the item's number where there is one."""
        return self.path if self.item is None else f"{self.path} ($items[{self.item}])"


class FaultLedger(Ledger):
    """A ledger that passes over faults and keeps each of them, with its place.

    Attributes:
        faults: in the order in which they came up.
    """

    def __init__(self, folder: object) -> None:
        """Begin with none.

        Args:
            folder: what is read; places are told from there on.
        """
        super().__init__(lenient=True)
        self.faults: list[PlacedFault] = []
        self._folder = str(folder)

    def fault(self, code: str, error: SceneloomError, *, count: int = 1) -> None:
        """Keep a fault."""
        del count
        self.faults.append(placed(error, code, self._folder))


def placed(error: SceneloomError, code: str, folder: str) -> PlacedFault:
    """An error as a fault, its file told from the folder on."""
    if not isinstance(error, DataError):
        return PlacedFault("", str(error).removeprefix(f"{folder}/"), code)
    file = error.file.removeprefix(folder).lstrip("/")
    return PlacedFault(": ".join(filter(None, (file, error.place))), error.problem, code)
