"""The types of properties and fields: a type of table 1, a tuple of them, or an array."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from sceneloom.errors import DataError
from sceneloom.fusion.messages.basic_types import BasicType, check_basic, shown

_TUPLE = re.compile(r"\(([^()]*)\)")
_ARRAY = re.compile(r"(\w+)\s*\[\s*(\d{0,9})\s*\]")
_LONGEST_TUPLE = 255


class ValueForm(StrEnum):
    """How many values there are."""

    SCALAR = "scalar"
    TUPLE = "tuple"
    ARRAY = "array"


@dataclass(frozen=True, slots=True)
class ValueType:
    """What a value has to be.

    Attributes:
        form: one value, a tuple of values with a type each, or an array of one type.
        elements: the types; of an array its one type.
        length: how many values an array has; None for any number.

    Source: DB34/T 4101-2022, tables 1 to 3, which write `uint32`, `(int8, int8, int8)`, `uint32[2]` and `float[]`.
    """

    form: ValueForm
    elements: tuple[BasicType, ...]
    length: int | None = None

    @classmethod
    def parse(cls, text: str) -> "ValueType":
        """Read a type as the standard writes it.

        Raises:
            DataError: it is not one.
        """
        plain = text.strip() if isinstance(text, str) else ""
        if (found := _TUPLE.fullmatch(plain)) is not None:
            names = found[1].removesuffix(",").split(",")
            if len(names) <= _LONGEST_TUPLE:
                return cls(ValueForm.TUPLE, tuple(_basic(name.strip(), text) for name in names))
        elif (found := _ARRAY.fullmatch(plain)) is not None:
            length = int(found[2]) if found[2] else None
            if length != 0:
                return cls(ValueForm.ARRAY, (_basic(found[1], text),), length)
        elif plain:
            return cls(ValueForm.SCALAR, (_basic(plain, text),))
        raise DataError("type", "", f"{shown(text)}; expected {_known()}")

    def __str__(self) -> str:
        if self.form is ValueForm.TUPLE:
            return f"({', '.join(self.elements)})"
        if self.form is ValueForm.ARRAY:
            return f"{self.elements[0]}[{'' if self.length is None else self.length}]"
        return str(self.elements[0])

    def check(self, value: Any, *, owner: str = "value", location: str = "") -> Any:
        """Check a value exactly, as `check_basic` does for one.

        Args:
            value: one value, or a list, tuple or array of one dimension.
            owner: what it belongs to, for the message.
            location: the field, for the message.

        Returns:
            The value, of a tuple or an array a tuple.

        Raises:
            DataError: it is of another type, out of range, or there are more or fewer values.
        """
        if self.form is ValueForm.SCALAR:
            return check_basic(self.elements[0], value, owner=owner, location=location)
        values = self._listed(value, owner, location)
        elements = self.elements if self.form is ValueForm.TUPLE else self.elements * len(values)
        return tuple(
            check_basic(element, item, owner=owner, location=f"{location}[{k}]")
            for k, (element, item) in enumerate(zip(elements, values, strict=True))
        )

    def _listed(self, value: Any, owner: str, location: str) -> Sequence[Any]:
        if isinstance(value, np.ndarray) and value.ndim == 1:
            value = value.tolist()
        count = len(self.elements) if self.form is ValueForm.TUPLE else self.length
        if not isinstance(value, list | tuple) or count not in (None, len(value)):
            raise DataError(owner, location, f"{shown(value)}; expected {self}")
        return value


def _basic(name: str, text: str) -> BasicType:
    try:
        return BasicType(name)
    except ValueError:
        raise DataError("type", "", f"{shown(text)}; expected {_known()}") from None


def _known() -> str:
    return (
        f"one of {', '.join(BasicType)}, a tuple of them as (int8, int8), or an array as double[9], string[]"
    )
