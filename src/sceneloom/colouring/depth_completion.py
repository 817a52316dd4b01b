"""Dense depth images from sparse ones, by gaps between scan lines or by triangulated surfaces, with a confidence.

With x, y the direction of a pixel (x/z, y/z of the points in it), a plane n·p = d has 1/z = n·(x, y, 1) / d. So the
inverse depth changes linearly over the image, by at most 1/d for each radian, however far away and however grazing the
plane is seen: a road 1.65 m below the camera has the slope 0.6 1/m everywhere. Steeper is only what passes the camera
nearer than that, or a jump from one object to another.

How near surfaces pass the camera is measured: most of a street's image is ground and walls, so 0.7 of the image is
no steeper than they are. What is 1.3 times as steep is half a jump.

Morphology closes a gap by dilating what is known and eroding the rim again; here the two rims are joined by what is
between them: linearly in inverse depth on one surface, linearly in depth across a jump, where that errs least. Samples
are first widened along their row to their neighbours on the scan line, so that columns meet the lines.

Triangles (Delaunay) hold inverse depth, in which planes are linear, so a plane comes out exactly; the slopes around
their corners show how surfaces bend between scan lines. Across jumps they mean little: there, depths flow in from
the surfaces on both sides, over pixels of one colour and hardly across edges of the image.

A pixel's confidence is the share of pixels like it whose depth was less than 0.5 m, or 5 %, from the truth. Alike are
pixels with the same doubt (how far apart the depths around the pixel are, in units of that tolerance, of which a
twentieth counts where they are of one surface) and the same gap (in spacings of the scan lines). Both tables fall along
rows and columns. `python -m benchmarks.depth fit` makes them; the sky counts as wrong.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numba import float32, int32, int64, void

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array, check_array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import unproject
from sceneloom.colouring.results import FusedView
from sceneloom.errors import ArrayError, OptionError
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import (
    IN_BOOL_1D,
    IN_F32_1D,
    IN_F32_2D,
    IN_I32_2D,
    IN_I64_1D,
    IN_I64_2D,
    IN_U8_3D,
    inlined,
)


@dataclass(frozen=True, slots=True, eq=False)
class DenseDepth:
    """A depth for every pixel near measured points.

    Attributes:
        depths: (H, W) float32 [m], z in the camera frame, 0 for none, in the image's own grid.
        confidence: (H, W) float32, 0 to 1: how probable it is that the depth is less than 0.5 m, or less than 5 % where
            that is more, from the true one; 0 where there is none.
    """

    depths: Float32Array
    confidence: Float32Array

    def __post_init__(self) -> None:
        check_array("dense.depths", self.depths, (None, None), np.float32)
        check_array("dense.confidence", self.confidence, self.depths.shape, np.float32)

    def above(self, confidence: float) -> Float32Array:
        """The depths with at least this confidence; 0 elsewhere."""
        return np.where(self.confidence >= confidence, self.depths, np.float32(0))


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """The measured points in an image.

    Attributes:
        image: (H, W) float32 [m], the nearest of each pixel, 0 for none.
        pixels: (N, 2) float32 [px], their positions.
        depths: (N,) float32 [m], all positive and finite.
    """

    image: Float32Array
    pixels: Float32Array
    depths: Float32Array

    @classmethod
    def of_view(cls, view: FusedView) -> "Samples":
        """The visible points of a view, at their positions between the pixels."""
        kept = view.visible & (view.depths > 0) & np.isfinite(view.depths)
        return cls(view.depth_image, view.pixels[kept], view.depths[kept])

    @classmethod
    def of_image(cls, sparse: Float32Array, camera: Camera) -> "Samples":
        """The pixels of a sparse depth image.

        Raises:
            ArrayError: it is of another size than the camera's images, or holds NaN, infinity or a negative depth.
        """
        check_array("sparse", sparse, (camera.height, camera.width), np.float32)
        wrong = np.argwhere(~((sparse >= 0) & (sparse < np.inf)))
        if len(wrong):
            row, column = wrong[0].tolist()
            raise ArrayError(
                f"sparse[{row}, {column}]: {sparse[row, column]}; expected metres, 0 where there is no depth"
            )
        image = np.ascontiguousarray(sparse)
        numbers = np.flatnonzero(image)
        rows, columns = np.divmod(numbers, camera.width)
        return cls(image, np.stack([columns, rows], axis=1).astype(np.float32), image.ravel()[numbers])


def pixels_per_radian(camera: Camera) -> float:
    """Pixels per radian in the middle of the image, of any camera model.

    Raises:
        CalibrationError: the camera's model is unknown or has other coefficients.
    """
    middle = np.array([(camera.width - 1) / 2, (camera.height - 1) / 2])
    around = middle + np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])
    rays = unproject(camera, around)
    angles = np.linalg.norm(rays[::2] - rays[1::2], axis=1)
    if not angles.all() or np.isnan(angles).any():
        return float(np.sqrt(camera.fx * camera.fy))
    return float(2.0 / np.sqrt(angles.prod()))


def _weighted_quantile(values: AnyArray, weights: AnyArray, share: float) -> float:
    """The value below which this share of the weight is; 0 of nothing."""
    if len(values) == 0:
        return 0.0
    order = np.argsort(values)
    sums: Float64Array = np.cumsum(weights[order], dtype=np.float64)
    return float(values[order[min(int(np.searchsorted(sums, share * sums[-1])), len(values) - 1)]])


_SURFACES = 0.7
_STEEPER = 1.2

_LEAST, _MOST = 0.5, 10.0
"""Bounds of the steepest slope [1/m/rad]: surfaces that pass the camera at 2 m are never cut apart."""

_EVEN, _SUDDEN = 0.85, 1.3
"""Up to 0.85 of the steepest slope two samples are of one surface; from 1.3 on there is a jump between them."""


def _steepest_slope(slopes: AnyArray, weights: AnyArray, per_radian: float) -> float:
    """The largest slope of the inverse depth of one surface [1/m/px], of slopes (N,) weighted by image area (N,)."""
    finite = np.isfinite(slopes)
    usual = _weighted_quantile(slopes[finite], weights[finite], _SURFACES)
    return float(np.clip(_STEEPER * usual * per_radian, _LEAST, _MOST)) / per_radian


_WIDENED_PER_STEP = 0.6
"""Widening, in steps from sample to sample of a scan line: a little more than half, as steps differ."""

_USUAL_STEP_SHARE = 0.4
_THIN = 2.0  # up to so many rows apart samples are of one scan line, which crosses from row to row [px]

_LONGEST, _REACH = 3.0, 1.0
"""The longest gap that is closed, and how far the last scan line reaches, in spacings of the lines."""


@dataclass(frozen=True, slots=True, eq=False)
class _Filled:
    """A dense depth image."""

    depths: Float32Array  # (H, W) float32 [m], 0 for none
    trusts: Float32Array  # (H, W) float32, 1 on one surface, 0 across a jump
    spreads: Float32Array  # (H, W) float32 [m], how far apart the depths around a pixel are
    gaps: Float32Array  # (H, W) float32 [px], how far apart they are in the image
    spacing: float  # between scan lines [px]; 0 where there are no two


def _close_gaps(samples: Samples, per_radian: float) -> _Filled:
    """Fill the gaps between samples along columns and rows."""
    sparse = samples.image
    rows, columns = np.divmod(np.flatnonzero(sparse), sparse.shape[1])
    # how far a sample is widened [px]; 0 where no two are in one row
    steps = np.diff(columns)[np.diff(rows) == 0]
    slack = 0
    if len(steps):
        at = int(_USUAL_STEP_SHARE * (len(steps) - 1))
        slack = max(1, round(_WIDENED_PER_STEP * float(np.partition(steps, at)[at])))
    widened, above, distances = (np.empty_like(sparse) for _ in range(3))
    widen_samples(sparse, slack, widened)
    look_up(widened, above, distances)
    rows, columns = rows[rows > 0], columns[rows > 0]
    apart = distances[rows - 1, columns] + 1.0
    between = (apart > _THIN) & (apart < sparse.shape[0])
    rows, columns, apart = rows[between], columns[between], apart[between]
    changes = np.abs(1.0 / sparse[rows, columns] - 1.0 / above[rows - 1, columns])
    spacing = float(np.median(apart)) if len(apart) else 0.0
    steepest = _steepest_slope(changes / apart, apart, per_radian)
    depths, trusts, spreads, gaps = (np.empty_like(sparse) for _ in range(4))
    longest = _LONGEST * spacing
    fill_down(widened, above, distances, longest, _REACH * spacing, steepest, depths, trusts, spreads, gaps)
    fill_across(sparse, longest, steepest, depths, trusts, spreads, gaps)
    return _Filled(depths, trusts, spreads, gaps, spacing)


_LONGEST_SURFACE, _LONGEST_JUMP = 12.0, 2.5
"""The longest side of a triangle that is filled, in spacings of the scan lines."""

_SLIVER_PX2 = 0.05  # smaller triangles give no slope
_TRUST_OF_JUMPS = 0.02

_EDGE_LEVELS = 12.0
"""A difference of so many levels, all three channels together, weakens the flow between two pixels by e."""

_ROTATIONS = 2
_FLOW = 0.5  # how far depths flow, as a share of the squared spacing of the scan lines

_BELIEF_IN_EDGES = np.float32(0.85)
"""Not every edge of an image is one of an object: by this share jumps move to the image's edges."""

_UNDRAWN = 2.0


def _cover_surfaces(samples: Samples, rgb: UInt8Array | None, per_radian: float) -> _Filled:
    """Fill an image from triangles between its samples, with jumps at the edges of the image (H, W, 3), if any."""
    filled = _close_gaps(samples, per_radian)
    triangles = triangles_between(samples.pixels, *samples.image.shape)
    inverse_depths, measures = np.reciprocal(samples.depths), np.empty((len(triangles), 3), np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        measure_triangles(samples.pixels, inverse_depths, triangles, measures)
    areas, sides, slopes = np.ascontiguousarray(measures.T)
    broad = areas > _SLIVER_PX2
    spacing = _weighted_quantile(sides, areas, 0.5)
    steepest = _steepest_slope(slopes[broad], areas[broad], per_radian)
    # 1 for slopes of one surface, 0 for jumps
    trusts = (1.0 - np.clip((slopes / steepest - _EVEN) / (_SUDDEN - _EVEN), 0.0, 1.0)).astype(np.float32)
    bends = np.empty_like(samples.pixels)
    measure_slopes(samples.pixels, inverse_depths, triangles, trusts, bends, np.empty_like(samples.depths))
    # draw the triangles that are not too large over the closed gaps
    small: BoolArray = sides <= np.where(trusts > 0.5, _LONGEST_SURFACE, _LONGEST_JUMP) * max(spacing, 2.0)
    beside = filled.trusts.copy()
    filled.trusts.fill(_UNDRAWN)
    images = filled.depths, filled.trusts, filled.spreads, filled.gaps
    fill_triangles(samples.pixels, samples.depths, bends, triangles, small, trusts, sides, *images)
    beyond: BoolArray = filled.trusts == _UNDRAWN
    np.copyto(filled.trusts, beside, where=beyond)
    return replace(filled, depths=_guide(filled, beyond, rgb, spacing), spacing=spacing)


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
    codes = np.empty(len(inner), np.int64)
    hilbert_codes(np.ascontiguousarray(inner), codes)
    triangles = np.empty((2 * len(inner) + 2, 3), np.int32)
    count = triangulate(np.concatenate([corners, inner]), np.argsort(codes) + CORNERS, triangles)
    triangles = triangles[:count]
    return np.ascontiguousarray(triangles[(triangles >= CORNERS).all(axis=1)] - np.int32(CORNERS))


def _guide(filled: _Filled, beyond: BoolArray, rgb: UInt8Array | None, spacing: float) -> Float32Array:
    """Let depths flow from surfaces into jumps along the image; on surfaces and beyond triangles they stay."""
    depths, trusts = filled.depths, np.where(beyond, np.float32(0), filled.trusts)
    # strength of the links between pixels, all equal without an image
    image = np.zeros((*depths.shape, 3), np.uint8) if rgb is None else np.ascontiguousarray(rgb)
    rightward, downward = np.empty_like(depths), np.empty_like(depths)
    link_pixels(image, np.exp(-np.arange(766) / _EDGE_LEVELS).astype(np.float32), rightward, downward)
    weights = np.where(depths > 0, trusts + np.float32(_TRUST_OF_JUMPS), np.float32(0))
    flows, room = weights * depths, np.empty_like(depths)
    for rotation in range(1, _ROTATIONS + 1):
        strength = 1.5 * 4.0 ** (_ROTATIONS - rotation) / (4.0**_ROTATIONS - 1) * _FLOW * spacing**2
        smooth_rightward(rightward, strength, flows, weights)
        smooth_downward(downward, strength, flows, weights, room)
    np.divide(flows, weights, out=flows, where=weights > 0)
    guided = depths + _BELIEF_IN_EDGES * (1 - trusts) * (flows - depths)
    return np.where(beyond, depths, guided)


TOLERANCE, TOLERANCE_SHARE = 0.5, 0.05
"""Depths count as right with an error of less than 0.5 m, or of less than 5 % where that is more."""

SLOPE_SHARE = 0.05
DOUBT_STEPS = (0.03, 0.1, 0.3, 1.0, 2.0, 4.0, 8.0)
GAP_STEPS = (0.5, 1.1, 1.6, 2.1, 3.1, 5.1)

_TABLES: Mapping[str, tuple[tuple[float, ...], ...]] = MappingProxyType(
    {
        "fast": (
            (0.973, 0.973, 0.973, 0.863, 0.863, 0.863, 0.863),
            (0.973, 0.973, 0.973, 0.817, 0.815, 0.815, 0.815),
            (0.973, 0.973, 0.947, 0.768, 0.768, 0.768, 0.768),
            (0.973, 0.893, 0.795, 0.721, 0.373, 0.373, 0.373),
            (0.973, 0.830, 0.795, 0.721, 0.373, 0.373, 0.373),
            (0.973, 0.830, 0.795, 0.721, 0.373, 0.373, 0.373),
            (0.939, 0.805, 0.795, 0.721, 0.358, 0.358, 0.358),
            (0.045, 0.045, 0.045, 0.045, 0.045, 0.045, 0.045),
        ),
        "quality": (
            (0.995, 0.995, 0.995, 0.936, 0.936, 0.936, 0.936),
            (0.992, 0.992, 0.973, 0.851, 0.851, 0.851, 0.851),
            (0.982, 0.982, 0.929, 0.830, 0.817, 0.727, 0.437),
            (0.982, 0.837, 0.814, 0.813, 0.782, 0.724, 0.437),
            (0.982, 0.837, 0.814, 0.813, 0.691, 0.691, 0.437),
            (0.982, 0.837, 0.814, 0.813, 0.691, 0.691, 0.437),
            (0.974, 0.837, 0.814, 0.813, 0.636, 0.636, 0.437),
            (0.553, 0.553, 0.428, 0.334, 0.334, 0.334, 0.334),
        ),
    }
)  # confidence by method, row by row of rising doubt, column by column of rising gaps


def complete_depth(
    source: FusedView | Float32Array,
    camera: Camera | None = None,
    rgb: UInt8Array | None = None,
    *,
    method: str = "quality",
) -> DenseDepth:
    """Give a depth, and its confidence, to every pixel near measured points.

    Points must be visible: of a view the hidden ones are left out. Where no points are near, as in the sky, there is
    no depth.

    Args:
        source: a sweep in an image, whose points count at their exact positions; or (H, W) float32 [m], the depths of
            some pixels, 0 for none.
        camera: the camera model of the image; a view has its own.
        rgb: (H, W, 3) uint8, the image, by which `quality` places jumps; None: that of the view, or none.
        method: a name out of `METHODS`.

    Raises:
        ArrayError: an array is not of the camera's size, or a depth is NaN, infinite or negative.
        CalibrationError: the camera's model is unknown or has other coefficients.
        OptionError: the method is unknown.
    """
    if method not in METHODS:
        raise OptionError(f"method {method!r}; expected one of {', '.join(METHODS)}")
    if isinstance(source, FusedView):
        camera_model, samples = source.camera, Samples.of_view(source)
        image: UInt8Array | None = source.rgb if rgb is None else rgb
    elif camera is None:
        raise ArrayError("camera: missing; a depth image needs the camera model that it was taken with")
    else:
        camera_model, samples, image = camera, Samples.of_image(source, camera), rgb
    check_array("rgb", image, (camera_model.height, camera_model.width, 3), np.uint8, optional=True)
    filled = METHODS[method](samples, image, pixels_per_radian(camera_model))
    confidence = np.empty_like(filled.depths)
    doubts, gaps, table = (np.array(one, np.float32) for one in (DOUBT_STEPS, GAP_STEPS, _TABLES[method]))
    grade_depths(
        filled.depths, filled.trusts, filled.spreads, filled.gaps, max(filled.spacing, 1.0), TOLERANCE,
        TOLERANCE_SHARE, SLOPE_SHARE, doubts, gaps, table, confidence,
    )  # fmt: skip
    return DenseDepth(filled.depths, confidence)


def _fill_fast(samples: Samples, _: UInt8Array | None, per_radian: float) -> _Filled:
    filled = _close_gaps(samples, per_radian)
    blended = np.empty_like(filled.depths)
    blend_neighbours(filled.depths, np.empty((2, filled.depths.size), np.float32), blended)
    return replace(filled, depths=blended)


_Method = Callable[[Samples, UInt8Array | None, float], _Filled]
"""Fills an image: samples, the image or None, pixels per radian."""

METHODS: Mapping[str, _Method] = MappingProxyType({"fast": _fill_fast, "quality": _cover_surfaces})
"""The methods by name."""

_FAR = np.float32(1e6)
_NOTHING = np.float32(0)
_EVEN_UP_TO, _PER_STEEPNESS = np.float32(_EVEN), np.float32(1.0 / (_SUDDEN - _EVEN))
_BEYOND = np.float32(0.3)  # how far another surface may be, as a share of the depth, where only one side is known


@kernel(void(IN_F32_2D, int64, float32[:, ::1]))
def widen_samples(sparse: Float32Array, slack: int, widened: Float32Array) -> None:
    """Widen each sample along its row, by at most `slack` pixels; what lies between two is shared out by halves.

    `sparse` (H, W) [m], 0 for nothing; `slack` [px]; `widened` (H, W) [m], written.
    """
    height, width = sparse.shape
    for row in range(height):
        last = -1
        for column in range(width):
            widened[row, column] = 0
        for column in range(width):
            depth = sparse[row, column]
            if not depth > 0:
                continue
            first = max(0, column - slack)
            if last >= 0:
                first = max(first, (last + column) // 2 + 1)
            for k in range(first, min(width, column + slack + 1)):
                widened[row, k] = depth
            last = column


@kernel(void(IN_F32_2D, float32[:, ::1], float32[:, ::1]))
def look_up(widened: Float32Array, depths: Float32Array, distances: Float32Array) -> None:
    """Give the next sample above each pixel, itself included, and how many rows it is away.

    `widened` (H, W) [m], 0 for nothing; `depths` (H, W) [m], written; 0 for none; `distances` (H, W) [px], written;
    very large for none.
    """
    height, width = widened.shape
    for column in range(width):
        depths[0, column] = widened[0, column]
        distances[0, column] = _NOTHING if widened[0, column] > 0 else _FAR
    for row in range(1, height):
        for column in range(width):
            here = widened[row, column]
            known = here > 0
            depths[row, column] = here if known else depths[row - 1, column]
            distances[row, column] = _NOTHING if known else distances[row - 1, column] + np.float32(1)


@inlined
def _join(near: float, to_near: float, other: float, to_other: float, steepest: float) -> tuple[Any, Any]:
    """Depth and trust of a pixel between two samples that are so many pixels away."""
    one = np.float32(1)
    gap = to_near + to_other
    share = to_other / gap
    inverse_near, inverse_other = one / near, one / other
    inverse = share * inverse_near + (one - share) * inverse_other
    steepness = abs(inverse_near - inverse_other) / (gap * steepest)
    jump = min(one, max(_NOTHING, _PER_STEEPNESS * (steepness - _EVEN_UP_TO)))
    return (one - jump) / inverse + jump * (share * near + (one - share) * other), one - jump


@kernel(void(
    IN_F32_2D, IN_F32_2D, IN_F32_2D, float32, float32, float32, float32[:, ::1], float32[:, ::1], float32[:, ::1],
    float32[:, ::1]
))  # fmt: skip
def fill_down(
    widened: Float32Array, depths_above: Float32Array, distances_above: Float32Array, longest: float, reach: float,
    steepest: float, depth_image: Float32Array, trust_image: Float32Array, spread_image: Float32Array,
    gap_image: Float32Array,
) -> None:  # fmt: skip
    """Fill gaps along columns: between two samples by both, beyond the last one a little trajectory by this one.

    Args:
        widened: (H, W) [m], the samples, 0 for nothing.
        depths_above, distances_above: (H, W), as `look_up` gives them.
        longest: the longest gap that is filled [px].
        reach: how far the last sample of a column reaches [px].
        steepest: how much the inverse depth of one surface changes at most from pixel to pixel [1/m/px].
        depth_image: (H, W) [m], written; 0 where nothing is near.
        trust_image: (H, W), written: 1 for one surface, 0 for a jump, and beyond the last sample.
        spread_image: (H, W) [m], written: how far apart the two depths are.
        gap_image: (H, W) [px], written: the gap's length, twice the distance beyond the last sample.
    """
    height, width = widened.shape
    below, distances = np.zeros(width, np.float32), np.full(width, _FAR, np.float32)
    one = np.float32(1)
    for row in range(height - 1, -1, -1):
        for column in range(width):
            here, above, to_above = (widened[row, column], depths_above[row, column], distances_above[row, column])
            known = here > 0
            other = here if known else below[column]
            to_other = _NOTHING if known else distances[column] + one
            below[column], distances[column] = other, to_other
            depth, trust, spread, gap = here, one, _NOTHING, _NOTHING
            if not known:
                nearest, gap = min(to_above, to_other), to_above + to_other
                if gap <= longest:
                    depth, trust = _join(above, to_above, other, to_other, steepest)
                    spread = abs(above - other)
                elif nearest <= reach:
                    depth, trust, gap = (above if to_above < to_other else other), _NOTHING, nearest + nearest
                    spread = depth * _BEYOND
            depth_image[row, column], trust_image[row, column] = depth, trust
            spread_image[row, column], gap_image[row, column] = spread, gap


@kernel(void(IN_F32_2D, float32, float32, float32[:, ::1], float32[:, ::1], float32[:, ::1], float32[:, ::1]))
def fill_across(
    sparse: Float32Array, longest: float, steepest: float, depth_image: Float32Array, trust_image: Float32Array,
    spread_image: Float32Array, gap_image: Float32Array,
) -> None:  # fmt: skip
    """Fill gaps along rows where that is the shorter way, as `fill_down` does along columns.

    `sparse` (H, W) [m], the samples, 0 for nothing; `longest`: the longest gap that is filled [px]; `steepest`: how
    much the inverse depth of one surface changes at most from pixel to pixel [1/m/px]; `depth_image`, `trust_image`,
    `spread_image`, `gap_image` (H, W), what is known already; written.
    """
    height, width = sparse.shape
    for row in range(height):
        last = -1
        for column in range(width):
            if not sparse[row, column] > 0:
                continue
            gap = np.float32(column - last)
            if last >= 0 and gap <= longest:
                left, right = sparse[row, last], sparse[row, column]
                for k in range(last + 1, column):
                    if depth_image[row, k] > 0 and gap_image[row, k] <= gap:
                        continue
                    depth_image[row, k], trust_image[row, k] = _join(
                        left, np.float32(k - last), right, np.float32(column - k), steepest
                    )
                    spread_image[row, k], gap_image[row, k] = abs(left - right), gap
            last = column


@kernel(void(IN_F32_2D, float32[:, ::1], float32[:, ::1]))
def blend_neighbours(depth_image: Float32Array, room: Float32Array, blended: Float32Array) -> None:
    """Average each filled pixel with the filled ones beside it, weighted 1 4 6 4 1 along both axes.

    `depth_image` (H, W) [m], 0 for nothing; `room` (2, H * W), overwritten; `blended` (H, W) [m], written; 0 where
    `depth_image` is.

    Source: Burt 1981, Computer Graphics and Image Processing 16, the binomial kernel of five.
    """
    height, width = depth_image.shape
    four, six = np.float32(4), np.float32(6)
    sums, weights = room[0].reshape(height, width), room[1].reshape(height, width)
    padded, present = np.zeros(width + 4, np.float32), np.zeros(width + 4, np.float32)
    for row in range(height):
        for column in range(width):
            depth = depth_image[row, column]
            padded[column + 2] = depth
            present[column + 2] = np.float32(1) if depth > 0 else _NOTHING
        for column in range(width):
            sums[row, column] = (
                padded[column] + padded[column + 4] + four * (padded[column + 1] + padded[column + 3])
                + six * padded[column + 2]
            )  # fmt: skip
            weights[row, column] = (
                present[column] + present[column + 4] + four * (present[column + 1] + present[column + 3])
                + six * present[column + 2]
            )  # fmt: skip
    for row in range(height):
        a, b = max(row - 2, 0), max(row - 1, 0)
        d, e = min(row + 1, height - 1), min(row + 2, height - 1)
        for column in range(width):
            total = (
                sums[a, column] + sums[e, column] + four * (sums[b, column] + sums[d, column])
                + six * sums[row, column]
            )  # fmt: skip
            weight = (
                weights[a, column] + weights[e, column] + four * (weights[b, column] + weights[d, column])
                + six * weights[row, column]
            )  # fmt: skip
            blended[row, column] = total / weight if depth_image[row, column] > 0 else _NOTHING


_HALF = np.float32(0.5)
_SLIVER = np.float32(0.1)  # twice the least area of a triangle that gives a slope [px²]

_ROUNDING = np.float32(1e-4)
"""How far outside a triangle a pixel may be and still be filled by it, as a share of the triangle."""


@kernel(void(IN_F32_2D, IN_F32_1D, IN_I32_2D, float32[:, ::1]))
def measure_triangles(
    pixels: Float32Array, inverse_depths: Float32Array, triangles: AnyArray, measures: Float32Array
) -> None:
    """Measure each triangle.

    `pixels` (N, 2) [px]; `inverse_depths` (N,) [1/m]; `triangles` (T, 3); `measures` (T, 3), written: area [px²];
    length of the longest side [px]; how much the inverse depth changes for a pixel, the steepest trajectory [1/m/px],
    infinite for triangles without area.
    """
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        bu, bv = pixels[b, 0] - pixels[a, 0], pixels[b, 1] - pixels[a, 1]
        cu, cv = pixels[c, 0] - pixels[a, 0], pixels[c, 1] - pixels[a, 1]
        twice = bu * cv - bv * cu
        longest = max(bu * bu + bv * bv, cu * cu + cv * cv, (bu - cu) ** 2 + (bv - cv) ** 2)
        db, dc = inverse_depths[b] - inverse_depths[a], inverse_depths[c] - inverse_depths[a]
        slope_u, slope_v = (db * cv - dc * bv) / twice, (dc * bu - db * cu) / twice
        measures[t, 0] = 0.5 * abs(twice)
        measures[t, 1] = math.sqrt(longest)
        measures[t, 2] = math.sqrt(slope_u * slope_u + slope_v * slope_v) if twice != 0 else math.inf


@kernel(void(IN_F32_2D, IN_F32_1D, IN_I32_2D, IN_F32_1D, float32[:, ::1], float32[::1]))
def measure_slopes(
    pixels: Float32Array, inverse_depths: Float32Array, triangles: AnyArray, trusts: Float32Array, slopes: Float32Array,
    weights: Float32Array,
) -> None:  # fmt: skip
    """Measure how the inverse depth changes around each point: the mean of its triangles, the smallest before all.

    `pixels` (N, 2) [px]; `inverse_depths` (N,) [1/m]; `triangles` (T, 3); `trusts` (T,), 1 for one surface, 0 for a
    jump, which does not count; `slopes` (N, 2) [1/m/px], written: rightward and downward; 0 where no triangle reports;
    `weights` (N,), overwritten.
    """
    slopes[:], weights[:] = _NOTHING, _NOTHING
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        bu, bv = pixels[b, 0] - pixels[a, 0], pixels[b, 1] - pixels[a, 1]
        cu, cv = pixels[c, 0] - pixels[a, 0], pixels[c, 1] - pixels[a, 1]
        twice = bu * cv - bv * cu
        if abs(twice) < _SLIVER or trusts[t] <= 0:
            continue
        longest = max(bu * bu + bv * bv, cu * cu + cv * cv, (bu - cu) ** 2 + (bv - cv) ** 2)
        db, dc = inverse_depths[b] - inverse_depths[a], inverse_depths[c] - inverse_depths[a]
        room = longest + np.float32(1)
        weight = trusts[t] * abs(twice) / (room * room * room)
        slope_u, slope_v = weight * (db * cv - dc * bv) / twice, weight * (dc * bu - db * cu) / twice
        for k in (a, b, c):
            slopes[k, 0] += slope_u
            slopes[k, 1] += slope_v
            weights[k] += weight
    for k in range(slopes.shape[0]):
        if weights[k] > 0:
            slopes[k, 0] /= weights[k]
            slopes[k, 1] /= weights[k]


@inlined
def _span(value: float, step: float, columns: int) -> tuple[int, int]:
    """First and last of so many columns in which a value that grows by `step` is not below the rounding."""
    if step > 0:
        return max(0, math.ceil((-_ROUNDING - value) / step)), columns
    if step < 0:
        return 0, min(columns, math.floor((-_ROUNDING - value) / step))
    return 0, columns if value >= -_ROUNDING else -1


@inlined
def _rise(slopes: Float32Array, corner: int, across: float, down: float) -> Any:
    """What a corner's slope adds at a distance of so many pixels."""
    return slopes[corner, 0] * across + slopes[corner, 1] * down


@inlined
def _evenness(pixels: Float32Array, slopes: Float32Array, corners: tuple[Any, ...], inverses: tuple[Any, ...]) -> Any:
    """How far depth itself counts as linear: where slopes miss the other corners, and depths are different."""
    least, most, off = min(inverses), max(inverses), _NOTHING
    for own in range(3):
        for other in range(3):
            k, m = corners[own], corners[other]
            reported = _rise(slopes, k, pixels[m, 0] - pixels[k, 0], pixels[m, 1] - pixels[k, 1])
            off = max(off, abs(inverses[other] - inverses[own] - reported))
    one = np.float32(1)
    return min(one, most / least - one) * (min(one, off / (most - least)) if most > least else one)


@kernel(void(
    IN_F32_2D, IN_F32_1D, IN_F32_2D, IN_I32_2D, IN_BOOL_1D, IN_F32_1D, IN_F32_1D, float32[:, ::1], float32[:, ::1],
    float32[:, ::1], float32[:, ::1]
))  # fmt: skip
def fill_triangles(
    pixels: Float32Array, depths: Float32Array, slopes: Float32Array, triangles: AnyArray, filled: BoolArray,
    trusts: Float32Array, lengths: Float32Array, depth_image: Float32Array, trust_image: Float32Array,
    spread_image: Float32Array, length_image: Float32Array,
) -> None:  # fmt: skip
    """Fill the pixels of triangles: in inverse depth where these are trusted.

    On one surface, each corner reports its inverse depth and half of what its slope adds on the way to the pixel, and
    the pixel's shares in the triangle weigh the three: exact for planes and for what bends evenly. Nothing leaves the
    range of the corners. Where slopes miss the other corners, and these are unlike in depth, depths are linear, which
    errs least where nobody knows: entirely so where they miss by all there is, and one corner is twice as far as
    another.

    Across jumps, what the image reported already stays, and where it reported nothing, depths are linear.

    Args:
        pixels: (N, 2) [px].
        depths: (N,) [m].
        slopes: (N, 2) [1/m/px], how the inverse depth changes rightward and downward.
        triangles: (T, 3).
        filled: (T,), others are left out.
        trusts: (T,), 1 for one surface, 0 for a jump.
        lengths: (T,), longest sides [px].
        depth_image: (H, W) [m], 0 for nothing; written where a triangle is.
        trust_image: (H, W), the triangle's trust.
        spread_image: (H, W) [m], how far apart the triangle's depths are.
        length_image: (H, W) [px], the triangle's longest side.
    """
    height, width = depth_image.shape
    one = np.float32(1.0)
    for t in range(triangles.shape[0]):
        if not filled[t]:
            continue
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        au, av, bu, bv, cu, cv = (
            pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1], pixels[c, 0], pixels[c, 1]
        )  # fmt: skip
        left, right = max(0, math.ceil(min(au, bu, cu))), min(width - 1, math.floor(max(au, bu, cu)))
        top, bottom = max(0, math.ceil(min(av, bv, cv))), min(height - 1, math.floor(max(av, bv, cv)))
        twice = (bu - au) * (cv - av) - (bv - av) * (cu - au)
        if twice == 0:
            continue
        step_b, step_c = (cv - av) / twice, -(bv - av) / twice
        za, zb, zc = depths[a], depths[b], depths[c]
        spread, trust = max(za, zb, zc) - min(za, zb, zc), trusts[t]
        ya, yb, yc = one / za, one / zb, one / zc
        least, most = min(ya, yb, yc), max(ya, yb, yc)
        even = _evenness(pixels, slopes, (a, b, c), (ya, yb, yc))
        for row in range(top, bottom + 1):
            du, dv = np.float32(left) - au, np.float32(row) - av
            share_b = (du * (cv - av) - dv * (cu - au)) / twice
            share_c = (dv * (bu - au) - du * (bv - av)) / twice
            count = right - left
            first_b, last_b = _span(share_b, step_b, count)
            first_c, last_c = _span(share_c, step_c, count)
            first_a, last_a = _span(one - share_b - share_c, -step_b - step_c, count)
            for column in range(max(first_a, first_b, first_c), min(last_a, last_b, last_c) + 1):
                of_b, of_c = share_b + np.float32(column) * step_b, share_c + np.float32(column) * step_c
                of_a = one - of_b - of_c
                u = left + column
                across, down = np.float32(u), np.float32(row)
                bent = of_a * _rise(slopes, a, across - au, down - av)
                bent += of_b * _rise(slopes, b, across - bu, down - bv)
                bent += of_c * _rise(slopes, c, across - cu, down - cv)
                inverse = min(most, max(least, of_a * ya + of_b * yb + of_c * yc + _HALF * bent))
                linear = of_a * za + of_b * zb + of_c * zc
                surface = (one - even) / inverse + even * linear
                reported = depth_image[row, u]
                between = reported if reported > 0 else linear
                depth_image[row, u] = trust * surface + (one - trust) * between
                trust_image[row, u] = trust
                spread_image[row, u] = spread
                length_image[row, u] = lengths[t]


_FASTMATH = {"contract", "arcp"}
_LANES = 16


@kernel(void(IN_U8_3D, IN_F32_1D, float32[:, ::1], float32[:, ::1]))
def link_pixels(
    rgb: UInt8Array, link_of_difference: Float32Array, rightward: Float32Array, downward: Float32Array
) -> None:
    """Give the strength of the links between neighbouring pixels.

    `rgb` (H, W, 3); `link_of_difference` (766,), by the sum of the differences of the three channels; `rightward`,
    `downward` (H, W), written: of each pixel to the next one; 0 in the last column or row.
    """
    height, width = rightward.shape
    for row in range(height):
        for column in range(width):
            right, down = 0, 0
            if column + 1 < width:
                for k in range(3):
                    right += abs(int64(rgb[row, column, k]) - int64(rgb[row, column + 1, k]))
                rightward[row, column] = link_of_difference[right]
            else:
                rightward[row, column] = 0
            if row + 1 < height:
                for k in range(3):
                    down += abs(int64(rgb[row, column, k]) - int64(rgb[row + 1, column, k]))
                downward[row, column] = link_of_difference[down]
            else:
                downward[row, column] = 0


@kernel(void(IN_F32_2D, float32, float32[:, ::1], float32[:, ::1], float32[:, ::1]), fastmath=_FASTMATH)
def smooth_downward(
    links: Float32Array, strength: float, first: Float32Array, second: Float32Array, room: Float32Array
) -> None:
    """Smooth two images along axis 0, all columns side by side.

    `links` (N, M), of each row to the next; 0 in the last; `strength`: λ; `first`, `second` (N, M), smoothed in place;
    `room` (N, M), overwritten.
    """
    count, lanes = first.shape
    one = np.float32(1)
    for column in range(lanes):
        link = strength * links[0, column]
        scale = one / (one + link)
        room[0, column] = link * scale
        first[0, column] *= scale
        second[0, column] *= scale
    for row in range(1, count):
        for column in range(lanes):
            above, link = strength * links[row - 1, column], strength * links[row, column]
            scale = one / (one + above + link - above * room[row - 1, column])
            room[row, column] = link * scale
            first[row, column] = (first[row, column] + above * first[row - 1, column]) * scale
            second[row, column] = (second[row, column] + above * second[row - 1, column]) * scale
    for row in range(count - 2, -1, -1):
        for column in range(lanes):
            first[row, column] += room[row, column] * first[row + 1, column]
            second[row, column] += room[row, column] * second[row + 1, column]


@kernel(void(IN_F32_2D, float32, float32[:, ::1], float32[:, ::1]), fastmath=_FASTMATH)
def smooth_rightward(links: Float32Array, strength: float, first: Float32Array, second: Float32Array) -> None:
    """Smooth two images along axis 1: some rows at a time are laid side by side.

    `links` (H, W), of each pixel to the next; 0 in the last column; `strength`: λ; `first`, `second` (H, W), smoothed
    in place.
    """
    height, width = first.shape
    laid = np.zeros((4, width, _LANES), np.float32)
    for top in range(0, height, _LANES):
        rows = min(_LANES, height - top)
        for k in range(rows):
            for column in range(width):
                laid[0, column, k] = links[top + k, column]
                laid[1, column, k] = first[top + k, column]
                laid[2, column, k] = second[top + k, column]
        smooth_downward(laid[0], strength, laid[1], laid[2], laid[3])
        for k in range(rows):
            for column in range(width):
                first[top + k, column] = laid[1, column, k]
                second[top + k, column] = laid[2, column, k]


@kernel(void(
    IN_F32_2D, IN_F32_2D, IN_F32_2D, IN_F32_2D, float32, float32, float32, float32, IN_F32_1D, IN_F32_1D, IN_F32_2D,
    float32[:, ::1]
))  # fmt: skip
def grade_depths(
    depths: Float32Array, trusts: Float32Array, spreads: Float32Array, gaps: Float32Array, spacing: float,
    tolerance: float, tolerance_share: float, slope_share: float, doubt_steps: Float32Array, gap_steps: Float32Array,
    table: Float32Array, confidence: Float32Array,
) -> None:  # fmt: skip
    """Look up the confidence of each pixel by its doubt and its gap.

    The doubt is the spread of the depths around the pixel, in tolerances; where these are of one surface, only
    `slope_share` of it counts.

    Args:
        depths: (H, W) [m], 0 for none, which has no confidence.
        trusts: (H, W), 1 on one surface, 0 across a jump.
        spreads: (H, W) [m].
        gaps: (H, W) [px].
        spacing: [px], the unit of the gaps.
        tolerance: [m], or …
        tolerance_share: … this share of the depth where that is more.
        slope_share: of the spread on one surface.
        doubt_steps: (D - 1,) rising, the borders of the table's rows.
        gap_steps: (G - 1,) rising, the borders of its columns.
        table: (D, G).
        confidence: (H, W), written.
    """
    height, width = depths.shape
    one = np.float32(1)
    for row in range(height):
        for column in range(width):
            depth = depths[row, column]
            if not depth > 0:
                confidence[row, column] = 0
                continue
            allowed = max(tolerance, tolerance_share * depth)
            share = one - trusts[row, column] * (one - slope_share)
            doubt, gap = share * spreads[row, column] / allowed, gaps[row, column] / spacing
            d, g = 0, 0
            for k in range(doubt_steps.shape[0]):
                d += doubt >= doubt_steps[k]
            for k in range(gap_steps.shape[0]):
                g += gap >= gap_steps[k]
            confidence[row, column] = table[d, g]


MOST_EXTENT = 29_000
"""Largest difference of two coordinates, corners included: 12 times its fourth power stays below 2⁶³."""

_CURVE_SIDE = 1 << 15

CORNERS = 4
"""The first points are the corners of a rectangle that holds all others."""


@inlined
def _rotation(points: Int64Array, a: int, b: int, p: int) -> int:
    """Positive where p is on the side of the line from a to b on which inner points of triangles are."""
    beside: int = (points[b, 0] - points[a, 0]) * (points[p, 1] - points[a, 1]) - (points[b, 1] - points[a, 1]) * (
        points[p, 0] - points[a, 0]
    )
    return beside


@inlined
def _in_circle(points: Int64Array, corners: AnyArray, p: int) -> bool:
    ax, ay = points[corners[0], 0] - points[p, 0], points[corners[0], 1] - points[p, 1]
    bx, by = points[corners[1], 0] - points[p, 0], points[corners[1], 1] - points[p, 1]
    cx, cy = points[corners[2], 0] - points[p, 0], points[corners[2], 1] - points[p, 1]
    a, b, c = ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy
    return bool(ax * (by * c - cy * b) - ay * (bx * c - cx * b) + a * (bx * cy - cx * by) > 0)


@inlined
def _locate(points: Int64Array, triangles: AnyArray, beside: AnyArray, start: int, p: int) -> int:
    """Walk to the triangle that contains the point."""
    at, rotated = start, True
    while rotated:
        rotated = False
        for k in range(3):
            a, b = triangles[at, (k + 1) % 3], triangles[at, (k + 2) % 3]
            if _rotation(points, a, b, p) < 0:
                at, rotated = beside[at, k], True
                break
    return at


@inlined
def _open_hole(
    points: Int64Array, triangles: AnyArray, beside: AnyArray, first: int, p: int, marks: AnyArray, hole: AnyArray,
    rim: AnyArray,
) -> tuple[int, int]:  # fmt: skip
    """List the triangles whose circle holds the point, and the rim: (from, to, triangle beyond) of each edge."""
    hole[0], marks[first], taken, edges, done = first, p, 1, 0, 0
    while done < taken:
        at = hole[done]
        done += 1
        for k in range(3):
            other = beside[at, k]
            if other >= 0 and marks[other] == p:
                continue
            if other >= 0 and _in_circle(points, triangles[other], p):
                marks[other] = p
                hole[taken] = other
                taken += 1
            else:
                rim[edges, 0], rim[edges, 1] = triangles[at, (k + 1) % 3], triangles[at, (k + 2) % 3]
                rim[edges, 2] = other
                edges += 1
    return taken, edges


@inlined
def _close_hole(
    triangles: AnyArray, beside: AnyArray, count: int, p: int, hole: AnyArray, taken: int, rim: AnyArray, edges: int,
    starting: AnyArray, marks: AnyArray,
) -> int:  # fmt: skip
    """Fill the hole with a fan around the point; triangle k of it stands on edge k of the rim."""
    for k in range(edges):
        new = hole[k] if k < taken else count + k - taken
        a, b, beyond = rim[k, 0], rim[k, 1], rim[k, 2]
        triangles[new, 0], triangles[new, 1], triangles[new, 2] = a, b, p
        beside[new, 2] = beyond
        marks[new] = -1
        starting[a] = new
        if beyond >= 0:
            for m in range(3):
                if triangles[beyond, (m + 1) % 3] == b and triangles[beyond, (m + 2) % 3] == a:
                    beside[beyond, m] = new
    for k in range(edges):
        new = hole[k] if k < taken else count + k - taken
        following = starting[rim[k, 1]]
        beside[new, 0] = following
        beside[following, 1] = new
    return count + edges - taken


@kernel(int64(IN_I64_2D, IN_I64_1D, int32[:, ::1]))
def triangulate(points: Int64Array, order: Int64Array, triangles: AnyArray) -> int:
    """Triangulate points so that no circumcircle holds another point.

    Args:
        points: (4 + N, 2); the first four are corners (left top, right top, right bottom, left bottom) of a rectangle
            inside which all others lie.
        order: (N,) the rows of the others in the order of their insertion, best along a curve that fills the plane.
        triangles: (2 N + 2, 3), written: rows of `points`, all rotating the same way.

    Returns:
        How many triangles were written. Those of the corners are among them; the second of two equal points is in none.
    """
    most = triangles.shape[0]
    beside, marks = np.full((most, 3), -1, np.int32), np.full(most, -1, np.int32)
    hole, rim = np.empty(most, np.int32), np.empty((most + 2, 3), np.int32)
    starting = np.empty(points.shape[0], np.int32)
    triangles[0, 0], triangles[0, 1], triangles[0, 2] = 0, 1, 2
    triangles[1, 0], triangles[1, 1], triangles[1, 2] = 0, 2, 3
    beside[0, 1], beside[1, 2] = 1, 0
    count, at = 2, 0
    for i in range(order.shape[0]):
        p = order[i]
        at = _locate(points, triangles, beside, at, p)
        known = False
        for k in range(3):
            corner = triangles[at, k]
            known |= points[corner, 0] == points[p, 0] and points[corner, 1] == points[p, 1]
        if known:
            continue
        taken, edges = _open_hole(points, triangles, beside, at, p, marks, hole, rim)
        count = _close_hole(triangles, beside, count, p, hole, taken, rim, edges, starting, marks)
        at = starting[rim[0, 0]]
    return count


@kernel(void(IN_I64_2D, int64[::1]))
def hilbert_codes(points: Int64Array, codes: Int64Array) -> None:
    """Number points along a curve that fills the plane, so that neighbours in the order lie near each other.

    `points` (N, 2), 0 to 2¹⁵ - 1; `codes` (N,), written.

    Source: Hilbert 1891, Mathematische Annalen 38.
    """
    for i in range(points.shape[0]):
        x, y, code = points[i, 0], points[i, 1], int64(0)
        side = _CURVE_SIDE >> 1
        while side > 0:
            right, below = int64((x & side) > 0), int64((y & side) > 0)
            code += side * side * ((3 * right) ^ below)
            if below == 0:
                if right == 1:
                    x, y = _CURVE_SIDE - 1 - x, _CURVE_SIDE - 1 - y
                x, y = y, x
            side >>= 1
        codes[i] = code
