"""Reading a manifest by the table of fields: kinds are checked, seconds become nanoseconds, faults are collected."""

from collections.abc import Callable, Mapping
from decimal import Decimal, InvalidOperation
from difflib import get_close_matches
from math import isfinite
from typing import Any

import numpy as np

from sceneloom.formats.rig.faults import FILL_IN, Faults
from sceneloom.formats.rig.fields import RECORDS, SENSOR_TYPES, Field, Kind, fields_of, inner_records

Record = dict[str, Any]
"""A record as read: values by name, absent ones left out."""

_FARTHEST_S = Decimal("9.2e9")
_LARGEST = 1e15


class FieldError(ValueError):
    """A value is not what its field holds."""


def read_record(raw: Mapping[str, Any], record: str, location: str, faults: Faults) -> Record:
    """Read one record; fields that are at fault are noted and left out.

    Args:
        raw: as `tomllib` gives it, numbers with a point as Decimal.
        record: its name in the table.
        location: where it stands, for messages.
        faults: takes all that is wrong.
    """
    fields = fields_of(record)
    values: Record = {}
    for name, value in raw.items():
        where = f"{location}.{name}" if location else name
        if name not in fields:
            faults.add(where, f"unknown; {_nearest(name, record)}")
            continue
        try:
            values[name] = _READERS[fields[name].kind](value, fields[name], where, faults)
        except FieldError as error:
            faults.add(where, str(error))
    for field in fields.values():
        if field.required and field.name not in raw:
            faults.add(
                f"{location}.{field.name}" if location else field.name,
                f"missing; expected {_expected(field)}",
            )
    return values


def _nearest(name: str, record: str) -> str:
    """Name the known field that is most like an unknown one, here or one table further in."""
    known = [*fields_of(record)]
    close = get_close_matches(name, known, 1, 0.6)
    if close:
        return f"did you mean {close[0]!r}?"
    for inner, inner_record in inner_records(record).items():
        if name in fields_of(inner_record):
            return f"did you mean {inner}.{name}?"
    return f"expected one of {', '.join(known)}"


def _expected(field: Field) -> str:
    if field.choices:
        return f"one of {', '.join(field.choices)}"
    if field.shapes:
        return " or ".join(_shape(shape) for shape in field.shapes)
    unit = f" ({field.unit})" if field.unit else ""
    return f"{field.kind.value}{unit}{', above 0' if field.positive else ''}: {field.about}"


def _shape(shape: tuple[int, ...]) -> str:
    if len(shape) == 1:
        return f"a list of {shape[0]} numbers"
    return f"{shape[0]} rows of {shape[1]} numbers"


def _found(value: Any) -> str:
    if isinstance(value, list | dict):
        return f"a {'list' if isinstance(value, list) else 'table'} of {len(value)}"
    text = str(value) if isinstance(value, Decimal) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _wrong(value: Any, field: Field) -> FieldError:
    return FieldError(f"{_found(value)}; expected {_expected(field)}")


def _read_text(value: Any, field: Field, location: str, faults: Faults) -> str:
    del location, faults
    if isinstance(value, str) and value.strip() and "\0" not in value:
        return value
    raise _wrong(value, field)


def _read_texts(value: Any, field: Field, location: str, faults: Faults) -> list[str]:
    texts = [value] if isinstance(value, str) else value
    if not isinstance(texts, list) or not texts:
        raise _wrong(value, field)
    return [_read_text(text, field, location, faults) for text in texts]


def _read_choice(value: Any, field: Field, location: str, faults: Faults) -> str:
    del location, faults
    if isinstance(value, str) and value in field.choices:
        return value
    close = get_close_matches(value, field.choices, 1, 0.5) if isinstance(value, str) else []
    hint = f"; did you mean {close[0]!r}?" if close else ""
    raise FieldError(f"{_found(value)}; expected {_expected(field)}{hint}")


def _read_flag(value: Any, field: Field, location: str, faults: Faults) -> bool:
    del location, faults
    if isinstance(value, bool):
        return value
    raise _wrong(value, field)


def _read_integer(value: Any, field: Field, location: str, faults: Faults) -> int:
    del location, faults
    if type(value) is int and abs(value) < _LARGEST and (value > 0 or not field.positive):
        return value
    if _is_nan(value):
        raise FieldError(f"{FILL_IN}: {field.about}")
    raise _wrong(value, field)


def _is_nan(value: Any) -> bool:
    return isinstance(value, Decimal | float) and value != value  # noqa: PLR0124 - a Decimal has no cheaper test


def _number(value: Any, field: Field) -> float:
    if _is_nan(value):
        raise FieldError(f"{FILL_IN}: {field.about}" + (f" [{field.unit}]" if field.unit else ""))
    if type(value) in {int, float, Decimal} and abs(value) < _LARGEST and isfinite(value):
        return float(value)
    raise _wrong(value, field)


def _read_number(value: Any, field: Field, location: str, faults: Faults) -> float:
    del location, faults
    number = _number(value, field)
    if field.positive and not number > 0:
        raise _wrong(value, field)
    return number


def _read_seconds(value: Any, field: Field, location: str, faults: Faults) -> int:
    """Read seconds as nanoseconds, exactly."""
    del location, faults
    if _is_nan(value):
        raise FieldError(f"{FILL_IN}: {field.about} [s]")
    try:
        number = Decimal(value) if type(value) in {int, Decimal} else Decimal("Infinity")
        if not abs(number) <= _FARTHEST_S or (field.positive and not number > 0):
            raise _wrong(value, field)
    except InvalidOperation:
        raise _wrong(value, field) from None
    return int((number * 10**9).to_integral_value())


def _read_vector(value: Any, field: Field, location: str, faults: Faults) -> Any:
    del location, faults
    if not isinstance(value, list) or (len(value),) not in field.shapes:
        raise _wrong(value, field)
    return np.array([_number(item, field) for item in value])


def _read_matrix(value: Any, field: Field, location: str, faults: Faults) -> Any:
    del location, faults
    rows = value if isinstance(value, list) else []
    widths = {len(row) if isinstance(row, list) else -1 for row in rows}
    if len(widths) != 1 or (len(rows), *widths) not in field.shapes:
        raise _wrong(value, field)
    return np.array([[_number(item, field) for item in row] for row in rows])


def _read_numbers(value: Any, field: Field, location: str, faults: Faults) -> Any:
    del location, faults
    if isinstance(value, list):
        return [_number(item, field) for item in value]
    if isinstance(value, dict):
        return {name: _number(item, field) for name, item in value.items()}
    raise _wrong(value, field)


def _read_names(value: Any, field: Field, location: str, faults: Faults) -> dict[str, str]:
    if not isinstance(value, dict):
        raise _wrong(value, field)
    return {name: _read_text(item, field, location, faults) for name, item in value.items()}


def _read_axes(value: Any, field: Field, location: str, faults: Faults) -> tuple[str, ...]:
    """Read axes as the three of them that are right, down and forward, or as one word."""
    del location, faults
    if isinstance(value, dict) and set(value) == {"right", "down", "forward"}:
        value = ",".join(map(str, (value["right"], value["down"], value["forward"])))
    if not isinstance(value, str):
        raise _wrong(value, field)
    return tuple(word.strip().lower() for word in value.split(","))


def _read_inner(value: Any, field: Field, location: str, faults: Faults) -> Record:
    if not isinstance(value, dict):
        raise _wrong(value, field)
    return read_record(value, field.record, location, faults)


def _read_list(value: Any, field: Field, location: str, faults: Faults) -> list[Record]:
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise FieldError(f"{_found(value)}; expected {field.kind.value}: one `[[{field.name}]]` each")
    read = _read_sensor if field.record == "sensor" else read_record
    for k, item in enumerate(value):
        label = item.get("id", item.get("name"))
        if isinstance(label, str):
            faults.labels[f"{location}[{k}]"] = label
    return [read(item, field.record, f"{location}[{k}]", faults) for k, item in enumerate(value)]


def _read_sensor(raw: Mapping[str, Any], record: str, location: str, faults: Faults) -> Record:
    """Read a sensor by the record of its type; of one without a known type only the type is judged."""
    del record
    kind = raw.get("type")
    if kind in SENSOR_TYPES:
        return read_record(raw, f"sensor {kind}", location, faults)
    field = fields_of(f"sensor {SENSOR_TYPES[0]}")["type"]
    if kind is None:
        close = get_close_matches("type", raw, 1, 0.6)
        hint = f"; {close[0]!r} is unknown: is it meant?" if close else ""
        faults.add(f"{location}.type", f"missing; expected {_expected(field)}{hint}")
    else:
        try:
            _read_choice(kind, field, location, faults)
        except FieldError as error:
            faults.add(f"{location}.type", str(error))
    return {}


_READERS: Mapping[Kind, Callable[[Any, Field, str, Faults], Any]] = {
    Kind.TEXT: _read_text,
    Kind.TEXTS: _read_texts,
    Kind.CHOICE: _read_choice,
    Kind.FLAG: _read_flag,
    Kind.INTEGER: _read_integer,
    Kind.NUMBER: _read_number,
    Kind.SECONDS: _read_seconds,
    Kind.VECTOR: _read_vector,
    Kind.MATRIX: _read_matrix,
    Kind.NUMBERS: _read_numbers,
    Kind.NAMES: _read_names,
    Kind.AXES: _read_axes,
    Kind.RECORD: _read_inner,
    Kind.RECORDS: _read_list,
}

if not {field.kind for record in RECORDS.values() for field in record} <= set(_READERS):
    raise TypeError("a kind of the table of fields has no reader")
