"""Table 2, rows 2 to 4, applied to the data: frames that are rotated or left-handed give the same fusion."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from sceneloom.service.conformance import scene
from sceneloom.service.conformance.bench import DETECTIONS, SENSOR_DATA, Bench, Peer
from sceneloom.service.conformance.calibration import filled
from sceneloom.service.conformance.catalogue import Basis, Catalogue, Seen, near, same
from sceneloom.service.conformance.sensor_results import columns_of

CHECKS = Catalogue("Reference frames (table 2, rows 2 to 4)")

_EXPECTED = sorted((point.column, point.row) for point in scene.SEEN)
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


def _look(
    bench: Bench, properties: dict[str, Any], camera: np.ndarray[Any, Any], lidar: np.ndarray[Any, Any]
) -> Iterator[Seen]:
    peer = bench.peer()
    for name, value in properties.items():
        peer.set(name, value)
    matrix = camera @ scene.CAMERA_FROM_LIDAR @ lidar.T
    peer.calibrate(extrinsic_matrix=scene.by_columns(matrix))
    points = (scene.points_lidar() @ lidar[:3, :3].T).astype(np.float32)
    peer.send(scene.image())
    peer.send(scene.cloud(points=points))
    record = peer.result(SENSOR_DATA)
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
    peer.send(scene.boxes_2d())
    peer.send(scene.boxes_3d(boxes=[scene.box_3d(box)]))
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


@CHECKS.clause(
    "5.2-1",
    "5.2",
    "chirality 1: data of left-handed frames are fused, and come back in them",
    basis=Basis.READING,
)
def _chirality(bench: Bench) -> Iterator[Seen]:
    properties = {"chirality": 1, "lidar_coordinate": [0, 1, 2], "camera_coordinate": [2, 0, 1]}
    yield from _look(bench, properties, _MIRRORED_CAMERA, _MIRRORED_LIDAR)


@CHECKS.clause("5.2-2", "5.2", "camera_coordinate: a camera whose x points forward", basis=Basis.READING)
def _camera(bench: Bench) -> Iterator[Seen]:
    properties = {"camera_coordinate": [0, -1, 2], "lidar_coordinate": _STANDARD_LIDAR}
    yield from _look(bench, properties, _ROTATED_CAMERA, np.eye(4))


@CHECKS.clause("5.2-3", "5.2", "lidar_coordinate: a lidar whose y points forward", basis=Basis.READING)
def _lidar(bench: Bench) -> Iterator[Seen]:
    properties = {"camera_coordinate": _STANDARD_CAMERA, "lidar_coordinate": [1, 0, 2]}
    yield from _look(bench, properties, np.eye(4), _ROTATED_LIDAR)


@CHECKS.clause(
    "5.2-4",
    "5.2",
    "a matrix that mirrors between frames of one handedness is refused with the first data",
    basis=Basis.READING,
)
def _mirrored(bench: Bench) -> Iterator[Seen]:
    peer = bench.peer()
    peer.calibrate(extrinsic_matrix=scene.by_columns(scene.CAMERA_FROM_LIDAR @ _MIRRORED_LIDAR))
    status = peer.send(scene.cloud())
    yield same("SetCalibration with a mirroring matrix, Send of a cloud", "status 0", f"status {status}")
