"""All that is wrong in a manifest, found in one go."""

from collections.abc import Iterator
from contextlib import contextmanager

from sceneloom.errors import DataError, SceneloomError

SHOWN = 20
"""Faults that an error lists."""


class Faults:
    """The faults found so far, each with its place in the manifest.

    Attributes:
        file: the manifest, for messages.
    """

    def __init__(self, file: object) -> None:
        """Begin without faults."""
        self.file = file
        self._errors: list[DataError] = []

    def add(self, place: str, problem: str) -> None:
        """Note a fault of the manifest."""
        self._errors.append(DataError(self.file, place, problem))

    def __len__(self) -> int:
        return len(self._errors)

    @contextmanager
    def catching(self, place: str) -> Iterator[None]:
        """Note what goes wrong in the block instead of raising it; errors of other files keep their place."""
        try:
            yield
        except DataError as error:
            self._errors.append(error)
        except SceneloomError as error:
            self.add(place, str(error))

    def raise_all(self) -> None:
        """Raise one error that tells all faults, if there is one.

        Raises:
            DataError: the only fault, or the first with all others below it.
        """
        if len(self._errors) == 1:
            raise self._errors[0]
        if self._errors:
            lines = [_told(error, self.file) for error in self._errors[:SHOWN]]
            if len(self._errors) > SHOWN:
                lines.append(f"… and {len(self._errors) - SHOWN} more")
            raise DataError(self.file, "", "\n  ".join([f"{len(self._errors)} faults", *lines]))


def _told(error: DataError, file: object) -> str:
    parts = (
        (error.place, error.problem) if error.file == str(file) else (error.file, error.place, error.problem)
    )
    return ": ".join(filter(None, parts))
