"""A grid over the directions in which a camera sees points, and the spacing of neighbouring points in it."""

import math
from typing import Any

import numba
import numpy as np
from numba import float32, float64, int32, int64, types, void

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int32Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.thread_pool import ALONE, ThreadPool

INNER: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
"""Options of the functions that are compiled, and cached, as parts of others."""

_BLOCK = 512
"""Points whose cells are numbered at once, by vector instructions."""

_EDGE = np.float32(2.1)
"""No direction lies farther than this from the axis in the equal-area map."""

_NOTHING, _STATIC = np.float32(0.0), np.float32(math.inf)

_LEAST, _GREATEST, _SIGN = np.int32(-(2**31)), np.int32(2**31 - 1), np.int32(31)

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)

_PARTS, _LAST_PART = np.float32(65536.0), np.int32(0xFFFF)

_PART = np.float32(1.0 / 65536.0)
"""How finely the location in a cell is kept: float32 knows it no better, but at the far edge of the map."""


@numba.njit(**INNER)
def _is_placed(a: Any, b: Any, inverse_range: Any) -> Any:
    """Report whether a point takes part; NaN does not."""
    return (inverse_range > _NOTHING) & (inverse_range < _STATIC) & (abs(a) <= _EDGE) & (abs(b) <= _EDGE)


@numba.njit(**INNER)
def _step(value: Any, placed: Any, per_cell: Any) -> Any:
    """Count cells from the edge of the map."""
    return np.int32((value if placed else _NOTHING) * per_cell + _EDGE * per_cell)


@numba.njit(**INNER)
def fraction(value: Any, per_cell: Any) -> Any:
    """Give how far into its cell a direction lies, 0 to 1."""
    steps = value * per_cell + _EDGE * per_cell
    return steps - np.float32(np.int32(steps))


@numba.njit(**INNER)
def _number(column: Any, row: Any, grid: tuple[Any, Any, Any, int, int]) -> Any:
    """Give the number of a cell; in 32 bits at each step, as Numba would go on in 64, of which vectors hold half."""
    _, first_column, first_row, columns, _ = grid
    before = np.int32(np.int32(row - first_row) * np.int32(columns))
    return np.int32(before + np.int32(column - first_column))


@numba.njit(**INNER)
def _order(bits: Any) -> Any:
    """Rotate the bits of a float into an integer that is ordered as the floats are, and back."""
    return np.int32(bits ^ np.int32(np.int32(bits >> _SIGN) & _GREATEST))


@kernel(void(_IN_F32_1D, _IN_F32_1D, _IN_F32_1D, float32[::1]), cache=True, nogil=True, error_model="numpy")
def _measure_extent(
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array, extent: Float32Array
) -> None:
    """Write the extent of some points; by integers, since vectors find no least of floats that may be NaN."""
    a_bits, b_bits, found = rightward.view(np.int32), downward.view(np.int32), extent.view(np.int32)
    left, right, top, bottom = _GREATEST, _LEAST, _GREATEST, _LEAST
    for i in range(inverse_ranges.shape[0]):
        placed = _is_placed(rightward[i], downward[i], inverse_ranges[i])
        a, b = _order(a_bits[i]), _order(b_bits[i])
        left, right = min(left, a if placed else _GREATEST), max(right, a if placed else _LEAST)
        top, bottom = min(top, b if placed else _GREATEST), max(bottom, b if placed else _LEAST)
    if left <= right:
        found[0], found[1], found[2], found[3] = _order(left), _order(right), _order(top), _order(bottom)
    else:
        extent[0] = extent[2] = _STATIC
        extent[1] = extent[3] = -_STATIC


def measure_extent(
    directions: Float32Array, inverse_ranges: Float32Array, *, thread_pool: ThreadPool = ALONE
) -> Float32Array:
    """Give how far points reach in the equal-area map.

    Args:
        directions: (2, M) in the equal-area map [rad].
        inverse_ranges: (M,) [1/m]; only points between zero and infinity take part.
        thread_pool: the threads that share the points.

    Returns:
        (4,) float32 [rad]: the least and the greatest rightward, the least and the greatest downward; infinity and
        minus infinity where no point takes part.
    """
    found = np.empty((thread_pool.size, 4), np.float32)

    def measure(part: int, a: int, b: int) -> None:
        _measure_extent(directions[0, a:b], directions[1, a:b], inverse_ranges[a:b], found[part])

    thread_pool.share(len(inverse_ranges), measure)
    extent: Float32Array = found.min(axis=0)
    extent[1::2] = found[:, 1::2].max(axis=0)
    return extent


@numba.njit(**INNER)
def _fit_grid(extent: Float32Array, cell: float, border: int) -> tuple[Any, Any, Any, int, int]:
    """Fit the smallest grid around some points that has `border` empty cells on each side.

    Args:
        extent: what `measure_extent` gives for them.
        cell: size of a cell [rad].
        border: cells, at least 1.

    Returns:
        per_cell: 1 / cell.
        first_column, first_row: of the grid, counted from the edge of the map.
        columns, rows: of the grid, border included.
    """
    per_cell, some = np.float32(1.0 / cell), extent[0] <= extent[1]
    left, right = _step(extent[0], some, per_cell), _step(extent[1], some, per_cell)
    top, bottom = _step(extent[2], some, per_cell), _step(extent[3], some, per_cell)
    columns, rows = int(right - left) + 1 + 2 * border, int(bottom - top) + 1 + 2 * border
    return per_cell, np.int32(left - border), np.int32(top - border), columns, rows


@kernel(void(_IN_F32_1D, float64, int64, int64[::1]), cache=True, nogil=True, error_model="numpy")
def _position_grid(extent: Float32Array, cell: float, border: int, grid: AnyArray) -> None:
    _, grid[0], grid[1], grid[2], grid[3] = _fit_grid(extent, cell, border)


def position_grid(extent: Float32Array, cell: float, border: int) -> list[int]:
    """Give what `_fit_grid` gives but for the first: first column and row, columns and rows."""
    grid = np.empty(4, np.int64)
    _position_grid(extent, cell, border, grid)
    first_and_sizes: list[int] = grid.tolist()
    return first_and_sizes


@numba.njit(**INNER)
def _number_cells(
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array,
    grid: tuple[Any, Any, Any, int, int], numbers: AnyArray,
) -> None:  # fmt: skip
    """Write each point's cell, int32 row * columns + column; 0, where no other point is, if it takes no part."""
    per_cell = grid[0]
    for i in range(numbers.shape[0]):
        a, b = rightward[i], downward[i]
        placed = _is_placed(a, b, inverse_ranges[i])
        number = _number(_step(a, placed, per_cell), _step(b, placed, per_cell), grid)
        numbers[i] = number if placed else np.int32(0)


@numba.njit(**INNER)
def _rank(
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array, counting: Float32Array,
    grid: tuple[Any, Any, Any, int, int], numbers: AnyArray, keys: AnyArray,
) -> None:  # fmt: skip
    """Write each point's cell, as `_number_cells`, and its key: inverse range, then how far right and down in the cell.

    The bits of positive floats are ordered as the floats are, so all fits one integer, whose maximum is that of the
    nearest point. Of equally near ones it is the one farther right.
    """
    per_cell, bits = grid[0], counting.view(np.int32)
    for i in range(numbers.shape[0]):
        a, b = rightward[i], downward[i]
        placed = _is_placed(a, b, inverse_ranges[i])
        steps_a = (a if placed else _NOTHING) * per_cell + _EDGE * per_cell
        steps_b = (b if placed else _NOTHING) * per_cell + _EDGE * per_cell
        column, row = np.int32(steps_a), np.int32(steps_b)
        right = np.int32((steps_a - np.float32(column)) * _PARTS)
        down = np.int32((steps_b - np.float32(row)) * _PARTS)
        number = _number(column, row, grid)
        numbers[i] = number if placed else np.int32(0)
        keys[i] = (np.int64(bits[i]) << 32) | (np.int64(right) << 16) | np.int64(down)


@numba.njit(**INNER)
def keep_nearest(
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array, counting: Float32Array,
    grid: tuple[Any, Any, Any, int, int], numbers: AnyArray, keys: AnyArray,
) -> None:  # fmt: skip
    """Write each point's cell, and raise the key of each cell to that of its nearest point.

    Args:
        rightward, downward, inverse_ranges: (M,) float32, as of `measure_extent`.
        counting: (M,) float32 [1/m], by what they count as near; 0 for a point that is nearer than none.
        grid: what `_fit_grid` gives.
        numbers: (M,) int32, written; 0, where no point is, for a point that takes no part.
        keys: (cells,) int64, raised.
    """
    block_keys = np.empty(_BLOCK, np.int64)
    for start in range(0, numbers.shape[0], _BLOCK):
        stop = min(start + _BLOCK, numbers.shape[0])
        block = numbers[start:stop]
        _rank(
            rightward[start:stop], downward[start:stop], inverse_ranges[start:stop], counting[start:stop], grid,
            block, block_keys,
        )  # fmt: skip
        for k in range(block.shape[0]):
            cell = np.uint32(block[k])
            keys[cell] = max(block_keys[k], keys[cell])


@numba.njit(**INNER)
def read_keys(keys: AnyArray, nearest: Float32Array, right: Float32Array, down: Float32Array) -> None:
    """Take keys apart.

    Args:
        keys: (cells,) int64.
        nearest: (cells,) float32 [1/m], written: inverse range of the nearest point, 0 where the cell is empty.
        right, down: (cells,) float32, written: how far into the cell it lies, 0 to 1.
    """
    nearest_bits = nearest.view(np.int32)
    for c in range(keys.shape[0]):
        nearest_bits[c] = np.int32(keys[c] >> 32)
        right[c] = np.float32(np.int32(keys[c] >> 16) & _LAST_PART) * _PART
        down[c] = np.float32(np.int32(keys[c]) & _LAST_PART) * _PART


_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)

_IN_F64_1D = types.Array(float64, 1, "C", readonly=True)

_IN_F64_2D = types.Array(float64, 2, "C", readonly=True)

_IN_I32_1D = types.Array(int32, 1, "C", readonly=True)

_IN_I32_2D = types.Array(int32, 2, "C", readonly=True)

_IN_I64_1D = types.Array(int64, 1, "C", readonly=True)

_IN_I64_2D = types.Array(int64, 2, "C", readonly=True)


@kernel(
    void(
        _IN_F32_1D, _IN_F32_1D, _IN_F32_1D, int64, int64, _IN_F32_1D, float64, int64, int32[::1], int32[::1]
    ),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def _occupy(
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array, first: int, count: int,
    extent: Float32Array, cell: float, border: int, sampled: AnyArray, holders: AnyArray,
) -> None:  # fmt: skip
    """Put the numbers of some of `count` points, the first of them `first`, from 1 on into their cells.

    The last point in a cell holds it; cells without a point hold 0. The cells of evenly drawn points go to `sampled`;
    0 for a point without a cell.
    """
    grid, numbers = _fit_grid(extent, cell, border), np.empty(_BLOCK, np.int32)
    holders[:] = 0
    samples = min(sampled.shape[0], count)
    taken = -(-first * samples // count)
    for start in range(0, inverse_ranges.shape[0], _BLOCK):
        stop = min(start + _BLOCK, inverse_ranges.shape[0])
        block, before = numbers[: stop - start], first + start
        _number_cells(rightward[start:stop], downward[start:stop], inverse_ranges[start:stop], grid, block)
        for k in range(block.shape[0]):
            holders[np.uint32(block[k])] = before + k + 1
        while taken < samples and taken * count // samples < first + stop:
            sampled[taken] = block[taken * count // samples - before]
            taken += 1
    holders[0] = 0


@kernel(
    void(
        _IN_I32_2D, int64, _IN_I32_1D, _IN_I64_1D, _IN_I64_1D, _IN_I64_1D, _IN_F64_1D, float64[:, ::1], int64[:, ::1]
    ),
    cache=True,
    nogil=True,
    error_model="numpy",
)  # fmt: skip
def _find_holders(
    holders: Int32Array, columns: int, sampled: Int32Array, right: Int64Array, down: Int64Array, sectors: Int64Array,
    distances: Float64Array, found: Float64Array, neighbours: Int64Array,
) -> None:  # fmt: skip
    """Look around the sampled cells for those that any of the threads found to be held."""
    found[:], neighbours[:] = math.nan, -1
    offsets = np.empty(right.shape[0], np.int32)
    for k in range(offsets.shape[0]):
        offsets[k] = down[k] * columns + right[k]
    for s in range(sampled.shape[0]):
        missing = found.shape[1] if sampled[s] > 0 else 0
        for k in range(offsets.shape[0] if missing > 0 else 0):
            location = np.uint32(sampled[s] + offsets[k])
            holder = holders[0, location]
            for part in range(1, holders.shape[0]):
                holder = max(holder, holders[part, location])
            if holder > 0 and neighbours[s, sectors[k]] < 0:
                found[s, sectors[k]], neighbours[s, sectors[k]] = distances[k], holder - 1
                missing -= 1
                if missing == 0:
                    break


def find_neighbours(
    directions: Float32Array,
    inverse_ranges: Float32Array,
    extent: Float32Array,
    cell: float,
    right: Int64Array,
    down: Int64Array,
    sectors: Int64Array,
    distances: Float64Array,
    found: Float64Array,
    neighbours: Int64Array,
    *,
    thread_pool: ThreadPool = ALONE,
) -> None:
    """Write how far it is from some points, evenly drawn from the cloud, to the next point in each sector.

    Sample s of S is point s * M // S; of fewer points than S, every one is drawn once.

    Args:
        directions: (2, M) in the equal-area map [rad].
        inverse_ranges: (M,) [1/m]; 0 for a point that takes no part.
        extent: (4,) of the points, as of `direction_grid.measure_extent`.
        cell: resolution [rad]; what lies in one cell is not distinguished.
        right, down: (K,) columns and rows to the cells that are looked at, the nearest first.
        sectors: (K,) number of the sector in which such a cell lies.
        distances: (K,) how far such a cell is, in any unit.
        found: (samples, sectors), written: the distance of the first occupied cell; NaN for none.
        neighbours: (samples, sectors), written: a point in that cell; -1 for none.
        thread_pool: the threads that share the points; what comes out is the same.
    """
    reach, count = int(max(1, np.abs(right).max(), np.abs(down).max())), len(inverse_ranges)
    _, _, columns, rows = position_grid(extent, cell, reach)
    sampled, holders = np.zeros(len(found), np.int32), np.empty((thread_pool.size, columns * rows), np.int32)

    def occupy(part: int, a: int, b: int) -> None:
        some = directions[0, a:b], directions[1, a:b], inverse_ranges[a:b]
        _occupy(*some, a, count, extent, cell, reach, sampled, holders[part])

    thread_pool.share(count, occupy)
    _find_holders(holders, columns, sampled, right, down, sectors, distances, found, neighbours)


@numba.njit(**INNER)
def _slope(
    directions: Float32Array, inverse_ranges: Float32Array, own: int, one: int, other: int, nothing: float,
    margin: float, margin_share: float,
) -> float:  # fmt: skip
    """Give how the inverse range changes from one neighbour to the other, NaN where the point is not on their line."""
    x, y, inverse = (
        float64(directions[0, own]),
        float64(directions[1, own]),
        float64(inverse_ranges[own]),
    )
    to_one = math.hypot(directions[0, one] - x, directions[1, one] - y)
    to_other = math.hypot(directions[0, other] - x, directions[1, other] - y)
    apart = max(to_one + to_other, nothing)
    first, second = float64(inverse_ranges[one]), float64(inverse_ranges[other])
    off = abs(inverse - (first * to_other + second * to_one) / apart)
    # The map widens angles off its axis by up to 1 / cos(θ/2).
    scale = math.sqrt(max(1.0 - 0.25 * (x * x + y * y), 0.0))
    straight = off <= margin * inverse * inverse + margin_share * inverse
    return scale * abs(first - second) / apart if straight else math.nan


@kernel(
    void(_IN_F32_2D, _IN_F32_1D, _IN_I64_1D, _IN_I64_2D, float64, float64, float64, float64[::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def find_slopes(
    directions: Float32Array,
    inverse_ranges: Float32Array,
    points: Int64Array,
    neighbours: Int64Array,
    nothing: float,
    margin: float,
    margin_share: float,
    slopes: Float64Array,
) -> None:
    """Write how fast the inverse range changes around some points, along the straightest steepest line there.

    Args:
        directions: (2, M) in the equal-area map [rad].
        inverse_ranges: (M,) [1/m].
        points: (S,) rows of `inverse_ranges`.
        neighbours: (S, sectors), likewise, -1 for none; sectors half of their number apart are opposite.
        nothing: neighbours nearer than this together count as so far apart [rad].
        margin: how far from the line between two opposite neighbours a point may lie [m] …
        margin_share: … plus this share of its range.
        slopes: (S,) [1/m/rad], written: the largest of all lines, NaN for a point that lies on none.
    """
    half = neighbours.shape[1] // 2
    for s in range(points.shape[0]):
        slopes[s] = math.nan
        for axis in range(half):
            one, other = neighbours[s, axis], neighbours[s, axis + half]
            if one >= 0 and other >= 0:
                slope = _slope(
                    directions, inverse_ranges, points[s], one, other, nothing, margin, margin_share
                )
                slopes[s] = slopes[s] if slope <= slopes[s] or math.isnan(slope) else slope


@numba.njit(**INNER)
def _count_steps(distances: Float64Array, axis: int, cell: float, counts: AnyArray) -> int:
    """Count how often neighbours on an axis are so far away, by the square of the distance in cells; give their sum."""
    half, last, known = distances.shape[1] // 2, counts.shape[0] - 1, 0
    counts[:] = 0
    for s in range(distances.shape[0]):
        for sector in (axis, axis + half):
            steps = distances[s, sector] / cell
            if not math.isnan(steps):
                counts[np.uint32(min(steps * steps + 0.5, last))] += 1
                known += 1
    return known


@numba.njit(**INNER)
def _mean_of_middle(counts: AnyArray, known: int) -> float:
    """Average the middle half of roots of which each is there so many times."""
    first, last, before, total = known // 4, known - known // 4, 0, 0.0
    for square in range(counts.shape[0]):
        behind = before + counts[square]
        total += max(min(behind, last) - max(before, first), 0) * math.sqrt(square)
        before = behind
    return total / (last - first)


@kernel(void(_IN_F64_2D, float64, int64, int64, float64[::1]), cache=True, nogil=True, error_model="numpy")
def measure_along_axes(
    distances: Float64Array, cell: float, reach: int, fewest: int, spacings: Float64Array
) -> None:
    """Write how far apart neighbours are along each axis: robust as the median, but not bound to whole cells.

    Args:
        distances: (S, sectors) [rad], between middles of cells; NaN for none. Opposite sectors make an axis.
        cell: size of a cell [rad].
        reach: how many cells away neighbours are at most.
        fewest: known distances along an axis.
        spacings: (sectors / 2,) [rad], written: mean of the middle half of the distances; NaN for too few.
    """
    counts = np.empty(reach * reach + 1, np.int64)
    for axis in range(spacings.shape[0]):
        known = _count_steps(distances, axis, cell, counts)
        spacings[axis] = cell * _mean_of_middle(counts, known) if known >= fewest else math.nan


@kernel(void(_IN_F64_2D, int64, float64[::1]), cache=True, nogil=True, error_model="numpy")
def measure_across(distances: Float64Array, fewest: int, spacings: Float64Array) -> None:
    """Write the upper quartile of each point's distances to its neighbours.

    Args:
        distances: (S, sectors), in any unit; NaN for none.
        fewest: known distances of a point, at least 1.
        spacings: (S,), written; NaN for too few.
    """
    ordered = np.empty(distances.shape[1])
    for s in range(distances.shape[0]):
        known = 0
        for sector in range(distances.shape[1]):
            distance = distances[s, sector]
            if not math.isnan(distance):
                location = known
                while location > 0 and ordered[location - 1] > distance:
                    ordered[location] = ordered[location - 1]
                    location -= 1
                ordered[location] = distance
                known += 1
        spacings[s] = ordered[min(3 * known // 4, known - 1)] if known >= fewest else math.nan
