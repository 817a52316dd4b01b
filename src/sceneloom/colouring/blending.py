"""Colours of a cloud from all images that show it, of nearest pixels or blended; where they come from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numba import float64, int64, uint8, void

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
from sceneloom.kernels.projection import BLOCK, sample_footprints
from sceneloom.kernels.signatures import IN_BOOL_1D, IN_F32_2D, IN_I32_1D, IN_I64_1D, IN_U8_3D, part
from sceneloom.kernels.thread_pool import Phase, ThreadPool

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
    """For each point the image whose colour counts most, of equal ones the first.

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


_EVEN_SECONDS = 0.05
"""Time between a point and an image at which its weight is half [s]: what is measured within half a sweep of 0.1 s
counts as simultaneous; later, colours are wrong by what moves meanwhile and by what the poses are wrong by."""

_BEAM = 3e-3
"""Width of a lidar's beam [rad]. Source: Velodyne VLS-128 manual, table F-1: 3.0 by 1.5 mrad."""


def view_weights(view: FusedView, timestamps_ns: Int64Array | None = None) -> Float32Array:
    """Weights of the points in an image, (M,) float32: 1 / (1 + (time apart / 0.05 s)²); 0 for hidden points.

    Args:
        view: the points in the image.
        timestamps_ns: (N,) int64 [ns], when each point of the cloud was measured; None: with the image.
    """
    if timestamps_ns is None:
        return view.visible.astype(np.float32)
    apart = (timestamps_ns[view.point_ids] - view.timestamp_ns) * (1e-9 / _EVEN_SECONDS)
    return np.where(view.visible, 1.0 / (1.0 + apart * apart), 0.0).astype(np.float32)


def sample_view(view: FusedView, pixels: Float32Array) -> Float32Array:
    """Colours at pixels (K, 2) of a view's image, each the mean over the footprint of a beam, (K, 3) float32."""
    colors = np.empty((len(pixels), 3), np.float32)
    width_px = max(_BEAM * min(view.camera.fx, view.camera.fy), 1.0)
    sample_footprints(np.ascontiguousarray(pixels), np.ascontiguousarray(view.rgb), width_px, colors)
    return colors


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
    timestamps_ns: Int64Array | None = None,
    gains: _Gains = _NO_GAINS,
) -> BlendedPoints:
    """Give each point the mean of the colours of all images that show it, those near to its time counting most.

    In an image, the colour of a point is the mean over the footprint of the lidar's beam.

    Args:
        points_world: (N, 3) float64 [m].
        views: the cloud in each image, of one moment or of several.
        camera_indices: of the camera of each view, 0 to 254.
        timestamps_ns: (N,) int64 [ns], when each point was measured; None: with the images.
        gains: factors of the colours of each camera's image.

    Raises:
        ArrayError: the arrays do not fit together.
        OptionError: the indices are not as many as the views, or out of range.
    """
    count = check_array("points_world", points_world, (None, 3), np.float64)
    check_array("timestamps_ns", timestamps_ns, (count,), np.int64, optional=True)
    _check_indices(views, camera_indices)
    sums, total, sources = np.zeros((count, 3), np.float32), np.zeros(count, np.float32), PointSources.none(count)
    for view, index in zip(views, camera_indices, strict=True):
        rows = np.flatnonzero(view.visible)
        ids, pixels, weights = view.point_ids[rows], view.pixels[rows], view_weights(view, timestamps_ns)[rows]
        sampled = sample_view(view, pixels)
        if index in gains:
            sampled *= gains[index].astype(np.float32)
        sums[ids] += weights[:, None] * sampled
        total[ids] += weights
        better = weights > sources.weights[ids]
        ids = ids[better]
        sources.weights[ids], sources.pixels[ids] = weights[better], pixels[better]
        sources.camera_index[ids], sources.images_ns[ids] = index, view.timestamp_ns
    colors, seen = np.full((count, 3), 255, np.uint8), total > 0
    colors[seen] = np.rint(np.clip(sums[seen] / total[seen, None], 0.0, 255.0))
    return BlendedPoints(colors, sources)


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
