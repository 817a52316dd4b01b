"""Figures 1 and 2, clause 6.1: the calibration data of table 3, seen by where points come to lie in the image."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from sceneloom.service.conformance import scene
from sceneloom.service.conformance.bench import SENSOR_DATA, Bench, Peer
from sceneloom.service.conformance.catalogue import Basis, Catalogue, Seen, same

CHECKS = Catalogue("Calibration (clause 6.1, table 3)")


def depths(record: Any) -> np.ndarray[Any, np.dtype[np.float32]]:
    """The depth image of a record of table 9, (H, W)."""
    return np.frombuffer(record.image_depth, "<f4").reshape(record.height, record.width)


def filled(record: Any) -> list[tuple[int, int]]:
    """Column and row of the pixels that have a depth."""
    rows, columns = np.nonzero(depths(record))
    return sorted(zip(columns.tolist(), rows.tolist(), strict=True))


def _pixels(peer: Peer, request: Any = None) -> list[tuple[int, int]]:
    peer.send(scene.image())
    peer.send(scene.cloud() if request is None else request)
    return filled(peer.result(SENSOR_DATA))


_EXPECTED = sorted((point.column, point.row) for point in scene.SEEN)


def _refused(bench: Bench, *cases: dict[str, Any]) -> Iterator[Seen]:
    for changed in cases:
        name, value = next(iter(changed.items()))
        yield same(
            f"SetCalibration {name} = {list(value) if isinstance(value, tuple) else value}",
            "status 0",
            f"status {bench.peer().calibrate(**changed)}",
        )


@CHECKS.row(
    3, "image_size", "two whole numbers above 0: width, height; an image of another size does not fit"
)
def _image_size(bench: Bench) -> Iterator[Seen]:
    yield from _refused(
        bench, {"image_size": ()}, {"image_size": (64,)}, {"image_size": (0, 48)}, {"image_size": (64, 48, 3)}
    )
    peer = bench.peer()
    peer.calibrate(image_size=(scene.HEIGHT, scene.WIDTH))
    status = peer.send(scene.image())
    yield same("Send of an image 64 x 48 after image_size (48, 64)", "status 0", f"status {status}")


@CHECKS.row(3, "distortion_coeffs", "k1 k2 p1 p2 k3 of the pinhole model; all 0 where they are left out")
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
    cloud = scene.lidar_from_camera(np.array([[8.0 * point[0], 8.0 * point[1], 8.0]])).astype(np.float32)
    found = _pixels(peer, scene.cloud(points=cloud))
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
    return scene.FOCAL * u + scene.MIDDLE[0], scene.FOCAL * v + scene.MIDDLE[1]


@CHECKS.row(
    3, "intrinsic_matrix", "3x3, row after row: focal lengths and middle state which pixel a ray meets"
)
def _intrinsic(bench: Bench) -> Iterator[Seen]:
    f, (cx, cy) = scene.FOCAL, scene.MIDDLE
    yield from _refused(
        bench,
        {"intrinsic_matrix": (f, 0, cx, 0, f, cy, 0, 0)},
        {"intrinsic_matrix": (0, 0, cx, 0, f, cy, 0, 0, 1)},
        {"intrinsic_matrix": (f, 0, 0, 0, f, 0, cx, cy, 1)},
    )
    peer = bench.peer()
    peer.calibrate(intrinsic_matrix=(32.0, 0, 30.0, 0, 44.8, 22.0, 0, 0, 1))
    x, y, z = scene.depth_of_pixel(scene.SEEN[0])
    expected = [(round(32.0 * x / z + 30.0), round(44.8 * y / z + 22.0))]
    cloud = scene.cloud(points=scene.points_lidar()[:1])
    yield same("a point after fx 32, cx 30, fy 44.8, cy 22: pixel", expected, _pixels(peer, cloud))


@CHECKS.row(
    3,
    "reference_frame",
    "0: the matrix leads into the camera's frame, 1: into the lidar's",
    basis=Basis.READING,
)
def _reference_frame(bench: Bench) -> Iterator[Seen]:
    yield from _refused(bench, {"reference_frame": 2})
    inverse = np.linalg.inv(scene.CAMERA_FROM_LIDAR)
    for frame, matrix in ((0, scene.CAMERA_FROM_LIDAR), (1, inverse)):
        peer = bench.peer()
        peer.calibrate(reference_frame=frame, extrinsic_matrix=scene.by_columns(matrix))
        yield same(f"a pair after reference_frame {frame}: pixels", _EXPECTED, _pixels(peer))


@CHECKS.row(
    3,
    "extrinsic_matrix",
    "16 numbers of a rigid transform, the translation last as in the example, or in the last column",
    basis=Basis.READING,
)
def _extrinsic(bench: Bench) -> Iterator[Seen]:
    good = scene.by_columns(scene.CAMERA_FROM_LIDAR)
    yield from _refused(
        bench,
        {"extrinsic_matrix": good[:15]},
        {"extrinsic_matrix": [2 * number for number in good[:15]] + [1.0]},
        {"extrinsic_matrix": [float("nan"), *good[1:]]},
        {"extrinsic_matrix": [*good[:15], 2.0]},
    )
    layouts = {"columns": good, "rows": scene.by_rows(scene.CAMERA_FROM_LIDAR)}
    for layout, numbers in layouts.items():
        peer = bench.peer()
        peer.calibrate(extrinsic_matrix=numbers)
        yield same(f"a pair after the matrix by {layout}: pixels", _EXPECTED, _pixels(peer))


@CHECKS.clause(
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
    peer.send(scene.image(height=480, width=640, data=pixels.tobytes()))
    peer.send(scene.cloud(points=point[None]))
    yield same("a point 8 m ahead: pixel", expected, filled(peer.result(SENSOR_DATA)))


@CHECKS.clause(
    "4.1-2", "4.1", "a calibration that is replaced counts for the frames after it", basis=Basis.READING
)
def _replaced(bench: Bench) -> Iterator[Seen]:
    peer = bench.ready()
    first = _pixels(peer)
    peer.calibrate(intrinsic_matrix=(64.0, 0, 34.0, 0, 64.0, 25.0, 0, 0, 1))
    later = 100_000_000
    peer.send(scene.image(2, later + scene.IMAGE_LATER_NS))
    peer.send(scene.cloud(2, later))
    moved = sorted((column + 2, row + 1) for column, row in _EXPECTED)
    yield same("a pair, a middle 2 px right and 1 px down, a pair: pixels of the first", _EXPECTED, first)
    yield same("pixels of the second", moved, filled(peer.result(SENSOR_DATA)))
