"""Checks of clauses 5.6 and 5.7: which records are accepted or refused, tables 4 to 8 field by field.

And results fetched once, first in, first out.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from sceneloom.db34t.conformance import scene as conformance_scene
from sceneloom.db34t.conformance.catalogue import (
    DETECTIONS,
    RESULT_NAMES,
    SENSOR_DATA,
    Basis,
    Bench,
    Catalogue,
    Look,
    Peer,
    Seen,
    near,
    reported,
    same,
    true,
)
from sceneloom.db34t.conformance.fusion_checks import columns_of
from sceneloom.db34t.tables import TABLES
from sceneloom.db34t.transport import CallFailedError
from sceneloom.db34t.wire import fusion_pb2

_CHECKS = Catalogue("What is sent (clauses 6.2 to 6.6, tables 4 to 8)")

_FLOATS = (float("nan"), float("inf"))

_TIMESTAMPS = (None, fusion_pb2.Timestamp(s=1, ns=10**9), fusion_pb2.Timestamp(s=1, ns=2**32 - 1))
"""No timestamp, and such whose nanoseconds make a second or more."""

_RAW_SENSORS = (
    f'{{"{conformance_scene.CAMERA_ID}": {{"kind": "camera", "raw": "rgb8"}}, '
    f'"{conformance_scene.LIDAR_ID}": {{"kind": "lidar"}}}}'
)
"""The property `sensors` for raw data that are pixels."""

_PIXELS = conformance_scene.drawn_image().tobytes()

_POINTS = conformance_scene.points_lidar()

_Case = tuple[Any, Any]
"""Values of a field: taken, refused."""

_IMAGE_ROWS: Mapping[str, _Case] = {
    "sensor_id": ((conformance_scene.CAMERA_ID,), (conformance_scene.CAMERA_ID + 256, 2**32 - 1)),
    "timestamp": ((conformance_scene.timestamp(), fusion_pb2.Timestamp(s=0, ns=0)), _TIMESTAMPS),
    "seq": ((0, 2**31, 2**32 - 1), ()),
    "height": (
        (conformance_scene.HEIGHT,),
        (0, conformance_scene.HEIGHT - 1, conformance_scene.HEIGHT + 1, 2**31),
    ),
    "width": (
        (conformance_scene.WIDTH,),
        (0, conformance_scene.WIDTH - 1, conformance_scene.WIDTH + 1, 2**31),
    ),
    "encoding": (("rgb8", "bgr8"), ("", "rgb", "rgba8")),
    "channel": ((3,), (0, 1, 4, 3 + 256)),
    "data": ((_PIXELS,), (b"", _PIXELS[:-1], _PIXELS + b"\0")),
}

_CLOUD_ROWS: Mapping[str, _Case] = {
    "sensor_id": ((conformance_scene.LIDAR_ID,), (conformance_scene.LIDAR_ID + 256, 2**32 - 1)),
    "timestamp": ((conformance_scene.timestamp(), fusion_pb2.Timestamp(s=0, ns=0)), _TIMESTAMPS),
    "seq": ((0, 2**31, 2**32 - 1), ()),
    "number": ((len(_POINTS),), (0, len(_POINTS) - 1, len(_POINTS) + 1, 2**32 - 1)),
    "fields": (
        (("x", "y", "z"), ("z", "y", "x")),
        ((), ("x", "y"), ("x", "y", "reflectivity"), ("x", "x", "y")),
    ),
    "fields_number": ((3,), (0, 2, 4, 3 + 256)),
    "data": (
        (_POINTS.tobytes(),),
        (b"", _POINTS.tobytes()[:-4], _POINTS.tobytes()[:-1]),
    ),
    "sensor_type": ((0, 1), (2,)),
    "beam": ((32, None), ()),
    "ring": ((0, None), ()),
}

_RAW_ROWS: Mapping[str, _Case] = {
    "sensor_id": (
        (conformance_scene.CAMERA_ID,),
        (conformance_scene.CAMERA_ID + 256, conformance_scene.CAMERA_ID + 1),
    ),
    "timestamp": ((conformance_scene.timestamp(), fusion_pb2.Timestamp(s=0, ns=0)), _TIMESTAMPS),
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
    "timestamp": ((conformance_scene.timestamp(),), (*_TIMESTAMPS[1:], conformance_scene.timestamp(1))),
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
    "timestamp": ((conformance_scene.timestamp(),), (*_TIMESTAMPS[1:], conformance_scene.timestamp(1))),
    "x1": ((0,), (conformance_scene.WIDTH,)),
    "y1": ((0,), (conformance_scene.HEIGHT,)),
    "x2": ((conformance_scene.WIDTH,), (0, 8)),
    "y2": ((conformance_scene.HEIGHT,), (0, 8)),
}


def _image(changed: Mapping[str, Any]) -> fusion_pb2.SendRequest:
    return conformance_scene.image(**changed)


def _cloud(changed: Mapping[str, Any]) -> fusion_pb2.SendRequest:
    return conformance_scene.cloud(**changed)


def _raw(changed: Mapping[str, Any]) -> fusion_pb2.SendRequest:
    request = conformance_scene.raw(_PIXELS)
    for name, value in changed.items():
        request.raw.ClearField(name)
        if value is not None:
            request.raw.MergeFrom(fusion_pb2.RawData(**{name: value}))
    return request


def _box_3d(changed: Mapping[str, Any]) -> fusion_pb2.SendRequest:
    return conformance_scene.boxes_3d(boxes=[conformance_scene.box_3d(conformance_scene.MATCHED, **changed)])


def _box_2d(changed: Mapping[str, Any]) -> fusion_pb2.SendRequest:
    corners = {"x1": 8, "y1": 8, "x2": 40, "y2": 40}
    return conformance_scene.boxes_2d(
        offset_ns=0, boxes=[conformance_scene.box_2d(offset_ns=0, **(corners | dict(changed)))]
    )


_TABLES: Mapping[int, tuple[Mapping[str, _Case], Callable[[Mapping[str, Any]], fusion_pb2.SendRequest]]] = {
    4: (_RAW_ROWS, _raw),
    5: (_IMAGE_ROWS, _image),
    6: (_CLOUD_ROWS, _cloud),
    7: (_BOX_3D_ROWS, _box_3d),
    8: (_BOX_2D_ROWS, _box_2d),
}

_READINGS = {(5, "encoding"), (7, "class"), (8, "class"), (7, "points_seq"), (8, "image_seq")}
"""Rows about which the standard says less than is asked here."""


def _ready(bench: Bench, table: int) -> Peer:
    peer = bench.ready()
    if table == 4:
        peer.set("sensors", _RAW_SENSORS)
    return peer


def _look(table: int, name: str) -> Look:
    rows, request_of = _TABLES[table]
    taken, refused = rows[name]

    def look(bench: Bench) -> Iterator[Seen]:
        for value in taken:
            status = _ready(bench, table).send(request_of({name: value}))
            yield same(f"Send {name} = {_shown(value)}", "taken", "taken" if status else "refused")
        peer = _ready(bench, table)
        for value in refused:
            status = peer.send(request_of({name: value}))
            yield same(f"Send {name} = {_shown(value)}", "status 0", f"status {status}")

    return look


def _shown(value: Any) -> str:
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    return reported(value) if hasattr(value, "DESCRIPTOR") else repr(value)


for _number, (_rows, _) in _TABLES.items():
    for _name in _rows:
        _row = TABLES[_number].row(_name)
        _basis = Basis.READING if (_number, _name) in _READINGS else Basis.TEXT
        _CHECKS.row(
            _number,
            _name,
            f"{_name} of type {_row.type} is taken as it is, and refused where it is none",
            basis=_basis,
        )(_look(_number, _name))


@_CHECKS.clause("6.2-1", "6.2", "raw data that are pixels are fused as an image is", basis=Basis.READING)
def _raw_pixels(bench: Bench) -> Iterator[Seen]:
    peer = _ready(bench, 4)
    peer.send(conformance_scene.raw(_PIXELS, offset_ns=conformance_scene.IMAGE_LATER_NS))
    peer.send(conformance_scene.cloud())
    record = peer.result(0)
    yield true(
        "Send of raw data and a cloud, Get: image_data",
        "the pixels that were sent",
        "the same" if record.image_data == _PIXELS else "others",
        agrees=record.image_data == _PIXELS,
    )


@_CHECKS.clause(
    "6.3-1", "6.3", "an image in bgr8 gives the points the colours that it has in rgb8", basis=Basis.READING
)
def _blue_first(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    blue_first = conformance_scene.drawn_image()[:, :, ::-1].tobytes()
    peer.send(conformance_scene.image(encoding="bgr8", data=blue_first))
    peer.send(conformance_scene.cloud())
    found = columns_of(peer.result(0), ("r", "g", "b"))
    for k, point in enumerate(conformance_scene.SEEN):
        expected = [float(level) for level in conformance_scene.color_at(point)]
        yield same(f"the scene's image in bgr8, Get: r, g, b of point {k}", expected, found[k].tolist())


@_CHECKS.clause("6.4-1", "6.4", "beam and ring are of mechanical lidars only")
def _solid_state(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    for name, request in (
        ("beam", conformance_scene.cloud(sensor_type=1, beam=1)),
        ("ring", conformance_scene.cloud(sensor_type=1, ring=1)),
    ):
        status = peer.send(request)
        yield same(f"Send sensor_type = 1, {name} = 1", "status 0", f"status {status}")


@_CHECKS.clause(
    "6.4-2",
    "6.4",
    "points that are not finite, as drivers mark missing returns, are left out, and the others are fused",
    basis=Basis.READING,
)
def _missing_returns(bench: Bench) -> Iterator[Seen]:
    for missing in _FLOATS:
        peer = bench.ready()
        points = conformance_scene.points_lidar()
        points[1] = missing
        peer.send(conformance_scene.image())
        status = peer.send(conformance_scene.cloud(points=points))
        yield same(f"Send of a cloud whose point 1 is {missing}", "taken", "taken" if status else "refused")
        record = peer.result(0)
        yield same("Get: point_num", len(points) - 1, record.point_num)
        found = columns_of(record, ("x", "y", "z"))
        error = float(np.abs(found - np.delete(conformance_scene.points_lidar(), 1, axis=0)).max())
        yield near("Get: distance of the others from where they were sent [m]", 0.0, error, 1e-5)


@_CHECKS.clause(
    "6.5-1",
    "6.5",
    "a box whose direction is vertical does not state how it lies, and is refused",
    basis=Basis.READING,
)
def _vertical(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    for direction in ((0.0, 0.0, 1.0), (0.0, 0.0, -2.0)):
        status = peer.send(_box_3d({"direction": direction}))
        yield same(f"Send of a box, direction = {direction}", "status 0", f"status {status}")


_RECEIVING_CHECKS = Catalogue("Receiving, pairs and order (clause 5.6)")

_PERIOD_NS = 100_000_000


@_RECEIVING_CHECKS.clause("5.6-1", "5.6.1", "raw data, images, clouds, 3D boxes and 2D boxes are taken")
def _kinds(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.set("sensors", _RAW_SENSORS)
    requests = (
        conformance_scene.raw(conformance_scene.drawn_image().tobytes()),
        conformance_scene.image(2),
        conformance_scene.cloud(),
        conformance_scene.boxes_3d(),
        conformance_scene.boxes_2d(),
    )
    for request in requests:
        yield same(
            f"Send {request.WhichOneof('data')}", "taken", "taken" if peer.send(request) else "refused"
        )


@_RECEIVING_CHECKS.clause("5.6-2", "5.6.2", "a request without data is refused")
def _nothing(bench: Bench) -> Iterator[Seen]:
    yield same("Send of nothing", "status 0", f"status {bench.ready().send(fusion_pb2.SendRequest())}")


@_RECEIVING_CHECKS.clause("5.6-3", "5.6.3", "sending returns 1, and 0 where the data are not taken")
def _status(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    yield same("Send of an image", 1, peer.send(conformance_scene.image()))
    yield same("Send of an image of 0 rows", 0, peer.send(conformance_scene.image(2, height=0)))


@_RECEIVING_CHECKS.clause(
    "5.6-4", "5.6.1", "data of a sensor without a calibration are refused", basis=Basis.READING
)
def _uncalibrated(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    yield same("Send before any calibration", "status 0", f"status {peer.send(conformance_scene.image())}")
    peer.calibrate()
    status = peer.send(conformance_scene.cloud(sensor_id=conformance_scene.LIDAR_ID + 1))
    yield same("Send of a lidar that has none", "status 0", f"status {status}")


@_RECEIVING_CHECKS.clause(
    "5.6-5", "5.6.1", "lists without boxes are taken: frames in which nothing was found", basis=Basis.READING
)
def _empty_lists(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    for request in (conformance_scene.boxes_2d(boxes=[]), conformance_scene.boxes_3d(boxes=[])):
        name = request.WhichOneof("data")
        yield same(f"Send of {name} without boxes", "taken", "taken" if peer.send(request) else "refused")
    yield same("Get: detections", 0, len(peer.result(DETECTIONS).detections))


@_RECEIVING_CHECKS.clause(
    "5.6-6", "5.6.1", "boxes that come one by one are those of their frame", basis=Basis.READING
)
def _bare(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.set(
        "pairing_timeout_ms", 10_000
    )  # nothing but the next number closes a frame, however slow the trajectory is
    later = _PERIOD_NS + conformance_scene.IMAGE_LATER_NS
    for box in (conformance_scene.box_2d(), conformance_scene.box_2d(2, later)):
        yield same(
            f"Send box_2d of image {box.image_seq}",
            "taken",
            _taken(peer, fusion_pb2.SendRequest(box_2d=box)),
        )
    for bare in (
        conformance_scene.box_3d(conformance_scene.MATCHED),
        conformance_scene.box_3d(conformance_scene.ALONE),
        conformance_scene.box_3d(conformance_scene.MATCHED, 2, _PERIOD_NS),
    ):
        request = fusion_pb2.SendRequest(box_3d=bare)
        yield same(f"Send box_3d of sweep {bare.points_seq}", "taken", _taken(peer, request))
    found = peer.result(DETECTIONS)
    ids = sorted(box.box_3d_id for box in found.detections if box.HasField("box_3d_id"))
    yield same("Get: boxes of sweep 1", [conformance_scene.MATCHED.id, conformance_scene.ALONE.id], ids)


def _taken(peer: Peer, request: fusion_pb2.SendRequest) -> str:
    return "taken" if peer.send(request) else "refused"


@_RECEIVING_CHECKS.clause(
    "5.6-7", "5.6.1", "the same number of a sensor again is refused", basis=Basis.READING
)
def _duplicate(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.send(conformance_scene.cloud(5))
    status = peer.send(conformance_scene.cloud(5, _PERIOD_NS))
    yield same("Send of clouds with seq 5 and 5: the second", "status 0", f"status {status}")


@_RECEIVING_CHECKS.clause(
    "5.6-8", "5.6.2", "seq is a uint32 that goes on from 4294967295 with 0, and comes back as it was sent"
)
def _wrap(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    numbers = [2**31 - 1, 2**31, 2**32 - 2, 2**32 - 1, 0, 1]
    for k, number in enumerate(numbers):
        peer.send(conformance_scene.image(number, k * _PERIOD_NS + conformance_scene.IMAGE_LATER_NS))
        peer.send(conformance_scene.cloud(number, k * _PERIOD_NS))
    found = [peer.result(SENSOR_DATA) for _ in numbers]
    yield same(f"pairs with seq {numbers}, Get: points_seq", numbers, [record.points_seq for record in found])
    yield same(f"pairs with seq {numbers}, Get: image_seq", numbers, [record.image_seq for record in found])


@_RECEIVING_CHECKS.clause("5.6-9", "5.6.1", "a sweep gets the image nearest in time", basis=Basis.READING)
def _nearest(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    for seq, offset_ns in ((1, -30_000_000), (2, 10_000_000), (3, 60_000_000)):
        peer.send(conformance_scene.image(seq, offset_ns))
    peer.send(conformance_scene.cloud(9))
    sent = "images 1, 2, 3 taken 30 ms before, 10 and 60 ms after a sweep, Get: image_seq"
    yield same(sent, 2, peer.result(SENSOR_DATA).image_seq)


@_RECEIVING_CHECKS.clause(
    "5.6-10", "5.6.1", "records that come late and out of order find their partners", basis=Basis.READING
)
def _out_of_order(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.send(conformance_scene.image(2, _PERIOD_NS))
    peer.send(conformance_scene.image(1, 0))
    peer.send(conformance_scene.cloud(1))
    peer.send(conformance_scene.cloud(2, _PERIOD_NS))
    found = [peer.result(SENSOR_DATA) for _ in range(2)]
    yield same(
        "images 2, 1, then sweeps 1, 2, Get: (points_seq, image_seq)",
        [(1, 1), (2, 2)],
        [(record.points_seq, record.image_seq) for record in found],
    )


@_RECEIVING_CHECKS.clause(
    "5.6-11", "5.6.1", "a record far older than its sensor's newest is refused", basis=Basis.READING
)
def _backwards(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.send(conformance_scene.cloud(1, 3_000_000_000))
    status = peer.send(conformance_scene.cloud(2, 0))
    yield same("Send of a sweep 3 s older than the one before", "status 0", f"status {status}")


@_RECEIVING_CHECKS.clause(
    "5.6-12", "5.6.3", "what is refused leaves no trace: the next pair is fused", basis=Basis.READING
)
def _no_trace(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.send(conformance_scene.image(1, width=1))
    peer.send(conformance_scene.cloud(1, number=1))
    peer.send(conformance_scene.image(1))
    peer.send(conformance_scene.cloud(1))
    record = peer.result(SENSOR_DATA)
    yield same(
        "faulty records with seq 1, then good ones with seq 1, Get",
        (1, 1),
        (record.points_seq, record.image_seq),
    )


_FETCHING_CHECKS = Catalogue("Fetching (clause 5.7)")

_FETCHING_PERIOD_NS = 100_000_000


def send_pairs(peer: Peer, numbers: range) -> None:
    """Send pairs of an image and a sweep, a period apart."""
    for k in numbers:
        peer.send(conformance_scene.image(k, k * _FETCHING_PERIOD_NS + conformance_scene.IMAGE_LATER_NS))
        peer.send(conformance_scene.cloud(k, k * _FETCHING_PERIOD_NS))


def _send_boxes(peer: Peer, numbers: range) -> None:
    for k in numbers:
        peer.send(conformance_scene.boxes_2d(k, k * _FETCHING_PERIOD_NS + conformance_scene.IMAGE_LATER_NS))
        peer.send(conformance_scene.boxes_3d(k, k * _FETCHING_PERIOD_NS))


@_FETCHING_CHECKS.clause("5.7-1", "5.7.1", "sensor data come fused as table 9 says, detections as table 10")
def _both(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    send_pairs(peer, range(1))
    _send_boxes(peer, range(1))
    for fusion_type, name in enumerate(RESULT_NAMES):
        yield same(f"Get fusion_type {fusion_type}", name, peer.fetch(fusion_type).WhichOneof("result"))


@_FETCHING_CHECKS.clause(
    "5.7-2",
    "5.7.2",
    "the fusion type is 0 or 1; without it, what the property fusion_type says",
    basis=Basis.READING,
)
def _type(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    send_pairs(peer, range(1))
    _send_boxes(peer, range(1))
    for fusion_type in (DETECTIONS, SENSOR_DATA):
        peer.set("fusion_type", fusion_type)
        found = peer.fetch(None).WhichOneof("result")
        yield same(
            f"SetProperty fusion_type {fusion_type}, Get without a type", RESULT_NAMES[fusion_type], found
        )
    try:
        found = f"an answer with {peer.fetch(2, wait_ms=0).WhichOneof('result')}"
    except CallFailedError:
        found = "an error"
    yield same("Get fusion_type 2", "an error", found)


@_FETCHING_CHECKS.clause(
    "5.7-3", "5.7.3", "results come first in, first out, of each type by itself", basis=Basis.READING
)
def _order(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    send_pairs(peer, range(5))
    _send_boxes(peer, range(5))
    numbers = list(range(5))
    for fusion_type in (DETECTIONS, SENSOR_DATA):
        found = [peer.result(fusion_type).points_seq for _ in numbers]
        yield same(f"pairs 0 to 4, Get fusion_type {fusion_type} five times: points_seq", numbers, found)


@_FETCHING_CHECKS.clause("5.7-4", "5.7.3", "each result is given once", basis=Basis.READING)
def _once(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    send_pairs(peer, range(2))
    found = sorted(peer.result(SENSOR_DATA).points_seq for _ in range(2))
    yield same("two pairs, Get twice: points_seq, sorted", [0, 1], found)
    yield same("Get a third time", "no_data", _held(peer, SENSOR_DATA, 0))


@_FETCHING_CHECKS.clause(
    "5.7-5", "5.7.3", "where there is no result, the answer says so, and is no error", basis=Basis.READING
)
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
