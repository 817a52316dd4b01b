"""Dense depth images from sparse ones, by triangles between the measured points, with a confidence.

With x, y the direction of a pixel (x/z, y/z of the points in it), a plane n·p = d has 1/z = n·(x, y, 1) / d. So the
inverse depth changes linearly over the image, by at most 1/d for each radian, however far away and however grazing the
plane is seen: a road 1.65 m below the camera has the slope 0.6 1/m everywhere. Steeper is only what passes the camera
nearer than that, or a jump from one object to another.

How near surfaces pass the camera is measured: most of a street's image is ground and walls, so 0.7 of the image is
no steeper than they are. What is 1.3 times as steep holds a jump.

Triangles (Delaunay) hold inverse depth, in which planes are linear, so a plane comes out exactly: where the points
beyond a triangle's sides are in its plane, too, and it is not too steep. Elsewhere there are jumps, edges, or leaves,
and the triangle's three points and the three beyond vote: more the nearer they are, above and below before beside, as
outlines are mostly upright; far more in the pixel's own row as far as the next point of a scan line, which runs along
rows; and more where the image has their colour, by as much as colours tell surfaces apart in this image. The depth is
the mean of the votes, which errs least in squares, a little nearer to their median, which errs least in size.

A pixel's confidence is the probability that its depth is less than 0.5 m, or 5 %, from the truth: in planes the share
of held-out points that is; elsewhere by a logistic regression. It knows how many of the points are within that
tolerance of the depth, by their distances from the pixel (with colours, which mislead where the image and the sweep
do not match, it would foretell less), how far the votes are apart, and how far away they are.
`python -m benchmarks.depth fit DATA` makes it, each image with the same weight.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import float32, int32, int64, void

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array, check_array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import unproject
from sceneloom.colouring.results import FusedView
from sceneloom.errors import ArrayError
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import (
    IN_BOOL_1D,
    IN_F32_1D,
    IN_F32_2D,
    IN_I32_2D,
    IN_I64_1D,
    IN_I64_2D,
    IN_U8_2D,
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


_SURFACES, _STEEPER = 0.7, 1.3

_LEAST, _MOST = 0.5, 10.0
"""Bounds of the steepest slope [1/m/rad]: surfaces that pass the camera at 2 m are never cut apart."""

_LONGEST, _LONGEST_JUMP = 12.0, 2.5
"""The longest side of a triangle that is filled, in spacings of the scan lines: on one surface, and across a jump.

A hole of the cloud is a pane or a black car where its rims are of one surface; where they are not, it may be the sky,
or what is too far away to be measured.
"""

_SLIVER_PX2 = 0.05  # smaller triangles give no slope


@dataclass(frozen=True, slots=True, eq=False)
class Completed:
    """A dense depth image, and what its confidence is looked up by.

    Attributes:
        depths: (H, W) float32 [m], 0 for none.
        supports: (H, W) float32, the share of the votes, as they are without colours, within the tolerance of the
            depth; 2 in planes, without a vote.
        spreads: (H, W) float32, how far the votes are from the depth (root of the mean square), in tolerances.
    """

    depths: Float32Array
    supports: Float32Array
    spreads: Float32Array


def fill_surfaces(samples: Samples, rgb: UInt8Array | None, per_radian: float) -> Completed:
    """Fill an image (H, W) from triangles between its samples; `rgb` (H, W, 3) or None, pixels per radian."""
    height, width = samples.image.shape
    triangles, beyond = triangles_between(samples.pixels, height, width)
    measures = np.empty((len(triangles), 5), np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        measure_triangles(samples.pixels, samples.depths, triangles, beyond, TOLERANCE, TOLERANCE_SHARE, measures)
    areas, sides, shortest, slopes, inside = np.ascontiguousarray(measures.T)
    unit = max(1.0, float(np.median(shortest)) / 2) if len(shortest) else 1.0
    broad = (areas > _SLIVER_PX2) & np.isfinite(slopes)
    spacing = _weighted_quantile(sides, areas, 0.5)
    usual = _weighted_quantile(slopes[broad], areas[broad], _SURFACES)
    steepest = float(np.clip(_STEEPER * usual * per_radian, _LEAST, _MOST)) / per_radian
    planar: BoolArray = (inside == 1) & (slopes < steepest)
    steep: BoolArray = ~(slopes < steepest)
    small: BoolArray = sides <= np.where(steep, _LONGEST_JUMP, _LONGEST) * max(spacing, 2.0)
    image = np.zeros((height, width, 3), np.uint8) if rgb is None else np.ascontiguousarray(rgb)
    columns, rows = np.rint(samples.pixels).astype(np.int64).clip(0, [width - 1, height - 1]).T
    colours = image[rows, columns]
    likeness = _likeness(samples.depths, colours, triangles[small & steep])
    depths, supports, spreads = (np.zeros((height, width), np.float32) for _ in range(3))
    fill_triangles(
        samples.pixels, samples.depths, triangles, beyond, small, planar, image, colours, likeness, unit, TOLERANCE,
        TOLERANCE_SHARE, depths, supports, spreads,
    )  # fmt: skip
    bare: BoolArray = (samples.image > 0) & (depths == 0)  # without two others near
    depths[bare], supports[bare] = samples.image[bare], 2.0
    return Completed(depths, supports, spreads)


_ALIKE, _UNLIKE = 1.05, 1.15
"""Points are of one surface with depths up to 5 % apart, of two from 15 % on."""

_LEVELS = np.array([4, 8, 12, 18, 26, 38, 54, 76, 108, 152, 216, 300])
"""Borders between differences of colours that are told apart, all three channels together."""

_DEPENDENT = 0.7  # votes are not independent: the power of their likelihood ratio
_DOUBTED = 20.0  # so many pairs are counted beside the measured ones that tell nothing


def _likeness(depths: Float32Array, colours: UInt8Array, jumps: AnyArray) -> Float32Array:
    """How much a difference of colours speaks for one surface: measured along the sides of triangles across jumps.

    `depths` (N,) [m]; `colours` (N, 3); `jumps` (T, 3), rows of both. Gives (766,) float32 by the sum of the
    differences of the three channels: the likelihood ratio, to a power, as votes are not independent.
    """
    pairs = np.concatenate([jumps[:, [0, 1]], jumps[:, [1, 2]], jumps[:, [2, 0]]])
    apart = depths[pairs].max(axis=1) / depths[pairs].min(axis=1)
    difference = np.abs(np.diff(colours[pairs].astype(np.int64), axis=1)).sum(axis=(1, 2))
    cells = np.searchsorted(_LEVELS, difference)
    one, two = (np.bincount(cells[chosen], minlength=len(_LEVELS) + 1) for chosen in (apart < _ALIKE, apart > _UNLIKE))
    share = (one + two + 1e-3) / (one + two + 1e-3).sum()
    ratio = (one + _DOUBTED * share) / (one.sum() + _DOUBTED) * (two.sum() + _DOUBTED) / (two + _DOUBTED * share)
    falling = np.minimum.accumulate(ratio) ** _DEPENDENT
    return falling[np.searchsorted(_LEVELS, np.arange(766))].astype(np.float32)


def triangles_between(pixels: Float32Array, height: int, width: int) -> tuple[AnyArray, AnyArray]:
    """Triangulate points of an image.

    Args:
        pixels: (N, 2) float32 [px].

    Returns:
        triangles: (T, 3) int32, rows of `pixels`; without the triangles outside their hull.
        beyond: (T, 3) int32, the point beyond the side that is opposite each corner; -1 for none.
    """
    extent = max(height, width)
    scale = MOST_EXTENT / (3 * (extent + 1))
    inner = np.rint((pixels.astype(np.float64) + 0.5) * scale).astype(np.int64)
    most = int(np.ceil(extent * scale)) + 1
    corners = np.array([[-most, -most], [2 * most, -most], [2 * most, 2 * most], [-most, 2 * most]])
    codes = np.empty(len(inner), np.int64)
    hilbert_codes(np.ascontiguousarray(inner), codes)
    triangles, beside = (np.full((2 * len(inner) + 2, 3), -1, np.int32) for _ in range(2))
    count = triangulate(np.concatenate([corners, inner]), np.argsort(codes) + CORNERS, triangles, beside)
    triangles, beside = triangles[:count], beside[:count]
    # of the six corners of two triangles, two sides' ends are in both
    sums = triangles.sum(axis=1, dtype=np.int64)
    beyond = np.where(beside < 0, -1, sums[beside] - (sums[:, None] - triangles) - CORNERS)
    kept = (triangles >= CORNERS).all(axis=1)
    return triangles[kept] - np.int32(CORNERS), np.maximum(beyond[kept], -1).astype(np.int32)


TOLERANCE, TOLERANCE_SHARE = 0.5, 0.05
"""Depths count as right with an error of less than 0.5 m, or of less than 5 % where that is more."""

WEIGHTS = (1.030, 0.444, -0.594, -0.385)
"""Of the parts of a logit, as `grade_depths` states them: a logistic regression of whether a depth is right."""

PLANES = 0.990
"""The share of right depths in planes."""


def complete_depth(
    source: FusedView | Float32Array, camera: Camera | None = None, rgb: UInt8Array | None = None
) -> DenseDepth:
    """Give a depth, and its confidence, to every pixel between measured points.

    Points must be visible: of a view the hidden ones are left out. Where no points are near, as in the sky, there is
    no depth.

    Args:
        source: a sweep in an image, whose points count at their exact positions; or (H, W) float32 [m], the depths of
            some pixels, 0 for none.
        camera: the camera model of the image; a view has its own.
        rgb: (H, W, 3) uint8, the image, by which jumps are placed; None: that of the view, or none.

    Raises:
        ArrayError: an array is not of the camera's size, or a depth is NaN, infinite or negative.
        CalibrationError: the camera's model is unknown or has other coefficients.
    """
    if isinstance(source, FusedView):
        camera_model, samples = source.camera, Samples.of_view(source)
        image: UInt8Array | None = source.rgb if rgb is None else rgb
    elif camera is None:
        raise ArrayError("camera: missing; a depth image needs the camera model that it was taken with")
    else:
        camera_model, samples, image = camera, Samples.of_image(source, camera), rgb
    check_array("rgb", image, (camera_model.height, camera_model.width, 3), np.uint8, optional=True)
    filled = fill_surfaces(samples, image, pixels_per_radian(camera_model))
    confidence = np.empty_like(filled.depths)
    weights = np.array(WEIGHTS, np.float32)
    grade_depths(filled.depths, filled.supports, filled.spreads, weights, PLANES, confidence)
    return DenseDepth(filled.depths, confidence)


_NOTHING = np.float32(0)

_ROUNDING = np.float32(1e-4)
"""How far outside a triangle a pixel may be and still be filled by it, as a share of the triangle."""

_UPRIGHT = np.float32(0.5)  # how much a distance down the image counts beside one along it
_IN_ROW, _ROW_PX = np.float32(600), np.float32(0.3)
_TO_MEDIAN = np.float32(0.15)  # from the mean of the votes, which errs least in squares, to their median, least in size


@kernel(void(IN_F32_2D, IN_F32_1D, IN_I32_2D, IN_I32_2D, float32, float32, float32[:, ::1]))
def measure_triangles(
    pixels: Float32Array, depths: Float32Array, triangles: AnyArray, beyond: AnyArray, tolerance: float,
    tolerance_share: float, measures: Float32Array,
) -> None:  # fmt: skip
    """Measure each triangle.

    `pixels` (N, 2) [px]; `depths` (N,) [m]; `triangles`, `beyond` (T, 3), the points beyond the triangle's sides,
    negative for none; `measures` (T, 5), written: area [px²]; lengths of the longest and the shortest side [px]; how
    much the inverse depth changes for a pixel, the steepest way [1/m/px], infinite for triangles without area; the
    share of the points beyond its sides whose depth is within the tolerance [m], or within that share of it where that
    is more, of the triangle's plane, 1 where there are none.
    """
    one = np.float32(1)
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        bu, bv = pixels[b, 0] - pixels[a, 0], pixels[b, 1] - pixels[a, 1]
        cu, cv = pixels[c, 0] - pixels[a, 0], pixels[c, 1] - pixels[a, 1]
        twice = bu * cv - bv * cu
        sides = bu * bu + bv * bv, cu * cu + cv * cv, (bu - cu) ** 2 + (bv - cv) ** 2
        ya, yb, yc = one / depths[a], one / depths[b], one / depths[c]
        slope_u, slope_v = ((yb - ya) * cv - (yc - ya) * bv) / twice, ((yc - ya) * bu - (yb - ya) * cu) / twice
        known, met = _NOTHING, _NOTHING
        for k in range(3):
            other = beyond[t, k]
            if other >= 0:
                du, dv = pixels[other, 0] - pixels[a, 0], pixels[other, 1] - pixels[a, 1]
                expected = ya + slope_u * du + slope_v * dv
                allowed = max(tolerance, tolerance_share * depths[other])
                met += expected > 0 and abs(one / expected - depths[other]) < allowed
                known += one
        measures[t, 0] = 0.5 * abs(twice)
        measures[t, 1], measures[t, 2] = math.sqrt(max(sides)), math.sqrt(min(sides))
        measures[t, 3] = math.sqrt(slope_u * slope_u + slope_v * slope_v) if twice != 0 else math.inf
        measures[t, 4] = met / known if known > 0 else one


@inlined
def _span(value: float, step: float, columns: int) -> tuple[int, int]:
    """First and last of so many columns in which a value that grows by `step` is not below the rounding."""
    if step > 0:
        return max(0, math.ceil((-_ROUNDING - value) / step)), columns
    if step < 0:
        return 0, min(columns, math.floor((-_ROUNDING - value) / step))
    return 0, columns if value >= -_ROUNDING else -1


@inlined
def _shares(pixels: Float32Array, triangle: AnyArray, u: float, v: float) -> tuple[Any, Any]:
    """The shares of the second and the third corner in a position, which are linear in it."""
    a, b, c = triangle[0], triangle[1], triangle[2]
    bu, bv = pixels[b, 0] - pixels[a, 0], pixels[b, 1] - pixels[a, 1]
    cu, cv = pixels[c, 0] - pixels[a, 0], pixels[c, 1] - pixels[a, 1]
    du, dv, twice = u - pixels[a, 0], v - pixels[a, 1], bu * cv - bv * cu
    return (du * cv - dv * cu) / twice, (dv * bu - du * bv) / twice


@inlined
def _list_voters(depths: Float32Array, triangle: AnyArray, beyond: AnyArray, voters: AnyArray) -> int:
    """List a triangle's points and those beyond its sides by depth; how many."""
    count = 0
    for k in range(6):
        point, m = (triangle[k] if k < 3 else beyond[k - 3]), count
        if point < 0:
            continue
        while m > 0 and depths[voters[m - 1]] > depths[point]:
            voters[m] = voters[m - 1]
            m -= 1
        voters[m] = point
        count += 1
    return count


@inlined
def _vote(du: float, dv: float, unit: float) -> Any:
    """The weight of a point that is so many pixels away, along the row and down.

    The first term is of any point; the second of those in the pixel's row, as far as their neighbour on the scan line.
    """
    one, across = np.float32(1), du / unit
    along, down = across * across + one, _UPRIGHT * dv / unit
    off, away = dv / _ROW_PX, along + down * down
    off *= off
    return one / (away * math.sqrt(away)) + _IN_ROW / (along * along * along * (one + off * off))


@inlined
def _count_votes(
    pixels: Float32Array, depths: Float32Array, colours: UInt8Array, voters: AnyArray, count: int, u: float, v: float,
    unit: float, colour: UInt8Array, likeness: Float32Array, plain: Float32Array, votes: Float32Array,
) -> tuple[Any, Any]:  # fmt: skip
    """The depth that the voters, sorted by depth, give a pixel, and the sum of their votes.

    Written: the votes without colours, and the votes.
    """
    total, mean = _NOTHING, _NOTHING
    for k in range(count):
        point, difference = voters[k], 0
        for channel in range(3):
            difference += abs(int64(colour[channel]) - int64(colours[point, channel]))
        plain[k] = _vote(u - pixels[point, 0], v - pixels[point, 1], unit)
        votes[k] = likeness[difference] * plain[k]
        total += votes[k]
        mean += votes[k] * depths[point]
    below, m, half = votes[0], 0, np.float32(0.5) * total
    while below < half and m < count - 1:
        m += 1
        below += votes[m]
    mean /= total
    return mean + _TO_MEDIAN * (depths[voters[m]] - mean), total


@kernel(void(
    IN_F32_2D, IN_F32_1D, IN_I32_2D, IN_I32_2D, IN_BOOL_1D, IN_BOOL_1D, IN_U8_3D, IN_U8_2D, IN_F32_1D, float32, float32,
    float32, float32[:, ::1], float32[:, ::1], float32[:, ::1]
))  # fmt: skip
def fill_triangles(
    pixels: Float32Array, depths: Float32Array, triangles: AnyArray, beyond: AnyArray, filled: BoolArray,
    planar: BoolArray, rgb: UInt8Array, colours: UInt8Array, likeness: Float32Array, unit: float,
    tolerance: float, tolerance_share: float, depth_image: Float32Array, support_image: Float32Array,
    spread_image: Float32Array,
) -> None:  # fmt: skip
    """Fill the pixels of triangles: linearly in inverse depth on a surface, by a vote of six points across a jump.

    Args:
        pixels: (N, 2) [px].
        depths: (N,) [m].
        triangles: (T, 3), rows of both.
        beyond: (T, 3), the points beyond the triangle's sides; negative for none.
        filled: (T,), others are left out.
        planar: (T,), of one plane; in the others points vote.
        rgb: (H, W, 3).
        colours: (N, 3), of the points.
        likeness: (766,), what a vote counts by the difference of its colour, all channels together.
        unit: of distances between votes and pixels [px]: half of the usual one between points of a scan line.
        tolerance: [m], or …
        tolerance_share: … this share of the depth where that is more.
        depth_image: (H, W) [m], written where a triangle is.
        support_image: (H, W), the share of the votes, without colours, within the tolerance of the depth; 2 in planes.
        spread_image: (H, W), where points vote how far they are from the depth, in tolerances.
    """
    height, width = depth_image.shape
    one = np.float32(1)
    voters, plain, votes = np.empty(6, np.int64), np.empty(6, np.float32), np.empty(6, np.float32)
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        au, av, bu, bv, cu, cv = (
            pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1], pixels[c, 0], pixels[c, 1]
        )  # fmt: skip
        left, right = max(0, math.ceil(min(au, bu, cu))), min(width - 1, math.floor(max(au, bu, cu)))
        top, bottom = max(0, math.ceil(min(av, bv, cv))), min(height - 1, math.floor(max(av, bv, cv)))
        twice = (bu - au) * (cv - av) - (bv - av) * (cu - au)
        if not filled[t] or twice == 0 or left > right or top > bottom:
            continue
        count = 0 if planar[t] else _list_voters(depths, triangles[t], beyond[t], voters)
        ya, yb, yc = one / depths[a], one / depths[b], one / depths[c]
        step_b, step_c, columns = (cv - av) / twice, -(bv - av) / twice, right - left
        for row in range(top, bottom + 1):
            share_b, share_c = _shares(pixels, triangles[t], np.float32(left), np.float32(row))
            first_b, last_b = _span(share_b, step_b, columns)
            first_c, last_c = _span(share_c, step_c, columns)
            first_a, last_a = _span(one - share_b - share_c, -step_b - step_c, columns)
            for column in range(max(first_a, first_b, first_c), min(last_a, last_b, last_c) + 1):
                of_b, of_c = share_b + np.float32(column) * step_b, share_c + np.float32(column) * step_c
                u = left + column
                across, down = np.float32(u), np.float32(row)
                depth = one / ((one - of_b - of_c) * ya + of_b * yb + of_c * yc)
                support_image[row, u] = one + one
                if count > 0:
                    depth, total = _count_votes(
                        pixels, depths, colours, voters, count, across, down, unit, rgb[row, u], likeness, plain, votes
                    )
                    allowed = max(tolerance, tolerance_share * depth)
                    near, every, squares = _NOTHING, _NOTHING, _NOTHING
                    for k in range(count):
                        off = depths[voters[k]] - depth
                        near += plain[k] if abs(off) < allowed else _NOTHING
                        every += plain[k]
                        squares += votes[k] * off * off
                    support_image[row, u] = near / every
                    spread_image[row, u] = math.sqrt(squares / total) / allowed
                depth_image[row, u] = depth


_LEAST_SHARE = np.float32(0.02)
_LEAST_SPREAD, _MOST_SPREAD = np.float32(0.01), np.float32(100)
_FAR = np.float32(TOLERANCE / TOLERANCE_SHARE)  # from here on the tolerance is a share of the depth


@kernel(void(IN_F32_2D, IN_F32_2D, IN_F32_2D, IN_F32_1D, float32, float32[:, ::1]))
def grade_depths(
    depths: Float32Array, supports: Float32Array, spreads: Float32Array, weights: Float32Array, planes: float,
    confidence: Float32Array,
) -> None:  # fmt: skip
    """Give each pixel the probability that its depth is right.

    Args:
        depths, supports, spreads: (H, W), as `Completed` has them.
        weights: (4,), of 1, the logit of the support, the logarithm of the spread, and that of the depth in multiples
            of 10 m where it is more; their sum is the logit of the probability.
        planes: the probability in planes.
        confidence: (H, W), written; 0 where there is no depth.
    """
    height, width = depths.shape
    one = np.float32(1)
    for row in range(height):
        for column in range(width):
            depth, support = depths[row, column], supports[row, column]
            if depth == 0 or support > one:
                confidence[row, column] = planes if depth > 0 else _NOTHING
                continue
            share = min(max(support, _LEAST_SHARE), one - _LEAST_SHARE)
            spread = min(max(spreads[row, column], _LEAST_SPREAD), _MOST_SPREAD)
            score = weights[0] + weights[1] * math.log(share / (one - share)) + weights[2] * math.log(spread)
            score += weights[3] * math.log(max(depth / _FAR, one))
            confidence[row, column] = one / (one + math.exp(-score))


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


@kernel(int64(IN_I64_2D, IN_I64_1D, int32[:, ::1], int32[:, ::1]))
def triangulate(points: Int64Array, order: Int64Array, triangles: AnyArray, beside: AnyArray) -> int:
    """Triangulate points so that no circumcircle holds another point.

    Args:
        points: (4 + N, 2); the first four are corners (left top, right top, right bottom, left bottom) of a rectangle
            inside which all others lie.
        order: (N,) the rows of the others in the order of their insertion, best along a curve that fills the plane.
        triangles: (2 N + 2, 3), written: rows of `points`, all rotating the same way.
        beside: (2 N + 2, 3), all -1; written: the triangle beyond the side that is opposite each corner, -1 for none.

    Returns:
        How many triangles were written. Those of the corners are among them; the second of two equal points is in none.
    """
    most = triangles.shape[0]
    marks = np.full(most, -1, np.int32)
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
