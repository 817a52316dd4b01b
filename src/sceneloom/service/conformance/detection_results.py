"""Clause 6.8, table 10: the fused detections of the kit's boxes."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from sceneloom.service.conformance import scene
from sceneloom.service.conformance.bench import Bench, detection_of, fused_boxes
from sceneloom.service.conformance.catalogue import Basis, Catalogue, Look, Seen, near, same, true

CHECKS = Catalogue("Fused detections (clause 6.8, table 10)")

_SENT = "the scene's boxes, Get"
_BOXES = (scene.MATCHED, scene.ALONE)
_TOLERANCE = 1e-4
"""What numbers of 32 bits lose on the way through another frame and back."""


@CHECKS.row(10, "id", "each detection of a pair has an id of its own")
def _id(bench: Bench) -> Iterator[Seen]:
    ids = [found.id for found in bench.once(fused_boxes).detections]
    yield true(f"{_SENT}: ids", "different ones", ids, agrees=len(set(ids)) == len(ids))


@CHECKS.row(
    10, "confidence", "a probability, 0 to 1; two detectors that agree are no less sure than each alone"
)
def _confidence(bench: Bench) -> Iterator[Seen]:
    result = bench.once(fused_boxes)
    values = [found.confidence for found in result.detections]
    agrees = bool(values) and all(0 <= value <= 1 for value in values)
    yield true(f"{_SENT}: confidences", "0 to 1", values, agrees=agrees)
    both = detection_of(result, scene.MATCHED).confidence
    yield true(f"{_SENT}: confidence of what both saw with 0.75", "0.75 or more", both, agrees=both >= 0.75)


@CHECKS.row(10, "timestamp", "the sweep's time, exact to the nanosecond", basis=Basis.READING)
def _timestamp(bench: Bench) -> Iterator[Seen]:
    for found in bench.once(fused_boxes).detections:
        stated = (found.timestamp.s, found.timestamp.ns)
        yield same(f"{_SENT}: timestamp (s, ns)", (scene.SECONDS, scene.NANOSECONDS), stated)


@CHECKS.row(10, "class", "the class that both detectors state, and that of the one who saw it alone")
def _class(bench: Bench) -> Iterator[Seen]:
    result = bench.once(fused_boxes)
    for box in _BOXES:
        yield same(f"{_SENT}: class of the {box.name}", box.name, getattr(detection_of(result, box), "class"))


def _location(name: str) -> Look:
    axis = "XYZ".index(name)

    def look(bench: Bench) -> Iterator[Seen]:
        result = bench.once(fused_boxes)
        for box in _BOXES:
            found = getattr(detection_of(result, box), name)
            # what the image adds may move a middle within what its covariance allows, a few decimetres
            yield near(f"{_SENT}: {name} of the {box.name}", box.center[axis], found, 0.25)

    return look


def _size(name: str) -> Look:
    axis = ("length", "width", "height").index(name)

    def look(bench: Bench) -> Iterator[Seen]:
        result = bench.once(fused_boxes)
        for box in _BOXES:
            found = getattr(detection_of(result, box), name)
            yield near(f"{_SENT}: {name} of the {box.name}", box.size_lwh[axis], found, 0.25)

    return look


def _covariance(name: str) -> Look:
    def look(bench: Bench) -> Iterator[Seen]:
        result = bench.once(fused_boxes)
        for box in _BOXES:
            numbers = list(getattr(detection_of(result, box), name))
            yield same(f"{_SENT}: numbers of {name}", 9, len(numbers))
            yield _is_covariance(f"{_SENT}: {name} of the {box.name}", numbers)

    return look


def _is_covariance(sent: str, numbers: list[float]) -> Seen:
    matrix = np.array(numbers, np.float64).reshape(3, 3)
    scale = float(np.abs(matrix).max())
    fine = bool(np.isfinite(matrix).all()) and scale > 0
    fine = fine and float(np.abs(matrix - matrix.T).max()) <= _TOLERANCE * scale
    fine = fine and float(np.linalg.eigvalsh(matrix)[0]) >= -_TOLERANCE * scale
    return true(sent, "a symmetric matrix without negative variances", numbers, agrees=fine)


for _name in "XYZ":
    CHECKS.row(10, _name, f"{_name} of the middle, in the lidar's frame")(_location(_name))
for _name in ("length", "width", "height"):
    CHECKS.row(10, _name, f"the {_name} of the box")(_size(_name))
for _name in ("center_cov", "size_cov"):
    CHECKS.row(10, _name, "3x3 numbers of a covariance: symmetric, no variance below 0")(_covariance(_name))


@CHECKS.row(10, "direction", "heads where the box in space does, in the lidar's frame")
def _direction(bench: Bench) -> Iterator[Seen]:
    result = bench.once(fused_boxes)
    for box in _BOXES:
        found = np.array(detection_of(result, box).direction, np.float64)
        yield same(f"{_SENT}: numbers of direction", 3, len(found))
        cosine = float(found @ box.direction / (np.linalg.norm(found) * np.linalg.norm(box.direction)))
        yield near(f"{_SENT}: cosine between direction and that of the {box.name}", 1.0, cosine, _TOLERANCE)


@CHECKS.row(10, "velocity", "speed along the direction, negative for reversing", basis=Basis.READING)
def _velocity(bench: Bench) -> Iterator[Seen]:
    result = bench.once(fused_boxes)
    for box in _BOXES:
        found = detection_of(result, box).velocity
        yield near(f"{_SENT}: velocity of the {box.name}", box.velocity, found, _TOLERANCE * 10)


def _corner(name: str) -> Look:
    k = ("x1", "y1", "x2", "y2").index(name)

    def look(bench: Bench) -> Iterator[Seen]:
        result = bench.once(fused_boxes)
        for box in _BOXES:
            found = getattr(detection_of(result, box), name)
            # rounding outwards and the pixel grid's two conventions differ by a pixel at most
            yield near(f"{_SENT}: {name} of the {box.name}", scene.outline(box)[k], found, 1.0)

    return look


for _name in ("x1", "y1", "x2", "y2"):
    CHECKS.row(10, _name, f"{_name} of the box in the image: of the 2D box, else of the projected 3D box")(
        _corner(_name)
    )


@CHECKS.clause("4.2-1", "4.2", "a box in space and the box that it makes in the image become one detection")
def _one(bench: Bench) -> Iterator[Seen]:
    found = [_center(box) for box in bench.once(fused_boxes).detections]
    count = sum(max(abs(a - b) for a, b in zip(c, scene.MATCHED.center, strict=True)) < 1.0 for c in found)
    yield same(f"{_SENT}: detections where both detectors saw one", 1, count)
    yield same(f"{_SENT}: detections", len(_BOXES), len(found))


def _center(found: Any) -> tuple[float, float, float]:
    return found.X, found.Y, found.Z


@CHECKS.clause("4.2-2", "4.2", "what one detector alone saw is kept", basis=Basis.READING)
def _alone(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.send(scene.boxes_2d(boxes=[]))
    peer.send(scene.boxes_3d())
    yield same("two boxes in space, none in the image: detections", 2, len(peer.result(1).detections))
    peer = bench.ready()
    peer.send(scene.boxes_2d())
    peer.send(scene.boxes_3d(boxes=[]))
    detections = peer.result(1).detections
    yield same("a box in the image, none in space: detections", 1, len(detections))


@CHECKS.clause(
    "6.8-1",
    "6.8",
    "of an object that the image does not show x1, y1, x2 and y2 are 0: its outline is empty",
    basis=Basis.READING,
)
def _not_shown(bench: Bench) -> Iterator[Seen]:
    for location, X, Y in (("behind the camera", -16.0, 2.0), ("beside its view", 5.0, 60.0)):
        peer = bench.ready()
        peer.send(scene.boxes_2d(boxes=[]))
        peer.send(scene.boxes_3d(boxes=[scene.box_3d(scene.MATCHED, X=X, Y=Y)]))
        found = peer.result(1).detections
        corners = [(box.x1, box.y1, box.x2, box.y2) for box in found]
        yield same(f"a box {location}, Get: x1, y1, x2, y2", [(0, 0, 0, 0)], corners)


_ROWS = "T10-"
CHECKS.checks.sort(
    key=lambda check: (
        (0, int(check.id.removeprefix(_ROWS)), "") if check.id.startswith(_ROWS) else (1, 0, check.id)
    )
)
