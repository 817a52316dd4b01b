"""Refinement of camera-lidar extrinsics by the edges and intensities that image and points share.

Each channel compares its points with a map of the image that was blurred to some width and freed of what is wider:
a candidate that moves non-finite points in particular gets 0. If a point that is where it belongs meets the mean value
m of its map, and the map's values vary by v, then m/v times the value is the logarithm of how much likelier the point's
location is than any other (both normal): channels are weighted by that, so the best-matching ones count most.

Source: edges of clouds against blurred edges of images: Levinson and Thrun 2013; intensity against brightness:
Pandey, McBride, Savarese and Eustice 2012; Gaussian scale space, coarse to fine: Witkin, Terzopoulos and Kass 1987.

A rotation about one axis moves pixels nearly as a shift, or as another time, does: in these numbers the objective is a
    long
narrow ridge, along which one climbs slowly and whose curvature differences do not report. By the mean square of how far
pixels move it is round.

Source: preconditioning by a quadratic form, e.g. Nocedal and Wright 2006, "Numerical Optimization", 5.1.

The objective's slope at the solution is a sum over parts of the images. How differently these parts pull, through the
objective's curvature, is the covariance: the sandwich of M-estimators. What one part of a view shows in one frame it
shows in the next ones, too: frames of one view pull together.

Source: Huber 1967, "The behavior of maximum likelihood estimates under nonstandard conditions"; clusters: Liang and
Zeger 1986.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from scipy import ndimage

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array
from sceneloom.calibrate.frames import CalibrationFrame, ScanOrder
from sceneloom.calibrate.measures import (
    COUNT,
    DIRECTIONS,
    UNITS,
    Change,
    FrameFeatures,
    Parameter,
    blur,
    box_means,
    evened,
    extract,
    measured_image,
    rows_above,
)
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project_unbounded
from sceneloom.errors import CalibrationError, OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.image_agreement import sum_maps
from sceneloom.scene.types import Progress

_CHANNELS = ("depth edges", "intensity edges", "contrasts")
"""What is compared with an image; contrasts of intensity are compared with its brightness, edges with its edges."""

_LEVEL_MAP = DIRECTIONS
"""Number of the map of brightness; those of edges come before it."""

_MOST_CONTRASTS = 3000

_MOST_EDGES = 1500
"""Points of a channel in a frame: the strongest contrasts, and edges evenly drawn."""

_BRIGHT_SHARE = 0.1
"""Of the steps in intensity along the scan lines the greatest, so many, are edges."""

_LEAST_STEP = 6.0
_STRONGEST_STEP = 60.0

_SMOOTH_SHARE, _LEAST_SMOOTH = 0.02, 0.1
"""Neighbours are of one surface where the range changes by less than this share, or this many metres."""

_GAP_STEPS = 2.5

_SURROUNDINGS = 61
"""Where no lines are known: points in the order of the image whose intensities a point's own is compared with."""


@dataclass(frozen=True, slots=True, eq=False)
class _Cues:
    """The points of one frame, all channels one after the other.

    Attributes:
        features: what the frame's image and points were taken from.
        points_lidar: (N, 3) float64 [m].
        weights: (N,) float32; of a channel they have the mean square 1.
        maps: (N,) int32, which of the image's maps counts for each.
        channels: (N,) int32, by `_CHANNELS`.
    """

    features: FrameFeatures
    points_lidar: Float64Array
    weights: Float32Array
    maps: AnyArray
    channels: AnyArray

    @property
    def frame(self) -> CalibrationFrame:
        """The frame."""
        return self.features.frame


def find_cues(frame: CalibrationFrame) -> _Cues:
    """Take the points of a frame that are compared with its image."""
    features = extract(frame, measured_image(frame.grey, frame.camera, widths=("fine",)))
    bright, kinds, steps = _intensity_edges(features)
    locations, contrasts = _contrasts(features)
    strongest = np.sort(np.argsort(-np.abs(contrasts), kind="stable")[:_MOST_CONTRASTS])
    contrasts = contrasts[strongest]
    parts: list[tuple[Float64Array, AnyArray, AnyArray, int]] = [
        (features.edge_points, np.sqrt(features.edge_weights), features.edge_kinds, _MOST_EDGES),
        (bright, steps, kinds, _MOST_EDGES),
        (locations[strongest], contrasts, np.full(len(contrasts), _LEVEL_MAP), _MOST_CONTRASTS),
    ]
    drawn = [_drawn(*part) for part in parts]
    return _Cues(
        features,
        np.concatenate([part[0] for part in drawn]),
        np.concatenate([part[1] for part in drawn]),
        np.concatenate([part[2] for part in drawn]),
        np.repeat(np.arange(len(_CHANNELS), dtype=np.int32), [len(part[0]) for part in drawn]),
    )


def _drawn(
    points: Float64Array, weights: AnyArray, maps: AnyArray, most: int
) -> tuple[Float64Array, Float32Array, AnyArray]:
    rows = np.linspace(0, len(points) - 1, min(most, len(points))).astype(np.int64)
    chosen = np.asarray(weights[rows], np.float32)
    scale = float(np.sqrt(np.mean(np.square(chosen)))) if len(rows) else 1.0
    return points[rows], chosen / np.float32(max(scale, 1e-6)), np.asarray(maps[rows], np.int32)


def _contrasts(features: FrameFeatures) -> tuple[Float64Array, Float32Array]:
    """Points, and how much brighter each is than its neighbours on the same surface: (N, 3), (N,).

    The sum over pairs of neighbours of the step in intensity times the step in brightness is the sum over points of
    their contrast times their brightness, each exactly where the point is.
    """
    frame, scan = features.frame, features.frame.scan
    if scan is None or frame.intensities is None or len(scan.order) < 2:
        return features.level_points, _about_surroundings(features.levels)
    near = _Neighbours.of(scan, features.visible, len(frame.points_lidar))
    levels = frame.intensities[near.points].astype(np.float32)
    contrasts = np.zeros(len(levels), np.float32)
    for first, second in (near.along, near.across):
        steps = levels[first] - levels[second]
        contrasts += np.bincount(first, steps, len(levels)) - np.bincount(second, steps, len(levels))
    return frame.points_lidar[near.points], contrasts


def _about_surroundings(levels: Float32Array) -> Float32Array:
    """Levels about the mean of those beside them in the image."""
    if len(levels) == 0:
        return levels
    usual = ndimage.uniform_filter1d(levels, min(_SURROUNDINGS, len(levels)), mode="nearest")
    return np.asarray(levels - usual, np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _Neighbours:
    """Pairs of points beside one another on one surface.

    Attributes:
        points: (M,) int64, points of the frame along the scan lines.
        along: rows of these, two times (K,), one after the other on a line.
        across: rows of these, one above the other on two lines.
    """

    points: Int64Array
    along: tuple[Int64Array, Int64Array]
    across: tuple[Int64Array, Int64Array]

    @classmethod
    def of(cls, scan: ScanOrder, wanted: Int64Array, count: int) -> "_Neighbours":
        """Pair some points of a frame of so many."""
        chosen = np.zeros(count, np.bool_)
        chosen[wanted] = True
        rows = np.flatnonzero(chosen[scan.order])
        lines, azimuths, ranges = scan.lines[rows], scan.azimuths[rows], scan.ranges[rows]
        same = np.diff(lines) == 0
        step = float(np.median(np.diff(azimuths)[same])) if same.any() else 0.0
        first = np.flatnonzero(same & (np.diff(azimuths) < _GAP_STEPS * step))
        upper = rows_above(lines, azimuths, scan.count, step)
        lower = np.flatnonzero(upper >= 0)
        return cls(scan.order[rows], _smooth(first, first + 1, ranges), _smooth(lower, upper[lower], ranges))


def _smooth(first: Int64Array, second: Int64Array, ranges: Float64Array) -> tuple[Int64Array, Int64Array]:
    """The pairs that are of one surface."""
    apart = np.abs(ranges[first] - ranges[second])
    kept = apart < np.maximum(_LEAST_SMOOTH, _SMOOTH_SHARE * ranges[second])
    return first[kept], second[kept]


def _intensity_edges(features: FrameFeatures) -> tuple[Float64Array, Int64Array, Float32Array]:
    """Where the intensity of one surface changes along a scan line: locations, kinds of edge, strengths."""
    frame, scan = features.frame, features.frame.scan
    none = np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.float32)
    if scan is None or frame.intensities is None or len(features.around) < 2:
        return none
    near = _Neighbours.of(scan, features.around, len(frame.points_lidar))
    first, second = (near.points[rows] for rows in near.along)
    if len(first) == 0:
        return none
    levels = frame.intensities.astype(np.float64)
    steps = np.minimum(np.abs(levels[second] - levels[first]), _STRONGEST_STEP)
    strong = steps > max(float(np.quantile(steps, 1.0 - _BRIGHT_SHARE)), _LEAST_STEP)
    first, second = first[strong], second[strong]
    points = 0.5 * (frame.points_lidar[first] + frame.points_lidar[second])
    kinds = _across(features, frame.points_lidar[first], frame.points_lidar[second])
    known = kinds >= 0
    return points[known], kinds[known], np.sqrt(steps[strong][known]).astype(np.float32)


def _across(features: FrameFeatures, first: Float64Array, second: Float64Array) -> Int64Array:
    """Which direction of the image leads from one point to the other; -1 where that is not known."""
    stated, camera = features.frame.camera_from_lidar, features.image.camera
    a, b = (project_unbounded(camera, stated.apply(points)) for points in (first, second))
    towards = np.arctan2(b[:, 1] - a[:, 1], b[:, 0] - a[:, 0])
    known = np.isfinite(towards)
    kinds = np.rint(np.where(known, towards, 0.0) * DIRECTIONS / np.pi).astype(np.int64) % DIRECTIONS
    return np.where(known, kinds, -1)


_STEP_SHARE = 1e-4
"""Derivatives of the camera model are taken over this part of a point's distance."""

_FOCAL_STEP = 1e-4
_SHIFTS = range(Parameter.RIGHT, Parameter.AHEAD + 1)


def moving_pixels(
    cues: _Cues, chosen: AnyArray, numbers: Float64Array, free: AnyArray
) -> tuple[Float64Array, Float64Array]:
    """Give pixels (M, 2) [px of the measured image] of some points of a frame, and their derivatives (M, 2, P).

    Args:
        chosen: (M,) int64, which points.
        numbers: (8,) of the candidate.
        free: (P,) int64, the numbers by which derivatives are taken, each by its unit.
    """
    points = cues.points_lidar[chosen]
    change = Change.of(numbers)
    matrix = change.camera_from_points(cues.frame)
    camera = _focused(cues.features.image.camera, float(numbers[Parameter.FOCAL]))
    seen = points @ matrix[:3, :3].T + matrix[:3, 3]
    pixels = project_unbounded(camera, seen)
    by_location = _by_location(camera, seen, pixels)
    slopes = np.empty((len(points), 2, len(free)))
    for column, k in enumerate(free.tolist()):
        if k == Parameter.FOCAL:
            wider = project_unbounded(_focused(camera, _FOCAL_STEP), seen)
            slopes[:, :, column] = (wider - pixels) * (UNITS[k] / _FOCAL_STEP)
        elif k in _SHIFTS:
            slopes[:, :, column] = by_location[k - Parameter.RIGHT].T * UNITS[k]
        else:
            velocity = _velocity(cues, k, seen, points, matrix) * UNITS[k]
            slopes[:, :, column] = np.einsum("cin,nc->ni", by_location, velocity)
    return pixels, slopes


def _focused(camera: Camera, logarithm: float) -> Camera:
    """The camera with focal lengths multiplied by a factor, of which the logarithm is given."""
    scale = float(np.exp(logarithm))
    return camera if scale == 1.0 else replace(camera, fx=camera.fx * scale, fy=camera.fy * scale)


def _by_location(camera: Camera, seen: Float64Array, pixels: Float64Array) -> Float64Array:
    """How pixels change with the points' locations in the camera frame, (3, 2, M) [px/m], by axis."""
    steps = _STEP_SHARE * np.sqrt(np.einsum("ij,ij->i", seen, seen))
    trajectories = np.empty((3, 2, len(seen)))
    for axis in range(3):
        ahead = seen.copy()
        ahead[:, axis] += steps
        trajectories[axis] = ((project_unbounded(camera, ahead) - pixels) / steps[:, None]).T
    return trajectories


def _velocity(
    cues: _Cues, parameter: int, seen: Float64Array, points_lidar: Float64Array, matrix: Float64Array
) -> Float64Array:
    """How the points move in the camera frame as a rotation or the time grows, (M, 3)."""
    if parameter < Parameter.RIGHT:
        return _moving_pixels_across(np.eye(3)[parameter], seen)
    twist = cues.frame.twist_lidar
    if twist is None:
        return np.zeros_like(seen)
    moved: Float64Array = -(_moving_pixels_across(twist[:3], points_lidar) + twist[3:]) @ matrix[:3, :3].T
    return moved


def _moving_pixels_across(rotation: Float64Array, points: Float64Array) -> Float64Array:
    """The cross product of a vector with points, (M, 3): a product with a matrix is several times as fast."""
    x, y, z = rotation
    crossed: Float64Array = points @ np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
    return crossed


_WIDTHS_PX = (6.0, 3.0, 1.0)
"""How far camera_images are blurred [px of the measured camera_image], from the first look to the last."""

_STRIDES = {6.0: 3, 3.0: 2, 1.0: 1}
"""So many pixels of an image are one of the map: a wide blur leaves nothing between them."""

_WIDER = 4.0

_BRIGHTNESS_SHARE = 0.5
"""Contrasts are known where their points are, edges between two points: brightness is blurred less than edges."""

_CELL_WIDTHS = 2.0
"""Points of a channel within so many widths see the same of an image: they count as one."""


def _fill_maps(cues: _Cues, width: float, maps: Float32Array) -> None:
    """Blur an image: edges by direction, then brightness.

    Args:
        width: of the blur [px of the image].
        maps: (K, H, W) float32, filled.
    """
    camera_image, stride = cues.features.image, _STRIDES[width]
    for k, image in enumerate(camera_image.edges["fine"]):
        maps[k] = _band(_reduced(image, stride), width / stride)
    maps[_LEVEL_MAP] = _band(_reduced(evened(camera_image.grey), stride), _BRIGHTNESS_SHARE * width / stride)


def _reduced(image: Float32Array, stride: int) -> Float32Array:
    """Average blocks of pixels; what is left over at the right and the bottom is cut."""
    height, width = (max(size // stride, 1) * min(stride, size) for size in image.shape)
    if stride == 1:
        return image
    blocks = [
        image[row:height:stride, column:width:stride]
        for row in range(min(stride, height))
        for column in range(min(stride, width))
    ]
    return np.asarray(sum(blocks[1:], start=blocks[0]) / np.float32(len(blocks)), np.float32)


def _band(image: Float32Array, width: float) -> Float32Array:
    """Blur, and take off what a blur of several times the width leaves: two boxes are nearly a Gaussian."""
    box = 2 * round(_WIDER * width * np.sqrt(6.0) / 2.0) + 1
    return np.asarray(blur(image, width) - box_means(box_means(image, box), box), np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _Level:
    """All frames at one width.

    Attributes:
        cues: of each frame.
        width: of the blur [px].
        maps: (F K, H, W) float32.
        rows: (N,) int32, the map of each point.
        groups: (N,) int32, frame and channel of each point.
        weights: (N,) float32.
        chosen: (N,) int64, number of each point among those of all frames; None where all are there.
    """

    cues: tuple[_Cues, ...]
    width: float
    maps: Float32Array
    rows: AnyArray
    groups: AnyArray
    weights: Float32Array
    chosen: AnyArray | None = None

    @classmethod
    def of(cls, cues: Sequence[_Cues], width: float) -> "_Level":
        """Blur all images, which must be of one size."""
        height, across = _reduced(cues[0].features.image.grey, _STRIDES[width]).shape
        kinds = _LEVEL_MAP + 1
        maps = np.empty((len(cues) * kinds, height, across), np.float32)
        for k, one in enumerate(cues):
            _fill_maps(one, width, maps[k * kinds : (k + 1) * kinds])
        return cls(
            tuple(cues),
            width,
            maps,
            np.concatenate([one.maps + kinds * k for k, one in enumerate(cues)]).astype(np.int32),
            np.concatenate([one.channels + len(_CHANNELS) * k for k, one in enumerate(cues)]).astype(np.int32),
            np.concatenate([one.weights for one in cues]),
        )

    def part(self, frames: AnyArray, *, most: int | None = None) -> "_Level":
        """Keep the points of some frames, (F,) bool, evenly drawn about so many of them; the maps are shared."""
        kept = np.flatnonzero(frames[self.groups // len(_CHANNELS)])
        if most is not None:
            kept = kept[:: max(-(-len(kept) // most), 1)]
        return replace(self, chosen=kept if self.chosen is None else self.chosen[kept], **self._rows(kept))

    def _rows(self, kept: AnyArray) -> dict[str, Any]:
        return {"rows": self.rows[kept], "groups": self.groups[kept], "weights": self.weights[kept]}

    def around(self, numbers: Float64Array, free: AnyArray) -> "_Linearised":
        """Take pixels and their derivatives at a candidate, (8,) numbers, for those of them that are free, (P,)."""
        stride = _STRIDES[self.width]
        chosen = np.arange(len(self.groups)) if self.chosen is None else self.chosen
        begins = np.cumsum([0, *(len(one.weights) for one in self.cues)])
        of = np.searchsorted(chosen, begins)
        pixels, slopes = (
            np.empty((len(chosen), 2), np.float32),
            np.empty((len(chosen), 2, len(free)), np.float32),
        )
        for k, one in enumerate(self.cues):
            own = slice(of[k], of[k + 1])
            if of[k] < of[k + 1]:
                found, trajectories = moving_pixels(one, chosen[own] - begins[k], numbers, free)
                pixels[own] = (found + 0.5) / stride - 0.5
                slopes[own] = trajectories / stride
        return _Linearised(self, pixels, slopes)


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """What a candidate came to, by frame and channel.

    Attributes:
        values: (F, C) float64, weighted sums of the maps' values.
        squares: (F, C) float64, sums of their squares.
        gradients: (F, C, P) float64, derivatives of the values, each by its unit.
    """

    values: Float64Array
    squares: Float64Array
    gradients: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class _Linearised:
    """A level around a candidate: pixels move straight with the numbers.

    Attributes:
        level: the level.
        pixels: (N, 2) float32 [px of the maps].
        slopes: (N, 2, P) float32, by unit.
    """

    level: _Level
    pixels: Float32Array
    slopes: Float32Array

    def sums(self, step: Float64Array) -> Sums:
        """Evaluate at a step, (P,) in units, from the candidate."""
        shape = len(self.level.cues), len(_CHANNELS)
        count = shape[0] * shape[1]
        values, squares = np.zeros(count), np.zeros(count)
        gradients = np.zeros((count, self.slopes.shape[2]))
        sum_maps(
            self.pixels, self.slopes, np.ascontiguousarray(step, np.float64), self.level.weights,
            self.level.rows, self.level.groups, self.level.maps, values, squares, gradients,
        )  # fmt: skip
        return Sums(values.reshape(shape), squares.reshape(shape), gradients.reshape(*shape, -1))

    def channel_weights(self, step: Float64Array) -> Float64Array:
        """What each channel counts at a step, (C,): m/v of its values, times the share of points that report news.

        A channel whose points do not fit better than others would gets 0.
        """
        sums = self.sums(step)
        counts, distinct = self._counts()
        safe = np.maximum(counts, 1.0)
        means = sums.values.sum(axis=0) / safe
        variances = np.maximum(sums.squares.sum(axis=0) / safe - means**2, 1e-12)
        return np.asarray(np.maximum(means, 0.0) / variances * distinct / safe, np.float64)

    def motion_form(self) -> Float64Array:
        """The mean square of how far pixels move with a step in units, as a quadratic form (P, P) [blur widths]."""
        rows = self._inside()
        if len(rows) == 0:
            return np.zeros((self.slopes.shape[2],) * 2)
        scale = _STRIDES[self.level.width] / self.level.width
        moved = np.float64(scale) * self.slopes[rows].reshape(2 * len(rows), -1)
        form: Float64Array = np.einsum("ip,iq->pq", moved, moved) / len(rows)
        return form

    def _inside(self) -> AnyArray:
        """Rows of the points in the images."""
        size = np.array(self.level.maps.shape[:0:-1])
        with np.errstate(invalid="ignore"):
            return np.flatnonzero(((self.pixels >= 0.0) & (self.pixels < size - 1)).all(axis=1))

    def _counts(self) -> tuple[Float64Array, Float64Array]:
        """How many points of each channel fall into the images, and into how many cells of a few widths."""
        cell = _CELL_WIDTHS * self.level.width / _STRIDES[self.level.width]
        inside = self._inside()
        groups = self.level.groups[inside]
        cells = (self.pixels[inside] / np.float32(cell)).astype(np.int32)
        across, down = (int(size / cell) + 1 for size in self.level.maps.shape[:0:-1])
        taken = np.zeros((len(self.level.cues), len(_CHANNELS), across * down), np.bool_)
        taken.reshape(-1)[(groups * np.int64(down) + cells[:, 1]) * across + cells[:, 0]] = True
        counts = np.bincount(groups % len(_CHANNELS), minlength=len(_CHANNELS)).astype(np.float64)
        return counts, taken.sum(axis=(0, 2)).astype(np.float64)


_GROUPS: dict[str, tuple[Parameter, ...]] = {
    "rotation": (Parameter.PITCH, Parameter.YAW, Parameter.ROLL),
    "translation": (Parameter.RIGHT, Parameter.DOWN, Parameter.AHEAD),
    "time": (Parameter.LATER,),
    "focal": (Parameter.FOCAL,),
}
"""What can be refined, by the words of the command line."""


class RefinementVerdict(StrEnum):
    """What became of a calibration."""

    REFINED = "refined"
    KEPT = "kept"
    UNDETERMINED = "cannot determine"


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """What refining came to.

    Attributes:
        verdict: whether the calibration is another one now.
        reason: why.
        camera_from_lidar: the refined one; the stated one unless the verdict is `refined`.
        camera: the camera model with refined focal lengths, or the stated one.
        time_offset: seconds to be added to the camera's timestamps.
        change: what was found, whatever the verdict: rotate and shift about the camera's axes, focal length, time.
        parameters: the groups that were refined.
        held: groups that the drive does not report, and how well it would.
        free: (P,) int64, the numbers of the change that were searched.
        covariance: (P, P) of these, in rad, m, logarithm and s.
        gains: how much likelier the held-out frames of each fold are under what the others found.
        sharpness: how far the solution stands above others around it, in their standard deviations.
        frames: how many were used.
        views: how many of them show something different.
    """

    verdict: RefinementVerdict
    reason: str
    camera_from_lidar: RigidTransform
    camera: Camera
    time_offset: float = 0.0
    change: Change = field(default_factory=Change)
    parameters: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    free: Int64Array = field(default_factory=lambda: np.zeros(0, np.int64))
    covariance: Float64Array = field(default_factory=lambda: np.zeros((0, 0)))
    gains: tuple[float, ...] = ()
    sharpness: float = 0.0
    frames: int = 0
    views: int = 0

    @property
    def sigmas(self) -> dict[str, float]:
        """The standard deviation of each refined number, by its name in lower case: rad, m, logarithm, s."""
        roots = np.sqrt(np.diagonal(self.covariance))
        return {Parameter(k).name.lower(): float(root) for k, root in zip(self.free.tolist(), roots, strict=True)}

    @property
    def found_change(self) -> dict[str, float]:
        """What was found of each number that was searched, in the same units."""
        return {Parameter(k).name.lower(): self.change.numbers[k] for k in self.free.tolist()}


_FARTHEST = np.array([6.0, 6.0, 6.0, 3.0, 3.0, 3.0, 2.0, 2.5])
"""How far a calibration is usually off, in units: 1.5 degrees, 15 cm, 2 % of the focal length, 50 ms."""

_CURVATURE_STEP = 0.4
"""Curvature is taken over this part of the blur's width: over less, single pixels show."""


@dataclass(frozen=True, slots=True, eq=False)
class _Hill:
    """What the channels state around a candidate, and what speaks against going far.

    Attributes:
        linearised: the channels.
        weights: (C,), what each counts.
        reach: (P,), how far the numbers usually go, in units.
        offset: (P,), the candidate, in units.
        basis: (P, P), steps of the length 1, in units: they move pixels by the width of the blur (root mean square), or
            the numbers as far as they usually go.
    """

    linearised: _Linearised
    weights: Float64Array
    reach: Float64Array
    offset: Float64Array
    basis: Float64Array

    @classmethod
    def around(cls, level: _Level, free: AnyArray, numbers: Float64Array) -> "_Hill":
        """Stand at a candidate, (8,) numbers, of which some are free, (P,)."""
        linearised = level.around(numbers, free)
        weights = linearised.channel_weights(np.zeros(len(free)))
        form = linearised.motion_form() + np.diag(_FARTHEST[free] ** -2.0)
        basis = np.linalg.inv(np.linalg.cholesky(form)).T
        return cls(linearised, weights, _FARTHEST[free], (numbers / UNITS)[free], basis)

    def downwards(self, step: Float64Array) -> tuple[float, Float64Array]:
        """Minus the objective and its slope at a step, (P,)."""
        in_units = self.basis @ step
        sums = self.linearised.sums(in_units)
        away = (self.offset + in_units) / self.reach
        value = float((sums.values.sum(axis=0) * self.weights).sum() - 0.5 * away @ away)
        slope = away / self.reach - np.einsum("fcp,c->p", sums.gradients, self.weights)
        return -value, self.basis.T @ slope

    def inverse_curvature(self) -> Float64Array:
        """The inverse of minus the second derivatives, (P, P); where the objective rises it counts as flat.

        What is flat is bounded by how far the numbers usually go.
        """
        rows = []
        for axis in np.eye(len(self.reach)) * _CURVATURE_STEP:
            (_, ahead), (_, behind) = self.downwards(axis), self.downwards(-axis)
            rows.append((ahead - behind) / (2.0 * _CURVATURE_STEP))
        curvature = np.array(rows)
        values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
        bounds = np.square(self.basis @ vectors / self.reach[:, None]).sum(axis=0)
        inverse: Float64Array = vectors / np.maximum(values, bounds) @ vectors.T
        return inverse


_ROTATIONS = np.arange(3)
_STARTS = 200

_KEPT = (8, 3, 1)
"""So many candidates are followed up after each look."""

_ROUNDS = 2
_MOST_ROTATED = (12_000, 16_000, 24_000)

_MOST_MOVED = (40_000, 160_000)
"""Points used at each stage, for the rotation alone and for all parameters: few suffice, since wide maps are smooth."""

_MOST_STEPS = 10

_FIRST_STEP, _LONGEST_STEP, _SMALLEST_STEP, _FARTHEST_CLIMB = 0.3, 1.0, 0.01, 2.0
"""Of a climb, in widths of the blur; the maps are smooth over about so much."""

_SEED = 7
_LAST_STEPS = 3


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Where a search ended.

    Attributes:
        numbers: (8,) float64, as of a `Change`.
        free: (P,) int64, which of them were searched.
        weights: (C,) of the channels there.
        inverse: (P, P), inverse of minus the second derivatives of the objective by units, at the last level.
        last: the last level around these numbers.
    """

    numbers: Float64Array
    free: AnyArray
    weights: Float64Array
    inverse: Float64Array
    last: _Linearised


def _search(
    levels: Sequence[_Level],
    frames: AnyArray,
    free: AnyArray,
    *,
    thinned: int = 1,
) -> _Found:
    """Find the best candidate near the stated calibration.

    Rotations are searched first, from many beginnings, for they move what is far away as well as what is near; then all
    numbers together from there.

    Args:
        levels: from wide to narrow.
        frames: (F,) bool, which of them count.
        free: (P,) int64, which of the eight numbers are searched.
        thinned: one point of so many counts.
    """
    most = [count // thinned for count in _MOST_ROTATED]
    best = _rotated([level.part(frames, most=count) for level, count in zip(levels, most, strict=True)])
    most = [count // thinned for count in _MOST_MOVED]
    parts = [level.part(frames, most=count) for level, count in zip(levels[1:], most, strict=True)]
    for level in parts:
        best = _climb(level, free, best)
    return _polished(parts[-1], free, best)


def _rotated(levels: Sequence[_Level]) -> Float64Array:
    """The best rotate of the stated calibration."""
    found = _beginnings(levels[0])
    for number, level in enumerate(levels):
        climbed = [_climb(level, _ROTATIONS, begun) for begun in found]
        found = _best(level, climbed)[: _KEPT[number]]
    return found[0]


def _beginnings(level: _Level) -> list[Float64Array]:
    """The stated calibration, and the best of some others rotated from it."""
    around = level.around(np.zeros(COUNT), _ROTATIONS)
    drawn = np.random.default_rng(_SEED).normal(0.0, 0.5, (_STARTS, len(_ROTATIONS))) * _FARTHEST[_ROTATIONS]
    best = np.argsort([-_stationary(around, step) for step in drawn])[: _KEPT[0] - 1]
    return [np.zeros(COUNT), *(_spread(_ROTATIONS, drawn[k]) for k in best)]


def _best(level: _Level, found: Sequence[Float64Array]) -> list[Float64Array]:
    """Those found, the best first."""
    stationary = [_stationary(level.around(numbers, _ROTATIONS), np.zeros(len(_ROTATIONS))) for numbers in found]
    return [found[k] for k in np.argsort(stationary)[::-1]]


def _stationary(linearised: _Linearised, step: Float64Array) -> float:
    """How far the channels together stand above 0, in standard deviations; weights play no part, so it compares."""
    sums = linearised.sums(step)
    scores = sums.values.sum(axis=0) / np.sqrt(np.maximum(sums.squares.sum(axis=0), 1e-9))
    return float(scores.sum())


def _spread(free: AnyArray, step: Float64Array) -> Float64Array:
    """A step in units as a change of all eight numbers."""
    numbers = np.zeros(COUNT)
    numbers[free] = step * UNITS[free]
    return numbers


def _climb(level: _Level, free: AnyArray, numbers: Float64Array) -> Float64Array:
    """Go uphill at one level, with pixels linearised anew in each round."""
    for _ in range(_ROUNDS):
        hill = _Hill.around(level, free, numbers)
        step = _descended(hill)
        numbers = numbers + _spread(free, hill.basis @ step)
        if np.abs(step).max() < 0.05:
            break
    return numbers


def _descended(hill: _Hill) -> Float64Array:
    """Where a quasi-Newton descent of minus the objective ends; a library's would wake threads for eight numbers.

    Source: the update of Broyden, Fletcher, Goldfarb and Shanno, with halved steps (Nocedal and Wright 2006,
    algorithm 6.1).
    """
    here = np.zeros(len(hill.basis))
    value, slope = hill.downwards(here)
    inverse = np.eye(len(here)) * (_FIRST_STEP / max(float(np.sqrt((slope**2).sum())), 1e-12))
    for _ in range(_MOST_STEPS):
        trajectory = -(inverse * slope).sum(axis=1)
        trajectory *= min(1.0, _LONGEST_STEP / max(float(np.sqrt((trajectory**2).sum())), 1e-12))
        for share in (1.0, 0.5, 0.25, 0.125):
            ahead = here + share * trajectory
            value_ahead, slope_ahead = hill.downwards(ahead)
            if value_ahead < value:
                break
        else:
            break
        moved, bent = ahead - here, slope_ahead - slope
        product = float((moved * bent).sum())
        if product > 1e-12:
            left = np.eye(len(here)) - np.outer(moved, bent) / product
            inverse = left @ inverse @ left.T + np.outer(moved, moved) / product
        here, value, slope = ahead, value_ahead, slope_ahead
        if np.abs(moved).max() < _SMALLEST_STEP or np.abs(here).max() > _FARTHEST_CLIMB:
            break
    return here


def _polished(level: _Level, free: AnyArray, numbers: Float64Array) -> _Found:
    """Newton's steps to the top, which long narrow ridges need; none that leads down."""
    for _ in range(_LAST_STEPS):
        hill = _Hill.around(level, free, numbers)
        value, slope = hill.downwards(np.zeros(len(free)))
        step = np.clip(-hill.inverse_curvature() @ slope, -1.0, 1.0)
        share = next((part for part in (1.0, 0.5, 0.25) if hill.downwards(part * step)[0] < value), 0.0)
        numbers = numbers + _spread(free, hill.basis @ (share * step))
        if np.abs(share * step).max() < _SMALLEST_STEP:
            break
    hill = _Hill.around(level, free, numbers)
    inverse = hill.basis @ hill.inverse_curvature() @ hill.basis.T
    return _Found(numbers, free, hill.weights, inverse, hill.linearised)


_ACROSS, _DOWN = 6, 3

_SYSTEMATIC = 0.05
"""What all parts share [units], such as shadows beside objects: 0.0125 degrees, 2.5 mm, 1 ms. With less, intervals of
simulated drives hold the truth too rarely."""


def _covariance_of(found: _Found, views: Int64Array) -> Float64Array:
    """Give the covariance of the free numbers, (P, P), in units.

    Args:
        views: (F,) int64, which frames show nearly the same.
    """
    reach = _FARTHEST[found.free]
    pulls = _cluster_slopes(found, views)
    count = int((np.abs(pulls).sum(axis=1) > 0).sum())
    spread = pulls.T @ pulls * (count / max(count - 1, 1)) + np.diag(reach**-2.0)
    systematic = np.diag(np.full(len(found.free), _SYSTEMATIC**2))
    return np.asarray(found.inverse @ spread @ found.inverse + systematic, np.float64)


def _cluster_slopes(found: _Found, views: Int64Array) -> Float64Array:
    """The slope of each tile of each view at the solution, (K, P)."""
    level = found.last.level
    frames = level.groups // len(_CHANNELS)
    height, width = level.maps.shape[1:]
    inside = np.nan_to_num(found.last.pixels)
    across = np.clip(inside[:, 0] / width * _ACROSS, 0, _ACROSS - 1).astype(np.int64)
    down = np.clip(inside[:, 1] / height * _DOWN, 0, _DOWN - 1).astype(np.int64)
    clusters = ((views[frames] * _DOWN + down) * _ACROSS + across).astype(np.int32)
    count, free = int(clusters.max(initial=0)) + 1, len(found.free)
    slopes = np.zeros((count, free))
    weights = (level.weights * found.weights[level.groups % len(_CHANNELS)]).astype(np.float32)
    sum_maps(
        found.last.pixels, found.last.slopes, np.zeros(free), weights, level.rows, clusters, level.maps,
        np.zeros(count), np.zeros(count), slopes,
    )  # fmt: skip
    return slopes


_LOOSEST = {"rotation": np.radians(0.5), "translation": 0.15, "time": 0.05, "focal": 0.02}
"""Standard deviations [rad], [m], [s], and of the focal length's logarithm, from which a group is not reported.

The stated
calibration is usually known as well."""

_LEAST_VIEWS = 4
"""Shift, time and focal length move pixels by a little as a rotation does.

What single objects suggest of the difference
averages out over several views only."""

_SHARPEST_WRONG = 4.0
"""How far above others around it, in their standard deviations, wrong calibrations come at most; right ones reach 6."""

_AROUND, _NEARBY = 60, (3.0, 8.0)

_FARTHEST_ROTATION, _FARTHEST_SHIFT, _FARTHEST_LATER = np.radians(4.0), 0.5, 0.2
"""A repair beyond these [rad], [m], [s] is no repair: the search went astray, or the stated calibration is no start."""


def _held_out_gain(levels: Sequence[_Level], held_out: BoolArray, free: Int64Array) -> float:
    """How much likelier frames are under what the others found than under the stated calibration."""
    start = np.zeros(COUNT)
    found = _search(levels, ~held_out, free, thinned=2)
    level = levels[-1].part(held_out)
    values = [
        float((level.around(numbers, free).sums(np.zeros(len(free))).values.sum(axis=0) * found.weights).sum())
        for numbers in (start, found.numbers)
    ]
    return values[1] - values[0]


def _sharpness_of(found: _Found) -> float:
    """How far the solution stands above others a degree or two around it, in their standard deviations."""
    rotations = np.flatnonzero(found.free < 3)
    drawn = np.random.default_rng(3).normal(size=(_AROUND, len(rotations)))
    sizes = np.random.default_rng(4).uniform(*_NEARBY, _AROUND)
    values = []
    for direction, size in zip(drawn, sizes, strict=True):
        step = np.zeros(len(found.free))
        step[rotations] = direction / np.linalg.norm(direction) * size
        values.append(float((found.last.sums(step).values.sum(axis=0) * found.weights).sum()))
    here = float((found.last.sums(np.zeros(len(found.free))).values.sum(axis=0) * found.weights).sum())
    return (here - float(np.mean(values))) / max(float(np.std(values)), 1e-12)


def _judged(
    found: _Found, covariance: Float64Array, gains: Sequence[float], sharpness: float
) -> tuple[RefinementVerdict, str]:
    """Whether what was found is to be taken."""
    numbers = found.numbers
    sigma = float(np.degrees(np.sqrt(np.diagonal(covariance)[:3].max()) * UNITS[0]))
    if not found.weights.any() or not sharpness > _SHARPEST_WRONG:
        return RefinementVerdict.UNDETERMINED, (
            f"nothing stands out near the stated calibration: the best is {sharpness:.1f} standard deviations above "
            f"others around it; expected {_SHARPEST_WRONG:.0f} or more"
        )
    if sigma > np.degrees(_LOOSEST["rotation"]):
        return (
            RefinementVerdict.UNDETERMINED,
            f"the rotation is known within {sigma:.2g} deg only; expected 0.5 or better",
        )
    if (
        np.linalg.norm(numbers[:3]) > _FARTHEST_ROTATION
        or np.linalg.norm(numbers[3:6]) > _FARTHEST_SHIFT
        or abs(numbers[Parameter.LATER]) > _FARTHEST_LATER
    ):
        return RefinementVerdict.UNDETERMINED, (
            f"the best is {np.degrees(np.linalg.norm(numbers[:3])):.1f} deg, {np.linalg.norm(numbers[3:6]):.2f} m and "
            f"{numbers[Parameter.LATER] * 1e3:.0f} ms away from the stated calibration, too far for a repair; "
            "expected a start within a few degrees (`--target`, `--hand-eye` give one)"
        )
    if min(gains) <= 0.0:
        return RefinementVerdict.KEPT, (
            f"frames that took no part do not agree: {sum(gain <= 0 for gain in gains)} of {len(gains)} held-out parts "
            "of the drive fit the stated calibration better"
        )
    step = numbers[found.free] / UNITS[found.free]
    distance = float(step @ np.linalg.solve(covariance, step)) / len(step)
    if distance < 1.0:
        return RefinementVerdict.KEPT, "the stated calibration is as good as the drive can report"
    return RefinementVerdict.REFINED, (
        f"all {len(gains)} held-out parts of the drive fit better than the stated calibration"
    )


_TRAJECTORY, _ROTATION = 2.0, np.radians(6.0)
"""Beyond this trajectory [m] or rotation a view counts as another one."""


def views_of(frames: Sequence[CalibrationFrame]) -> Int64Array:
    """Number the views of frames in the order of their time, (F,) int64; unknown motion is none."""
    numbers, trajectory, rotation = [0], 0.0, 0.0
    for before, after in pairwise(frames):
        if before.twist_lidar is not None:
            seconds = abs(after.image_ns - before.image_ns) * 1e-9
            trajectory += float(np.linalg.norm(before.twist_lidar[3:])) * seconds
            rotation += float(np.linalg.norm(before.twist_lidar[:3])) * seconds
        new = trajectory > _TRAJECTORY or rotation > _ROTATION
        numbers.append(numbers[-1] + int(new))
        trajectory, rotation = (0.0, 0.0) if new else (trajectory, rotation)
    return np.array(numbers[: len(frames)], np.int64)


_Result = TypeVar("_Result")
DEFAULT = ("rotation", "translation", "time")
_LEAST_FRAMES = 4
_FOLDS = 3

_LEAST_CUES = 150
"""A frame with fewer points around its image is not used."""


def refine(
    frames: Sequence[CalibrationFrame],
    *,
    parameters: Sequence[str] = DEFAULT,
    progress: Progress | None = None,
) -> Refinement:
    """Refine the calibration of a camera against a lidar by frames of a drive.

    Args:
        frames: of one camera and one lidar, all with the same stated calibration.
        parameters: names out of `_GROUPS`; "rotation" is always among what is refined.
        progress: reported how many of the steps are done.

    Raises:
        OptionError: a parameter is unknown.
    """
    groups = _groups(parameters)
    if len(frames) < _LEAST_FRAMES:
        return _unable(frames, f"{len(frames)} frames; expected {_LEAST_FRAMES} or more, to refine and to judge by")
    reported = _Reported(progress, len(frames) + len(_WIDTHS_PX) + 2 + _FOLDS)
    cues = tuple(one for frame in frames if len((one := reported.after(find_cues(frame))).weights) >= _LEAST_CUES)
    problem = _why_not(frames, cues)
    if problem:
        return _unable(frames, problem)
    levels = tuple(reported.after(_Level.of(cues, width)) for width in _WIDTHS_PX)
    return _refined(_Drive(cues, levels, views_of([one.frame for one in cues])), groups, reported)


def _groups(parameters: Sequence[str]) -> tuple[str, ...]:
    unknown = [name for name in parameters if name not in _GROUPS]
    if unknown or not parameters:
        raise OptionError(f"parameters {', '.join(unknown) or 'none'}; expected some of {', '.join(_GROUPS)}")
    return tuple(name for name in _GROUPS if name == "rotation" or name in parameters)


@dataclass(slots=True)
class _Reported:
    """Counts what is done."""

    progress: Progress | None
    whole: int
    done: int = 0

    def after(self, result: _Result) -> _Result:
        """Report that something more is done."""
        self.done = min(self.done + 1, self.whole)
        if self.progress is not None:
            self.progress(self.done, self.whole)
        return result


@dataclass(frozen=True, slots=True, eq=False)
class _Drive:
    cues: tuple[_Cues, ...]
    levels: tuple[_Level, ...]
    views: Int64Array

    @property
    def all_frames(self) -> BoolArray:
        return np.ones(len(self.cues), np.bool_)

    @property
    def folds(self) -> list[BoolArray]:
        """Frames that are held out together: stretches of the drive, whole views where there are enough."""
        whole = self.views if self.views[-1] + 1 >= _FOLDS else np.arange(len(self.cues))
        return [whole * _FOLDS // (int(whole[-1]) + 1) == fold for fold in range(_FOLDS)]


def _why_not(frames: Sequence[CalibrationFrame], cues: Sequence[_Cues]) -> str:
    """What speaks against even trying; "" for nothing."""
    if len(cues) < _LEAST_FRAMES:
        return (
            f"the camera sees enough of the cloud in {len(cues)} of {len(frames)} frames; expected {_LEAST_FRAMES}: "
            "does it look where the calibration says, and does the lidar see there?"
        )
    cameras = {(one.frame.camera.width, one.frame.camera.height, one.frame.camera.fx) for one in cues}
    if len(cameras) > 1:
        return "the camera model differs from image to image; expected one that is the same in all"
    if float(np.median([one.features.image.plainness for one in cues])) > 0.97:
        return "the images show next to nothing: black, covered or overexposed; expected edges to go by"
    return ""


def _unable(frames: Sequence[CalibrationFrame], reason: str) -> Refinement:
    if not frames:
        raise CalibrationError("no frames to refine a calibration by; expected some")
    return Refinement(
        RefinementVerdict.UNDETERMINED,
        reason,
        frames[0].camera_from_lidar,
        frames[0].camera,
        frames=len(frames),
    )


def _refined(drive: _Drive, groups: tuple[str, ...], reported: _Reported) -> Refinement:
    found, covariance, groups, held = _refine_best(drive, groups, reported)
    gains = tuple(reported.after(_held_out_gain(drive.levels, fold, found.free)) for fold in drive.folds)
    sharpness = _sharpness_of(found)
    verdict, reason = _judged(found, covariance, gains, sharpness)
    stated = drive.cues[0].frame
    change = Change.of(found.numbers)
    scale = UNITS[found.free]
    taken = change if verdict is RefinementVerdict.REFINED else Change()
    matrix = taken.camera_from_lidar(stated.camera_from_lidar.matrix)
    return Refinement(
        verdict,
        reason,
        RigidTransform.nearest(matrix)[0],
        _focused(stated.camera, taken.numbers[Parameter.FOCAL]),
        taken.numbers[Parameter.LATER],
        change,
        groups,
        held,
        found.free,
        covariance * np.outer(scale, scale),
        gains,
        sharpness,
        len(drive.cues),
        int(drive.views[-1]) + 1,
    )


def _refine_best(
    drive: _Drive, groups: tuple[str, ...], reported: _Reported
) -> tuple[_Found, Float64Array, tuple[str, ...], tuple[str, ...]]:
    """Search for all groups, and again without those that the drive does not report."""
    held: list[str] = []
    count = int(drive.views[-1]) + 1
    if count < _LEAST_VIEWS:
        held = [f"{name}: {count} views; expected {_LEAST_VIEWS} or more" for name in groups if name != "rotation"]
        groups = ("rotation",)
    while True:
        free = np.array([int(parameter) for name in groups for parameter in _GROUPS[name]], np.int64)
        found = reported.after(_search(drive.levels, drive.all_frames, free))
        covariance = _covariance_of(found, drive.views)
        sigmas = _sigmas(found.free, covariance, groups)
        loose = {name: sigma for name, sigma in sigmas.items() if sigma > _LOOSEST[name] and name != "rotation"}
        if not loose:
            return found, covariance, groups, tuple(held)
        held += [f"{name}: known within {_worded(name, sigma)} only" for name, sigma in loose.items()]
        groups = tuple(name for name in groups if name not in loose)


def _sigmas(free: Int64Array, covariance: Float64Array, groups: Sequence[str]) -> dict[str, float]:
    """The largest standard deviation of each group."""
    roots = np.sqrt(np.diagonal(covariance)) * UNITS[free]
    return {name: max(float(roots[free == int(k)][0]) for k in _GROUPS[name]) for name in groups}


def _worded(name: str, sigma: float) -> str:
    scale, unit = {
        "rotation": (np.degrees(1.0), "deg"),
        "translation": (100.0, "cm"),
        "time": (1e3, "ms"),
    }.get(name, (100.0, "%"))
    return f"{sigma * scale:.2g} {unit}"
