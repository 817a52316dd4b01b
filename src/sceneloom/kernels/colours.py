"""Between points and pixels: nearest depths per pixel, colours of points, sub-pixel samples with contrast and trust.

And label votes.
"""

import math

import numba
import numpy as np
from numba import boolean, float32, float64, int32, int64, types, uint8, uint16, void

from sceneloom.arrays import (
    AnyArray,
    BoolArray,
    Float32Array,
    Float64Array,
    Int32Array,
    Int64Array,
    UInt8Array,
    UInt16Array,
)
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.projection import BLOCK, PART
from sceneloom.kernels.thread_pool import ALONE, ThreadPool

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)

_IN_I32_1D = types.Array(int32, 1, "C", readonly=True)

_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)

_IN_BOOL_1D = types.Array(boolean, 1, "C", readonly=True)

_NOTHING, _STATIC = np.float32(0.0), np.float32(math.inf)


@numba.njit(**PART)
def _pick(
    numbers: Int32Array, depths: Float32Array, visible: BoolArray, first: int, size: int, locations: AnyArray
) -> None:
    """Write where in some rows of the image the points are drawn; -1 for those that are not."""
    for i in range(locations.shape[0]):
        drawn = (depths[i] > _NOTHING) & (depths[i] < _STATIC) & visible[i]
        location = np.int32(numbers[i] - np.int32(first))
        locations[i] = location if drawn & (np.uint32(location) < np.uint32(size)) else np.int32(-1)


@numba.njit(**PART)
def _draw(locations: AnyArray, depths: Float32Array, rows: Float32Array) -> None:
    for i in range(depths.shape[0]):
        if locations[i] >= 0:
            depth, p = depths[i], np.uint64(locations[i])
            there = rows[p]
            rows[p] = depth if (there == _NOTHING) | (depth < there) else there


@kernel(
    void(_IN_I32_1D, _IN_F32_1D, _IN_BOOL_1D, int64, int64, float32[:, ::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def _draw_rows(
    numbers: Int32Array,
    depths: Float32Array,
    visible: BoolArray,
    top: int,
    bottom: int,
    depth_image: AnyArray,
) -> None:
    """Draw what falls into some rows of the image."""
    width, count = depth_image.shape[1], depths.shape[0]
    first, rows = top * width, depth_image.reshape(depth_image.size)[top * width : bottom * width]
    locations = np.empty(BLOCK, np.int32)
    for start in range(0, count, BLOCK):
        stop = min(start + BLOCK, count)
        block = locations[: stop - start]
        _pick(numbers[start:stop], depths[start:stop], visible[start:stop], first, rows.shape[0], block)
        _draw(block, depths[start:stop], rows)


def draw_depths(
    pixel_numbers: Int32Array,
    depths: Float32Array,
    visible: BoolArray,
    depth_image: Float32Array,
    *,
    thread_pool: ThreadPool = ALONE,
) -> None:
    """Lower each pixel of the depth image to the least positive depth of the visible points in it.

    Args:
        pixel_numbers: (M,), counted row by row; negative outside the image.
        depths: (M,) [m].
        visible: (M,); other points make no depth.
        depth_image: (H, W) [m], 0 for nothing; written.
        thread_pool: the threads that share the rows of the image.
    """
    rows = len(depth_image)
    thread_pool.share(
        rows, lambda _, top, bottom: _draw_rows(pixel_numbers, depths, visible, top, bottom, depth_image)
    )


@kernel(void(_IN_I32_1D, _IN_F32_1D, _IN_F32_2D, boolean[::1]), cache=True, nogil=True, error_model="numpy")
def mark_nearest(
    pixel_numbers: Int32Array, depths: Float32Array, depth_image: Float32Array, visible: BoolArray
) -> None:
    """Mark the points that are the nearest of their pixel, as a z-buffer over all of them says.

    Args:
        pixel_numbers: (M,), counted row by row; negative outside the image.
        depths: (M,) [m].
        depth_image: (H, W) [m], least depth of each pixel, 0 for nothing.
        visible: (M,), written; equally near points are all visible, and so is a point of a very wide camera model that
            lies beside or behind the camera (depth <= 0), with which no depth can be compared.
    """
    image = depth_image.reshape(depth_image.size)
    for i in range(depths.shape[0]):
        inside = (pixel_numbers[i] >= 0) & (pixel_numbers[i] < image.shape[0])
        nearest = image[np.uint32(pixel_numbers[i])] if inside else -_STATIC
        visible[i] = inside & (depths[i] <= max(nearest, _NOTHING))


_IN_I64_1D = types.Array(int64, 1, "C", readonly=True)

_IN_U8_3D = types.Array(uint8, 3, "C", readonly=True)

_GREEN, _BLUE = np.uint64(1), np.uint64(2)


@numba.njit(**PART)
def _point_colours_pick(
    pixel_numbers: Int32Array, size: int, visible: BoolArray, point_ids: Int64Array, count: int, numbers: AnyArray
) -> None:  # fmt: skip
    """Write the points' pixels, of which there are `size`; -1 for points that are unseen or do not exist."""
    for i in range(numbers.shape[0]):
        inside = np.uint32(pixel_numbers[i]) < np.uint32(size)
        painted = inside & visible[i] & (np.uint64(point_ids[i]) < np.uint64(count))
        numbers[i] = pixel_numbers[i] if painted else np.int32(-1)


@numba.njit(**PART)
def _choose(
    point_ids: Int64Array, flat_pixels: Float32Array, width: int, height: int, eccentricities: Float64Array,
    numbers: AnyArray,
) -> None:  # fmt: skip
    """Cross out, likewise, points that were seen more centrally before."""
    center_u, center_v = 0.5 * (width - 1), 0.5 * (height - 1)
    per_square = 4.0 / np.float64(width * width + height * height)
    for i in range(numbers.shape[0]):
        if numbers[i] < 0:
            continue
        k = np.uint64(point_ids[i])
        du, dv = flat_pixels[2 * i] - center_u, flat_pixels[2 * i + 1] - center_v
        eccentricity = (du * du + dv * dv) * per_square
        if eccentricity < eccentricities[k]:
            eccentricities[k] = eccentricity
        else:
            numbers[i] = -1


@numba.njit(**PART)
def _paint(
    numbers: AnyArray, point_ids: Int64Array, flat_rgb: UInt8Array, camera: int, flat_colors: UInt8Array,
    camera_index: UInt8Array,
) -> None:  # fmt: skip
    """Copy the colours of the pixels of a block of points."""
    for i in range(point_ids.shape[0]):
        if numbers[i] >= 0:
            k = np.uint64(point_ids[i])
            source, target = np.uint64(3) * np.uint64(numbers[i]), np.uint64(3) * k
            # Read as one before written, since for the compiler a colour might lie where the next is read.
            red, green, blue = flat_rgb[source], flat_rgb[source + _GREEN], flat_rgb[source + _BLUE]
            flat_colors[target], flat_colors[target + _GREEN], flat_colors[target + _BLUE] = red, green, blue
            camera_index[k] = camera


@kernel(
    void(
        _IN_I64_1D,
        _IN_F32_2D,
        _IN_I32_1D,
        _IN_BOOL_1D,
        _IN_U8_3D,
        uint8,
        float64[::1],
        uint8[:, ::1],
        uint8[::1],
    ),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def paint_points(
    point_ids: Int64Array,
    pixels: Float32Array,
    pixel_numbers: Int32Array,
    visible: BoolArray,
    rgb: UInt8Array,
    camera: int,
    eccentricities: Float64Array,
    colors: UInt8Array,
    camera_index: UInt8Array,
) -> None:
    """Give each visible point its nearest pixel's colour if this image shows it more centrally than those before.

    Args:
        point_ids: (M,), rows of the outputs.
        pixels: (M, 2) [px].
        pixel_numbers: (M,), the nearest ones, counted row by row; negative outside the image.
        visible: (M,).
        rgb: (H, W, 3), the image.
        camera: number to write into `camera_index`.
        eccentricities: (N,), updated: least squared distance so far from an image's centre, in half diagonals; or
            (0,) where this image is the only one.
        colors: (N, 3), updated.
        camera_index: (N,), updated.
    """
    height, width = rgb.shape[0], rgb.shape[1]
    flat_pixels, flat_rgb, flat_colors = (
        pixels.reshape(pixels.size),
        rgb.reshape(rgb.size),
        colors.reshape(colors.size),
    )
    count = point_ids.shape[0]
    numbers, size = np.empty(BLOCK, np.int32), width * height
    for start in range(0, count, BLOCK):
        stop = min(start + BLOCK, count)
        block, ids = numbers[: stop - start], point_ids[start:stop]
        _point_colours_pick(
            pixel_numbers[start:stop], size, visible[start:stop], ids, camera_index.shape[0], block
        )
        if eccentricities.shape[0] > 0:
            _choose(ids, flat_pixels[2 * start : 2 * stop], width, height, eccentricities, block)
        _paint(block, ids, flat_rgb, camera, flat_colors, camera_index)


_IN_F64_1D = types.Array(float64, 1, "C", readonly=True)

_IN_F64_2D = types.Array(float64, 2, "C", readonly=True)

_CONTRAST_STEP_PX = 2.0
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
                du = _CONTRAST_STEP_PX * ((k == 1) - (k == 2))
                dv = _CONTRAST_STEP_PX * ((k == 3) - (k == 4))
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


_IN_U16_1D = types.Array(uint16, 1, "C", readonly=True)

_IN_U16_2D = types.Array(uint16, 2, "C", readonly=True)


@kernel(
    void(_IN_I64_1D, _IN_F32_2D, _IN_F32_1D, _IN_U16_2D, uint16[::1], float32[::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def take_labels(
    point_ids: Int64Array,
    pixels: Float32Array,
    weights: Float32Array,
    labels: UInt16Array,
    votes: UInt16Array,
    trust: Float32Array,
) -> None:
    """Give each point that an image shows the label of its nearest pixel.

    Args:
        point_ids: (M,), rows of the outputs.
        pixels: (M, 2) [px].
        weights: (M,), 0 for points that are not visible, which are passed over.
        labels: (H, W).
        votes, trust: (N,), written where the image shows the point.
    """
    height, width = labels.shape
    for i in range(point_ids.shape[0]):
        if weights[i] > 0.0:
            column = min(max(math.floor(pixels[i, 0] + 0.5), 0), width - 1)
            row = min(max(math.floor(pixels[i, 1] + 0.5), 0), height - 1)
            votes[point_ids[i]] = labels[row, column]
            trust[point_ids[i]] = weights[i]


@kernel(
    void(_IN_U16_2D, types.Array(float32, 2, "C", readonly=True), uint16, uint16[::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def count_votes(votes: UInt16Array, trust: Float32Array, none: int, labels: UInt16Array) -> None:
    """Give each point the label that most images give it; of equally many the one that is trusted more.

    Args:
        votes: (V, N), `none` where an image says nothing.
        trust: (V, N).
        none: what stands for no label.
        labels: (N,), written.
    """
    for i in range(votes.shape[1]):
        labels[i] = none
        most, surest = 0, np.float32(0.0)
        for a in range(votes.shape[0]):
            if votes[a, i] == none:
                continue
            count, sure = 0, np.float32(0.0)
            for b in range(votes.shape[0]):
                if votes[b, i] == votes[a, i]:
                    count += 1
                    sure += trust[b, i]
            if count > most or (count == most and sure > surest):
                most, surest, labels[i] = count, sure, votes[a, i]


@kernel(
    void(
        _IN_I64_1D,
        _IN_F32_2D,
        _IN_F32_1D,
        _IN_BOOL_1D,
        _IN_U16_1D,
        uint16,
        int64,
        float32[:, ::1],
        uint16[:, ::1],
    ),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def draw_labels(
    point_ids: Int64Array,
    pixels: Float32Array,
    depths: Float32Array,
    visible: BoolArray,
    labels: UInt16Array,
    none: int,
    radius_px: int,
    depth_image: Float32Array,
    label_image: UInt16Array,
) -> None:
    """Draw the labels of visible points into an image, each as a square; the nearest point of a pixel counts.

    Points without a label cover what is behind them, too, and leave their pixels as they are.

    Args:
        point_ids: (M,), rows of `labels`.
        pixels: (M, 2) [px].
        depths: (M,) [m].
        visible: (M,).
        labels: (N,), `none` for points without one.
        none: what stands for no label.
        radius_px: of the square beside the pixel itself.
        depth_image: (H, W) [m], updated: depth of the nearest point drawn so far, infinite for none.
        label_image: (H, W), updated; 0 where no labelled point is.
    """
    height, width = label_image.shape
    for i in range(point_ids.shape[0]):
        if not visible[i]:
            continue
        label = labels[point_ids[i]]
        column = min(max(math.floor(pixels[i, 0] + 0.5), 0), width - 1)
        row = min(max(math.floor(pixels[i, 1] + 0.5), 0), height - 1)
        for r in range(max(row - radius_px, 0), min(row + radius_px + 1, height)):
            for c in range(max(column - radius_px, 0), min(column + radius_px + 1, width)):
                if depths[i] < depth_image[r, c]:
                    depth_image[r, c] = depths[i]
                    label_image[r, c] = 0 if label == none else label
