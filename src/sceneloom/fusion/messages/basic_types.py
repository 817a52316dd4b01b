"""The basic types of table 1, and the exact check of one value of each."""

import math
import sys
from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.errors import DataError


class BasicType(StrEnum):
    """A type of table 1."""

    BOOL = "bool"
    INT8 = "int8"
    UINT8 = "uint8"
    INT32 = "int32"
    UINT32 = "uint32"
    FLOAT = "float"
    DOUBLE = "double"
    STRING = "string"
    ENUM = "enum"


INTEGER_RANGES: Mapping[BasicType, tuple[int, int]] = MappingProxyType(
    {
        BasicType.BOOL: (0, 1),
        BasicType.INT8: (-(2**7), 2**7 - 1),
        BasicType.UINT8: (0, 2**8 - 1),
        BasicType.INT32: (-(2**31), 2**31 - 1),
        BasicType.UINT32: (0, 2**32 - 1),
        BasicType.ENUM: (-(2**31), 2**31 - 1),
    }
)
"""Smallest and largest value of each type of whole numbers; an enumeration's numbers are of 32 bits."""

FLOAT_BOUND = float(2**128 - 2**103)
"""Numbers below it, whose nearest number of 32 bits is finite, can be a `float`: half a step beyond the largest one."""

_LONGEST_SHOWN = 60


def shown(value: object) -> str:
    """A value as it stands in a message, cut where it is long."""
    if isinstance(value, int) and value.bit_length() > 256:
        return f"a whole number of {value.bit_length()} bits"
    if isinstance(value, np.ndarray):
        return f"an array {value.shape} of {value.dtype.name}"
    if isinstance(value, list | tuple | dict) and len(value) > 16:
        return f"a {type(value).__name__} of {len(value)}"
    if isinstance(value, str | bytes) and len(value) > _LONGEST_SHOWN:
        return f"{value[:_LONGEST_SHOWN]!r}…"
    text = repr(value)
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}…"


def is_number(value: object) -> bool:
    """Whether a value is one whole or broken number, and neither a truth value nor a text."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def check_basic(kind: BasicType, value: Any, *, owner: str = "value", location: str = "") -> Any:
    """Check one value exactly: nothing wraps, nothing is cut, nothing is infinite.

    Args:
        kind: what it has to be.
        value: what it is; whole numbers of NumPy are whole numbers.
        owner: what it belongs to, for the message.
        location: the field, for the message.

    Returns:
        0 or 1 for a `bool`; an int; a float, for `float` the nearest number of 32 bits; a str; of an `enum` its number
        or its name.

    Raises:
        DataError: it is of another type or out of range.
    """
    if kind in (BasicType.FLOAT, BasicType.DOUBLE):
        return _broken_number(kind, value, owner, location)
    if kind is BasicType.STRING or (kind is BasicType.ENUM and isinstance(value, str)):
        return _text(value, owner, location)
    return _whole_number(kind, value, owner, location)


def _whole_number(kind: BasicType, value: Any, owner: str, location: str) -> int:
    low, high = INTEGER_RANGES[kind]
    truth = isinstance(value, bool | np.bool_)
    if (isinstance(value, int | np.integer) or truth) and truth <= (kind is BasicType.BOOL):
        number = int(value)
        if low <= number <= high:
            return number
    raise DataError(owner, location, f"{shown(value)}; expected a {kind}, {low} to {high}")


def _broken_number(kind: BasicType, value: Any, owner: str, location: str) -> float:
    bound = FLOAT_BOUND if kind is BasicType.FLOAT else math.inf
    if is_number(value) and -bound < value < bound and abs(value) <= sys.float_info.max:
        return float(np.float32(value)) if kind is BasicType.FLOAT else float(value)
    raise DataError(owner, location, f"{shown(value)}; expected a finite {kind}")


def _text(value: Any, owner: str, location: str) -> str:
    if not isinstance(value, str):
        raise DataError(owner, location, f"{shown(value)}; expected a string")
    try:
        value.encode("utf-8")
    except UnicodeEncodeError as error:
        raise DataError(owner, location, f"{shown(value)}; expected text that UTF-8 can hold") from error
    return value
