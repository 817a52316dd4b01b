"""The gRPC server: access control (TLS, tokens), sessions, health, metrics, and a shutdown that loses nothing."""

import asyncio
import hmac
import logging
import time
from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Awaitable, Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import grpc
import grpc.aio
from grpc.aio import ServerInterceptor, ServicerContext
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from sceneloom.db34t.events import Event
from sceneloom.db34t.interface import FusionInterface, QueueLimits
from sceneloom.db34t.transport import SERVICE, is_local, read_certificates, read_pair
from sceneloom.errors import OptionError
from sceneloom.service.methods import Handlers
from sceneloom.service.sessions import Session, SessionTable
from sceneloom.service.startup import ServiceLimits, check_port

_OPEN_SERVICES = ("/grpc.health.v1.Health/",)
"""Services that need no token: they report whether the server is up, and nothing else."""


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

    def interceptors(self) -> list[ServerInterceptor]:
        """Give what looks at calls before they are answered."""
        return [] if self.token is None else [_TokenCheck(self.token)]


class _TokenCheck(ServerInterceptor):
    """Ends calls that do not show the token."""

    def __init__(self, token: str) -> None:
        self._expected = f"Bearer {token}".encode()

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], "Awaitable[grpc.RpcMethodHandler[Any, Any] | None]"],
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


_LOG = logging.getLogger(__name__)
_Observer = Callable[[Event], None]

_LOOK_S = 0.05  # how often a server that ends looks whether all results were fetched
_FETCHES_AGAIN_S = 2.0  # who fetched a result so lately is given time to ask for the next one
_LAST_WORDS_S = 1.0  # how long calls that are being answered may take in the end


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerSettings:
    """How a server is set up.

    Attributes:
        host: address to listen at.
        port: 0 for a free one.
        metrics_port: where to answer `GET /metrics` over HTTP, 0 for a free one; None for nowhere.
        limits: of the service and its sessions.
        security: what callers have to prove.
        configure: called with each new session's interface, to set properties and calibrations.
        observe: gives the observer of the events of a session, by its name; None for none.
        clock: seconds, by which sessions grow idle.
    """

    host: str = "127.0.0.1"
    port: int = 0
    metrics_port: int | None = None
    limits: ServiceLimits = field(default_factory=ServiceLimits)
    security: Security = field(default_factory=Security)
    configure: Callable[[FusionInterface], None] | None = None
    observe: Callable[[str], _Observer] | None = None
    clock: Callable[[], float] = time.monotonic


class FusionServer:
    """Serves the fusion interface; use it in `async with`, or call `start` and `drain`.

    Attributes:
        settings: how it is set up.
        sessions: the rigs.
        port: where it listens, once it was started.
        metrics_port: where numbers for Prometheus are, on this machine alone; 0 for nowhere.
    """

    def __init__(self, settings: ServerSettings | None = None) -> None:
        """Set it up; nothing is opened yet.

        Raises:
            OptionError: others than this machine could reach it without TLS or without a token.
            DataError: a file holds no certificate, or no key of it.
            OSError: such a file cannot be read.
        """
        self.settings = settings or ServerSettings()
        self.settings.security.check_host(self.settings.host)
        self._credentials = self.settings.security.credentials()
        self.sessions = SessionTable(
            self._interface, self.settings.limits, observed=self.settings.observe is not None, clock=self.settings.clock
        )
        self.port = 0
        self.metrics_port = 0
        self._metrics = _Metrics()
        self._handlers = Handlers(self.sessions, self._metrics.called)
        self._health = health.aio.HealthServicer()
        self._server: grpc.aio.Server | None = None
        self._sweeper: asyncio.Task[None] | None = None
        self._metrics_server: asyncio.Server | None = None

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.drain(0.0 if kind is not None else None)

    @property
    def address(self) -> str:
        """Where clients find it: host and port."""
        host = self.settings.host
        return f"[{host}]:{self.port}" if ":" in host and not host.startswith("[") else f"{host}:{self.port}"

    def check_ports(self) -> None:
        """Check that the server could listen where it is set up to.

        Raises:
            OptionError: it could not.
        """
        check_port(self.settings.host, self.settings.port)
        if self.settings.metrics_port is not None:
            check_port("127.0.0.1", self.settings.metrics_port, option="metrics port")

    async def start(self) -> None:
        """Listen.

        Raises:
            OptionError: the address cannot be had.
        """
        limits, security = self.settings.limits, self.settings.security
        self.check_ports()
        server = grpc.aio.server(
            interceptors=security.interceptors(),
            options=_channel_options(limits),
            maximum_concurrent_rpcs=limits.most_calls,
        )
        server.add_generic_rpc_handlers((self._handlers.generic_handler(),))
        health_pb2_grpc.add_HealthServicer_to_server(self._health, server)
        names = (SERVICE.full_name, health.SERVICE_NAME, reflection.SERVICE_NAME)
        reflection.enable_server_reflection(names, server)
        self.port = self.settings.port
        try:
            if self._credentials is None:
                self.port = server.add_insecure_port(self.address)
            else:
                self.port = server.add_secure_port(self.address, self._credentials)
        except RuntimeError as error:
            raise OptionError(f"cannot listen at {self.address}: {error}") from error
        await server.start()
        self._server = server
        for name in ("", SERVICE.full_name):
            await self._health.set(name, health_pb2.HealthCheckResponse.SERVING)
        self._sweeper = asyncio.get_running_loop().create_task(self._sweep())
        if self.settings.metrics_port is not None:
            try:
                self._metrics_server = await _serve_metrics(self._metrics, self.sessions, self.settings.metrics_port)
            except OSError as error:
                await self.drain(0.0)
                problem = f"cannot answer /metrics at port {self.settings.metrics_port}: {error.strerror}"
                raise OptionError(problem) from error
            self.metrics_port = self._metrics_server.sockets[0].getsockname()[1]
        _LOG.info("listening", extra={"fields": {"address": self.address}})

    async def wait(self) -> None:
        """Return when the server has ended."""
        if self._server is not None:
            await self._server.wait_for_termination()

    async def drain(self, limit_s: float | None = None) -> tuple[str, ...]:
        """End: take nothing more, fuse what waits, let those who fetch have their results, close.

        Args:
            limit_s: how long they may take; None for what the limits state.

        Returns:
            the sessions whose threads hang, so that the process will not end by itself.
        """
        if self._server is None:
            return ()
        server, self._server = self._server, None
        self._handlers.draining = True
        _LOG.info("draining", extra={"fields": {"sessions": len(self.sessions)}})
        await self._health.enter_graceful_shutdown()
        limit_s = self.settings.limits.drain_seconds if limit_s is None else limit_s
        over_s = time.monotonic() + limit_s + _LAST_WORDS_S
        try:
            await asyncio.wait_for(self._deliver_the_rest(), limit_s)
        except TimeoutError:
            if limit_s > 0:
                _LOG.warning("results were not fetched in time", extra={"fields": {"seconds": limit_s}})
        if self._sweeper is not None:
            self._sweeper.cancel()
        hanging = await self.sessions.end_all(max(over_s - time.monotonic(), _LAST_WORDS_S))
        if hanging:
            fields = {"sessions": list(hanging), "seconds": limit_s + _LAST_WORDS_S}
            _LOG.error("sessions do not end: an algorithm hangs", extra={"fields": fields})
        if self._metrics_server is not None:
            self._metrics_server.close()
        await server.stop(min(limit_s, _LAST_WORDS_S))
        self.sessions.close()
        _LOG.info("ended")
        return hanging

    async def _deliver_the_rest(self) -> None:
        await asyncio.gather(*(session.run(session.fusion.flush) for session in self.sessions))
        while any(self._is_fetched(session) for session in self.sessions):
            await asyncio.sleep(_LOOK_S)

    def _is_fetched(self, session: Session) -> bool:
        """Whether results wait and somebody is there who fetches them."""
        lately = self.sessions.clock() - session.last_fetched_s < _FETCHES_AGAIN_S
        return session.fusion.waiting_results > 0 and (session.fetching > 0 or lately)

    async def _sweep(self) -> None:
        while True:
            await asyncio.sleep(min(30.0, 15.0 * self.settings.limits.idle_minutes))
            for name in self.sessions.end_idle():
                _LOG.info("session ended unused", extra={"fields": {"session": name}})

    def _interface(self, name: str, on_result: Callable[[], None]) -> FusionInterface:
        observe = self.settings.observe
        most = self.settings.limits
        fusion = FusionInterface(
            observer=None if observe is None else observe(name),
            on_result=on_result,
            limits=QueueLimits(most_length=most.most_queue_length, most_bytes=most.most_bytes_waiting),
        )
        if self.settings.configure is not None:
            self.settings.configure(fusion)
        _LOG.info("session begins", extra={"fields": {"session": name}})
        return fusion


def _channel_options(limits: ServiceLimits) -> list[tuple[str, int]]:
    return [
        ("grpc.max_receive_message_length", limits.largest_message),
        ("grpc.max_send_message_length", -1),
        ("grpc.so_reuseport", 0),  # a second server at the same port is a mistake
        ("grpc.keepalive_time_ms", 30_000),  # finds connections whose other end has gone without a word
        ("grpc.keepalive_timeout_ms", 10_000),
        ("grpc.keepalive_permit_without_calls", 1),
        ("grpc.http2.min_ping_interval_without_data_ms", 5_000),
    ]


BOUNDS_S = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
"""Upper bounds of the classes of durations [s]."""


_LONGEST_REQUEST = 8192


_PATIENCE_S = 5.0


@dataclass(slots=True)
class Histogram:
    """How many durations fell into each class.

    Attributes:
        counts: for each of `BOUNDS_S`, and of those beyond.
        total_s: their sum.
    """

    counts: list[int] = field(default_factory=lambda: [0] * (len(BOUNDS_S) + 1))
    total_s: float = 0.0

    def add(self, duration_s: float) -> None:
        """Count a duration; a bound belongs to the class below it."""
        self.counts[bisect_left(BOUNDS_S, duration_s)] += 1
        self.total_s += duration_s


class _Metrics:
    """What the service counts. For the event loop's thread."""

    def __init__(self) -> None:
        """Begin at 0."""
        self._calls: Counter[tuple[str, str]] = Counter()
        self._durations: defaultdict[str, Histogram] = defaultdict(Histogram)

    def called(self, method: str, outcome: str, duration_s: float) -> None:
        """Count a call that was answered."""
        self._calls[method, outcome] += 1
        self._durations[method].add(duration_s)

    def text(self, sessions: SessionTable) -> str:
        """Give all numbers: prometheus.io, "Exposition formats", text-based format, version 0.0.4."""
        return "\n".join(self._lines(sessions)) + "\n"

    def _lines(self, sessions: SessionTable) -> Iterator[str]:
        yield from _head("sceneloom_calls_total", "counter", "Calls by method and how they ended.")
        for (method, outcome), count in sorted(self._calls.items()):
            yield _line("sceneloom_calls_total", count, method=method, outcome=outcome)
        name = "sceneloom_call_seconds"
        yield from _head(name, "histogram", "How long calls took, waiting for results included.")
        for method, histogram in sorted(self._durations.items()):
            below = 0
            for bound, count in zip((*map(str, BOUNDS_S), "+Inf"), histogram.counts, strict=True):
                below += count
                yield _line(f"{name}_bucket", below, method=method, le=bound)
            yield _line(f"{name}_sum", histogram.total_s, method=method)
            yield _line(f"{name}_count", below, method=method)
        yield from _head("sceneloom_sessions", "gauge", "Sessions that are there.")
        yield _line("sceneloom_sessions", len(sessions))
        yield from _head("sceneloom_waiting_results", "gauge", "Results that wait to be fetched.")
        for session in sessions:
            yield _line("sceneloom_waiting_results", session.fusion.waiting_results, session=session.name)
        yield from _head("sceneloom_open_requests", "gauge", "Requests that are being answered.")
        for session in sessions:
            yield _line("sceneloom_open_requests", session.open_requests, session=session.name)
        name = "sceneloom_session_events_total"
        yield from _head(name, "counter", "What came in, what was left out and why, by the names of GetCounters.")
        for session in sessions:
            for event, count in session.fusion.counters.counts().items():
                yield _line(name, count, session=session.name, event=event)


def _head(name: str, kind: str, meaning: str) -> Iterable[str]:
    return f"# HELP {name} {meaning}", f"# TYPE {name} {kind}"


def _line(name: str, value: float, **labels: str) -> str:
    escapes = str.maketrans({"\\": "\\\\", '"': '\\"', "\n": "\\n"})
    quoted = ",".join(f'{label}="{text.translate(escapes)}"' for label, text in labels.items())
    return f"{name}{{{quoted}}} {value}" if quoted else f"{name} {value}"


async def _serve_metrics(metrics: _Metrics, sessions: SessionTable, port: int) -> asyncio.Server:
    """Answer `GET /metrics` over HTTP, for this machine alone."""

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            async with asyncio.timeout(_PATIENCE_S):
                head = await reader.readuntil(b"\r\n\r\n")
                writer.write(_response(head, metrics, sessions))
                await writer.drain()
        except (TimeoutError, OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # no request came, or nobody is there for the answer
        finally:
            writer.close()

    return await asyncio.start_server(answer, "127.0.0.1", port, limit=_LONGEST_REQUEST)


def _response(head: bytes, metrics: _Metrics, sessions: SessionTable) -> bytes:
    words = head.split(b"\r\n", 1)[0].split(b" ")
    if len(words) != 3 or words[0] not in (b"GET", b"HEAD"):
        return _http("405 Method Not Allowed", b"expected GET /metrics\n")
    if words[1].split(b"?")[0] != b"/metrics":
        return _http("404 Not Found", b"expected /metrics\n")
    body = metrics.text(sessions).encode()
    return _http("200 OK", body, with_body=words[0] == b"GET")


def _http(status: str, body: bytes, *, with_body: bool = True) -> bytes:
    head = (
        f"HTTP/1.1 {status}\r\nContent-Type: text/plain; version=0.0.4; charset=utf-8\r\n"
        f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    )
    return head.encode() + (body if with_body else b"")
