"""Types of DB34/T 4101-2022: those of table 1, tuples and arrays of them, timestamps, arrays as bytes, and outcomes."""

import math
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray
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
    """A value in a message, cut where it is long."""
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


def _check_basic(kind: BasicType, value: Any, owner: str, location: str) -> Any:
    """Check one value exactly: a `bool` gives 0 or 1, a `float` the nearest 32-bit number."""
    if kind in (BasicType.FLOAT, BasicType.DOUBLE):
        bound = FLOAT_BOUND if kind is BasicType.FLOAT else math.inf
        known = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
        if known and -bound < value < bound and abs(value) <= sys.float_info.max:
            return float(np.float32(value)) if kind is BasicType.FLOAT else float(value)
        raise DataError(owner, location, f"{shown(value)}; expected a finite {kind}")
    if kind is BasicType.STRING or (kind is BasicType.ENUM and isinstance(value, str)):
        if not isinstance(value, str):
            raise DataError(owner, location, f"{shown(value)}; expected a string")
        try:
            value.encode("utf-8")
        except UnicodeEncodeError as error:
            raise DataError(owner, location, f"{shown(value)}; expected text that UTF-8 can hold") from error
        return value
    low, high = INTEGER_RANGES[kind]
    truth = isinstance(value, bool | np.bool_)
    if (isinstance(value, int | np.integer) or truth) and truth <= (kind is BasicType.BOOL):
        number = int(value)
        if low <= number <= high:
            return number
    raise DataError(owner, location, f"{shown(value)}; expected a {kind}, {low} to {high}")


NANOSECONDS = 1_000_000_000
"""In a second."""

_LATEST_NS = 2**32 * NANOSECONDS - 1  # the latest time that a time timestamp can state [ns]

_TEXT = re.compile(r"([0-9]{1,10})\.([0-9]{9})")


@dataclass(frozen=True, slots=True, order=True)
class Timestamp:
    """A time from 0 to 2^32 seconds: whole seconds `s`, a uint32, and nanoseconds `ns` beside them, below 1000000000.

    Raises:
        DataError: one of them is out of range.

    Source: DB34/T 4101-2022, tables 4 to 10, "uint32. uint32"; the unit is "s. ns".
    """

    s: int
    ns: int = 0

    def __post_init__(self) -> None:
        if type(self.s) is int and type(self.ns) is int and 0 <= self.s < 2**32 and 0 <= self.ns < NANOSECONDS:
            return
        for name in ("s", "ns"):
            value = _check_basic(BasicType.UINT32, getattr(self, name), "timestamp", name)
            object.__setattr__(self, name, value)
        if self.ns >= NANOSECONDS:
            raise DataError("timestamp", "ns", f"{self.ns}; expected 0 to {NANOSECONDS - 1}")

    @classmethod
    def of(cls, timestamp_ns: int) -> "Timestamp":
        """The timestamp of a time in nanoseconds.

        Raises:
            DataError: it is before 0 or beyond 2^32 seconds.
        """
        whole = isinstance(timestamp_ns, int | np.integer)
        if not (whole and 0 <= timestamp_ns <= _LATEST_NS):
            raise DataError("timestamp", "", f"{shown(timestamp_ns)} ns; expected 0 to {_LATEST_NS}")
        return cls(*divmod(int(timestamp_ns), NANOSECONDS))

    @classmethod
    def parse(cls, text: Any) -> "Timestamp":
        """Read seconds, a point, and all nine digits of the nanoseconds: fewer digits could mean two times.

        Raises:
            DataError: it is written otherwise.
        """
        found = _TEXT.fullmatch(text) if isinstance(text, str) else None
        if found is None:
            raise DataError("timestamp", "", f'{shown(text)}; expected a text as "1595682678.715705367"')
        return cls(int(found[1]), int(found[2]))

    @property
    def nanoseconds(self) -> int:
        """The time [ns]."""
        return self.s * NANOSECONDS + self.ns

    def __str__(self) -> str:
        return f"{self.s}.{self.ns:09d}"


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
    """What a value has to be: one value, a tuple of values with a type each, or an array of one type.

    `elements` are the types (of an array its one type), `length` how many values an array has, None for any number.

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
        """Check a value exactly: one value, or a list, tuple or 1D array, which gives a tuple.

        Nothing wraps, nothing is cut, nothing is infinite. `owner` and `location` are for the message.

        Raises:
            DataError: it is of another type, out of range, or there are more or fewer values.
        """
        if self.form is ValueForm.SCALAR:
            return _check_basic(self.elements[0], value, owner, location)
        if isinstance(value, np.ndarray) and value.ndim == 1:
            value = value.tolist()
        count = len(self.elements) if self.form is ValueForm.TUPLE else self.length
        if not isinstance(value, list | tuple) or count not in (None, len(value)):
            raise DataError(owner, location, f"{shown(value)}; expected {self}")
        return tuple(
            _check_basic(element, item, owner, f"{location}[{k}]")
            for k, (element, item) in enumerate(zip(self.elements_of(len(value)), value, strict=True))
        )

    def elements_of(self, count: int) -> tuple[BasicType, ...]:
        """The types of so many values of a tuple or an array."""
        return self.elements if self.form is ValueForm.TUPLE else self.elements * count


def _basic(name: str, text: str) -> BasicType:
    try:
        return BasicType(name)
    except ValueError:
        raise DataError("type", "", f"{shown(text)}; expected {_known()}") from None


def _known() -> str:
    return f"one of {', '.join(BasicType)}, a tuple of them as (int8, int8), or an array as double[9], string[]"


def bytes_of(array: AnyArray) -> bytes:
    """The bytes of an array in C order: those that it is a view of, where it shows all of them, else a copy."""
    base = array.base
    while isinstance(base, np.ndarray):
        base = base.base
    whole = isinstance(base, bytes) and len(base) == array.nbytes and array.flags.c_contiguous
    if whole and array.dtype.newbyteorder("<") == array.dtype:
        return base  # type: ignore[return-value]
    return array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()


def array_of(content: bytes, dtype: np.dtype[Any], owner: str, location: str) -> AnyArray:
    """The flat array that bytes hold, a read-only view of them; `owner` and `location` are for the message.

    Raises:
        DataError: they are no whole number of values.
    """
    if len(content) % dtype.itemsize:
        problem = f"{len(content)} bytes; expected a multiple of {dtype.itemsize}"
        raise DataError(owner, location, problem)
    return np.frombuffer(content, dtype.newbyteorder("<")).astype(dtype, copy=False)


class Cause(StrEnum):
    """Why something was refused, for programs; the reason beside it is for people."""

    NONE = ""
    KNOWN_NAME = "known-name"
    """A property of that name is there already."""
    UNKNOWN_NAME = "unknown-name"
    """There is no property of that name."""
    ILL_TYPED = "ill-typed"
    """A value or a type that is none of table 1, or not the one that was declared."""
    OUT_OF_RANGE = "out-of-range"
    """A value of the right type that the property cannot take."""
    TOO_MANY = "too-many"
    """A limit on the number or size of things is reached."""
    BAD_RECORD = "bad-record"
    """A field of a record is missing, wrong or contradicts another."""
    BAD_CALIBRATION = "bad-calibration"
    """Numbers that are no camera model or no rigid transform."""
    NO_CALIBRATION = "no-calibration"
    """A sensor of which no calibration is known."""
    UNKNOWN_SENSOR = "unknown-sensor"
    """A sensor that is not declared, or as another kind."""
    DUPLICATE = "duplicate"
    """The sensor has sent that sequence number already."""
    TIME_BACKWARDS = "time-backwards"
    """A record older than what was fused already."""
    QUEUE_FULL = "queue-full"
    """A queue is full and its policy is to refuse."""
    UNKNOWN_ALGORITHM = "unknown-algorithm"
    """No algorithm of that name is installed."""
    BAD_MOTION = "bad-motion"
    """Poses that are no path."""
    CLOSED = "closed"
    """The session has ended."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """The answer of a call that does something.

    Attributes:
        status: 1 done, 0 failed.
        cause: why it failed, for programs.
        reason: why it failed, for people: the value, and what was expected.

    Source: DB34/T 4101-2022, clauses 5.3.3, 5.4.3 and 5.6.3.
    """

    status: int
    cause: Cause = Cause.NONE
    reason: str = ""

    def __bool__(self) -> bool:
        return self.status == 1


DONE = Outcome(1)


def refused(cause: Cause, reason: object) -> Outcome:
    """The answer 0, with the reason."""
    return Outcome(0, cause, str(reason))
