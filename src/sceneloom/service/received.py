"""Answers of the service as the objects of the fusion interface."""

from dataclasses import dataclass
from types import MappingProxyType

from sceneloom.errors import DataError
from sceneloom.fusion.events import Result
from sceneloom.fusion.messages.protobuf_form import from_protobuf
from sceneloom.fusion.messages.value_types import ValueType
from sceneloom.fusion.messages.wire import fusion_pb2
from sceneloom.fusion.outcome import DONE, Cause, Outcome
from sceneloom.fusion.properties.store import Property, Snapshot
from sceneloom.service.values import value_from_protobuf


@dataclass(frozen=True, slots=True)
class Sent:
    """What became of a stream of records.

    Attributes:
        accepted: how many were taken.
        refused: how many were not.
        refusals: number in the stream and answer of the first of these.
    """

    accepted: int
    refused: int
    refusals: tuple[tuple[int, Outcome], ...] = ()


def outcome_of(message: fusion_pb2.Status) -> Outcome:
    """Give the answer of a message; a cause that is none of ours is left to the reason."""
    if message.status == 1 and not message.cause:
        return DONE
    known = {str(cause) for cause in Cause}
    cause = Cause(message.cause) if message.cause in known else Cause.NONE
    return Outcome(message.status, cause, message.reason)


def sent_of(message: fusion_pb2.SendSummary) -> Sent:
    """Give the answer to a stream of records."""
    refusals = tuple((refusal.number, outcome_of(refusal.status)) for refusal in message.refusals)
    return Sent(message.accepted, message.refused, refusals)


def property_of(message: fusion_pb2.Property) -> Property:
    """Give the property of a message.

    Raises:
        DataError: its type is none, or its value is not of it.
    """
    kind = ValueType.parse(message.type)
    value = None
    if message.HasField("value"):
        value = kind.check(value_from_protobuf(message.value), owner=message.name)
    return Property(message.name, message.description, kind, value, message.unit, message.predefined)


def snapshot_of(message: fusion_pb2.Properties, algorithms: tuple[str, str] | None = None) -> Snapshot:
    """Give the configuration of a message.

    Args:
        algorithms: of both types; None for what the message says: that of its fusion_type, "" for the other one.

    Raises:
        DataError: a property is faulty.
    """
    properties = {found.name: found for found in map(property_of, message.properties)}
    if algorithms is None:
        algorithms = _shown_algorithms(properties)
    return Snapshot(message.revision, MappingProxyType(properties), algorithms)


def result_of(message: fusion_pb2.GetReply) -> Result | None:
    """Give the result of an answer of clause 5.7; None where it says that there is none.

    Raises:
        DataError: it says nothing, or the result is faulty.
    """
    name = message.WhichOneof("result")
    if name is None:
        raise DataError("reply", "result", "missing; expected sensor_data, detections or no_data")
    if name == "no_data":
        return None
    return Result(message.number, from_protobuf(getattr(message, name)), snapshot_of(message.configuration))


def _shown_algorithms(properties: dict[str, Property]) -> tuple[str, str]:
    shown, kind = properties.get("fusion_algorithm"), properties.get("fusion_type")
    name = "" if shown is None else str(shown.value)
    detections = kind is not None and kind.value == 1
    return ("", name) if detections else (name, "")
