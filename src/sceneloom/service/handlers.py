"""The service's methods for gRPC: bytes in, bytes out, so that large ones are parsed beside the event loop."""

from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any, TypeAlias

import grpc
from grpc.aio import ServicerContext

from sceneloom.errors import DataError, OptionError, SceneloomError
from sceneloom.fusion.interface import Result
from sceneloom.fusion.messages.fused import FusedDetections
from sceneloom.fusion.messages.wire import fusion_pb2
from sceneloom.fusion.outcome import DONE, Cause, Outcome, refused
from sceneloom.service.call_errors import CallError
from sceneloom.service.methods import METHODS, SERVICE, Method
from sceneloom.service.replies import NO_DATA, status_bytes
from sceneloom.service.sessions import DEFAULT_SESSION, Session, SessionTable

Context: TypeAlias = "ServicerContext[bytes, bytes]"

_SMALL = 32_768
"""Bytes of a request that is answered at once where its session has nothing else to do."""

_FEW = 100
"""Detections of a result that is made a reply at once."""

_REFUSALS_TOLD = 100


class Handlers:
    """Answers the methods of the service for the sessions of a table."""

    def __init__(self, sessions: SessionTable) -> None:
        """Answer for these sessions."""
        self.sessions = sessions
        self.draining = False

    def generic_handler(self) -> grpc.GenericRpcHandler:
        """Give what a gRPC server is told, from the table of methods."""
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
            try:
                return await self._answer(method, request)
            except CallError as error:
                if method.answers_status:
                    return status_bytes(refused(error.cause, error.reason))
                await context.abort(error.code, error.reason)

        return answer

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
        async for request in requests:
            outcome = await self._sent(request)
            if outcome:
                summary.accepted += 1
            else:
                summary.refused += 1
                if summary.refused <= _REFUSALS_TOLD:
                    status = fusion_pb2.Status(status=0, cause=str(outcome.cause), reason=outcome.reason)
                    summary.refusals.append(fusion_pb2.Refusal(number=number, status=status))
            number += 1
        return summary.SerializeToString()

    async def _sent(self, request: bytes) -> Outcome:
        try:
            answer = await self._answer(METHODS["Send"], request)
        except CallError as error:
            return refused(error.cause, error.reason)
        status = fusion_pb2.Status.FromString(answer)
        return DONE if status.status == 1 else Outcome(0, Cause(status.cause), status.reason)

    async def get(self, request: bytes, context: Context) -> None:
        """Clause 5.7."""
        session, asked = await self._fetching("Get", request, context)
        await self._deliver(session, asked, context, most=1, timeout_s=asked.wait_ms / 1e3)

    async def subscribe(self, request: bytes, context: Context) -> None:
        """Clause 5.7 as a stream."""
        session, asked = await self._fetching("Subscribe", request, context)
        await self._deliver(session, asked, context, most=asked.most, timeout_s=None)

    async def _fetching(self, name: str, request: bytes, context: Context) -> tuple[Session, Any]:
        method = METHODS[name]
        try:
            session = self._session_of(method, request)
            return session, method.parse(request)
        except CallError as error:
            await context.abort(error.code, error.reason)
        except SceneloomError as error:
            await context.abort(grpc.StatusCode.INVALID_ARGUMENT, str(error))

    async def _deliver(
        self, session: Session, asked: Any, context: Context, *, most: int, timeout_s: float | None
    ) -> None:
        """Write results as they come; one that cannot be written is put back."""
        fusion_type = asked.fusion_type if asked.HasField("fusion_type") else None
        try:
            with session.request(0, self.sessions.clock), session.delivering():
                delivered = 0
                while not (most and delivered >= most):
                    result = await session.next_result(fusion_type, timeout_s)
                    if result is None:
                        break
                    try:
                        await context.write(await self._reply(session, result))
                    except BaseException:
                        session.fusion.put_back(result)
                        raise
                    delivered += 1
                    session.last_fetched_s = self.sessions.clock()
                if timeout_s is not None and delivered == 0:
                    await context.write(NO_DATA)
        except CallError as error:
            await context.abort(error.code, error.reason)
        except OptionError as error:
            await context.abort(grpc.StatusCode.INVALID_ARGUMENT, str(error))

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
