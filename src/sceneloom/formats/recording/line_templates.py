"""Lines of numbers as templates: text with gaps for numbers, in the order of keys that a file had."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec

from sceneloom.formats.recording.json_faults import DECODER_FAULTS

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


def line_template(fields: Mapping[str, Any], form: str | None = None) -> LineTemplate:
    """Make a template.

    Args:
        fields: of the line, with slots for its numbers.
        form: a line with the order of keys that is wanted.
    """
    slots: list[int] = []
    text = _text(arranged(fields, _example(form)), slots)
    return LineTemplate(text, tuple(slots))


def arranged(fields: Mapping[str, Any], example: object) -> dict[str, Any]:
    """Put fields, and those inside them, into the order of an example; those that it has none of come last."""
    if not isinstance(example, dict):
        return dict(fields)
    keys = [*(key for key in example if key in fields), *(key for key in fields if key not in example)]
    return {
        key: arranged(fields[key], example.get(key)) if isinstance(fields[key], dict) else fields[key]
        for key in keys
    }


def example_of(form: str | None) -> dict[str, Any] | None:
    """Parse a line that shows an order of keys, None for none."""
    example = _example(form)
    return example if isinstance(example, dict) else None


def _example(form: str | None) -> object:
    try:
        return None if form is None else msgspec.json.decode(form)
    except DECODER_FAULTS:
        return None


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
