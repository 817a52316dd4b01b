"""The conformance kit's own scene, whose fusion results follow in closed form.

Nothing here is computed by the code under test.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sceneloom.db34t.wire import fusion_pb2

WIDTH, HEIGHT, FOCAL = 64, 48, 64.0
MIDDLE = (32.0, 24.0)

CAMERA_ID, LIDAR_ID = 7, 3
"""Numbers that no server would take for granted."""

SECONDS, NANOSECONDS = 1595682678, 715705367
"""The standard's own example; as a float of 64 bits it is off by 57 ns."""

IMAGE_LATER_NS = 1_234_567
"""How much after its sweep an image is taken."""

PERIOD_NS = 100_000_000
"""Between one pair and the next."""

CAMERA_FROM_LIDAR = np.array(
    [[0.0, -1.0, 0.0, 0.25], [0.0, 0.0, -1.0, -0.5], [1.0, 0.0, 0.0, -0.125], [0.0, 0.0, 0.0, 1.0]]
)
"""Takes points of the lidar (x forward, y left, z up) into the camera's frame (x right, y down, z forward)."""

INTRINSIC = (FOCAL, 0.0, MIDDLE[0], 0.0, FOCAL, MIDDLE[1], 0.0, 0.0, 1.0)


class SeenPoint(NamedTuple):
    """A point that the image shows.

    Attributes:
        column, row: of the pixel whose centre it is seen at.
        depth: along the optical axis [m].
    """

    column: int
    row: int
    depth: float


SEEN = (SeenPoint(44, 14, 8.0), SeenPoint(16, 34, 16.0), SeenPoint(10, 8, 4.0))
"""The points that the image shows, far from one another in it."""

UNSEEN_CAMERA = ((1.0, 1.0, -4.0), (40.0, 0.0, 8.0))
"""Points in the camera's frame that it does not show: behind it, and beside its view [m]."""


def depth_of_pixel(point: SeenPoint) -> tuple[float, float, float]:
    """Where a seen point is in the camera's frame [m]."""
    scale = point.depth / FOCAL
    return (point.column - MIDDLE[0]) * scale, (point.row - MIDDLE[1]) * scale, point.depth


def points_camera() -> NDArray[np.float64]:
    """All points in the camera's frame: those seen first, (N, 3) [m]."""
    return np.array([*map(depth_of_pixel, SEEN), *UNSEEN_CAMERA])


def lidar_from_camera(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Take (N, 3) points into the lidar's frame [m]."""
    moved: NDArray[np.float64] = (points - CAMERA_FROM_LIDAR[:3, 3]) @ CAMERA_FROM_LIDAR[:3, :3]
    return moved


def points_lidar() -> NDArray[np.float32]:
    """All points in the lidar's frame, (N, 3) float32 [m]; exact."""
    return lidar_from_camera(points_camera()).astype(np.float32)


def drawn_image() -> NDArray[np.uint8]:
    """The image, (48, 64, 3) uint8: red reports the column, green the row, blue both."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    return np.stack([3 * columns, 5 * rows, 1 + columns + 2 * rows], axis=2).astype(np.uint8)


def color_at(point: SeenPoint) -> tuple[int, int, int]:
    """The colour of a seen point."""
    red, green, blue = drawn_image()[point.row, point.column].tolist()
    return red, green, blue


def timestamp(offset_ns: int = 0) -> fusion_pb2.Timestamp:
    """The timestamp of the scene, so much later."""
    s, ns = divmod(SECONDS * 10**9 + NANOSECONDS + offset_ns, 10**9)
    return fusion_pb2.Timestamp(s=s, ns=ns)


def in_ns(timestamp: Any) -> int:
    """A timestamp in nanoseconds."""
    return int(timestamp.s) * 10**9 + int(timestamp.ns)


def by_columns(matrix: NDArray[np.float64]) -> list[float]:
    """The 16 numbers of a transform as the standard's example has them: its translation in the last row."""
    numbers: list[float] = matrix.T.reshape(-1).tolist()
    return numbers


def by_rows(matrix: NDArray[np.float64]) -> list[float]:
    """The 16 numbers of a transform with its translation in the last column."""
    numbers: list[float] = matrix.reshape(-1).tolist()
    return numbers


def calibration(**changed: Any) -> fusion_pb2.Calibration:
    """A message of table 3."""
    fields: dict[str, Any] = {
        "image_size": (WIDTH, HEIGHT),
        "distortion_coeffs": (0.0,) * 5,
        "intrinsic_matrix": INTRINSIC,
        "reference_frame": 0,
        "extrinsic_matrix": by_columns(CAMERA_FROM_LIDAR),
    }
    return fusion_pb2.Calibration(**fields | changed)


def image(seq: int = 1, offset_ns: int = IMAGE_LATER_NS, **changed: Any) -> fusion_pb2.SendRequest:
    """A request with the image, table 5."""
    fields: dict[str, Any] = {
        "sensor_id": CAMERA_ID,
        "timestamp": timestamp(offset_ns),
        "seq": seq,
        "height": HEIGHT,
        "width": WIDTH,
        "encoding": "rgb8",
        "channel": 3,
        "data": drawn_image().tobytes(),
    }
    return fusion_pb2.SendRequest(image=fusion_pb2.ImageData(**fields | changed))


def cloud(
    seq: int = 1, offset_ns: int = 0, points: NDArray[np.float32] | None = None, **changed: Any
) -> fusion_pb2.SendRequest:
    """A request with the points, table 6."""
    values = points_lidar() if points is None else points
    fields: dict[str, Any] = {
        "sensor_id": LIDAR_ID,
        "timestamp": timestamp(offset_ns),
        "seq": seq,
        "number": len(values),
        "fields": ("x", "y", "z"),
        "fields_number": 3,
        "data": values.astype("<f4").tobytes(),
        "sensor_type": 0,
    }
    return fusion_pb2.SendRequest(points=fusion_pb2.PointCloudData(**fields | changed))


def raw(data: bytes, seq: int = 1, offset_ns: int = 0, **changed: Any) -> fusion_pb2.SendRequest:
    """A request with raw data, table 4."""
    fields: dict[str, Any] = {"sensor_id": CAMERA_ID, "timestamp": timestamp(offset_ns), "seq": seq}
    fields |= {"length": len(data), "data": data}
    return fusion_pb2.SendRequest(raw=fusion_pb2.RawData(**fields | changed))


class SentBox(NamedTuple):
    """A box in space; numbers that 32 bits hold exactly.

    Attributes:
        id: of the box.
        name: its class.
        confidence: that it exists.
        center: in the lidar's frame [m].
        size_lwh: [m].
        direction: in the lidar's frame, not of length 1.
        velocity: along the direction [m/s].
    """

    id: int
    name: str
    confidence: float
    center: tuple[float, float, float]
    size_lwh: tuple[float, float, float]
    direction: tuple[float, float, float]
    velocity: float


MATCHED = SentBox(-11, "Car", 0.75, (16.0, 2.0, -0.5), (4.5, 1.75, 1.5), (3.0, -4.0, 0.0), -2.5)
"""A box that the image's detector found, too; it reverses."""

ALONE = SentBox(12, "Pedestrian", 0.625, (12.0, -3.0, -0.25), (0.75, 0.5, 1.75), (0.0, 2.0, 0.0), 1.25)
"""A box that the image shows, and its detector did not find."""

MATCHED_2D_ID = 2_000_000_007


def _corners_lidar(box: SentBox) -> NDArray[np.float64]:
    """The corners of a box, (8, 3) [m]: length along the direction, width to its left, height upwards."""
    forward = np.array(box.direction) / np.linalg.norm(box.direction)
    left = np.array([-forward[1], forward[0], 0.0])
    axes = np.stack([forward, left, [0.0, 0.0, 1.0]])
    signs = np.array([[a, b, c] for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (-0.5, 0.5)])
    corners: NDArray[np.float64] = np.array(box.center) + (signs * box.size_lwh) @ axes
    return corners


def outline(box: SentBox) -> tuple[int, int, int, int]:
    """The pixels' edges around a box in the image: left, top, right, bottom, rounded outwards."""
    seen = _corners_lidar(box) @ CAMERA_FROM_LIDAR[:3, :3].T + CAMERA_FROM_LIDAR[:3, 3]
    # edges of pixels are counted from the image's corner, half a pixel before the first one's centre
    edges = FOCAL * seen[:, :2] / seen[:, 2:] + MIDDLE + 0.5
    low, high = np.floor(edges.min(axis=0)), np.ceil(edges.max(axis=0))
    left, top = np.maximum(low, 0).astype(int).tolist()
    right, bottom = np.minimum(high, [WIDTH, HEIGHT]).astype(int).tolist()
    return left, top, right, bottom


def box_3d(box: SentBox, seq: int = 1, offset_ns: int = 0, **changed: Any) -> fusion_pb2.Box3d:
    """A message of table 7."""
    fields: dict[str, Any] = {"id": box.id, "class": box.name, "points_seq": seq, "confidence": box.confidence}
    fields |= {"timestamp": timestamp(offset_ns), "direction": box.direction, "velocity": box.velocity}
    fields |= zip("XYZ", box.center, strict=True)
    fields |= zip(("length", "width", "height"), box.size_lwh, strict=True)
    return fusion_pb2.Box3d(**fields | changed)


def box_2d(seq: int = 1, offset_ns: int = IMAGE_LATER_NS, **changed: Any) -> fusion_pb2.Box2d:
    """A message of table 8: the outline of the matched box."""
    fields: dict[str, Any] = {"id": MATCHED_2D_ID, "class": MATCHED.name, "image_seq": seq, "confidence": 0.75}
    fields |= {"timestamp": timestamp(offset_ns)}
    fields |= zip(("x1", "y1", "x2", "y2"), outline(MATCHED), strict=True)
    return fusion_pb2.Box2d(**fields | changed)


def boxes_3d(
    seq: int = 1, offset_ns: int = 0, boxes: Sequence[fusion_pb2.Box3d] | None = None, **changed: Any
) -> fusion_pb2.SendRequest:
    """A request with the boxes of a sweep; both boxes where none are stated."""
    listed = [box_3d(box, seq, offset_ns) for box in (MATCHED, ALONE)] if boxes is None else boxes
    fields: dict[str, Any] = {"sensor_id": LIDAR_ID, "seq": seq, "timestamp": timestamp(offset_ns)}
    return fusion_pb2.SendRequest(boxes_3d=fusion_pb2.Boxes3d(boxes=listed, **fields | changed))


def boxes_2d(
    seq: int = 1, offset_ns: int = IMAGE_LATER_NS, boxes: Sequence[fusion_pb2.Box2d] | None = None, **changed: Any
) -> fusion_pb2.SendRequest:
    """A request with the boxes of an image; the one box where none are stated."""
    listed = [box_2d(seq, offset_ns)] if boxes is None else boxes
    fields: dict[str, Any] = {"sensor_id": CAMERA_ID, "seq": seq, "timestamp": timestamp(offset_ns)}
    return fusion_pb2.SendRequest(boxes_2d=fusion_pb2.Boxes2d(boxes=listed, **fields | changed))
