"""The bytes of messages that viewers know, as they stand in a log."""

from sceneloom.formats.mcap.schemas import foxglove_type, serialised
from sceneloom.formats.wire_bytes import field_head
from sceneloom.fusion.messages.foxglove_form import FoxgloveMessage

_LARGE = "data"
"""The field of pixels and points in the schemas of viewers."""


def shown_bytes(found: FoxgloveMessage) -> bytes:
    """Give the bytes of the protobuf message of a message that shows a record; large data are copied once."""
    message_type = foxglove_type(found.schema)
    data = found.content.get(_LARGE)
    if data is None:
        return serialised(message_type(**found.content))
    rest = serialised(
        message_type(**{name: value for name, value in found.content.items() if name != _LARGE})
    )
    number = message_type.DESCRIPTOR.fields_by_name[_LARGE].number
    return b"".join([rest, field_head(number, len(data)), data])
