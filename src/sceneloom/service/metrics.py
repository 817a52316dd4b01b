"""Numbers for Prometheus: calls by method and outcome, how long they took, and what each session counts."""

import asyncio
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from sceneloom.service.sessions import SessionTable

BOUNDS_S = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
"""Upper bounds of the classes of durations [s]."""

LONGEST_REQUEST = 8192
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


class Metrics:
    """What the service counts. For the event loop's thread."""

    def __init__(self) -> None:
        """Begin at 0."""
        self._calls: Counter[tuple[str, str]] = Counter()
        self._durations: dict[str, Histogram] = {}

    def called(self, method: str, outcome: str, duration_s: float) -> None:
        """Count a call that was answered."""
        self._calls[method, outcome] += 1
        histogram = self._durations.get(method)
        if histogram is None:
            histogram = self._durations[method] = Histogram()
        histogram.add(duration_s)

    def text(self, sessions: SessionTable) -> str:
        """Give all numbers.

        Source: prometheus.io, "Exposition formats", text-based format, version 0.0.4.
        """
        return "\n".join([*self._of_calls(), *_of_sessions(sessions)]) + "\n"

    def _of_calls(self) -> Iterator[str]:
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


def _of_sessions(sessions: SessionTable) -> Iterator[str]:
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
    quoted = ",".join(f'{label}="{_escaped(text)}"' for label, text in labels.items())
    return f"{name}{{{quoted}}} {value}" if quoted else f"{name} {value}"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


async def serve_metrics(metrics: Metrics, sessions: SessionTable, port: int) -> asyncio.Server:
    """Answer `GET /metrics` over HTTP, for this machine alone.

    Args:
        port: 0 for a free one.

    Raises:
        OSError: the port cannot be had.
    """

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

    return await asyncio.start_server(answer, "127.0.0.1", port, limit=LONGEST_REQUEST)


def _response(head: bytes, metrics: Metrics, sessions: SessionTable) -> bytes:
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
