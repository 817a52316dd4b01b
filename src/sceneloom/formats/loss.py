"""What a target format could not hold, field by field."""

from collections.abc import Iterable, Iterator

import msgspec


class Loss(msgspec.Struct, frozen=True, kw_only=True):
    """One kind of loss.

    Attributes:
        field: path inside the scene (`sensors[lidar].frames[].points.timestamps`).
        what: what happened to it, for a person ("rounded to microseconds, at most 0.5 µs").
        count: how many values or objects it happened to.
        kept: where the exact value stands in the target all the same ("metadata.sceneloom.imu"), or None.
    """

    field: str
    what: str
    count: int = 1
    kept: str | None = None


class LossReport(msgspec.Struct, frozen=True):
    """All losses of one writing; empty where the target holds everything."""

    losses: tuple[Loss, ...] = ()

    def __len__(self) -> int:
        return len(self.losses)

    def __iter__(self) -> Iterator[Loss]:
        return iter(self.losses)

    @classmethod
    def of(cls, losses: Iterable[Loss]) -> "LossReport":
        """Collect losses; those of one field and kind are added up."""
        counts: dict[tuple[str, str, str | None], int] = {}
        for loss in losses:
            key = (loss.field, loss.what, loss.kept)
            counts[key] = counts.get(key, 0) + loss.count
        return cls(tuple(Loss(field=f, what=w, count=n, kept=k) for (f, w, k), n in counts.items()))
