"""Clause 6.7, table 9: the fused sensor data of the kit's scene, against what closed forms state."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from sceneloom.service.conformance import scene
from sceneloom.service.conformance.bench import Bench, fused_pair
from sceneloom.service.conformance.calibration import depths, filled
from sceneloom.service.conformance.catalogue import Basis, Catalogue, Look, Seen, near, same, true

CHECKS = Catalogue("Fused sensor data (clause 6.7, table 9)")

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
}
"""Fields that have one value."""

_READINGS = {"class"}


def _look(name: str) -> Look:
    def look(bench: Bench) -> Iterator[Seen]:
        yield same(f"{_SENT}: {name}", _EXPECTED[name], getattr(bench.once(fused_pair), name))

    return look


@CHECKS.row(9, "timestamp", "the sweep's time, exact to the nanosecond", basis=Basis.READING)
def _timestamp(bench: Bench) -> Iterator[Seen]:
    found = bench.once(fused_pair).timestamp
    yield same(f"{_SENT}: timestamp (s, ns)", (scene.SECONDS, scene.NANOSECONDS), (found.s, found.ns))


for _name in _EXPECTED:
    _basis = Basis.READING if _name in _READINGS else Basis.TEXT
    CHECKS.row(9, _name, f"{_name} is that of the pair", basis=_basis)(_look(_name))


@CHECKS.row(9, "image_data", "the image's pixels, width * height * image_channel values in their order")
def _image_data(bench: Bench) -> Iterator[Seen]:
    record = bench.once(fused_pair)
    size = record.width * record.height * record.image_channel
    yield same(f"{_SENT}: values of image_data", size, len(record.image_data))
    found = np.frombuffer(record.image_data, np.uint8)[: scene.WIDTH * scene.HEIGHT * 3]
    pixels = found.reshape(scene.HEIGHT, scene.WIDTH, 3)
    for point in scene.SEEN:
        color = tuple(pixels[point.row, point.column].tolist())
        yield same(
            f"{_SENT}: image_data at column {point.column}, row {point.row}", scene.color_at(point), color
        )
    equal = np.array_equal(pixels, scene.drawn_image())
    yield true(f"{_SENT}: image_data", "the image", "the image" if equal else "another", agrees=equal)


@CHECKS.row(
    9,
    "image_depth",
    "how far from the camera what each pixel shows is, along the optical axis; 0 for nothing",
)
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


@CHECKS.row(
    9, "point_fields", "names of what each point has, x, y and z first, r, g and b last", basis=Basis.READING
)
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


def columns_of(record: Any, names: tuple[str, ...]) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Some fields of the points of a record of table 9, (N, F)."""
    fields = list(record.point_fields)
    rows = np.frombuffer(record.point_data, "<f4").reshape(-1, len(fields))
    return rows[:, [fields.index(name) for name in names]]


@CHECKS.clause(
    "4.1-3", "4.1", "points that the image shows get its colours there (r, g, b)", basis=Basis.READING
)
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
    basis=Basis.READING,
)
def _layout(bench: Bench) -> Iterator[Seen]:
    sent = ("r", "reflectivity", "x", "g", "y", "echo", "b", "z")
    expected = ["x", "y", "z", "reflectivity", "echo", "r", "g", "b"]
    peer = bench.ready()
    for seq, (name, scale) in enumerate((("whole numbers", 40.0), ("fractions", 0.3), ("below 0", -0.7))):
        rows = np.full((len(scene.points_lidar()), len(sent)), scale, np.float32)
        rows[:, [sent.index(axis) for axis in "xyz"]] = scene.points_lidar()
        later = 100_000_000 * seq
        peer.send(scene.image(seq + 1, scene.IMAGE_LATER_NS + later))
        peer.send(scene.cloud(seq + 1, later, rows, fields=sent, fields_number=len(sent)))
        record = peer.result(0)
        yield same(f"points with {name}, Get: point_fields", expected, list(record.point_fields))
        kept = columns_of(record, ("reflectivity", "echo"))
        agrees = bool((kept == np.float32(scale)).all())
        reported = "as sent" if agrees else kept.tolist()
        yield true(f"points with {name}, Get: reflectivity, echo", "as sent", reported, agrees=agrees)
        found = columns_of(record, ("r", "g", "b"))
        colors = [[float(level) for level in scene.color_at(point)] for point in scene.SEEN]
        yield same(f"points with {name}, Get: r, g, b of those seen", colors, found[: len(colors)].tolist())


@CHECKS.clause(
    "6.7-2", "6.7", "an image comes back as it was sent: encoding, channels and data", basis=Basis.READING
)
def _encodings(bench: Bench) -> Iterator[Seen]:
    red, green, blue = np.moveaxis(scene.drawn_image(), 2, 0)
    clear = np.full_like(red, 200)
    for encoding, channels in (
        ("mono8", (green,)),
        ("bgr8", (blue, green, red)),
        ("rgba8", (red, green, blue, clear)),
        ("bgra8", (blue, green, red, clear)),
    ):
        peer = bench.ready()
        data = np.stack(channels, axis=2).tobytes()
        peer.send(scene.image(encoding=encoding, channel=len(channels), data=data))
        peer.send(scene.cloud())
        record = peer.result(0)
        yield same(
            f"the scene's image in {encoding}, Get: encoding, image_channel",
            (encoding, len(channels)),
            (record.encoding, record.image_channel),
        )
        agrees = record.image_data == data
        found = "as sent" if agrees else "others"
        yield true(f"the scene's image in {encoding}, Get: image_data", "as sent", found, agrees=agrees)


@CHECKS.clause(
    "6.7-3", "6.7", "points that the image does not show have r, g, b = 128, 128, 128", basis=Basis.READING
)
def _unseen(bench: Bench) -> Iterator[Seen]:
    found = columns_of(bench.once(fused_pair), ("r", "g", "b"))[len(scene.SEEN) :]
    yield same(f"{_SENT}: r, g, b of points not seen", [[128.0] * 3] * len(found), found.tolist())


_ROWS = "T9-"
CHECKS.checks.sort(
    key=lambda check: (
        (0, int(check.id.removeprefix(_ROWS)), "") if check.id.startswith(_ROWS) else (1, 0, check.id)
    )
)
