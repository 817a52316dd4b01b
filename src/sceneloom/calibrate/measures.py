"""How well image and cloud agree under a candidate calibration: depth edges at image edges, intensity and grey levels.

Source: Levinson and Thrun 2013, "Automatic Online Calibration of Cameras and Lasers": range jumps to both sides, the
nearer point counts. Ours: jumps across the scan lines too, and their direction, which edges of images must share.

Source: mutual information of intensity and grey: Pandey, McBride, Savarese and Eustice 2012, "Automatic Targetless
Extrinsic Calibration of a 3D Lidar and Camera by Maximizing Mutual Information"; over levels that are equally frequent
it is, except for a constant, the normalised information distance that Taylor and Nieto 2012 use. Linear B-splines as
the Parzen window: Unser and Thévenaz 2000.
"""

from collections.abc import Collection, Sequence
from copy import copy
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np
from numba import float64, int16, types, void
from scipy import ndimage

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array
from sceneloom.calibrate.frames import CalibrationFrame, ScanOrder
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import (
    PointsInImage,
    domain_angle,
    intrinsics_vector,
    project_unbounded,
    projection_kernel,
    unproject,
)
from sceneloom.colouring.visibility import VisibilitySettings, find_visible
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import IN_F32_1D, IN_F32_2D, IN_F32_3D, IN_I64_1D, IN_U8_1D, inlined


class Parameter(IntEnum):
    """The numbers of a change, in this order."""

    PITCH = 0
    YAW = 1
    ROLL = 2
    RIGHT = 3
    DOWN = 4
    AHEAD = 5
    FOCAL = 6
    LATER = 7


COUNT = len(Parameter)
ROTATION = (Parameter.PITCH, Parameter.YAW, Parameter.ROLL)
TRANSLATION = (Parameter.RIGHT, Parameter.DOWN, Parameter.AHEAD)
UNITS = np.array([*(np.radians(0.25),) * 3, 0.05, 0.05, 0.05, 0.01, 0.02])
"""Comparable steps of each: 0.25 degrees, 5 cm, 1 % of the focal length, 20 ms."""

DIRECTIONS = 4
"""Edges are distinguished by the direction across them: 0, 45, 90, 135 degrees from rightward to downward."""

EDGES, _EDGES_COARSE, INFORMATION = "edges", "edges-coarse", "information"
MEASURES = (EDGES, _EDGES_COARSE, INFORMATION)
"""The measures; of all of them more is better."""

_WIDTHS_PX = {EDGES: 1.0, _EDGES_COARSE: 5.0}
"""How far edges are widened, so that points that miss them by a little still meet them."""

_LEVELS, _LEVEL_STEPS = 24, 16
"""Grey levels and intensities are distinguished by so many; parts of a grey level that are distinguished."""

_PIXELS_PER_RADIAN = 750.0
"""About the finest that is looked at: a pixel of 0.08 degrees is less than the step of nearly all lidars."""

_SMOOTHED_PX, _GREY_PX = 1.0, 1.5
_SURROUNDINGS_PX = 61  # edges are compared with others this near

_NOISE, _STRONGEST = 2.0, 3.0
"""Grey levels per pixel that noise and compression make; edges as multiples of their surroundings, at most."""

_LEAST_JUMP, _JUMP_SHARE, _LARGEST_JUMP = 0.4, 0.04, 3.0
"""A jump is larger than this [m], and than this share of the range; one larger than that counts no more [m]."""

_GAP_STEPS, _NEIGHBOURS, _ISOLATED = 4.0, 16, 3.0
_SLANT_FACTOR = 2.0  # a surface that slants so many times as much as where it was last seen explains a jump

_SURFACE_DISTANCE = 0.6
"""Surfaces pass the lidar no nearer [m]: along them inverse range changes by less than one over it for each radian, so
that ground seen at a grazing angle is no edge."""

_TILES_ACROSS, _TILES_DOWN = 6, 3
_TILES = _TILES_ACROSS * _TILES_DOWN
"""Tiles of an image: how much these differ shows how much chance there is in a score."""

_BESIDE = np.radians(6.0)  # points so far outside the image may come into it [rad]

_MOST_POINTS = 6000  # points of a frame whose intensity is compared, evenly drawn

_SMOOTHED_BINS = 0.7
_THINNED = 3  # one feature of so many shows well enough where to look next

_LEAST_SHARE = 0.25
"""Of the features that fall into the images under the stated calibration, so many must do so under a candidate."""


@dataclass(frozen=True, slots=True)
class Change:
    """A candidate's change of the stated calibration.

    Attributes:
        numbers: eight: a rotation about the camera's x, y and z axes [rad] and a translation along them [m], of the
            cloud as the camera sees it; the logarithm of a factor on the focal lengths; how long after its timestamp
            an image was really taken [s], which counts where the lidar's motion is known.
    """

    numbers: tuple[float, ...] = (0.0,) * COUNT

    @classmethod
    def of(cls, numbers: Float64Array) -> "Change":
        """Take (8,) numbers."""
        return cls(tuple(float(number) for number in numbers))

    @classmethod
    def rotation(cls, rotation: Float64Array) -> "Change":
        """Rotate the cloud about the camera's axes by a rotation vector, (3,) [rad]."""
        return cls((*(float(number) for number in rotation), *(0.0,) * (COUNT - 3)))

    def camera_from_lidar(self, stated: Float64Array) -> Float64Array:
        """Change a `camera_from_lidar`, (4, 4)."""
        changed: Float64Array = _screw_motion(np.array(self.numbers[:6])) @ stated
        return changed

    def camera_from_points(self, frame: CalibrationFrame) -> Float64Array:
        """Give the transform of the points of a frame into the camera, (4, 4) float64, contiguous."""
        changed = self.camera_from_lidar(frame.camera_from_lidar.matrix)
        later = self.numbers[Parameter.LATER]
        if later != 0.0 and frame.twist_lidar is not None:
            changed = changed @ _screw_motion(-later * frame.twist_lidar)
        return np.ascontiguousarray(changed)

    def camera_model(self, intrinsics_vector: Float64Array) -> Float64Array:
        """Change the numbers of a camera model."""
        changed = intrinsics_vector.copy()
        changed[:2] *= np.exp(self.numbers[Parameter.FOCAL])
        return changed


def _screw_motion(screw: Float64Array) -> Float64Array:
    """The (4, 4) transform of angular velocity [rad] and velocity [m], (6,), over a unit of time."""
    # Source: exponential map of SE(3), e.g. Barfoot 2017, State Estimation for Robotics, eq. 7.34 to 7.37
    rotation, velocity = screw[:3], screw[3:]
    angle = float(np.linalg.norm(rotation))
    x = np.array([[0.0, -rotation[2], rotation[1]], [rotation[2], 0.0, -rotation[0]], [-rotation[1], rotation[0], 0.0]])
    a, b, c = 1.0, 0.5, 1.0 / 6.0
    if angle >= 1e-8:
        a = np.sin(angle) / angle
        b = (1.0 - np.cos(angle)) / angle**2
        c = (1.0 - a) / angle**2
    matrix = np.eye(4)
    matrix[:3, :3] += a * x + b * (x @ x)
    matrix[:3, 3] = velocity + b * (x @ velocity) + c * (x @ (x @ velocity))
    return matrix


@dataclass(frozen=True, slots=True, eq=False)
class _MeasuredImage:
    """An image as measures need it."""

    camera: Camera  # of the reduced image
    camera_model: Float64Array  # its numbers as the projection takes them
    grey: Float32Array  # (H, W), the reduced image, 0 to 255
    maps: dict[str, Float32Array]
    """By measure: edges (4, H, W), by direction, in multiples of the usual; for `INFORMATION` grey levels (H, W)."""
    plainness: float  # share of the image that shows nothing, being of one brightness


def _blur(image: Float32Array, width: float, output: Float32Array | None = None) -> Float32Array:
    """Blur an image (H, W) float32 by a Gaussian of a standard deviation [px], up to three of it; borders mirror."""
    return np.asarray(ndimage.gaussian_filter(image, width, truncate=3.0, output=output), np.float32)


def _box_means(image: Float32Array, size: int) -> Float32Array:
    """Average an image (H, W) float32 over squares of an odd side [px]; the border's pixels go on beyond it."""
    return np.asarray(ndimage.uniform_filter(image, size, mode="nearest"), np.float32)


def measured_image(grey: Float32Array, camera: Camera, measures: Collection[str] = MEASURES) -> _MeasuredImage:
    """Reduce an image to pixels of at least 0.08 degrees, and find what these measures need: its edges and levels."""
    small, reduced = _reduced_image(grey, camera)
    smoothed = _blur(small, _SMOOTHED_PX)
    across, down = ndimage.sobel(smoothed, 1) / 8.0, ndimage.sobel(smoothed, 0) / 8.0
    strength = np.hypot(across, down)
    shares = 1.0 / (_box_means(strength, _SURROUNDINGS_PX) + np.float32(_NOISE))
    plain = float(np.mean(_box_means(strength, 9) < 0.25))
    maps = {name: np.empty((DIRECTIONS, *small.shape), np.float32) for name in _WIDTHS_PX if name in measures}
    angles = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    for number, (cosine, sine) in enumerate(np.column_stack([np.cos(angles), np.sin(angles)]).astype(np.float32)):
        directed = np.minimum(np.abs(across * cosine + down * sine) * shares, np.float32(_STRONGEST))
        for name, edges in maps.items():
            _blur(directed, _WIDTHS_PX[name], edges[number])
    if INFORMATION in measures:
        maps[INFORMATION] = evened(_blur(small, _GREY_PX))
    return _MeasuredImage(reduced, intrinsics_vector(reduced), small, maps, plain)


def _reduced_image(grey: Float32Array, camera: Camera) -> tuple[Float32Array, Camera]:
    """Average blocks of pixels to at least 0.08 degrees; the remainder at the ends is cut."""
    factor = max(int(min(camera.fx, camera.fy) / _PIXELS_PER_RADIAN + 0.25), 1)
    height, width = grey.shape[0] // factor, grey.shape[1] // factor
    if factor == 1 or height < 2 or width < 2:
        return grey, camera
    blocks = grey[: height * factor, : width * factor].reshape(height, factor, width, factor)
    cut = replace(camera, width=width * factor, height=height * factor)
    return np.ascontiguousarray(blocks.mean(axis=(1, 3), dtype=np.float32)), cut.resized(width, height)


def evened(grey: Float32Array) -> Float32Array:
    """Turn brightness (H, W), 0 to 255, into levels that are as frequent as any other, 0 to `_LEVELS` - 1."""
    sample = np.sort(grey.ravel()[:: max(grey.size // 20_000, 1)])
    shares = np.searchsorted(sample, np.arange(256 * _LEVEL_STEPS) / _LEVEL_STEPS) / max(len(sample), 1)
    table = (shares * (_LEVELS - 1)).astype(np.float32)
    return table[np.clip(grey * _LEVEL_STEPS, 0, len(table) - 1).astype(np.int32)]


@dataclass(frozen=True, slots=True, eq=False)
class DepthEdges:
    """Points at the edges of near surfaces.

    Attributes:
        points_lidar: (N, 3) float64 [m], at the image's time, as far away as the nearer of two points, halfway to the
            direction of the farther one: the edge is somewhere between the two.
        outwards_lidar: (N, 3) float64 [m], as far away, in the direction of the farther one.
        weights: (N,) float32, the jump [m], at most 3.
    """

    points_lidar: Float64Array
    outwards_lidar: Float64Array
    weights: Float32Array


def find_depth_edges(frame: CalibrationFrame, chosen: Int64Array) -> DepthEdges:
    """Find the edges among some points of a frame, (M,) int64, which the camera may see."""
    if frame.scan is None:
        eye = frame.camera_from_lidar.inverse().translation
        near, far = _jumps_anywhere(frame.points_lidar, chosen, eye)
        shares, reaches = np.ones(len(near)), np.ones(len(near))
    else:
        eye = np.zeros(3)
        near, far, shares, reaches = _jumps_in_scan(frame.scan, chosen)
    inner, outer = frame.points_lidar[near] - eye, frame.points_lidar[far] - eye
    ranges_near, ranges_far = np.linalg.norm(inner, axis=1), np.linalg.norm(outer, axis=1)
    weights = (shares * np.minimum(ranges_far - ranges_near, _LARGEST_JUMP)).astype(np.float32)
    outer *= (ranges_near / ranges_far)[:, None]
    middle = inner + outer
    middle *= (reaches * ranges_near / np.linalg.norm(middle, axis=1))[:, None]
    return DepthEdges(np.ascontiguousarray(middle + eye), np.ascontiguousarray(outer + eye), weights)


def _is_jump(near: Float64Array, far: Float64Array, apart: Float64Array | float) -> BoolArray:
    """Whether the range jumps between two points, seen at an angle [rad] to one another."""
    with np.errstate(divide="ignore"):
        steep = 1.0 / near - 1.0 / far > apart / _SURFACE_DISTANCE
    return np.asarray((far - near > _least_jump(near)) & steep)


def _least_jump(near: Float64Array) -> Float64Array:
    return np.maximum(_LEAST_JUMP, _JUMP_SHARE * near)


def _jumps_in_scan(scan: ScanOrder, chosen: Int64Array) -> tuple[Int64Array, Int64Array, Float64Array, Float64Array]:
    """Jumps on and between lines: near points, far points, shares (what each counts) and reaches, (N,)."""
    # jumps between lines count less, since lines lie farther apart; a reach is a multiple of the near point's range
    part = scan.part(chosen)
    if len(part.order) < 2:
        return part.order[:0], part.order[:0], np.zeros(0), np.zeros(0)
    pairs, step = part.along(_GAP_STEPS)
    after = np.full(len(part.order), -1)
    after[pairs] = pairs + 1
    spacing = scan.spacing
    jumps = [
        _jumps_along(onwards, back, part.ranges, apart)
        for ahead, apart in ((after, step), (part.above(step), spacing))
        for onwards, back in ((ahead, _reversed(ahead)), (_reversed(ahead), ahead))
    ]
    near, far, reaches = (np.concatenate(columns) for columns in zip(*jumps, strict=True))
    share = min(step / spacing, 1.0) if spacing > 0 else 1.0
    shares = np.repeat([1.0, 1.0, share, share], [len(rows) for rows, _, _ in jumps])
    return part.order[near], part.order[far], shares, reaches


def _reversed(ahead: Int64Array) -> Int64Array:
    """Of each row the one that it is ahead of; -1 for none."""
    behind = np.full(len(ahead), -1)
    behind[ahead[ahead >= 0]] = np.flatnonzero(ahead >= 0)
    return behind


def _jumps_along(
    onwards: Int64Array, back: Int64Array, ranges: Float64Array, apart: float
) -> tuple[Int64Array, Int64Array, Float64Array]:
    """Jumps from each row to the next one: near rows, far rows, reaches."""
    # where the near surface is one point wide its slant counts as none; a point that itself lies behind an edge, or has
    # none beside it, is no end of a surface that is known
    near = np.flatnonzero(onwards >= 0)
    near = near[_is_jump(ranges[near], ranges[onwards[near]], apart)]
    far, before = onwards[near], back[near]
    previous = np.where(before >= 0, ranges[before], ranges[near])
    same = np.abs(previous - ranges[near]) < _least_jump(ranges[near])
    # a plane's inverse range changes evenly with the angle
    slants = np.where(same, 1.0 / previous - 1.0 / ranges[near], 0.0)
    explained = 1.0 / ranges[near] - 1.0 / ranges[far] < _SLANT_FACTOR * slants
    kept = (before >= 0) & (same | (previous > ranges[near])) & ~explained
    reaches = 1.0 / np.maximum(1.0 - 0.5 * slants * ranges[near], ranges[near] / ranges[far])
    return near[kept], far[kept], reaches[kept]


def _jumps_anywhere(
    points_lidar: Float64Array, chosen: Int64Array, eye_lidar: Float64Array
) -> tuple[Int64Array, Int64Array]:
    """Jumps between neighbours in direction as seen from a location near the lidar, where no lines are known."""
    if len(chosen) <= _NEIGHBOURS:
        return chosen[:0], chosen[:0]
    from scipy.spatial import cKDTree

    points = points_lidar[chosen] - eye_lidar
    ranges = np.maximum(np.linalg.norm(points, axis=1), 1e-9)
    directions = points / ranges[:, None]
    found = cKDTree(directions).query(directions, k=_NEIGHBOURS + 1)
    distances, others = np.asarray(found[0]), np.asarray(found[1], np.int64)
    usual = np.median(distances[:, -1])
    jumps = _is_jump(ranges[:, None], ranges[others], distances) & (distances < _ISOLATED * usual)
    nearest = np.argmax(jumps, axis=1)
    rows = np.flatnonzero(jumps.any(axis=1))
    return chosen[rows], chosen[others[rows, nearest[rows]]]


@dataclass(frozen=True, slots=True, eq=False)
class FrameFeatures:
    """The features of one frame.

    Attributes:
        frame: the frame.
        edge_points: (E, 3) float64 [m], lidar frame.
        edge_kinds: (E,) uint8, the direction across the edge, as edges of images are counted.
        edge_weights: (E,) float32.
        edge_cells: (E,) int16, tile of the image.
        level_points: (P, 3) float64 [m], lidar frame, seen by the camera.
        levels: (P,) float32, intensity as a level that is as frequent as any other, 0 to `_LEVELS` - 1.
        seen: how many points the camera sees by the stated calibration.
        around: (A,) int64, the points of the frame in the image and around it.
        visible: (V,) int64, those in the image that nothing hides.
    """

    frame: CalibrationFrame
    edge_points: Float64Array
    edge_kinds: UInt8Array
    edge_weights: Float32Array
    edge_cells: AnyArray
    level_points: Float64Array
    levels: Float32Array
    seen: int
    around: Int64Array
    visible: Int64Array

    def thinned(self, every: int) -> "FrameFeatures":
        """One of so many edges and levels."""
        names = ("edge_points", "edge_kinds", "edge_weights", "edge_cells", "level_points", "levels")
        columns: dict[str, Any] = {name: np.ascontiguousarray(getattr(self, name)[::every]) for name in names}
        return replace(self, **columns)


def extract(frame: CalibrationFrame, camera: Camera) -> FrameFeatures:
    """Find the features of a frame under its stated calibration; `camera` is that of the measured image."""
    chosen, stated = _around_view(frame), frame.camera_from_lidar
    edges = find_depth_edges(frame, chosen)
    near, far = (
        project_unbounded(camera, stated.apply(points)) for points in (edges.points_lidar, edges.outwards_lidar)
    )
    directions = np.arctan2(far[:, 1] - near[:, 1], far[:, 0] - near[:, 0])
    known = _as_in_memory(near, np.flatnonzero(np.isfinite(near).all(axis=1) & np.isfinite(directions)))
    kinds = np.rint(directions[known] * DIRECTIONS / np.pi).astype(np.int64) % DIRECTIONS
    seen, visible = _seen(frame, chosen)
    level_rows, levels = _levels(frame, visible)
    level_pixels = project_unbounded(camera, stated.apply(frame.points_lidar[level_rows]))
    order = _as_in_memory(level_pixels, np.arange(len(level_rows)))
    return FrameFeatures(
        frame=frame,
        edge_points=np.ascontiguousarray(edges.points_lidar[known]),
        edge_kinds=kinds.astype(np.uint8),
        edge_weights=edges.weights[known],
        edge_cells=_tiles(near[known], camera),
        level_points=np.ascontiguousarray(frame.points_lidar[level_rows[order]]),
        levels=levels[order],
        seen=seen,
        around=chosen,
        visible=visible,
    )


def _as_in_memory(pixels: Float64Array, rows: Int64Array) -> Int64Array:
    """Order rows of (N, 2) pixels as an image has them: what lies together is looked up together."""
    ordered: Int64Array = rows[np.lexsort((pixels[rows, 0], np.floor(pixels[rows, 1] / 4.0)))]
    return ordered


def _around_view(frame: CalibrationFrame) -> Int64Array:
    """The points in the directions that the camera sees or nearly sees."""
    camera = frame.camera
    across, down = np.linspace(-0.5, camera.width - 0.5, 9), np.linspace(-0.5, camera.height - 0.5, 9)
    border = np.array(
        [(u, v) for u in across for v in (down[0], down[-1])] + [(u, v) for v in down for u in (across[0], across[-1])]
    )
    rays = unproject(camera, border)
    angles = np.arccos(np.clip(rays[np.isfinite(rays).all(axis=1), 2], -1.0, 1.0))
    widest = float(angles.max()) if len(angles) == len(border) else domain_angle(camera)
    relative = frame.points_lidar - frame.camera_from_lidar.inverse().translation
    ranges = np.sqrt(np.einsum("ij,ij->i", relative, relative))
    forward = np.einsum("ij,j->i", relative, frame.camera_from_lidar.rotation[2])
    rows: Int64Array = np.flatnonzero(forward > np.cos(min(widest + _BESIDE, np.pi)) * ranges)
    return rows


def _seen(frame: CalibrationFrame, chosen: Int64Array) -> tuple[int, Int64Array]:
    """How many points fall into the image under the stated calibration, and those that nothing hides, (V,)."""
    points = np.ascontiguousarray(frame.points_lidar[chosen])
    pixels = project_unbounded(frame.camera, frame.camera_from_lidar.apply(points))
    size = np.array([frame.camera.width, frame.camera.height])
    inside = np.flatnonzero(np.all((pixels >= -0.5) & (pixels < size - 0.5), axis=1))
    if len(inside) == 0:
        return 0, chosen[:0]
    visible = find_visible(points, inside, frame.camera_from_lidar.matrix, VisibilitySettings())
    return len(inside), chosen[inside[visible]]


def _levels(frame: CalibrationFrame, visible: Int64Array) -> tuple[Int64Array, Float32Array]:
    """Some of the visible points, and their intensities as equally frequent levels; none where all are the same."""
    values = None if frame.intensities is None else frame.intensities[visible]
    if values is None or len(values) < 2 or values.min() == values.max():
        return visible[:0], np.zeros(0, np.float32)
    # points of one intensity share the middle of their levels
    counts = np.bincount(values, minlength=256)
    middles = (np.cumsum(counts) - 0.5 * counts) / len(values) * (_LEVELS - 1)
    drawn = np.linspace(0, len(visible) - 1, min(_MOST_POINTS, len(visible))).astype(np.int64)
    return visible[drawn], middles.astype(np.float32)[values][drawn]


def _tiles(pixels: Float64Array, camera: Camera) -> AnyArray:
    columns = np.clip(pixels[:, 0] / camera.width * _TILES_ACROSS, 0, _TILES_ACROSS - 1).astype(np.int16)
    rows = np.clip(pixels[:, 1] / camera.height * _TILES_DOWN, 0, _TILES_DOWN - 1).astype(np.int16)
    return np.asarray(rows * _TILES_ACROSS + columns, np.int16)


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """The score of one candidate, by cells: tiles of the images of one view.

    Attributes:
        sums: (M, C) float64, by measure and cell.
        totals: (M, C) float64, weight of the features behind each sum.
    """

    sums: Float64Array
    totals: Float64Array

    def values(self, weights: Float64Array | None = None) -> Float64Array:
        """Give means by measure, (M,), or (B, M) for weights (B, C) of the cells; NaN where nothing was measured."""
        sums, totals = (
            (self.sums.sum(axis=1), self.totals.sum(axis=1))
            if weights is None
            else (weights @ self.sums.T, weights @ self.totals.T)
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.where(totals > 0, sums / totals, np.nan))


class Agreement:
    """Scores candidates by all frames.

    Attributes:
        images: of the frames, as measured.
        features: of the frames.
        views: (F,) int64, which frames show nearly the same.
        cells: number of cells.
    """

    def __init__(
        self,
        frames: Sequence[CalibrationFrame],
        views: Int64Array | None = None,
        *,
        images: Sequence[_MeasuredImage] | None = None,
    ) -> None:
        """Find the features of the frames.

        Args:
            views: (F,) int64, which frames show nearly the same; None: each another.
            images: of the frames, where they were measured before.
        """
        self.images = [measured_image(frame.grey, frame.camera) for frame in frames] if images is None else images
        self.features = [extract(frame, image.camera) for frame, image in zip(frames, self.images, strict=True)]
        self.views = np.arange(len(frames)) if views is None else views
        self.cells = _TILES * (int(self.views.max(initial=0)) + 1)

    @cached_property
    def _stated_totals(self) -> Float64Array:
        totals: Float64Array = self._score(Change()).totals.sum(axis=1)
        return totals

    @cached_property
    def _thinned(self) -> "Agreement":
        """The same by some of the features, for a first look."""
        thinned = copy(self)
        thinned.features = [features.thinned(_THINNED) for features in self.features]
        return thinned

    def score(self, change: Change, measures: Collection[str] = MEASURES, *, rough: bool = False) -> Score:
        """Score a candidate; a measure whose features have mostly left the images has no value.

        Args:
            measures: the only ones to be taken; the others have no value.
            rough: by some of the features only.
        """
        if rough:
            return self._thinned.score(change, measures)
        score = self._score(change, measures)
        few = score.totals.sum(axis=1) < _LEAST_SHARE * self._stated_totals
        if not few.any():
            return score
        return Score(np.where(few[:, None], 0.0, score.sums), np.where(few[:, None], 0.0, score.totals))

    def _score(self, change: Change, measures: Collection[str] = MEASURES) -> Score:
        sums, totals = np.zeros((len(MEASURES), self.cells)), np.zeros((len(MEASURES), self.cells))
        histogram = np.zeros((_LEVELS, _LEVELS))
        for features, image, view in zip(self.features, self.images, self.views.tolist(), strict=True):
            own = slice(view * _TILES, (view + 1) * _TILES)
            placing = change.camera_from_points(features.frame), change.camera_model(image.camera_model)
            ids, pixels = _project(image.camera, features.edge_points, *placing)
            for row, name in enumerate(MEASURES):
                if name in _WIDTHS_PX and name in measures:
                    sum_edges(
                        ids, pixels, features.edge_kinds, features.edge_weights, features.edge_cells,
                        image.maps[name], sums[row, own], totals[row, own],
                    )  # fmt: skip
            if INFORMATION not in measures:
                continue
            ids, pixels = _project(image.camera, features.level_points, *placing)
            fill_histogram(ids, pixels, features.levels, image.maps[INFORMATION], histogram)
        row = MEASURES.index(INFORMATION)
        table = _pointwise_information(histogram)
        # bins share points as the table shares its numbers, so that all points together need no second look
        sums[row, 0], totals[row, 0] = (histogram * table).sum(), histogram.sum()
        return Score(sums, totals)


def _project(
    camera: Camera, points_lidar: Float64Array, camera_from_points: Float64Array, camera_model: Float64Array
) -> tuple[Int64Array, Float32Array]:
    """Ids and pixels of the points, (N, 3) [m], that fall into the reduced image under a candidate."""
    room, kernel = PointsInImage.room(len(points_lidar)), projection_kernel(camera.model)
    kept = kernel(points_lidar, camera_from_points, camera_model, camera.width, camera.height, room)
    return room.point_ids[:kept], room.pixels[:kept]


def _pointwise_information(histogram: Float64Array) -> Float64Array:
    """Give log p(a, b) / (p(a) p(b)) [nat] from counts (B, B); its mean over the points is the mutual information."""
    total = histogram.sum()
    if total <= 0:
        return np.zeros_like(histogram)
    joint = ndimage.gaussian_filter(histogram, _SMOOTHED_BINS, mode="nearest") / total
    joint = (joint + 1e-6) / (joint + 1e-6).sum()
    table: Float64Array = np.log(joint / np.outer(joint.sum(axis=1), joint.sum(axis=0)))
    return table


_CELLS = types.Array(int16, 1, "C", readonly=True)


@inlined
def _between(image, u, v):  # type: ignore[no-untyped-def]
    """Interpolate an image between its pixels; beyond its outer pixels' centres these hold."""
    height, width = image.shape
    x, y = min(max(u, 0.0), width - 1.0), min(max(v, 0.0), height - 1.0)
    column, row = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
    right, below = min(column + 1, width - 1), min(row + 1, height - 1)
    a, b = x - column, y - row
    upper = image[row, column] + a * (image[row, right] - image[row, column])
    lower = image[below, column] + a * (image[below, right] - image[below, column])
    return upper + b * (lower - upper)


@kernel(void(IN_I64_1D, IN_F32_2D, IN_U8_1D, IN_F32_1D, _CELLS, IN_F32_3D, float64[::1], float64[::1]))  # fmt: skip
def sum_edges(
    point_ids: Int64Array, pixels: Float32Array, kinds: UInt8Array, weights: Float32Array, cells: Int64Array,
    edges: Float32Array, sums: Float64Array, totals: Float64Array,
) -> None:  # fmt: skip
    """Add up how strong an image's edges are where edges of a cloud fall: weights times edges, and the weights.

    `kinds` (N,), the image of `edges` (K, H, W) that counts for each point; `weights` (N,); `sums`, `totals` (C,).
    """
    for i in range(point_ids.shape[0]):
        point = point_ids[i]
        weight = float64(weights[point])
        sums[cells[point]] += weight * _between(edges[kinds[point]], pixels[i, 0], pixels[i, 1])
        totals[cells[point]] += weight


@kernel(void(IN_I64_1D, IN_F32_2D, IN_F32_1D, IN_F32_2D, float64[:, ::1]))
def fill_histogram(
    point_ids: Int64Array, pixels: Float32Array, levels: Float32Array, image: Float32Array, histogram: Float64Array
) -> None:
    """Count points by their level and that of the image, each shared among the four nearest bins.

    `levels` (N,); `histogram` (B, B), its rows are levels of the points.
    """
    last = histogram.shape[0] - 1
    for i in range(point_ids.shape[0]):
        a = float64(levels[point_ids[i]])
        b = float64(_between(image, pixels[i, 0], pixels[i, 1]))
        row, column = min(int(a), last - 1), min(int(b), last - 1)
        p, q = a - row, b - column
        histogram[row, column] += (1.0 - p) * (1.0 - q)
        histogram[row, column + 1] += (1.0 - p) * q
        histogram[row + 1, column] += p * (1.0 - q)
        histogram[row + 1, column + 1] += p * q
