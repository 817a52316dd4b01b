"""The schemas of a log: our messages and those that viewers know, each with all that it refers to."""

from collections.abc import Iterator
from importlib import import_module
from typing import Any

from google.protobuf import descriptor_pb2
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.message import Message

from sceneloom.errors import MissingExtraError
from sceneloom.fusion.messages.foxglove_form import FoxgloveMessage
from sceneloom.fusion.messages.wire_bytes import field_head

try:
    import foxglove_schemas_protobuf
    import mcap  # noqa: F401 - only whether it is there
except ImportError as missing:
    raise MissingExtraError(f"{missing}; install the extra: pip install 'sceneloom[mcap]'") from missing


_LARGE = "data"
"""The field of pixels and points in the schemas of viewers."""


def schema_bytes(message_type: type[Any]) -> bytes:
    """Give the `FileDescriptorSet` of a class of messages, those that it refers to first.

    Source: MCAP format registry, schema encoding "protobuf".
    """
    files = dict.fromkeys(_with_imports(message_type.DESCRIPTOR.file))
    described = descriptor_pb2.FileDescriptorSet()
    for file in files:
        file.CopyToProto(described.file.add())
    return serialised(described)


def _with_imports(file: FileDescriptor) -> Iterator[FileDescriptor]:
    for imported in file.dependencies:
        yield from _with_imports(imported)
    yield file


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


def serialised(message: Message) -> bytes:
    """Give the bytes of a message; equal ones have equal bytes."""
    content: bytes = message.SerializeToString(deterministic=True)
    return content


def foxglove_type(schema: str) -> type[Any]:
    """Give the class of a Foxglove schema by its full name."""
    name = schema.removeprefix("foxglove.")
    found: type[Any] = getattr(import_module(f"{foxglove_schemas_protobuf.__name__}.{name}_pb2"), name)
    return found
