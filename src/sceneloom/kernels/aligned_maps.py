"""What maps state at pixels that move with a few numbers, and how that changes with them."""

from numba import float32, float64, int32, types, void

from sceneloom.arrays import AnyArray, Float32Array, Float64Array
from sceneloom.kernels.cache import kernel

_PIXELS = types.Array(float32, 2, "C", readonly=True)
_SLOPES = types.Array(float32, 3, "C", readonly=True)
_NUMBERS = types.Array(float32, 1, "C", readonly=True)
_ROWS = types.Array(int32, 1, "C", readonly=True)
_MAPS = types.Array(float32, 3, "C", readonly=True)
_STEP = types.Array(float64, 1, "C", readonly=True)


@kernel(
    void(
        _PIXELS, _SLOPES, _STEP, _NUMBERS, _ROWS, _ROWS, _MAPS,
        float64[::1], float64[::1], float64[:, ::1],
    ),
    cache=True, nogil=True, error_model="numpy",
)  # fmt: skip
def sum_maps(
    pixels: Float32Array,
    slopes: Float32Array,
    step: Float64Array,
    weights: Float32Array,
    rows: AnyArray,
    groups: AnyArray,
    maps: Float32Array,
    sums: Float64Array,
    squares: Float64Array,
    gradients: Float64Array,
) -> None:
    """Add up weighted values of maps at moved pixels, by group; beyond a map's outer pixels it says nothing.

    Args:
        pixels: (N, 2) [px of the maps], where each point falls.
        slopes: (N, 2, P), how its pixel changes with the numbers.
        step: (P,) the change of the numbers.
        weights: (N,).
        rows: (N,) int32, which map counts for each point.
        groups: (N,) int32, the sum that each point counts in.
        maps: (K, H, W).
        sums: (G,), weight times value is added to it.
        squares: (G,), the squares of the values are added to it.
        gradients: (G, P), the derivatives of the sums are added to it.
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
