"""gRPC connections to a service of the standard: certificates, tokens, and what is read of answers."""

import ipaddress
import ssl
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sceneloom.errors import DataError, MissingExtraError, OptionError, how_to_install
from sceneloom.formats.base.files import read_settings

try:
    import grpc
    from google.protobuf.message import DecodeError
    from google.protobuf.message_factory import GetMessageClass

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
    """Read a certificate and its key, as the PEM files have them.

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Security:
    """What a caller has to prove, and how the server proves who it is.

    Attributes:
        tls_certificate, tls_key: PEM files of the server, or None for no encryption.
        tls_client_authority: PEM file of those who sign the certificates of clients; None where they need none.
        token: what callers show as `authorization: Bearer …`; None where they need none.
    """

    tls_certificate: Path | None = None
    tls_key: Path | None = None
    tls_client_authority: Path | None = None
    token: str | None = None

    def check_host(self, host: str) -> None:
        """Check that the service may be reached at an address.

        Raises:
            OptionError: others than this machine could reach it without TLS or without a token.
        """
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise OptionError("a TLS certificate or a key alone; expected both")
        if self.tls_client_authority is not None and self.tls_certificate is None:
            raise OptionError("an authority of clients' certificates without the server's; expected it, too")
        if is_local(host):
            return
        needed = {"a TLS certificate and key": self.tls_certificate, "a token": self.token}
        lacking = [name for name, there in needed.items() if there is None]
        if lacking:
            raise OptionError(
                f"host {host!r} is open to other machines, which needs {' and '.join(lacking)}; or use 127.0.0.1"
            )

    def credentials(self) -> grpc.ServerCredentials | None:
        """Give what the server encrypts with; None for nothing.

        Raises:
            DataError: a file holds no certificate, or no key of it.
            OSError: a file cannot be read.
        """
        if self.tls_certificate is None or self.tls_key is None:
            return None
        certificate, key = read_pair(self.tls_certificate, self.tls_key)
        authority = None if self.tls_client_authority is None else read_certificates(self.tls_client_authority)
        return grpc.ssl_server_credentials(
            [(key, certificate)], root_certificates=authority, require_client_auth=authority is not None
        )


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


_UNREADABLE = "Exception deserializing response"  # what gRPC says where a reader of answers gives None


def reader_of(reply_type: Any) -> Callable[[bytes], Any]:
    """What reads answers of a type; None of bytes that are none, since gRPC logs tracebacks of what is raised."""

    def read(content: bytes) -> Any:
        try:
            return reply_type.FromString(content)
        except DecodeError:
            return None

    return read


def details_of(error: grpc.RpcError) -> str:
    """What a service reported of a call that failed."""
    details = str(getattr(error, "details", lambda: "")() or "")
    return "the answer is no message of this service" if _UNREADABLE in details else details


SERVICE = fusion_pb2.DESCRIPTOR.services_by_name["DataFusion"]
"""The service of the `.proto`."""

_ARITY = {False: "unary", True: "stream"}


def calls_of(channel: grpc.Channel) -> dict[str, Callable[..., Any]]:
    """The calls of all methods of the service over a channel, by name; requests are messages or their bytes."""
    return {
        method.name: getattr(channel, f"{_ARITY[method.client_streaming]}_{_ARITY[method.server_streaming]}")(
            f"/{SERVICE.full_name}/{method.name}",
            request_serializer=lambda sent: sent if isinstance(sent, bytes) else sent.SerializeToString(),
            response_deserializer=reader_of(GetMessageClass(method.output_type)),
        )
        for method in SERVICE.methods
    }


def open_channel(
    address: str, *, ca: Path | None, certificate: tuple[Path, Path] | None, token: str | None
) -> grpc.Channel:
    """Open a channel to a service.

    Args:
        ca: PEM file of who signed the service's certificate; None for a connection without TLS.
        certificate: PEM files of the client's certificate and its key, where the service asks for them.
        token: that calls will carry, so that it is not sent where others could read it.

    Raises:
        OptionError: a token for another machine, or a certificate, without TLS.
        DataError: a file holds no certificate, or no key of it.
        OSError: a file cannot be read.
    """
    options = [
        ("grpc.max_receive_message_length", _LARGEST_MESSAGE),
        ("grpc.max_send_message_length", _LARGEST_MESSAGE),
        ("grpc.enable_http_proxy", 0),
    ]
    if ca is None:
        if token is not None and not is_local(address):
            raise OptionError(
                f"a token for {address} without TLS; expected `ca` (--ca), the file of who signed its certificate"
            )
        if certificate is not None:
            raise OptionError("a certificate of the client without `ca`; expected both, or none")
        return grpc.insecure_channel(address, options)
    chain, key = (None, None) if certificate is None else read_pair(*certificate)
    credentials = grpc.ssl_channel_credentials(read_certificates(ca), key, chain)
    return grpc.secure_channel(address, credentials, options)


_LARGEST_MESSAGE = 1 << 29  # of an answer [byte]


def is_local(address: str) -> bool:
    """Whether a host, or HOST:PORT, is this machine's alone."""
    host = address.rsplit(":", 1)[0] if address.count(":") == 1 or "]:" in address else address
    if host == "localhost" or address.startswith("unix:"):
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
