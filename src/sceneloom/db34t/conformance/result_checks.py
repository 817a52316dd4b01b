"""Checks of fusion results by closed forms: sensor data (clause 6.7, table 9) and detections (clause 6.8, table 10)."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from sceneloom.db34t.conformance import scene
from sceneloom.db34t.conformance.catalogue import (
    Bench,
    Catalogue,
    Check,
    Look,
    Seen,
    columns_of,
    depths,
    detection_of,
    filled,
    fused_boxes,
    fused_pair,
    near,
    same,
    true,
)

CHECKS = Catalogue()
_SENT = "the scene's pair, Get"

_EXPECTED: dict[str, Any] = {
    "class": "",
    "image_seq": 1,
    "points_seq": 1,
    "camera_id": scene.CAMERA_ID,
    "lidar_id": scene.LIDAR_ID,
    "height": scene.HEIGHT,
    "width": scene.WIDTH,
    "encoding": "rgb8",
    "image_channel": 3,
    "point_num": len(scene.SEEN) + len(scene.UNSEEN_CAMERA),
}  # fields that have one value


def _look(name: str) -> Look:
    def look(bench: Bench) -> Iterator[Seen]:
        yield same(f"{_SENT}: {name}", _EXPECTED[name], getattr(bench.once(fused_pair), name))

    return look


@CHECKS.row(9, "timestamp", "the sweep's time, exact to the nanosecond", reading=True)
def _timestamp(bench: Bench) -> Iterator[Seen]:
    found = bench.once(fused_pair).timestamp
    yield same(f"{_SENT}: timestamp (s, ns)", (scene.SECONDS, scene.NANOSECONDS), (found.s, found.ns))


for _name in _EXPECTED:
    CHECKS.row(9, _name, f"{_name} is that of the pair", reading=_name == "class")(_look(_name))


@CHECKS.row(9, "image_data", "the image's pixels, width * height * image_channel values in their order")
def _image_data(bench: Bench) -> Iterator[Seen]:
    record = bench.once(fused_pair)
    size = record.width * record.height * record.image_channel
    yield same(f"{_SENT}: values of image_data", size, len(record.image_data))
    found = np.frombuffer(record.image_data, np.uint8)[: scene.WIDTH * scene.HEIGHT * 3]
    pixels = found.reshape(scene.HEIGHT, scene.WIDTH, 3)
    for point in scene.SEEN:
        color = tuple(pixels[point.row, point.column].tolist())
        yield same(f"{_SENT}: image_data at column {point.column}, row {point.row}", scene.color_at(point), color)
    equal = np.array_equal(pixels, scene.drawn_image())
    yield true(f"{_SENT}: image_data", "the image", "the image" if equal else "another", agrees=equal)


@CHECKS.row(9, "image_depth", "how far from the camera what each pixel shows is, along the optical axis; 0 for nothing")
def _image_depth(bench: Bench) -> Iterator[Seen]:
    record = bench.once(fused_pair)
    yield same(f"{_SENT}: bytes of image_depth", 4 * record.width * record.height, len(record.image_depth))
    image = depths(record)
    for point in scene.SEEN:
        sent = f"{_SENT}: image_depth at column {point.column}, row {point.row}"
        yield near(sent, point.depth, float(image[point.row, point.column]), 1e-5 * point.depth)
    pixels = filled(record)
    near_points = [
        any(max(abs(column - p.column), abs(row - p.row)) <= 3 for p in scene.SEEN) for column, row in pixels
    ]
    yield true(f"{_SENT}: pixels with a depth", "none far from the points", pixels, agrees=all(near_points))


@CHECKS.row(9, "point_fields", "names of what each point has, x, y and z first, r, g and b last", reading=True)
def _point_fields(bench: Bench) -> Iterator[Seen]:
    names = list(bench.once(fused_pair).point_fields)
    yield same(f"{_SENT}: point_fields", [*"xyz", *"rgb"], names)


@CHECKS.row(9, "fields_number", "as many as there are names in point_fields")
def _fields_number(bench: Bench) -> Iterator[Seen]:
    record = bench.once(fused_pair)
    yield same(f"{_SENT}: fields_number", len(record.point_fields), record.fields_number)


@CHECKS.row(9, "point_data", "the points, one after the other, in the lidar's frame, where they were sent")
def _point_data(bench: Bench) -> Iterator[Seen]:
    record = bench.once(fused_pair)
    size = 4 * record.point_num * len(record.point_fields)
    yield same(f"{_SENT}: bytes of point_data", size, len(record.point_data))
    found = columns_of(record, ("x", "y", "z"))
    error = float(np.abs(found - scene.points_lidar()).max())
    yield near(f"{_SENT}: distance of points from where they were sent [m]", 0.0, error, 1e-5)


@CHECKS.clause("4.1-3", "4.1", "points that the image shows get its colours there (r, g, b)", reading=True)
def _colors(bench: Bench) -> Iterator[Seen]:
    record = bench.once(fused_pair)
    found = columns_of(record, ("r", "g", "b"))
    for k, point in enumerate(scene.SEEN):
        expected = [float(level) for level in scene.color_at(point)]
        yield same(f"{_SENT}: r, g, b of point {k}", expected, found[k].tolist())


@CHECKS.clause(
    "6.7-1",
    "6.7",
    "point_fields are x, y, z, then what else was sent in its order, then r, g, b, whatever the values are",
    reading=True,
)
def _layout(bench: Bench) -> Iterator[Seen]:
    sent = ("r", "reflectivity", "x", "g", "y", "echo", "b", "z")
    expected = ["x", "y", "z", "reflectivity", "echo", "r", "g", "b"]
    peer = bench.ready()
    for seq, (name, scale) in enumerate((("whole numbers", 40.0), ("fractions", 0.3), ("below 0", -0.7))):
        rows = np.full((len(scene.points_lidar()), len(sent)), scale, np.float32)
        rows[:, [sent.index(axis) for axis in "xyz"]] = scene.points_lidar()
        later = scene.PERIOD_NS * seq
        cloud = scene.cloud(seq + 1, later, rows, fields=sent, fields_number=len(sent))
        record = peer.fused(scene.image(seq + 1, scene.IMAGE_LATER_NS + later), cloud)
        yield same(f"points with {name}, Get: point_fields", expected, list(record.point_fields))
        kept = columns_of(record, ("reflectivity", "echo"))
        agrees = bool((kept == np.float32(scale)).all())
        reported = "as sent" if agrees else kept.tolist()
        yield true(f"points with {name}, Get: reflectivity, echo", "as sent", reported, agrees=agrees)
        found = columns_of(record, ("r", "g", "b"))
        colors = [[float(level) for level in scene.color_at(point)] for point in scene.SEEN]
        yield same(f"points with {name}, Get: r, g, b of those seen", colors, found[: len(colors)].tolist())


@CHECKS.clause("6.7-2", "6.7", "an image comes back as it was sent: encoding, channels and data", reading=True)
def _encodings(bench: Bench) -> Iterator[Seen]:
    red, green, blue = np.moveaxis(scene.drawn_image(), 2, 0)
    clear = np.full_like(red, 200)
    for encoding, channels in (
        ("mono8", (green,)),
        ("bgr8", (blue, green, red)),
        ("rgba8", (red, green, blue, clear)),
        ("bgra8", (blue, green, red, clear)),
    ):
        data = np.stack(channels, axis=2).tobytes()
        image = scene.image(encoding=encoding, channel=len(channels), data=data)
        record = bench.ready().fused(image, scene.cloud())
        stated = record.encoding, record.image_channel
        yield same(f"the scene's image in {encoding}, Get: encoding, image_channel", (encoding, len(channels)), stated)
        agrees = record.image_data == data
        found = "as sent" if agrees else "others"
        yield true(f"the scene's image in {encoding}, Get: image_data", "as sent", found, agrees=agrees)


@CHECKS.clause("6.7-3", "6.7", "points that the image does not show have r, g, b = 128, 128, 128", reading=True)
def _unseen(bench: Bench) -> Iterator[Seen]:
    found = columns_of(bench.once(fused_pair), ("r", "g", "b"))[len(scene.SEEN) :]
    yield same(f"{_SENT}: r, g, b of points not seen", [[128.0] * 3] * len(found), found.tolist())


_BOXES_SENT = "the scene's boxes, Get"
_BOXES = (scene.MATCHED, scene.ALONE)

_TOLERANCE = 1e-4  # what numbers of 32 bits lose on the way through another frame and back


@CHECKS.row(10, "id", "each detection of a pair has an id of its own")
def _id(bench: Bench) -> Iterator[Seen]:
    ids = [found.id for found in bench.once(fused_boxes).detections]
    yield true(f"{_BOXES_SENT}: ids", "different ones", ids, agrees=len(set(ids)) == len(ids))


@CHECKS.row(10, "confidence", "a probability, 0 to 1; two detectors that agree are no less sure than each alone")
def _confidence(bench: Bench) -> Iterator[Seen]:
    result = bench.once(fused_boxes)
    values = [found.confidence for found in result.detections]
    agrees = bool(values) and all(0 <= value <= 1 for value in values)
    yield true(f"{_BOXES_SENT}: confidences", "0 to 1", values, agrees=agrees)
    both = detection_of(result, scene.MATCHED).confidence
    yield true(f"{_BOXES_SENT}: confidence of what both saw with 0.75", "0.75 or more", both, agrees=both >= 0.75)


@CHECKS.row(10, "timestamp", "the sweep's time, exact to the nanosecond", reading=True)
def _time_of_detections(bench: Bench) -> Iterator[Seen]:
    for found in bench.once(fused_boxes).detections:
        stated = (found.timestamp.s, found.timestamp.ns)
        yield same(f"{_BOXES_SENT}: timestamp (s, ns)", (scene.SECONDS, scene.NANOSECONDS), stated)


@CHECKS.row(10, "class", "the class that both detectors state, and that of the one who saw it alone")
def _class(bench: Bench) -> Iterator[Seen]:
    result = bench.once(fused_boxes)
    for box in _BOXES:
        yield same(f"{_BOXES_SENT}: class of the {box.name}", box.name, getattr(detection_of(result, box), "class"))


_ROWS_OF_BOXES: Mapping[str, tuple[str, Callable[[scene.SentBox], Sequence[float]], int, float]] = {
    # what the image adds may move a middle within what its covariance allows, a few decimetres
    **{n: (f"{n} of the middle, in the lidar's frame", lambda box: box.center, k, 0.25) for k, n in enumerate("XYZ")},
    "length": ("the length of the box", lambda box: box.size_lwh, 0, 0.25),
    "width": ("the width of the box", lambda box: box.size_lwh, 1, 0.25),
    "height": ("the height of the box", lambda box: box.size_lwh, 2, 0.25),
    # rounding outwards and the pixel grid's two conventions differ by a pixel at most
    **{
        name: (f"{name} of the box in the image: of the 2D box, else of the projected 3D box", scene.outline, k, 1.0)
        for k, name in enumerate(("x1", "y1", "x2", "y2"))
    },
}  # by row of table 10: its title, the numbers of a box that was sent, which of them it is, and the tolerance


def _look_at_number(name: str) -> Look:
    _, numbers_of, k, tolerance = _ROWS_OF_BOXES[name]

    def look(bench: Bench) -> Iterator[Seen]:
        result = bench.once(fused_boxes)
        for box in _BOXES:
            found = getattr(detection_of(result, box), name)
            yield near(f"{_BOXES_SENT}: {name} of the {box.name}", numbers_of(box)[k], found, tolerance)

    return look


def _look_at_covariance(name: str) -> Look:
    def look(bench: Bench) -> Iterator[Seen]:
        result = bench.once(fused_boxes)
        for box in _BOXES:
            numbers = list(getattr(detection_of(result, box), name))
            yield same(f"{_BOXES_SENT}: numbers of {name}", 9, len(numbers))
            yield _is_covariance(f"{_BOXES_SENT}: {name} of the {box.name}", numbers)

    return look


def _is_covariance(sent: str, numbers: list[float]) -> Seen:
    matrix = np.array(numbers, np.float64).reshape(3, 3)
    scale = float(np.abs(matrix).max())
    fine = bool(np.isfinite(matrix).all()) and scale > 0
    fine = fine and float(np.abs(matrix - matrix.T).max()) <= _TOLERANCE * scale
    fine = fine and float(np.linalg.eigvalsh(matrix)[0]) >= -_TOLERANCE * scale
    return true(sent, "a symmetric matrix without negative variances", numbers, agrees=fine)


for _name, (_title, *_) in _ROWS_OF_BOXES.items():
    CHECKS.row(10, _name, _title)(_look_at_number(_name))

for _name in ("center_cov", "size_cov"):
    CHECKS.row(10, _name, "3x3 numbers of a covariance: symmetric, no variance below 0")(_look_at_covariance(_name))


@CHECKS.row(10, "direction", "heads where the box in space does, in the lidar's frame")
def _direction(bench: Bench) -> Iterator[Seen]:
    result = bench.once(fused_boxes)
    for box in _BOXES:
        found = np.array(detection_of(result, box).direction, np.float64)
        yield same(f"{_BOXES_SENT}: numbers of direction", 3, len(found))
        cosine = float(found @ box.direction / (np.linalg.norm(found) * np.linalg.norm(box.direction)))
        yield near(f"{_BOXES_SENT}: cosine between direction and that of the {box.name}", 1.0, cosine, _TOLERANCE)


@CHECKS.row(10, "velocity", "speed along the direction, negative for reversing", reading=True)
def _velocity(bench: Bench) -> Iterator[Seen]:
    result = bench.once(fused_boxes)
    for box in _BOXES:
        found = detection_of(result, box).velocity
        yield near(f"{_BOXES_SENT}: velocity of the {box.name}", box.velocity, found, _TOLERANCE * 10)


@CHECKS.clause("4.2-1", "4.2", "a box in space and the box that it makes in the image become one detection")
def _one(bench: Bench) -> Iterator[Seen]:
    found = [(box.X, box.Y, box.Z) for box in bench.once(fused_boxes).detections]
    count = sum(max(abs(a - b) for a, b in zip(c, scene.MATCHED.center, strict=True)) < 1.0 for c in found)
    yield same(f"{_BOXES_SENT}: detections where both detectors saw one", 1, count)
    yield same(f"{_BOXES_SENT}: detections", len(_BOXES), len(found))


@CHECKS.clause("4.2-2", "4.2", "what one detector alone saw is kept", reading=True)
def _alone(bench: Bench) -> Iterator[Seen]:
    detections = bench.ready().detected(scene.boxes_2d(boxes=[]), scene.boxes_3d()).detections
    yield same("two boxes in space, none in the image: detections", 2, len(detections))
    detections = bench.ready().detected(scene.boxes_2d(), scene.boxes_3d(boxes=[])).detections
    yield same("a box in the image, none in space: detections", 1, len(detections))


@CHECKS.clause(
    "6.8-1",
    "6.8",
    "of an object that the image does not show x1, y1, x2 and y2 are 0: its outline is empty",
    reading=True,
)
def _not_shown(bench: Bench) -> Iterator[Seen]:
    for location, X, Y in (("behind the camera", -16.0, 2.0), ("beside its view", 5.0, 60.0)):
        box = scene.boxes_3d(boxes=[scene.box_3d(scene.MATCHED, X=X, Y=Y)])
        found = bench.ready().detected(scene.boxes_2d(boxes=[]), box).detections
        corners = [(box.x1, box.y1, box.x2, box.y2) for box in found]
        yield same(f"a box {location}, Get: x1, y1, x2, y2", [(0, 0, 0, 0)], corners)


def _order(check: Check) -> tuple[bool, bool, int, str]:
    """Table 9 before table 10; of each its rows, then the clauses."""
    part, number = check.id.split("-")
    is_row = part.startswith("T")
    of_detections = part in ("T10", "4.2", "6.8")
    return of_detections, not is_row, int(number) if is_row else 0, check.id


CHECKS.checks.sort(key=_order)
