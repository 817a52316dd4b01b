"""Results and configurations as the bytes of replies."""

from sceneloom.fusion.interface import Result
from sceneloom.fusion.messages.protobuf_form import encode_in
from sceneloom.fusion.messages.wire import fusion_pb2
from sceneloom.fusion.outcome import DONE, Outcome
from sceneloom.fusion.properties import Snapshot
from sceneloom.service.values import property_to_protobuf

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


def reply_bytes(result: Result) -> bytes:
    """Give the bytes of the answer of clause 5.7."""
    reply = fusion_pb2.GetReply(number=result.number, configuration=properties_message(result.configuration))
    return encode_in(reply, result.record)


_DONE = fusion_pb2.Status(status=1).SerializeToString()
