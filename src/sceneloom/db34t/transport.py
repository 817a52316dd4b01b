"""gRPC connections to a service of the standard: certificates and tokens, errors of failed calls.

And the calls that the conformance kit makes.
"""

import ipaddress
import ssl
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, Self

from sceneloom.errors import DataError, MissingExtraError, OptionError, SceneloomError, how_to_install
from sceneloom.formats.base.files import read_settings

try:
    import grpc
    from google.protobuf.message import DecodeError, Message
    from grpc_health.v1 import health_pb2
    from grpc_reflection.v1alpha import reflection_pb2

    from sceneloom.db34t.wire import fusion_pb2
except ImportError as missing:
    raise MissingExtraError(f"{missing}; install the extra: {how_to_install('serve')}") from missing

_SHORTEST_TOKEN = 16


def read_certificates(path: Path) -> bytes:
    """Read the certificates of a PEM file.

    Raises:
        DataError: there are none, or the file cannot be read.
    """
    content = read_settings(path)
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_verify_locations(cafile=path)
    except ssl.SSLError as error:
        raise DataError(path, "", "no certificate; expected a PEM file (BEGIN CERTIFICATE)") from error
    return content


def read_pair(certificate: Path, key: Path) -> tuple[bytes, bytes]:
    """Read a certificate and its key.

    Returns:
        the certificates and the key, as the PEM files have them.

    Raises:
        DataError: one of them is none or cannot be read, or they do not belong together.
    """
    certificates, private = read_certificates(certificate), read_settings(key)
    try:
        # a password of our own: without one OpenSSL would ask at the terminal
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password=lambda: "none")
    except ssl.SSLError as error:
        wanted = f"the unencrypted key (PEM) of the certificate in {certificate}"
        raise DataError(key, "", f"not that key; expected {wanted}") from error
    return certificates, private


def read_token(path: Path) -> str:
    """Read a token from a file that holds nothing else.

    Raises:
        DataError: it is no text, too short, or has blanks in it.
    """
    try:
        token = read_settings(path).decode("ascii").strip()
    except UnicodeDecodeError as error:
        raise DataError(path, "", "no token; expected ASCII characters") from error
    if len(token) < _SHORTEST_TOKEN or not token.isprintable() or " " in token:
        problem = f"{len(token)} characters; expected a token of {_SHORTEST_TOKEN} or more without blanks"
        raise DataError(path, "", problem)
    return token


class ServiceError(SceneloomError):
    """The service did not answer, or answered that it cannot.

    Attributes:
        address: of the service.
        problem: what happened, for people.
    """

    advice = ""
    """What the caller can do about it."""

    def __init__(self, address: str, problem: str) -> None:
        super().__init__(address, problem)
        self.address, self.problem = address, problem

    def __str__(self) -> str:
        return f"{self.address}: {self.problem}" + (f"; {self.advice}" if self.advice else "")


class UnreachableError(ServiceError):
    """Nobody answers at the address, or the connection broke."""

    advice = "is the service there, and are both sides with or both without TLS?"


class UnauthenticatedError(ServiceError):
    """The token is missing or wrong."""

    advice = "state the token that the service was started with"


class TooLargeError(ServiceError):
    """A message is larger than one side takes."""

    advice = "send smaller images or clouds, or raise the limit of the service"


class DeadlineError(ServiceError):
    """The answer did not come in time; whether the call was done is not known."""


_TOO_LARGE = "larger than max"
"""What gRPC says of a message beyond either side's limit; its status is also that of other limits."""

_ERRORS: Mapping[grpc.StatusCode, type[ServiceError]] = MappingProxyType(
    {
        grpc.StatusCode.UNAVAILABLE: UnreachableError,
        grpc.StatusCode.UNAUTHENTICATED: UnauthenticatedError,
        grpc.StatusCode.PERMISSION_DENIED: UnauthenticatedError,
        grpc.StatusCode.DEADLINE_EXCEEDED: DeadlineError,
    }
)

_UNREADABLE = "Exception deserializing response"
"""What gRPC says where a reader of answers gives None."""


def reader_of(reply_type: Any) -> Callable[[bytes], Any]:
    """Give what reads answers of a type; None of bytes that are none, since gRPC logs tracebacks of what is raised."""

    def read(content: bytes) -> Any:
        try:
            return reply_type.FromString(content)
        except DecodeError:
            return None

    return read


def details_of(error: grpc.RpcError) -> str:
    """What is stated for a call that failed."""
    details = str(getattr(error, "details", lambda: "")() or "")
    return "the answer is no message of this service" if _UNREADABLE in details else details


def service_error(address: str, error: grpc.RpcError) -> ServiceError:
    """Give the error of a call that failed."""
    code, details = code_of(error), details_of(error)
    kind = TooLargeError if _TOO_LARGE in details else _ERRORS.get(code, ServiceError)
    problem = f"{code.name.lower().replace('_', ' ')}: {details}" if details else code.name.lower()
    return kind(address, problem)


def code_of(error: grpc.RpcError) -> grpc.StatusCode:
    """The status that a call ended with."""
    code = getattr(error, "code", lambda: None)()
    return code if isinstance(code, grpc.StatusCode) else grpc.StatusCode.UNKNOWN


SERVICE = fusion_pb2.DESCRIPTOR.services_by_name["DataFusion"]
"""The service of the `.proto`."""

PATIENCE_S = 30.0
"""How long an answer may take."""

_LARGEST_MESSAGE = 256 * 2**20

_SHUT = ("UNAUTHENTICATED", "PERMISSION_DENIED")
"""Answered to who does not show the token: it would fail every check alike."""


class NobodyAnswersError(SceneloomError):
    """No server answers at an address, or it does not let the kit in."""


class CallFailedError(SceneloomError):
    """A call ended with an error instead of an answer.

    Attributes:
        code: as gRPC calls it, such as NOT_FOUND.
        details: what the server says of it.
    """

    def __init__(self, code: str, details: str) -> None:
        super().__init__(code, details)
        self.code, self.details = code, details

    def __str__(self) -> str:
        return f"error {self.code}: {self.details}"


class Transport(Protocol):
    """Carries calls to a server and answers back; errors are `CallFailedError`."""

    def call(self, method: str, request: Message) -> Any:
        """Call a method that takes one message and gives one."""
        ...

    def send_stream(self, requests: Iterable[Message]) -> Any:
        """Call SendStream."""
        ...

    def subscribe(self, request: Message) -> Iterator[Any]:
        """Call Subscribe."""
        ...

    def health(self, service: str) -> str:
        """Ask the health service how a service is, by its full name, or "" for all: SERVING and so on."""
        ...

    def services(self) -> set[str]:
        """Ask by reflection for the full names of the services."""
        ...

    def files_with(self, symbol: str) -> list[bytes]:
        """Ask by reflection for the descriptors of the file that describes a symbol, perhaps with its imports."""
        ...


def is_local(address: str) -> bool:
    """Whether a host, or HOST:PORT, is this machine's alone."""
    host = address.rsplit(":", 1)[0] if address.count(":") == 1 or "]:" in address else address
    if host == "localhost" or address.startswith("unix:"):
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True, slots=True)
class Access:
    """How a server lets one in.

    Attributes:
        ca: file of the certificate (PEM) that the server's is signed with; None for a connection that is not encrypted.
        token_file: file of the bearer token; None for none.
        certificate: files (PEM) of the certificate and the key that the kit shows to servers that ask; None for none.
    """

    ca: Path | None = None
    token_file: Path | None = None
    certificate: tuple[Path, Path] | None = None

    def metadata(self) -> tuple[tuple[str, str], ...]:
        """What every call carries.

        Raises:
            DataError: the file holds no token.
            OSError: it cannot be read.
        """
        if self.token_file is None:
            return ()
        token = read_token(self.token_file)
        return (("authorization", f"Bearer {token}"),)

    def channel(self, address: str) -> grpc.Channel:
        """Open a channel.

        Raises:
            OptionError: there is a token, but no encryption to keep it secret on the way to another machine.
            DataError: a file holds no certificate, or no key of it.
            OSError: a file cannot be read.
        """
        options = [
            (f"grpc.max_{direction}_message_length", _LARGEST_MESSAGE) for direction in ("send", "receive")
        ]
        if self.ca is not None:
            chain, key = (None, None) if self.certificate is None else read_pair(*self.certificate)
            credentials = grpc.ssl_channel_credentials(read_certificates(self.ca), key, chain)
            return grpc.secure_channel(address, credentials, options)
        if self.token_file is not None and not is_local(address):
            raise OptionError(f"{address}: a token over a connection that is not encrypted; state --ca, too")
        return grpc.insecure_channel(address, options)


class GrpcTransport:
    """Calls over a gRPC channel, with stubs made from the service's descriptor. Use it in `with`, or close it.

    Attributes:
        channel: the connection.
    """

    def __init__(self, channel: grpc.Channel, *, metadata: tuple[tuple[str, str], ...] = ()) -> None:
        """Make the stubs; nothing is sent yet.

        Args:
            metadata: what every call carries.
        """
        self.channel = channel
        self._metadata = metadata
        self._stubs: Mapping[str, Any] = {method.name: _stub(channel, method) for method in SERVICE.methods}

    @classmethod
    def connected(cls, address: str, access: Access) -> "GrpcTransport":
        """Connect to a server.

        Raises:
            NobodyAnswersError: no server answers there, or it does not let the kit in.
            OptionError: there is a token, but no encryption to keep it secret on the way to another machine.
            DataError: a file holds no token, or no certificate.
            OSError: a file cannot be read.
        """
        channel = access.channel(address)
        try:
            grpc.channel_ready_future(channel).result(timeout=PATIENCE_S / 3)
        except grpc.FutureTimeoutError:
            channel.close()
            reported = (
                "no server answers there; is it running, and are both sides with or both without TLS (--ca)?"
            )
            raise NobodyAnswersError(f"{address}: {reported}") from None
        transport = cls(channel, metadata=access.metadata())
        try:
            transport.call("CloseSession", fusion_pb2.CloseSessionRequest(session="conformance-knocks"))
        except CallFailedError as error:
            if error.code in _SHUT:
                channel.close()
                reported = "state the token that it was started with (--token-file)"
                raise NobodyAnswersError(f"{address}: {error.code}: {error.details}; {reported}") from None
        return transport

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.channel.close()

    def call(self, method: str, request: Message) -> Any:
        """Call a method that takes one message and gives one."""
        return self._answered(method, request)

    def send_stream(self, requests: Iterable[Message]) -> Any:
        """Call SendStream."""
        return self._answered("SendStream", iter(list(requests)))

    def subscribe(self, request: Message) -> Iterator[Any]:
        """Call Subscribe."""
        try:
            yield from self._stubs["Subscribe"](request, timeout=PATIENCE_S, metadata=self._metadata)
        except grpc.RpcError as error:
            raise _reported(error) from error

    def health(self, service: str) -> str:
        """Ask the health service how a service is, by its full name, or "" for all: SERVING and so on.

        Source: the gRPC health checking protocol, github.com/grpc/grpc/blob/master/doc/health-checking.md.
        """
        call = self.channel.unary_unary(
            "/grpc.health.v1.Health/Check",
            request_serializer=health_pb2.HealthCheckRequest.SerializeToString,
            response_deserializer=reader_of(health_pb2.HealthCheckResponse),
        )
        request = health_pb2.HealthCheckRequest(service=service)
        try:
            reply = call(request, timeout=PATIENCE_S, metadata=self._metadata)
        except grpc.RpcError as error:
            raise _reported(error) from error
        name: str = health_pb2.HealthCheckResponse.ServingStatus.Name(reply.status)
        return name

    def services(self) -> set[str]:
        """Ask by reflection for the full names of the services."""
        reply = self._reflected(reflection_pb2.ServerReflectionRequest(list_services=""))
        return {service.name for service in reply.list_services_response.service}

    def files_with(self, symbol: str) -> list[bytes]:
        """Ask by reflection for the descriptors of the file that describes a symbol, perhaps with its imports."""
        reply = self._reflected(reflection_pb2.ServerReflectionRequest(file_containing_symbol=symbol))
        return list(reply.file_descriptor_response.file_descriptor_proto)

    def _reflected(self, request: Message) -> Any:
        """Ask the reflection service, of whichever of its two versions there is.

        Source: github.com/grpc/grpc/blob/master/doc/server-reflection.md; both versions have the same messages.
        """
        failed: CallFailedError | None = None
        for version in ("v1", "v1alpha"):
            call = self.channel.stream_stream(
                f"/grpc.reflection.{version}.ServerReflection/ServerReflectionInfo",
                request_serializer=reflection_pb2.ServerReflectionRequest.SerializeToString,
                response_deserializer=reader_of(reflection_pb2.ServerReflectionResponse),
            )
            try:
                replies = list(call(iter([request]), timeout=PATIENCE_S, metadata=self._metadata))
            except grpc.RpcError as error:
                failed = _reported(error)
                if failed.code != "UNIMPLEMENTED":
                    break
            else:
                return _only(replies)
        raise failed or CallFailedError("UNIMPLEMENTED", "")

    def _answered(self, method: str, request: Any) -> Any:
        try:
            return self._stubs[method](request, timeout=PATIENCE_S, metadata=self._metadata)
        except grpc.RpcError as error:
            raise _reported(error) from error


def _stub(channel: grpc.Channel, method: Any) -> Any:
    kinds = {(False, False): "unary_unary", (True, False): "stream_unary", (False, True): "unary_stream"}
    make = getattr(channel, kinds[method.client_streaming, method.server_streaming])
    return make(
        f"/{SERVICE.full_name}/{method.name}",
        request_serializer=getattr(fusion_pb2, method.input_type.name).SerializeToString,
        response_deserializer=reader_of(getattr(fusion_pb2, method.output_type.name)),
    )


def _reported(error: Any) -> CallFailedError:
    return CallFailedError(error.code().name, details_of(error))


def _only(replies: list[Any]) -> Any:
    if len(replies) != 1:
        raise CallFailedError("INTERNAL", f"{len(replies)} answers to one question of reflection")
    if replies[0].HasField("error_response"):
        error = replies[0].error_response
        raise CallFailedError(f"code {error.error_code}", error.error_message)
    return replies[0]
