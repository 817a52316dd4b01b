"""How well projected points agree with an image: sums over edges, grey levels, and maps with their derivatives.

`point_ids` (M,) are those of N points that fall into the image, at `pixels` (M, 2) [px]; `cells` (N,) number the sum
that each point counts in; images are (H, W), their levels and those of points 0 to B - 1. Sums, totals and counts are
added to.
"""

from numba import float64, int16, types, void

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int64Array, UInt8Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import (
    IN_F32_1D,
    IN_F32_2D,
    IN_F32_3D,
    IN_F64_1D,
    IN_F64_2D,
    IN_I32_1D,
    IN_I64_1D,
    IN_U8_1D,
    inlined,
)

_CELLS = types.Array(int16, 1, "C", readonly=True)


@inlined
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


@kernel(void(IN_I64_1D, IN_F32_2D, IN_U8_1D, IN_F32_1D, _CELLS, IN_F32_3D, float64[::1], float64[::1]))  # fmt: skip
def sum_edges(
    point_ids: Int64Array, pixels: Float32Array, kinds: UInt8Array, weights: Float32Array, cells: Int64Array,
    edges: Float32Array, sums: Float64Array, totals: Float64Array,
) -> None:  # fmt: skip
    """Add up how strong an image's edges are where edges of a cloud fall: weights times edges, and the weights.

    `kinds` (N,), the image of `edges` (K, H, W) that counts for each point; `weights` (N,); `sums`, `totals` (C,).
    """
    for i in range(point_ids.shape[0]):
        point = point_ids[i]
        weight = float64(weights[point])
        sums[cells[point]] += weight * _between(edges[kinds[point]], pixels[i, 0], pixels[i, 1])
        totals[cells[point]] += weight


@kernel(void(IN_I64_1D, IN_F32_2D, IN_F32_1D, IN_F32_2D, float64[:, ::1]))
def fill_histogram(
    point_ids: Int64Array, pixels: Float32Array, levels: Float32Array, image: Float32Array, histogram: Float64Array
) -> None:
    """Count points by their level and that of the image, each shared among the four nearest bins.

    `levels` (N,); `histogram` (B, B), its rows are levels of the points.
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


@kernel(void(IN_I64_1D, IN_F32_2D, IN_F32_1D, _CELLS, IN_F32_2D, IN_F64_2D, float64[::1], float64[::1]))  # fmt: skip
def sum_by_table(
    point_ids: Int64Array, pixels: Float32Array, levels: Float32Array, cells: Int64Array, image: Float32Array,
    table: Float64Array, sums: Float64Array, totals: Float64Array,
) -> None:  # fmt: skip
    """Add up what a table says of points by their level and that of the image, and count the points.

    `levels` (N,); `table` (B, B), interpolated, its rows are levels of the points; `sums`, `totals` (C,).
    """
    for i in range(point_ids.shape[0]):
        point = point_ids[i]
        b = _between(image, pixels[i, 0], pixels[i, 1])
        sums[cells[point]] += _between(table, b, levels[point])
        totals[cells[point]] += 1.0


@kernel(void(
    IN_F32_2D, IN_F32_3D, IN_F64_1D, IN_F32_1D, IN_I32_1D, IN_I32_1D, IN_F32_3D, float64[::1], float64[::1],
    float64[:, ::1]
))  # fmt: skip
def sum_maps(
    pixels: Float32Array, slopes: Float32Array, step: Float64Array, weights: Float32Array, rows: AnyArray,
    groups: AnyArray, maps: Float32Array, sums: Float64Array, squares: Float64Array, gradients: Float64Array,
) -> None:  # fmt: skip
    """Add up weighted values of maps at moved pixels, by group; beyond a map's outer pixels it says nothing.

    Args:
        pixels: (N, 2) [px of the maps].
        slopes: (N, 2, P), derivatives of the pixels by the parameters.
        step: (P,), change of the parameters.
        weights, rows, groups: (N,), and int32: the map that counts for each point, and the sum.
        maps: (K, H, W).
        sums, squares, gradients: (G,), (G,), (G, P): of weight times value, of squared values, derivatives of `sums`.
    """
    height, width = maps.shape[1], maps.shape[2]
    count = step.shape[0]
    for i in range(pixels.shape[0]):
        u, v = float64(pixels[i, 0]), float64(pixels[i, 1])
        for k in range(count):
            u += slopes[i, 0, k] * step[k]
            v += slopes[i, 1, k] * step[k]
        if not (0.0 <= u < width - 1 and 0.0 <= v < height - 1):
            continue
        column, row = int(u), int(v)
        a, b = u - column, v - row
        one = maps[rows[i]]
        upper, lower = one[row, column], one[row + 1, column]
        across_upper, across_lower = one[row, column + 1] - upper, one[row + 1, column + 1] - lower
        at_upper, at_lower = upper + a * across_upper, lower + a * across_lower
        value = at_upper + b * (at_lower - at_upper)
        by_u = across_upper + b * (across_lower - across_upper)
        by_v = at_lower - at_upper
        weight, group = float64(weights[i]), groups[i]
        sums[group] += weight * value
        squares[group] += value * value
        for k in range(count):
            gradients[group, k] += weight * (by_u * slopes[i, 0, k] + by_v * slopes[i, 1, k])
