"""Colours of a cloud out of all images that show it, by weight, between the pixels, with their provenance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array, UInt8Array, check_array
from sceneloom.colouring.colours import NO_CAMERA
from sceneloom.colouring.provenance import PointSources
from sceneloom.colouring.results import FusedView
from sceneloom.colouring.weights import BlendSettings, view_weights
from sceneloom.errors import OptionError
from sceneloom.kernels.image_samples import sample_between_pixels

Gains = Mapping[int, Float64Array]
"""(3,) factors of red, green and blue for the image of each camera, by the camera's index; 1 for those left out."""

NO_GAINS: Gains = {}


@dataclass(frozen=True, slots=True, eq=False)
class BlendedPoints:
    """Colours of a cloud.

    Attributes:
        colors: (N, 3) uint8; 255, 255, 255 for a point that no image shows.
        sources: the image that counts most for each point.
    """

    colors: UInt8Array
    sources: PointSources


@dataclass(slots=True)
class _Samples:
    """What one image gives to the points it shows."""

    ids: Int64Array
    weights: Float32Array
    colors: Float32Array
    pixels: Float32Array


@dataclass(slots=True)
class _Sum:
    """The best colour so far, and the sum of those that agree with it."""

    sources: PointSources
    best: Float32Array
    colors: Float32Array
    weights: Float32Array = field(init=False)

    def __post_init__(self) -> None:
        self.weights = np.zeros(len(self.best), np.float32)


def blend_colours(
    points_world: Float64Array,
    views: Sequence[FusedView],
    camera_indices: Sequence[int],
    *,
    settings: BlendSettings | None = None,
    normals_world: Float32Array | None = None,
    timestamps_ns: Int64Array | None = None,
    gains: Gains = NO_GAINS,
) -> BlendedPoints:
    """Give each point the best, or the weighted mean, of the colours that images give it between their pixels.

    Args:
        points_world: (N, 3) float64 [m].
        views: the cloud in each image.
        camera_indices: of the camera of each view, 0 to 254.
        settings: mode and weights; None for the usual ones.
        normals_world: (N, 3) float32 unit vectors, 0 where not known; None: the camera's axis stands for all of them.
        timestamps_ns: (N,) int64 [ns], when each point was measured; None: with the images.
        gains: what the colours of each camera's image are multiplied by.

    Raises:
        ArrayError: the arrays do not fit together.
        OptionError: the indices are not as many as the views, or out of range.
    """
    count = check_array("points_world", points_world, (None, 3), np.float64)
    check_array("normals_world", normals_world, (count, 3), np.float32, optional=True)
    check_array("timestamps_ns", timestamps_ns, (count,), np.int64, optional=True)
    _check_indices(views, camera_indices)
    chosen, points = settings or BlendSettings(), np.ascontiguousarray(points_world)
    found = [
        _sampled(
            view,
            view_weights(points, view, chosen, normals_world=normals_world, timestamps_ns=timestamps_ns),
            gains.get(index),
        )
        for view, index in zip(views, camera_indices, strict=True)
    ]
    total = _Sum(
        PointSources.none(count), np.full((count, 3), 255, np.float32), np.zeros((count, 3), np.float32)
    )
    for samples, view, index in zip(found, views, camera_indices, strict=True):
        _take_better(samples, view, index, total)
    if chosen.mode == "best" or len(views) < 2:
        return BlendedPoints(_levels(total.best), total.sources)
    for samples in found:
        _add_agreeing(samples, chosen.agreement, total)
    seen = total.weights > 0
    total.best[seen] = total.colors[seen] / total.weights[seen, None]
    return BlendedPoints(_levels(total.best), total.sources)


def _check_indices(views: Sequence[FusedView], camera_indices: Sequence[int]) -> None:
    if len(views) != len(camera_indices):
        raise OptionError(f"{len(camera_indices)} camera indices for {len(views)} views; expected one each")
    for view, index in zip(views, camera_indices, strict=True):
        if not 0 <= index < NO_CAMERA:
            raise OptionError(f"camera {view.camera_id!r}: index {index}; expected 0 to {NO_CAMERA - 1}")


def _sampled(view: FusedView, weights: Float32Array, gain: Float64Array | None) -> _Samples:
    """Colours between the pixels of the points that an image shows."""
    rows = np.flatnonzero(weights > 0)
    pixels = np.ascontiguousarray(view.pixels[rows])
    colors = np.empty((len(rows), 3), np.float32)
    sample_between_pixels(pixels, np.ascontiguousarray(view.rgb), colors)
    if gain is not None:
        colors *= gain.astype(np.float32)
    return _Samples(view.point_ids[rows], weights[rows], colors, pixels)


def _take_better(samples: _Samples, view: FusedView, index: int, total: _Sum) -> None:
    """Note the colours that are trusted more than the best ones so far."""
    sources = total.sources
    better = samples.weights > sources.weights[samples.ids]
    ids = samples.ids[better]
    total.best[ids] = samples.colors[better]
    sources.weights[ids] = samples.weights[better]
    sources.camera_index[ids] = index
    sources.images_ns[ids] = view.timestamp_ns
    sources.pixels[ids] = samples.pixels[better]


def _add_agreeing(samples: _Samples, agreement: float, total: _Sum) -> None:
    """Add up the colours that are near the best one; those of another surface would be ghosts."""
    agrees = (np.abs(samples.colors - total.best[samples.ids]) <= agreement).all(axis=1)
    ids, weights = samples.ids[agrees], samples.weights[agrees]
    total.colors[ids] += weights[:, None] * samples.colors[agrees]
    total.weights[ids] += weights


def _levels(colors: Float32Array) -> UInt8Array:
    levels: UInt8Array = np.rint(np.clip(colors, 0.0, 255.0)).astype(np.uint8)
    return levels
