"""What points get from an image: colours between the pixels, how plain it is around them, and how far to trust it."""

import math

import numpy as np
from numba import boolean, float32, float64, int64, types, uint8, void

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array
from sceneloom.kernels.cache import kernel

_IN_I64_1D = types.Array(int64, 1, "C", readonly=True)
_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)
_IN_F64_1D = types.Array(float64, 1, "C", readonly=True)
_IN_F64_2D = types.Array(float64, 2, "C", readonly=True)
_IN_BOOL_1D = types.Array(boolean, 1, "C", readonly=True)
_IN_U8_3D = types.Array(uint8, 3, "C", readonly=True)

CONTRAST_STEP_PX = 2.0
"""How far from a point's pixel the image is looked at to report how plain it is there [px]."""


_LEAST_DEPTH = np.float32(0.05)
"""Points beside the camera_model or behind it, which wide camera_models show, too.

Have no inverse depth to compare [m].
"""


@kernel(
    void(_IN_F32_2D, _IN_U8_3D, float32[:, ::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def sample_between_pixels(pixels: Float32Array, rgb: UInt8Array, colors: Float32Array) -> None:
    """Take colours at locations between the pixels' centres, linearly along both axes; beyond the outer centres theirs.

    Args:
        pixels: (M, 2) [px], finite.
        rgb: (H, W, 3).
        colors: (M, 3), written, 0 to 255.
    """
    height, width = rgb.shape[0], rgb.shape[1]
    for i in range(pixels.shape[0]):
        u = min(max(float32(pixels[i, 0]), float32(0.0)), float32(width - 1))
        v = min(max(float32(pixels[i, 1]), float32(0.0)), float32(height - 1))
        left, top = min(int(u), max(width - 2, 0)), min(int(v), max(height - 2, 0))
        right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
        a, b = u - float32(left), v - float32(top)
        for c in range(3):
            upper = (float32(1.0) - a) * rgb[top, left, c] + a * rgb[top, right, c]
            lower = (float32(1.0) - a) * rgb[bottom, left, c] + a * rgb[bottom, right, c]
            colors[i, c] = (float32(1.0) - b) * upper + b * lower


@kernel(
    void(_IN_F32_2D, _IN_U8_3D, float32[::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def measure_contrasts(pixels: Float32Array, rgb: UInt8Array, contrasts: Float32Array) -> None:
    """Report by how much an image changes around locations: the greatest difference of a channel among five pixels.

    Args:
        pixels: (M, 2) [px], finite.
        rgb: (H, W, 3).
        contrasts: (M,), written, 0 to 255.
    """
    height, width = rgb.shape[0], rgb.shape[1]
    for i in range(pixels.shape[0]):
        greatest = 0
        for c in range(3):
            low, high = 255, 0
            for k in range(5):
                du = CONTRAST_STEP_PX * ((k == 1) - (k == 2))
                dv = CONTRAST_STEP_PX * ((k == 3) - (k == 4))
                column = min(max(math.floor(pixels[i, 0] + du + 0.5), 0), width - 1)
                row = min(max(math.floor(pixels[i, 1] + dv + 0.5), 0), height - 1)
                value = int(rgb[row, column, c])
                low, high = min(low, value), max(high, value)
            greatest = max(greatest, high - low)
        contrasts[i] = greatest


@kernel(
    void(_IN_F32_2D, _IN_F32_1D, _IN_BOOL_1D, int64, int64, float64, float64, float64, boolean[::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def mark_outlines(
    pixels: Float32Array,
    depths: Float32Array,
    visible: BoolArray,
    width: int,
    height: int,
    cell_px: float,
    slope: float,
    margin: float,
    near_outline: BoolArray,
) -> None:
    """Mark points that have a nearer surface, or behind them a farther visible one, beside them in the image.

    On one surface, the inverse depth changes by at most `slope` over the reach of three cells; `margin` [m] is what
    counts as a step besides.

    Args:
        pixels: (M, 2) [px].
        depths: (M,) [m]; points that are not in front of the camera model are never marked.
        visible: (M,).
        width, height: of the image [px].
        cell_px: side of the cells; neighbours are looked for in three by three of them.
        slope: [1/m].
        margin: [m].
        near_outline: (M,), written.
    """
    columns, rows = int(width / cell_px) + 3, int(height / cell_px) + 3
    nearest = np.zeros((rows, columns), np.float32)
    farthest = np.full((rows, columns), np.float32(np.inf))
    locations = np.empty((pixels.shape[0], 2), np.int32)
    for i in range(pixels.shape[0]):
        column = min(max(int((pixels[i, 0] + 0.5) / cell_px), 0), columns - 3) + 1
        row = min(max(int((pixels[i, 1] + 0.5) / cell_px), 0), rows - 3) + 1
        locations[i, 0], locations[i, 1] = column, row
        if not depths[i] > _LEAST_DEPTH:
            continue
        inverse = float32(1.0) / depths[i]
        nearest[row, column] = max(nearest[row, column], inverse)
        if visible[i]:
            farthest[row, column] = min(farthest[row, column], inverse)
    for i in range(pixels.shape[0]):
        near_outline[i] = False
        if not depths[i] > _LEAST_DEPTH:
            continue
        inverse = float32(1.0) / depths[i]
        step = slope + margin * inverse * inverse
        high, low = inverse, inverse
        for row in range(locations[i, 1] - 1, locations[i, 1] + 2):
            for column in range(locations[i, 0] - 1, locations[i, 0] + 2):
                high = max(high, nearest[row, column])
                low = min(low, farthest[row, column])
        near_outline[i] = (high - inverse > step) | (inverse - low > step)


@kernel(
    void(
        _IN_F64_2D, _IN_I64_1D, _IN_F32_2D, _IN_BOOL_1D, _IN_BOOL_1D, _IN_F32_2D, _IN_I64_1D, _IN_F64_2D, int64, int64,
        int64, _IN_F64_1D, float32[::1],
    ),
    cache=True,
    nogil=True,
    error_model="numpy",
)  # fmt: skip
def weigh_samples(
    points_world: Float64Array,
    point_ids: Int64Array,
    pixels: Float32Array,
    visible: BoolArray,
    near_outline: BoolArray,
    normals_world: Float32Array,
    times_ns: Int64Array,
    world_from_camera: Float64Array,
    width: int,
    height: int,
    image_ns: int,
    numbers: Float64Array,
    weights: Float32Array,
) -> None:
    """Report how far the colour of each point in an image is to be trusted, 0 for points that are not visible.

    The weight is the product of five: the cosine between the line of sight and the surface's normal, or the camera's
    axis where none is known; 1 / (1 + (distance / d)²); 1 / (1 + (time apart / t)²); a ramp from the image's border
    inwards; and a factor for points beside an outline.

    Args:
        points_world: (N, 3) [m].
        point_ids: (M,), rows of `points_world`, `normals_world` and `times_ns`.
        pixels: (M, 2) [px].
        visible, near_outline: (M,).
        normals_world: (N, 3) unit vectors, 0 where not known; or (0, 3).
        times_ns: (N,) [ns]; or (0,).
        world_from_camera: (3, 4) or (4, 4).
        width, height: of the image [px].
        image_ns: its time [ns].
        numbers: d [m], t [s], width of the ramp as a share of the image's shorter side, least factor of the border,
            least cosine, factor beside an outline.
        weights: (M,), written.
    """
    ramp_px = max(numbers[2] * min(width, height), 1e-6)
    for i in range(point_ids.shape[0]):
        if not visible[i]:
            weights[i] = 0.0
            continue
        k = point_ids[i]
        x = points_world[k, 0] - world_from_camera[0, 3]
        y = points_world[k, 1] - world_from_camera[1, 3]
        z = points_world[k, 2] - world_from_camera[2, 3]
        distance = max(math.sqrt(x * x + y * y + z * z), 1e-9)
        nx, ny, nz = 0.0, 0.0, 0.0
        if normals_world.shape[0] > 0:
            nx, ny, nz = normals_world[k, 0], normals_world[k, 1], normals_world[k, 2]
        if nx == 0.0 and ny == 0.0 and nz == 0.0:
            nx, ny, nz = world_from_camera[0, 2], world_from_camera[1, 2], world_from_camera[2, 2]
        cosine = max(abs(nx * x + ny * y + nz * z) / distance, numbers[4])
        apart = (times_ns[k] - image_ns) * 1e-9 if times_ns.shape[0] > 0 else 0.0
        border_px = min(pixels[i, 0], width - 1 - pixels[i, 0], pixels[i, 1], height - 1 - pixels[i, 1])
        border = min(max((border_px + 0.5) / ramp_px, numbers[3]), 1.0)
        weight = cosine * border / (1.0 + (distance / numbers[0]) ** 2) / (1.0 + (apart / numbers[1]) ** 2)
        weights[i] = weight * (numbers[5] if near_outline[i] else 1.0)
