"""The methods of the service: what each call does with the interface of its session, and tracking of fused results."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter
from types import MappingProxyType
from typing import Any, TypeAlias

import grpc
import grpc.aio
import numpy as np
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
from grpc.aio import ServicerContext

from sceneloom.arrays import Float64Array
from sceneloom.db34t.events import Result
from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.protobuf import (
    decode_send_request,
    from_protobuf,
    parse_message,
    path_of,
    properties_message,
    property_to_protobuf,
    value_from_protobuf,
)
from sceneloom.db34t.records import FusedDetections, kind_of
from sceneloom.db34t.results import FoundObjects, tracked_detections_record
from sceneloom.db34t.transport import SERVICE
from sceneloom.db34t.types import DONE, Cause, Outcome, refused
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.detections.results import NO_BOX, FusedBoxes
from sceneloom.errors import DataError, OptionError, SceneloomError
from sceneloom.formats.base.protobuf import LENGTH_TYPE, wire_fields
from sceneloom.fusion.algorithms import FusionType
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.detections import Support, TrackedObjects
from sceneloom.scene.types import Identifier
from sceneloom.service.sessions import DEFAULT_SESSION, CallError, Session, SessionTable
from sceneloom.tracking.settings import TrackerSettings
from sceneloom.tracking.tracker import Observation, Tracker, View


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
class Call:
    """What a method does.

    Attributes:
        perform: given the interface and the request; None where it takes more than one step of the event loop.
        cause: why a message that is none is refused.
        quick: it never waits for records that are being received.
        reads_bytes: it is given the bytes of the request.
    """

    perform: Callable[[FusionInterface, Any], Outcome | Message] | None
    cause: Cause = Cause.ILL_TYPED
    quick: bool = False
    reads_bytes: bool = False


CALLS: Mapping[str, Call] = MappingProxyType(
    {
        "AddProperty": Call(lambda fusion, r: fusion.add_property(r.name, r.description, r.type), quick=True),
        "SetProperty": Call(lambda fusion, r: fusion.set_property(r.name, value_from_protobuf(r.value))),
        "GetProperty": Call(_get_property, quick=True),
        "ListProperties": Call(lambda fusion, _: properties_message(fusion.properties.snapshot()), quick=True),
        "SetCalibration": Call(
            lambda fusion, r: fusion.set_calibration(
                from_protobuf(r.calibration), camera_id=r.camera_id, lidar_id=r.lidar_id
            ),
            Cause.BAD_CALIBRATION,
        ),
        "SendMotion": Call(lambda fusion, r: fusion.send_motion(path_of(r)), Cause.BAD_MOTION),
        "Send": Call(_send, Cause.BAD_RECORD, reads_bytes=True),
        "SendStream": Call(None, Cause.BAD_RECORD),
        "Get": Call(None),
        "Subscribe": Call(None),
        "GetCounters": Call(lambda fusion, _: fusion_pb2.Counters(counts=fusion.counters.counts()), quick=True),
        "Flush": Call(_flush),
        "CloseSession": Call(None),
    }
)
"""By the names of the `.proto`."""


@dataclass(frozen=True, slots=True)
class _Method:
    """A method of the service as the `.proto` describes it, and what it does."""

    name: str
    request_type: type[Any]
    reply_type: type[Any]
    call: Call

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
            method.name, GetMessageClass(method.input_type), GetMessageClass(method.output_type), CALLS[method.name]
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
        lidar = self._lidars.setdefault(found.frame.lidar_id, _OneLidar(Tracker(TrackerSettings())))
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
    record = tracked_detections_record(result.record, seen, found.setting, found.frame.camera)
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


class Handlers:
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

    def _session_of(self, method: _Method, request: bytes) -> Session:
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

    async def _deliver(self, session: Session, asked: Any, context: _Context) -> None:
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

    async def _deliver_tracks(self, session: Session, asked: Any, context: _Context) -> None:
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

    async def _write(self, session: Session, result: Result, context: _Context) -> None:
        """Write a result; where that fails, who fetched it puts it back, so that others have it."""
        try:
            await context.write(await self._reply(session, result))
        except grpc.aio.InternalError as error:  # the connection has broken
            raise asyncio.CancelledError from error
        session.fusion.counters.add(f"delivered.{kind_of(result.record).name}")
        session.last_fetched_s = self.sessions.clock()

    async def _reply(self, session: Session, result: Result) -> bytes:
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
                refused(Cause.UNKNOWN_NAME, f"session {(name or DEFAULT_SESSION)[:80]!r} is not there")
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
