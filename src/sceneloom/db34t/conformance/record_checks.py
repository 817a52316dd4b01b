"""Checks of clauses 5.6 and 5.7: records taken and refused, tables 4 to 8 field by field, and results in order."""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from sceneloom.db34t.conformance import scene
from sceneloom.db34t.conformance.catalogue import (
    DETECTIONS,
    RESULT_NAMES,
    SENSOR_DATA,
    Bench,
    CallFailedError,
    Catalogue,
    Look,
    Peer,
    Seen,
    columns_of,
    near,
    refused,
    reported,
    same,
    send_pairs,
    taken,
    true,
)
from sceneloom.db34t.tables import TABLES
from sceneloom.db34t.wire import fusion_pb2

CHECKS = Catalogue()
_FLOATS = (float("nan"), float("inf"))

_TIMESTAMPS = (None, fusion_pb2.Timestamp(s=1, ns=10**9), fusion_pb2.Timestamp(s=1, ns=2**32 - 1))
"""No timestamp, and such whose nanoseconds make a second or more."""

_RAW_SENSORS = f'{{"{scene.CAMERA_ID}": {{"kind": "camera", "raw": "rgb8"}}, "{scene.LIDAR_ID}": {{"kind": "lidar"}}}}'
"""The property `sensors` for raw data that are pixels."""

_PIXELS = scene.drawn_image().tobytes()
_POINTS = scene.points_lidar()


def _raw_ready(bench: Bench) -> Peer:
    """A calibrated session in which raw data are pixels."""
    peer = bench.ready()
    peer.set("sensors", _RAW_SENSORS)
    return peer


@CHECKS.clause("5.6-1", "5.6.1", "raw data, images, clouds, 3D boxes and 2D boxes are taken")
def _kinds(bench: Bench) -> Iterator[Seen]:
    peer = _raw_ready(bench)
    for request in (scene.raw(_PIXELS), scene.image(2), scene.cloud(), scene.boxes_3d(), scene.boxes_2d()):
        yield taken(f"Send {request.WhichOneof('data')}", peer.send(request))


@CHECKS.clause("5.6-2", "5.6.2", "a request without data is refused")
def _nothing(bench: Bench) -> Iterator[Seen]:
    yield refused("Send of nothing", bench.ready().send(fusion_pb2.SendRequest()))


@CHECKS.clause("5.6-3", "5.6.3", "sending returns 1, and 0 where the data are not taken")
def _status(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    yield same("Send of an image", 1, peer.send(scene.image()))
    yield same("Send of an image of 0 rows", 0, peer.send(scene.image(2, height=0)))


@CHECKS.clause("5.6-4", "5.6.1", "data of a sensor without a calibration are refused", reading=True)
def _uncalibrated(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    yield refused("Send before any calibration", peer.send(scene.image()))
    peer.calibrate()
    status = peer.send(scene.cloud(sensor_id=scene.LIDAR_ID + 1))
    yield refused("Send of a lidar that has none", status)


@CHECKS.clause("5.6-5", "5.6.1", "lists without boxes are taken: frames in which nothing was found", reading=True)
def _empty_lists(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    for request in (scene.boxes_2d(boxes=[]), scene.boxes_3d(boxes=[])):
        name = request.WhichOneof("data")
        yield taken(f"Send of {name} without boxes", peer.send(request))
    yield same("Get: detections", 0, len(peer.result(DETECTIONS).detections))


@CHECKS.clause("5.6-6", "5.6.1", "boxes that come one by one are those of their frame", reading=True)
def _bare(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.set("pairing_timeout_ms", 10_000)  # only the next number closes a frame, however slow the connection is
    later = scene.PERIOD_NS + scene.IMAGE_LATER_NS
    for box in (scene.box_2d(), scene.box_2d(2, later)):
        yield taken(f"Send box_2d of image {box.image_seq}", peer.send(fusion_pb2.SendRequest(box_2d=box)))
    boxes = (scene.box_3d(scene.MATCHED), scene.box_3d(scene.ALONE))
    for bare in (*boxes, scene.box_3d(scene.MATCHED, 2, scene.PERIOD_NS)):
        request = fusion_pb2.SendRequest(box_3d=bare)
        yield taken(f"Send box_3d of sweep {bare.points_seq}", peer.send(request))
    found = peer.result(DETECTIONS)
    ids = sorted(box.box_3d_id for box in found.detections if box.HasField("box_3d_id"))
    yield same("Get: boxes of sweep 1", [scene.MATCHED.id, scene.ALONE.id], ids)


@CHECKS.clause("5.6-7", "5.6.1", "the same number of a sensor again is refused", reading=True)
def _duplicate(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.send(scene.cloud(5))
    status = peer.send(scene.cloud(5, scene.PERIOD_NS))
    yield refused("Send of clouds with seq 5 and 5: the second", status)


@CHECKS.clause("5.6-8", "5.6.2", "seq is a uint32 that goes on from 4294967295 with 0, and comes back as it was sent")
def _wrap(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    numbers = [2**31 - 1, 2**31, 2**32 - 2, 2**32 - 1, 0, 1]
    for k, number in enumerate(numbers):
        peer.send(scene.image(number, k * scene.PERIOD_NS + scene.IMAGE_LATER_NS))
        peer.send(scene.cloud(number, k * scene.PERIOD_NS))
    found = [peer.result(SENSOR_DATA) for _ in numbers]
    yield same(f"pairs with seq {numbers}, Get: points_seq", numbers, [record.points_seq for record in found])
    yield same(f"pairs with seq {numbers}, Get: image_seq", numbers, [record.image_seq for record in found])


@CHECKS.clause("5.6-9", "5.6.1", "a sweep gets the image nearest in time", reading=True)
def _nearest(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    images = [scene.image(seq, offset_ns) for seq, offset_ns in ((1, -30_000_000), (2, 10_000_000), (3, 60_000_000))]
    sent = "images 1, 2, 3 taken 30 ms before, 10 and 60 ms after a sweep, Get: image_seq"
    yield same(sent, 2, peer.fused(*images, scene.cloud(9)).image_seq)


@CHECKS.clause("5.6-10", "5.6.1", "records that come late and out of order find their partners", reading=True)
def _out_of_order(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    images = scene.image(2, scene.PERIOD_NS), scene.image(1, 0)
    first = peer.fused(*images, scene.cloud(1), scene.cloud(2, scene.PERIOD_NS))
    found = [(record.points_seq, record.image_seq) for record in (first, peer.result(SENSOR_DATA))]
    yield same("images 2, 1, then sweeps 1, 2, Get: (points_seq, image_seq)", [(1, 1), (2, 2)], found)


@CHECKS.clause("5.6-11", "5.6.1", "a record far older than its sensor's newest is refused", reading=True)
def _backwards(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.send(scene.cloud(1, 3_000_000_000))
    status = peer.send(scene.cloud(2, 0))
    yield refused("Send of a sweep 3 s older than the one before", status)


@CHECKS.clause("5.6-12", "5.6.3", "what is refused leaves no trace: the next pair is fused", reading=True)
def _no_trace(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    faulty = scene.image(1, width=1), scene.cloud(1, number=1)
    record = peer.fused(*faulty, scene.image(1), scene.cloud(1))
    found = (record.points_seq, record.image_seq)
    yield same("faulty records with seq 1, then good ones with seq 1, Get", (1, 1), found)


_Case = tuple[Any, Any]  # values of a field: taken, refused

_IMAGE_ROWS: Mapping[str, _Case] = {
    "sensor_id": ((scene.CAMERA_ID,), (scene.CAMERA_ID + 256, 2**32 - 1)),
    "timestamp": ((scene.timestamp(), fusion_pb2.Timestamp(s=0, ns=0)), _TIMESTAMPS),
    "seq": ((0, 2**31, 2**32 - 1), ()),
    "height": ((scene.HEIGHT,), (0, scene.HEIGHT - 1, scene.HEIGHT + 1, 2**31)),
    "width": ((scene.WIDTH,), (0, scene.WIDTH - 1, scene.WIDTH + 1, 2**31)),
    "encoding": (("rgb8", "bgr8"), ("", "rgb", "rgba8")),
    "channel": ((3,), (0, 1, 4, 3 + 256)),
    "data": ((_PIXELS,), (b"", _PIXELS[:-1], _PIXELS + b"\0")),
}

_CLOUD_ROWS: Mapping[str, _Case] = {
    "sensor_id": ((scene.LIDAR_ID,), (scene.LIDAR_ID + 256, 2**32 - 1)),
    "timestamp": ((scene.timestamp(), fusion_pb2.Timestamp(s=0, ns=0)), _TIMESTAMPS),
    "seq": ((0, 2**31, 2**32 - 1), ()),
    "number": ((len(_POINTS),), (0, len(_POINTS) - 1, len(_POINTS) + 1, 2**32 - 1)),
    "fields": ((("x", "y", "z"), ("z", "y", "x")), ((), ("x", "y"), ("x", "y", "reflectivity"), ("x", "x", "y"))),
    "fields_number": ((3,), (0, 2, 4, 3 + 256)),
    "data": ((_POINTS.tobytes(),), (b"", _POINTS.tobytes()[:-4], _POINTS.tobytes()[:-1])),
    "sensor_type": ((0, 1), (2,)),
    "beam": ((32, None), ()),
    "ring": ((0, None), ()),
}

_RAW_ROWS: Mapping[str, _Case] = {
    "sensor_id": ((scene.CAMERA_ID,), (scene.CAMERA_ID + 256, scene.CAMERA_ID + 1)),
    "timestamp": ((scene.timestamp(), fusion_pb2.Timestamp(s=0, ns=0)), _TIMESTAMPS),
    "seq": ((0, 2**31, 2**32 - 1), ()),
    "length": ((len(_PIXELS),), (0, len(_PIXELS) - 1, len(_PIXELS) + 1)),
    "data": ((_PIXELS,), (b"", _PIXELS[:-1])),
}

_LOCATION: _Case = ((-100.0, 0.0), _FLOATS)
_SIZE: _Case = ((0.25,), (0.0, -1.0, *_FLOATS))
_CONFIDENCE: _Case = ((0.0, 1.0), (-0.125, 1.125, *_FLOATS))

_BOX_3D_ROWS: Mapping[str, _Case] = {
    "id": ((-(2**31), 2**31 - 1), ()),
    "class": (("Car", "Zamboni", "自行车"), ("",)),
    "points_seq": ((1,), (2,)),
    "confidence": _CONFIDENCE,
    "timestamp": ((scene.timestamp(),), (*_TIMESTAMPS[1:], scene.timestamp(1))),
    **dict.fromkeys("XYZ", _LOCATION),
    **dict.fromkeys(("length", "width", "height"), _SIZE),
    "direction": (((2.0, 3.0, 0.0),), ((0.0, 0.0, 0.0), (1.0, 0.0), (), (math.nan, 1.0, 0.0))),
    "velocity": ((-3.5, 0.0), _FLOATS),
}

_BOX_2D_ROWS: Mapping[str, _Case] = {
    "id": ((-(2**31), 2**31 - 1), ()),
    "class": (("Car", "Zamboni", "自行车"), ("",)),
    "image_seq": ((1,), (2,)),
    "confidence": _CONFIDENCE,
    "timestamp": ((scene.timestamp(),), (*_TIMESTAMPS[1:], scene.timestamp(1))),
    "x1": ((0,), (scene.WIDTH,)),
    "y1": ((0,), (scene.HEIGHT,)),
    "x2": ((scene.WIDTH,), (0, 8)),
    "y2": ((scene.HEIGHT,), (0, 8)),
}


def _raw(changed: Mapping[str, Any]) -> fusion_pb2.SendRequest:
    request = scene.raw(_PIXELS)
    for name, value in changed.items():
        request.raw.ClearField(name)
        if value is not None:
            request.raw.MergeFrom(fusion_pb2.RawData(**{name: value}))
    return request


def _box_3d(changed: Mapping[str, Any]) -> fusion_pb2.SendRequest:
    return scene.boxes_3d(boxes=[scene.box_3d(scene.MATCHED, **changed)])


def _box_2d(changed: Mapping[str, Any]) -> fusion_pb2.SendRequest:
    corners = {"x1": 8, "y1": 8, "x2": 40, "y2": 40}
    return scene.boxes_2d(offset_ns=0, boxes=[scene.box_2d(offset_ns=0, **(corners | dict(changed)))])


_TABLES: Mapping[int, tuple[Mapping[str, _Case], Callable[[Mapping[str, Any]], fusion_pb2.SendRequest]]] = {
    4: (_RAW_ROWS, _raw),
    5: (_IMAGE_ROWS, lambda changed: scene.image(**changed)),
    6: (_CLOUD_ROWS, lambda changed: scene.cloud(**changed)),
    7: (_BOX_3D_ROWS, _box_3d),
    8: (_BOX_2D_ROWS, _box_2d),
}

_READINGS = {(5, "encoding"), (7, "class"), (8, "class"), (7, "points_seq"), (8, "image_seq")}
"""Rows about which the standard says less than is asked here."""


def _look(table: int, name: str) -> Look:
    rows, request_of = _TABLES[table]
    (good, bad), ready = rows[name], _raw_ready if table == 4 else Bench.ready

    def send(peer: Peer, value: Any) -> tuple[str, int]:
        shown = f"{len(value)} bytes" if isinstance(value, bytes) else repr(value)
        shown = reported(value) if hasattr(value, "DESCRIPTOR") else shown
        return f"Send {name} = {shown}", peer.send(request_of({name: value}))

    def look(bench: Bench) -> Iterator[Seen]:
        for value in good:
            yield taken(*send(ready(bench), value))
        peer = ready(bench)
        for value in bad:
            yield refused(*send(peer, value))

    return look


for _number, (_rows, _) in _TABLES.items():
    for _name in _rows:
        _kind = TABLES[_number].row(_name).type
        _title = f"{_name} of type {_kind} is taken as it is, and refused where it is none"
        _declare = CHECKS.row(_number, _name, _title, reading=(_number, _name) in _READINGS)
        _declare(_look(_number, _name))


@CHECKS.clause("6.2-1", "6.2", "raw data that are pixels are fused as an image is", reading=True)
def _raw_pixels(bench: Bench) -> Iterator[Seen]:
    peer = _raw_ready(bench)
    record = peer.fused(scene.raw(_PIXELS, offset_ns=scene.IMAGE_LATER_NS), scene.cloud())
    agrees = record.image_data == _PIXELS
    found = "the same" if agrees else "others"
    yield true("Send of raw data and a cloud, Get: image_data", "the pixels that were sent", found, agrees=agrees)


@CHECKS.clause("6.3-1", "6.3", "an image in bgr8 gives the points the colours that it has in rgb8", reading=True)
def _blue_first(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    blue_first = scene.drawn_image()[:, :, ::-1].tobytes()
    record = peer.fused(scene.image(encoding="bgr8", data=blue_first), scene.cloud())
    found = columns_of(record, ("r", "g", "b"))
    for k, point in enumerate(scene.SEEN):
        expected = [float(level) for level in scene.color_at(point)]
        yield same(f"the scene's image in bgr8, Get: r, g, b of point {k}", expected, found[k].tolist())


@CHECKS.clause("6.4-1", "6.4", "beam and ring are of mechanical lidars only")
def _solid_state(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    for name, request in (("beam", scene.cloud(sensor_type=1, beam=1)), ("ring", scene.cloud(sensor_type=1, ring=1))):
        status = peer.send(request)
        yield refused(f"Send sensor_type = 1, {name} = 1", status)


@CHECKS.clause(
    "6.4-2",
    "6.4",
    "points that are not finite, as drivers mark missing returns, are left out, and the others are fused",
    reading=True,
)
def _missing_returns(bench: Bench) -> Iterator[Seen]:
    for missing in _FLOATS:
        peer = bench.ready()
        points = scene.points_lidar()
        points[1] = missing
        peer.send(scene.image())
        status = peer.send(scene.cloud(points=points))
        yield taken(f"Send of a cloud whose point 1 is {missing}", status)
        record = peer.result(SENSOR_DATA)
        yield same("Get: point_num", len(points) - 1, record.point_num)
        found = columns_of(record, ("x", "y", "z"))
        error = float(np.abs(found - np.delete(scene.points_lidar(), 1, axis=0)).max())
        yield near("Get: distance of the others from where they were sent [m]", 0.0, error, 1e-5)


@CHECKS.clause(
    "6.5-1", "6.5", "a box whose direction is vertical does not state how it lies, and is refused", reading=True
)
def _vertical(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    for direction in ((0.0, 0.0, 1.0), (0.0, 0.0, -2.0)):
        status = peer.send(_box_3d({"direction": direction}))
        yield refused(f"Send of a box, direction = {direction}", status)


def _send_boxes(peer: Peer, numbers: range) -> None:
    for k in numbers:
        peer.send(scene.boxes_2d(k, k * scene.PERIOD_NS + scene.IMAGE_LATER_NS))
        peer.send(scene.boxes_3d(k, k * scene.PERIOD_NS))


@CHECKS.clause("5.7-1", "5.7.1", "sensor data come fused as table 9 says, detections as table 10")
def _both(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    send_pairs(peer, range(1))
    _send_boxes(peer, range(1))
    for fusion_type, name in enumerate(RESULT_NAMES):
        yield same(f"Get fusion_type {fusion_type}", name, peer.fetch(fusion_type).WhichOneof("result"))


@CHECKS.clause(
    "5.7-2", "5.7.2", "the fusion type is 0 or 1; without it, what the property fusion_type says", reading=True
)
def _type(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    send_pairs(peer, range(1))
    _send_boxes(peer, range(1))
    for fusion_type in (DETECTIONS, SENSOR_DATA):
        peer.set("fusion_type", fusion_type)
        found = peer.fetch(None).WhichOneof("result")
        yield same(f"SetProperty fusion_type {fusion_type}, Get without a type", RESULT_NAMES[fusion_type], found)
    try:
        found = f"an answer with {peer.fetch(2, wait_ms=0).WhichOneof('result')}"
    except CallFailedError:
        found = "an error"
    yield same("Get fusion_type 2", "an error", found)


@CHECKS.clause("5.7-3", "5.7.3", "results come first in, first out, of each type by itself", reading=True)
def _order(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    send_pairs(peer, range(5))
    _send_boxes(peer, range(5))
    numbers = list(range(5))
    for fusion_type in (DETECTIONS, SENSOR_DATA):
        found = [peer.result(fusion_type).points_seq for _ in numbers]
        yield same(f"pairs 0 to 4, Get fusion_type {fusion_type} five times: points_seq", numbers, found)


@CHECKS.clause("5.7-4", "5.7.3", "each result is given once", reading=True)
def _once(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    send_pairs(peer, range(2))
    found = sorted(peer.result(SENSOR_DATA).points_seq for _ in range(2))
    yield same("two pairs, Get twice: points_seq, sorted", [0, 1], found)
    yield same("Get a third time", "no_data", _held(peer, SENSOR_DATA, 0))


@CHECKS.clause("5.7-5", "5.7.3", "where there is no result, the answer says so, and is no error", reading=True)
def _no_data(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    for fusion_type in (SENSOR_DATA, DETECTIONS):
        for wait_ms in (0, 20):
            found = _held(peer, fusion_type, wait_ms)
            yield same(f"Get fusion_type {fusion_type}, wait_ms {wait_ms}, of nothing", "no_data", found)


def _held(peer: Peer, fusion_type: int, wait_ms: int) -> str:
    try:
        return str(peer.fetch(fusion_type, wait_ms=wait_ms).WhichOneof("result"))
    except CallFailedError as error:
        return str(error)
