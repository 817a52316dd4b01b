"""Lists of records straight out of the bytes of messages, where there is nothing unusual about them, and into them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array, UInt8Array, UInt32Array, read_only
from sceneloom.fusion.messages.columns import Column
from sceneloom.fusion.messages.records import RECORD_KINDS, ListLayout, RecordKind
from sceneloom.fusion.messages.timestamps import NANOSECONDS, Timestamp
from sceneloom.fusion.messages.wire import fusion_pb2
from sceneloom.kernels import wire_reading, wire_writing

_FORMS: Mapping[tuple[str, bool], int] = {
    ("float", False): wire_reading.FLOAT,
    ("float", True): wire_reading.FLOATS,
    ("uint32", False): wire_reading.UNSIGNED,
    ("sint32", False): wire_reading.SIGNED,
    ("string", False): wire_reading.TEXT,
    ("message", False): wire_reading.TIME,
}


@dataclass(frozen=True, slots=True)
class _Plan:
    """How the words of a list of records lie.

    Attributes:
        heads: numbers of the fields of the list: sensor, seq, timestamp, and its records.
        fields: (KNOWN, 4) int64 of `wire_reading.read_list`.
        width: words of a record.
        columns: each with where it begins among the words of a record, how many it has, and the number of the field
            without which it is not there: that of a vector, else None.
        group: the number of the field of the records.
    """

    heads: tuple[int, int, int, int]
    fields: Int64Array
    width: int
    columns: tuple[tuple[Column, int, int, int | None], ...]
    group: int


def read_usual_list(content: bytes, start: int, stop: int, kind: RecordKind) -> Any | None:
    """Read a list of boxes.

    Args:
        content: bytes in which its message stands.
        start, stop: where it begins and ends.
        kind: of the list.

    Returns:
        The record; None where there is something unusual that others had better look at.

    Raises:
        DataError: a value is out of range.
    """
    layout = kind.layout
    if layout is None or layout.ids:
        return None
    plan = _plan_of(kind.name)
    head, words, texts, counts = wire_reading.read_list(
        np.frombuffer(content, np.uint8), start, stop, plan.heads, plan.fields, plan.width
    )
    sensor_id, seq, s, ns, count = head
    if count < 0 or ns >= NANOSECONDS:
        return None
    try:
        names = tuple([content[begin:end].decode() for begin, end in texts.tolist()])
    except UnicodeDecodeError:
        return None
    values: dict[str, Any] = {"sensor_id": sensor_id, "seq": seq, "timestamp": Timestamp(s, ns)}
    values["class_names"] = names
    for column, first, size, vector in plan.columns:
        if vector is not None and counts[vector] != count:
            if not column.optional or counts[vector]:
                return None
            continue
        values[column.attribute] = _column(words, column, first * count, size * count, count)
    return kind.record_type(**values)


def _column(words: UInt32Array, column: Column, first: int, length: int, count: int) -> Any:
    values = words[first : first + length].view(column.dtype)
    return values.reshape(count, *column.shape) if column.shape else values


def list_bytes(record: Any, kind: RecordKind) -> bytes:
    """Give the records of a list as the bytes of the repeated field that they are in a message."""
    layout: Any = kind.layout
    plan, count = _plan_of(kind.name), len(record)
    columns, absent = [], []
    for column, _, size, vector in plan.columns:
        values = getattr(record, column.attribute)
        if values is None:
            absent.append(vector)
            values = np.zeros(size * count, np.uint32)
        columns.append(values.reshape(-1).view(np.uint32))
    ids = [getattr(record, attribute) for attribute in layout.ids.values()]
    given = np.array([[number is not None for number in numbers] for numbers in ids], np.bool_)
    columns += [np.array([number or 0 for number in numbers], np.int32).view(np.uint32) for numbers in ids]
    texts, letters = _texts(record.class_names)
    common = (getattr(record, "seq", 0), record.timestamp.s, record.timestamp.ns)
    written: Any = wire_writing.write_list(
        plan.group,
        count,
        _fields_without(kind.name, tuple(absent)),
        np.concatenate(columns),
        texts,
        letters,
        given.reshape(len(ids), count),
        common,
    )
    return bytes(written)


def _texts(names: tuple[str, ...]) -> tuple[Int64Array, UInt8Array]:
    """Where the letters of each name begin and end, (N, 2), and the letters of all."""
    locations: dict[str, tuple[int, int]] = {}
    letters = bytearray()
    for name in dict.fromkeys(names):
        first = len(letters)
        letters += name.encode()
        locations[name] = (first, len(letters))
    return (
        np.array([locations[name] for name in names], np.int64).reshape(len(names), 2),
        np.frombuffer(bytes(letters), np.uint8),
    )


@cache
def _fields_without(kind_name: str, absent: tuple[int, ...]) -> Int64Array:
    """The fields of a record as `wire_writing.write_list` takes them, in the order of their numbers."""
    kind, plan = RECORD_KINDS[kind_name], _plan_of(kind_name)
    numbers = _record_message(kind).fields_by_name
    rows = [
        (number, *plan.fields[number].tolist())
        for number in range(wire_reading.KNOWN)
        if plan.fields[number, 0] and number not in absent
    ]
    optional = {numbers[name].number: k for k, name in enumerate(kind.layout.ids if kind.layout else ())}
    return read_only(
        [
            (row[0], wire_writing.OPTIONAL, plan.width + optional[row[0]], 1, optional[row[0]])
            if row[0] in optional
            else row
            for row in rows
        ],
        np.int64,
    )


def _record_message(kind: RecordKind) -> Any:
    """The descriptor of one record of a list."""
    group = "" if kind.layout is None else kind.layout.group
    return getattr(fusion_pb2, kind.message_name).DESCRIPTOR.fields_by_name[group].message_type


@cache
def _plan_of(kind_name: str) -> _Plan:
    kind = RECORD_KINDS[kind_name]
    layout: Any = kind.layout
    numbers = {field.name: field.number for field in getattr(fusion_pb2, kind.message_name).DESCRIPTOR.fields}
    message = _record_message(kind)
    fields = np.zeros((wire_reading.KNOWN, 4), np.int64)
    for field in message.fields:
        fields[field.number, 0] = _form(field, layout)
    columns, first = [], 0
    for column in layout.columns:
        size = math.prod(column.shape)
        for k, name in enumerate(column.names):
            fields[message.fields_by_name[name].number, 1:] = first, size, k
        is_vector = len(column.names) == 1 and bool(column.shape)
        vector = message.fields_by_name[column.names[0]].number if is_vector else None
        columns.append((column, first, size, vector))
        first += size
    heads = tuple(numbers.get(name, 0) for name in ("sensor_id", "seq", "timestamp", layout.group))
    return _Plan(heads, read_only(fields), first, tuple(columns), numbers[layout.group])


def _form(field: Any, layout: ListLayout) -> int:
    """What a field of a record holds."""
    if layout.shared.get(field.name) == "seq":
        return wire_reading.SEQ
    kinds = {field.TYPE_FLOAT: "float", field.TYPE_UINT32: "uint32", field.TYPE_SINT32: "sint32"}
    kinds |= {field.TYPE_STRING: "string", field.TYPE_MESSAGE: "message"}
    return _FORMS[kinds[field.type], field.is_repeated]
