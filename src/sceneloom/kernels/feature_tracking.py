"""Corners of images, and where they are in the next image."""

import math

import numba
import numpy as np
from numba import boolean, float32, int64, types, void

from sceneloom.arrays import BoolArray, Float32Array
from sceneloom.kernels.cache import kernel

_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)


@kernel(void(_IN_F32_2D, int64, float32[:, ::1]), cache=True, nogil=True, error_model="numpy")
def corner_strengths(grey: Float32Array, half: int, strengths: Float32Array) -> None:
    """Report how well a window around each pixel can be distinguished from its neighbours, in both directions.

    Args:
        grey: (H, W).
        half: the window reaches so many pixels to each side.
        strengths: (H, W), written: the smaller eigenvalue of the mean product of gradients; 0 near the border.

    Source: Shi and Tomasi 1994, "Good Features to Track", section 4.
    """
    height, width = grey.shape
    strengths[:, :] = np.float32(0.0)
    sums = np.zeros((3, width), np.float32)
    products = np.zeros((3, height, width), np.float32)
    for i in range(1, height - 1):
        for j in range(1, width - 1):
            du = np.float32(0.5) * (grey[i, j + 1] - grey[i, j - 1])
            dv = np.float32(0.5) * (grey[i + 1, j] - grey[i - 1, j])
            products[0, i, j], products[1, i, j], products[2, i, j] = du * du, du * dv, dv * dv
    share = np.float32(1.0 / (2 * half + 1) ** 2)
    for i in range(half + 1, height - half - 1):
        sums[:, :] = np.float32(0.0)
        for k in range(i - half, i + half + 1):
            for j in range(width):
                sums[0, j] += products[0, k, j]
                sums[1, j] += products[1, k, j]
                sums[2, j] += products[2, k, j]
        for j in range(half + 1, width - half - 1):
            uu, uv, vv = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for k in range(j - half, j + half + 1):
                uu += sums[0, k]
                uv += sums[1, k]
                vv += sums[2, k]
            middle, apart = np.float32(0.5) * (uu + vv), np.float32(0.5) * (uu - vv)
            least = middle - np.sqrt(apart * apart + uv * uv)
            strengths[i, j] = max(least * share, np.float32(0.0))


@numba.njit(inline="always")
def _between(grey: Float32Array, u: float, v: float) -> float:
    """The brightness at a location between four pixels."""
    j, i = math.floor(u), math.floor(v)
    a, b = u - j, v - i
    upper = (1.0 - a) * grey[i, j] + a * grey[i, j + 1]
    lower = (1.0 - a) * grey[i + 1, j] + a * grey[i + 1, j + 1]
    return float((1.0 - b) * upper + b * lower)


@numba.njit(inline="always")
def _holds(grey: Float32Array, u: float, v: float, half: int) -> bool:
    """Whether a window around a location, and one pixel more, lies inside the image."""
    height, width = grey.shape
    reach = half + 1.0
    return bool((u >= reach) & (v >= reach) & (u < width - reach - 1) & (v < height - reach - 1))


@kernel(
    void(_IN_F32_2D, _IN_F32_2D, _IN_F32_2D, int64, int64, float32[:, ::1], boolean[::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def follow_corners(
    first: Float32Array,
    second: Float32Array,
    pixels: Float32Array,
    half: int,
    rounds: int,
    followed: Float32Array,
    found: BoolArray,
) -> None:
    """Find what windows of one image show in another one.

    What the windows differ in by brightness as a whole does not count.

    Args:
        first, second: (H, W) both.
        pixels: (N, 2) [px], column and row in the first image.
        half: windows reach so many pixels to each side.
        rounds: at most so many steps.
        followed: (N, 2) [px], in the second image: where to begin; written.
        found: (N,), written: whether the window was found.

    Source: Lucas and Kanade 1981, with the gradient of the first image, Baker and Matthews 2004, section 3.2.
    """
    side = 2 * half + 1
    count = side * side
    shown, slope_u, slope_v = np.empty(count), np.empty(count), np.empty(count)
    for n in range(pixels.shape[0]):
        u, v = float(pixels[n, 0]), float(pixels[n, 1])
        x, y = float(followed[n, 0]), float(followed[n, 1])
        found[n] = False
        if not _holds(first, u, v, half):
            continue
        mean, mean_u, mean_v = 0.0, 0.0, 0.0
        for k in range(count):
            a, b = u + k % side - half, v + k // side - half
            shown[k] = _between(first, a, b)
            slope_u[k] = 0.5 * (_between(first, a + 1, b) - _between(first, a - 1, b))
            slope_v[k] = 0.5 * (_between(first, a, b + 1) - _between(first, a, b - 1))
            mean += shown[k]
            mean_u += slope_u[k]
            mean_v += slope_v[k]
        uu, uv, vv = 1e-9, 0.0, 1e-9
        for k in range(count):
            shown[k] -= mean / count
            slope_u[k] -= mean_u / count
            slope_v[k] -= mean_v / count
            uu += slope_u[k] * slope_u[k]
            uv += slope_u[k] * slope_v[k]
            vv += slope_v[k] * slope_v[k]
        area = uu * vv - uv * uv
        if area <= 1e-9 * (uu + vv) ** 2:
            continue
        for _ in range(rounds):
            if not _holds(second, x, y, half):
                break
            # the slopes have no mean, so that of the difference drops out of both sums
            along_u, along_v = 0.0, 0.0
            for k in range(count):
                left = shown[k] - _between(second, x + k % side - half, y + k // side - half)
                along_u += slope_u[k] * left
                along_v += slope_v[k] * left
            step_u = (vv * along_u - uv * along_v) / area
            step_v = (uu * along_v - uv * along_u) / area
            x, y = x + step_u, y + step_v
            if step_u * step_u + step_v * step_v < 1e-5:
                found[n] = _holds(second, x, y, half)
                break
        followed[n, 0], followed[n, 1] = np.float32(x), np.float32(y)
