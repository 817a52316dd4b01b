"""What differs: gathered while two scenes are compared, reported as a list without repetition."""

from dataclasses import dataclass, field
from enum import StrEnum

import msgspec


class Change(StrEnum):
    """What happened on the way from the first scene to the second."""

    ADDED = "added"
    REMOVED = "removed"
    CHANGED = "changed"


class Difference(msgspec.Struct, frozen=True, kw_only=True):
    """One field that differs; of frames all of a sensor together.

    Attributes:
        path: where, in the words of the model; sensors and annotations by id (`sensors['lidar'].frames[].points`).
        change: what happened.
        message: how it differs.
        amount: by how much, the largest of all that differ; None where that is no number.
        unit: of the amount.
        count: in how many frames.
        frame: which frame of the first scene differs most, or first; None for what is in no frame.
    """

    path: str
    change: Change
    message: str
    amount: float | None = None
    unit: str = ""
    count: int = 1
    frame: int | None = None


class SceneDifferences(msgspec.Struct, frozen=True, kw_only=True):
    """The differences of two scenes.

    Attributes:
        differences: all of them, in the order of the fields.
        not_compared: what could not be compared, or only at a price that was not asked for.
    """

    differences: tuple[Difference, ...]
    not_compared: tuple[str, ...] = ()

    @property
    def equal(self) -> bool:
        """Whether nothing differs beyond the tolerances."""
        return not self.differences


@dataclass(slots=True)
class Findings:
    """Gathers differences; those of the frames of one sensor become one."""

    found: dict[tuple[str, Change], Difference] = field(default_factory=dict)
    not_compared: dict[str, None] = field(default_factory=dict)

    def add(
        self,
        path: str,
        change: Change,
        message: str,
        *,
        amount: float | None = None,
        unit: str = "",
        frame: int | None = None,
    ) -> None:
        """Add a difference; of several in frames the largest one is reported."""
        key = (path, change)
        made = Difference(path=path, change=change, message=message, amount=amount, unit=unit, frame=frame)
        before = self.found.get(key)
        if before is not None:
            largest = made if (amount or 0.0) > (before.amount or 0.0) else before
            made = msgspec.structs.replace(largest, count=before.count + 1)
        self.found[key] = made

    def pass_over(self, what: str) -> None:
        """Report that something was not compared."""
        self.not_compared[what] = None

    def reported(self) -> SceneDifferences:
        """All that was found."""
        return SceneDifferences(differences=tuple(self.found.values()), not_compared=tuple(self.not_compared))
