"""Plain chunks of surfaces in images, by the location where they are, for comparing the exposures of images."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array
from sceneloom.colouring.results import FusedView
from sceneloom.colouring.weights import near_outlines
from sceneloom.kernels.image_samples import measure_contrasts, sample_between_pixels

CUBE = 0.15
"""Side of the cubes by which locations are found again in other sweeps [m]."""

_DARKEST, _LIGHTEST = 16.0, 240.0
"""Levels beyond these are cut off, or nearly, in this image or its neighbours."""
_PLAIN = 14.0
"""Where a channel changes by more than so many levels around a point, which pixel is its own counts too much."""
_MOST_SAMPLES = 8000
_FARTHEST = 60.0
_BORDER_PX = 3.0
_HALF_KEY = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceSamples:
    """Chunks of surfaces in one image.

    Attributes:
        ids: (K,) int64, rows of the cloud, ascending.
        cubes: (K,) int64, numbers of the cubes of space that they lie in.
        colors: (K, 3) float32, 0 to 255.
    """

    ids: Int64Array
    cubes: Int64Array
    colors: Float32Array


def take_samples(points_world: Float64Array, view: FusedView) -> SurfaceSamples:
    """Take the points of an image that report its exposure: visible, on plain ground, neither dark nor light, no edge.

    Args:
        points_world: (N, 3) float64 [m].
        view: the points in the image.
    """
    rows = np.flatnonzero(_usable(view))
    pixels = np.ascontiguousarray(view.pixels[rows])
    rgb, contrasts = np.ascontiguousarray(view.rgb), np.empty(len(rows), np.float32)
    measure_contrasts(pixels, rgb, contrasts)
    plain = contrasts <= _PLAIN
    rows, pixels = rows[plain], np.ascontiguousarray(pixels[plain])
    colors = np.empty((len(rows), 3), np.float32)
    sample_between_pixels(pixels, rgb, colors)
    inside = ((colors >= _DARKEST) & (colors <= _LIGHTEST)).all(axis=1)
    rows, colors = rows[inside], colors[inside]
    every = -(-len(rows) // _MOST_SAMPLES) if len(rows) else 1
    ids = view.point_ids[rows]
    # the same points are left out of every image, so that pairs stay whole
    kept = ids % every == 0
    ids = ids[kept]
    return SurfaceSamples(ids, cube_numbers(points_world[ids]), colors[kept])


def _usable(view: FusedView) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    u, v = view.pixels[:, 0], view.pixels[:, 1]
    inside = (u >= _BORDER_PX) & (u <= view.camera.width - 1 - _BORDER_PX)
    inside &= (v >= _BORDER_PX) & (v <= view.camera.height - 1 - _BORDER_PX)
    usable: np.ndarray[tuple[int], np.dtype[np.bool_]] = (
        view.visible & inside & (view.depths < _FARTHEST) & ~near_outlines(view)
    )
    return usable


def cube_numbers(points_world: Float64Array) -> Int64Array:
    """One number for the cube of space of each point, the same in every sweep; (N,) int64 of (N, 3) finite points."""
    cubes = np.floor(points_world / CUBE).astype(np.int64) & (2 * _HALF_KEY - 1)
    numbers: Int64Array = (cubes[:, 0] << 42) | (cubes[:, 1] << 21) | cubes[:, 2]
    return numbers
