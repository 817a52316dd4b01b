"""The table of the service's methods: what each does with the fusion interface of its session."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import grpc
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass

from sceneloom.errors import DataError, OptionError, SceneloomError
from sceneloom.formats.wire_bytes import LENGTH_TYPE, wire_fields
from sceneloom.fusion.interface import FusionInterface
from sceneloom.fusion.messages.protobuf_form import (
    decode_send_request,
    from_protobuf,
    parse_message,
)
from sceneloom.fusion.messages.wire import fusion_pb2
from sceneloom.fusion.outcome import DONE, Cause, Outcome
from sceneloom.service.call_errors import CallError
from sceneloom.service.motion_form import path_of
from sceneloom.service.replies import properties_message, status_bytes
from sceneloom.service.values import property_to_protobuf, value_from_protobuf

SERVICE = fusion_pb2.DESCRIPTOR.services_by_name["DataFusion"]
"""The descriptor of the service."""


def add_property(fusion: FusionInterface, request: fusion_pb2.AddPropertyRequest) -> Outcome:
    """Clause 5.3."""
    return fusion.add_property(request.name, request.description, request.type)


def set_property(fusion: FusionInterface, request: fusion_pb2.SetPropertyRequest) -> Outcome:
    """Clause 5.4."""
    return fusion.set_property(request.name, value_from_protobuf(request.value))


def get_property(fusion: FusionInterface, request: fusion_pb2.GetPropertyRequest) -> Message:
    """Clause 5.5."""
    try:
        return property_to_protobuf(fusion.properties.get(request.name))
    except OptionError as error:
        raise CallError(grpc.StatusCode.NOT_FOUND, Cause.UNKNOWN_NAME, str(error)) from error


def list_properties(fusion: FusionInterface, _: fusion_pb2.ListPropertiesRequest) -> Message:
    """All properties."""
    return properties_message(fusion.properties.snapshot())


def set_calibration(fusion: FusionInterface, request: fusion_pb2.SetCalibrationRequest) -> Outcome:
    """Table 3."""
    data = from_protobuf(request.calibration)
    return fusion.set_calibration(data, camera_id=request.camera_id, lidar_id=request.lidar_id)


def send_motion(fusion: FusionInterface, request: fusion_pb2.SendMotionRequest) -> Outcome:
    """The trajectory of the vehicle."""
    return fusion.send_motion(path_of(request))


def send(fusion: FusionInterface, request: bytes) -> Outcome:
    """Clause 5.6; arrays are read where they stand in the request."""
    try:
        record = decode_send_request(request)
    except SceneloomError:
        fusion.counters.add(f"refused.{Cause.BAD_RECORD}")
        raise
    return fusion.send(record)


def get_counters(fusion: FusionInterface, _: fusion_pb2.GetCountersRequest) -> Message:
    """What came in, what was left out and why."""
    return fusion_pb2.Counters(counts=fusion.counters.counts())


def flush(fusion: FusionInterface, _: fusion_pb2.FlushRequest) -> Outcome:
    """Fuse what waits."""
    fusion.flush()
    return DONE


@dataclass(frozen=True, slots=True)
class Call:
    """What a method does.

    Attributes:
        perform: given the interface and the request; None where it takes more than one step of the event loop.
        cause: why a message that is none is refused.
        quick: it never waits for records that are being received.
        in_bytes: it takes the request unread.
        reads_bytes: it is given the bytes of the request.
    """

    perform: Callable[[FusionInterface, Any], Outcome | Message] | None
    cause: Cause = Cause.ILL_TYPED
    quick: bool = False
    reads_bytes: bool = False


CALLS: Mapping[str, Call] = MappingProxyType(
    {
        "AddProperty": Call(add_property, quick=True),
        "SetProperty": Call(set_property),
        "GetProperty": Call(get_property, quick=True),
        "ListProperties": Call(list_properties, quick=True),
        "SetCalibration": Call(set_calibration, Cause.BAD_CALIBRATION),
        "SendMotion": Call(send_motion, Cause.BAD_MOTION),
        "Send": Call(send, Cause.BAD_RECORD, reads_bytes=True),
        "SendStream": Call(None, Cause.BAD_RECORD),
        "Get": Call(None),
        "Subscribe": Call(None),
        "GetCounters": Call(get_counters, quick=True),
        "Flush": Call(flush),
        "CloseSession": Call(None),
    }
)
"""By the names of the `.proto`."""


@dataclass(frozen=True, slots=True)
class Method:
    """A method of the service as the `.proto` describes it, and what it does.

    Attributes:
        name: of the method.
        request_type: class of what is asked.
        reply_type: class of what is answered.
        call: what it does.
    """

    name: str
    request_type: type[Any]
    reply_type: type[Any]
    call: Call

    @property
    def answers_status(self) -> bool:
        """Whether it says 1 or 0, as clauses 5.3.3, 5.4.3 and 5.6.3 do."""
        return self.reply_type is fusion_pb2.Status

    def session_of(self, request: bytes) -> str:
        """The session that a request names, "" for none; the rest of a large one is not read.

        Raises:
            DataError: the bytes are no request.
        """
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
        """Read a request.

        Raises:
            DataError: the bytes are none.
        """
        return parse_message(self.request_type, request)

    def perform(self, fusion: FusionInterface, request: bytes) -> bytes:
        """Read a request, do it, and give the bytes of the answer.

        Raises:
            CallError: it cannot be answered.
        """
        if self.call.perform is None:
            raise TypeError(f"{self.name} is not one step")
        try:
            answer = self.call.perform(fusion, request if self.call.reads_bytes else self.parse(request))
        except CallError:
            raise
        except SceneloomError as error:
            raise self.fault(error) from error
        return status_bytes(answer) if isinstance(answer, Outcome) else answer.SerializeToString()

    def fault(self, reason: object) -> CallError:
        """What a request that is none ends with."""
        return CallError(grpc.StatusCode.INVALID_ARGUMENT, self.call.cause, str(reason))


METHODS: Mapping[str, Method] = MappingProxyType(
    {
        method.name: Method(
            method.name,
            GetMessageClass(method.input_type),
            GetMessageClass(method.output_type),
            CALLS[method.name],
        )
        for method in SERVICE.methods
    }
)
"""All methods of the `.proto`, by name."""
