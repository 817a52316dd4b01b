"""Tables 3 to 10 of DB34/T 4101-2022, row by row: name, type, unit and check of each field.

Records, encodings, documentation and the conformance kit are derived from them.
"""

import math
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from sceneloom.arrays import AnyArray, read_only
from sceneloom.db34t.types import INTEGER_RANGES, Timestamp, ValueForm, ValueType, shown
from sceneloom.errors import DataError

TIME = "uint32. uint32"
"""How the standard writes the type of a timestamp."""

_CLASS = "enum"
"""The type of classes, which are names here."""

STREAM = "int8[]"
"""How it writes the type of raw bytes."""

_STRING = ValueType.parse("string")

ARRAY_DTYPES: Mapping[str, np.dtype[Any]] = {"uint8[]": np.dtype(np.uint8), "float[]": np.dtype(np.float32)}
"""The types of fields that are arrays of any length, and what they are in memory."""

_FEW = 1000
"""Of fewer numbers it is quicker to look at each than for the smallest and the largest."""


@dataclass(frozen=True, slots=True)
class Row:
    """One field of a record.

    Attributes:
        number: of the row in its table, from 1; from 100 on a field that the standard does not have.
        name: the standard's name.
        type: as the standard writes it.
        meaning: what it says.
        unit: "" for none.
        low, high: the smallest and largest value that makes sense, each included; None for those of the type.
        above: `low` itself makes no sense.
        finite: whether every number has to be finite; points without a position are dropped when they are used.
        required: whether it has to be there.
        default: what it is where it is not there.
        size: how many values an array has, in words of other fields.
        example: the standard's.
        attribute: of the record in Python; "" for `name`.
        aliases: names that are read, too: those of the same field in other tables.
        quote: description, type and note as the standard prints them.
        value_type: what `type` means; None for a timestamp.
        whole: smallest and largest value of a whole number, else None.
        bounds: `low`, `high` and `above`.
    """

    number: int
    name: str
    type: str
    meaning: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    above: bool = False
    finite: bool = True
    required: bool = True
    default: Any = None
    size: str = ""
    example: Any = None
    attribute: str = ""
    aliases: tuple[str, ...] = ()
    quote: str = ""
    value_type: ValueType | None = field(init=False)
    whole: tuple[int, int] | None = field(init=False)
    bounds: tuple[float | None, float | None, bool] = field(init=False)

    def __post_init__(self) -> None:
        value_type = None if self.type == TIME else ValueType.parse(self.type)
        object.__setattr__(self, "value_type", value_type)
        object.__setattr__(self, "attribute", self.attribute or self.name)
        object.__setattr__(self, "whole", self._whole(value_type))
        object.__setattr__(self, "bounds", (self.low, self.high, self.above))

    def _whole(self, value_type: ValueType | None) -> tuple[int, int] | None:
        """Smallest and largest value where it is one whole number."""
        if value_type is None or value_type.form is not ValueForm.SCALAR or self.type == _CLASS:
            return None
        bounds = INTEGER_RANGES.get(value_type.elements[0])
        if bounds is None:
            return None
        low, high = self.low, self.high
        return bounds[0] if low is None else int(low), bounds[1] if high is None else int(high)

    @property
    def is_extension(self) -> bool:
        """Whether the standard does not have it."""
        return self.number >= 100

    @property
    def range(self) -> str:
        """The values that make sense, in words."""
        low, high = (self.low, self.high) if self.whole is None else self.whole
        if low is None:
            return ""
        if self.above:
            return f"more than {low:g}"
        return f"{_plain(low)} or more" if high is None else f"{_plain(low)} to {_plain(high)}"

    @property
    def wanted(self) -> str:
        """What was expected of a number, for messages."""
        return f"expected {self.range or 'a finite number'}"

    def check(self, value: Any, owner: str) -> Any:
        """Check a value exactly.

        Args:
            value: what stands in the record; None where nothing does.
            owner: the record, for the message.

        Returns:
            The value as a record keeps it: arrays flat and read-only, numbers of Python, vectors as tuples.

        Raises:
            DataError: it is missing, of another type or out of range.
        """
        if type(value) is int and self.whole is not None and self.whole[0] <= value <= self.whole[1]:
            return value
        if value is None:
            if self.required:
                raise DataError(owner, self.name, f"missing; expected {self._expected()}")
            return self.default
        check = _CHECKS.get(self.type)
        return self._plain_value(value, owner) if check is None else check(self, value, owner)

    def check_class(self, value: Any, owner: str, location: str = "") -> str:
        """Check the name of a class.

        Raises:
            DataError: it is no text, or empty where a class is required.
        """
        if type(value) is str and value.isascii() and value:
            return value
        name = _STRING.check(value, owner=owner, location=location or self.name)
        if self.required and not name:
            raise DataError(owner, location or self.name, "''; expected the name of a class")
        return str(name)

    def refuse_any(self, flat: AnyArray, owner: str) -> None:
        """Refuse an array in which a number is not finite or out of range.

        Raises:
            DataError: one is; the message names the first.
        """
        if not self.admits(flat):
            k = self.first_refused(flat)
            raise DataError(owner, f"{self.name}[{k}]", f"{flat[k]}; {self.wanted}")

    def admits(self, values: AnyArray) -> bool:
        """Whether all numbers of an array are finite and in the range of this field."""
        if values.size == 0:
            return True
        broken = values.dtype.kind == "f"
        if self.low is None and self.high is None and (not broken or values.size < _FEW):
            return not broken or bool(np.isfinite(values).all())
        smallest, largest = values.min().item(), values.max().item()
        finite = not broken or (math.isfinite(smallest) and math.isfinite(largest))
        return finite and self._is_in_range(smallest) and self._is_in_range(largest)

    def first_refused(self, values: AnyArray) -> int:
        """The number of the first value that is not finite or out of range; there has to be one."""
        good = np.isfinite(values)
        if self.low is not None:
            good &= values > self.low if self.above else values >= self.low
        if self.high is not None:
            good &= values <= self.high
        return int(np.argmin(good))

    def _plain_value(self, value: Any, owner: str) -> Any:
        value_type = cast("ValueType", self.value_type)
        try:
            checked = value_type.check(value, owner=owner, location=self.name)
        except DataError as error:
            if self.range and value_type.form is ValueForm.SCALAR:
                raise DataError(owner, self.name, f"{shown(value)}; {self.wanted}") from error
            raise
        numbers = checked if isinstance(checked, tuple) else (checked,)
        if not all(self._is_in_range(number) for number in numbers):
            raise DataError(owner, self.name, f"{shown(value)}; {self.wanted}")
        return checked

    def _is_in_range(self, number: Any) -> bool:
        if self.high is not None and number > self.high:
            return False
        if self.low is None:
            return True
        return bool(number > self.low if self.above else number >= self.low)

    def _expected(self) -> str:
        words = (self.type, self.range, f"[{self.unit}]" if self.unit else "")
        return ", ".join(word for word in words if word)


def _time(row: Row, value: Any, owner: str) -> Timestamp:
    if not isinstance(value, Timestamp):
        raise DataError(owner, row.name, f"{shown(value)}; expected a Timestamp")
    return value


def _stream(row: Row, value: Any, owner: str) -> bytes:
    if isinstance(value, bytes):
        return value
    if isinstance(value, np.ndarray) and value.dtype in (np.int8, np.uint8):
        return value.tobytes()
    if isinstance(value, bytearray | memoryview):
        return bytes(value)
    raise DataError(owner, row.name, f"{shown(value)}; expected bytes")


def _array(row: Row, values: Any, owner: str) -> AnyArray:
    dtype = ARRAY_DTYPES[row.type]
    if not isinstance(values, np.ndarray) or values.dtype != dtype:
        raise DataError(owner, row.name, f"{shown(values)}; expected an array of {dtype.name}")
    flat = read_only(values.reshape(-1))
    if row.finite:
        row.refuse_any(flat, owner)
    return flat


def _plain(number: float) -> str:
    return str(int(number)) if number == int(number) else str(number)


_CHECKS: Mapping[str, Callable[[Row, Any, str], Any]] = {
    TIME: _time,
    STREAM: _stream,
    _CLASS: Row.check_class,
    **dict.fromkeys(ARRAY_DTYPES, _array),
}
"""How fields of these types are checked; others hold a value or a few of table 1."""


@dataclass(frozen=True, slots=True)
class Table:
    """One of the standard's tables.

    Attributes:
        number: of the table.
        clause: in which it stands.
        title: what it describes.
        rows: its fields in order, extensions last.
    """

    number: int
    clause: str
    title: str
    rows: tuple[Row, ...]
    _by_name: dict[str, Row] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_by_name", {row.name: row for row in self.rows})

    @property
    def owner(self) -> str:
        """How messages call a record of it."""
        return f"{self.title} (table {self.number})"

    def row(self, name: str) -> Row:
        """The row with that name.

        Raises:
            KeyError: there is none.
        """
        return self._by_name[name]

    def settle(self, record: Any) -> None:
        """Check all fields of a record that is being made, and replace each by its checked value.

        Raises:
            DataError: a field is missing, of another type or out of range.
        """
        owner = self.owner
        for row in self.rows:
            checked = row.check(getattr(record, row.attribute), owner)
            object.__setattr__(record, row.attribute, checked)

    def fault(self, name: str, problem: str) -> DataError:
        """What is wrong with a field of a record of it."""
        return DataError(self.owner, name, problem)


def _read_tables() -> Iterator[Table]:
    """Read the tables, in the order of the file."""
    content = tomllib.loads(files(__package__).joinpath("tables.toml").read_text("utf-8"))
    for table in content.values():
        rows = [_read_row(k + 1, row) for k, row in enumerate(table.pop("rows"))]
        yield Table(**table, rows=tuple(rows))


def _read_row(number: int, values: dict[str, Any]) -> Row:
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    if values["type"] == TIME and "example" in values:
        values["example"] = Timestamp.parse(values["example"])
    return Row(**{"number": number, **values})


_ALL = tuple(_read_tables())
CALIBRATION, RAW, IMAGE, POINT_CLOUD, BOX_3D, BOX_2D, SENSOR_FUSION, FUSED_DETECTION = _ALL[:8]

BOXES_3D, BOXES_2D, FUSED_DETECTIONS = _ALL[8:]
"""What the boxes of one frame, or the detections of one pair, have in common."""

TABLES: Mapping[int, Table] = MappingProxyType({table.number: table for table in _ALL[:8]})
"""By number."""
