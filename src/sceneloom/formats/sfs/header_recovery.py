"""Headers that are cut off or damaged: what stands complete before the damage, and the list of arrays behind it."""

import json
from json.decoder import scanstring  # type: ignore[attr-defined]
from typing import Any

import msgspec

from sceneloom.errors import DataError
from sceneloom.formats.sfs.items import ITEMS, format_keys

_BLANK = " \t\r\n"
_OURS = ("metadata", "sceneloom")
_TAKEN_APART = frozenset(
    {
        ("sensors",),
        ("annotations",),
        ("attributes",),
        ("metadata",),
        _OURS,
        *(
            (*_OURS, name)
            for name in ("sensors", "annotations", "attributes", "trajectories", "sensor_notes")
        ),
    }
)
"""Objects and lists of which a part is worth something; everything below them is whole or lost."""


def recover_header(text: memoryview, file: str) -> tuple[Any, list[tuple[str, str, int]]]:
    """Decode a header as far as it is whole.

    Returns:
        The header, and what is lost of it: location, problem, bytes.

    Raises:
        DataError: nothing of it can be read.
    """
    content = bytes(text)
    if not content.strip():
        raise DataError(
            file,
            "header",
            "the space for it is empty: this is the draft of a writer that was stopped before it could write the "
            "header, and nothing else says what the arrays are; record or convert the drive again",
        )
    try:
        return msgspec.json.decode(content), []
    except (ValueError, RecursionError):
        return _Recovery(content.decode("utf-8", "replace"), file).run()


class _Recovery:
    """Reads JSON up to the first damage."""

    def __init__(self, text: str, file: str) -> None:
        self._text, self._file = text, file
        self._decoder = json.JSONDecoder()
        self._broken = -1
        self._lost: list[tuple[str, str, int]] = []

    def run(self) -> tuple[Any, list[tuple[str, str, int]]]:
        start = self._skip(0)
        if not self._text.startswith("{", start):
            raise DataError(
                self._file, "header", "does not begin as the header of a scene; nothing can be reported"
            )
        header = self._object(start, ())[0]
        if self._broken >= 0 and ITEMS not in header:
            self._find_items(header)
        return header, self._lost

    def _object(self, location: int, keys: tuple[Any, ...]) -> tuple[dict[str, Any], int]:
        """Read members until one is damaged."""
        found: dict[str, Any] = {}
        location = self._skip(location + 1)
        while self._text[location : location + 1] not in {"}", ""}:
            try:
                name, location = self._name(location)
                found[name], location = self._value(location, (*keys, name))
            except _DamageError:
                return found, self._note(location, (*keys, "…"))
            if self._broken >= 0:
                return found, location
            location = self._after(location, keys)
        return found, self._closed(location, "}", keys)

    def _list(self, location: int, keys: tuple[Any, ...]) -> tuple[list[Any], int]:
        """Read entries until one is damaged."""
        found: list[Any] = []
        location = self._skip(location + 1)
        while self._text[location : location + 1] not in {"]", ""}:
            try:
                value, location = self._value(location, (*keys, len(found)))
            except _DamageError:
                return found, self._note(location, (*keys, len(found)))
            found.append(value)
            if self._broken >= 0:
                return found, location
            location = self._after(location, keys)
        return found, self._closed(location, "]", keys)

    def _name(self, location: int) -> tuple[str, int]:
        if not self._text.startswith('"', location):
            raise _DamageError
        try:
            name, location = scanstring(self._text, location + 1)
        except ValueError:
            raise _DamageError from None
        location = self._skip(location)
        if not self._text.startswith(":", location):
            raise _DamageError
        return name, self._skip(location + 1)

    def _value(self, location: int, keys: tuple[Any, ...]) -> tuple[Any, int]:
        try:
            value, stop = self._decoder.raw_decode(self._text, location)
        except (ValueError, RecursionError):
            readers = {"{": self._object, "[": self._list} if keys in _TAKEN_APART else {}
            reader = readers.get(self._text[location : location + 1])
            if reader is None:
                raise _DamageError from None
            return reader(location, keys)
        if isinstance(value, int | float) and stop == len(self._text):
            raise _DamageError  # further digits may have stood behind the cut
        return value, stop

    def _after(self, location: int, keys: tuple[Any, ...]) -> int:
        """Go over the comma behind a value; what stands there else is damage."""
        location = self._skip(location)
        if self._text.startswith(",", location):
            return self._skip(location + 1)
        if self._text[location : location + 1] not in {"}", "]", ""}:
            return self._note(location, keys)
        return location

    def _closed(self, location: int, bracket: str, keys: tuple[Any, ...]) -> int:
        if self._broken < 0 and self._text.startswith(bracket, location):
            return location + 1
        return location if self._broken >= 0 else self._note(location, keys)

    def _note(self, location: int, keys: tuple[Any, ...]) -> int:
        """Remember where the damage is; what comes after it is lost."""
        if self._broken < 0:
            self._broken = location
            size = len(self._text[location:].encode("utf-8", "replace"))
            problem = "the header is cut off or damaged here; what follows is lost"
            self._lost.append((format_keys(keys) or "header", problem, size))
        return len(self._text)

    def _find_items(self, header: dict[str, Any]) -> None:
        """Find the list of arrays behind the damage; it stands last, and each of its entries says where it belongs."""
        location = self._text.rfind(f'"{ITEMS}"', self._broken)
        if location < 0:
            return
        self._broken = -1
        try:
            _, location = self._name(location)
            items, _ = self._decoder.raw_decode(self._text, location)
        except (_DamageError, ValueError, RecursionError):
            return
        if isinstance(items, list):
            header[ITEMS] = items

    def _skip(self, location: int) -> int:
        """Go over blanks."""
        while location < len(self._text) and self._text[location] in _BLANK:
            location += 1
        return location


class _DamageError(Exception):
    """Something is not whole here."""
