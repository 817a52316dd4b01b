"""Checks of the calibration (clause 6.1, table 3) and of declared coordinate frames (table 2), by closed forms."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from sceneloom.db34t.conformance import scene
from sceneloom.db34t.conformance.catalogue import (
    Bench,
    Catalogue,
    Peer,
    Seen,
    columns_of,
    filled,
    near,
    refused,
    same,
    taken,
)

CHECKS = Catalogue()


def _pixels(peer: Peer, request: Any = None) -> list[tuple[int, int]]:
    return filled(peer.fused(scene.image(), scene.cloud() if request is None else request))


_EXPECTED = sorted((point.column, point.row) for point in scene.SEEN)


def _refusals(bench: Bench, *cases: dict[str, Any]) -> Iterator[Seen]:
    for changed in cases:
        ((name, value),) = changed.items()
        shown = list(value) if isinstance(value, tuple) else value
        yield refused(f"SetCalibration {name} = {shown}", bench.peer().calibrate(**changed))


@CHECKS.row(3, "image_size", "two whole numbers above 0: width, height; an image of another size does not fit")
def _image_size(bench: Bench) -> Iterator[Seen]:
    sizes: tuple[tuple[int, ...], ...] = ((), (64,), (0, 48), (64, 48, 3))
    yield from _refusals(bench, *({"image_size": size} for size in sizes))
    status = bench.ready(image_size=(scene.HEIGHT, scene.WIDTH)).send(scene.image())
    yield refused("Send of an image 64 x 48 after image_size (48, 64)", status)


@CHECKS.row(3, "distortion_coeffs", "k1 k2 p1 p2 k3 of the pinhole model; all 0 where they are left out")
def _distortion(bench: Bench) -> Iterator[Seen]:
    yield from _refusals(bench, {"distortion_coeffs": (0.1,) * 4}, {"distortion_coeffs": (0.1,) * 6})
    found = _pixels(bench.ready(distortion_coeffs=()))
    yield same("a pair after a calibration without coefficients: pixels", _EXPECTED, found)
    coefficients = (-0.25, 0.125, 0.0625, -0.09375, 0.5)
    point = (0.375, -0.25)
    column, row = (round(number) for number in _distorted(point, coefficients))
    cloud = scene.lidar_from_camera(np.array([[8.0 * point[0], 8.0 * point[1], 8.0]])).astype(np.float32)
    found = _pixels(bench.ready(distortion_coeffs=coefficients), scene.cloud(points=cloud))
    yield same(f"a point at (x, y) / z = {point} after k1 k2 p1 p2 k3 = {coefficients}", [(column, row)], found)


def _distorted(point: tuple[float, float], coefficients: tuple[float, ...]) -> tuple[float, float]:
    """Where the pinhole model with distortion has a point [px]: Brown 1971, with p1 and p2 as OpenCV has them."""
    (x, y), (k1, k2, p1, p2, k3) = point, coefficients
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return scene.FOCAL * u + scene.MIDDLE[0], scene.FOCAL * v + scene.MIDDLE[1]


@CHECKS.row(3, "intrinsic_matrix", "3x3, row after row: focal lengths and middle state which pixel a ray meets")
def _intrinsic(bench: Bench) -> Iterator[Seen]:
    f, (cx, cy) = scene.FOCAL, scene.MIDDLE
    yield from _refusals(
        bench,
        {"intrinsic_matrix": (f, 0, cx, 0, f, cy, 0, 0)},
        {"intrinsic_matrix": (0, 0, cx, 0, f, cy, 0, 0, 1)},
        {"intrinsic_matrix": (f, 0, 0, 0, f, 0, cx, cy, 1)},
    )
    peer = bench.ready(intrinsic_matrix=(32.0, 0, 30.0, 0, 44.8, 22.0, 0, 0, 1))
    x, y, z = scene.depth_of_pixel(scene.SEEN[0])
    expected = [(round(32.0 * x / z + 30.0), round(44.8 * y / z + 22.0))]
    cloud = scene.cloud(points=scene.points_lidar()[:1])
    yield same("a point after fx 32, cx 30, fy 44.8, cy 22: pixel", expected, _pixels(peer, cloud))


@CHECKS.row(3, "reference_frame", "0: the matrix leads into the camera's frame, 1: into the lidar's", reading=True)
def _reference_frame(bench: Bench) -> Iterator[Seen]:
    yield from _refusals(bench, {"reference_frame": 2})
    inverse = np.linalg.inv(scene.CAMERA_FROM_LIDAR)
    for frame, matrix in ((0, scene.CAMERA_FROM_LIDAR), (1, inverse)):
        peer = bench.ready(reference_frame=frame, extrinsic_matrix=scene.by_columns(matrix))
        yield same(f"a pair after reference_frame {frame}: pixels", _EXPECTED, _pixels(peer))


@CHECKS.row(
    3,
    "extrinsic_matrix",
    "16 numbers of a rigid transform, the translation last as in the example, or in the last column",
    reading=True,
)
def _extrinsic(bench: Bench) -> Iterator[Seen]:
    good = scene.by_columns(scene.CAMERA_FROM_LIDAR)
    doubled = [*(2 * number for number in good[:15]), 1.0]
    wrong = (good[:15], doubled, [float("nan"), *good[1:]], [*good[:15], 2.0])
    yield from _refusals(bench, *({"extrinsic_matrix": numbers} for numbers in wrong))
    for layout, numbers in (("columns", good), ("rows", scene.by_rows(scene.CAMERA_FROM_LIDAR))):
        found = _pixels(bench.ready(extrinsic_matrix=numbers))
        yield same(f"a pair after the matrix by {layout}: pixels", _EXPECTED, found)


@CHECKS.clause("4.1-1", "4.1", "the standard's own example of a calibration is taken, and points lie where it says")
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
    yield taken("SetCalibration as in the examples of table 3", status)
    point = np.array([8.0, 0.0, 0.0], np.float32)
    x, y, z = rotation @ point + translation
    # so near the middle of the image the distortion is below a hundredth of a pixel
    expected = [(round(matrix[0] * x / z + matrix[2]), round(matrix[4] * y / z + matrix[5]))]
    pixels = np.zeros((480, 640, 3), np.uint8).tobytes()
    image = scene.image(height=480, width=640, data=pixels)
    found = filled(peer.fused(image, scene.cloud(points=point[None])))
    yield same("a point 8 m ahead: pixel", expected, found)


@CHECKS.clause("4.1-2", "4.1", "a calibration that is replaced counts for the frames after it", reading=True)
def _replaced(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    first = _pixels(peer)
    peer.calibrate(intrinsic_matrix=(64.0, 0, 34.0, 0, 64.0, 25.0, 0, 0, 1))
    second = peer.fused(scene.image(2, scene.PERIOD_NS + scene.IMAGE_LATER_NS), scene.cloud(2, scene.PERIOD_NS))
    moved = sorted((column + 2, row + 1) for column, row in _EXPECTED)
    yield same("a pair, a middle 2 px right and 1 px down, a pair: pixels of the first", _EXPECTED, first)
    yield same("pixels of the second", moved, filled(second))


_STANDARD_CAMERA, _STANDARD_LIDAR = [2, 0, -1], [0, -1, 2]


def _square(rows: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    matrix = np.eye(4)
    matrix[:3, :3] = rows
    return matrix


_ROTATED_LIDAR = _square([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
"""Of a lidar with y forward, x right, z up: takes points out of x forward, y left, z up."""

_MIRRORED_LIDAR = _square([[1, 0, 0], [0, -1, 0], [0, 0, 1]])  # of a left-handed lidar with x forward, y right, z up
_MIRRORED_CAMERA = _square([[1, 0, 0], [0, -1, 0], [0, 0, 1]])  # of a left-handed camera with x right, y up, z forward
_ROTATED_CAMERA = _square([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # of a camera with x forward, y left, z up


def _look(
    bench: Bench, properties: dict[str, Any], camera: np.ndarray[Any, Any], lidar: np.ndarray[Any, Any]
) -> Iterator[Seen]:
    peer = bench.peer()
    for name, value in properties.items():
        peer.set(name, value)
    matrix = camera @ scene.CAMERA_FROM_LIDAR @ lidar.T
    peer.calibrate(extrinsic_matrix=scene.by_columns(matrix))
    points = (scene.points_lidar() @ lidar[:3, :3].T).astype(np.float32)
    record = peer.fused(scene.image(), scene.cloud(points=points))
    sent = ", ".join(f"{name} {value}" for name, value in properties.items())
    yield same(f"{sent}, a pair, Get: pixels with a depth", _EXPECTED, filled(record))
    error = float(np.abs(columns_of(record, ("x", "y", "z")) - points).max())
    yield near(f"{sent}: distance of points from where they were sent [m]", 0.0, error, 1e-5)
    yield from _boxes(peer, sent, lidar)


def _boxes(peer: Peer, sent: str, lidar: np.ndarray[Any, Any]) -> Iterator[Seen]:
    """The box that both detectors see, sent in the declared frame, comes back in it."""
    center = lidar[:3, :3] @ scene.MATCHED.center
    direction = lidar[:3, :3] @ scene.MATCHED.direction
    box = scene.MATCHED._replace(center=tuple(center.tolist()), direction=tuple(direction.tolist()))
    detections = peer.detected(scene.boxes_2d(), scene.boxes_3d(boxes=[scene.box_3d(box)])).detections
    yield same(f"{sent}, a box in space and in the image: detections", 1, len(detections))
    found = detections[0]
    error = float(np.abs(np.array([found.X, found.Y, found.Z]) - center).max())
    yield near(f"{sent}: distance of its middle from where it was sent [m]", 0.0, error, 0.25)
    cosine = float(np.array(found.direction) @ direction / np.linalg.norm(direction))
    cosine /= float(np.linalg.norm(found.direction))
    yield near(f"{sent}: cosine of its direction to what was sent", 1.0, cosine, 1e-4)


@CHECKS.clause("5.2-1", "5.2", "chirality 1: data of left-handed frames are fused, and come back in them", reading=True)
def _chirality(bench: Bench) -> Iterator[Seen]:
    properties = {"chirality": 1, "lidar_coordinate": [0, 1, 2], "camera_coordinate": [2, 0, 1]}
    yield from _look(bench, properties, _MIRRORED_CAMERA, _MIRRORED_LIDAR)


@CHECKS.clause("5.2-2", "5.2", "camera_coordinate: a camera whose x points forward", reading=True)
def _camera(bench: Bench) -> Iterator[Seen]:
    properties = {"camera_coordinate": [0, -1, 2], "lidar_coordinate": _STANDARD_LIDAR}
    yield from _look(bench, properties, _ROTATED_CAMERA, np.eye(4))


@CHECKS.clause("5.2-3", "5.2", "lidar_coordinate: a lidar whose y points forward", reading=True)
def _lidar(bench: Bench) -> Iterator[Seen]:
    properties = {"camera_coordinate": _STANDARD_CAMERA, "lidar_coordinate": [1, 0, 2]}
    yield from _look(bench, properties, np.eye(4), _ROTATED_LIDAR)


@CHECKS.clause(
    "5.2-4",
    "5.2",
    "a matrix that mirrors between frames of one handedness is refused with the first data",
    reading=True,
)
def _mirrored(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready(extrinsic_matrix=scene.by_columns(scene.CAMERA_FROM_LIDAR @ _MIRRORED_LIDAR))
    status = peer.send(scene.cloud())
    yield refused("SetCalibration with a mirroring matrix, Send of a cloud", status)
