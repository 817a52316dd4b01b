"""Servers for the kit: a sound one in this process, and broken ones, where something is changed on its way."""

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorProto

from sceneloom.db34t.conformance.catalogue import CallFailedError
from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.protobuf import fill_message, property_to_protobuf
from sceneloom.db34t.records import kind_of
from sceneloom.db34t.transport import SERVICE
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import OptionError
from sceneloom.service.server import METHODS, CallError


def summary_of(statuses):
    """What SendStream replies where its requests have these statuses."""
    summary = fusion_pb2.SendSummary()
    for number, status in enumerate(statuses):
        if status.status:
            summary.accepted += 1
        else:
            summary.refused += 1
            summary.refusals.add(number=number, status=status)
    return summary


class HereTransport:
    """Calls the fusion interface of a session directly; each session fuses inline, so that nothing has to wait."""

    def __init__(self):
        self.sessions = defaultdict(lambda: FusionInterface(inline=True))

    def call(self, method, request):
        if method == "Get":
            return self.get(request)
        if method == "CloseSession":
            return fusion_pb2.Status(status=int(self.sessions.pop(request.session, None) is not None))
        entry = METHODS[method]
        try:
            answer = entry.perform(self.sessions[request.session], request.SerializeToString())
        except CallError as error:
            if not entry.answers_status:
                raise CallFailedError(error.code.name, error.reason) from error
            return fusion_pb2.Status(status=0, cause=str(error.cause), reason=error.reason)
        return entry.reply_type.FromString(answer)

    def get(self, request):
        fusion = self.sessions[request.session]
        wanted = request.fusion_type if request.HasField("fusion_type") else None
        try:
            result = fusion.get(wanted)
            if result is None and getattr(request, "wait_ms", 0):
                fusion.flush()  # what another sweep or image would set free comes when nothing does for a while
                result = fusion.get(wanted)
        except OptionError as error:
            raise CallFailedError("INVALID_ARGUMENT", str(error)) from error
        if result is None:
            return fusion_pb2.GetReply(no_data=fusion_pb2.NoData())
        properties = map(property_to_protobuf, result.configuration.properties.values())
        reply = fusion_pb2.GetReply(number=result.number, configuration=fusion_pb2.Properties(properties=properties))
        fill_message(getattr(reply, kind_of(result.record).name), result.record)
        return reply

    def send_stream(self, requests):
        return summary_of(self.call("Send", request) for request in requests)

    def subscribe(self, request):
        for _ in range(request.most):
            yield self.get(request)

    def health(self, service):
        if service not in ("", SERVICE.full_name):
            raise CallFailedError("NOT_FOUND", service)
        return "SERVING"

    def services(self):
        return {SERVICE.full_name, "grpc.health.v1.Health"}

    def files_with(self, symbol):
        if symbol != SERVICE.full_name:
            raise CallFailedError("NOT_FOUND", symbol)
        return [fusion_pb2.DESCRIPTOR.serialized_pb]


@dataclass
class Broken:
    """A sound server, `inner`, of which one thing is changed on its way.

    Attributes:
        incoming: gets this object, the method and the request, and gives the request.
        outgoing: gets this object, the method, the request and the answer, and gives the answer.
        instead: methods of health and reflection that are called with the sound server instead of its own.
        notes: what it remembers.
    """

    inner: Any
    incoming: Callable[..., Any] | None = None
    outgoing: Callable[..., Any] | None = None
    instead: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    notes: dict[Any, Any] = field(default_factory=dict)

    def __getattr__(self, name):
        return partial(self.instead[name], self.inner) if name in self.instead else getattr(self.inner, name)

    def call(self, method, request):
        # the kit keeps its requests; what is broken here must not reach it
        changed = type(request).FromString(request.SerializeToString())
        if self.incoming is not None:
            changed = self.incoming(self, method, changed)
        reply = self.inner.call(method, changed)
        return reply if self.outgoing is None else self.outgoing(self, method, request, reply)

    def send_stream(self, requests):
        return summary_of(self.call("Send", request) for request in requests)

    def subscribe(self, request):
        for _ in range(request.most):
            get = fusion_pb2.GetRequest(session=request.session, wait_ms=1000)
            if request.HasField("fusion_type"):
                get.fusion_type = request.fusion_type
            yield self.call("Get", get)


SERVERS = []  # every broken server's name, how it is made of a sound one, and the checks that find it


def broken(ids, where=None):
    """Declare a class of servers, or a change `where` it is one of `Broken`: incoming or outgoing."""

    def declared(change):
        make = change if where is None else lambda inner: Broken(inner, **{where: change})
        SERVERS.append((change.__name__, make, ids.split()))
        return change

    return declared


def incoming(ids, *kinds, method="Send", name=""):
    """Declare a change of requests: of Send with records of some kinds it gets the record, else the request.

    A record for which it gives "refuse" is taken out, so that the request is refused.
    """

    def declared(change):
        def changed(_, called, request):
            if called != method or (kinds and request.WhichOneof("data") not in kinds):
                return request
            found = change(getattr(request, request.WhichOneof("data"))) if kinds else change(request)
            return fusion_pb2.SendRequest(session=request.session) if found == "refuse" else request

        changed.__name__ = name or change.__name__
        broken(ids, "incoming")(changed)

    return declared


def outgoing(ids, name, change, held="sensor_data"):
    """Declare a change of results: it gets the record of table 9, or each one of table 10."""

    def changed(_, method, request, reply):
        if method == "Get" and reply.HasField(held):
            for record in [reply.sensor_data] if held == "sensor_data" else reply.detections.detections:
                change(record)
        return reply

    changed.__name__ = name
    broken(ids, "outgoing")(changed)


def fill(numbers, values):
    """Give a repeated field other values."""
    numbers[:] = values


def records(reply):
    """The messages in a reply of Get that have a timestamp of their own."""
    if reply.HasField("sensor_data"):
        return [reply.sensor_data]
    return [reply.detections, *reply.detections.detections] if reply.HasField("detections") else []


def rows_of(record):
    """The points of a record of table 9, (N, F)."""
    return np.frombuffer(record.point_data, "<f4").reshape(-1, len(record.point_fields))


@incoming("T1-4 T1-5", method="SetProperty")
def wrapping_values(request):
    """Whole numbers are cut to 32 bits where they are set."""
    number = request.value.integer_value
    if request.value.WhichOneof("kind") == "integer_value" and not -(2**31) <= number < 2**32:
        request.value.integer_value = number % 2**32


@incoming(
    "T3-2 T3-3 T3-4 T3-5 4.1-1 4.1-2 4.1-3 5.2-1 5.2-2 5.2-3 6.3-1 6.7-1 T9-12 T10-16 T10-17 T10-18 X-10 X-11 X-15",
    method="SetCalibration",
)
def matrix_by_rows(request):
    """The first three rows of four numbers are taken for rotation and translation, in whatever layout they come."""
    if len(request.calibration.extrinsic_matrix) == 16:
        request.calibration.extrinsic_matrix[12:] = [0.0, 0.0, 0.0, 1.0]


@incoming("T9-11 4.1-3 6.7-1", "image")
def colours_swapped(image):
    pixels = np.frombuffer(image.data, np.uint8)
    if image.encoding == "rgb8" and pixels.size % 3 == 0:
        image.data = pixels.reshape(-1, 3)[:, ::-1].tobytes()


_CALIBRATION, _PROPERTY = {"method": "SetCalibration"}, {"method": "SetProperty"}
_KINDS = ("raw", "image", "points", "boxes_3d", "boxes_2d")
incoming("T3-4", name="reference_frame_ignored", **_CALIBRATION)(
    lambda request: request.calibration.reference_frame == 1 and setattr(request.calibration, "reference_frame", 0)
)
incoming("T3-2", name="distortion_ignored", **_CALIBRATION)(
    lambda request: fill(request.calibration.distortion_coeffs, [0.0] * len(request.calibration.distortion_coeffs))
)
incoming("T2-2 5.2-1", name="chirality_ignored", **_PROPERTY)(
    lambda request: (
        (request.name, request.value.integer_value) == ("chirality", 1) and setattr(request.value, "integer_value", 0)
    )
)
incoming("6.3-1 6.7-2", "image", name="blue_taken_for_red")(  # images are taken to have red first, whatever they state
    lambda image: setattr(image, "encoding", image.encoding.replace("bgr8", "rgb8"))
)
incoming("5.6-8 T4-3 T5-3 T6-3", *_KINDS, name="negative_seq")(  # numbers are kept as if they had a sign
    lambda record: "refuse" if record.seq >= 2**31 else None
)
incoming("5.6-6", "box_3d", "box_2d", name="bare_boxes_refused")(lambda _: "refuse")


@incoming("T3-2", method="SetCalibration")
def tangential_swapped(request):
    coefficients = request.calibration.distortion_coeffs
    if len(coefficients) == 5:
        coefficients[2], coefficients[3] = coefficients[3], coefficients[2]


@broken("4.1-2", "incoming")
def first_calibration_kept(server, method, request):
    if method == "SetCalibration":
        key = request.session, request.camera_id, request.lidar_id
        request.calibration.CopyFrom(server.notes.setdefault(key, request.calibration))
    return request


@broken("X-2 X-3", "incoming")
def one_session(_, method, request):
    """All sessions are one, but for ending it."""
    if method in ("SetProperty", "GetProperty") and request.name == "camera_frequency":
        request.session = "everybody"
    return request


@incoming("X-15", method="SendMotion")
def motion_ignored(request):
    for pose in request.poses:
        pose.position[:] = [0.0, 0.0, 0.0]


@broken("5.6-10", "incoming")
def late_refused(server, method, request):
    """What is older than something that came before is refused."""
    if method == "Send" and request.WhichOneof("data") == "image":
        timestamp = request.image.timestamp.s, request.image.timestamp.ns
        newest = server.notes.get(request.session, (0, 0))
        server.notes[request.session] = max(newest, timestamp)
        if timestamp < newest:
            return fusion_pb2.SendRequest(session=request.session)
    return request


@incoming("T10-9", "boxes_3d")
def lengths_halved(boxes):
    for box in boxes.boxes:
        box.length /= 2


@incoming("6.4-2", "points")
def whole_cloud_refused(points):
    whole = len(points.data) % 4 == 0
    return "refuse" if whole and not np.isfinite(np.frombuffer(points.data, "<f4")).all() else None


@incoming("T8-8", "boxes_2d")
def flat_boxes_taken(boxes):
    for box in boxes.boxes:
        box.x2 += box.x1 == box.x2


@incoming("6.5-1", "boxes_3d")
def vertical_taken_for_forward(boxes):
    """Boxes that head straight up are taken to head forward."""
    for box in boxes.boxes:
        if len(box.direction) == 3 and not any(box.direction[:2]) and box.direction[2]:
            box.direction[:] = [1.0, 0.0, 0.0]


def layout_by_values(record):
    """Colours come before what else was sent of a point where that is whole numbers."""
    names, rows = list(record.point_fields), rows_of(record)
    if len(names) > 6 and np.array_equal(rows[:, 3], np.rint(rows[:, 3])):
        record.point_fields[:] = [*names[:3], *names[-3:], *names[3:-3]]
        order = [names.index(name) for name in record.point_fields]
        record.point_data = np.ascontiguousarray(rows[:, order]).tobytes()


def unseen_white(record):
    rows = rows_of(record).copy()
    rows[(rows[:, -3:] == 128).all(axis=1), -3:] = 255
    record.point_data = rows.tobytes()


def depth_by_columns(record):
    image = np.frombuffer(record.image_depth, "<f4").reshape(record.height, record.width)
    record.image_depth = image.T.tobytes()


SENSOR_DATA = (
    ("6.7-1", "layout_by_values", layout_by_values),
    ("6.7-2", "always_rgb8", lambda record: setattr(record, "encoding", "rgb8")),
    ("6.7-3", "unseen_white", unseen_white),
    ("T9-12 T3-2 T3-3 T3-4 T3-5 4.1-1 4.1-2 5.2-1 5.2-2 5.2-3 X-10 X-15 X-20", "depth_by_columns", depth_by_columns),
    ("5.6-8 5.6-9 5.6-10 5.6-12 T9-3", "missing_field", lambda record: record.ClearField("image_seq")),
    (
        *("5.2-1 5.2-2 5.2-3 6.3-1 6.4-2 6.7-1 6.7-3 T9-16 4.1-3 X-11", "points_reversed"),
        lambda record: setattr(record, "point_data", rows_of(record)[:, ::-1].tobytes()),
    ),
    ("T9-1", "time_of_the_image", lambda record: record.timestamp.CopyFrom(record.image_timestamp)),
)
DETECTIONS = (
    ("6.8-1", "outlines_at_the_border", lambda found: found.x2 or [setattr(found, name, 64) for name in ("x1", "x2")]),
    ("T10-4", "class_lost", lambda found: setattr(found, "class", "")),
    (
        *("T10-8", "covariance_by_halves"),
        lambda found: fill(found.center_cov, np.triu(np.reshape(found.center_cov, (3, 3)) + 0.01).reshape(-1).tolist()),
    ),
    ("T10-14", "speed_without_sign", lambda found: setattr(found, "velocity", abs(found.velocity))),
    (
        *("5.2-1 5.2-2 5.2-3 T10-13", "directions_of_the_camera"),
        lambda found: fill(found.direction, [-found.direction[1], -found.direction[2], found.direction[0]]),
    ),
)
for row in SENSOR_DATA:
    outgoing(*row)
for row in DETECTIONS:
    outgoing(*row, held="detections")


@broken("5.3-3 5.4-3 5.6-3", "outgoing")
def status_two(_, method, request, reply):
    of_standard = method not in ("CloseSession", "SendMotion", "Flush")
    if isinstance(reply, fusion_pb2.Status) and reply.status == 1 and of_standard:
        reply.status = 2
    return reply


@broken("5.3-2 5.3-3 X-1", "outgoing")
def always_done(_, method, request, reply):
    """What is refused is reported as done."""
    return fusion_pb2.Status(status=1) if method == "AddProperty" else reply


@broken("T9-1 T10-3 X-14", "outgoing")
def float_seconds(_, method, request, reply):
    for record in records(reply) if method == "Get" else ():
        seconds = record.timestamp.s + record.timestamp.ns * 1e-9
        record.timestamp.s = int(seconds)
        record.timestamp.ns = round((seconds - int(seconds)) * 1e9)
    return reply


@broken("5.6-8", "outgoing")
def float_seq(_, method, request, reply):
    """Numbers of sweeps go through a float of 32 bits."""
    for record in records(reply) if method == "Get" else ():
        if hasattr(record, "points_seq"):
            record.points_seq = min(int(np.float32(record.points_seq)), 2**32 - 1)
    return reply


@broken("5.6-8 5.6-10 5.7-3 X-6", "outgoing")
def newest_first(server, method, request, reply):
    if method != "Get":
        return reply
    key = request.session, request.fusion_type if request.HasField("fusion_type") else None
    kept = server.notes.setdefault(key, [])
    while reply.WhichOneof("result") != "no_data":
        kept.append(reply)
        again = fusion_pb2.GetRequest()
        again.CopyFrom(request)
        again.wait_ms = 0
        reply = server.inner.call("Get", again)
    return kept.pop() if kept else reply


@broken("5.7-4", "outgoing")
def result_again(server, method, request, reply):
    """The last result is given again where there is none."""
    if method != "Get":
        return reply
    key = request.session, request.fusion_type
    if reply.WhichOneof("result") == "no_data":
        return server.notes.get(key, reply)
    server.notes[key] = reply
    return reply


@broken("5.7-4 5.7-5 X-2 X-5", "outgoing")
def no_data_is_an_error(_, method, request, reply):
    """Where there is no result the call fails."""
    if method == "Get" and reply.WhichOneof("result") == "no_data":
        raise CallFailedError("NOT_FOUND", "no result")
    return reply


@broken("X-1", "outgoing")
def no_reasons(_, method, request, reply):
    if isinstance(reply, fusion_pb2.Status):
        reply.reason = reply.cause = ""
    return reply


@broken("5.5-2")
class UnknownIsEmpty(Broken):
    """A property that is not there is an empty one."""

    def call(self, method, request):
        try:
            return super().call(method, request)
        except CallFailedError:
            if method != "GetProperty":
                raise
            return fusion_pb2.Property(name=request.name)


@broken("T9-12 X-10")
class RangesForDepths(Broken):
    """Depth images hold distances along the rays, and the records state that they do not."""

    def call(self, method, request):
        if method == "Send" and request.session not in self.notes:
            self.notes[request.session] = "stated"
            kind = fusion_pb2.Value(string_value="range")
            stated = fusion_pb2.SetPropertyRequest(name="depth_kind", value=kind, session=request.session)
            self.inner.call("SetProperty", stated)
        reply = super().call(method, request)
        if method == "Get" and reply.HasField("sensor_data"):
            reply.sensor_data.depth_kind = "z"
        return reply


def missing(*_):
    raise CallFailedError("UNIMPLEMENTED", "reflection")


def another_proto(inner, symbol):
    """Reflection describes a service whose fields have other numbers."""
    (content,) = inner.files_with(symbol)
    file = FileDescriptorProto.FromString(content)
    next(m for m in file.message_type if m.name == "ImageData").field[3].number = 99
    return [file.SerializeToString()]


SURROUNDINGS = {
    "never_well": ("X-21", {"health": lambda inner, service: "NOT_SERVING" if service else "SERVING"}),
    "well_without_name": ("X-21", {"health": lambda inner, service: missing() if service else "SERVING"}),
    "anything_is_well": ("X-21", {"health": lambda inner, service: "SERVING"}),
    "unlisted": ("X-22", {"services": lambda inner: inner.services() - {SERVICE.full_name}}),
    "no_reflection": ("X-22 X-23", {"services": missing, "files_with": missing}),
    "another_proto": ("X-23", {"files_with": another_proto}),
}
for name, (ids, instead) in SURROUNDINGS.items():
    SERVERS.append((name, partial(Broken, instead=instead), ids.split()))
