"""The inner corners of a checkerboard in an image: saddles of the brightness that lie on a grid.

Source: saddles by the determinant of the Hessian and their sub-pixel location by a quadratic surface: Lucchese and
    Mitra
2002, "Using saddle points for subpixel feature detection in camera calibration targets"; growing a grid from a seed:
Geiger, Moosmann, Car and Schuster 2012, "Automatic camera and range sensor calibration using a single shot".
"""

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from sceneloom.arrays import AnyArray, Float32Array, Float64Array
from sceneloom.calibrate.target.board import Board

_SMOOTHED_PX = 1.5
_SHARE = 0.08
"""Saddles weaker than this share of the strong ones are left out."""
_MOST_SADDLES = 2000
_SEEDS = 80
_SURFACE = 4
"""Half a side of the patch that a surface is fitted to [px]."""
_TOLERANCE = 0.3
"""A corner lies within this part of a step from where the grid goes on."""
_NEIGHBOURS = 9


def find_corners(grey: Float32Array, board: Board) -> Float64Array | None:
    """Find a board's inner corners, (rows columns, 2) float64 [px], row after row; None where it is not seen whole.

    A board that is symmetric can be reported in several orders: which corner comes first is not known.
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
    strong = (
        strength[rows, columns]
        > _SHARE * strength[rows[min(20, len(rows) - 1)], columns[min(20, len(rows) - 1)]]
    )
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


Grid = dict[tuple[int, int], int]


def _grown(saddles: Float64Array, tree: cKDTree, seed: int) -> Grid:
    """Grow a grid of saddles from one of them: number of the saddle by (column, row)."""
    near = np.asarray(tree.query(saddles[seed], k=min(_NEIGHBOURS, len(saddles)))[1], np.int64)
    trajectories = saddles[near[1:]] - saddles[seed]
    best: Grid = {}
    lengths = np.linalg.norm(trajectories, axis=1)
    for i in range(min(4, len(trajectories))):
        for j in range(len(trajectories)):
            sine = abs(
                trajectories[i, 0] * trajectories[j, 1] - trajectories[i, 1] * trajectories[j, 0]
            ) / max(lengths[i] * lengths[j], 1e-9)
            if sine < 0.4 or not 0.3 < lengths[i] / lengths[j] < 3.3:
                continue
            grid = _spread(saddles, tree, seed, trajectories[i], trajectories[j])
            if len(grid) > len(best):
                best = grid
    return best


def _spread(
    saddles: Float64Array, tree: cKDTree, seed: int, right: Float64Array, below: Float64Array
) -> Grid:
    grid: Grid = {(0, 0): seed}
    steps: dict[tuple[int, int], tuple[Float64Array, Float64Array]] = {(0, 0): (right, below)}
    taken, queue = {seed}, [(0, 0)]
    while queue:
        location = queue.pop(0)
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


def _whole_board(grid: Grid, saddles: Float64Array, board: Board) -> Float64Array | None:
    """The corners of a board in a grid, in its own rows; None where the grid is not just that board."""
    locations = np.array(list(grid))
    low, high = locations.min(axis=0), locations.max(axis=0)
    size = tuple((high - low + 1).tolist())
    for wanted, rotated in (((board.columns, board.rows), False), ((board.rows, board.columns), True)):
        for start in _windows(size, wanted):
            order = [
                (low[0] + start[0] + (v if rotated else u), low[1] + start[1] + (u if rotated else v))
                for v in range(board.rows)
                for u in range(board.columns)
            ]
            if all(location in grid for location in order) and len(grid) <= 1.3 * len(order):
                return _facing(np.array([saddles[grid[location]] for location in order]), board)
    return None


def _windows(size: tuple[int, ...], wanted: tuple[int, int]) -> list[tuple[int, int]]:
    """Where a grid of the wanted size may begin in one that may be a little larger."""
    return [
        (u, v) for u in range(max(size[0] - wanted[0] + 1, 0)) for v in range(max(size[1] - wanted[1] + 1, 0))
    ]


def _facing(corners: Float64Array, board: Board) -> Float64Array:
    """Order the corners so that the board is seen from its front: columns to the right of rows, as in the image."""
    square = corners.reshape(board.rows, board.columns, 2)
    right, below = square[0, -1] - square[0, 0], square[-1, 0] - square[0, 0]
    if right[0] * below[1] - right[1] * below[0] < 0:
        square = square[:, ::-1]
    return np.ascontiguousarray(square.reshape(-1, 2))
