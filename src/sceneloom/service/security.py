"""Who may use the service: this machine alone, or those who hold a token over TLS."""

import hmac
import ipaddress
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
from grpc.aio import ServerInterceptor, ServicerContext

from sceneloom.errors import DataError, OptionError
from sceneloom.formats.files import read_settings
from sceneloom.service.pem import read_certificates, read_pair

_OPEN_SERVICES = ("/grpc.health.v1.Health/",)
"""Services that need no token: they report whether the server is up, and nothing else."""

_SHORTEST_TOKEN = 16


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
        if is_loopback(host):
            return
        lacking = [
            name
            for name, there in (
                ("a TLS certificate and key", self.tls_certificate is not None),
                ("a token", self.token is not None),
            )
            if not there
        ]
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
        authority = (
            None if self.tls_client_authority is None else read_certificates(self.tls_client_authority)
        )
        return grpc.ssl_server_credentials(
            [(key, certificate)],
            root_certificates=authority,
            require_client_auth=authority is not None,
        )

    def interceptors(self) -> list[ServerInterceptor]:
        """Give what looks at calls before they are answered."""
        return [] if self.token is None else [_TokenCheck(self.token)]


def is_loopback(host: str) -> bool:
    """Whether an address is this machine's alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


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


class _TokenCheck(ServerInterceptor):
    """Ends calls that do not show the token."""

    def __init__(self, token: str) -> None:
        self._expected = f"Bearer {token}".encode()

    async def intercept_service(
        self,
        continuation: Callable[
            [grpc.HandlerCallDetails], "Awaitable[grpc.RpcMethodHandler[Any, Any] | None]"
        ],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> "grpc.RpcMethodHandler[Any, Any] | None":
        """Let a call through that shows it."""
        if handler_call_details.method.startswith(_OPEN_SERVICES) or self._shown(handler_call_details):
            return await continuation(handler_call_details)
        return grpc.stream_stream_rpc_method_handler(_refuse)

    def _shown(self, details: grpc.HandlerCallDetails) -> bool:
        found = b""
        for key, value in details.invocation_metadata or ():
            if key == "authorization":
                found = value if isinstance(value, bytes) else value.encode("utf-8", "surrogateescape")
        return hmac.compare_digest(found, self._expected)


async def _refuse(_: Any, context: "ServicerContext[Any, Any]") -> None:
    await context.abort(grpc.StatusCode.UNAUTHENTICATED, "expected the metadata authorization: Bearer TOKEN")
