"""The nearest neighbours of a cloud's points in several directions, as a camera sees them."""

import math

import numba
import numpy as np
from numba import float32, float64, int32, int64, types, void

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int32Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.direction_grid import BLOCK, INNER, fit_grid, number_cells, position_grid
from sceneloom.kernels.thread_pool import ALONE, ThreadPool

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
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
    grid, numbers = fit_grid(extent, cell, border), np.empty(BLOCK, np.int32)
    holders[:] = 0
    samples = min(sampled.shape[0], count)
    taken = -(-first * samples // count)
    for start in range(0, inverse_ranges.shape[0], BLOCK):
        stop = min(start + BLOCK, inverse_ranges.shape[0])
        block, before = numbers[: stop - start], first + start
        number_cells(rightward[start:stop], downward[start:stop], inverse_ranges[start:stop], grid, block)
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
