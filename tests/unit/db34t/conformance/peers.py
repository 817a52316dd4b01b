"""A server in this process for the kit: the service's own table of methods, without a network in between."""

from collections import defaultdict

from sceneloom.db34t.conformance.catalogue import CallFailedError
from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.protobuf import fill_message, property_to_protobuf
from sceneloom.db34t.records import kind_of
from sceneloom.db34t.transport import SERVICE
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import OptionError
from sceneloom.service.server import METHODS, CallError


def summary_of(statuses):
    """What SendStream replies where its requests have these statuses."""
    summary = fusion_pb2.SendSummary()
    for number, status in enumerate(statuses):
        if status.status:
            summary.accepted += 1
        else:
            summary.refused += 1
            summary.refusals.add(number=number, status=status)
    return summary


class HereTransport:
    """Calls the fusion interface of a session directly; each session fuses inline, so that nothing has to wait."""

    def __init__(self):
        self.sessions = defaultdict(lambda: FusionInterface(inline=True))

    def call(self, method, request):
        if method == "Get":
            return self.get(request)
        if method == "CloseSession":
            return fusion_pb2.Status(status=int(self.sessions.pop(request.session, None) is not None))
        entry = METHODS[method]
        try:
            answer = entry.perform(self.sessions[request.session], request.SerializeToString())
        except CallError as error:
            if not entry.answers_status:
                raise CallFailedError(error.code.name, error.reason) from error
            return fusion_pb2.Status(status=0, cause=str(error.cause), reason=error.reason)
        return entry.reply_type.FromString(answer)

    def get(self, request):
        fusion = self.sessions[request.session]
        wanted = request.fusion_type if request.HasField("fusion_type") else None
        try:
            result = fusion.get(wanted)
            if result is None and getattr(request, "wait_ms", 0):
                fusion.flush()  # what another sweep or image would set free comes when nothing does for a while
                result = fusion.get(wanted)
        except OptionError as error:
            raise CallFailedError("INVALID_ARGUMENT", str(error)) from error
        if result is None:
            return fusion_pb2.GetReply(no_data=fusion_pb2.NoData())
        properties = map(property_to_protobuf, result.configuration.properties.values())
        reply = fusion_pb2.GetReply(number=result.number, configuration=fusion_pb2.Properties(properties=properties))
        fill_message(getattr(reply, kind_of(result.record).name), result.record)
        return reply

    def send_stream(self, requests):
        return summary_of(self.call("Send", request) for request in requests)

    def subscribe(self, request):
        for _ in range(request.most):
            yield self.get(request)

    def health(self, service):
        if service not in ("", SERVICE.full_name):
            raise CallFailedError("NOT_FOUND", service)
        return "SERVING"

    def services(self):
        return {SERVICE.full_name, "grpc.health.v1.Health"}

    def files_with(self, symbol):
        if symbol != SERVICE.full_name:
            raise CallFailedError("NOT_FOUND", symbol)
        return [fusion_pb2.DESCRIPTOR.serialized_pb]
