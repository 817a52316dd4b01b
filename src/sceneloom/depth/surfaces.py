"""`quality`: surfaces as triangles between the points, cut where depth jumps, and jumps placed by the image.

Triangles (Delaunay) hold inverse depth, in which planes are linear, so a plane comes out exactly; the slopes around
their corners report how surfaces bend between scan lines. Across jumps they state little: there, depths flow in from
the surfaces on both sides, over pixels of one colour and hardly across edges of the image.
"""

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, UInt8Array
from sceneloom.depth.gaps import Filled, close_gaps
from sceneloom.depth.samples import Samples, weighted_quantile
from sceneloom.depth.steepness import steepest_slope, trusts_of
from sceneloom.kernels.delaunay import CORNERS, MOST_EXTENT, hilbert_codes, triangulate
from sceneloom.kernels.edge_aware import link_pixels, smooth_downward, smooth_rightward
from sceneloom.kernels.triangle_filling import fill_triangles, measure_slopes, measure_triangles

_LONGEST_SURFACE, _LONGEST_JUMP = 12.0, 2.5
"""The longest side of a triangle that is filled, in spacings of the scan lines."""

_SLIVER_PX2 = 0.05
"""Triangles of less area report no slope."""

_TRUST_OF_JUMPS = 0.02
_EDGE_LEVELS = 12.0
"""A difference of so many levels, all three channels together, weakens what flows between two pixels by e."""

_ROTATIONS = 2
_FLOW = 0.5
"""How far depths flow, as a share of the squared spacing of the scan lines."""

_BELIEF_IN_EDGES = np.float32(0.85)
"""Not every edge of an image is one of a thing: by so much jumps go to where the image has them."""

_UNDRAWN = 2.0


def cover_surfaces(samples: Samples, rgb: UInt8Array | None, per_radian: float) -> Filled:
    """Fill an image from triangles between its samples.

    Args:
        samples: the measured points.
        rgb: (H, W, 3) uint8, the image; None: jumps are placed without one.
        per_radian: pixels per radian.
    """
    filled = close_gaps(samples, per_radian)
    triangles = triangles_between(samples.pixels, *samples.image.shape)
    inverse_depths, measures = np.reciprocal(samples.depths), np.empty((len(triangles), 3), np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        measure_triangles(samples.pixels, inverse_depths, triangles, measures)
    areas, sides, slopes = np.ascontiguousarray(measures.T)
    broad = areas > _SLIVER_PX2
    spacing = weighted_quantile(sides, areas, 0.5)
    steepest = steepest_slope(slopes[broad], areas[broad], per_radian)
    trusts = trusts_of(slopes, steepest)
    bends = np.empty_like(samples.pixels)
    measure_slopes(samples.pixels, inverse_depths, triangles, trusts, bends, np.empty_like(samples.depths))
    beyond = _fill(samples, bends, triangles, sides, trusts, spacing, filled)
    depths = _guide(filled, beyond, rgb, spacing)
    return Filled(depths, filled.trusts, filled.spreads, filled.gaps, spacing)


def triangles_between(pixels: Float32Array, height: int, width: int) -> AnyArray:
    """Triangulate points of an image.

    Args:
        pixels: (N, 2) float32 [px].

    Returns:
        (T, 3) int32, rows of `pixels`; without the triangles outside their hull.
    """
    extent = max(height, width)
    scale = MOST_EXTENT / (3 * (extent + 1))
    inner = np.rint((pixels.astype(np.float64) + 0.5) * scale).astype(np.int64)
    most = int(np.ceil(extent * scale)) + 1
    corners = np.array([[-most, -most], [2 * most, -most], [2 * most, 2 * most], [-most, 2 * most]])
    points = np.concatenate([corners, inner])
    codes = np.empty(len(inner), np.int64)
    hilbert_codes(np.ascontiguousarray(inner), codes)
    triangles = np.empty((2 * len(inner) + 2, 3), np.int32)
    count = triangulate(points, np.argsort(codes) + CORNERS, triangles)
    triangles = triangles[:count]
    return np.ascontiguousarray(triangles[(triangles >= CORNERS).all(axis=1)] - np.int32(CORNERS))


def _fill(
    samples: Samples,
    bends: Float32Array,
    triangles: AnyArray,
    sides: Float32Array,
    trusts: Float32Array,
    spacing: float,
    filled: Filled,
) -> BoolArray:
    """Draw the triangles that are not too large over what the gaps reported; report where there are none."""
    longest = np.where(trusts > 0.5, _LONGEST_SURFACE, _LONGEST_JUMP) * max(spacing, 2.0)
    small: BoolArray = sides <= longest
    beside = filled.trusts.copy()
    filled.trusts.fill(_UNDRAWN)
    images = (filled.depths, filled.trusts, filled.spreads, filled.gaps)
    fill_triangles(samples.pixels, samples.depths, bends, triangles, small, trusts, sides, *images)
    beyond: BoolArray = filled.trusts == _UNDRAWN
    np.copyto(filled.trusts, beside, where=beyond)
    return beyond


def _guide(filled: Filled, beyond: BoolArray, rgb: UInt8Array | None, spacing: float) -> Float32Array:
    """Let depths flow from surfaces into jumps along the image; on surfaces and beyond triangles they stay."""
    depths, trusts = filled.depths, np.where(beyond, np.float32(0), filled.trusts)
    rightward, downward = _links(rgb, depths)
    weights = np.where(depths > 0, trusts + np.float32(_TRUST_OF_JUMPS), np.float32(0))
    flows, room = weights * depths, np.empty_like(depths)
    for rotation in range(1, _ROTATIONS + 1):
        strength = 1.5 * 4.0 ** (_ROTATIONS - rotation) / (4.0**_ROTATIONS - 1) * _FLOW * spacing**2
        smooth_rightward(rightward, strength, flows, weights)
        smooth_downward(downward, strength, flows, weights, room)
    np.divide(flows, weights, out=flows, where=weights > 0)
    guided = depths + _BELIEF_IN_EDGES * (1 - trusts) * (flows - depths)
    return np.where(beyond, depths, guided)


def _links(rgb: UInt8Array | None, depths: Float32Array) -> tuple[Float32Array, Float32Array]:
    """How freely depth flows from each pixel to the right and down; as over one colour where there is no image."""
    image = np.zeros((*depths.shape, 3), np.uint8) if rgb is None else np.ascontiguousarray(rgb)
    rightward, downward = np.empty_like(depths), np.empty_like(depths)
    link_of_difference = np.exp(-np.arange(766) / _EDGE_LEVELS).astype(np.float32)
    link_pixels(image, link_of_difference, rightward, downward)
    return rightward, downward
