"""Tables 3 to 10 of DB34/T 4101-2022, row by row: name, type, unit and check of each field.

Records, encodings, documentation and the conformance kit are derived from them.
"""

import math
import tomllib
from collections.abc import Iterator, Mapping
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

_CLASS = "enum"  # the type of classes, which are names here

STREAM = "int8[]"
"""How it writes the type of raw bytes."""

_STRING = ValueType.parse("string")

ARRAY_DTYPES: Mapping[str, np.dtype[Any]] = {"uint8[]": np.dtype(np.uint8), "float[]": np.dtype(np.float32)}
"""The types of fields that are arrays of any length, and what they are in memory."""

_FEW = 1000  # of fewer numbers it is quicker to look at each than for the smallest and the largest


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
        default: the value of a field that is not there.
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
        whole = None
        if value_type is not None and value_type.form is ValueForm.SCALAR and self.type != _CLASS:
            whole = INTEGER_RANGES.get(value_type.elements[0])
        if whole is not None:
            whole = whole[0] if self.low is None else int(self.low), whole[1] if self.high is None else int(self.high)
        object.__setattr__(self, "whole", whole)
        object.__setattr__(self, "bounds", (self.low, self.high, self.above))

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
        first, last = (str(int(each)) if each is not None and each == int(each) else str(each) for each in (low, high))
        return f"{first} or more" if high is None else f"{first} to {last}"

    @property
    def wanted(self) -> str:
        """What was expected of a number, for messages."""
        return f"expected {self.range or 'a finite number'}"

    def check(self, value: Any, owner: str) -> Any:
        """Check a value exactly; None where there is none. `owner` names the record in messages.

        Returns:
            The value as a record keeps it: arrays flat and read-only, numbers of Python, vectors as tuples.

        Raises:
            DataError: it is missing, of another type or out of range.
        """
        if type(value) is int and self.whole is not None and self.whole[0] <= value <= self.whole[1]:
            return value
        if value is None:
            if self.required:
                words = (self.type, self.range, f"[{self.unit}]" if self.unit else "")
                raise DataError(owner, self.name, f"missing; expected {', '.join(word for word in words if word)}")
            return self.default
        if self.type == _CLASS:
            return self.check_class(value, owner)
        if self.type == TIME:
            if not isinstance(value, Timestamp):
                raise DataError(owner, self.name, f"{shown(value)}; expected a Timestamp")
            return value
        if self.type == STREAM:
            return self._check_bytes(value, owner)
        return self._check_array(value, owner) if self.type in ARRAY_DTYPES else self._check_values(value, owner)

    def _check_bytes(self, value: Any, owner: str) -> bytes:
        if isinstance(value, bytes):
            return value
        if isinstance(value, np.ndarray) and value.dtype in (np.int8, np.uint8):
            return value.tobytes()
        if isinstance(value, bytearray | memoryview):
            return bytes(value)
        raise DataError(owner, self.name, f"{shown(value)}; expected bytes")

    def _check_array(self, values: Any, owner: str) -> AnyArray:
        dtype = ARRAY_DTYPES[self.type]
        if not isinstance(values, np.ndarray) or values.dtype != dtype:
            raise DataError(owner, self.name, f"{shown(values)}; expected an array of {dtype.name}")
        flat = read_only(values.reshape(-1))
        if self.finite and not self.admits(flat):
            k = self.first_refused(flat)
            raise DataError(owner, f"{self.name}[{k}]", f"{flat[k]}; {self.wanted}")
        return flat

    def _check_values(self, value: Any, owner: str) -> Any:
        value_type = cast("ValueType", self.value_type)
        try:
            checked = value_type.check(value, owner=owner, location=self.name)
        except DataError as error:
            if self.range and value_type.form is ValueForm.SCALAR:
                raise DataError(owner, self.name, f"{shown(value)}; {self.wanted}") from error
            raise
        if not all(map(self._is_in_range, checked if isinstance(checked, tuple) else (checked,))):
            raise DataError(owner, self.name, f"{shown(value)}; {self.wanted}")
        return checked

    def check_class(self, value: Any, owner: str) -> str:
        """Check the name of a class.

        Raises:
            DataError: it is no text, or empty where a class is required.
        """
        if type(value) is str and value.isascii() and value:
            return value
        name = _STRING.check(value, owner=owner, location=self.name)
        if self.required and not name:
            raise DataError(owner, self.name, "''; expected the name of a class")
        return str(name)

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

    def _is_in_range(self, number: Any) -> bool:
        if self.high is not None and number > self.high:
            return False
        if self.low is None:
            return True
        return bool(number > self.low if self.above else number >= self.low)


@dataclass(frozen=True, slots=True)
class Table:
    """One of the standard's tables: its number, clause and title, and its fields in order, extensions last."""

    number: int
    clause: str
    title: str
    rows: tuple[Row, ...]
    _by_name: dict[str, Row] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_by_name", {row.name: row for row in self.rows})

    @property
    def owner(self) -> str:
        """The name of a record of it in messages."""
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
            object.__setattr__(record, row.attribute, row.check(getattr(record, row.attribute), owner))

    def fault(self, name: str, problem: str) -> DataError:
        """What is wrong with a field of a record of it."""
        return DataError(self.owner, name, problem)


def _read_tables() -> Iterator[Table]:
    """Read the tables, in the order of the file."""
    content = tomllib.loads(files(__package__).joinpath("tables.toml").read_text("utf-8"))
    for table in content.values():
        rows = []
        for k, listed in enumerate(table.pop("rows")):
            values: dict[str, Any] = {
                name: tuple(value) if isinstance(value, list) else value for name, value in listed.items()
            }
            if values["type"] == TIME and "example" in values:
                values["example"] = Timestamp.parse(values["example"])
            rows.append(Row(**{"number": k + 1, **values}))
        yield Table(**table, rows=tuple(rows))


_ALL = tuple(_read_tables())
CALIBRATION, RAW, IMAGE, POINT_CLOUD, BOX_3D, BOX_2D, SENSOR_FUSION, FUSED_DETECTION = _ALL[:8]

BOXES_3D, BOXES_2D, FUSED_DETECTIONS = _ALL[8:]
"""What the boxes of one frame, or the detections of one pair, have in common."""

TABLES: Mapping[int, Table] = MappingProxyType({table.number: table for table in _ALL[:8]})
"""By number."""
