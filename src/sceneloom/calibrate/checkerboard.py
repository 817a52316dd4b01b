"""Camera-lidar calibration by a checkerboard: its corners in images and its plane in clouds, without a first guess.

Source: saddles by the determinant of the Hessian and their sub-pixel location by a quadratic surface: Lucchese and
Mitra 2002, "Using saddle points for subpixel feature detection in camera calibration targets"; growing a grid from a
seed: Geiger, Moosmann, Car and Schuster 2012, "Automatic camera and range sensor calibration using a single shot".

Of each view the camera gives the board's pose and the lidar its plane and extent. Normals determine the rotation,
planes and middles the translation; then all points are fitted at once: those of the cloud onto the board's plane, and
the board's extent, as far as the scan lines show it, onto its border.

Source: planes: Zhang and Pless 2004, "Extrinsic calibration of a camera and laser range finder", and Unnikrishnan and
Hebert 2005; planes and borders: Zhou, Li and Kaess 2018, "Automatic extrinsic calibration of a camera and a 3D lidar
using line and plane correspondences".
"""

import re
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, spread_rows
from sceneloom.calibrate.extrinsics import MountingEstimate, ground_plane, moved_by
from sceneloom.calibrate.frames import LUMA, chosen_camera, chosen_lidar
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project_unbounded, unproject
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform, nearest_rotation
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, PointsFrame, Progress

_TEXT = re.compile(r"(\d+)x(\d+):([\d.]+)(?::([\d.]+)x([\d.]+))?")
_SMOOTHED_PX, _SHARE, _MOST_SADDLES, _SEEDS = 1.5, 0.08, 2000, 80
"""Saddles weaker than this share of the strong ones are left out."""

_SURFACE = 4  # half a side of the patch that a surface is fitted to [px]

_TOLERANCE, _NEIGHBOURS = 0.3, 9  # a corner lies within this part of a step from where the grid goes on

_CELL, _REACH, _LEAST_POINTS, _FLATNESS, _SIZE_SHARE, _GROUND_M = 0.12, 15.0, 40, 0.03, 0.3, 0.15
_LEAST_VIEWS, _LEAST_ROTATION = 3, np.radians(10.0)
_PLANE_SIGMA, _MIDDLE_SIGMA = 0.01, 0.02
"""Errors of a board's plane, and of its extent as scan lines show it [m]: about a third of the gap between two."""

_FARTHEST_NS = 100_000_000  # a sweep farther from an image does not show the board where the image does

_WORST_PX = 1.5  # corners that are farther off from a flat board under the camera model are not this board's [px]

_Grid = dict[tuple[int, int], int]  # number of a saddle by (column, row)


@dataclass(frozen=True, slots=True)
class Board:
    """A flat rectangle with a checkerboard in its middle.

    Attributes:
        columns, rows: inner corners of the pattern, where four squares meet.
        square: side of a square [m].
        width, height: of the whole board [m], along columns and rows.

    Raises:
        OptionError: a number is out of bounds.
    """

    columns: int
    rows: int
    square: float
    width: float
    height: float

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or max(self.columns, self.rows) > 100:
            raise OptionError(f"board of {self.columns}x{self.rows} inner corners; expected 3 to 100 each way")
        least = (self.columns * self.square, self.rows * self.square)
        if not (self.square > 0 and self.width > least[0] and self.height > least[1]):
            raise OptionError(
                f"board of {self.width} x {self.height} m with squares of {self.square} m; expected a pattern that fits"
            )

    @classmethod
    def parse(cls, text: str) -> "Board":
        """Read `COLUMNSxROWS:SQUARE[:WIDTHxHEIGHT]`, inner corners and metres; without a size squares go to the edge.

        Raises:
            OptionError: it is written otherwise.
        """
        found = _TEXT.fullmatch(text.strip())
        if found is None:
            raise OptionError(f"board {text!r}; expected COLUMNSxROWS:SQUARE[:WIDTHxHEIGHT], like 7x5:0.1:0.9x0.7")
        columns, rows, square = int(found[1]), int(found[2]), float(found[3])
        width = float(found[4] or (columns + 1) * square)
        height = float(found[5] or (rows + 1) * square)
        return cls(columns, rows, square, width, height)

    @property
    def corners(self) -> Float64Array:
        """The inner corners on the board, (rows columns, 3) [m], row after row, the board's middle at the origin."""
        across = (np.arange(self.columns) - (self.columns - 1) / 2.0) * self.square
        down = (np.arange(self.rows) - (self.rows - 1) / 2.0) * self.square
        u, v = np.meshgrid(across, down)
        return np.stack([u.ravel(), v.ravel(), np.zeros(u.size)], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class _BoardInCloud:
    """A board as a lidar sees it."""

    points: Float64Array  # (N, 3) [m], lidar frame
    center: Float64Array  # (3,) [m], the middle of its extent
    normal: Float64Array  # (3,) unit, towards the lidar
    noise: float  # root mean square of the points' distances from the plane [m]


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """A board seen by both: `camera_from_board` by the corners, z away from the camera, and the board in the cloud."""

    camera_from_board: RigidTransform
    cloud: _BoardInCloud


def board_views(
    scene: Scene,
    board: Board,
    camera_id: Identifier | None = None,
    lidar_id: Identifier | None = None,
    *,
    most: int,
    progress: Progress | None = None,
) -> Iterator[BoardView]:
    """Find the board in images spread over a drive; board and vehicle are assumed to be stationary at these times.

    Args:
        camera_id, lidar_id: None for the scene's first ones.
        most: so many images at most.
        progress: reported after each image.

    Raises:
        OptionError: there is no such camera or lidar.
        DataError: an image or a sweep cannot be read.
    """
    camera, lidar = chosen_camera(scene, camera_id), chosen_lidar(scene, lidar_id)
    chosen = spread_rows(len(camera.images), most).tolist()
    for done, k in enumerate(chosen, start=1):
        image = camera.images[k]
        sweep = lidar.frames[int(np.argmin(np.abs(lidar.frames.timestamps_ns - image.timestamp_ns)))]
        if progress is not None:
            progress(done, len(chosen))
        if abs(sweep.reference_ns - image.timestamp_ns) > _FARTHEST_NS:
            continue
        corners = find_corners(image.rgb @ LUMA, board)
        pose = None if corners is None else board_pose(image.camera, corners, board)
        if pose is None or pose[1] > _WORST_PX:
            continue
        points: Float64Array = sweep.points.positions.astype(np.float64)
        if lidar.points_frame is PointsFrame.EGO and lidar.mount is not None:
            points = lidar.mount.inverse().apply(points)
        found = board_in_cloud(points, board)
        if found is not None:
            yield BoardView(pose[0], found)


def start_from_target(views: Sequence[BoardView], board: Board) -> MountingEstimate:
    """Estimate `camera_from_lidar` from several views of a board.

    Raises:
        PoseError: too few views, or all with the board rotated alike.
    """
    if len(views) < _LEAST_VIEWS:
        raise PoseError(f"{len(views)} views of the board; expected {_LEAST_VIEWS} or more, rotated differently")
    boards = [view.camera_from_board for view in views]
    middles = np.array([board.translation for board in boards])
    normals = np.array([board.rotation[:, 2] for board in boards])
    normals *= -np.sign((normals * middles).sum(axis=1, keepdims=True))  # towards the camera
    if np.linalg.svd(normals)[1][1] < np.sin(_LEAST_ROTATION) * np.sqrt(len(views)) * 0.5:
        raise PoseError("the board is rotated alike in all views; expected rotations by 10 deg or more about two axes")
    # the rotation that takes the lidar's normals, and directions between middles, to the camera's; then the translation
    seen_middles = np.array([view.cloud.center for view in views])
    a = np.concatenate([normals, middles - middles.mean(axis=0)])
    b = np.concatenate([[view.cloud.normal for view in views], seen_middles - seen_middles.mean(axis=0)])
    rotation, _ = nearest_rotation(a.T @ b)
    start = RigidTransform(rotation, (middles - seen_middles @ rotation.T).mean(axis=0))

    def errors(step: Float64Array) -> Float64Array:
        camera_from_lidar = moved_by(start, step)
        return np.concatenate([_errors(view, camera_from_lidar, board) for view in views])

    found = least_squares(errors, np.zeros(6), loss="soft_l1", x_scale=[0.01] * 3 + [0.02] * 3)
    jacobian = np.asarray(found.jac, np.float64)
    variance = max(float(2.0 * found.cost / max(len(found.fun) - 6, 1)), 1.0)
    covariance = np.asarray(np.linalg.pinv(jacobian.T @ jacobian) * variance, np.float64)
    return MountingEstimate.of(moved_by(start, found.x), covariance, "camera")


def _errors(view: BoardView, camera_from_lidar: RigidTransform, board: Board) -> Float64Array:
    """Distances from the board's plane, and how far the extent is from the border on both sides, by their sigmas."""
    # successive points of a plane are not independent: of many each counts less
    on_board = view.camera_from_board.inverse().apply(camera_from_lidar.apply(view.cloud.points))
    share = np.sqrt(min(1.0, 100.0 / len(on_board)))
    planes = on_board[:, 2] / max(view.cloud.noise, _PLANE_SIGMA) * share
    beyond = np.abs(on_board[:, :2]) - 0.5 * np.array([board.width, board.height])
    outside = np.maximum(beyond, 0.0) / _MIDDLE_SIGMA * share
    low, high = (np.quantile(on_board[:, :2], q, axis=0) for q in (0.02, 0.98))
    return np.concatenate([planes, outside.ravel(), 0.5 * (low + high) / _MIDDLE_SIGMA])


def find_corners(grey: Float32Array, board: Board) -> Float64Array | None:
    """Find a board's inner corners, (rows columns, 2) float64 [px], row after row; None where it is not seen whole.

    A board that is symmetric can be found in several orders: which corner comes first is not known.
    """
    saddles = _saddles(grey)
    if len(saddles) < board.rows * board.columns:
        return None
    tree = cKDTree(saddles)
    tried: set[int] = set()
    for seed in range(min(_SEEDS, len(saddles))):
        if seed in tried:
            continue
        grid = _grown(saddles, tree, seed)
        tried.update(grid.values())
        found = _whole_board(grid, saddles, board)
        if found is not None:
            return found
    return None


def _saddles(grey: Float32Array) -> Float64Array:
    """Locations of saddles, (N, 2) [px], the strongest first."""
    smooth = ndimage.gaussian_filter(np.asarray(grey, np.float64), _SMOOTHED_PX)
    across, down = np.gradient(smooth, axis=1), np.gradient(smooth, axis=0)
    uu, vv, uv = np.gradient(across, axis=1), np.gradient(down, axis=0), np.gradient(across, axis=0)
    strength = np.maximum(uv**2 - uu * vv, 0.0)
    peaks = (strength == ndimage.maximum_filter(strength, 5)) & (strength > 0)
    margin = _SURFACE + 1
    peaks[:margin], peaks[-margin:], peaks[:, :margin], peaks[:, -margin:] = False, False, False, False
    rows, columns = np.nonzero(peaks)
    if len(rows) == 0:
        return np.zeros((0, 2))
    order = np.argsort(-strength[rows, columns])[:_MOST_SADDLES]
    rows, columns = rows[order], columns[order]
    strengths = strength[rows, columns]
    strong = strengths > _SHARE * strengths[min(20, len(rows) - 1)]
    return _refined(smooth, columns[strong], rows[strong])


def _refined(smooth: Float64Array, columns: AnyArray, rows: AnyArray) -> Float64Array:
    """Where quadratic surfaces around some pixels are level, (N, 2) [px]; those beyond a pixel are left out."""
    span = np.arange(-_SURFACE, _SURFACE + 1)
    dv, du = (grid.ravel().astype(np.float64) for grid in np.meshgrid(span, span, indexing="ij"))
    weights = np.exp(-(du**2 + dv**2) / (2.0 * (0.5 * _SURFACE) ** 2))
    design = np.stack([du * du, du * dv, dv * dv, du, dv, np.ones_like(du)], axis=1)
    solve = np.linalg.pinv(design * weights[:, None]) * weights
    patches = smooth[rows[:, None] + dv.astype(int), columns[:, None] + du.astype(int)]
    a, b, c, d, e, _ = solve @ patches.T
    bend = 4.0 * a * c - b * b
    safe = np.where(bend < 0, bend, -1.0)
    shifts = np.stack([(b * e - 2.0 * c * d) / safe, (b * d - 2.0 * a * e) / safe], axis=1)
    good = (bend < 0) & (np.abs(shifts).max(axis=1) < 1.5)
    locations: Float64Array = (np.stack([columns, rows], axis=1) + shifts)[good]
    return locations


def _grown(saddles: Float64Array, tree: cKDTree, seed: int) -> _Grid:
    """The largest grid of saddles around one of them, by any two directions to its neighbours."""
    near = np.asarray(tree.query(saddles[seed], k=min(_NEIGHBOURS, len(saddles)))[1], np.int64)
    sides = saddles[near[1:]] - saddles[seed]
    best: _Grid = {}
    lengths = np.linalg.norm(sides, axis=1)
    for i in range(min(4, len(sides))):
        for j in range(len(sides)):
            sine = abs(sides[i, 0] * sides[j, 1] - sides[i, 1] * sides[j, 0]) / max(lengths[i] * lengths[j], 1e-9)
            if sine >= 0.4 and 0.3 < lengths[i] / lengths[j] < 3.3:
                grid = _spread(saddles, tree, seed, sides[i], sides[j])
                best = max(best, grid, key=len)
    return best


def _spread(saddles: Float64Array, tree: cKDTree, seed: int, right: Float64Array, below: Float64Array) -> _Grid:
    """Grow a grid from a saddle in two directions; the steps follow the perspective."""
    grid: _Grid = {(0, 0): seed}
    steps: dict[tuple[int, int], tuple[Float64Array, Float64Array]] = {(0, 0): (right, below)}
    taken, queue = {seed}, deque([(0, 0)])
    while queue:
        location = queue.popleft()
        own = steps[location]
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            beside = (location[0] + sign * (axis == 0), location[1] + sign * (axis == 1))
            if beside in grid:
                continue
            here = saddles[grid[location]]
            distance, found = tree.query(here + sign * own[axis])
            if int(found) in taken or distance > _TOLERANCE * np.linalg.norm(own[axis]):
                continue
            step = (saddles[found] - here) * sign
            grid[beside] = int(found)
            steps[beside] = (step, own[1]) if axis == 0 else (own[0], step)
            taken.add(int(found))
            queue.append(beside)
    return grid


def _whole_board(grid: _Grid, saddles: Float64Array, board: Board) -> Float64Array | None:
    """The corners of a board in a grid that may be a little larger; None where the grid is not just that board."""
    # the board is seen from its front: columns go to the right of rows, as in the image
    locations = np.array(list(grid))
    low, high = locations.min(axis=0), locations.max(axis=0)
    v, u = np.mgrid[: board.rows, : board.columns].reshape(2, -1)
    for cells in (np.stack([u, v], axis=1), np.stack([v, u], axis=1)):
        for start in np.ndindex(*np.maximum(high - low + 1 - cells.max(axis=0), 0)):
            order = list(map(tuple, (low + start + cells).tolist()))
            if all(location in grid for location in order) and len(grid) <= 1.3 * len(order):
                square = saddles[[grid[location] for location in order]].reshape(board.rows, board.columns, 2)
                right, below = square[0, -1] - square[0, 0], square[-1, 0] - square[0, 0]
                mirrored = right[0] * below[1] - right[1] * below[0] < 0
                return np.ascontiguousarray((square[:, ::-1] if mirrored else square).reshape(-1, 2))
    return None


def board_pose(camera: Camera, corners: Float64Array, board: Board) -> tuple[RigidTransform, float] | None:
    """Find `camera_from_board` from the corners, (N, 2) [px], and how far these are off [px]; None where it fails.

    Source: a plane's pose from its homography: Zhang 2000, "A flexible new technique for camera calibration",
    section 3.1; then least squares of the pixels.
    """
    rays = unproject(camera, corners)
    if not np.isfinite(rays).all() or (rays[:, 2] <= 0).any():
        return None
    seen = rays[:, :2] / rays[:, 2:]
    source = np.column_stack([board.corners[:, :2], np.ones(len(seen))])
    zeros = np.zeros_like(source)
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
    start = RigidTransform(rotation, h[:, 2].copy())

    def errors(step: Float64Array) -> Float64Array:
        pixels = project_unbounded(camera, moved_by(start, step).apply(board.corners))
        return np.nan_to_num((pixels - corners).ravel(), nan=1e3)

    found = least_squares(errors, np.zeros(6), method="lm")
    return moved_by(start, found.x), float(np.sqrt(np.mean(found.fun**2) * 2.0))


def board_in_cloud(points: Float64Array, board: Board) -> _BoardInCloud | None:
    """Find a board in a cloud, (N, 3) [m]: something flat of its size that stands free; None where nothing is."""
    ranges = np.linalg.norm(points, axis=1)
    found: list[tuple[float, _BoardInCloud]] = []
    for cluster in _clusters(points[np.isfinite(ranges) & (ranges > 0.5) & (ranges < _REACH)]):
        flat = _flat(cluster)
        if flat is not None:
            # lines miss up to a step at each edge
            kept, normal, noise = flat
            center, size = _extent(kept, normal)
            misfit = float(np.abs(np.sort(size) / np.sort([board.width, board.height]) - 1.0).max())
            found.append((misfit, _BoardInCloud(kept, center, normal, noise)))
    misfit, best = min(found, key=lambda one: one[0], default=(np.inf, None))
    return best if misfit < _SIZE_SHARE else None


def _clusters(points: Float64Array) -> list[Float64Array]:
    """Parts of a cloud with a gap around each; the ground, which joins all, is left out."""
    if len(points) < _LEAST_POINTS:
        return []
    plane = ground_plane(points)
    above = points if plane is None else points[points @ plane[0] + plane[1] >= _GROUND_M]
    if len(above) < _LEAST_POINTS:
        return []
    cells = np.floor(above / _CELL).astype(np.int64)
    cells -= cells.min(axis=0)
    volume = np.zeros(cells.max(axis=0) + 3, np.bool_)
    volume[tuple((cells + 1).T)] = True
    # scan lines lie apart: cells within two of one another touch
    joined = ndimage.binary_dilation(volume, np.ones((3, 3, 3), np.bool_), iterations=1)
    labels, count = ndimage.label(joined, np.ones((3, 3, 3)))
    own = labels[tuple((cells + 1).T)]
    sizes = np.bincount(own, minlength=count + 1)
    return [above[own == label] for label in np.flatnonzero(sizes >= _LEAST_POINTS) if label]


def _flat(cluster: Float64Array) -> tuple[Float64Array, Float64Array, float] | None:
    """Points, normal and noise of the plane of a cluster whose points nearly all lie on one."""
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
    return kept, normal * -np.sign(normal @ center), noise


def _extent(points: Float64Array, normal: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Middle (3,) and size (2,) of the smallest rectangle around points of a plane."""
    first = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    first /= np.linalg.norm(first)
    axes = np.stack([first, np.cross(normal, first)])
    flat = points @ axes.T
    rectangles = []
    for angle in np.radians(np.arange(0.0, 90.0, 1.0)):
        rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        rotated = flat @ rotation.T
        low, high = rotated.min(axis=0), rotated.max(axis=0)
        rectangles.append((float(np.prod(high - low)), 0.5 * (low + high) @ rotation, high - low))
    _, middle, size = min(rectangles, key=lambda one: one[0])
    return middle @ axes + normal * float(np.median(points @ normal)), size
