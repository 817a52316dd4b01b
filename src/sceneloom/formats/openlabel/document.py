"""The JSON of a file, and its parts with the locations where they stand."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.errors import DataError
from sceneloom.formats.files import read_bytes

_SHOWN = 60
_LARGEST = 1e150


@dataclass(frozen=True, slots=True)
class Part:
    """A part of a document.

    Attributes:
        file: the document's.
        location: where the part stands in it ("openlabel.frames.3").
        value: as in the file.
    """

    file: Path
    location: str
    value: Any

    def fault(self, expected: str) -> DataError:
        """What is wrong with the part."""
        text = repr(self.value)
        shown = text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"
        return DataError(self.file, self.location, f"{shown}; expected {expected}")

    def members(self) -> dict[str, Any]:
        """The members of an object of JSON.

        Raises:
            DataError: it is none.
        """
        if not isinstance(self.value, dict):
            raise self.fault("an object of JSON")
        return self.value

    def get(self, name: str) -> "Part | None":
        """A member that need not be there; null counts as not there."""
        value = self.members().get(name)
        return None if value is None else Part(self.file, f"{self.location}.{name}", value)

    def need(self, name: str) -> "Part":
        """A member.

        Raises:
            DataError: it is missing.
        """
        found = self.get(name)
        if found is None:
            raise DataError(self.file, f"{self.location}.{name}", "missing")
        return found

    def each(self, name: str) -> Iterator[tuple[str, "Part"]]:
        """The members of a member, by name; none where it is not there."""
        found = self.get(name)
        if found is not None:
            for key, value in found.members().items():
                yield key, Part(self.file, f"{found.location}.{key}", value)

    def items(self, name: str) -> Iterator["Part"]:
        """The elements of a list that is a member; none where it is not there."""
        found = self.get(name)
        if found is not None:
            if not isinstance(found.value, list):
                raise found.fault("a list")
            for k, value in enumerate(found.value):
                yield Part(self.file, f"{found.location}[{k}]", value)

    def text(self) -> str:
        """A text.

        Raises:
            DataError: it is none.
        """
        if not isinstance(self.value, str):
            raise self.fault("a text")
        return self.value

    def numbers(self, counts: Sequence[int] | None = None) -> list[float]:
        """A list of finite numbers.

        Args:
            counts: how many there may be; None: any number.

        Raises:
            DataError: it is none, or of another length.
        """
        values = self.value
        sound = (
            isinstance(values, list)
            and {*map(type, values)} <= {int, float}
            and all(-_LARGEST < end < _LARGEST for end in (min(values, default=0), max(values, default=0)))
        )
        if not sound or (counts is not None and len(values) not in counts):
            listed = " or ".join(map(str, counts or ()))
            raise self.fault(f"a list of {listed + ' ' if listed else ''}numbers")
        return [*map(float, values)]


def read_document(path: Path) -> Part:
    """Read a file.

    Raises:
        DataError: it is no JSON, or has no member `openlabel`.
    """
    try:
        value = msgspec.json.decode(read_bytes(path))
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise DataError(path, "", f"is no JSON: {error}") from error
    if not isinstance(value, Mapping) or not isinstance(value.get("openlabel"), dict):
        raise DataError(path, "", "has no object `openlabel`; expected a file of ASAM OpenLABEL")
    return Part(path, "openlabel", value["openlabel"])
