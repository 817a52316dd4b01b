"""The service's methods for gRPC: bytes in, bytes out, so that large ones are parsed beside the event loop."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import Any, TypeAlias

import grpc
import grpc.aio
from grpc.aio import ServicerContext

from sceneloom.errors import DataError, OptionError
from sceneloom.fusion.algorithms import FusionType
from sceneloom.fusion.events import Result
from sceneloom.fusion.messages.fused import FusedDetections
from sceneloom.fusion.messages.records import kind_of
from sceneloom.fusion.messages.wire import fusion_pb2
from sceneloom.fusion.outcome import DONE, Cause, refused
from sceneloom.fusion.tracked import TrackedResults
from sceneloom.service.call_errors import CallError
from sceneloom.service.methods import METHODS, SERVICE, Method
from sceneloom.service.metrics import Metrics
from sceneloom.service.replies import NO_DATA, status_bytes
from sceneloom.service.sessions import DEFAULT_SESSION, Session, SessionTable

Context: TypeAlias = "ServicerContext[bytes, bytes]"

_SMALL = 32_768
"""Bytes of a request that is answered at once where its session has nothing else to do."""

_FEW = 100
"""Detections of a result that is made a reply at once."""

_REFUSALS_REPORTED = 100


class Handlers:
    """Answers the methods of the service for the sessions of a table."""

    def __init__(self, sessions: SessionTable, metrics: Metrics) -> None:
        """Answer for these sessions, and count how."""
        self.sessions = sessions
        self.metrics = metrics
        self.draining = False

    def generic_handler(self) -> grpc.GenericRpcHandler:
        """Give what a gRPC server is reported, from the table of methods."""
        special: dict[str, grpc.RpcMethodHandler[Any, Any]] = {
            "SendStream": grpc.stream_unary_rpc_method_handler(self.send_stream),
            # one message, whose writing can fail before the call has ended
            "Get": grpc.unary_stream_rpc_method_handler(self.get),
            "Subscribe": grpc.unary_stream_rpc_method_handler(self.subscribe),
            "CloseSession": grpc.unary_unary_rpc_method_handler(self.close_session),
        }
        handlers = {
            name: special.get(name) or grpc.unary_unary_rpc_method_handler(self._unary(method))
            for name, method in METHODS.items()
        }
        return grpc.method_handlers_generic_handler(SERVICE.full_name, handlers)

    def _unary(self, method: Method) -> Callable[[bytes, Context], Awaitable[bytes]]:
        async def answer(request: bytes, context: Context) -> bytes:
            with self._counted(method.name) as ended:
                try:
                    return await self._answer(method, request)
                except CallError as error:
                    ended.append(error.code.name)
                    if method.answers_status:
                        return status_bytes(refused(error.cause, error.reason))
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
            self.metrics.called(method, ended[0] if ended else "OK", perf_counter() - begun_s)

    async def _answer(self, method: Method, request: bytes) -> bytes:
        session = self._session_of(method, request)
        self._check_open(method)
        with session.request(len(request), self.sessions.clock):
            if len(request) <= _SMALL and (method.call.quick or (session.idle and method.name != "Flush")):
                return method.perform(session.fusion, request)
            return await session.run(method.perform, session.fusion, request)

    def _session_of(self, method: Method, request: bytes) -> Session:
        try:
            return self.sessions.named(method.session_of(request))
        except DataError as error:
            raise method.fault(error) from error

    def _check_open(self, method: Method) -> None:
        if self.draining and method.answers_status:
            raise CallError(grpc.StatusCode.UNAVAILABLE, Cause.CLOSED, "the server is ending")

    async def send_stream(self, requests: AsyncIterator[bytes], _: Context) -> bytes:
        """Clause 5.6 for a stream of records."""
        summary = fusion_pb2.SendSummary()
        number = 0
        with self._counted("SendStream"):
            async for request in requests:
                status = await self._sent(request)
                if status.status == 1:
                    summary.accepted += 1
                else:
                    summary.refused += 1
                    if summary.refused <= _REFUSALS_REPORTED:
                        summary.refusals.append(fusion_pb2.Refusal(number=number, status=status))
                number += 1
        return summary.SerializeToString()

    async def _sent(self, request: bytes) -> fusion_pb2.Status:
        try:
            return fusion_pb2.Status.FromString(await self._answer(METHODS["Send"], request))
        except CallError as error:
            return fusion_pb2.Status(status=0, cause=str(error.cause), reason=error.reason)

    async def get(self, request: bytes, context: Context) -> None:
        """Clause 5.7."""
        await self._fetch("Get", request, context)

    async def subscribe(self, request: bytes, context: Context) -> None:
        """Clause 5.7 as a stream."""
        await self._fetch("Subscribe", request, context)

    async def _fetch(self, name: str, request: bytes, context: Context) -> None:
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

    async def _deliver(self, session: Session, asked: Any, context: Context) -> None:
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
            await context.write(NO_DATA)

    async def _deliver_tracks(self, session: Session, asked: Any, context: Context) -> None:
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

    async def _write(self, session: Session, result: Result, context: Context) -> None:
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

    async def close_session(self, request: bytes, _: Context) -> bytes:
        """End a session."""
        try:
            name: str = METHODS["CloseSession"].parse(request).session
        except DataError as error:
            return status_bytes(refused(Cause.ILL_TYPED, error))
        session = self.sessions.take(name)
        if session is None:
            return status_bytes(
                refused(Cause.UNKNOWN_NAME, f"session {(name or DEFAULT_SESSION)[:80]!r} is not there")
            )
        await session.end()
        return status_bytes(DONE)
