"""How well points that fall into an image agree with it: sums over its edges, and over shared grey levels."""

import numba
from numba import float32, float64, int16, int64, types, uint8, void

from sceneloom.arrays import Float32Array, Float64Array, Int64Array, UInt8Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.pixel_numbers import PART

_IDS = types.Array(int64, 1, "C", readonly=True)
_PIXELS = types.Array(float32, 2, "C", readonly=True)
_IMAGE = types.Array(float32, 2, "C", readonly=True)
_STACK = types.Array(float32, 3, "C", readonly=True)
_NUMBERS = types.Array(float32, 1, "C", readonly=True)
_KINDS = types.Array(uint8, 1, "C", readonly=True)
_CELLS = types.Array(int16, 1, "C", readonly=True)
_TABLE = types.Array(float64, 2, "C", readonly=True)


@numba.njit(inline="always", **PART)
def _between(image, u, v):  # type: ignore[no-untyped-def]
    """Interpolate an image between its pixels; beyond its outer pixels' centres these hold."""
    height, width = image.shape
    x, y = min(max(u, 0.0), width - 1.0), min(max(v, 0.0), height - 1.0)
    column, row = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
    right, below = min(column + 1, width - 1), min(row + 1, height - 1)
    a, b = x - column, y - row
    upper = image[row, column] + a * (image[row, right] - image[row, column])
    lower = image[below, column] + a * (image[below, right] - image[below, column])
    return upper + b * (lower - upper)


@kernel(
    void(_IDS, _PIXELS, _KINDS, _NUMBERS, _CELLS, _STACK, float64[::1], float64[::1]),
    cache=True, nogil=True, error_model="numpy",
)  # fmt: skip
def sum_edges(
    point_ids: Int64Array,
    pixels: Float32Array,
    kinds: UInt8Array,
    weights: Float32Array,
    cells: Int64Array,
    edges: Float32Array,
    sums: Float64Array,
    totals: Float64Array,
) -> None:
    """Add up how strong an image's edges are where edges of a cloud fall.

    Args:
        point_ids: (M,), those of N points that fall into the image.
        pixels: (M, 2) [px], where.
        kinds: (N,), the image of `edges` that counts for each point.
        weights: (N,).
        cells: (N,), the sum that each point counts in.
        edges: (K, H, W).
        sums: (C,), weights times edges are added to it.
        totals: (C,), weights are added to it.
    """
    for i in range(point_ids.shape[0]):
        point = point_ids[i]
        weight = float64(weights[point])
        sums[cells[point]] += weight * _between(edges[kinds[point]], pixels[i, 0], pixels[i, 1])
        totals[cells[point]] += weight


@kernel(void(_IDS, _PIXELS, _NUMBERS, _IMAGE, float64[:, ::1]), cache=True, nogil=True, error_model="numpy")
def fill_histogram(
    point_ids: Int64Array,
    pixels: Float32Array,
    levels: Float32Array,
    image: Float32Array,
    histogram: Float64Array,
) -> None:
    """Count points by their level and that of the image where they fall, each shared among the four nearest bins.

    Args:
        point_ids: (M,), those of N points that fall into the image.
        pixels: (M, 2) [px], where.
        levels: (N,), 0 to B - 1.
        image: (H, W), 0 to B - 1.
        histogram: (B, B), counts are added to it; rows are levels of the points.
    """
    last = histogram.shape[0] - 1
    for i in range(point_ids.shape[0]):
        a = float64(levels[point_ids[i]])
        b = float64(_between(image, pixels[i, 0], pixels[i, 1]))
        row, column = min(int(a), last - 1), min(int(b), last - 1)
        p, q = a - row, b - column
        histogram[row, column] += (1.0 - p) * (1.0 - q)
        histogram[row, column + 1] += (1.0 - p) * q
        histogram[row + 1, column] += p * (1.0 - q)
        histogram[row + 1, column + 1] += p * q


@kernel(
    void(_IDS, _PIXELS, _NUMBERS, _CELLS, _IMAGE, _TABLE, float64[::1], float64[::1]),
    cache=True, nogil=True, error_model="numpy",
)  # fmt: skip
def sum_by_table(
    point_ids: Int64Array,
    pixels: Float32Array,
    levels: Float32Array,
    cells: Int64Array,
    image: Float32Array,
    table: Float64Array,
    sums: Float64Array,
    totals: Float64Array,
) -> None:
    """Add up what a table says of points by their level and that of the image where they fall.

    Args:
        point_ids: (M,), those of N points that fall into the image.
        pixels: (M, 2) [px], where.
        levels: (N,), 0 to B - 1.
        cells: (N,), the sum that each point counts in.
        image: (H, W), 0 to B - 1.
        table: (B, B), interpolated between its numbers; rows are levels of the points.
        sums: (C,), what the table says is added to it.
        totals: (C,), the number of points is added to it.
    """
    for i in range(point_ids.shape[0]):
        point = point_ids[i]
        b = _between(image, pixels[i, 0], pixels[i, 1])
        sums[cells[point]] += _between(table, b, levels[point])
        totals[cells[point]] += 1.0
