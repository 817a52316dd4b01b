"""A message of a Foxglove schema, and its time."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sceneloom.fusion.messages.foreign_values import ForeignMessage
from sceneloom.fusion.messages.timestamps import Timestamp

NO_TURN = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
NO_PLACE = {"x": 0.0, "y": 0.0, "z": 0.0}


@dataclass(frozen=True, slots=True)
class FoxgloveMessage:
    """A message of a Foxglove schema.

    Attributes:
        schema: its name, "foxglove.RawImage".
        content: its fields by name; messages in it are mappings, enumerations numbers.
    """

    schema: str
    content: Mapping[str, Any]


def time_content(timestamp: Timestamp) -> dict[str, int]:
    """A time, as it stands in a message."""
    return {"seconds": timestamp.s, "nanos": timestamp.ns}


def time_of(message: ForeignMessage) -> Timestamp:
    """The time of a message, or of the first thing in it that has one."""
    if "timestamp" in message.content:
        return message.inner("timestamp").timestamp("seconds", "nanos")
    for name in ("deletions", "entities", "points"):
        inner = message.each(name) if name in message.content else []
        if inner:
            return inner[0].inner("timestamp").timestamp("seconds", "nanos")
    raise message.fault("timestamp", "missing")
