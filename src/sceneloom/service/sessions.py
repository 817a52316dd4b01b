"""Sessions of the service: a rig each, by name, with its own interface, limits and threads."""

import asyncio
import re
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import ParamSpec, Protocol, TypeVar

import grpc

from sceneloom.db34t.events import Result
from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.properties import Snapshot
from sceneloom.db34t.protobuf import encoded_parts, properties_message
from sceneloom.db34t.records import kind_of
from sceneloom.db34t.types import Cause
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import SceneloomError
from sceneloom.formats.base.protobuf import enclosed
from sceneloom.service.startup import ServiceLimits


class CallError(SceneloomError):
    """A call cannot be answered; where it answers with a `Status`, that says cause and reason.

    Attributes:
        code: what other calls end with.
        cause: for programs.
        reason: for people.
    """

    def __init__(self, code: grpc.StatusCode, cause: Cause, reason: str) -> None:
        super().__init__(code, cause, reason)
        self.code, self.cause, self.reason = code, cause, reason

    def __str__(self) -> str:
        return self.reason

    @classmethod
    def exhausted(cls, reason: str) -> "CallError":
        """There are too many of something."""
        return cls(grpc.StatusCode.RESOURCE_EXHAUSTED, Cause.TOO_MANY, reason)


class _Bell:
    """Wakes the coroutines of one event loop that wait for it; rung from any thread, it never waits itself."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        """Belong to an event loop, in whose thread this is called."""
        self._loop = loop
        self._thread_id = threading.get_ident()
        self._waiting: set[asyncio.Future[None]] = set()
        self._ringing = False

    def ring(self) -> None:
        """Wake all who wait now; nothing happens once the loop has ended."""
        if self._ringing:
            return
        self._ringing = True
        # in its own thread the loop is awake, and need not be woken through a pipe
        call = self._loop.call_soon if threading.get_ident() == self._thread_id else self._loop.call_soon_threadsafe
        try:
            call(self._wake)
        except RuntimeError:
            if not self._loop.is_closed():
                raise

    async def wait(self, timeout_s: float | None) -> None:
        """Wait until it rings, or for so long; who looked before in the same step of the loop misses no ring."""
        woken = self._loop.create_future()
        self._waiting.add(woken)
        try:
            if timeout_s is None:
                await woken
            else:
                await asyncio.wait((woken,), timeout=timeout_s)
        finally:
            self._waiting.discard(woken)

    def _wake(self) -> None:
        self._ringing = False
        for woken in self._waiting:
            if not woken.done():
                woken.set_result(None)


_Arguments = ParamSpec("_Arguments")
_Answer = TypeVar("_Answer")

DEFAULT_SESSION = "default"
"""The session of calls that name none."""

_THREADS_OF_SESSION = 2  # threads that one session may keep busy, so that none waits for another's

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:-]{0,63}")


class MakeInterface(Protocol):
    """Makes the interface of a new session."""

    def __call__(self, name: str, on_result: Callable[[], None]) -> FusionInterface:
        """Make it as the server is configured."""
        ...


class Session:
    """One rig. All methods are for the event loop's thread.

    Attributes:
        name: of the session.
        fusion: its interface.
        replies: makes its answers.
        open_requests, fetching: requests that are being answered, and those of them that fetch results.
        last_used_s, last_fetched_s: when the last request began or ended, and when the last result was delivered.
        ended: whether its results were the last ones.
        observed: whether events have an observer, which takes time.
    """

    def __init__(
        self, name: str, make_interface: MakeInterface, limits: ServiceLimits, pool: ThreadPoolExecutor, now_s: float
    ) -> None:
        """Start; `sessions` makes them."""
        self.name = name
        self.bell = _Bell(asyncio.get_running_loop())
        self.fusion = make_interface(name, self.bell.ring)
        self.replies = _Replies()
        self.open_requests = 0
        self.fetching = 0
        self.last_used_s = now_s
        self.last_fetched_s = -1e9
        self.ended = False
        self.observed = False
        self._limits = limits
        self._pool = pool
        self._threads = asyncio.Semaphore(_THREADS_OF_SESSION)
        self._running = 0
        self._bytes = 0

    @property
    def idle(self) -> bool:
        """Whether a short request can be answered at once: nothing that it could wait for is being done."""
        return self._running == 0 and not self.observed

    @contextmanager
    def request(self, size: int, clock: Callable[[], float]) -> Iterator[None]:
        """Count a request while it is answered.

        Raises:
            CallError: there are too many, or too large ones.
        """
        most = self._limits.most_open_requests
        if self.open_requests >= most:
            raise CallError.exhausted(f"session {self.name!r} has {most} open requests, as many as it may have")
        if self._bytes + size > self._limits.most_bytes_waiting:
            most = self._limits.most_bytes_waiting
            raise CallError.exhausted(f"{self._bytes} bytes of session {self.name!r} wait; expected at most {most}")
        self.open_requests += 1
        self._bytes += size
        self.last_used_s = clock()
        try:
            yield
        finally:
            self.open_requests -= 1
            self._bytes -= size
            self.last_used_s = clock()

    @contextmanager
    def delivering(self) -> Iterator[None]:
        """Count a request that fetches results."""
        self.fetching += 1
        try:
            yield
        finally:
            self.fetching -= 1

    async def run(
        self, function: Callable[_Arguments, _Answer], *arguments: _Arguments.args, **options: _Arguments.kwargs
    ) -> _Answer:
        """Call a function in one of the session's threads; it goes on where the caller does not wait for it."""
        await self._threads.acquire()
        self._running += 1
        loop = asyncio.get_running_loop()
        future = loop.run_in_executor(self._pool, lambda: function(*arguments, **options))
        future.add_done_callback(self._ran)
        return await asyncio.shield(future)

    def _ran(self, future: asyncio.Future[_Answer]) -> None:
        self._running -= 1
        self._threads.release()
        if not future.cancelled():
            future.exception()  # seen, also where nobody waits any more

    async def next_result(self, fusion_type: int | None, timeout_s: float | None) -> Result | None:
        """Fetch a result as soon as there is one; None after the timeout, or where the session has ended.

        Raises:
            OptionError: there is no such type.
        """
        loop = asyncio.get_running_loop()
        deadline = None if timeout_s is None else loop.time() + timeout_s
        while True:
            result = self.fusion.get(fusion_type)
            if result is not None or self.ended:
                return result
            left_s = None if deadline is None else deadline - loop.time()
            if left_s is not None and left_s <= 0:
                return None
            await self.bell.wait(left_s)

    async def end(self) -> None:
        """Fuse what waits; those who fetch get what there is, and then an end."""
        await asyncio.get_running_loop().run_in_executor(self._pool, self.fusion.close)
        self.ended = True
        self.bell.ring()


class SessionTable:
    """All sessions. For the event loop's thread."""

    def __init__(
        self,
        make_interface: MakeInterface,
        limits: ServiceLimits,
        *,
        observed: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Hold no session yet.

        Args:
            make_interface: makes the interface of each.
            limits: of each, and how many there may be.
            observed: whether the interfaces have observers.
            clock: seconds, never backwards.
        """
        self._observed = observed
        self.clock = clock
        self._make_interface = make_interface
        self._limits = limits
        self._sessions: dict[str, Session] = {}
        threads = _THREADS_OF_SESSION * limits.most_sessions + limits.most_sessions
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="session")
        self._ending: dict[asyncio.Task[None], str] = {}

    def __iter__(self) -> Iterator[Session]:
        return iter(list(self._sessions.values()))

    def __len__(self) -> int:
        return len(self._sessions)

    def named(self, name: str) -> Session:
        """Give a session, a new one where there is none of that name.

        Raises:
            CallError: the name cannot be one, or there are too many.
        """
        name = name or DEFAULT_SESSION
        session = self._sessions.get(name)
        if session is not None:
            return session
        if _NAME.fullmatch(name) is None:
            reason = f"session {name[:80]!r}; expected 1 to 64 letters, digits, and . _ : - after the first"
            raise CallError(grpc.StatusCode.INVALID_ARGUMENT, Cause.OUT_OF_RANGE, reason)
        if len(self) + len(self._ending) >= self._limits.most_sessions:
            raise CallError.exhausted(
                f"there are {len(self)} sessions, as many as there may be; end one, or raise the limit most_sessions"
            )
        session = self._sessions[name] = Session(name, self._make_interface, self._limits, self._pool, self.clock())
        session.observed = self._observed
        return session

    def take(self, name: str) -> Session | None:
        """Take a session out, so that the name is free; None where there is none."""
        return self._sessions.pop(name or DEFAULT_SESSION, None)

    def end_idle(self) -> list[str]:
        """End the sessions that nobody used for long, and give their names."""
        before_s = self.clock() - 60.0 * self._limits.idle_minutes
        idle = [s.name for s in self if s.open_requests == 0 and s.last_used_s <= before_s]
        for name in idle:
            task = asyncio.get_running_loop().create_task(self._sessions.pop(name).end())
            self._ending[task] = name
            task.add_done_callback(self._ending.pop)
        return idle

    async def end_all(self, limit_s: float) -> tuple[str, ...]:
        """End all sessions; none can begin. Gives the names of those that have not ended after so long [s]."""
        loop = asyncio.get_running_loop()
        ending = {loop.create_task(session.end()): session.name for session in self}
        self._sessions.clear()
        ending.update(self._ending)
        if not ending:
            return ()
        done, hanging = await asyncio.wait(ending, timeout=limit_s)
        for task in hanging:
            task.cancel()
        for task in done:
            task.result()
        return tuple(sorted(ending[task] for task in hanging))

    def close(self) -> None:
        """Let the threads go."""
        self._pool.shutdown(wait=False)


class _Replies:
    """Makes one session's answers (clause 5.7), for several threads; keeps the bytes of the latest configuration."""

    def __init__(self) -> None:
        """Know no configuration yet."""
        self._latest: tuple[Snapshot, bytes] | None = None

    def reply(self, result: Result) -> bytes:
        """Give the bytes of the answer that carries a result; large arrays are copied once."""
        latest, snapshot = self._latest, result.configuration
        if latest is None or latest[0] is not snapshot:
            latest = self._latest = snapshot, properties_message(snapshot).SerializeToString()
        fields = fusion_pb2.GetReply.DESCRIPTOR.fields_by_name
        return b"".join(
            [
                *enclosed(fields[kind_of(result.record).name].number, encoded_parts(result.record)),
                fusion_pb2.GetReply(number=result.number).SerializeToString(),
                *enclosed(fields["configuration"].number, [latest[1]]),
            ]
        )
