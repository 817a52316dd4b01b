"""Clause 6.7, table 9: the fused sensor data of the kit's scene, against what closed forms say."""

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


@CHECKS.row(9, "image_data", "the picture's pixels, width * height * image_channel values in their order")
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
    equal = np.array_equal(pixels, scene.picture())
    yield true(f"{_SENT}: image_data", "the picture", "the picture" if equal else "another", agrees=equal)


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


@CHECKS.row(9, "point_fields", "names of what each point has, x, y and z among them")
def _point_fields(bench: Bench) -> Iterator[Seen]:
    names = list(bench.once(fused_pair).point_fields)
    yield true(f"{_SENT}: point_fields", "x, y, z among them", names, agrees={"x", "y", "z"} <= set(names))


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
    "4.1-3", "4.1", "points that the picture shows get its colours there (r, g, b)", basis=Basis.READING
)
def _colors(bench: Bench) -> Iterator[Seen]:
    record = bench.once(fused_pair)
    found = columns_of(record, ("r", "g", "b"))
    for k, point in enumerate(scene.SEEN):
        expected = [float(level) for level in scene.color_at(point)]
        yield same(f"{_SENT}: r, g, b of point {k}", expected, found[k].tolist())


CHECKS.checks.sort(key=lambda check: (not check.id.startswith("T9"), int(check.id.split("-")[1])))
