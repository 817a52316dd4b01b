"""Results and configurations as the bytes of replies."""

from sceneloom.formats.wire_bytes import enclosed
from sceneloom.fusion.events import Result
from sceneloom.fusion.messages.protobuf_form import encoded_parts
from sceneloom.fusion.messages.records import kind_of
from sceneloom.fusion.messages.wire import fusion_pb2
from sceneloom.fusion.outcome import DONE, Outcome
from sceneloom.fusion.properties.store import Snapshot
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
