"""Records as JSON objects with the field names of the standard."""

import base64
import binascii
import math
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.db34t.records import RECORD_KINDS, ListLayout, Record, RecordKind, kind_of
from sceneloom.db34t.tables import ARRAY_DTYPES, STREAM, TIME, Row, Table
from sceneloom.db34t.types import FLOAT_BOUND, BasicType, Timestamp, array_of, bytes_of, shown
from sceneloom.errors import DataError

_STREAM_DTYPE = np.dtype(np.int8)


def to_json(record: Record, *, lists: bool = False) -> dict[str, Any]:
    """Give the JSON object of a record.

    Args:
        lists: give arrays as lists of numbers, not as Base64.

    Raises:
        OptionError: it is no record.
    """
    kind = kind_of(record)
    content = _written(record, kind.table, lists=lists)
    if kind.layout is not None:
        content[kind.layout.group] = [_written(member, kind.layout.table, lists=lists) for member in record]  # type: ignore[union-attr]
    return content


def from_json(name: str, content: Any) -> Any:
    """Give the record of a JSON object.

    Args:
        name: the kind of record, out of `RECORD_KINDS`.
        content: the object, as a JSON parser gives it; names of the same field in other tables are taken, too.

    Raises:
        DataError: a field is missing, unknown, there twice, of another type or out of range.
        KeyError: there is no such kind of record.
    """
    kind = RECORD_KINDS[name]
    members = None
    if kind.layout is not None and isinstance(content, Mapping):
        members = content.get(kind.layout.group)
        content = {key: value for key, value in content.items() if key != kind.layout.group}
    values = _read(content, kind.table)
    if kind.layout is not None:
        values |= _read_members(members, kind, kind.layout, values)
    return kind.record_type(**values)


def format_json(record: Record, *, lists: bool = False) -> str:
    """Give a record as JSON text: an object with the name of its kind, `{"image": {…}}`."""
    return msgspec.json.encode({kind_of(record).name: to_json(record, lists=lists)}).decode("utf-8")


def parse_json(text: str | bytes) -> Any:
    """Read a record from such a JSON text.

    Raises:
        DataError: it is no JSON, no object with the name of one kind of record, or the record is faulty.
    """
    try:
        content = msgspec.json.decode(text)
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise DataError("record", "", f"no JSON: {error}") from error
    if not isinstance(content, dict) or len(content) != 1 or not set(content) <= set(RECORD_KINDS):
        raise DataError("record", "", f"{shown(content)}; expected an object with one of {', '.join(RECORD_KINDS)}")
    ((name, inner),) = content.items()
    return from_json(name, inner)


def _written(record: Any, table: Table, *, lists: bool) -> dict[str, Any]:
    values = ((row, getattr(record, row.attribute)) for row in table.rows)
    return {row.name: _as_json(row, value, lists=lists) for row, value in values if value is not None}


def _as_json(row: Row, value: Any, *, lists: bool) -> Any:
    if row.type == TIME:
        return str(value)
    if row.type == STREAM:
        return np.frombuffer(value, _STREAM_DTYPE).tolist() if lists else _base64(value)
    if row.type in ARRAY_DTYPES:
        if not lists:
            return _base64(bytes_of(value))
        return _shortest(value) if value.dtype.kind == "f" else value.tolist()
    if row.type.startswith("float"):
        numbers = _shortest(np.array(value, np.float32).reshape(-1))
        return numbers if isinstance(value, tuple) else numbers[0]
    return list(value) if isinstance(value, tuple) else value


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _shortest(values: AnyArray) -> list[float]:
    """The shortest decimal numbers that mean the same numbers of 32 bits: 0.8, not 0.800000011920929."""
    numbers: list[float] = values.astype(str).astype(np.float64).tolist()
    return numbers


def _read(content: Any, table: Table) -> dict[str, Any]:
    if not isinstance(content, Mapping):
        raise DataError(table.owner, "", f"{shown(content)}; expected a JSON object")
    rows = {name: row for row in table.rows for name in row.aliases}
    rows |= {row.name: row for row in table.rows}
    values: dict[str, Any] = {}
    for name, value in content.items():
        row = rows.get(name)
        if row is None:
            known = ", ".join(row.name for row in table.rows)
            raise table.fault(str(name), f"is no field of it; expected {known}")
        if row.attribute in values:
            raise table.fault(row.name, f"stands there twice, once as {shown(name)}")
        values[row.attribute] = _from_json(value, row, table.owner)
    missing = next((row for row in table.rows if row.required and values.get(row.attribute) is None), None)
    if missing is not None:
        missing.check(None, table.owner)
    return {row.attribute: values.get(row.attribute, row.default) for row in table.rows}


def _from_json(value: Any, row: Row, owner: str) -> Any:
    if value is None:
        return None
    if row.type == TIME:
        return _timestamp(value, row, owner)
    if row.type != STREAM and row.type not in ARRAY_DTYPES:
        return value
    dtype = _STREAM_DTYPE if row.type == STREAM else ARRAY_DTYPES[row.type]
    if isinstance(value, list):
        return _array(value, dtype, row, owner)
    if not isinstance(value, str):
        raise DataError(owner, row.name, f"{shown(value)}; expected Base64 or a list of numbers")
    try:
        content = base64.b64decode(value, validate=True)
    except (binascii.Error, ValueError) as error:
        raise DataError(owner, row.name, f"{shown(value)}; expected Base64: {error}") from error
    return content if row.type == STREAM else array_of(content, dtype, owner, row.name)


def _timestamp(value: Any, row: Row, owner: str) -> Timestamp:
    try:
        if isinstance(value, Mapping) and set(value) == {"s", "ns"}:
            return Timestamp(value["s"], value["ns"])
        return Timestamp.parse(value)
    except DataError as error:
        location = f"{row.name}.{error.location}" if error.location else row.name
        raise DataError(owner, location, error.problem) from error


def _array(values: list[Any], dtype: np.dtype[Any], row: Row, owner: str) -> AnyArray:
    if not row.finite:
        values = [math.nan if value is None else value for value in values]
        if set(map(type, values)) <= {int, float} and all(not abs(value) >= FLOAT_BOUND for value in values):
            return np.array(values, dtype)
    kinds = set(map(type, values))
    whole = dtype.kind in "iu"
    low, high = (np.iinfo(dtype).min - 1, np.iinfo(dtype).max + 1) if whole else (-FLOAT_BOUND, FLOAT_BOUND)
    if kinds <= ({int} if whole else {int, float}) and all(low < value < high for value in values):
        return np.array(values, dtype)
    name = str(BasicType(dtype.name)) if whole else "finite float"
    raise DataError(owner, row.name, f"{shown(values)}; expected a list of {name}")


def _read_members(members: Any, kind: RecordKind, layout: ListLayout, common: Mapping[str, Any]) -> dict[str, Any]:
    if not isinstance(members, list):
        problem = "missing" if members is None else shown(members)
        raise kind.table.fault(layout.group, f"{problem}; expected a list")
    rows = [_read_member(member, k, layout, common) for k, member in enumerate(members)]
    values: dict[str, Any] = {"class_names": tuple(row["class_name"] for row in rows)}
    for column in layout.columns:
        attributes = [layout.table.row(name).attribute for name in column.names]
        if column.optional and all(row[attributes[0]] is None for row in rows):
            continue
        numbers = [[row[attribute] for attribute in attributes] for row in rows]
        missing = next((k for k, found in enumerate(numbers) if None in found), None)
        if missing is not None:
            location = f"{layout.group}[{missing}].{column.names[0]}"
            raise layout.table.fault(location, "missing; expected as in the others")
        values[column.attribute] = np.array(numbers, column.dtype).reshape(len(rows), *column.shape)
    for name, attribute in layout.ids.items():
        values[attribute] = tuple(row[name] for row in rows)
    return values


def _read_member(member: Any, k: int, layout: ListLayout, common: Mapping[str, Any]) -> dict[str, Any]:
    table, location = layout.table, f"{layout.group}[{k}]"
    try:
        values = _read(member, table)
        checked = {row.attribute: row.check(values[row.attribute], table.owner) for row in table.rows}
        _check_shared(checked, layout.shared, common, table)
    except DataError as error:
        within = f"{location}.{error.location}" if error.location else location
        raise DataError(table.owner, within, error.problem) from error
    return checked


def _check_shared(
    values: Mapping[str, Any], shared: Mapping[str, str], common: Mapping[str, Any], table: Table
) -> None:
    for name, attribute in shared.items():
        if values[name] != common[attribute]:
            raise table.fault(name, f"{values[name]}; expected {common[attribute]} as all of them")
