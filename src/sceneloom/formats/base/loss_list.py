"""Losses as a writer finds them, one after the other."""

from collections.abc import Iterable, Iterator

from sceneloom.formats.base.losses import Loss, Support


class Losses:
    """Collects what a target cannot hold; a count of 0 is no loss."""

    def __init__(self, losses: Iterable[Loss] = ()) -> None:
        """Begin with some losses, or none."""
        self.all: list[Loss] = [*losses]

    def __iter__(self) -> Iterator[Loss]:
        return iter(self.all)

    def extend(self, losses: Iterable[Loss]) -> None:
        """Add losses that others found."""
        self.all.extend(losses)

    def dropped(self, field: str, what: str, *, count: int = 1) -> None:
        """Something is not in the target."""
        self._add(Loss(field=field, what=what, count=count))

    def converted(self, field: str, what: str, *, count: int = 1, error: float | None = None) -> None:
        """Something is stated in another way."""
        self._add(Loss(field=field, what=what, count=count, support=Support.CONVERTED, largest_error=error))

    def approximated(self, field: str, what: str, *, count: int = 1, error: float | None = None) -> None:
        """Something is replaced by something near."""
        self._add(Loss(field=field, what=what, count=count, support=Support.APPROXIMATED, largest_error=error))

    def _add(self, loss: Loss) -> None:
        if loss.count > 0:
            self.all.append(loss)
