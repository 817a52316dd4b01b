"""Checks of what the service adds to the standard: its own calls and fields, health and reflection.

A program that knows only the standard can leave them out.
"""

import json
from collections.abc import Iterator

import numpy as np
from google.protobuf.descriptor_pb2 import DescriptorProto, FileDescriptorProto

from sceneloom.db34t.conformance import scene
from sceneloom.db34t.conformance.catalogue import (
    QUOTES,
    SENSOR_DATA,
    Bench,
    CallFailedError,
    Catalogue,
    Seen,
    added,
    columns_of,
    depths,
    detection_of,
    filled,
    fused_boxes,
    fused_pair,
    near,
    refused,
    same,
    send_pairs,
    taken,
    true,
)
from sceneloom.db34t.transport import SERVICE
from sceneloom.db34t.wire import fusion_pb2

CHECKS = Catalogue()
_TABLE_2 = list(QUOTES["table_2"])


@CHECKS.extension(1, "Status, fields 100 and 101", "a 0 comes with a reason for people and a cause for programs")
def _reasons(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    replies = {
        "SetProperty of an unknown name": peer.call("SetProperty", name="conformance_unknown"),
        "AddProperty with the type 'text'": peer.call("AddProperty", name="a", type="text"),
        "Send before a calibration": peer.send_for_status(scene.cloud()),
    }
    for sent, reply in replies.items():
        found = (reply.reason, reply.cause)
        yield true(sent, "status 0 with reason and cause", found, agrees=reply.status == 0 and all(found))


@CHECKS.extension(2, "session", "sessions are separate: properties, calibrations, numbers and results")
def _sessions(bench: Bench) -> Iterator[Seen]:
    one, other = bench.ready(), bench.peer()
    one.set("camera_frequency", 20)
    one.add("of_one", "", "uint32")
    yield same("SetProperty in one session, GetProperty in another", 10, other.value("camera_frequency"))
    status = other.add("of_one", "", "uint32")
    yield added("AddProperty in one session, and in another", status)
    yield same("SetCalibration in one session, Send in another", 0, other.send(scene.cloud()))
    other.calibrate()
    send_pairs(one, range(1))
    held = other.fetch(SENSOR_DATA, wait_ms=0).WhichOneof("result")
    yield same("a pair in one session, Get in another", "no_data", held)
    yield taken("the same seq in another session", other.send(scene.cloud(0)))


@CHECKS.extension(3, "CloseSession", "a session that was ended begins anew under its name")
def _closed(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    peer.set("camera_frequency", 20)
    reply = peer.call("CloseSession")
    yield same("CloseSession", 1, reply.status)
    yield same("CloseSession, GetProperty camera_frequency", 10, peer.value("camera_frequency"))


@CHECKS.extension(4, "ListProperties", "all properties, those of table 2 first, and a number that counts the changes")
def _listed(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    peer.add("added", "by the kit", "uint32")
    first = peer.call("ListProperties")
    names = [found.name for found in first.properties]
    yield same("ListProperties: the first names", _TABLE_2, names[: len(_TABLE_2)])
    marks = {found.name: found.predefined for found in first.properties}
    yield same("AddProperty, ListProperties: predefined", (True, False), (marks["fusion_type"], marks.get("added")))
    peer.set("added", 3)
    second = peer.call("ListProperties").revision
    third = peer.call("ListProperties").revision
    more = f"more than {first.revision}"
    yield true("SetProperty, ListProperties: revision", more, second, agrees=second > first.revision)
    yield same("ListProperties again: revision", second, third)


@CHECKS.extension(5, "Get, wait_ms", "a get that waits for nothing comes back with no_data when its time is over")
def _waits(bench: Bench) -> Iterator[Seen]:
    found = bench.ready().fetch(SENSOR_DATA, wait_ms=50).WhichOneof("result")
    yield same("Get wait_ms 50 of nothing", "no_data", found)


@CHECKS.extension(6, "Subscribe", "a subscription gives results in order, as many as were asked for")
def _subscribed(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    send_pairs(peer, range(4))
    found = [record.points_seq for record in peer.subscribe(SENSOR_DATA, 3)]
    yield same("pairs 0 to 3, Subscribe most 3: points_seq", [0, 1, 2], found)
    yield same("then Get: points_seq", 3, peer.result(SENSOR_DATA).points_seq)


@CHECKS.extension(7, "SendStream", "a stream of records is taken like one by one; what was refused is known by number")
def _streamed(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    summary = peer.send_stream([scene.image(), scene.image(2, height=0), scene.cloud()])
    yield same("SendStream of good, bad, good: accepted, refused", (2, 1), (summary.accepted, summary.refused))
    yield same("the numbers of those refused", [1], [found.number for found in summary.refusals])
    yield same("then Get: points_seq", 1, peer.result(SENSOR_DATA).points_seq)


@CHECKS.extension(8, "GetReply, field 100", "results are numbered from 0 on, each type by itself, without gaps")
def _numbered(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    send_pairs(peer, range(3))
    found = sorted(peer.fetch(SENSOR_DATA).number for _ in range(3))
    yield same("three pairs, Get three times: number", [0, 1, 2], found)


@CHECKS.extension(9, "GetReply, field 101", "a result carries the properties that were in force when its sweep came")
def _configuration(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.set("lidar_frequency", 20)
    send_pairs(peer, range(1))
    reply = peer.fetch(SENSOR_DATA)
    peer.set("lidar_frequency", 5)
    found = {entry.name: entry.value.integer_value for entry in reply.configuration.properties}
    yield same("lidar_frequency 20, a pair, Get: its configuration", 20, found.get("lidar_frequency"))


@CHECKS.extension(10, "table 9, field 100", 'depth_kind "range": distances along the rays; the record says which')
def _range(bench: Bench) -> Iterator[Seen]:
    yield same("the scene's pair, Get: depth_kind", "z", bench.once(fused_pair).depth_kind)
    peer = bench.ready()
    peer.set("depth_kind", "range")
    record = fused_pair(peer)
    yield same("depth_kind range, a pair, Get: depth_kind", "range", record.depth_kind)
    for point in scene.SEEN:
        length = float(np.linalg.norm(scene.depth_of_pixel(point)))
        found = float(depths(record)[point.row, point.column])
        yield near(f"image_depth at column {point.column}, row {point.row}", length, found, 1e-5 * length)


@CHECKS.extension(11, "table 9, field 101", "reference_frame 0: the points of results are in the camera's frame")
def _camera_frame(bench: Bench) -> Iterator[Seen]:
    yield same("the scene's pair, Get: point_frame", "lidar", bench.once(fused_pair).point_frame)
    peer = bench.ready()
    peer.set("reference_frame", 0)
    record = fused_pair(peer)
    yield same("reference_frame 0, a pair, Get: point_frame", "camera", record.point_frame)
    error = float(np.abs(columns_of(record, ("x", "y", "z")) - scene.points_camera()).max())
    yield near("distance of points from where the calibration puts them [m]", 0.0, error, 1e-5)


@CHECKS.extension(12, "tables 9 and 10, field 103", "a result also says when its image was taken")
def _image_time(bench: Bench) -> Iterator[Seen]:
    expected = scene.in_ns(scene.timestamp(scene.IMAGE_LATER_NS))
    for make in (fused_pair, fused_boxes):
        yield same("a pair, Get: image_timestamp [ns]", expected, scene.in_ns(bench.once(make).image_timestamp))


@CHECKS.extension(13, "table 10, fields 101 and 102", "a detection names the boxes that it was made of")
def _boxes_named(bench: Bench) -> Iterator[Seen]:
    result = bench.once(fused_boxes)
    both, alone = (detection_of(result, box) for box in (scene.MATCHED, scene.ALONE))
    ids = (both.box_3d_id, both.box_2d_id)
    yield same("what both saw: box_3d_id, box_2d_id", (scene.MATCHED.id, scene.MATCHED_2D_ID), ids)
    found = (alone.box_3d_id, alone.HasField("box_2d_id"))
    yield same("what the lidar alone saw: box_3d_id, whether there is a box_2d_id", (scene.ALONE.id, False), found)


@CHECKS.extension(14, "FusedDetections, fields 2 to 6", "detections state of which image and which sweep they are")
def _pair_named(bench: Bench) -> Iterator[Seen]:
    found = bench.once(fused_boxes)
    numbers = (found.image_seq, found.points_seq, found.camera_id, found.lidar_id, scene.in_ns(found.timestamp))
    expected = (1, 1, scene.CAMERA_ID, scene.LIDAR_ID, scene.in_ns(scene.timestamp()))
    yield same("image_seq, points_seq, camera_id, lidar_id, timestamp", expected, numbers)


@CHECKS.extension(15, "SendMotion", "where the vehicle moves between sweep and image, points are seen from where it is")
def _motion(bench: Bench) -> Iterator[Seen]:
    # 2 m forward from the sweep to the image: a point 10 m before the camera is then 8 m before it
    yield same("without motion: motion_compensated", 0, int(bench.once(fused_pair).motion_compensated))
    later = 50_000_000
    for compensated in (1, 0):
        peer = bench.ready()
        peer.set("motion_compensation", compensated)
        poses = [_pose(-later, -2.0), _pose(0, 0.0), _pose(later, 2.0), _pose(2 * later, 4.0)]
        reply = peer.call("SendMotion", poses=poses)
        yield same("SendMotion of 40 m/s forward", 1, reply.status)
        x, y, depth = scene.depth_of_pixel(scene.SEEN[0])
        before = np.array([[x, y, depth + 2.0 * compensated]])
        cloud = scene.cloud(points=scene.lidar_from_camera(before).astype(np.float32))
        record = peer.fused(scene.image(1, later), cloud)
        pixel = (scene.SEEN[0].column, scene.SEEN[0].row)
        yield same(f"motion_compensation {compensated}: pixels with a depth", [pixel], filled(record))
        yield same("motion_compensated of the result", compensated, int(record.motion_compensated))


def _pose(offset_ns: int, forward: float) -> fusion_pb2.Pose:
    return fusion_pb2.Pose(
        timestamp=scene.timestamp(offset_ns), position=(forward, 0.0, 0.0), quaternion_xyzw=(0.0, 0.0, 0.0, 1.0)
    )


@CHECKS.extension(16, "SetCalibration, fields 100 and 101", "several cameras and lidars: a result for each pair")
def _several(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    for camera_id in (7, 8):
        for lidar_id in (3, 4):
            peer.calibrate(camera_id=camera_id, lidar_id=lidar_id)
    for camera_id in (7, 8):
        peer.send(scene.image(sensor_id=camera_id))
    for lidar_id in (3, 4):
        peer.send(scene.cloud(sensor_id=lidar_id))
    found = [peer.result(SENSOR_DATA) for _ in range(4)]
    pairs = sorted((record.camera_id, record.lidar_id) for record in found)
    yield same("an image of cameras 7, 8, a sweep of lidars 3, 4: pairs", [(7, 3), (7, 4), (8, 3), (8, 4)], pairs)


@CHECKS.extension(17, "Flush", "what waits is fused with what has come")
def _flushed(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.send(scene.image(1, -2_000_000))
    peer.send(scene.cloud())
    yield same("an image, a sweep 2 ms later, Flush", 1, peer.call("Flush").status)
    found = peer.fetch(SENSOR_DATA, wait_ms=0).WhichOneof("result")
    yield same("Get without waiting", "sensor_data", found)


@CHECKS.extension(18, "GetCounters", "what came and what was refused is counted")
def _counted(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    send_pairs(peer, range(2))
    peer.send(scene.image(9, height=0))
    peer.result(SENSOR_DATA)
    counts = dict(peer.call("GetCounters").counts)
    received = (counts.get("received.image"), counts.get("received.points"))
    yield same("two pairs: received.image, received.points", (2, 2), received)
    refused = sum(count for name, count in counts.items() if name.startswith("refused."))
    yield same("one faulty image: all of refused.…", 1, refused)


@CHECKS.extension(19, "table 7, field 100", "velocity_vector: the velocity along all three axes comes back")
def _vector(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    vector = (-1.5, 2.0, 0.0)
    box = scene.box_3d(scene.MATCHED)
    box.velocity_vector.extend(vector)
    found = list(peer.detected(scene.boxes_2d(), scene.boxes_3d(boxes=[box])).detections[0].velocity_vector)
    agrees = len(found) == 3 and max(abs(a - b) for a, b in zip(found, vector, strict=True)) < 1e-4
    yield true("velocity_vector (-1.5, 2, 0), Get", str(vector), found, agrees=agrees)


@CHECKS.extension(20, "property calibration", "records of table 3 can be set as a property, as JSON")
def _calibrated_by_property(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    entry = {
        "camera_id": scene.CAMERA_ID,
        "lidar_id": scene.LIDAR_ID,
        "image_size": [scene.WIDTH, scene.HEIGHT],
        "intrinsic_matrix": scene.INTRINSIC,
        "reference_frame": 0,
        "extrinsic_matrix": scene.by_columns(scene.CAMERA_FROM_LIDAR),
    }
    status = peer.set("calibration", json.dumps([entry]))
    yield same("SetProperty calibration", "set", "set" if status else "refused")
    expected = sorted((point.column, point.row) for point in scene.SEEN)
    yield same("a pair, Get: pixels with a depth", expected, filled(fused_pair(peer)))
    yield refused("SetProperty calibration 'none'", peer.set("calibration", "none"))


@CHECKS.extension(21, "grpc.health.v1", "the health service says SERVING of the service and of all")
def _healthy(bench: Bench) -> Iterator[Seen]:
    for name in (SERVICE.full_name, ""):
        yield same(f"Health/Check of {name!r}", "SERVING", bench.transport.health(name))
    unknown = f"{SERVICE.full_name}Unknown"
    try:
        found = bench.transport.health(unknown)
    except CallFailedError as error:
        found = error.code
    yield same(f"Health/Check of {unknown!r}", "NOT_FOUND", found)


@CHECKS.extension(22, "grpc.reflection", "reflection lists the service")
def _surroundings_listed(bench: Bench) -> Iterator[Seen]:
    found = bench.transport.services()
    yield true("list_services", SERVICE.full_name, sorted(found), agrees=SERVICE.full_name in found)


@CHECKS.extension(
    23, "grpc.reflection", "reflection gives the methods, messages and fields of the .proto, further ones aside"
)
def _described(bench: Bench) -> Iterator[Seen]:
    files = [FileDescriptorProto.FromString(content) for content in bench.transport.files_with(SERVICE.full_name)]
    methods = {
        method.name: _of_method(method)
        for file in files
        for service in file.service
        if f"{file.package}.{service.name}" == SERVICE.full_name
        for method in service.method
    }
    ours = FileDescriptorProto()
    fusion_pb2.DESCRIPTOR.CopyToProto(ours)
    for method in ours.service[0].method:
        asked = f"file_containing_symbol of the service: method {method.name}"
        yield same(asked, _of_method(method), methods.get(method.name))
    messages = {f"{file.package}.{message.name}": message for file in files for message in file.message_type}
    for message in ours.message_type:
        theirs = messages.get(f"{ours.package}.{message.name}", DescriptorProto())
        missing = sorted(_fields(message) - _fields(theirs))
        yield same(f"fields of {message.name} that are missing or others", [], missing)


def _of_method(method: object) -> tuple[object, ...]:
    names = ("input_type", "output_type", "client_streaming", "server_streaming")
    return tuple(getattr(method, name) for name in names)


def _fields(message: DescriptorProto) -> set[tuple[int, str, int, bool, str]]:
    repeated = 3  # FieldDescriptorProto.Label.LABEL_REPEATED
    return {(field.number, field.name, field.type, field.label == repeated, field.type_name) for field in message.field}
