"""All that is wrong in a manifest, found in one go."""

from collections.abc import Iterator
from contextlib import contextmanager

from sceneloom.errors import DataError, SceneloomError

SHOWN = 20
"""Lines that an error lists."""

FILL_IN = "still to be filled in"
"""How the problem begins where a template's `nan` still stands."""


class Faults:
    """The faults found so far, each with its location in the manifest.

    Attributes:
        file: the manifest, for messages.
        labels: what people call the parts, by location ("sensors[1]").
    """

    def __init__(self, file: object) -> None:
        """Begin without faults."""
        self.file = file
        self.labels: dict[str, str] = {}
        self._errors: list[DataError] = []

    def add(self, location: str, problem: str) -> None:
        """Note a fault of the manifest."""
        self._errors.append(DataError(self.file, location, problem))

    def __len__(self) -> int:
        return len(self._errors)

    @contextmanager
    def catching(self, location: str) -> Iterator[None]:
        """Note what goes wrong in the block instead of raising it; errors of other files keep their location."""
        try:
            yield
        except DataError as error:
            self._errors.append(error)
        except SceneloomError as error:
            self.add(location, str(error))

    def raise_all(self) -> None:
        """Raise one error that reports all faults, if there is one.

        Raises:
            DataError: the only fault, or the first with all others below it.
        """
        errors = [DataError(e.file, self._labelled(e), e.problem) for e in self._errors]
        if len(errors) == 1:
            raise errors[0]
        if errors:
            stated = [self._reported(error) for error in errors if not error.problem.startswith(FILL_IN)]
            lines = [*stated, *self._to_fill_in(errors)]
            if len(lines) > SHOWN:
                lines[SHOWN:] = [f"… and {len(lines) - SHOWN} lines more"]
            raise DataError(self.file, "", "\n  ".join([f"{len(errors)} faults", *lines]))

    def _labelled(self, error: DataError) -> str:
        part, dot, rest = error.location.partition(".")
        known = part in self.labels and error.file == str(self.file)
        return f"{part} ({self.labels[part]}){dot}{rest}" if known else error.location

    def _reported(self, error: DataError) -> str:
        if error.file == str(self.file):
            return ": ".join(filter(None, (error.location, error.problem)))
        return str(error)

    @staticmethod
    def _to_fill_in(errors: list[DataError]) -> list[str]:
        """One line per sensor for all that a template left open."""
        open_fields: dict[str, list[str]] = {}
        for error in errors:
            if error.problem.startswith(FILL_IN):
                part, _, name = error.location.partition(".")
                open_fields.setdefault(part, []).append(name)
        return [f"{part}: {FILL_IN}: {', '.join(names)}" for part, names in open_fields.items()]
