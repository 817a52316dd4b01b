"""Where a board is, as a camera sees its corners and as a lidar sees its surface."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.optimize import least_squares

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.calibrate.ground_start import ground_plane
from sceneloom.calibrate.mounting_estimate import moved_by
from sceneloom.calibrate.target.board import Board
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import project_unbounded, unproject
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import nearest_rotation

_CELL = 0.12
_REACH = 15.0
_LEAST_POINTS = 40
_FLATNESS = 0.03
_SIZE_SHARE = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class BoardInCloud:
    """A board as a lidar sees it.

    Attributes:
        points: (N, 3) [m], lidar frame.
        center: (3,) [m], the middle of its extent.
        normal: (3,) unit, towards the lidar.
        noise: root mean square of the points' distances from the plane [m].
    """

    points: Float64Array
    center: Float64Array
    normal: Float64Array
    noise: float


def board_pose(camera: Camera, corners: Float64Array, board: Board) -> tuple[RigidTransform, float] | None:
    """Find `camera_from_board` from the corners, (N, 2) [px], and how far these are off [px]; None where it fails.

    Source: a plane's pose from its homography: Zhang 2000, "A flexible new technique for camera calibration",
    section 3.1; then least squares of the pixels.
    """
    rays = unproject(camera, corners)
    if not np.isfinite(rays).all() or (rays[:, 2] <= 0).any():
        return None
    start = _from_homography(board.corners[:, :2], rays[:, :2] / rays[:, 2:])
    if start is None:
        return None

    def errors(step: Float64Array) -> Float64Array:
        pixels = project_unbounded(camera, moved_by(start, step).apply(board.corners))
        return np.nan_to_num((pixels - corners).ravel(), nan=1e3)

    found = least_squares(errors, np.zeros(6), method="lm")
    return moved_by(start, found.x), float(np.sqrt(np.mean(found.fun**2) * 2.0))


def _from_homography(plane: Float64Array, seen: Float64Array) -> RigidTransform | None:
    ones, zeros = np.ones(len(plane)), np.zeros((len(plane), 3))
    source = np.column_stack([plane, ones])
    rows = np.concatenate(
        [
            np.column_stack([source, zeros, -seen[:, :1] * source]),
            np.column_stack([zeros, source, -seen[:, 1:] * source]),
        ]
    )
    h = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    scale = 0.5 * (np.linalg.norm(h[:, 0]) + np.linalg.norm(h[:, 1]))
    if scale < 1e-12:
        return None
    h = h / scale * (1.0 if h[2, 2] > 0 else -1.0)
    rotation, _ = nearest_rotation(np.column_stack([h[:, 0], h[:, 1], np.cross(h[:, 0], h[:, 1])]))
    return RigidTransform(rotation, h[:, 2].copy())


def board_in_cloud(points: Float64Array, board: Board) -> BoardInCloud | None:
    """Find a board in a cloud, (N, 3) [m]: something flat of its size that stands free; None where nothing is."""
    ranges = np.linalg.norm(points, axis=1)
    near = points[np.isfinite(ranges) & (ranges > 0.5) & (ranges < _REACH)]
    found = []
    for cluster in _clusters(near):
        candidate = _flat(cluster)
        if candidate is not None:
            misfit = _size_misfit(candidate, board)
            if misfit < _SIZE_SHARE:
                found.append((misfit, candidate))
    return min(found, key=lambda one: one[0])[1] if found else None


def _clusters(points: Float64Array) -> list[Float64Array]:
    """Parts of a cloud with a gap around each; the ground, which joins all, is left out."""
    if len(points) < _LEAST_POINTS:
        return []
    stationary = points[~_ground(points)]
    if len(stationary) < _LEAST_POINTS:
        return []
    cells = np.floor(stationary / _CELL).astype(np.int64)
    cells -= cells.min(axis=0)
    volume = np.zeros(cells.max(axis=0) + 3, np.bool_)
    volume[tuple((cells + 1).T)] = True
    # scan lines lie apart: cells within two of one another touch
    joined = ndimage.binary_dilation(volume, np.ones((3, 3, 3), np.bool_), iterations=1)
    labels, count = ndimage.label(joined, np.ones((3, 3, 3)))
    own = labels[tuple((cells + 1).T)]
    sizes = np.bincount(own, minlength=count + 1)
    return [stationary[own == label] for label in np.flatnonzero(sizes >= _LEAST_POINTS) if label]


def _ground(points: Float64Array) -> BoolArray:
    plane = ground_plane(points)
    if plane is None:
        return np.zeros(len(points), np.bool_)
    normal, height = plane
    return np.asarray(points @ normal + height < 0.15)


def _flat(cluster: Float64Array) -> BoardInCloud | None:
    """The plane of a cluster whose points nearly all lie on one."""
    kept = cluster
    for _ in range(4):
        center = kept.mean(axis=0)
        normal = np.linalg.svd(kept - center, full_matrices=False)[2][2]
        distances = np.abs((cluster - center) @ normal)
        kept = cluster[distances < max(3.0 * float(np.median(distances)), 0.02)]
        if len(kept) < _LEAST_POINTS:
            return None
    noise = float(np.sqrt(np.mean(((kept - center) @ normal) ** 2)))
    if noise > _FLATNESS or len(kept) < 0.8 * len(cluster):
        return None
    normal = normal * -np.sign(normal @ center)
    return BoardInCloud(kept, _middle(kept, normal), normal, noise)


def _axes(normal: Float64Array) -> Float64Array:
    """Two unit vectors along a plane, (2, 3)."""
    helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def _extent(points: Float64Array, normal: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Middle, size and axes of the smallest rectangle around points of a plane."""
    axes = _axes(normal)
    flat = points @ axes.T
    rectangles = []
    for angle in np.radians(np.arange(0.0, 90.0, 1.0)):
        rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        rotated = flat @ rotation.T
        low, high = rotated.min(axis=0), rotated.max(axis=0)
        rectangles.append(
            (float(np.prod(high - low)), 0.5 * (low + high) @ rotation, high - low, rotation @ axes)
        )
    best = min(rectangles, key=lambda one: one[0])
    middle = best[1] @ axes + normal * float(np.median(points @ normal))
    return middle, best[2], best[3]


def _middle(points: Float64Array, normal: Float64Array) -> Float64Array:
    return _extent(points, normal)[0]


def _size_misfit(found: BoardInCloud, board: Board) -> float:
    """How far the extent is from the board's size, as a share of it; lines miss up to a step at each edge."""
    _, size, _ = _extent(found.points, found.normal)
    wanted = np.sort([board.width, board.height])
    return float(np.abs(np.sort(size) / wanted - 1.0).max())
