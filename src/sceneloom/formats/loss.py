"""What a target format could not hold, field by field."""

from collections.abc import Iterable, Iterator, Mapping
from enum import StrEnum

import msgspec


class Support(StrEnum):
    """What becomes of a field of the scene in a target."""

    KEPT = "kept"
    """Read back, it is the same."""
    CONVERTED = "converted"
    """Stated in another way (other units, types, frames), with no more error than the rounding of that."""
    APPROXIMATED = "approximated"
    """Replaced by something near, such as another model of the camera model or a compressed image."""
    DROPPED = "dropped"
    """Not in the target."""


class Holding(msgspec.Struct, frozen=True):
    """What a format makes of one field of the scene, whatever the scene.

    Attributes:
        support: what becomes of it.
        how: how it is converted or approximated, or why it is dropped, for a person; empty if it is kept.
    """

    support: Support
    how: str = ""


Supports = Mapping[str, Holding]
"""Names of fields, or beginnings of them that end at a dot, and what becomes of these; "" is for all the rest."""

KEPT = Holding(Support.KEPT)


def converted(how: str) -> Holding:
    """A field that is stated in another way."""
    return Holding(Support.CONVERTED, how)


def approximated(how: str) -> Holding:
    """A field that is replaced by something near."""
    return Holding(Support.APPROXIMATED, how)


def dropped(why: str) -> Holding:
    """A field that the format has no field for."""
    return Holding(Support.DROPPED, why)


class Loss(msgspec.Struct, frozen=True, kw_only=True):
    """One kind of loss.

    Attributes:
        field: name of the field out of `MODEL_FIELDS`, or a beginning of it where all below is meant; the id of the
            sensor or annotation may stand instead of its kind (`sensors[top].frames[].points.intensities`), the name
            of a trajectory and keys may be in it (`trajectories[vio].covariances`, `metadata.weather`).
        what: what happened to it, for a person ("rounded to microseconds, at most 0.5 µs").
        count: how many values or objects it happened to.
        kept: where the exact value stands in the target all the same ("metadata.sceneloom.imu"), or None.
        support: what became of it.
        largest_error: how far the worst value is off, in the unit that `what` names; None where that means nothing.
    """

    field: str
    what: str
    count: int = 1
    kept: str | None = None
    support: Support = Support.DROPPED
    largest_error: float | None = None


class LossReport(msgspec.Struct, frozen=True):
    """All losses of one writing; empty where the target holds everything."""

    losses: tuple[Loss, ...] = ()

    def __len__(self) -> int:
        return len(self.losses)

    def __iter__(self) -> Iterator[Loss]:
        return iter(self.losses)

    @classmethod
    def of(cls, losses: Iterable[Loss]) -> "LossReport":
        """Collect losses; those of one field and kind are added up, and the largest error of them is reported."""
        together: dict[tuple[str, str, str | None, Support], Loss] = {}
        for loss in losses:
            key = (loss.field, loss.what, loss.kept, loss.support)
            earlier = together.get(key)
            together[key] = loss if earlier is None else joined(earlier, loss)
        return cls(tuple(together.values()))


def joined(first: Loss, second: Loss) -> Loss:
    """Two losses of one kind as one: counts are added, the largest error counts."""
    errors = [loss.largest_error for loss in (first, second) if loss.largest_error is not None]
    return msgspec.structs.replace(
        first, count=first.count + second.count, largest_error=max(errors, default=None)
    )
