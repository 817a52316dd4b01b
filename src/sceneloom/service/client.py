"""A client of the service: the fusion interface of another process."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, Self

import grpc
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass

from sceneloom.db34t.events import Result
from sceneloom.db34t.protobuf import (
    encode_in,
    fill_message,
    from_protobuf,
    motion_request,
    property_of,
    snapshot_of,
    value_to_protobuf,
)
from sceneloom.db34t.records import CalibrationData, SentRecord
from sceneloom.db34t.setting import Property
from sceneloom.db34t.transport import SERVICE, calls_of, details_of, open_channel
from sceneloom.db34t.types import DONE, Cause, Outcome, refused
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import DataError, OptionError, SceneloomError
from sceneloom.scene.poses import Poses


class ServiceError(SceneloomError):
    """The service did not answer, or answered that it cannot.

    Attributes:
        address: of the service.
        problem: what happened, for people.
    """

    advice = ""
    """What the caller can do about it."""

    def __init__(self, address: str, problem: str) -> None:
        super().__init__(address, problem)
        self.address, self.problem = address, problem

    def __str__(self) -> str:
        return f"{self.address}: {self.problem}" + (f"; {self.advice}" if self.advice else "")


class UnreachableError(ServiceError):
    """Nobody answers at the address, or the connection broke."""

    advice = "is the service there, and are both sides with or both without TLS?"


class UnauthenticatedError(ServiceError):
    """The token is missing or wrong."""

    advice = "state the token that the service was started with"


class TooLargeError(ServiceError):
    """A message is larger than one side takes."""

    advice = "send smaller images or clouds, or raise the limit of the service"


class DeadlineError(ServiceError):
    """The answer did not come in time; whether the call was done is not known."""


_ERRORS: Mapping[grpc.StatusCode, type[ServiceError]] = MappingProxyType(
    {
        grpc.StatusCode.UNAVAILABLE: UnreachableError,
        grpc.StatusCode.UNAUTHENTICATED: UnauthenticatedError,
        grpc.StatusCode.PERMISSION_DENIED: UnauthenticatedError,
        grpc.StatusCode.DEADLINE_EXCEEDED: DeadlineError,
    }
)


@dataclass(frozen=True, slots=True)
class Sent:
    """What became of a stream of records.

    Attributes:
        accepted: how many were taken.
        refused: how many were not.
        refusals: number in the stream and answer of the first of these.
    """

    accepted: int
    refused: int
    refusals: tuple[tuple[int, Outcome], ...] = ()


class FusionClient:
    """The fusion interface of DB34/T 4101-2022, clause 5, of a service at an address.

    Its methods are those of `FusionInterface`, with the same records and answers, and can be called from several
    threads. What is refused is an answer (0 with its reason); errors are for calls that got none. Use it in `with`, or
    call `close`; the session stays until `end_session` or until it was idle for long.

    Attributes:
        address: of the service.
        session: the name of the rig; "" for the service's default one.
        deadline_s: how long an answer may take [s].

    Raises:
        OptionError: a token for another machine without `ca`: it could be read on the way.
        DataError: a file holds no certificate, or no key of it.
        OSError: a file cannot be read.
    """

    def __init__(
        self,
        address: str,
        *,
        token: str | None = None,
        ca: str | Path | None = None,
        certificate: tuple[str | Path, str | Path] | None = None,
        session: str = "",
        deadline_s: float = 30.0,
    ) -> None:
        """Make a client; it connects with the first call.

        Args:
            ca: PEM file of who signed the service's certificate; None for a connection without TLS.
            certificate: PEM files of this client's certificate and key, where the service asks for them.
            deadline_s: how long an answer may take, beyond what a call itself waits for [s].
        """
        self.address, self.session, self.deadline_s = address, session, deadline_s
        self._metadata = () if token is None else (("authorization", f"Bearer {token}"),)
        pair = None if certificate is None else (Path(certificate[0]), Path(certificate[1]))
        self._channel = open_channel(address, ca=None if ca is None else Path(ca), certificate=pair, token=token)
        self._calls = calls_of(self._channel)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the connection; the session stays."""
        self._channel.close()

    def end_session(self) -> Outcome:
        """End the session and forget all of it."""
        return self._status("CloseSession")

    def add_property(self, name: str, description: str, type: str) -> Outcome:
        """Add a property, clause 5.3."""
        return self._status("AddProperty", name=name, description=description, type=type)

    def set_property(self, name: str, value: Any) -> Outcome:
        """Set a property, clause 5.4; it counts for all records that come after."""
        try:
            message = value_to_protobuf(value)
        except DataError as error:
            return refused(Cause.ILL_TYPED, error)
        return self._status("SetProperty", name=name, value=message)

    def get_property(self, name: str) -> Any:
        """Give the value of a property, clause 5.5; None where it was added and not set yet.

        Raises:
            OptionError: there is none of that name.
        """
        return property_of(self._ask("GetProperty", self._request("GetProperty", name=name))).value

    def list_properties(self) -> tuple[Property, ...]:
        """Give all properties, those of table 2 first."""
        return tuple(map(property_of, self._ask("ListProperties", self._request("ListProperties")).properties))

    def set_calibration(self, data: CalibrationData, *, camera_id: int = 0, lidar_id: int = 0) -> Outcome:
        """Set or replace the calibration of a camera and a lidar; it counts for all records that come after."""
        if not all(isinstance(number, int) and 0 <= number <= 255 for number in (camera_id, lidar_id)):
            return refused(Cause.OUT_OF_RANGE, f"camera {camera_id}, lidar {lidar_id}; expected 0 to 255")
        request = self._request("SetCalibration", camera_id=camera_id, lidar_id=lidar_id)
        fill_message(request.calibration, data)
        return _outcome_of(self._ask("SetCalibration", request))

    def send_motion(self, path: Poses) -> Outcome:
        """Report where the vehicle was."""
        try:
            request = motion_request(path, session=self.session)
        except DataError as error:
            return refused(Cause.BAD_MOTION, error)
        return _outcome_of(self._ask("SendMotion", request))

    def send(self, record: SentRecord) -> Outcome:
        """Hand in a record of tables 4 to 8, clause 5.6."""
        if not isinstance(record, SentRecord):
            reason = f"a {type(record).__name__}; expected a record of tables 4 to 8"
            return refused(Cause.BAD_RECORD, reason)
        request = encode_in(fusion_pb2.SendRequest(session=self.session), record)
        return _outcome_of(self._ask("Send", request))

    def send_stream(self, records: Iterable[SentRecord], *, deadline_s: float | None = None) -> Sent:
        """Hand in records as one stream, as fast as the service takes them.

        Args:
            records: any number of them; what this raises, the call raises.
            deadline_s: how long all of it may take [s]; None for as long as it takes.
        """
        failures: list[BaseException] = []

        def requests() -> Iterator[bytes]:
            try:
                for record in records:
                    yield encode_in(fusion_pb2.SendRequest(session=self.session), record)
            except BaseException as error:
                failures.append(error)
                raise

        try:
            answer = self._calls["SendStream"](requests(), timeout=deadline_s, metadata=self._metadata)
        except grpc.RpcError as error:
            if failures:
                raise failures[0] from None
            raise _service_error(self.address, error) from error
        refusals = tuple((refusal.number, _outcome_of(refusal.status)) for refusal in answer.refusals)
        return Sent(answer.accepted, answer.refused, refusals)

    def get(self, fusion_type: int | None = None, timeout_s: float = 0.0) -> Result | None:
        """Fetch the oldest result that nobody has fetched, clause 5.7; None where there is none.

        Args:
            fusion_type: 0 sensor data, 1 detections; None for what the property fusion_type says.

        Raises:
            OptionError: there is no such type.
        """
        wait_ms = min(max(round(timeout_s * 1e3), 0), 2**32 - 1)
        request = self._request("Get", fusion_type=_type_or_none(fusion_type), wait_ms=wait_ms)
        return _result_of(self._ask("Get", request, wait_s=wait_ms / 1e3))

    def results(self, fusion_type: int | None = None) -> Iterator[Result]:
        """Fetch all results that are there."""
        return iter(lambda: self.get(fusion_type), None)

    def subscribe(self, fusion_type: int | None = None, *, most: int = 0, track: bool = False) -> Iterator[Result]:
        """Give results as they come, until the session ends or the iteration does.

        Args:
            fusion_type: 0 sensor data, 1 detections; None for what the property fusion_type says.
            most: end after so many; 0 for never.
            track: whether the objects of detections are followed from sweep to sweep; their `id` is that of a track.

        Raises:
            OptionError: there is no such type, or it has no objects to follow.
        """
        request = self._request("Subscribe", fusion_type=_type_or_none(fusion_type), most=most, track=track)
        call = self._calls["Subscribe"](request, metadata=self._metadata)
        try:
            for reply in call:
                found = _result_of(reply)
                if found is not None:
                    yield found
        except grpc.RpcError as error:
            raise self._failure(error) from error
        finally:
            call.cancel()

    def counters(self) -> dict[str, int]:
        """What came in, what was left out and why."""
        return dict(sorted(self._ask("GetCounters", self._request("GetCounters")).counts.items()))

    def flush(self) -> Outcome:
        """Fuse what waits with what has come, and return when that is done."""
        return self._status("Flush")

    def _request(self, method: str, **fields: Any) -> Any:
        return _REQUESTS[method](session=self.session, **fields)

    def _status(self, method: str, **fields: Any) -> Outcome:
        return _outcome_of(self._ask(method, self._request(method, **fields)))

    def _ask(self, name: str, request: Message | bytes, *, wait_s: float = 0.0) -> Any:
        try:
            return self._calls[name](request, timeout=self.deadline_s + wait_s, metadata=self._metadata)
        except grpc.RpcError as error:
            raise self._failure(error) from error

    def _failure(self, error: grpc.RpcError) -> Exception:
        if _code_of(error) in _OF_THE_CALLER:
            return OptionError(details_of(error) or f"{self.address}: {_code_of(error).name.lower()}")
        return _service_error(self.address, error)


_REQUESTS = {method.name: GetMessageClass(method.input_type) for method in SERVICE.methods}


_OF_THE_CALLER = (grpc.StatusCode.NOT_FOUND, grpc.StatusCode.INVALID_ARGUMENT)
"""What is answered to a value that cannot be followed."""


def _type_or_none(fusion_type: int | None) -> int | None:
    if fusion_type is None or (not isinstance(fusion_type, bool) and fusion_type in (0, 1)):
        return fusion_type
    raise OptionError(f"fusion type {fusion_type!r}; expected 0 (sensor data) or 1 (detections)")


def _outcome_of(message: fusion_pb2.Status) -> Outcome:
    """Give the answer of a message; a cause that is none of ours is left to the reason."""
    if message.status == 1 and not message.cause:
        return DONE
    known = {str(cause) for cause in Cause}
    cause = Cause(message.cause) if message.cause in known else Cause.NONE
    return Outcome(message.status, cause, message.reason)


def _result_of(message: fusion_pb2.GetReply) -> Result | None:
    """Give the result of an answer of clause 5.7; None where it says that there is none."""
    name = message.WhichOneof("result")
    if name is None:
        raise DataError("reply", "result", "missing; expected sensor_data, detections or no_data")
    if name == "no_data":
        return None
    return Result(message.number, from_protobuf(getattr(message, name)), snapshot_of(message.configuration))


def _service_error(address: str, error: grpc.RpcError) -> ServiceError:
    """Give the error of a call that failed."""
    code, details = _code_of(error), details_of(error)
    # the status of a message beyond either side's limit is also that of other limits
    kind = TooLargeError if "larger than max" in details else _ERRORS.get(code, ServiceError)
    problem = f"{code.name.lower().replace('_', ' ')}: {details}" if details else code.name.lower()
    return kind(address, problem)


def _code_of(error: grpc.RpcError) -> grpc.StatusCode:
    """The status that a call ended with."""
    code = getattr(error, "code", lambda: None)()
    return code if isinstance(code, grpc.StatusCode) else grpc.StatusCode.UNKNOWN
