"""Lines of numbers as templates: text with gaps for numbers."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec

TIME, ROW = -1, -2
"""Slots of the time, and of all numbers of a row with commas between them."""


@dataclass(frozen=True, slots=True)
class Slot:
    """Where a number goes.

    Attributes:
        source: which number of a row, or `TIME`, or `ROW`.
    """

    source: int


@dataclass(frozen=True, slots=True)
class LineTemplate:
    """A line with gaps.

    Attributes:
        text: with `%s` for each gap.
        slots: what goes into each, in order.
    """

    text: str
    slots: tuple[int, ...]


def line_template(fields: Mapping[str, Any]) -> LineTemplate:
    """Make a template of the fields of a line, with slots for its numbers."""
    slots: list[int] = []
    text = _text(fields, slots)
    return LineTemplate(text, tuple(slots))


def _text(value: object, slots: list[int]) -> str:
    if isinstance(value, Slot):
        slots.append(value.source)
        return "[%s]" if value.source == ROW else "%s"
    if isinstance(value, dict):
        return "{" + ",".join(f"{_quoted(key)}:{_text(part, slots)}" for key, part in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ",".join(_text(part, slots) for part in value) + "]"
    return _quoted(value)


def _quoted(value: object) -> str:
    """A constant as JSON text that can stand in a template."""
    return msgspec.json.encode(value).decode().replace("%", "%%")
