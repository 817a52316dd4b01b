"""Tables 4 to 8 row by row: what each field may be, and that what is none is refused."""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from sceneloom.fusion.messages.tables import TABLES
from sceneloom.fusion.messages.wire import fusion_pb2
from sceneloom.service.conformance import scene
from sceneloom.service.conformance.bench import Bench, Peer, reported
from sceneloom.service.conformance.catalogue import Basis, Catalogue, Look, Seen, near, same, true
from sceneloom.service.conformance.sensor_results import columns_of

CHECKS = Catalogue("What is sent (clauses 6.2 to 6.6, tables 4 to 8)")

_FLOATS = (float("nan"), float("inf"))
_TIMESTAMPS = (None, fusion_pb2.Timestamp(s=1, ns=10**9), fusion_pb2.Timestamp(s=1, ns=2**32 - 1))
"""No timestamp, and such whose nanoseconds make a second or more."""

RAW_SENSORS = (
    f'{{"{scene.CAMERA_ID}": {{"kind": "camera", "raw": "rgb8"}}, "{scene.LIDAR_ID}": {{"kind": "lidar"}}}}'
)
"""The property `sensors` for raw data that are pixels."""

_PIXELS = scene.drawn_image().tobytes()
_POINTS = scene.points_lidar()

Case = tuple[Any, Any]
"""Values of a field: taken, refused."""

_IMAGE_ROWS: Mapping[str, Case] = {
    "sensor_id": ((scene.CAMERA_ID,), (scene.CAMERA_ID + 256, 2**32 - 1)),
    "timestamp": ((scene.timestamp(), fusion_pb2.Timestamp(s=0, ns=0)), _TIMESTAMPS),
    "seq": ((0, 2**31, 2**32 - 1), ()),
    "height": ((scene.HEIGHT,), (0, scene.HEIGHT - 1, scene.HEIGHT + 1, 2**31)),
    "width": ((scene.WIDTH,), (0, scene.WIDTH - 1, scene.WIDTH + 1, 2**31)),
    "encoding": (("rgb8", "bgr8"), ("", "rgb", "rgba8")),
    "channel": ((3,), (0, 1, 4, 3 + 256)),
    "data": ((_PIXELS,), (b"", _PIXELS[:-1], _PIXELS + b"\0")),
}

_CLOUD_ROWS: Mapping[str, Case] = {
    "sensor_id": ((scene.LIDAR_ID,), (scene.LIDAR_ID + 256, 2**32 - 1)),
    "timestamp": ((scene.timestamp(), fusion_pb2.Timestamp(s=0, ns=0)), _TIMESTAMPS),
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

_RAW_ROWS: Mapping[str, Case] = {
    "sensor_id": ((scene.CAMERA_ID,), (scene.CAMERA_ID + 256, scene.CAMERA_ID + 1)),
    "timestamp": ((scene.timestamp(), fusion_pb2.Timestamp(s=0, ns=0)), _TIMESTAMPS),
    "seq": ((0, 2**31, 2**32 - 1), ()),
    "length": ((len(_PIXELS),), (0, len(_PIXELS) - 1, len(_PIXELS) + 1)),
    "data": ((_PIXELS,), (b"", _PIXELS[:-1])),
}

_LOCATION: Case = ((-100.0, 0.0), _FLOATS)
_SIZE: Case = ((0.25,), (0.0, -1.0, *_FLOATS))
_CONFIDENCE: Case = ((0.0, 1.0), (-0.125, 1.125, *_FLOATS))

_BOX_3D_ROWS: Mapping[str, Case] = {
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

_BOX_2D_ROWS: Mapping[str, Case] = {
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


def _image(changed: Mapping[str, Any]) -> fusion_pb2.SendRequest:
    return scene.image(**changed)


def _cloud(changed: Mapping[str, Any]) -> fusion_pb2.SendRequest:
    return scene.cloud(**changed)


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


_TABLES: Mapping[int, tuple[Mapping[str, Case], Callable[[Mapping[str, Any]], fusion_pb2.SendRequest]]] = {
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
        peer.set("sensors", RAW_SENSORS)
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
        CHECKS.row(
            _number,
            _name,
            f"{_name} of type {_row.type} is taken as it is, and refused where it is none",
            basis=_basis,
        )(_look(_number, _name))


@CHECKS.clause("6.2-1", "6.2", "raw data that are pixels are fused as an image is", basis=Basis.READING)
def _raw_pixels(bench: Bench) -> Iterator[Seen]:
    peer = _ready(bench, 4)
    peer.send(scene.raw(_PIXELS, offset_ns=scene.IMAGE_LATER_NS))
    peer.send(scene.cloud())
    record = peer.result(0)
    yield true(
        "Send of raw data and a cloud, Get: image_data",
        "the pixels that were sent",
        "the same" if record.image_data == _PIXELS else "others",
        agrees=record.image_data == _PIXELS,
    )


@CHECKS.clause(
    "6.3-1", "6.3", "an image in bgr8 gives the points the colours that it has in rgb8", basis=Basis.READING
)
def _blue_first(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    blue_first = scene.drawn_image()[:, :, ::-1].tobytes()
    peer.send(scene.image(encoding="bgr8", data=blue_first))
    peer.send(scene.cloud())
    found = columns_of(peer.result(0), ("r", "g", "b"))
    for k, point in enumerate(scene.SEEN):
        expected = [float(level) for level in scene.color_at(point)]
        yield same(f"the scene's image in bgr8, Get: r, g, b of point {k}", expected, found[k].tolist())


@CHECKS.clause("6.4-1", "6.4", "beam and ring are of mechanical lidars only")
def _solid_state(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    for name, request in (
        ("beam", scene.cloud(sensor_type=1, beam=1)),
        ("ring", scene.cloud(sensor_type=1, ring=1)),
    ):
        status = peer.send(request)
        yield same(f"Send sensor_type = 1, {name} = 1", "status 0", f"status {status}")


@CHECKS.clause(
    "6.4-2",
    "6.4",
    "points that are not finite, as drivers mark missing returns, are left out, and the others are fused",
    basis=Basis.READING,
)
def _missing_returns(bench: Bench) -> Iterator[Seen]:
    for missing in _FLOATS:
        peer = bench.ready()
        points = scene.points_lidar()
        points[1] = missing
        peer.send(scene.image())
        status = peer.send(scene.cloud(points=points))
        yield same(f"Send of a cloud whose point 1 is {missing}", "taken", "taken" if status else "refused")
        record = peer.result(0)
        yield same("Get: point_num", len(points) - 1, record.point_num)
        found = columns_of(record, ("x", "y", "z"))
        error = float(np.abs(found - np.delete(scene.points_lidar(), 1, axis=0)).max())
        yield near("Get: distance of the others from where they were sent [m]", 0.0, error, 1e-5)


@CHECKS.clause(
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
