"""Dense depth images from sparse ones, by gaps between scan lines or by triangulated surfaces.

With a confidence for each pixel.

With x, y the direction of a pixel (x/z, y/z of the points in it), a plane n·p = d has 1/z = n·(x, y, 1) / d. So the
inverse depth changes evenly over the image, by at most 1/d for each radian, however far away and however grazing the
plane is seen: a road 1.65 m below the camera has the slope 0.6 1/m everywhere. Steeper is only what passes the camera
nearer than that, or a jump from one thing to another.

How near surfaces pass the camera is measured: most of a street's image is ground and walls, so 0.7 of the image is
no steeper than they are. What is 1.3 times as steep is half a jump.

Morphology closes a gap by widening what is known and drawing the rim back; here the two rims are joined by what lies
between them: evenly in inverse depth on one surface, evenly in depth across a jump, where that errs least. Samples are
first widened along their row to their neighbours on the scan line, so that columns meet the lines.

Triangles (Delaunay) hold inverse depth, in which planes are linear, so a plane comes out exactly; the slopes around
their corners report how surfaces bend between scan lines. Across jumps they state little: there, depths flow in from
the surfaces on both sides, over pixels of one colour and hardly across edges of the image.

A pixel's confidence is the share of pixels like it whose depth was less than 0.5 m, or 5 %, from the truth. Alike are
pixels with the same doubt (how far apart the depths are between which the pixel lies, in units of that tolerance, of
which a twentieth counts where they are of one surface) and the same gap (in spacings of the scan lines). Both tables
fall along rows and columns. `python -m benchmarks.depth fit` makes them; the sky counts as wrong.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, UInt8Array, check_array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import unproject
from sceneloom.colouring.results import FusedView
from sceneloom.errors import ArrayError, OptionError
from sceneloom.kernels.completion import (
    blend_neighbours,
    fill_across,
    fill_down,
    fill_triangles,
    grade_depths,
    link_pixels,
    look_up,
    measure_slopes,
    measure_triangles,
    smooth_downward,
    smooth_rightward,
    widen_samples,
)
from sceneloom.kernels.delaunay import CORNERS, MOST_EXTENT, hilbert_codes, triangulate


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
    """The measured points that an image shows.

    Attributes:
        image: (H, W) float32 [m], the nearest of each pixel, 0 for none.
        pixels: (N, 2) float32 [px], where each is.
        depths: (N,) float32 [m], all positive and finite.
    """

    image: Float32Array
    pixels: Float32Array
    depths: Float32Array

    @classmethod
    def of_view(cls, view: FusedView) -> "Samples":
        """The visible points of a view, at their locations between the pixels."""
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
        locations = np.flatnonzero(image)
        rows, columns = np.divmod(locations, camera.width)
        return cls(image, np.stack([columns, rows], axis=1).astype(np.float32), image.ravel()[locations])


def pixels_per_radian(camera: Camera) -> float:
    """How many pixels a radian takes in the middle of the image, of any camera model.

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
    """The value below which this share of the weight lies; 0 of nothing."""
    if len(values) == 0:
        return 0.0
    order = np.argsort(values)
    sums: Float64Array = np.cumsum(weights[order], dtype=np.float64)
    return float(values[order[min(int(np.searchsorted(sums, share * sums[-1])), len(values) - 1)]])


_SURFACES = 0.7

_STEEPER = 1.2

_LEAST, _MOST = 0.5, 10.0
"""Bounds of what counts as steep [1/m/rad]: surfaces that pass the camera at 2 m are never cut apart."""

_EVEN, _SUDDEN = 0.85, 1.3
"""Up to 0.85 of it there is one surface; from 1.3 on there are two."""


def _steepest_slope(slopes: AnyArray, weights: AnyArray, per_radian: float) -> float:
    """Give how much the inverse depth of one surface changes at most from pixel to pixel [1/m/px].

    Args:
        slopes: (N,) [1/m/px], measured ones.
        weights: (N,), how much of the image each of them is of.
        per_radian: pixels per radian.
    """
    finite = np.isfinite(slopes)
    usual = _weighted_quantile(slopes[finite], weights[finite], _SURFACES)
    return float(np.clip(_STEEPER * usual * per_radian, _LEAST, _MOST)) / per_radian


def _trusts_of(slopes: AnyArray, steepest: float) -> Float32Array:
    """Give 1 for slopes of one surface, 0 for jumps, and what is between for what is between."""
    jumps = np.clip((slopes / steepest - _EVEN) / (_SUDDEN - _EVEN), 0.0, 1.0)
    return (1.0 - jumps).astype(np.float32)


_WIDENED_PER_STEP = 0.6
"""Widening, in steps from sample to sample of a scan line: a little more than half, as steps differ."""

_USUAL_STEP_SHARE = 0.4

_THIN = 2.0
"""Up to so many rows apart samples are of one scan line, which is on its trajectory from row to row [px]."""

_LONGEST, _REACH = 3.0, 1.0
"""The longest gap that is closed, and how far the last scan line reaches, in spacings of the lines."""


@dataclass(frozen=True, slots=True, eq=False)
class _Filled:
    """A dense depth image in the making.

    Attributes:
        depths: (H, W) float32 [m], 0 for none.
        trusts: (H, W) float32, 1 on one surface, 0 across a jump.
        spreads: (H, W) float32 [m], how far apart the depths are that a pixel lies between.
        gaps: (H, W) float32 [px], how far apart they are in the image.
        spacing: between scan lines [px]; 0 where there are no two.
    """

    depths: Float32Array
    trusts: Float32Array
    spreads: Float32Array
    gaps: Float32Array
    spacing: float


def _close_gaps(samples: Samples, per_radian: float) -> _Filled:
    """Fill the gaps between samples.

    Args:
        samples: the measured points.
        per_radian: pixels per radian.
    """
    sparse = samples.image
    locations = np.flatnonzero(sparse)
    rows, columns = np.divmod(locations, sparse.shape[1])
    widened, above, distances = (np.empty_like(sparse) for _ in range(3))
    widen_samples(sparse, _widening(rows, columns), widened)
    look_up(widened, above, distances)
    spacing, steepest = _measure(sparse, rows, columns, above, distances, per_radian)
    depths, trusts, spreads, gaps = (np.empty_like(sparse) for _ in range(4))
    longest = _LONGEST * spacing
    fill_down(widened, above, distances, longest, _REACH * spacing, steepest, depths, trusts, spreads, gaps)
    fill_across(sparse, longest, steepest, depths, trusts, spreads, gaps)
    return _Filled(depths, trusts, spreads, gaps, spacing)


def _blend(depths: Float32Array) -> Float32Array:
    """Average each pixel with its filled neighbours, over five pixels."""
    blended = np.empty_like(depths)
    blend_neighbours(depths, np.empty((2, depths.size), np.float32), blended)
    return blended


def _widening(rows: np.ndarray, columns: np.ndarray) -> int:
    """How far a sample is widened [px]; 0 where no two are in one row."""
    steps = np.diff(columns)[np.diff(rows) == 0]
    if len(steps) == 0:
        return 0
    at = int(_USUAL_STEP_SHARE * (len(steps) - 1))
    return max(1, round(_WIDENED_PER_STEP * float(np.partition(steps, at)[at])))


def _measure(
    sparse: Float32Array,
    rows: np.ndarray,
    columns: np.ndarray,
    above: Float32Array,
    distances: Float32Array,
    per_radian: float,
) -> tuple[float, float]:
    """Give the spacing of the scan lines [px], and the steepest slope of one surface [1/m/px]."""
    inner = rows > 0
    rows, columns = rows[inner], columns[inner]
    apart = distances[rows - 1, columns] + 1.0
    between = (apart > _THIN) & (apart < sparse.shape[0])
    rows, columns, apart = rows[between], columns[between], apart[between]
    changes = np.abs(1.0 / sparse[rows, columns] - 1.0 / above[rows - 1, columns])
    spacing = float(np.median(apart)) if len(apart) else 0.0
    return spacing, _steepest_slope(changes / apart, apart, per_radian)


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


def _cover_surfaces(samples: Samples, rgb: UInt8Array | None, per_radian: float) -> _Filled:
    """Fill an image from triangles between its samples.

    Args:
        samples: the measured points.
        rgb: (H, W, 3) uint8, the image; None: jumps are placed without one.
        per_radian: pixels per radian.
    """
    filled = _close_gaps(samples, per_radian)
    triangles = triangles_between(samples.pixels, *samples.image.shape)
    inverse_depths, measures = np.reciprocal(samples.depths), np.empty((len(triangles), 3), np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        measure_triangles(samples.pixels, inverse_depths, triangles, measures)
    areas, sides, slopes = np.ascontiguousarray(measures.T)
    broad = areas > _SLIVER_PX2
    spacing = _weighted_quantile(sides, areas, 0.5)
    steepest = _steepest_slope(slopes[broad], areas[broad], per_radian)
    trusts = _trusts_of(slopes, steepest)
    bends = np.empty_like(samples.pixels)
    measure_slopes(samples.pixels, inverse_depths, triangles, trusts, bends, np.empty_like(samples.depths))
    beyond = _fill(samples, bends, triangles, sides, trusts, spacing, filled)
    depths = _guide(filled, beyond, rgb, spacing)
    return _Filled(depths, filled.trusts, filled.spreads, filled.gaps, spacing)


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
    filled: _Filled,
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


def _guide(filled: _Filled, beyond: BoolArray, rgb: UInt8Array | None, spacing: float) -> Float32Array:
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


TOLERANCE, TOLERANCE_SHARE = 0.5, 0.05
"""What counts as right: an error of less than 0.5 m, or of less than 5 % where that is more."""

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
)
"""Confidence by method, row by row of rising doubt, column by column of rising gaps."""


def _grade(method: str, filled: _Filled) -> Float32Array:
    """Give the confidence of each pixel, (H, W) float32, 0 to 1.

    Args:
        method: whose table counts.
        filled: what the method made.
    """
    confidence = np.empty_like(filled.depths)
    grade_depths(
        filled.depths,
        filled.trusts,
        filled.spreads,
        filled.gaps,
        max(filled.spacing, 1.0),
        TOLERANCE,
        TOLERANCE_SHARE,
        SLOPE_SHARE,
        np.array(DOUBT_STEPS, np.float32),
        np.array(GAP_STEPS, np.float32),
        np.array(_TABLES[method], np.float32),
        confidence,
    )
    return confidence


def complete_depth(
    source: FusedView | Float32Array,
    camera: Camera | None = None,
    rgb: UInt8Array | None = None,
    *,
    method: str = "quality",
) -> DenseDepth:
    """Give a depth to every pixel near measured points, and state how far each can be trusted.

    Points must be free of what the camera does not see: of a view the hidden ones are left out. What has no points near
    it, as the sky, stays empty.

    Args:
        source: a sweep in an image, whose points count at their exact locations; or (H, W) float32 [m], the depths of
            some pixels, 0 for none.
        camera: the camera model of the image; a view has its own.
        rgb: (H, W, 3) uint8, the image, by which `quality` locations jumps; None: that of the view, or none.
        method: a name out of `METHODS`.

    Raises:
        ArrayError: an array is not of the camera's size, or a depth is NaN, infinite or negative.
        CalibrationError: the camera's model is unknown or has other coefficients.
        OptionError: the method is not known.
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
    return DenseDepth(filled.depths, _grade(method, filled))


def _fill_fast(samples: Samples, _: UInt8Array | None, per_radian: float) -> _Filled:
    filled = _close_gaps(samples, per_radian)
    return _Filled(_blend(filled.depths), filled.trusts, filled.spreads, filled.gaps, filled.spacing)


_Method = Callable[[Samples, UInt8Array | None, float], _Filled]
"""Fills an image: samples, the image or None, pixels per radian."""

METHODS: Mapping[str, _Method] = MappingProxyType({"fast": _fill_fast, "quality": _cover_surfaces})
"""Name of each method and what runs it."""
