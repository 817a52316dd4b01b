"""The gRPC server: sessions, what each method does with them, tracks of fused results.

Also access control (TLS, tokens), health, metrics, and a shutdown that loses nothing.
"""

import asyncio
import hmac
import logging
import re
import threading
import time
from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter
from types import MappingProxyType, TracebackType
from typing import Any, ParamSpec, Self, TypeAlias, TypeVar

import grpc
import grpc.aio
import numpy as np
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
from grpc.aio import ServerInterceptor, ServicerContext
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from sceneloom.arrays import Float64Array
from sceneloom.db34t.events import Event, Result
from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.protobuf import (
    decode_send_request,
    encode_in,
    from_protobuf,
    parse_message,
    path_of,
    properties_message,
    property_to_protobuf,
    value_from_protobuf,
)
from sceneloom.db34t.records import FusedDetections, kind_of
from sceneloom.db34t.scene_objects import FoundObjects, declared_columns
from sceneloom.db34t.setting import Snapshot
from sceneloom.db34t.transport import SERVICE, Security
from sceneloom.db34t.types import DONE, Cause, Outcome, refused
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.detections.results import NO_BOX, FusedBoxes
from sceneloom.errors import DataError, OptionError, SceneloomError
from sceneloom.formats.base.wire_formats import LENGTH_TYPE, wire_fields
from sceneloom.fusion.algorithms import FusionType
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.detections import Support, TrackedObjects
from sceneloom.scene.types import Identifier
from sceneloom.service.startup import ServiceLimits, check_port
from sceneloom.tracking.settings import TrackerSettings
from sceneloom.tracking.tracker import Observation, Tracker, View


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
_DEFAULT_SESSION = "default"
"""The session of calls that name none."""

_THREADS_OF_SESSION = 2  # threads that one session may keep busy, so that none waits for another's
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:-]{0,63}")


_MakeInterface = Callable[[str, Callable[[], None]], FusionInterface]
"""Makes the interface of a new session: given its name, and what to call on each result."""


class _Session:
    """One rig; all methods are for the event loop's thread."""

    def __init__(
        self, name: str, make_interface: _MakeInterface, limits: ServiceLimits, pool: ThreadPoolExecutor, now_s: float
    ) -> None:
        self.name = name
        self.bell = _Bell(asyncio.get_running_loop())
        self.fusion = make_interface(name, self.bell.ring)
        self.replies = _Replies()
        self.open_requests = self.fetching = 0  # those that are being answered, and those of them that fetch results
        self.last_used_s, self.last_fetched_s = now_s, -1e9
        self.ended = self.observed = False
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
        make_interface: _MakeInterface,
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
        self._sessions: dict[str, _Session] = {}
        threads = _THREADS_OF_SESSION * limits.most_sessions + limits.most_sessions
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="session")
        self._ending: dict[asyncio.Task[None], str] = {}

    def __iter__(self) -> Iterator[_Session]:
        return iter(list(self._sessions.values()))

    def __len__(self) -> int:
        return len(self._sessions)

    def named(self, name: str) -> _Session:
        """Give a session, a new one where there is none of that name.

        Raises:
            CallError: the name cannot be one, or there are too many.
        """
        name = name or _DEFAULT_SESSION
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
        session = self._sessions[name] = _Session(name, self._make_interface, self._limits, self._pool, self.clock())
        session.observed = self._observed
        return session

    def take(self, name: str) -> _Session | None:
        """Take a session out, so that the name is free; None where there is none."""
        return self._sessions.pop(name or _DEFAULT_SESSION, None)

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
        self._latest: tuple[Snapshot, bytes] | None = None

    def reply(self, result: Result) -> bytes:
        """Give the bytes of the answer that carries a result; large arrays are copied once."""
        latest, snapshot = self._latest, result.configuration
        if latest is None or latest[0] is not snapshot:
            configuration = fusion_pb2.GetReply(configuration=properties_message(snapshot)).SerializeToString()
            latest = self._latest = snapshot, configuration
        return encode_in(fusion_pb2.GetReply(number=result.number), result.record, more=latest[1])


def _get_property(fusion: FusionInterface, request: fusion_pb2.GetPropertyRequest) -> Message:
    """Clause 5.5."""
    try:
        return property_to_protobuf(fusion.properties.get(request.name))
    except OptionError as error:
        raise CallError(grpc.StatusCode.NOT_FOUND, Cause.UNKNOWN_NAME, str(error)) from error


def _send(fusion: FusionInterface, request: bytes) -> Outcome:
    """Clause 5.6; arrays are read where they stand in the request."""
    try:
        record = decode_send_request(request)
    except SceneloomError:
        fusion.counters.add(f"refused.{Cause.BAD_RECORD}")
        raise
    return fusion.send(record)


def _flush(fusion: FusionInterface, _: fusion_pb2.FlushRequest) -> Outcome:
    fusion.flush()
    return DONE


@dataclass(frozen=True, slots=True)
class _Call:
    """What a method does, by `perform`; None where it takes more than one step of the event loop."""

    perform: Callable[[FusionInterface, Any], Outcome | Message] | None
    cause: Cause = Cause.ILL_TYPED  # why a message that is none is refused
    quick: bool = False  # it never waits for records that are being received
    reads_bytes: bool = False  # it is given the bytes of the request


_CALLS: Mapping[str, _Call] = MappingProxyType(
    {
        "AddProperty": _Call(lambda fusion, r: fusion.add_property(r.name, r.description, r.type), quick=True),
        "SetProperty": _Call(lambda fusion, r: fusion.set_property(r.name, value_from_protobuf(r.value))),
        "GetProperty": _Call(_get_property, quick=True),
        "ListProperties": _Call(lambda fusion, _: properties_message(fusion.properties.snapshot()), quick=True),
        "SetCalibration": _Call(
            lambda fusion, r: fusion.set_calibration(
                from_protobuf(r.calibration), camera_id=r.camera_id, lidar_id=r.lidar_id
            ),
            Cause.BAD_CALIBRATION,
        ),
        "SendMotion": _Call(lambda fusion, r: fusion.send_motion(path_of(r)), Cause.BAD_MOTION),
        "Send": _Call(_send, Cause.BAD_RECORD, reads_bytes=True),
        "SendStream": _Call(None, Cause.BAD_RECORD),
        "Get": _Call(None),
        "Subscribe": _Call(None),
        "GetCounters": _Call(lambda fusion, _: fusion_pb2.Counters(counts=fusion.counters.counts()), quick=True),
        "Flush": _Call(_flush),
        "CloseSession": _Call(None),
    }
)
"""By the names of the `.proto`."""


@dataclass(frozen=True, slots=True)
class _Method:
    """A method of the service as the `.proto` describes it, and what it does."""

    name: str
    request_type: type[Any]
    reply_type: type[Any]
    call: _Call

    @property
    def answers_status(self) -> bool:
        """Whether it says 1 or 0, as clauses 5.3.3, 5.4.3 and 5.6.3 do."""
        return self.reply_type is fusion_pb2.Status

    def session_of(self, request: bytes) -> str:
        """The session that a request names, "" for none; the rest of a large one is not read."""
        fields = wire_fields(request, 0, len(request))
        if fields is None:
            name: str = self.parse(request).session
            return name
        number = self.request_type.DESCRIPTOR.fields_by_name["session"].number
        named = [field for field in fields if field.number == number and field.type == LENGTH_TYPE]
        try:
            return request[named[-1].start : named[-1].stop].decode() if named else ""
        except UnicodeDecodeError as error:
            raise DataError("request", "session", "no UTF-8; expected a name") from error

    def parse(self, request: bytes) -> Any:
        """Read a request."""
        return parse_message(self.request_type, request)

    def perform(self, fusion: FusionInterface, request: bytes) -> bytes:
        """Read a request, do it, and give the bytes of the answer."""
        if self.call.perform is None:
            raise TypeError(f"{self.name} is not one step")
        try:
            answer = self.call.perform(fusion, request if self.call.reads_bytes else self.parse(request))
        except CallError:
            raise
        except SceneloomError as error:
            raise self.fault(error) from error
        return _status_bytes(answer) if isinstance(answer, Outcome) else answer.SerializeToString()

    def fault(self, reason: object) -> CallError:
        """What a request that is none ends with."""
        return CallError(grpc.StatusCode.INVALID_ARGUMENT, self.call.cause, str(reason))


METHODS: Mapping[str, _Method] = MappingProxyType(
    {
        method.name: _Method(
            method.name, GetMessageClass(method.input_type), GetMessageClass(method.output_type), _CALLS[method.name]
        )
        for method in SERVICE.methods
    }
)
"""All methods of the `.proto`, by name."""


@dataclass(slots=True)
class _OneLidar:
    """What is followed of one lidar's sweeps."""

    tracker: Tracker
    origin: Float64Array | None = None  # (3,) [m], of the tracker's world in that of the vehicle's trajectory
    waiting: list[Result] = field(default_factory=list)  # of the newest sweep, until all of its images are there
    sweep: tuple[int, int] = (-1, -1)  # index and time of that sweep


class TrackedResults:
    """Follows objects through results as they are fetched; not for several threads at once."""

    def __init__(self) -> None:
        """Follow nothing yet."""
        self._lidars: dict[Identifier, _OneLidar] = {}

    def take(self, result: Result) -> list[Result]:
        """Take the next result, and give those whose objects are tracks now.

        A result is given for each one taken, with its number and configuration, as soon as all images of its sweep
        are there, or another sweep comes. Its objects are those that are believed in at the time of the sweep: `id` is
        that of the track; the numbers of the boxes behind them are not reported.
        """
        found = result.found
        if found is None:
            return [result]
        settings = TrackerSettings(detectors=result.configuration["detectors"])
        lidar = self._lidars.setdefault(found.frame.lidar_id, _OneLidar(Tracker(settings)))
        given: list[Result] = []
        sweep = found.frame.index, found.frame.timestamp_ns
        if lidar.sweep != sweep and lidar.waiting:
            given += _step(lidar)
        lidar.sweep = sweep
        lidar.waiting.append(result)
        return given + _step(lidar) if found.frame.last else given


def _step(lidar: _OneLidar) -> list[Result]:
    """Follow the objects of the sweep that waits."""
    pairs = [(result, result.found) for result in lidar.waiting if result.found is not None]
    lidar.waiting = []
    first = pairs[0][1]
    if lidar.origin is None:
        lidar.origin = first.origin
    world_from_lidar = RigidTransform(
        first.world_from_lidar.rotation, first.world_from_lidar.translation + (first.origin - lidar.origin)
    )
    objects = lidar.tracker.step(
        Observation(
            first.frame.timestamp_ns,
            world_from_lidar,
            {found.frame.camera_id: found.frame.fused for _, found in pairs},
            {found.frame.camera_id: View(found.frame.camera, found.frame.camera_from_lidar) for _, found in pairs},
        )
    )
    return [_tracked(result, found, objects, world_from_lidar.inverse()) for result, found in pairs]


def _tracked(result: Result, found: FoundObjects, objects: TrackedObjects, lidar_from_world: RigidTransform) -> Result:
    if not isinstance(result.record, FusedDetections):
        return result
    seen = _boxes_of(objects, found.frame.camera_id, lidar_from_world)
    columns, _ = declared_columns(seen, found.setting.declared_from_standard, found.frame.camera)
    none: tuple[None, ...] = (None,) * len(seen)
    numbers = (seen.ids & (2**31 - 1)).astype(np.int32)
    record = replace(result.record, id=numbers, class_names=seen.labels, box_3d_ids=none, box_2d_ids=none, **columns)
    return replace(result, record=record, found=None)


def _boxes_of(objects: TrackedObjects, camera_id: Identifier, lidar_from_world: RigidTransform) -> FusedBoxes:
    """Give tracked objects as objects of a sweep and an image, in the lidar's frame."""
    # `rows_3d` and `rows_2d` report whether there is a box, with 0 for one: its number is not known
    rotation, count = lidar_from_world.rotation, len(objects)
    headings = np.column_stack([np.cos(objects.yaws), np.sin(objects.yaws), np.zeros(count)]) @ rotation.T
    unseen = np.full((count, 4), np.nan)
    measured = np.isin(objects.supports, (Support.BOTH, Support.SWEEP))
    pictured = np.isin(objects.supports, (Support.BOTH, Support.IMAGE))
    return FusedBoxes(
        timestamp_ns=objects.timestamp_ns,
        centers=lidar_from_world.apply(objects.centers),
        center_covariances=rotation @ objects.covariances[:, :3, :3] @ rotation.T,
        sizes_lwh=objects.sizes_lwh,
        size_covariances=np.ascontiguousarray(objects.covariances[:, 3:6, 3:6]),
        yaws=np.arctan2(headings[:, 1], headings[:, 0]),
        velocities=objects.velocities @ rotation.T,
        scores=objects.scores,
        labels=objects.labels,
        corners_xyxy=np.nan_to_num(objects.corners_xyxy.get(camera_id, unseen)),
        ids=objects.ids,
        rows_3d=np.where(measured, 0, NO_BOX),
        rows_2d=np.where(pictured, 0, NO_BOX),
    )


_Context: TypeAlias = "ServicerContext[bytes, bytes]"
_SMALL = 32_768  # bytes of a request that is answered at once where its session has nothing else to do
_FEW = 100  # detections of a result that is made a reply at once
_REFUSALS_REPORTED = 100


class _Handlers:
    """Answers the methods of the service for the sessions of a table."""

    def __init__(self, sessions: SessionTable, count: Callable[[str, str, float], None]) -> None:
        """Answer for these sessions.

        Args:
            count: called after each call with its method, how it ended, and how long it took [s].
        """
        self.sessions = sessions
        self._count = count
        self.draining = False

    def generic_handler(self) -> grpc.GenericRpcHandler:
        """Make the handlers that a gRPC server is given, from the table of methods."""
        special: dict[str, grpc.RpcMethodHandler[Any, Any]] = {
            "SendStream": grpc.stream_unary_rpc_method_handler(self.send_stream),
            # one message, whose writing can fail before the call has ended
            "Get": grpc.unary_stream_rpc_method_handler(partial(self._fetch, "Get")),
            "Subscribe": grpc.unary_stream_rpc_method_handler(partial(self._fetch, "Subscribe")),
            "CloseSession": grpc.unary_unary_rpc_method_handler(self.close_session),
        }
        handlers = {
            name: special.get(name) or grpc.unary_unary_rpc_method_handler(self._unary(method))
            for name, method in METHODS.items()
        }
        return grpc.method_handlers_generic_handler(SERVICE.full_name, handlers)

    def _unary(self, method: _Method) -> Callable[[bytes, _Context], Awaitable[bytes]]:
        async def answer(request: bytes, context: _Context) -> bytes:
            with self._counted(method.name) as ended:
                try:
                    return await self._answer(method, request)
                except CallError as error:
                    ended.append(error.code.name)
                    if method.answers_status:
                        return _status_bytes(refused(error.cause, error.reason))
                    await context.abort(error.code, error.reason)

        return answer

    @contextmanager
    def _counted(self, method: str) -> Iterator[list[str]]:
        """Measure a call; what is put into the list is how it ended, else it is OK, or what was raised."""
        begun_s = perf_counter()
        ended: list[str] = []
        try:
            yield ended
        except asyncio.CancelledError:
            ended.append("CANCELLED")
            raise
        except Exception:
            ended.append("INTERNAL")
            raise
        finally:
            self._count(method, ended[0] if ended else "OK", perf_counter() - begun_s)

    async def _answer(self, method: _Method, request: bytes) -> bytes:
        session = self._session_of(method, request)
        if self.draining and method.answers_status:
            raise CallError(grpc.StatusCode.UNAVAILABLE, Cause.CLOSED, "the server is ending")
        with session.request(len(request), self.sessions.clock):
            if len(request) <= _SMALL and (method.call.quick or (session.idle and method.name != "Flush")):
                return method.perform(session.fusion, request)
            return await session.run(method.perform, session.fusion, request)

    def _session_of(self, method: _Method, request: bytes) -> _Session:
        try:
            return self.sessions.named(method.session_of(request))
        except DataError as error:
            raise method.fault(error) from error

    async def send_stream(self, requests: AsyncIterator[bytes], _: _Context) -> bytes:
        """Clause 5.6 for a stream of records."""
        summary = fusion_pb2.SendSummary()
        number = 0
        with self._counted("SendStream"):
            async for request in requests:
                try:
                    status = fusion_pb2.Status.FromString(await self._answer(METHODS["Send"], request))
                except CallError as error:
                    status = fusion_pb2.Status(status=0, cause=str(error.cause), reason=error.reason)
                if status.status == 1:
                    summary.accepted += 1
                else:
                    summary.refused += 1
                    if summary.refused <= _REFUSALS_REPORTED:
                        summary.refusals.append(fusion_pb2.Refusal(number=number, status=status))
                number += 1
        return summary.SerializeToString()

    async def _fetch(self, name: str, request: bytes, context: _Context) -> None:
        """Clause 5.7, at once or as a stream."""
        method = METHODS[name]
        with self._counted(name) as ended:
            try:
                session = self._session_of(method, request)
                asked = method.parse(request)
                with session.request(len(request), self.sessions.clock), session.delivering():
                    await self._deliver(session, asked, context)
            except CallError as error:
                ended.append(error.code.name)
                await context.abort(error.code, error.reason)
            except (DataError, OptionError) as error:
                ended.append("INVALID_ARGUMENT")
                await context.abort(grpc.StatusCode.INVALID_ARGUMENT, str(error))

    async def _deliver(self, session: _Session, asked: Any, context: _Context) -> None:
        """Write results as they come: one or no data for Get, else until the caller or the session ends."""
        once = isinstance(asked, fusion_pb2.GetRequest)
        if not once and asked.track:
            await self._deliver_tracks(session, asked, context)
            return
        most = 1 if once else asked.most
        fusion_type = asked.fusion_type if asked.HasField("fusion_type") else None
        delivered = 0
        while not (most and delivered >= most):
            result = await session.next_result(fusion_type, asked.wait_ms / 1e3 if once else None)
            if result is None:
                break
            try:
                await self._write(session, result, context)
            except BaseException:
                session.fusion.put_back(result)
                raise
            delivered += 1
        if once and not delivered:
            await context.write(_NO_DATA)

    async def _deliver_tracks(self, session: _Session, asked: Any, context: _Context) -> None:
        """Write results of detection fusion as they come, their objects followed from one to the next."""
        if asked.HasField("fusion_type") and asked.fusion_type != FusionType.DETECTIONS:
            raise OptionError(f"track: fusion_type {asked.fusion_type}; expected 1, detections")
        tracked, delivered = TrackedResults(), 0
        taken: dict[int, Result] = {}
        try:
            while not (asked.most and delivered >= asked.most):
                result = await session.next_result(FusionType.DETECTIONS, None)
                if result is None:
                    break
                taken[result.number] = result
                for reported in await session.run(tracked.take, result):
                    await self._write(session, reported, context)
                    del taken[reported.number]
                    delivered += 1
        finally:
            for result in taken.values():
                session.fusion.put_back(result)

    async def _write(self, session: _Session, result: Result, context: _Context) -> None:
        """Write a result; where that fails, who fetched it puts it back, so that others have it."""
        try:
            await context.write(await self._reply(session, result))
        except grpc.aio.InternalError as error:  # the connection has broken
            raise asyncio.CancelledError from error
        session.fusion.counters.add(f"delivered.{kind_of(result.record).name}")
        session.last_fetched_s = self.sessions.clock()

    async def _reply(self, session: _Session, result: Result) -> bytes:
        if isinstance(result.record, FusedDetections) and len(result.record) <= _FEW:
            return session.replies.reply(result)
        return await session.run(session.replies.reply, result)

    async def close_session(self, request: bytes, _: _Context) -> bytes:
        """End a session."""
        try:
            name: str = METHODS["CloseSession"].parse(request).session
        except DataError as error:
            return _status_bytes(refused(Cause.ILL_TYPED, error))
        session = self.sessions.take(name)
        if session is None:
            return _status_bytes(
                refused(Cause.UNKNOWN_NAME, f"session {(name or _DEFAULT_SESSION)[:80]!r} is not there")
            )
        await session.end()
        return _status_bytes(DONE)


_NO_DATA = fusion_pb2.GetReply(no_data=fusion_pb2.NoData()).SerializeToString()


def _status_bytes(outcome: Outcome) -> bytes:
    """Give the bytes of a `Status`."""
    if outcome is DONE:
        return _DONE
    return fusion_pb2.Status(status=outcome.status, cause=str(outcome.cause), reason=outcome.reason).SerializeToString()


_DONE = fusion_pb2.Status(status=1).SerializeToString()
_OPEN_SERVICES = ("/grpc.health.v1.Health/",)
"""Services that need no token: they report whether the server is up, and nothing else."""


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
        self._handlers = _Handlers(self.sessions, self._metrics.called)
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
            interceptors=[] if security.token is None else [_TokenCheck(security.token)],
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

    def _is_fetched(self, session: _Session) -> bool:
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
            most_length=most.most_queue_length,
            most_bytes=most.most_bytes_waiting,
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
