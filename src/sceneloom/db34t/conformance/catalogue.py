"""What a conformance check is: a numbered statement of the standard, and a function that asks a server.

The sessions that checks work with, what they observe, and how they are declared.
"""

import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from importlib.resources import files
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from google.protobuf.message import Message

from sceneloom.db34t.conformance import scene
from sceneloom.db34t.tables import TABLES
from sceneloom.db34t.transport import SERVICE
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import SceneloomError


class _Quote(NamedTuple):
    """What stands at one location."""

    english: str
    chinese: str


QUOTES: Mapping[str, Mapping[str, Any]] = tomllib.loads(files(__package__).joinpath("quotes.toml").read_text("utf-8"))
"""`clauses`, and rows of `table_1` and `table_2`, by name: English and Chinese."""

_Made = TypeVar("_Made")

_WAIT_MS = 5_000  # how long a result may take

SENSOR_DATA, DETECTIONS = 0, 1
"""Fusion types, table 2, row 1."""

RESULT_NAMES = ("sensor_data", "detections")
"""What a reply calls the result of each fusion type."""

_INPUTS = {method.name: getattr(fusion_pb2, method.input_type.name) for method in SERVICE.methods}


class CallFailedError(SceneloomError):
    """A call ended with an error instead of an answer.

    Attributes:
        code: as gRPC calls it, such as NOT_FOUND.
        details: what the server says of it.
    """

    def __init__(self, code: str, details: str) -> None:
        super().__init__(code, details)
        self.code, self.details = code, details

    def __str__(self) -> str:
        return f"error {self.code}: {self.details}"


class Transport(Protocol):
    """Carries calls to a server and answers back; errors are `CallFailedError`."""

    def call(self, method: str, request: Message) -> Any:
        """Call a method that takes one message and gives one."""
        ...

    def send_stream(self, requests: Iterable[Message]) -> Any:
        """Call SendStream."""
        ...

    def subscribe(self, request: Message) -> Iterator[Any]:
        """Call Subscribe."""
        ...

    def health(self, service: str) -> str:
        """Ask the health service how a service is, by its full name, or "" for all: SERVING and so on."""
        ...

    def services(self) -> set[str]:
        """Ask by reflection for the full names of the services."""
        ...

    def files_with(self, symbol: str) -> list[bytes]:
        """Ask by reflection for the descriptors of the file that describes a symbol, perhaps with its imports."""
        ...


class _NoResultError(Exception):
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
        return int(self.call("SetProperty", name=name, value=_value_message(value)).status)

    def get(self, name: str) -> Any:
        """Clause 5.5; the message."""
        return self.call("GetProperty", name=name)

    def value(self, name: str) -> Any:
        """Clause 5.5; the value."""
        return _plain_value(self.get(name).value)

    def calibrate(self, *, camera_id: int = scene.CAMERA_ID, lidar_id: int = scene.LIDAR_ID, **changed: Any) -> int:
        """Send a calibration, that of the scene but for what is stated; the status."""
        calibration = scene.calibration(**changed)
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

    def fetch(self, fusion_type: int | None, *, wait_ms: int = _WAIT_MS) -> Any:
        """Clause 5.7; the reply."""
        return self.call("Get", fusion_type=fusion_type, wait_ms=wait_ms)

    def result(self, fusion_type: int) -> Any:
        """Clause 5.7; the record or records of the next result, which has to be there."""
        return _result_of(self.fetch(fusion_type), fusion_type)

    def fused(self, *requests: fusion_pb2.SendRequest, fusion_type: int = SENSOR_DATA) -> Any:
        """Send records one after the other, and give the record or records of the next result."""
        for request in requests:
            self.send(request)
        return self.result(fusion_type)

    def detected(self, *requests: fusion_pb2.SendRequest) -> Any:
        """The same of boxes and the records of table 10."""
        return self.fused(*requests, fusion_type=DETECTIONS)

    def subscribe(self, fusion_type: int, most: int) -> list[Any]:
        """Clause 5.7 as a stream; the records of so many replies."""
        request = fusion_pb2.SubscribeRequest(fusion_type=fusion_type, most=most, session=self.session)
        return [_result_of(reply, fusion_type) for reply in self.transport.subscribe(request)]

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

    def ready(self, **changed: Any) -> Peer:
        """A session that has the scene's calibration, but for what is stated."""
        peer = self.peer()
        peer.calibrate(**changed)
        return peer

    def once(self, make: Callable[[Peer], _Made]) -> _Made:
        """Give what a function makes in a calibrated session, made by the first check that asks."""
        if make not in self._kept:
            self._kept[make] = make(self.ready())
        kept: _Made = self._kept[make]
        return kept

    def end_sessions(self) -> None:
        """End the sessions that the last check had."""
        while self._open:
            self._open.pop().close()


def fused_pair(peer: Peer) -> Any:
    """The record of table 9 of the scene."""
    return peer.fused(scene.image(), scene.cloud())


def fused_boxes(peer: Peer) -> Any:
    """The records of table 10 of the scene."""
    return peer.detected(scene.boxes_2d(), scene.boxes_3d())


def send_pairs(peer: Peer, numbers: range) -> None:
    """Send pairs of an image and a sweep, a period apart."""
    for k in numbers:
        peer.send(scene.image(k, k * scene.PERIOD_NS + scene.IMAGE_LATER_NS))
        peer.send(scene.cloud(k, k * scene.PERIOD_NS))


def depths(record: Any) -> np.ndarray[Any, np.dtype[np.float32]]:
    """The depth image of a record of table 9, (H, W)."""
    return np.frombuffer(record.image_depth, "<f4").reshape(record.height, record.width)


def filled(record: Any) -> list[tuple[int, int]]:
    """Column and row of the pixels that have a depth."""
    rows, columns = np.nonzero(depths(record))
    return sorted(zip(columns.tolist(), rows.tolist(), strict=True))


def columns_of(record: Any, names: tuple[str, ...]) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Some fields of the points of a record of table 9, (N, F)."""
    fields = list(record.point_fields)
    rows = np.frombuffer(record.point_data, "<f4").reshape(-1, len(fields))
    return rows[:, [fields.index(name) for name in names]]


def _result_of(reply: Any, fusion_type: int) -> Any:
    """The record or records that a reply holds."""
    name = RESULT_NAMES[fusion_type]
    held = reply.WhichOneof("result")
    if held != name:
        raise _NoResultError(f"a reply with {held or 'nothing'}; expected {name}")
    return getattr(reply, name)


def detection_of(result: Any, box: scene.SentBox) -> Any:
    """The fused detection that stands where a box was sent; there has to be one."""
    for found in result.detections:
        if max(abs(a - b) for a, b in zip((found.X, found.Y, found.Z), box.center, strict=True)) < 1.0:
            return found
    raise _NoResultError(f"no detection near {box.center}, where a {box.name} was sent")


_VALUE_FIELDS = {bool: "bool_value", int: "integer_value", float: "number_value", str: "string_value"}


def _value_message(value: Any) -> fusion_pb2.Value:
    """The message of a value."""
    if type(value) in _VALUE_FIELDS:
        return fusion_pb2.Value(**{_VALUE_FIELDS[type(value)]: value})
    return fusion_pb2.Value(list_value=fusion_pb2.ValueList(values=map(_value_message, value)))


def _plain_value(message: Any) -> Any:
    """The value of a message; None where it holds none, truth values as 0 and 1."""
    kind = message.WhichOneof("kind")
    if kind is None:
        return None
    if kind == "list_value":
        return [_plain_value(item) for item in message.list_value.values]
    value = getattr(message, kind)
    return int(value) if kind == "bool_value" else value


def reported(message: Message) -> str:
    """A message in one line."""
    return " ".join(str(message).split())


class Basis(StrEnum):
    """What a check rests on."""

    TEXT = "text"
    """The words of the standard."""
    READING = "reading"
    """Our reading of a location that the standard leaves open; docs/db34t-4101.md says which."""
    EXTENSION = "extension"
    """The service's own calls and fields, which the standard does not have."""


@dataclass(frozen=True, slots=True)
class Seen:
    """One thing that a check looked at.

    Attributes:
        sent: what was sent.
        expected: what the answer has to be.
        found: what it was.
        agrees: whether it is as expected.
    """

    sent: str
    expected: str
    found: str
    agrees: bool


Look = Callable[["Bench"], Iterator[Seen]]
"""What a check does: talks to the server, and reports one thing after the other."""


@dataclass(frozen=True, slots=True)
class Check:
    """One numbered check.

    Attributes:
        id: clause and number ("5.4-3"), table and row ("T6-7"), or an extension's number ("X-2").
        location: of the standard, in words.
        title: what has to be so.
        basis: what it rests on.
        quote: what stands there, in English and Chinese.
        look: finds out.
    """

    id: str
    location: str
    title: str
    basis: Basis
    quote: _Quote
    look: Look

    def seen(self, bench: Bench) -> Iterator[Seen]:
        """Look, whatever the server answers; an answer that cannot be read is the last thing seen."""
        sent = "what the check begins with"
        try:
            for each in self.look(bench):
                sent = f"what comes after: {each.sent}"
                yield each
        except (CallFailedError, _NoResultError) as error:
            yield Seen(sent, "an answer", str(error), agrees=False)
        except Exception as error:  # noqa: BLE001 - whatever a server answers, the other checks go on
            found = f"an answer that cannot be read: {type(error).__name__}: {error}"
            yield Seen(sent, "an answer", found, agrees=False)
        finally:
            bench.end_sessions()


_Declare = Callable[[Look], Look]


class Catalogue:
    """Declares the checks of some parts of the standard; each method is a decorator of what looks.

    Attributes:
        checks: in the order in which they were declared.
    """

    def __init__(self) -> None:
        """Declare nothing yet."""
        self.checks: list[Check] = []

    def clause(self, number: str, of: str, title: str, *, reading: bool = False) -> _Declare:
        """Declare what looks whether a clause is kept; `reading` where the clause leaves it open."""
        basis = Basis.READING if reading else Basis.TEXT
        return self._declare(number, f"clause {of}", title, basis, _Quote(*QUOTES["clauses"][of]))

    def row(self, table: int, name: str, title: str, *, reading: bool = False) -> _Declare:
        """Declare what looks at a row of a table."""
        if table <= 2:
            quotes = QUOTES[f"table_{table}"]
            number, quote = list(quotes).index(name) + 1, _Quote(*quotes[name])
        else:
            row = TABLES[table].row(name)
            unit = f" [{row.unit}]" if row.unit else ""
            number, quote = row.number, _Quote(f"{name}: {row.type}{unit}: {row.meaning}", row.quote)
        location, basis = f"table {table}, row {number} ({name})", Basis.READING if reading else Basis.TEXT
        return self._declare(f"T{table}-{number}", location, title, basis, quote)

    def extension(self, number: int, location: str, title: str) -> _Declare:
        """Declare what looks at something that the standard does not have."""
        quote = _Quote("not in the standard", "本文件未规定")
        return self._declare(f"X-{number}", location, title, Basis.EXTENSION, quote)

    def _declare(self, number: str, location: str, title: str, basis: Basis, quote: _Quote) -> _Declare:
        def declared(look: Look) -> Look:
            self.checks.append(Check(number, location, title, basis, quote, look))
            return look

        return declared


def same(sent: str, expected: Any, found: Any) -> Seen:
    """See whether two values are equal."""
    return Seen(sent, _short(expected), _short(found), bool(expected == found))


def true(sent: str, expected: str, found: Any, *, agrees: bool) -> Seen:
    """See whether something holds that is stated in words."""
    return Seen(sent, expected, _short(found), agrees)


def taken(sent: str, status: int) -> Seen:
    """See whether a record or a calibration was taken."""
    return same(sent, "taken", "taken" if status else "refused")


def refused(sent: str, status: int) -> Seen:
    """See whether something was refused."""
    return same(sent, "status 0", f"status {status}")


def added(sent: str, status: int) -> Seen:
    """See whether a property was added."""
    return true(sent, "added", f"status {status}", agrees=status != 0)


def near(sent: str, expected: float, found: float, tolerance: float) -> Seen:
    """See whether a number is as near to another as it has to be."""
    agrees = abs(found - expected) <= tolerance
    return Seen(sent, f"{expected:.6g} ± {tolerance:g}", f"{found:.6g}", agrees)


def _short(value: Any) -> str:
    """A value in a report, cut where it is long."""
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= 200 else f"{text[:197]}…"
