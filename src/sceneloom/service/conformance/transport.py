"""How the kit reaches a server: by the service of the `.proto` alone, whoever wrote the server."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self

import grpc
from google.protobuf.message import Message

from sceneloom.errors import OptionError, SceneloomError
from sceneloom.fusion.messages.wire import fusion_pb2
from sceneloom.service.security import read_token

SERVICE = fusion_pb2.DESCRIPTOR.services_by_name["DataFusion"]
"""The service of the `.proto`."""

PATIENCE_S = 30.0
"""How long an answer may take."""

LARGEST_MESSAGE = 256 * 2**20


class NobodyAnswersError(SceneloomError):
    """No server answers at an address."""


class CallFailedError(SceneloomError):
    """A call ended with an error in place of an answer.

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


@dataclass(frozen=True, slots=True)
class Doors:
    """How a server lets one in.

    Attributes:
        ca: file of the certificate (PEM) that the server's is signed with; None for a connection that is not encrypted.
        token_file: file of the bearer token; None for none.
        certificate, key: files of what the kit shows to servers that ask who it is (PEM); None for nothing.
    """

    ca: Path | None = None
    token_file: Path | None = None
    certificate: Path | None = None
    key: Path | None = None

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
            OSError: a file cannot be read.
        """
        options = [(f"grpc.max_{way}_message_length", LARGEST_MESSAGE) for way in ("send", "receive")]
        if self.ca is not None:
            shown = [None if path is None else path.read_bytes() for path in (self.key, self.certificate)]
            credentials = grpc.ssl_channel_credentials(self.ca.read_bytes(), *shown)
            return grpc.secure_channel(address, credentials, options)
        if self.token_file is not None and not _is_here(address):
            raise OptionError(f"{address}: a token over a connection that is not encrypted; say --ca, too")
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
    def connected(cls, address: str, doors: Doors) -> "GrpcTransport":
        """Connect to a server.

        Raises:
            NobodyAnswersError: no server answers there.
            OptionError: there is a token, but no encryption to keep it secret on the way to another machine.
            DataError: the file holds no token.
            OSError: a file cannot be read.
        """
        channel = doors.channel(address)
        try:
            grpc.channel_ready_future(channel).result(timeout=PATIENCE_S / 3)
        except grpc.FutureTimeoutError:
            channel.close()
            raise NobodyAnswersError(f"{address}: no server answers there") from None
        return cls(channel, metadata=doors.metadata())

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
            raise _told(error) from error

    def _answered(self, method: str, request: Any) -> Any:
        try:
            return self._stubs[method](request, timeout=PATIENCE_S, metadata=self._metadata)
        except grpc.RpcError as error:
            raise _told(error) from error


def _stub(channel: grpc.Channel, method: Any) -> Any:
    kinds = {(False, False): "unary_unary", (True, False): "stream_unary", (False, True): "unary_stream"}
    make = getattr(channel, kinds[method.client_streaming, method.server_streaming])
    return make(
        f"/{SERVICE.full_name}/{method.name}",
        request_serializer=getattr(fusion_pb2, method.input_type.name).SerializeToString,
        response_deserializer=getattr(fusion_pb2, method.output_type.name).FromString,
    )


def _told(error: Any) -> CallFailedError:
    return CallFailedError(error.code().name, str(error.details() or ""))


def _is_here(address: str) -> bool:
    host = address.rsplit(":", 1)[0].strip("[]")
    return host in {"localhost", "::1"} or host.startswith("127.") or address.startswith("unix:")
