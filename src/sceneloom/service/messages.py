"""Requests and replies as protobuf messages: property values, the ego trajectory, results and configurations."""

from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.db34t.properties import Property, Snapshot
from sceneloom.db34t.protobuf import (
    encoded_parts,
    from_protobuf,
    timestamp_from_protobuf,
    timestamp_to_protobuf,
)
from sceneloom.db34t.queues import Result
from sceneloom.db34t.records import kind_of
from sceneloom.db34t.types import DONE, Cause, Outcome, Timestamp, ValueType, shown
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import DataError
from sceneloom.formats.base.protobuf import enclosed
from sceneloom.scene.poses import Poses

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


def motion_request(path: Poses, *, session: str = "") -> fusion_pb2.SendMotionRequest:
    """Give the message of a trajectory.

    Raises:
        DataError: it has no times, or one that a timestamp cannot state.
    """
    if path.static:
        raise DataError("motion", "poses", "a location without times; expected poses with times")
    poses = [
        fusion_pb2.Pose(
            timestamp=timestamp_to_protobuf(Timestamp.of(timestamp_ns)),
            position=position,
            quaternion_xyzw=quaternion,
        )
        for timestamp_ns, position, quaternion in zip(
            path.timestamps_ns.tolist(), path.positions.tolist(), path.quaternions_xyzw.tolist(), strict=True
        )
    ]
    return fusion_pb2.SendMotionRequest(poses=poses, session=session)


def path_of(request: fusion_pb2.SendMotionRequest) -> Poses:
    """Give the trajectory of a message.

    Raises:
        DataError: a pose has more or fewer numbers.
        ArrayError: the poses are no path.
    """
    poses = request.poses
    for k, pose in enumerate(poses):
        found = len(pose.position), len(pose.quaternion_xyzw)
        if found != (3, 4):
            problem = f"{found[0]} and {found[1]} numbers; expected a position of 3 and a quaternion of 4"
            raise DataError("motion", f"poses[{k}]", problem)
    times = [
        timestamp_from_protobuf(pose.timestamp, "motion", f"poses[{k}].timestamp").nanoseconds
        for k, pose in enumerate(poses)
    ]
    return Poses(
        np.array(times, np.int64),
        np.array([list(pose.position) for pose in poses], np.float64).reshape(-1, 3),
        np.array([list(pose.quaternion_xyzw) for pose in poses], np.float64).reshape(-1, 4),
    )


NO_DATA = fusion_pb2.GetReply(no_data=fusion_pb2.NoData()).SerializeToString()


def status_bytes(outcome: Outcome) -> bytes:
    """Give the bytes of a `Status`."""
    if outcome is DONE:
        return _DONE
    return fusion_pb2.Status(
        status=outcome.status, cause=str(outcome.cause), reason=outcome.reason
    ).SerializeToString()


def properties_message(snapshot: Snapshot) -> fusion_pb2.Properties:
    """Give the message of a configuration."""
    return fusion_pb2.Properties(
        properties=map(property_to_protobuf, snapshot.properties.values()), revision=snapshot.revision
    )


class Replies:
    """Makes the answers of clause 5.7 of one session; for several threads.

    The bytes of a configuration are kept, for most results have that of the one before.
    """

    def __init__(self) -> None:
        """Know no configuration yet."""
        self._latest: tuple[Snapshot, bytes] | None = None

    def reply(self, result: Result) -> bytes:
        """Give the bytes of the answer that carries a result; large arrays are copied once."""
        field = _REPLY.fields_by_name[kind_of(result.record).name]
        return b"".join(
            [
                *enclosed(field.number, encoded_parts(result.record)),
                fusion_pb2.GetReply(number=result.number).SerializeToString(),
                *enclosed(_CONFIGURATION, [self._configuration(result.configuration)]),
            ]
        )

    def _configuration(self, snapshot: Snapshot) -> bytes:
        latest = self._latest
        if latest is None or latest[0] is not snapshot:
            latest = self._latest = snapshot, properties_message(snapshot).SerializeToString()
        return latest[1]


_REPLY = fusion_pb2.GetReply.DESCRIPTOR

_CONFIGURATION = _REPLY.fields_by_name["configuration"].number

_DONE = fusion_pb2.Status(status=1).SerializeToString()


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
