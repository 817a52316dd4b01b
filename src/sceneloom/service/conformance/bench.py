"""What checks work with: sessions of the server under test, and the answers that several checks look at."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

from google.protobuf.message import Message

from sceneloom.fusion.messages.wire import fusion_pb2
from sceneloom.service.conformance import scene
from sceneloom.service.conformance.transport import SERVICE, CallFailedError, Transport

Made = TypeVar("Made")

WAIT_MS = 5_000
"""How long a result may take."""

SENSOR_DATA, DETECTIONS = 0, 1
"""Fusion types, table 2, row 1."""

RESULT_NAMES = ("sensor_data", "detections")
"""What a reply calls the result of each fusion type."""

_INPUTS = {method.name: getattr(fusion_pb2, method.input_type.name) for method in SERVICE.methods}


class NoResultError(Exception):
    """A result that should have been there was not."""


class Peer:
    """One session of the server under test."""

    def __init__(self, transport: Transport, session: str) -> None:
        """Talk to a session by this name."""
        self.transport, self.session = transport, session

    def call(self, method: str, **fields: Any) -> Any:
        """Call a method that takes one message and gives one."""
        return self.transport.call(method, _INPUTS[method](session=self.session, **fields))

    def add(self, name: str, description: str, type: str) -> int:
        """Clause 5.3; the status."""
        return int(self.call("AddProperty", name=name, description=description, type=type).status)

    def set(self, name: str, value: Any) -> int:
        """Clause 5.4; the status."""
        return int(self.call("SetProperty", name=name, value=value_message(value)).status)

    def get(self, name: str) -> Any:
        """Clause 5.5; the message."""
        return self.call("GetProperty", name=name)

    def value(self, name: str) -> Any:
        """Clause 5.5; the value."""
        return plain_value(self.get(name).value)

    def calibrate(
        self, *, camera_id: int = scene.CAMERA_ID, lidar_id: int = scene.LIDAR_ID, **changed: Any
    ) -> int:
        """Send a calibration, that of the scene but for what is stated; the status."""
        return self.calibrate_with(scene.calibration(**changed), camera_id=camera_id, lidar_id=lidar_id)

    def calibrate_with(
        self,
        calibration: fusion_pb2.Calibration,
        *,
        camera_id: int = scene.CAMERA_ID,
        lidar_id: int = scene.LIDAR_ID,
    ) -> int:
        """Send a calibration; the status."""
        reply = self.call("SetCalibration", calibration=calibration, camera_id=camera_id, lidar_id=lidar_id)
        return int(reply.status)

    def send(self, request: fusion_pb2.SendRequest) -> int:
        """Clause 5.6; the status."""
        return int(self.send_for_status(request).status)

    def send_for_status(self, request: fusion_pb2.SendRequest) -> Any:
        """Clause 5.6; the message."""
        return self.transport.call("Send", self._owned(request))

    def send_stream(self, requests: Iterable[fusion_pb2.SendRequest]) -> Any:
        """Clause 5.6 for several records; the summary."""
        return self.transport.send_stream([self._owned(request) for request in requests])

    def fetch(self, fusion_type: int | None, *, wait_ms: int = WAIT_MS) -> Any:
        """Clause 5.7; the reply."""
        return self.call("Get", fusion_type=fusion_type, wait_ms=wait_ms)

    def result(self, fusion_type: int) -> Any:
        """Clause 5.7; the record or records of the next result.

        Raises:
            NoResultError: none came.
        """
        return result_of(self.fetch(fusion_type), fusion_type)

    def subscribe(self, fusion_type: int, most: int) -> Iterator[Any]:
        """Clause 5.7 as a stream of so many replies."""
        request = fusion_pb2.SubscribeRequest(fusion_type=fusion_type, most=most, session=self.session)
        return self.transport.subscribe(request)

    def close(self) -> None:
        """End the session, if the server knows how."""
        try:
            self.call("CloseSession")
        except CallFailedError:
            return

    def _owned(self, request: fusion_pb2.SendRequest) -> fusion_pb2.SendRequest:
        owned = fusion_pb2.SendRequest()
        owned.CopyFrom(request)
        owned.session = self.session
        return owned


class Bench:
    """Gives sessions to a check and ends them after it; keeps answers that several checks look at."""

    def __init__(self, transport: Transport, prefix: str) -> None:
        """Talk to a server in sessions whose names begin so."""
        self.transport = transport
        self._prefix, self._count = prefix, 0
        self._open: list[Peer] = []
        self._kept: dict[Callable[[Peer], Any], Any] = {}

    def peer(self) -> Peer:
        """A session that nothing was done in."""
        self._count += 1
        peer = Peer(self.transport, f"{self._prefix}-{self._count}")
        self._open.append(peer)
        return peer

    def ready(self) -> Peer:
        """A session that has the scene's calibration."""
        peer = self.peer()
        peer.calibrate()
        return peer

    def once(self, make: Callable[[Peer], Made]) -> Made:
        """Give what a function makes in a calibrated session, made by the first check that asks."""
        if make not in self._kept:
            self._kept[make] = make(self.ready())
        kept: Made = self._kept[make]
        return kept

    def end_sessions(self) -> None:
        """End the sessions that the last check had."""
        while self._open:
            self._open.pop().close()


def fused_pair(peer: Peer) -> Any:
    """The record of table 9 of the scene."""
    peer.send(scene.image())
    peer.send(scene.cloud())
    return peer.result(SENSOR_DATA)


def fused_boxes(peer: Peer) -> Any:
    """The records of table 10 of the scene."""
    peer.send(scene.boxes_2d())
    peer.send(scene.boxes_3d())
    return peer.result(DETECTIONS)


def result_of(reply: Any, fusion_type: int) -> Any:
    """The record or records that a reply holds.

    Raises:
        NoResultError: it holds others, or none.
    """
    name = RESULT_NAMES[fusion_type]
    held = reply.WhichOneof("result")
    if held != name:
        raise NoResultError(f"a reply with {held or 'nothing'}; expected {name}")
    return getattr(reply, name)


def detection_of(result: Any, box: scene.SentBox) -> Any:
    """The fused detection that stands where a box was sent.

    Raises:
        NoResultError: there is none.
    """
    for found in result.detections:
        if max(abs(a - b) for a, b in zip((found.X, found.Y, found.Z), box.center, strict=True)) < 1.0:
            return found
    raise NoResultError(f"no detection near {box.center}, where a {box.name} was sent")


def value_message(value: Any) -> fusion_pb2.Value:
    """The message of a value."""
    if isinstance(value, bool):
        return fusion_pb2.Value(bool_value=value)
    if isinstance(value, int):
        return fusion_pb2.Value(integer_value=value)
    if isinstance(value, float):
        return fusion_pb2.Value(number_value=value)
    if isinstance(value, str):
        return fusion_pb2.Value(string_value=value)
    return fusion_pb2.Value(list_value=fusion_pb2.ValueList(values=map(value_message, value)))


def plain_value(message: Any) -> Any:
    """The value of a message; None where it holds none, truth values as 0 and 1."""
    kind = message.WhichOneof("kind")
    if kind is None:
        return None
    if kind == "list_value":
        return [plain_value(item) for item in message.list_value.values]
    value = getattr(message, kind)
    return int(value) if kind == "bool_value" else value


def reported(message: Message) -> str:
    """A message in one line."""
    return " ".join(str(message).split())
