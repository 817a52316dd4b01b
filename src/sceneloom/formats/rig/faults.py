"""All that is wrong in a manifest, found in one go."""

from collections.abc import Iterator
from contextlib import contextmanager

from sceneloom.errors import DataError, SceneloomError

SHOWN = 20
"""Lines that an error lists."""

FILL_IN = "still to be filled in"
"""How the problem begins where a template's `nan` still stands."""


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
            lines = [
                _told(error, self.file) for error in self._errors if not error.problem.startswith(FILL_IN)
            ]
            lines += self._to_fill_in()
            if len(lines) > SHOWN:
                lines[SHOWN:] = [f"… and {len(lines) - SHOWN} lines more"]
            raise DataError(self.file, "", "\n  ".join([f"{len(self._errors)} faults", *lines]))

    def _to_fill_in(self) -> list[str]:
        """One line per sensor for all that a template left open."""
        open_fields: dict[str, list[str]] = {}
        for error in self._errors:
            if error.problem.startswith(FILL_IN):
                part, _, name = error.place.partition(".")
                open_fields.setdefault(part, []).append(name)
        return [f"{part}: {FILL_IN}: {', '.join(names)}" for part, names in open_fields.items()]


def _told(error: DataError, file: object) -> str:
    parts = (
        (error.place, error.problem) if error.file == str(file) else (error.file, error.place, error.problem)
    )
    return ": ".join(filter(None, parts))
