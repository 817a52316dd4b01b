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
        labels: what people call the parts, by place ("sensors[1]").
    """

    def __init__(self, file: object) -> None:
        """Begin without faults."""
        self.file = file
        self.labels: dict[str, str] = {}
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
            said = [error for error in self._errors if not error.problem.startswith(FILL_IN)]
            lines = [*map(self._told, said), *self._to_fill_in()]
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
        return [
            f"{self._labelled(part)}: {FILL_IN}: {', '.join(names)}" for part, names in open_fields.items()
        ]

    def _labelled(self, place: str) -> str:
        part, dot, rest = place.partition(".")
        return f"{part} ({self.labels[part]}){dot}{rest}" if part in self.labels else place

    def _told(self, error: DataError) -> str:
        if error.file == str(self.file):
            return ": ".join(filter(None, (self._labelled(error.place), error.problem)))
        return str(error)
