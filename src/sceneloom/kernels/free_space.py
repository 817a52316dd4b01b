"""Through which points the rays of another sweep pass, and which of them they meet again."""

import math
from typing import Any

import numba
import numpy as np
from numba import float32, float64, int32, types, uint8, void

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, UInt8Array
from sceneloom.kernels.cache import kernel

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)
_IN_F64_2D = types.Array(float64, 2, "C", readonly=True)
_IN_F64_1D = types.Array(float64, 1, "C", readonly=True)
_IN_I32_2D = types.Array(int32, 2, "C", readonly=True)
_PART: dict[str, Any] = {"nogil": True, "error_model": "numpy", "inline": "always"}


@numba.njit(**_PART)
def _cell(x: float, y: float, z: float, distance: float, rows: int, columns: int) -> tuple[int, int]:
    """Row and column of a direction: rows by elevation from the nadir, columns by azimuth."""
    column = int((math.atan2(y, x) / (2.0 * math.pi) + 0.5) * columns)
    row = int((math.asin(min(max(z / distance, -1.0), 1.0)) / math.pi + 0.5) * rows)
    return min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)


@kernel(void(_IN_F32_2D, _IN_F32_1D, _IN_F64_2D, int32[:, ::1]), cache=True, nogil=True, error_model="numpy")
def fill_directions(
    points_world: Float32Array, fractions: Float32Array, ends_world: Float64Array, nearest: AnyArray
) -> None:
    """Sort a sweep by the directions in which it was measured: the nearest point of each cell.

    Args:
        points_world: (N, 3) [m].
        fractions: (N,), how far along its trajectory the lidar was at each point.
        ends_world: (2, 3) [m], the ends of that way.
        nearest: (rows, columns), rows of points are written, -1 for none.
    """
    rows, columns = nearest.shape
    distances = np.full((rows, columns), np.inf)
    nearest[:] = -1
    for i in range(points_world.shape[0]):
        share = fractions[i]
        x = points_world[i, 0] - (ends_world[0, 0] + share * (ends_world[1, 0] - ends_world[0, 0]))
        y = points_world[i, 1] - (ends_world[0, 1] + share * (ends_world[1, 1] - ends_world[0, 1]))
        z = points_world[i, 2] - (ends_world[0, 2] + share * (ends_world[1, 2] - ends_world[0, 2]))
        distance = math.sqrt(x * x + y * y + z * z)
        if not 0.1 < distance < math.inf:
            continue
        row, column = _cell(x, y, z, distance, rows, columns)
        if distance < distances[row, column]:
            distances[row, column] = distance
            nearest[row, column] = i


@numba.njit(**_PART)
def _near(row: int, column: int, nearest: AnyArray) -> int:
    """Some point of the cells around one, or -1."""
    rows, columns = nearest.shape
    for location in range(9):
        r, c = row + location // 3 - 1, (column + location % 3 - 1) % columns
        if 0 <= r < rows and nearest[r, c] >= 0:
            return int(nearest[r, c])
    return -1


@numba.njit(**_PART)
def _vote(
    x: float, y: float, z: float, distance: float, row: int, column: int, others_world: Float32Array,
    fractions: Float32Array, ends_world: Float64Array, nearest: AnyArray, numbers: Float64Array,
) -> int:  # fmt: skip
    """What the rays around a direction state of a point in it: 1 they pass through, 2 they meet something there.

    Or 0.
    """
    rows, columns = nearest.shape
    inverse = 1.0 / distance
    margin = numbers[1] * inverse * inverse + numbers[2] * inverse
    through, stopped = False, False
    for location in range(9):
        r, c = row + location // 3 - 1, (column + location % 3 - 1) % columns
        if not 0 <= r < rows or nearest[r, c] < 0:
            continue
        k = nearest[r, c]
        ox = others_world[k, 0] - (ends_world[0, 0] + fractions[k] * (ends_world[1, 0] - ends_world[0, 0]))
        oy = others_world[k, 1] - (ends_world[0, 1] + fractions[k] * (ends_world[1, 1] - ends_world[0, 1]))
        oz = others_world[k, 2] - (ends_world[0, 2] + fractions[k] * (ends_world[1, 2] - ends_world[0, 2]))
        away = math.sqrt(ox * ox + oy * oy + oz * oz)
        ax, ay, az = ox / away - x * inverse, oy / away - y * inverse, oz / away - z * inverse
        angle = math.sqrt(ax * ax + ay * ay + az * az)
        nearer = 1.0 / away - inverse
        step, beside = angle / numbers[0] + margin, angle * distance <= numbers[3]
        if abs(nearer) <= step and beside:
            return 2
        through = through or (nearer < -step and beside)
        stopped = stopped or nearer >= -step
    return 1 if through and not stopped else 0


@kernel(
    void(
        _IN_F32_2D, _IN_F32_2D, _IN_F32_1D, _IN_F64_2D, _IN_I32_2D, _IN_F64_1D, uint8[::1], uint8[::1],
    ),
    cache=True,
    nogil=True,
    error_model="numpy",
)  # fmt: skip
def vote_free_space(
    points_world: Float32Array,
    others_world: Float32Array,
    fractions: Float32Array,
    ends_world: Float64Array,
    nearest: AnyArray,
    numbers: Float64Array,
    free: UInt8Array,
    met: UInt8Array,
) -> None:
    """Count for each point whether another sweep looked through its location, or met something there.

    Inverse range changes on a surface by at most the angle over the distance at which its plane passes the lidar; what
    changes by more lies before or behind it. Rays that pass a point too far aside state nothing.

    Args:
        points_world: (N, 3) [m].
        others_world, fractions, ends_world, nearest: the other sweep, as for and from `fill_directions`.
        numbers: distance at which surfaces pass the lidar [m], margin [m], margin as a share of the range, how far
            aside a ray may pass a point [m], farthest range [m].
        free, met: (N,), counted up by 1.
    """
    rows, columns = nearest.shape
    for i in range(points_world.shape[0]):
        share, looks = 0.5, 0
        x, y, z, distance, row, column = 0.0, 0.0, 0.0, 0.0, 0, 0
        # where the lidar was when it looked this way is known once it is known which way that is
        while looks < 2:
            x = points_world[i, 0] - (ends_world[0, 0] + share * (ends_world[1, 0] - ends_world[0, 0]))
            y = points_world[i, 1] - (ends_world[0, 1] + share * (ends_world[1, 1] - ends_world[0, 1]))
            z = points_world[i, 2] - (ends_world[0, 2] + share * (ends_world[1, 2] - ends_world[0, 2]))
            distance = math.sqrt(x * x + y * y + z * z)
            if not 0.5 < distance < numbers[4]:
                break
            row, column = _cell(x, y, z, distance, rows, columns)
            found = _near(row, column, nearest)
            if found < 0:
                break
            share = fractions[found]
            looks += 1
        if looks < 2:
            continue
        vote = _vote(
            x, y, z, distance, row, column, others_world, fractions, ends_world, nearest, numbers
        )  # fmt: skip
        if vote == 2:
            met[i] = min(met[i] + 1, 255)
        elif vote == 1:
            free[i] = min(free[i] + 1, 255)
