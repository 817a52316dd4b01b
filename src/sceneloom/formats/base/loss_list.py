"""Losses as a writer finds them, one after the other."""

from collections.abc import Iterable, Iterator

from sceneloom.formats.base.losses import Loss, Support


class Losses:
    """Collects what a target cannot hold; those of one field and kind are added up, and a count of 0 is no loss."""

    def __init__(self, losses: Iterable[Loss] = ()) -> None:
        """Begin with some losses, or none."""
        self._found: dict[tuple[str, str, str | None, Support], Loss] = {}
        self.extend(losses)

    def __iter__(self) -> Iterator[Loss]:
        return iter(self._found.values())

    @property
    def all(self) -> list[Loss]:
        """All losses, in the order in which they first came up."""
        return [*self]

    def extend(self, losses: Iterable[Loss]) -> None:
        """Add losses that others found."""
        for loss in losses:
            if loss.count > 0:
                earlier = self._found.get(loss.kind)
                self._found[loss.kind] = loss if earlier is None else earlier.joined(loss)

    def dropped(self, field: str, what: str, *, count: int = 1, kept: str | None = None) -> None:
        """Something is not in the target, or stands in it under another name: `kept`."""
        self.extend([Loss(field=field, what=what, count=count, kept=kept)])

    def converted(self, field: str, what: str, *, count: int = 1, error: float | None = None) -> None:
        """Something is stated in another way."""
        self.extend([Loss(field=field, what=what, count=count, support=Support.CONVERTED, largest_error=error)])

    def approximated(self, field: str, what: str, *, count: int = 1, error: float | None = None) -> None:
        """Something is replaced by something near."""
        self.extend([Loss(field=field, what=what, count=count, support=Support.APPROXIMATED, largest_error=error)])

    def kept(self, field: str, what: str) -> None:
        """Something that is worth a remark, though nothing is lost."""
        self.extend([Loss(field=field, what=what, support=Support.KEPT)])
