"""What clients find beside the service itself: whether it is well, and what it is, without any file."""

from collections.abc import Iterator

from google.protobuf.descriptor_pb2 import DescriptorProto, FileDescriptorProto

from sceneloom.fusion.messages.wire import fusion_pb2
from sceneloom.service.conformance.bench import Bench
from sceneloom.service.conformance.catalogue import Catalogue, Seen, same, true
from sceneloom.service.conformance.transport import SERVICE, CallFailedError

CHECKS = Catalogue("Health and reflection")


@CHECKS.extension(21, "grpc.health.v1", "the health service says SERVING of the service and of all")
def _healthy(bench: Bench) -> Iterator[Seen]:
    for name in (SERVICE.full_name, ""):
        yield same(f"Health/Check of {name!r}", "SERVING", bench.transport.health(name))
    unknown = f"{SERVICE.full_name}Unknown"
    try:
        found = bench.transport.health(unknown)
    except CallFailedError as error:
        found = error.code
    yield same(f"Health/Check of {unknown!r}", "NOT_FOUND", found)


@CHECKS.extension(22, "grpc.reflection", "reflection lists the service")
def _listed(bench: Bench) -> Iterator[Seen]:
    found = bench.transport.services()
    yield true("list_services", SERVICE.full_name, sorted(found), agrees=SERVICE.full_name in found)


@CHECKS.extension(
    23,
    "grpc.reflection",
    "reflection gives the methods, messages and fields of the .proto, further ones aside",
)
def _described(bench: Bench) -> Iterator[Seen]:
    files = [
        FileDescriptorProto.FromString(content) for content in bench.transport.files_with(SERVICE.full_name)
    ]
    methods = {
        method.name: _of_method(method)
        for file in files
        for service in file.service
        if f"{file.package}.{service.name}" == SERVICE.full_name
        for method in service.method
    }
    ours = FileDescriptorProto()
    fusion_pb2.DESCRIPTOR.CopyToProto(ours)
    for method in ours.service[0].method:
        asked = f"file_containing_symbol of the service: method {method.name}"
        yield same(asked, _of_method(method), methods.get(method.name))
    messages = {f"{file.package}.{message.name}": message for file in files for message in file.message_type}
    for message in ours.message_type:
        theirs = messages.get(f"{ours.package}.{message.name}", DescriptorProto())
        missing = sorted(_fields(message) - _fields(theirs))
        yield same(f"fields of {message.name} that are missing or others", [], missing)


def _of_method(method: object) -> tuple[object, ...]:
    names = ("input_type", "output_type", "client_streaming", "server_streaming")
    return tuple(getattr(method, name) for name in names)


def _fields(message: DescriptorProto) -> set[tuple[int, str, int, bool, str]]:
    repeated = 3  # FieldDescriptorProto.Label.LABEL_REPEATED
    return {
        (field.number, field.name, field.type, field.label == repeated, field.type_name)
        for field in message.field
    }
