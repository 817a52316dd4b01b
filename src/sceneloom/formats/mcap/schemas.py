"""The protobuf schemas of messages, the classes of Foxglove's, and the names by which our own files are recognised."""

from collections.abc import Iterator
from functools import cache
from importlib import import_module
from types import MappingProxyType
from typing import Any

from google.protobuf import descriptor_pb2
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.message import Message

from sceneloom.errors import MissingExtraError, how_to_install

try:
    import foxglove_schemas_protobuf
except ImportError as missing:
    raise MissingExtraError(f"{missing}; install the extra: {how_to_install('mcap')}") from missing


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


def serialised(message: Message) -> bytes:
    """Give the bytes of a message; equal ones have equal bytes."""
    content: bytes = message.SerializeToString(deterministic=True)
    return content


@cache
def foxglove_type(schema: str) -> type[Any]:
    """Give the class of a Foxglove schema by its full name."""
    name = schema.removeprefix("foxglove.")
    found: type[Any] = getattr(import_module(f"{foxglove_schemas_protobuf.__name__}.{name}_pb2"), name)
    return found


NOTES = "sceneloom"
"""Name of the metadata record that holds what no message has a location for."""

NOTES_KEY = "scene"

SAMPLE_SCHEMA = "sceneloom.Sample"
"""Name of the JSON schema of what an IMU measures, which Foxglove has none for."""

SAMPLE_JSON = MappingProxyType(
    {
        "title": SAMPLE_SCHEMA,
        "description": "One measurement of an inertial unit; streams in m/s², rad/s, µT and K.",
        "type": "object",
        "properties": {
            "timestamp": {
                "type": "object",
                "title": "time",
                "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
            },
            "frame_id": {"type": "string"},
            "values": {
                "type": "object",
                "additionalProperties": {"type": "array", "items": {"type": "number"}},
            },
        },
        "required": ["timestamp", "frame_id", "values"],
    }
)
"""Source: MCAP format registry, schema encoding "jsonschema"."""

LABEL_KEYS = ("label", "class", "class_name", "category", "type")
"""Metadata of plots that name the class of an object, the likeliest first."""

ID_KEYS = ("id", "track_id", "instance_id", "object_id")
"""Metadata of plots that name an object, the likeliest first."""
