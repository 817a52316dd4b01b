"""Points that stand packed in a message, as columns; and columns packed for a message."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError
from sceneloom.formats.clouds.cloud import MOST_POINTS, Cloud, unique_names
from sceneloom.formats.topics.records import CloudRecord, PackedField

_PADDING = "_"


def unpack(record: CloudRecord, owner: str, location: str) -> Cloud:
    """Take the points of a message apart into columns.

    Args:
        record: the message.
        owner: what messages call the log.
        location: which message it is.

    Raises:
        DataError: a field reaches beyond the point, or there are fewer bytes than points.
    """
    rows = checked_rows(record, owner, location)
    names = unique_names([field.name for field in record.fields])
    columns = {
        name: _column(rows, field)
        for name, field in zip(names, record.fields, strict=True)
        if not name.startswith(_PADDING)
    }
    return Cloud(Path(owner), len(rows), columns)


def checked_rows(record: CloudRecord, owner: str, location: str) -> AnyArray:
    """(N, stride) uint8, the bytes of each point.

    Raises:
        DataError: a field reaches beyond the point, or there are fewer bytes than points.
    """
    stride = record.stride
    if stride <= 0 and (len(record.data) or record.count):
        raise DataError(owner, location, f"{stride} bytes from point to point; expected a positive number")
    for field in record.fields:
        end = field.offset + field.dtype.itemsize * field.count
        if field.offset < 0 or end > stride:
            problem = (
                f"field {field.name!r} takes bytes {field.offset} to {end} of each point, which has {stride}; "
                "expected fields inside the point"
            )
            raise DataError(owner, location, problem)
    return _rows(record, owner, location)


def _rows(record: CloudRecord, owner: str, location: str) -> AnyArray:
    """(N, stride) uint8, the bytes of each point; a view."""
    stride = max(record.stride, 1)
    content = np.frombuffer(record.data, np.uint8)
    count = len(content) // stride if record.count is None else record.count
    if not 0 <= count <= MOST_POINTS:
        raise DataError(owner, location, f"{count} points; expected 0 to {MOST_POINTS}")
    if record.row_bytes is not None and record.row_bytes[0] != record.row_bytes[1] * stride:
        return _uneven_rows(content, record.row_bytes, stride, count, owner, location)
    if len(content) < count * stride:
        problem = f"{len(content)} bytes for {count} points of {stride}; expected {count * stride}"
        raise DataError(owner, location, problem)
    return content[: count * stride].reshape(count, stride)


def _uneven_rows(
    content: AnyArray, row_bytes: tuple[int, int], stride: int, count: int, owner: str, location: str
) -> AnyArray:
    """Points in rows that are longer than their points."""
    length, width = row_bytes
    height = count // width if width else 0
    if length < width * stride or len(content) < height * length:
        problem = (
            f"{height} rows of {length} bytes for {width} points of {stride}, {len(content)} bytes in all; "
            f"expected rows of {width * stride} or more, and all of them"
        )
        raise DataError(owner, location, problem)
    rows = content[: height * length].reshape(height, length)[:, : width * stride]
    return np.ascontiguousarray(rows).reshape(count, stride)


def _column(rows: AnyArray, field: PackedField) -> AnyArray:
    shape = (len(rows),) if field.count == 1 else (len(rows), field.count)
    strides = (rows.strides[0], field.dtype.itemsize)[: len(shape)]
    if len(rows) == 0:
        return np.zeros(shape, field.dtype.newbyteorder("="))
    # numbers picked out of the points one by one: copying the bytes of each takes ten times as long
    column = np.ndarray(shape, field.dtype, rows, field.offset, strides)
    native: AnyArray = column.astype(field.dtype.newbyteorder("="), order="C")
    return native


@dataclass(frozen=True, slots=True, eq=False)
class PackedPoints:
    """Points on their trajectory into a message: the bytes, and what is where in them."""

    fields: tuple[PackedField, ...]
    stride: int
    count: int
    data: memoryview


def pack(columns: Mapping[tuple[str, ...], AnyArray], count: int) -> PackedPoints:
    """Lay columns side by side, little-endian, without gaps, in their order.

    Args:
        columns: each (count,), or several that lie side by side already, (count, k), by their k names.
        count: how many points there are.
    """
    stride = sum(len(names) * column.itemsize for names, column in columns.items())
    table = np.empty((count, stride), np.uint8)
    fields: list[PackedField] = []
    offset = 0
    for names, column in columns.items():
        dtype = column.dtype.newbyteorder("<")
        fields += [PackedField(name, offset + k * dtype.itemsize, dtype) for k, name in enumerate(names)]
        items = _whole_items(column.astype(dtype, copy=False))
        if count:  # no view may begin within an empty table
            np.ndarray((count,), items.dtype, table, offset, (stride,))[:] = items
        offset += items.itemsize
    return PackedPoints(tuple(fields), stride, count, table.reshape(-1).data)


def _whole_items(column: AnyArray) -> AnyArray:
    """What stands in a row, (N,): numbers, or several of them as bytes, which are copied in a third of the time."""
    if column.ndim == 1:
        return column
    rows = np.ascontiguousarray(column)
    return rows.view(f"V{rows.shape[1] * rows.itemsize}").reshape(-1)
