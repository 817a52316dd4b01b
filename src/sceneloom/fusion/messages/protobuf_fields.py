"""Fields of records in protobuf messages: one value for each row of a table."""

from typing import Any

from sceneloom.errors import DataError
from sceneloom.fusion.messages.array_bytes import array_of, bytes_of
from sceneloom.fusion.messages.rows import ARRAY_DTYPES, TIME, Row
from sceneloom.fusion.messages.timestamps import Timestamp
from sceneloom.fusion.messages.value_types import ValueForm
from sceneloom.fusion.messages.wire import fusion_pb2


def timestamp_to_protobuf(timestamp: Timestamp) -> fusion_pb2.Timestamp:
    """Give the message of a timestamp."""
    return fusion_pb2.Timestamp(s=timestamp.s, ns=timestamp.ns)


def timestamp_from_protobuf(message: fusion_pb2.Timestamp, owner: str, location: str) -> Timestamp:
    """Give the timestamp of a message.

    Raises:
        DataError: its nanoseconds make a second or more.
    """
    try:
        return Timestamp(message.s, message.ns)
    except DataError as error:
        raise DataError(owner, f"{location}.{error.location}", error.problem) from error


def write_field(message: Any, row: Row, value: Any) -> None:
    """Write the value of one row; None is left out."""
    if value is None:
        return
    if row.type == TIME:
        timestamp = getattr(message, row.name)
        timestamp.s, timestamp.ns = value.s, value.ns
        timestamp.SetInParent()
    elif row.type in ARRAY_DTYPES:
        setattr(message, row.name, bytes_of(value))
    elif isinstance(value, tuple):
        getattr(message, row.name).extend(value)
    else:
        setattr(message, row.name, value)


def read_field(message: Any, row: Row, owner: str) -> Any:
    """Read the value of one row."""
    if row.type == TIME:
        if not message.HasField(row.name):
            return None
        return timestamp_from_protobuf(getattr(message, row.name), owner, row.name)
    value = getattr(message, row.name)
    if row.type in ARRAY_DTYPES:
        return array_of(value, ARRAY_DTYPES[row.type], owner, row.name)
    if row.value_type is not None and row.value_type.form is ValueForm.ARRAY and not isinstance(value, bytes):
        return tuple(value) if row.required or value else None
    if row.required:
        return value
    return _if_stated(message, row, value)


def _if_stated(message: Any, row: Row, value: Any) -> Any:
    """An optional field's value, None where it was left out."""
    if message.DESCRIPTOR.fields_by_name[row.name].has_presence:
        return value if message.HasField(row.name) else None
    return value or None
