"""Colours of a cloud from all images that show it, nearest or blended by weight; surface normals; colour sources."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import isfinite, radians

import numpy as np
from numba import boolean, float32, float64, int64, uint8, void

from sceneloom.arrays import (
    AnyArray,
    BoolArray,
    Float32Array,
    Float64Array,
    Int32Array,
    Int64Array,
    UInt8Array,
    check_array,
    hold_arrays,
)
from sceneloom.colouring.results import FusedView
from sceneloom.errors import OptionError
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.projection import BLOCK, sample_between_pixels
from sceneloom.kernels.signatures import (
    IN_BOOL_1D,
    IN_F32_1D,
    IN_F32_2D,
    IN_F64_1D,
    IN_F64_2D,
    IN_I32_1D,
    IN_I64_1D,
    IN_U8_3D,
    part,
)
from sceneloom.kernels.thread_pool import Phase, ThreadPool
from sceneloom.kernels.voxels import number_cubes

NO_CAMERA = 255
"""In `camera_index`: no image shows the point; its colour is then 255, 255, 255."""

NO_IMAGE_NS = np.iinfo(np.int64).min
"""In `images_ns`: no image shows the point."""


def colour_points(
    count: int, views: Sequence[FusedView], camera_indices: Sequence[int], *, threads: int = 1
) -> tuple[UInt8Array, UInt8Array]:
    """Give each point the colour of its nearest pixel.

    Of the images in which a point is visible, that counts in which it is nearest to the image's centre, in units of
    half the image's diagonal: camera models are sharpest and best calibrated there. Of equally near ones the first.

    Args:
        count: number of points of the cloud.
        views: the cloud in each image.
        camera_indices: what to write into `camera_index`, one for each view, 0 to 254.
        threads: number of threads for the points.

    Returns:
        colors: (count, 3) uint8, red green blue; 255, 255, 255 where no image shows the point.
        camera_index: (count,) uint8; 255 where no image shows the point.

    Raises:
        OptionError: the indices are not as many as the views, or out of range.
    """
    _check_indices(views, camera_indices)
    colors, camera_index = np.full((count, 3), 255, np.uint8), np.full(count, NO_CAMERA, np.uint8)
    eccentricities = np.full(count if len(views) > 1 else 0, np.inf)
    phases = []
    for view, index in zip(views, camera_indices, strict=True):
        paint = partial(
            paint_points, view.point_ids, view.pixels, view.pixel_numbers, view.visible, np.ascontiguousarray(view.rgb),
            index, eccentricities, colors, camera_index,
        )  # fmt: skip
        # the points of one image are all different: threads write to different rows
        phases.append(Phase(len(view.point_ids), paint))
    ThreadPool.of(threads, max((phase.length for phase in phases), default=0)).share(*phases)
    return colors, camera_index


def _check_indices(views: Sequence[FusedView], camera_indices: Sequence[int]) -> None:
    if len(views) != len(camera_indices):
        raise OptionError(f"{len(camera_indices)} camera indices for {len(views)} views; expected one each")
    for view, index in zip(views, camera_indices, strict=True):
        if not 0 <= index < NO_CAMERA:
            raise OptionError(f"camera {view.camera_id!r}: index {index}; expected 0 to {NO_CAMERA - 1}")


@dataclass(frozen=True, slots=True, eq=False)
class PointSources:
    """For each point the image whose colour counts most.

    Attributes:
        camera_index: (N,) uint8, the camera among the scene's, 255 for none.
        images_ns: (N,) int64 [ns], time of its image, `NO_IMAGE_NS` for none.
        pixels: (N, 2) float32 [px], position of the point in it, NaN for none.
        weights: (N,) float32, weight of the colour, 0 for none.
    """

    camera_index: UInt8Array
    images_ns: Int64Array
    pixels: Float32Array
    weights: Float32Array

    def __post_init__(self) -> None:
        fields = {"images_ns": (np.int64, "N"), "pixels": (np.float32, "N", 2), "weights": (np.float32, "N")}
        hold_arrays(self, "sources", {"camera_index": (np.uint8, "N"), **fields})

    @classmethod
    def none(cls, count: int) -> "PointSources":
        """Of points that no image shows; the arrays are new and may be filled."""
        return cls(
            np.full(count, 255, np.uint8),
            np.full(count, NO_IMAGE_NS, np.int64),
            np.full((count, 2), np.nan, np.float32),
            np.zeros(count, np.float32),
        )


_NEAR_SIDE, _NEAR = 0.4, 12.0
"""Up to this distance from the sensor cubes have the smallest side [m]; it doubles with the distance, as gaps do."""

_LEVELS = 4
_FEWEST = 5

_FLAT, _LINE = 0.1, 0.02
"""Of the eigenvalues of a plane's spread, the least is at most the first share of the middle one; and the middle one
at least the second share of the greatest, or else the points are on a line, as those of one scan line are."""


def estimate_normals(points_world: Float64Array, eye_world: Float64Array) -> Float32Array:
    """Estimate the surface normal at each point, of either sign.

    Args:
        points_world: (N, 3) float64 [m].
        eye_world: (3,) float64 [m], approximate position of the sensor.

    Returns:
        (N, 3) float32 unit vectors; 0 where the points around one make no plane.
    """
    check_array("points_world", points_world, (None, 3), np.float64)
    points = np.ascontiguousarray(points_world)
    normals = np.zeros((len(points), 3), np.float32)
    distances = np.linalg.norm(points - eye_world, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        levels = np.clip(np.ceil(np.log2(distances / _NEAR)), 0, _LEVELS - 1)
    for level in range(_LEVELS):
        rows = np.flatnonzero(levels == level)
        if len(rows):
            numbers = np.empty(len(rows), np.int64)
            count = number_cubes(points[rows], _NEAR_SIDE * 2.0**level, numbers)
            # a point in no cube has the number -1, the last row
            of_cubes = np.zeros((count + 1, 3), np.float32)
            if count:
                found, flat = _planes(points[rows], numbers, count)
                of_cubes[:count][flat] = found[flat]
            normals[rows] = of_cubes[numbers]
    return normals


def _planes(points_world: Float64Array, numbers: Int64Array, count: int) -> tuple[Float64Array, BoolArray]:
    """The axis of the least spread in each cube, (count, 3), and whether it is that of a plane."""
    rows = np.flatnonzero(numbers >= 0)
    inside, cubes = points_world[rows], numbers[rows]
    held = np.bincount(cubes, minlength=count)
    means = np.stack([np.bincount(cubes, inside[:, k], count) for k in range(3)], axis=1) / held[:, None]
    apart = inside - means[cubes]
    spread = np.empty((count, 3, 3))
    for a in range(3):
        for b in range(a, 3):
            spread[:, a, b] = spread[:, b, a] = np.bincount(cubes, apart[:, a] * apart[:, b], count)
    values, axes = np.linalg.eigh(spread)
    flat = (held >= _FEWEST) & (values[:, 0] <= _FLAT * values[:, 1]) & (values[:, 1] >= _LINE * values[:, 2])
    return axes[:, :, 0], flat


_OUTLINE_CELL_DEG = 0.25  # points beside an outline: their gap in the image is a few scan lines at most

_SURFACE_DISTANCE = 1.2
"""Nearly all surfaces pass the camera at this distance or more [m]: roads at the height of the camera."""

_REACH_CELLS = 2.0
_OUTLINE_STEP = 0.3  # least step in depth [m]
_MODES = ("best", "weighted")

_WEIGHTS = ("even_distance", "even_seconds", "border_share", "border_least", "least_cosine", "outline_factor")
"""Fields of `BlendSettings` in the order of `weigh_samples`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BlendSettings:
    """How the colours of several images are combined.

    A point falls beside its true position in the image by noise of the lidar, which does not depend on the distance,
    and by angles of mountings, whose effect does. Both are equal at `even_distance`: 3 cm and a tenth of a degree meet
    at 17 m. With time colours are wrong by what moves meanwhile, the ego trajectory included.

    Attributes:
        mode: "best", the colour with the greatest weight, or "weighted", the mean of all that agree with it.
        even_distance: where a weight is half of what it is nearby [m].
        even_seconds: time between point and image at which it is half [s].
        border_share: width of the image border in which weights fall, as a share of its shorter side.
        border_least: factor of a weight at the very border.
        least_cosine: factor of a weight where a surface is seen at grazing angle.
        outline_factor: factor of a weight beside the outline of something nearer or farther, to which a pixel's colour
            may belong.
        agreement: colours that differ from the best one by more levels in a channel are left out of the mean: one of
            them is of another surface.

    Raises:
        OptionError: a number is out of bounds, or the mode is none of these.
    """

    mode: str = "weighted"
    even_distance: float = 20.0
    even_seconds: float = 0.05
    border_share: float = 0.08
    border_least: float = 0.05
    least_cosine: float = 0.1
    outline_factor: float = 0.1
    agreement: float = 32.0

    def __post_init__(self) -> None:
        if self.mode not in _MODES:
            raise OptionError(f"mode {self.mode!r}; expected one of {', '.join(_MODES)}")
        for name in ("even_distance", "even_seconds", "agreement"):
            value = getattr(self, name)
            if not (isfinite(value) and value > 0):
                raise OptionError(f"{name} {value}; expected a finite number above 0")
        for name in ("border_share", "border_least", "least_cosine", "outline_factor"):
            value = getattr(self, name)
            if not 0 < value <= 1:
                raise OptionError(f"{name} {value}; expected more than 0 and at most 1")


def view_weights(
    points_world: Float64Array,
    view: FusedView,
    settings: BlendSettings,
    *,
    normals_world: Float32Array | None = None,
    timestamps_ns: Int64Array | None = None,
) -> Float32Array:
    """Weights of the colours of the points in an image.

    Args:
        points_world: (N, 3) float64 [m], contiguous.
        view: the points in the image.
        settings: of the weights.
        normals_world: (N, 3) float32 unit vectors, 0 where unknown; None: of no point.
        timestamps_ns: (N,) int64 [ns], when each point was measured; None: with the image.

    Returns:
        (M,) float32, one for each of `view.point_ids`; 0 for points that are not visible.
    """
    weights = np.empty(len(view.point_ids), np.float32)
    weigh_samples(
        points_world, view.point_ids, view.pixels, view.visible, near_outlines(view),
        np.zeros((0, 3), np.float32) if normals_world is None else normals_world,
        np.zeros(0, np.int64) if timestamps_ns is None else timestamps_ns,
        view.world_from_camera.matrix, view.camera.width, view.camera.height, view.timestamp_ns,
        np.array([getattr(settings, name) for name in _WEIGHTS]), weights,
    )  # fmt: skip
    return weights


def near_outlines(view: FusedView) -> BoolArray:
    """Which points of an image are beside an outline of something nearer or farther, (M,) bool."""
    found = np.empty(len(view.point_ids), np.bool_)
    focal_px = max(min(view.camera.fx, view.camera.fy), 1.0)
    cell_px = max(radians(_OUTLINE_CELL_DEG) * focal_px, 2.0)
    slope = _REACH_CELLS * cell_px / focal_px / _SURFACE_DISTANCE
    mark_outlines(
        view.pixels, view.depths, view.visible, view.camera.width, view.camera.height, cell_px, slope, _OUTLINE_STEP,
        found,
    )  # fmt: skip
    return found


_Gains = Mapping[int, Float64Array]
"""(3,) factors of red, green and blue for the image of each camera, by the camera's index; 1 for those left out."""

_NO_GAINS: _Gains = {}


@dataclass(frozen=True, slots=True, eq=False)
class BlendedPoints:
    """Colours of a cloud.

    Attributes:
        colors: (N, 3) uint8; 255, 255, 255 for a point that no image shows.
        sources: the image that counts most for each point.
    """

    colors: UInt8Array
    sources: PointSources


def blend_colours(
    points_world: Float64Array,
    views: Sequence[FusedView],
    camera_indices: Sequence[int],
    *,
    settings: BlendSettings | None = None,
    normals_world: Float32Array | None = None,
    timestamps_ns: Int64Array | None = None,
    gains: _Gains = _NO_GAINS,
) -> BlendedPoints:
    """Give each point the best, or the weighted mean, of the colours that images interpolate between their pixels.

    Args:
        points_world: (N, 3) float64 [m].
        views: the cloud in each image.
        camera_indices: of the camera of each view, 0 to 254.
        settings: mode and weights; None for the usual ones.
        normals_world: (N, 3) float32 unit vectors, 0 where unknown; None: the camera's axis is used for all of them.
        timestamps_ns: (N,) int64 [ns], when each point was measured; None: with the images.
        gains: factors of the colours of each camera's image.

    Raises:
        ArrayError: the arrays do not fit together.
        OptionError: the indices are not as many as the views, or out of range.
    """
    count = check_array("points_world", points_world, (None, 3), np.float64)
    check_array("normals_world", normals_world, (count, 3), np.float32, optional=True)
    check_array("timestamps_ns", timestamps_ns, (count,), np.int64, optional=True)
    _check_indices(views, camera_indices)
    chosen, points = settings or BlendSettings(), np.ascontiguousarray(points_world)
    best, sources = np.full((count, 3), 255, np.float32), PointSources.none(count)
    found = []
    for view, index in zip(views, camera_indices, strict=True):
        weights = view_weights(points, view, chosen, normals_world=normals_world, timestamps_ns=timestamps_ns)
        rows = np.flatnonzero(weights > 0)
        ids, weights, pixels = view.point_ids[rows], weights[rows], np.ascontiguousarray(view.pixels[rows])
        colors = np.empty((len(rows), 3), np.float32)
        sample_between_pixels(pixels, np.ascontiguousarray(view.rgb), colors)
        if index in gains:
            colors *= gains[index].astype(np.float32)
        found.append((ids, weights, colors))
        better = weights > sources.weights[ids]
        ids = ids[better]
        best[ids], sources.weights[ids], sources.pixels[ids] = colors[better], weights[better], pixels[better]
        sources.camera_index[ids], sources.images_ns[ids] = index, view.timestamp_ns
    if chosen.mode == "weighted" and len(views) > 1:
        sums, total = np.zeros((count, 3), np.float32), np.zeros(count, np.float32)
        for ids, weights, colors in found:
            # colours of another surface than the best one's would be ghosts
            agrees = (np.abs(colors - best[ids]) <= chosen.agreement).all(axis=1)
            sums[ids[agrees]] += weights[agrees, None] * colors[agrees]
            total[ids[agrees]] += weights[agrees]
        seen = total > 0
        best[seen] = sums[seen] / total[seen, None]
    return BlendedPoints(np.rint(np.clip(best, 0.0, 255.0)).astype(np.uint8), sources)


_GREEN, _BLUE = np.uint64(1), np.uint64(2)


@part
def _number_painted(
    pixel_numbers: Int32Array, size: int, visible: BoolArray, point_ids: Int64Array, count: int, numbers: AnyArray
) -> None:  # fmt: skip
    """Write the points' pixels, of which there are `size`; -1 for points that are not visible or do not exist."""
    for i in range(numbers.shape[0]):
        inside = np.uint32(pixel_numbers[i]) < np.uint32(size)
        painted = inside & visible[i] & (np.uint64(point_ids[i]) < np.uint64(count))
        numbers[i] = pixel_numbers[i] if painted else np.int32(-1)


@part
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


@part
def _paint_block(
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


@kernel(void(
    IN_I64_1D, IN_F32_2D, IN_I32_1D, IN_BOOL_1D, IN_U8_3D, uint8, float64[::1], uint8[:, ::1], uint8[::1],
    int64, int64, int64,
))  # fmt: skip
def paint_points(
    point_ids: Int64Array, pixels: Float32Array, pixel_numbers: Int32Array, visible: BoolArray, rgb: UInt8Array,
    camera: int, eccentricities: Float64Array, colors: UInt8Array, camera_index: UInt8Array, _: int, a: int, b: int,
) -> None:  # fmt: skip
    """Give each visible point its nearest pixel's colour if this image shows it more centrally than those before.

    Of the points of the image those from a to b.

    `point_ids` (M,), rows of the outputs; `pixels` (M, 2) [px]; `pixel_numbers` (M,), the nearest ones, counted row by
    row; negative outside the image; `visible` (M,); `rgb` (H, W, 3), the image; `camera`: number to write into
    `camera_index`; `eccentricities` (N,), updated: least squared distance so far from an image's centre, in half
    diagonals; or (0,) where this image is the only one; `colors` (N, 3), updated; `camera_index` (N,), updated.
    """
    height, width = rgb.shape[0], rgb.shape[1]
    flat_pixels, flat_rgb, flat_colors = (
        pixels.reshape(pixels.size),
        rgb.reshape(rgb.size),
        colors.reshape(colors.size),
    )
    numbers, size = np.empty(BLOCK, np.int32), width * height
    for start in range(a, b, BLOCK):
        stop = min(start + BLOCK, b)
        block, ids = numbers[: stop - start], point_ids[start:stop]
        _number_painted(pixel_numbers[start:stop], size, visible[start:stop], ids, camera_index.shape[0], block)
        if eccentricities.shape[0] > 0:
            _choose(ids, flat_pixels[2 * start : 2 * stop], width, height, eccentricities, block)
        _paint_block(block, ids, flat_rgb, camera, flat_colors, camera_index)


_LEAST_DEPTH = np.float32(0.05)
"""Points beside or behind the camera, which wide camera models show, too, have no inverse depth to compare [m]."""


@kernel(void(IN_F32_2D, IN_F32_1D, IN_BOOL_1D, int64, int64, float64, float64, float64, boolean[::1]))
def mark_outlines(
    pixels: Float32Array, depths: Float32Array, visible: BoolArray, width: int, height: int, cell_px: float,
    slope: float, margin: float, near_outline: BoolArray,
) -> None:  # fmt: skip
    """Mark points that have a nearer surface, or behind them a farther visible one, beside them in the image.

    On one surface, the inverse depth changes by at most `slope` over the reach of three cells; `margin` [m] is what
    counts as a step besides.

    `pixels` (M, 2) [px]; `depths` (M,) [m]; points that are not in front of the camera model are never marked;
    `visible` (M,); `width`, `height`: of the image [px]; `cell_px`: side of the cells; neighbours are looked for in
    three by three of them; `slope` [1/m]; `margin` [m]; `near_outline` (M,), written.
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


@kernel(void(
    IN_F64_2D, IN_I64_1D, IN_F32_2D, IN_BOOL_1D, IN_BOOL_1D, IN_F32_2D, IN_I64_1D, IN_F64_2D, int64, int64, int64,
    IN_F64_1D, float32[::1]
))  # fmt: skip
def weigh_samples(
    points_world: Float64Array, point_ids: Int64Array, pixels: Float32Array, visible: BoolArray,
    near_outline: BoolArray, normals_world: Float32Array, times_ns: Int64Array, world_from_camera: Float64Array,
    width: int, height: int, image_ns: int, numbers: Float64Array, weights: Float32Array,
) -> None:  # fmt: skip
    """The weight of the colour of each point in an image, 0 for points that are not visible.

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
