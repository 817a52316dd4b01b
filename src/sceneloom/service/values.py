"""Values of properties as messages, and back."""

from typing import Any

import numpy as np

from sceneloom.errors import DataError
from sceneloom.fusion.messages.basic_types import shown
from sceneloom.fusion.messages.wire import fusion_pb2
from sceneloom.fusion.properties.store import Property

_INT64 = range(-(2**63), 2**63)


def value_to_protobuf(value: Any) -> fusion_pb2.Value:
    """Give the message of a value.

    Raises:
        DataError: it is none of table 1, nor a list of such.
    """
    message = fusion_pb2.Value()
    if isinstance(value, bool | np.bool_):
        message.bool_value = bool(value)
    elif isinstance(value, int | np.integer) and int(value) in _INT64:
        message.integer_value = int(value)
    elif isinstance(value, float | np.floating):
        message.number_value = float(value)
    elif isinstance(value, str):
        message.string_value = value
    elif isinstance(value, list | tuple | np.ndarray):
        message.list_value.SetInParent()
        message.list_value.values.extend(value_to_protobuf(item) for item in value)
    else:
        raise DataError("value", "", f"{shown(value)}; expected a value of table 1 or a list of such")
    return message


def value_from_protobuf(message: fusion_pb2.Value) -> Any:
    """Give the value of a message.

    Raises:
        DataError: it holds none.
    """
    kind = message.WhichOneof("kind")
    if kind is None:
        raise DataError("value", "", "missing; expected a value of table 1 or a list of such")
    if kind == "list_value":
        return [value_from_protobuf(item) for item in message.list_value.values]
    return getattr(message, kind)


def property_to_protobuf(found: Property) -> fusion_pb2.Property:
    """Give the message of a property; without a value where it was added and not set yet."""
    return fusion_pb2.Property(
        name=found.name,
        description=found.description,
        type=str(found.type),
        unit=found.unit,
        value=None if found.value is None else value_to_protobuf(found.value),
        predefined=found.predefined,
    )
