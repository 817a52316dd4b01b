"""Checks of fusion results against closed forms: calibration (clause 6.1), coordinate frames (table 2).

Fused sensor data (clause 6.7, table 9) and fused detections (clause 6.8, table 10).
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from sceneloom.db34t.conformance import scene as conformance_scene
from sceneloom.db34t.conformance.catalogue import (
    DETECTIONS,
    SENSOR_DATA,
    Basis,
    Bench,
    Catalogue,
    Look,
    Peer,
    Seen,
    detection_of,
    fused_boxes,
    fused_pair,
    near,
    same,
    true,
)

_CHECKS = Catalogue("Calibration (clause 6.1, table 3)")


def depths(record: Any) -> np.ndarray[Any, np.dtype[np.float32]]:
    """The depth image of a record of table 9, (H, W)."""
    return np.frombuffer(record.image_depth, "<f4").reshape(record.height, record.width)


def filled(record: Any) -> list[tuple[int, int]]:
    """Column and row of the pixels that have a depth."""
    rows, columns = np.nonzero(depths(record))
    return sorted(zip(columns.tolist(), rows.tolist(), strict=True))


def _pixels(peer: Peer, request: Any = None) -> list[tuple[int, int]]:
    peer.send(conformance_scene.image())
    peer.send(conformance_scene.cloud() if request is None else request)
    return filled(peer.result(SENSOR_DATA))


_EXPECTED = sorted((point.column, point.row) for point in conformance_scene.SEEN)


def _refused(bench: Bench, *cases: dict[str, Any]) -> Iterator[Seen]:
    for changed in cases:
        name, value = next(iter(changed.items()))
        yield same(
            f"SetCalibration {name} = {list(value) if isinstance(value, tuple) else value}",
            "status 0",
            f"status {bench.peer().calibrate(**changed)}",
        )


@_CHECKS.row(
    3, "image_size", "two whole numbers above 0: width, height; an image of another size does not fit"
)
def _image_size(bench: Bench) -> Iterator[Seen]:
    yield from _refused(
        bench, {"image_size": ()}, {"image_size": (64,)}, {"image_size": (0, 48)}, {"image_size": (64, 48, 3)}
    )
    peer = bench.peer()
    peer.calibrate(image_size=(conformance_scene.HEIGHT, conformance_scene.WIDTH))
    status = peer.send(conformance_scene.image())
    yield same("Send of an image 64 x 48 after image_size (48, 64)", "status 0", f"status {status}")


@_CHECKS.row(3, "distortion_coeffs", "k1 k2 p1 p2 k3 of the pinhole model; all 0 where they are left out")
def _distortion(bench: Bench) -> Iterator[Seen]:
    yield from _refused(bench, {"distortion_coeffs": (0.1,) * 4}, {"distortion_coeffs": (0.1,) * 6})
    peer = bench.peer()
    peer.calibrate(distortion_coeffs=())
    yield same("a pair after a calibration without coefficients: pixels", _EXPECTED, _pixels(peer))
    coefficients = (-0.25, 0.125, 0.0625, -0.09375, 0.5)
    point = (0.375, -0.25)
    column, row = (round(number) for number in _distorted(point, coefficients))
    peer = bench.peer()
    peer.calibrate(distortion_coeffs=coefficients)
    cloud = conformance_scene.lidar_from_camera(np.array([[8.0 * point[0], 8.0 * point[1], 8.0]])).astype(
        np.float32
    )
    found = _pixels(peer, conformance_scene.cloud(points=cloud))
    yield same(
        f"a point at (x, y) / z = {point} after k1 k2 p1 p2 k3 = {coefficients}", [(column, row)], found
    )


def _distorted(point: tuple[float, float], coefficients: tuple[float, ...]) -> tuple[float, float]:
    """Where the pinhole model with distortion has a point [px].

    Source: Brown 1971, "Close-range camera calibration", with p1 and p2 as OpenCV has them.
    """
    (x, y), (k1, k2, p1, p2, k3) = point, coefficients
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return conformance_scene.FOCAL * u + conformance_scene.MIDDLE[
        0
    ], conformance_scene.FOCAL * v + conformance_scene.MIDDLE[1]


@_CHECKS.row(
    3, "intrinsic_matrix", "3x3, row after row: focal lengths and middle state which pixel a ray meets"
)
def _intrinsic(bench: Bench) -> Iterator[Seen]:
    f, (cx, cy) = conformance_scene.FOCAL, conformance_scene.MIDDLE
    yield from _refused(
        bench,
        {"intrinsic_matrix": (f, 0, cx, 0, f, cy, 0, 0)},
        {"intrinsic_matrix": (0, 0, cx, 0, f, cy, 0, 0, 1)},
        {"intrinsic_matrix": (f, 0, 0, 0, f, 0, cx, cy, 1)},
    )
    peer = bench.peer()
    peer.calibrate(intrinsic_matrix=(32.0, 0, 30.0, 0, 44.8, 22.0, 0, 0, 1))
    x, y, z = conformance_scene.depth_of_pixel(conformance_scene.SEEN[0])
    expected = [(round(32.0 * x / z + 30.0), round(44.8 * y / z + 22.0))]
    cloud = conformance_scene.cloud(points=conformance_scene.points_lidar()[:1])
    yield same("a point after fx 32, cx 30, fy 44.8, cy 22: pixel", expected, _pixels(peer, cloud))


@_CHECKS.row(
    3,
    "reference_frame",
    "0: the matrix leads into the camera's frame, 1: into the lidar's",
    basis=Basis.READING,
)
def _reference_frame(bench: Bench) -> Iterator[Seen]:
    yield from _refused(bench, {"reference_frame": 2})
    inverse = np.linalg.inv(conformance_scene.CAMERA_FROM_LIDAR)
    for frame, matrix in ((0, conformance_scene.CAMERA_FROM_LIDAR), (1, inverse)):
        peer = bench.peer()
        peer.calibrate(reference_frame=frame, extrinsic_matrix=conformance_scene.by_columns(matrix))
        yield same(f"a pair after reference_frame {frame}: pixels", _EXPECTED, _pixels(peer))


@_CHECKS.row(
    3,
    "extrinsic_matrix",
    "16 numbers of a rigid transform, the translation last as in the example, or in the last column",
    basis=Basis.READING,
)
def _extrinsic(bench: Bench) -> Iterator[Seen]:
    good = conformance_scene.by_columns(conformance_scene.CAMERA_FROM_LIDAR)
    yield from _refused(
        bench,
        {"extrinsic_matrix": good[:15]},
        {"extrinsic_matrix": [2 * number for number in good[:15]] + [1.0]},
        {"extrinsic_matrix": [float("nan"), *good[1:]]},
        {"extrinsic_matrix": [*good[:15], 2.0]},
    )
    layouts = {"columns": good, "rows": conformance_scene.by_rows(conformance_scene.CAMERA_FROM_LIDAR)}
    for layout, numbers in layouts.items():
        peer = bench.peer()
        peer.calibrate(extrinsic_matrix=numbers)
        yield same(f"a pair after the matrix by {layout}: pixels", _EXPECTED, _pixels(peer))


@_CHECKS.clause(
    "4.1-1", "4.1", "the standard's own example of a calibration is taken, and points lie where it says"
)
def _example(bench: Bench) -> Iterator[Seen]:
    matrix = (468.3708, 0.0, 339.7596, 0.0, 470.2517, 235.6143, 0.0, 0.0, 1.0)
    rotation = np.array([[0.0070, -0.9999, 0.0016], [1e-06, -0.0016, -0.9999], [0.9999, 0.0070, -1e-06]])
    translation = np.array([-0.0062, 0.0756, 0.0337])
    numbers = [*rotation[:, 0], 0, *rotation[:, 1], 0, *rotation[:, 2], 0, *translation, 1]
    peer = bench.peer()
    status = peer.calibrate(
        image_size=(640, 480),
        intrinsic_matrix=matrix,
        extrinsic_matrix=numbers,
        distortion_coeffs=(-0.3995, 0.1803, 0, 0, 0.0429),
    )
    yield same("SetCalibration as in the examples of table 3", "taken", "taken" if status else "refused")
    point = np.array([8.0, 0.0, 0.0], np.float32)
    x, y, z = rotation @ point + translation
    # so near the middle of the image the distortion is below a hundredth of a pixel
    expected = [(round(matrix[0] * x / z + matrix[2]), round(matrix[4] * y / z + matrix[5]))]
    pixels = np.zeros((480, 640, 3), np.uint8)
    peer.send(conformance_scene.image(height=480, width=640, data=pixels.tobytes()))
    peer.send(conformance_scene.cloud(points=point[None]))
    yield same("a point 8 m ahead: pixel", expected, filled(peer.result(SENSOR_DATA)))


@_CHECKS.clause(
    "4.1-2", "4.1", "a calibration that is replaced counts for the frames after it", basis=Basis.READING
)
def _replaced(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    first = _pixels(peer)
    peer.calibrate(intrinsic_matrix=(64.0, 0, 34.0, 0, 64.0, 25.0, 0, 0, 1))
    later = 100_000_000
    peer.send(conformance_scene.image(2, later + conformance_scene.IMAGE_LATER_NS))
    peer.send(conformance_scene.cloud(2, later))
    moved = sorted((column + 2, row + 1) for column, row in _EXPECTED)
    yield same("a pair, a middle 2 px right and 1 px down, a pair: pixels of the first", _EXPECTED, first)
    yield same("pixels of the second", moved, filled(peer.result(SENSOR_DATA)))


_SENSOR_RESULTS_CHECKS = Catalogue("Fused sensor data (clause 6.7, table 9)")

_SENT = "the scene's pair, Get"

_SENSOR_RESULTS_EXPECTED: dict[str, Any] = {
    "class": "",
    "image_seq": 1,
    "points_seq": 1,
    "camera_id": conformance_scene.CAMERA_ID,
    "lidar_id": conformance_scene.LIDAR_ID,
    "height": conformance_scene.HEIGHT,
    "width": conformance_scene.WIDTH,
    "encoding": "rgb8",
    "image_channel": 3,
    "point_num": len(conformance_scene.SEEN) + len(conformance_scene.UNSEEN_CAMERA),
}
"""Fields that have one value."""

_READINGS = {"class"}


def _look(name: str) -> Look:
    def look(bench: Bench) -> Iterator[Seen]:
        yield same(f"{_SENT}: {name}", _SENSOR_RESULTS_EXPECTED[name], getattr(bench.once(fused_pair), name))

    return look


@_SENSOR_RESULTS_CHECKS.row(9, "timestamp", "the sweep's time, exact to the nanosecond", basis=Basis.READING)
def _timestamp(bench: Bench) -> Iterator[Seen]:
    found = bench.once(fused_pair).timestamp
    yield same(
        f"{_SENT}: timestamp (s, ns)",
        (conformance_scene.SECONDS, conformance_scene.NANOSECONDS),
        (found.s, found.ns),
    )


for _name in _SENSOR_RESULTS_EXPECTED:
    _basis = Basis.READING if _name in _READINGS else Basis.TEXT
    _SENSOR_RESULTS_CHECKS.row(9, _name, f"{_name} is that of the pair", basis=_basis)(_look(_name))


@_SENSOR_RESULTS_CHECKS.row(
    9, "image_data", "the image's pixels, width * height * image_channel values in their order"
)
def _image_data(bench: Bench) -> Iterator[Seen]:
    record = bench.once(fused_pair)
    size = record.width * record.height * record.image_channel
    yield same(f"{_SENT}: values of image_data", size, len(record.image_data))
    found = np.frombuffer(record.image_data, np.uint8)[
        : conformance_scene.WIDTH * conformance_scene.HEIGHT * 3
    ]
    pixels = found.reshape(conformance_scene.HEIGHT, conformance_scene.WIDTH, 3)
    for point in conformance_scene.SEEN:
        color = tuple(pixels[point.row, point.column].tolist())
        yield same(
            f"{_SENT}: image_data at column {point.column}, row {point.row}",
            conformance_scene.color_at(point),
            color,
        )
    equal = np.array_equal(pixels, conformance_scene.drawn_image())
    yield true(f"{_SENT}: image_data", "the image", "the image" if equal else "another", agrees=equal)


@_SENSOR_RESULTS_CHECKS.row(
    9,
    "image_depth",
    "how far from the camera what each pixel shows is, along the optical axis; 0 for nothing",
)
def _image_depth(bench: Bench) -> Iterator[Seen]:
    record = bench.once(fused_pair)
    yield same(f"{_SENT}: bytes of image_depth", 4 * record.width * record.height, len(record.image_depth))
    image = depths(record)
    for point in conformance_scene.SEEN:
        sent = f"{_SENT}: image_depth at column {point.column}, row {point.row}"
        yield near(sent, point.depth, float(image[point.row, point.column]), 1e-5 * point.depth)
    pixels = filled(record)
    near_points = [
        any(max(abs(column - p.column), abs(row - p.row)) <= 3 for p in conformance_scene.SEEN)
        for column, row in pixels
    ]
    yield true(f"{_SENT}: pixels with a depth", "none far from the points", pixels, agrees=all(near_points))


@_SENSOR_RESULTS_CHECKS.row(
    9, "point_fields", "names of what each point has, x, y and z first, r, g and b last", basis=Basis.READING
)
def _point_fields(bench: Bench) -> Iterator[Seen]:
    names = list(bench.once(fused_pair).point_fields)
    yield same(f"{_SENT}: point_fields", [*"xyz", *"rgb"], names)


@_SENSOR_RESULTS_CHECKS.row(9, "fields_number", "as many as there are names in point_fields")
def _fields_number(bench: Bench) -> Iterator[Seen]:
    record = bench.once(fused_pair)
    yield same(f"{_SENT}: fields_number", len(record.point_fields), record.fields_number)


@_SENSOR_RESULTS_CHECKS.row(
    9, "point_data", "the points, one after the other, in the lidar's frame, where they were sent"
)
def _point_data(bench: Bench) -> Iterator[Seen]:
    record = bench.once(fused_pair)
    size = 4 * record.point_num * len(record.point_fields)
    yield same(f"{_SENT}: bytes of point_data", size, len(record.point_data))
    found = columns_of(record, ("x", "y", "z"))
    error = float(np.abs(found - conformance_scene.points_lidar()).max())
    yield near(f"{_SENT}: distance of points from where they were sent [m]", 0.0, error, 1e-5)


def columns_of(record: Any, names: tuple[str, ...]) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Some fields of the points of a record of table 9, (N, F)."""
    fields = list(record.point_fields)
    rows = np.frombuffer(record.point_data, "<f4").reshape(-1, len(fields))
    return rows[:, [fields.index(name) for name in names]]


@_SENSOR_RESULTS_CHECKS.clause(
    "4.1-3", "4.1", "points that the image shows get its colours there (r, g, b)", basis=Basis.READING
)
def _colors(bench: Bench) -> Iterator[Seen]:
    record = bench.once(fused_pair)
    found = columns_of(record, ("r", "g", "b"))
    for k, point in enumerate(conformance_scene.SEEN):
        expected = [float(level) for level in conformance_scene.color_at(point)]
        yield same(f"{_SENT}: r, g, b of point {k}", expected, found[k].tolist())


@_SENSOR_RESULTS_CHECKS.clause(
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
        rows = np.full((len(conformance_scene.points_lidar()), len(sent)), scale, np.float32)
        rows[:, [sent.index(axis) for axis in "xyz"]] = conformance_scene.points_lidar()
        later = 100_000_000 * seq
        peer.send(conformance_scene.image(seq + 1, conformance_scene.IMAGE_LATER_NS + later))
        peer.send(conformance_scene.cloud(seq + 1, later, rows, fields=sent, fields_number=len(sent)))
        record = peer.result(0)
        yield same(f"points with {name}, Get: point_fields", expected, list(record.point_fields))
        kept = columns_of(record, ("reflectivity", "echo"))
        agrees = bool((kept == np.float32(scale)).all())
        reported = "as sent" if agrees else kept.tolist()
        yield true(f"points with {name}, Get: reflectivity, echo", "as sent", reported, agrees=agrees)
        found = columns_of(record, ("r", "g", "b"))
        colors = [
            [float(level) for level in conformance_scene.color_at(point)] for point in conformance_scene.SEEN
        ]
        yield same(f"points with {name}, Get: r, g, b of those seen", colors, found[: len(colors)].tolist())


@_SENSOR_RESULTS_CHECKS.clause(
    "6.7-2", "6.7", "an image comes back as it was sent: encoding, channels and data", basis=Basis.READING
)
def _encodings(bench: Bench) -> Iterator[Seen]:
    red, green, blue = np.moveaxis(conformance_scene.drawn_image(), 2, 0)
    clear = np.full_like(red, 200)
    for encoding, channels in (
        ("mono8", (green,)),
        ("bgr8", (blue, green, red)),
        ("rgba8", (red, green, blue, clear)),
        ("bgra8", (blue, green, red, clear)),
    ):
        peer = bench.ready()
        data = np.stack(channels, axis=2).tobytes()
        peer.send(conformance_scene.image(encoding=encoding, channel=len(channels), data=data))
        peer.send(conformance_scene.cloud())
        record = peer.result(0)
        yield same(
            f"the scene's image in {encoding}, Get: encoding, image_channel",
            (encoding, len(channels)),
            (record.encoding, record.image_channel),
        )
        agrees = record.image_data == data
        found = "as sent" if agrees else "others"
        yield true(f"the scene's image in {encoding}, Get: image_data", "as sent", found, agrees=agrees)


@_SENSOR_RESULTS_CHECKS.clause(
    "6.7-3", "6.7", "points that the image does not show have r, g, b = 128, 128, 128", basis=Basis.READING
)
def _unseen(bench: Bench) -> Iterator[Seen]:
    found = columns_of(bench.once(fused_pair), ("r", "g", "b"))[len(conformance_scene.SEEN) :]
    yield same(f"{_SENT}: r, g, b of points not seen", [[128.0] * 3] * len(found), found.tolist())


_ROWS = "T9-"

_SENSOR_RESULTS_CHECKS.checks.sort(
    key=lambda check: (
        (0, int(check.id.removeprefix(_ROWS)), "") if check.id.startswith(_ROWS) else (1, 0, check.id)
    )
)

_FRAMES_CHECKS = Catalogue("Reference frames (table 2, rows 2 to 4)")

_STANDARD_CAMERA, _STANDARD_LIDAR = [2, 0, -1], [0, -1, 2]


def _square(rows: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    matrix = np.eye(4)
    matrix[:3, :3] = rows
    return matrix


_ROTATED_LIDAR = _square([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
"""Of a lidar with y forward, x right, z up: takes points out of x forward, y left, z up."""

_MIRRORED_LIDAR = _square([[1, 0, 0], [0, -1, 0], [0, 0, 1]])
"""Of a left-handed lidar with x forward, y right, z up."""

_MIRRORED_CAMERA = _square([[1, 0, 0], [0, -1, 0], [0, 0, 1]])
"""Of a left-handed camera with x right, y up, z forward."""

_ROTATED_CAMERA = _square([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Of a camera with x forward, y left, z up."""


def _frames_look(
    bench: Bench, properties: dict[str, Any], camera: np.ndarray[Any, Any], lidar: np.ndarray[Any, Any]
) -> Iterator[Seen]:
    peer = bench.peer()
    for name, value in properties.items():
        peer.set(name, value)
    matrix = camera @ conformance_scene.CAMERA_FROM_LIDAR @ lidar.T
    peer.calibrate(extrinsic_matrix=conformance_scene.by_columns(matrix))
    points = (conformance_scene.points_lidar() @ lidar[:3, :3].T).astype(np.float32)
    peer.send(conformance_scene.image())
    peer.send(conformance_scene.cloud(points=points))
    record = peer.result(SENSOR_DATA)
    sent = ", ".join(f"{name} {value}" for name, value in properties.items())
    yield same(f"{sent}, a pair, Get: pixels with a depth", _EXPECTED, filled(record))
    error = float(np.abs(columns_of(record, ("x", "y", "z")) - points).max())
    yield near(f"{sent}: distance of points from where they were sent [m]", 0.0, error, 1e-5)
    yield from _boxes(peer, sent, lidar)


def _boxes(peer: Peer, sent: str, lidar: np.ndarray[Any, Any]) -> Iterator[Seen]:
    """The box that both detectors see, sent in the declared frame, comes back in it."""
    center = lidar[:3, :3] @ conformance_scene.MATCHED.center
    direction = lidar[:3, :3] @ conformance_scene.MATCHED.direction
    box = conformance_scene.MATCHED._replace(
        center=tuple(center.tolist()), direction=tuple(direction.tolist())
    )
    peer.send(conformance_scene.boxes_2d())
    peer.send(conformance_scene.boxes_3d(boxes=[conformance_scene.box_3d(box)]))
    detections = peer.result(DETECTIONS).detections
    yield same(f"{sent}, a box in space and in the image: detections", 1, len(detections))
    found = detections[0]
    error = float(np.abs(np.array([found.X, found.Y, found.Z]) - center).max())
    yield near(f"{sent}: distance of its middle from where it was sent [m]", 0.0, error, 0.25)
    cosine = float(np.array(found.direction) @ direction / np.linalg.norm(direction))
    yield near(
        f"{sent}: cosine of its direction to what was sent",
        1.0,
        cosine / float(np.linalg.norm(found.direction)),
        1e-4,
    )


@_FRAMES_CHECKS.clause(
    "5.2-1",
    "5.2",
    "chirality 1: data of left-handed frames are fused, and come back in them",
    basis=Basis.READING,
)
def _chirality(bench: Bench) -> Iterator[Seen]:
    properties = {"chirality": 1, "lidar_coordinate": [0, 1, 2], "camera_coordinate": [2, 0, 1]}
    yield from _frames_look(bench, properties, _MIRRORED_CAMERA, _MIRRORED_LIDAR)


@_FRAMES_CHECKS.clause(
    "5.2-2", "5.2", "camera_coordinate: a camera whose x points forward", basis=Basis.READING
)
def _camera(bench: Bench) -> Iterator[Seen]:
    properties = {"camera_coordinate": [0, -1, 2], "lidar_coordinate": _STANDARD_LIDAR}
    yield from _frames_look(bench, properties, _ROTATED_CAMERA, np.eye(4))


@_FRAMES_CHECKS.clause(
    "5.2-3", "5.2", "lidar_coordinate: a lidar whose y points forward", basis=Basis.READING
)
def _lidar(bench: Bench) -> Iterator[Seen]:
    properties = {"camera_coordinate": _STANDARD_CAMERA, "lidar_coordinate": [1, 0, 2]}
    yield from _frames_look(bench, properties, np.eye(4), _ROTATED_LIDAR)


@_FRAMES_CHECKS.clause(
    "5.2-4",
    "5.2",
    "a matrix that mirrors between frames of one handedness is refused with the first data",
    basis=Basis.READING,
)
def _mirrored(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    peer.calibrate(
        extrinsic_matrix=conformance_scene.by_columns(conformance_scene.CAMERA_FROM_LIDAR @ _MIRRORED_LIDAR)
    )
    status = peer.send(conformance_scene.cloud())
    yield same("SetCalibration with a mirroring matrix, Send of a cloud", "status 0", f"status {status}")


_DETECTION_RESULTS_CHECKS = Catalogue("Fused detections (clause 6.8, table 10)")

_DETECTION_RESULTS_SENT = "the scene's boxes, Get"

_BOXES = (conformance_scene.MATCHED, conformance_scene.ALONE)

_TOLERANCE = 1e-4
"""What numbers of 32 bits lose on the way through another frame and back."""


@_DETECTION_RESULTS_CHECKS.row(10, "id", "each detection of a pair has an id of its own")
def _id(bench: Bench) -> Iterator[Seen]:
    ids = [found.id for found in bench.once(fused_boxes).detections]
    yield true(f"{_DETECTION_RESULTS_SENT}: ids", "different ones", ids, agrees=len(set(ids)) == len(ids))


@_DETECTION_RESULTS_CHECKS.row(
    10, "confidence", "a probability, 0 to 1; two detectors that agree are no less sure than each alone"
)
def _confidence(bench: Bench) -> Iterator[Seen]:
    result = bench.once(fused_boxes)
    values = [found.confidence for found in result.detections]
    agrees = bool(values) and all(0 <= value <= 1 for value in values)
    yield true(f"{_DETECTION_RESULTS_SENT}: confidences", "0 to 1", values, agrees=agrees)
    both = detection_of(result, conformance_scene.MATCHED).confidence
    yield true(
        f"{_DETECTION_RESULTS_SENT}: confidence of what both saw with 0.75",
        "0.75 or more",
        both,
        agrees=both >= 0.75,
    )


@_DETECTION_RESULTS_CHECKS.row(
    10, "timestamp", "the sweep's time, exact to the nanosecond", basis=Basis.READING
)
def _detection_results_timestamp(bench: Bench) -> Iterator[Seen]:
    for found in bench.once(fused_boxes).detections:
        stated = (found.timestamp.s, found.timestamp.ns)
        yield same(
            f"{_DETECTION_RESULTS_SENT}: timestamp (s, ns)",
            (conformance_scene.SECONDS, conformance_scene.NANOSECONDS),
            stated,
        )


@_DETECTION_RESULTS_CHECKS.row(
    10, "class", "the class that both detectors state, and that of the one who saw it alone"
)
def _class(bench: Bench) -> Iterator[Seen]:
    result = bench.once(fused_boxes)
    for box in _BOXES:
        yield same(
            f"{_DETECTION_RESULTS_SENT}: class of the {box.name}",
            box.name,
            getattr(detection_of(result, box), "class"),
        )


def _location(name: str) -> Look:
    axis = "XYZ".index(name)

    def look(bench: Bench) -> Iterator[Seen]:
        result = bench.once(fused_boxes)
        for box in _BOXES:
            found = getattr(detection_of(result, box), name)
            # what the image adds may move a middle within what its covariance allows, a few decimetres
            yield near(f"{_DETECTION_RESULTS_SENT}: {name} of the {box.name}", box.center[axis], found, 0.25)

    return look


def _size(name: str) -> Look:
    axis = ("length", "width", "height").index(name)

    def look(bench: Bench) -> Iterator[Seen]:
        result = bench.once(fused_boxes)
        for box in _BOXES:
            found = getattr(detection_of(result, box), name)
            yield near(
                f"{_DETECTION_RESULTS_SENT}: {name} of the {box.name}", box.size_lwh[axis], found, 0.25
            )

    return look


def _covariance(name: str) -> Look:
    def look(bench: Bench) -> Iterator[Seen]:
        result = bench.once(fused_boxes)
        for box in _BOXES:
            numbers = list(getattr(detection_of(result, box), name))
            yield same(f"{_DETECTION_RESULTS_SENT}: numbers of {name}", 9, len(numbers))
            yield _is_covariance(f"{_DETECTION_RESULTS_SENT}: {name} of the {box.name}", numbers)

    return look


def _is_covariance(sent: str, numbers: list[float]) -> Seen:
    matrix = np.array(numbers, np.float64).reshape(3, 3)
    scale = float(np.abs(matrix).max())
    fine = bool(np.isfinite(matrix).all()) and scale > 0
    fine = fine and float(np.abs(matrix - matrix.T).max()) <= _TOLERANCE * scale
    fine = fine and float(np.linalg.eigvalsh(matrix)[0]) >= -_TOLERANCE * scale
    return true(sent, "a symmetric matrix without negative variances", numbers, agrees=fine)


for _detection_results_name in "XYZ":
    _DETECTION_RESULTS_CHECKS.row(
        10, _detection_results_name, f"{_detection_results_name} of the middle, in the lidar's frame"
    )(_location(_detection_results_name))

for _detection_results_name in ("length", "width", "height"):
    _DETECTION_RESULTS_CHECKS.row(10, _detection_results_name, f"the {_detection_results_name} of the box")(
        _size(_detection_results_name)
    )

for _detection_results_name in ("center_cov", "size_cov"):
    _DETECTION_RESULTS_CHECKS.row(
        10, _detection_results_name, "3x3 numbers of a covariance: symmetric, no variance below 0"
    )(_covariance(_detection_results_name))


@_DETECTION_RESULTS_CHECKS.row(10, "direction", "heads where the box in space does, in the lidar's frame")
def _direction(bench: Bench) -> Iterator[Seen]:
    result = bench.once(fused_boxes)
    for box in _BOXES:
        found = np.array(detection_of(result, box).direction, np.float64)
        yield same(f"{_DETECTION_RESULTS_SENT}: numbers of direction", 3, len(found))
        cosine = float(found @ box.direction / (np.linalg.norm(found) * np.linalg.norm(box.direction)))
        yield near(
            f"{_DETECTION_RESULTS_SENT}: cosine between direction and that of the {box.name}",
            1.0,
            cosine,
            _TOLERANCE,
        )


@_DETECTION_RESULTS_CHECKS.row(
    10, "velocity", "speed along the direction, negative for reversing", basis=Basis.READING
)
def _velocity(bench: Bench) -> Iterator[Seen]:
    result = bench.once(fused_boxes)
    for box in _BOXES:
        found = detection_of(result, box).velocity
        yield near(
            f"{_DETECTION_RESULTS_SENT}: velocity of the {box.name}", box.velocity, found, _TOLERANCE * 10
        )


def _corner(name: str) -> Look:
    k = ("x1", "y1", "x2", "y2").index(name)

    def look(bench: Bench) -> Iterator[Seen]:
        result = bench.once(fused_boxes)
        for box in _BOXES:
            found = getattr(detection_of(result, box), name)
            # rounding outwards and the pixel grid's two conventions differ by a pixel at most
            yield near(
                f"{_DETECTION_RESULTS_SENT}: {name} of the {box.name}",
                conformance_scene.outline(box)[k],
                found,
                1.0,
            )

    return look


for _detection_results_name in ("x1", "y1", "x2", "y2"):
    _DETECTION_RESULTS_CHECKS.row(
        10,
        _detection_results_name,
        f"{_detection_results_name} of the box in the image: of the 2D box, else of the projected 3D box",
    )(_corner(_detection_results_name))


@_DETECTION_RESULTS_CHECKS.clause(
    "4.2-1", "4.2", "a box in space and the box that it makes in the image become one detection"
)
def _one(bench: Bench) -> Iterator[Seen]:
    found = [_center(box) for box in bench.once(fused_boxes).detections]
    count = sum(
        max(abs(a - b) for a, b in zip(c, conformance_scene.MATCHED.center, strict=True)) < 1.0 for c in found
    )
    yield same(f"{_DETECTION_RESULTS_SENT}: detections where both detectors saw one", 1, count)
    yield same(f"{_DETECTION_RESULTS_SENT}: detections", len(_BOXES), len(found))


def _center(found: Any) -> tuple[float, float, float]:
    return found.X, found.Y, found.Z


@_DETECTION_RESULTS_CHECKS.clause("4.2-2", "4.2", "what one detector alone saw is kept", basis=Basis.READING)
def _alone(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    peer.send(conformance_scene.boxes_2d(boxes=[]))
    peer.send(conformance_scene.boxes_3d())
    yield same("two boxes in space, none in the image: detections", 2, len(peer.result(1).detections))
    peer = bench.ready()
    peer.send(conformance_scene.boxes_2d())
    peer.send(conformance_scene.boxes_3d(boxes=[]))
    detections = peer.result(1).detections
    yield same("a box in the image, none in space: detections", 1, len(detections))


@_DETECTION_RESULTS_CHECKS.clause(
    "6.8-1",
    "6.8",
    "of an object that the image does not show x1, y1, x2 and y2 are 0: its outline is empty",
    basis=Basis.READING,
)
def _not_shown(bench: Bench) -> Iterator[Seen]:
    for location, X, Y in (("behind the camera", -16.0, 2.0), ("beside its view", 5.0, 60.0)):
        peer = bench.ready()
        peer.send(conformance_scene.boxes_2d(boxes=[]))
        peer.send(
            conformance_scene.boxes_3d(boxes=[conformance_scene.box_3d(conformance_scene.MATCHED, X=X, Y=Y)])
        )
        found = peer.result(1).detections
        corners = [(box.x1, box.y1, box.x2, box.y2) for box in found]
        yield same(f"a box {location}, Get: x1, y1, x2, y2", [(0, 0, 0, 0)], corners)


_DETECTION_RESULTS_ROWS = "T10-"

_DETECTION_RESULTS_CHECKS.checks.sort(
    key=lambda check: (
        (0, int(check.id.removeprefix(_DETECTION_RESULTS_ROWS)), "")
        if check.id.startswith(_DETECTION_RESULTS_ROWS)
        else (1, 0, check.id)
    )
)
