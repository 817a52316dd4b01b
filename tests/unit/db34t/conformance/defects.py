"""Servers with one thing wrong each: what comes in or goes out of a sound one is changed on its way."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorProto

from sceneloom.db34t.conformance.catalogue import CallFailedError
from sceneloom.db34t.transport import SERVICE
from sceneloom.db34t.wire import fusion_pb2


@dataclass
class Broken:
    """A server that does one thing wrong.

    Attributes:
        inner: a sound server.
        incoming: changes requests; gets this object, the method and the request, and gives the request.
        outgoing: changes answers; gets this object, the method, the request and the answer, and gives the answer.
        notes: what it remembers.
    """

    inner: Any
    incoming: Callable[..., Any] | None = None
    outgoing: Callable[..., Any] | None = None
    notes: dict[Any, Any] = field(default_factory=dict)

    def call(self, method, request):
        # the kit keeps its requests; what is broken here must not reach it
        changed = type(request).FromString(request.SerializeToString())
        if self.incoming is not None:
            changed = self.incoming(self, method, changed)
        reply = self.inner.call(method, changed)
        return reply if self.outgoing is None else self.outgoing(self, method, request, reply)

    def send_stream(self, requests):
        summary = fusion_pb2.SendSummary()
        for number, request in enumerate(requests):
            status = self.call("Send", request)
            summary.accepted += status.status != 0
            summary.refused += status.status == 0
            if status.status == 0:
                summary.refusals.add(number=number, status=status)
        return summary

    def subscribe(self, request):
        for _ in range(request.most):
            get = fusion_pb2.GetRequest(session=request.session, wait_ms=1000)
            if request.HasField("fusion_type"):
                get.fusion_type = request.fusion_type
            yield self.call("Get", get)

    def health(self, service):
        return self.inner.health(service)

    def services(self):
        return self.inner.services()

    def files_with(self, symbol):
        return self.inner.files_with(symbol)


def records(reply):
    """The messages in a reply of Get that have a timestamp of their own."""
    if reply.HasField("sensor_data"):
        return [reply.sensor_data]
    return [reply.detections, *reply.detections.detections] if reply.HasField("detections") else []


# what comes in


def wrapping_values(_, method, request):
    """Whole numbers are cut to 32 bits where they are set."""
    if method == "SetProperty" and request.value.WhichOneof("kind") == "integer_value":
        number = request.value.integer_value
        if not -(2**31) <= number < 2**32:
            request.value.integer_value = number % 2**32
    return request


def matrix_by_rows(_, method, request):
    """The first three rows of four numbers are taken for rotation and translation, in whatever layout they come."""
    if method == "SetCalibration" and len(request.calibration.extrinsic_matrix) == 16:
        request.calibration.extrinsic_matrix[12:] = [0.0, 0.0, 0.0, 1.0]
    return request


def reference_frame_ignored(_, method, request):
    """The matrix is always taken for one into the camera's frame."""
    if method == "SetCalibration" and request.calibration.reference_frame == 1:
        request.calibration.reference_frame = 0
    return request


def colours_swapped(_, method, request):
    """Red and blue change locations."""
    if method == "Send" and request.WhichOneof("data") == "image" and request.image.encoding == "rgb8":
        pixels = np.frombuffer(request.image.data, np.uint8)
        if pixels.size % 3 == 0:
            request.image.data = pixels.reshape(-1, 3)[:, ::-1].tobytes()
    return request


def blue_taken_for_red(_, method, request):
    """Images are taken to have red first, whatever they state."""
    if method == "Send" and request.WhichOneof("data") == "image" and request.image.encoding == "bgr8":
        request.image.encoding = "rgb8"
    return request


def negative_seq(_, method, request):
    """Numbers are kept as if they had a sign: those from 2^31 on are refused."""
    if method == "Send":
        record = getattr(request, request.WhichOneof("data") or "image")
        if hasattr(record, "seq") and record.seq >= 2**31:
            return fusion_pb2.SendRequest(session=request.session)
    return request


def chirality_ignored(_, method, request):
    """Frames are right-handed, whatever is declared."""
    if method == "SetProperty" and request.name == "chirality" and request.value.integer_value == 1:
        request.value.integer_value = 0
    return request


def distortion_ignored(_, method, request):
    """Camera models are taken to have no distortion."""
    if method == "SetCalibration" and len(request.calibration.distortion_coeffs) == 5:
        request.calibration.distortion_coeffs[:] = [0.0] * 5
    return request


def tangential_swapped(_, method, request):
    """p1 and p2 change locations."""
    coefficients = request.calibration.distortion_coeffs if method == "SetCalibration" else ()
    if len(coefficients) == 5:
        coefficients[2], coefficients[3] = coefficients[3], coefficients[2]
    return request


def first_calibration_kept(broken, method, request):
    """A calibration cannot be replaced."""
    if method == "SetCalibration":
        key = request.session, request.camera_id, request.lidar_id
        first = broken.notes.setdefault(key, request.calibration)
        request.calibration.CopyFrom(first)
    return request


def one_session(_, method, request):
    """All sessions are one, but for ending it."""
    if method == "SetProperty" and request.name == "camera_frequency":
        request.session = "everybody"
    if method == "GetProperty" and request.name == "camera_frequency":
        request.session = "everybody"
    return request


def motion_ignored(_, method, request):
    """The vehicle stands, whatever is reported."""
    if method == "SendMotion":
        for pose in request.poses:
            pose.position[:] = [0.0, 0.0, 0.0]
    return request


def late_refused(broken, method, request):
    """What is older than something that came before is refused."""
    if method == "Send" and request.WhichOneof("data") == "image":
        timestamp = request.image.timestamp
        newest = broken.notes.get(request.session, (0, 0))
        broken.notes[request.session] = max(newest, (timestamp.s, timestamp.ns))
        if (timestamp.s, timestamp.ns) < newest:
            return fusion_pb2.SendRequest(session=request.session)
    return request


def bare_boxes_refused(_, method, request):
    """Boxes are taken in lists only."""
    if method == "Send" and request.WhichOneof("data") in ("box_3d", "box_2d"):
        return fusion_pb2.SendRequest(session=request.session)
    return request


def lengths_halved(_, method, request):
    """Lengths of boxes are taken for twice what is meant."""
    if method == "Send" and request.WhichOneof("data") == "boxes_3d":
        for box in request.boxes_3d.boxes:
            box.length /= 2
    return request


def whole_cloud_refused(_, method, request):
    """A cloud with one number that is not finite is refused."""
    if method == "Send" and request.WhichOneof("data") == "points":
        content = request.points.data
        if len(content) % 4 == 0 and not np.isfinite(np.frombuffer(content, "<f4")).all():
            return fusion_pb2.SendRequest(session=request.session)
    return request


def flat_boxes_taken(_, method, request):
    """Boxes without a width are taken for a pixel wide."""
    if method == "Send" and request.WhichOneof("data") == "boxes_2d":
        for box in request.boxes_2d.boxes:
            box.x2 += box.x1 == box.x2
    return request


def vertical_taken_for_forward(_, method, request):
    """Boxes that head straight up are taken to head forward."""
    if method == "Send" and request.WhichOneof("data") == "boxes_3d":
        for box in request.boxes_3d.boxes:
            if len(box.direction) == 3 and not any(box.direction[:2]) and box.direction[2]:
                box.direction[:] = [1.0, 0.0, 0.0]
    return request


# what goes out


def always_rgb8(_, method, request, reply):
    """Images are reported to be rgb8, whatever they are."""
    if method == "Get" and reply.HasField("sensor_data"):
        reply.sensor_data.encoding = "rgb8"
    return reply


def layout_by_values(_, method, request, reply):
    """Colours come before what else was sent of a point where that is whole numbers."""
    record = reply.sensor_data if method == "Get" else None
    if record is not None and len(record.point_fields) > 6:
        names = list(record.point_fields)
        rows = np.frombuffer(record.point_data, "<f4").reshape(-1, len(names))
        if np.array_equal(rows[:, 3], np.rint(rows[:, 3])):
            record.point_fields[:] = [*names[:3], *names[-3:], *names[3:-3]]
            order = [names.index(name) for name in record.point_fields]
            record.point_data = np.ascontiguousarray(rows[:, order]).tobytes()
    return reply


def unseen_white(_, method, request, reply):
    """Points that the image does not show are white."""
    record = reply.sensor_data if method == "Get" else None
    if record is not None and record.point_data:
        rows = np.frombuffer(record.point_data, "<f4").reshape(-1, len(record.point_fields)).copy()
        rows[(rows[:, -3:] == 128).all(axis=1), -3:] = 255
        record.point_data = rows.tobytes()
    return reply


def outlines_at_the_border(_, method, request, reply):
    """Outlines of what is not in the image are somewhere at its border."""
    if method == "Get" and reply.HasField("detections"):
        for found in reply.detections.detections:
            if found.x2 == 0:
                found.x1 = found.x2 = 64
    return reply


def status_two(_, method, request, reply):
    """What is done is reported with 2."""
    if (
        isinstance(reply, fusion_pb2.Status)
        and reply.status == 1
        and method not in ("CloseSession", "SendMotion", "Flush")
    ):
        reply.status = 2
    return reply


def always_done(_, method, request, reply):
    """What is refused is reported as done."""
    if isinstance(reply, fusion_pb2.Status) and method == "AddProperty":
        reply.Clear()
        reply.status = 1
    return reply


def float_seconds(_, method, request, reply):
    """Times go through seconds in a float of 64 bits."""
    if method == "Get":
        for record in records(reply):
            seconds = record.timestamp.s + record.timestamp.ns * 1e-9
            record.timestamp.s = int(seconds)
            record.timestamp.ns = round((seconds - int(seconds)) * 1e9)
    return reply


def float_seq(_, method, request, reply):
    """Numbers of sweeps go through a float of 32 bits."""
    if method == "Get":
        for record in records(reply):
            if hasattr(record, "points_seq"):
                record.points_seq = min(int(np.float32(record.points_seq)), 2**32 - 1)
    return reply


def newest_first(broken, method, request, reply):
    """The newest result comes first."""
    if method != "Get":
        return reply
    key = request.session, request.fusion_type if request.HasField("fusion_type") else None
    kept = broken.notes.setdefault(key, [])
    while reply.WhichOneof("result") != "no_data":
        kept.append(reply)
        again = fusion_pb2.GetRequest()
        again.CopyFrom(request)
        again.wait_ms = 0
        reply = broken.inner.call("Get", again)
    return kept.pop() if kept else reply


def result_again(broken, method, request, reply):
    """The last result is given again where there is none."""
    if method != "Get":
        return reply
    key = request.session, request.fusion_type
    if reply.WhichOneof("result") == "no_data":
        return broken.notes.get(key, reply)
    broken.notes[key] = reply
    return reply


def no_data_is_an_error(_, method, request, reply):
    """Where there is no result the call fails."""
    if method == "Get" and reply.WhichOneof("result") == "no_data":
        raise CallFailedError("NOT_FOUND", "no result")
    return reply


def missing_field(_, method, request, reply):
    """image_seq of table 9 is left out."""
    if method == "Get" and reply.HasField("sensor_data"):
        reply.sensor_data.ClearField("image_seq")
    return reply


def class_lost(_, method, request, reply):
    """Detections have no class."""
    if method == "Get" and reply.HasField("detections"):
        for found in reply.detections.detections:
            setattr(found, "class", "")
    return reply


def covariance_by_halves(_, method, request, reply):
    """Of covariances only the upper half is filled."""
    if method == "Get" and reply.HasField("detections"):
        for found in reply.detections.detections:
            square = np.triu(np.reshape(found.center_cov, (3, 3)) + 0.01)
            found.center_cov[:] = square.reshape(-1).tolist()
    return reply


def speed_without_sign(_, method, request, reply):
    """Speeds lose their sign."""
    if method == "Get" and reply.HasField("detections"):
        for found in reply.detections.detections:
            found.velocity = abs(found.velocity)
    return reply


def depth_by_columns(_, method, request, reply):
    """The depth image is written column after column."""
    if method == "Get" and reply.HasField("sensor_data"):
        record = reply.sensor_data
        image = np.frombuffer(record.image_depth, "<f4").reshape(record.height, record.width)
        record.image_depth = image.T.tobytes()
    return reply


def no_reasons(_, method, request, reply):
    """What is refused is refused without a word."""
    if isinstance(reply, fusion_pb2.Status):
        reply.reason = reply.cause = ""
    return reply


class UnknownIsEmpty(Broken):
    """A property that is not there is an empty one."""

    def call(self, method, request):
        try:
            return super().call(method, request)
        except CallFailedError:
            if method != "GetProperty":
                raise
            return fusion_pb2.Property(name=request.name)


class RangesForDepths(Broken):
    """Depth images hold distances along the rays, and the records state that they do not."""

    def call(self, method, request):
        if method == "Send" and request.session not in self.notes:
            self.notes[request.session] = "stated"
            kind = fusion_pb2.Value(string_value="range")
            self.inner.call(
                "SetProperty",
                fusion_pb2.SetPropertyRequest(name="depth_kind", value=kind, session=request.session),
            )
        reply = super().call(method, request)
        if method == "Get" and reply.HasField("sensor_data"):
            reply.sensor_data.depth_kind = "z"
        return reply


class NeverWell(Broken):
    """The service is there, and its health says that it is not."""

    def health(self, service):
        return "NOT_SERVING" if super().health(service) and service else "SERVING"


class WellWithoutName(Broken):
    """Health is known of all together and of no service."""

    def health(self, service):
        if service:
            raise CallFailedError("NOT_FOUND", service)
        return super().health(service)


class AnythingIsWell(Broken):
    """Health is SERVING of services that there are not."""

    def health(self, service):
        return "SERVING"


class Unlisted(Broken):
    """Reflection lists others than the service."""

    def services(self):
        return super().services() - {SERVICE.full_name}


class NoReflection(Broken):
    """Nobody answers questions of reflection."""

    def services(self):
        raise CallFailedError("UNIMPLEMENTED", "reflection")

    def files_with(self, symbol):
        raise CallFailedError("UNIMPLEMENTED", "reflection")


class AnotherProto(Broken):
    """Reflection describes a service whose fields have other numbers."""

    def files_with(self, symbol):
        (content,) = super().files_with(symbol)
        file = FileDescriptorProto.FromString(content)
        next(m for m in file.message_type if m.name == "ImageData").field[3].number = 99
        return [file.SerializeToString()]


def points_reversed(_, method, request, reply):
    """The numbers of each point come in the opposite order of their names."""
    if method == "Get" and reply.HasField("sensor_data"):
        record = reply.sensor_data
        rows = np.frombuffer(record.point_data, "<f4").reshape(-1, len(record.point_fields))
        record.point_data = rows[:, ::-1].tobytes()
    return reply


def directions_rotated(_, method, request, reply):
    """Directions come in the frame of the camera."""
    if method == "Get" and reply.HasField("detections"):
        for found in reply.detections.detections:
            x, y, z = found.direction
            found.direction[:] = [-y, -z, x]
    return reply


def time_of_the_image(_, method, request, reply):
    """Results bear the time of the image."""
    if method == "Get" and reply.HasField("sensor_data"):
        reply.sensor_data.timestamp.CopyFrom(reply.sensor_data.image_timestamp)
    return reply


INCOMING = {
    wrapping_values: "T1-4 T1-5",
    reference_frame_ignored: "T3-4",
    blue_taken_for_red: "6.3-1 6.7-2",
    colours_swapped: "T9-11 4.1-3 6.7-1",
    whole_cloud_refused: "6.4-2",
    flat_boxes_taken: "T8-8",
    vertical_taken_for_forward: "6.5-1",
    negative_seq: "5.6-8 T4-3 T5-3 T6-3",
    chirality_ignored: "T2-2 5.2-1",
    distortion_ignored: "T3-2",
    tangential_swapped: "T3-2",
    first_calibration_kept: "4.1-2",
    one_session: "X-2 X-3",
    motion_ignored: "X-15",
    late_refused: "5.6-10",
    bare_boxes_refused: "5.6-6",
    lengths_halved: "T10-9",
    matrix_by_rows: "T3-2 T3-3 T3-4 T3-5 4.1-1 4.1-2 4.1-3 5.2-1 5.2-2 5.2-3 6.3-1 6.7-1 "
    "T9-12 T10-16 T10-17 T10-18 X-10 X-11 X-15",
}
"""What is broken on the way in, and the checks that find it."""

OUTGOING = {
    status_two: "5.3-3 5.4-3 5.6-3",
    always_done: "5.3-2 5.3-3 X-1",
    float_seconds: "T9-1 T10-3 X-14",
    float_seq: "5.6-8",
    newest_first: "5.6-8 5.6-10 5.7-3 X-6",
    result_again: "5.7-4",
    no_data_is_an_error: "5.7-4 5.7-5 X-2 X-5",
    missing_field: "5.6-8 5.6-9 5.6-10 5.6-12 T9-3",
    class_lost: "T10-4",
    covariance_by_halves: "T10-8",
    speed_without_sign: "T10-14",
    depth_by_columns: "T3-2 T3-3 T3-4 T3-5 4.1-1 4.1-2 5.2-1 5.2-2 5.2-3 T9-12 X-10 X-15 X-20",
    no_reasons: "X-1",
    points_reversed: "5.2-1 5.2-2 5.2-3 6.3-1 6.4-2 6.7-1 6.7-3 T9-16 4.1-3 X-11",
    always_rgb8: "6.7-2",
    layout_by_values: "6.7-1",
    unseen_white: "6.7-3",
    outlines_at_the_border: "6.8-1",
    directions_rotated: "5.2-1 5.2-2 5.2-3 T10-13",
    time_of_the_image: "T9-1",
}
"""What is broken on the way out, and the checks that find it."""

WHOLE = {
    UnknownIsEmpty: "5.5-2",
    RangesForDepths: "T9-12 X-10",
    NeverWell: "X-21",
    WellWithoutName: "X-21",
    AnythingIsWell: "X-21",
    Unlisted: "X-22",
    NoReflection: "X-22 X-23",
    AnotherProto: "X-23",
}
"""Servers that are broken in another way, and the checks that find it."""


def broken_servers():
    """Every broken server's name, how it is made of a sound one, and the checks that find it."""
    for change, ids in INCOMING.items():
        yield change.__name__, lambda inner, change=change: Broken(inner, incoming=change), ids.split()
    for change, ids in OUTGOING.items():
        yield change.__name__, lambda inner, change=change: Broken(inner, outgoing=change), ids.split()
    for kind, ids in WHOLE.items():
        yield kind.__name__, kind, ids.split()
