"""The objective of refinement: points on depth and intensity edges, their pixels under a candidate.

And a smooth sum with derivatives.

Each channel compares its points with a map of the image that was blurred to some width and freed of what is wider:
a candidate that moves non-finite points in particular gets 0. If a point that is where it belongs meets the mean value
m of its map, and the map's values vary by v, then m/v times the value is the logarithm of how much likelier the point's
location is than any other (both normal): channels are weighted by that, so the best-matching ones count most.

Source: edges of clouds against blurred edges of images: Levinson and Thrun 2013; intensity against brightness:
Pandey, McBride, Savarese and Eustice 2012; Gaussian scale space, coarse to fine: Witkin, Terzopoulos and Kass 1987.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int64Array
from sceneloom.calibrate.frames import CalibrationFrame, ScanOrder
from sceneloom.calibrate.measures import (
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
from sceneloom.kernels.image_agreement import sum_maps

CHANNELS = ("depth edges", "intensity edges", "contrasts")
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
class Cues:
    """The points of one frame, all channels one after the other.

    Attributes:
        features: what the frame's image and points were taken from.
        points_lidar: (N, 3) float64 [m].
        weights: (N,) float32; of a channel they have the mean square 1.
        maps: (N,) int32, which of the image's maps counts for each.
        channels: (N,) int32, by `CHANNELS`.
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


def find_cues(frame: CalibrationFrame) -> Cues:
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
    return Cues(
        features,
        np.concatenate([part[0] for part in drawn]),
        np.concatenate([part[1] for part in drawn]),
        np.concatenate([part[2] for part in drawn]),
        np.repeat(np.arange(len(CHANNELS), dtype=np.int32), [len(part[0]) for part in drawn]),
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
    cues: Cues, chosen: AnyArray, numbers: Float64Array, free: AnyArray
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
    camera = focused(cues.features.image.camera, float(numbers[Parameter.FOCAL]))
    seen = points @ matrix[:3, :3].T + matrix[:3, 3]
    pixels = project_unbounded(camera, seen)
    by_location = _by_location(camera, seen, pixels)
    slopes = np.empty((len(points), 2, len(free)))
    for column, k in enumerate(free.tolist()):
        if k == Parameter.FOCAL:
            wider = project_unbounded(focused(camera, _FOCAL_STEP), seen)
            slopes[:, :, column] = (wider - pixels) * (UNITS[k] / _FOCAL_STEP)
        elif k in _SHIFTS:
            slopes[:, :, column] = by_location[k - Parameter.RIGHT].T * UNITS[k]
        else:
            velocity = _velocity(cues, k, seen, points, matrix) * UNITS[k]
            slopes[:, :, column] = np.einsum("cin,nc->ni", by_location, velocity)
    return pixels, slopes


def focused(camera: Camera, logarithm: float) -> Camera:
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
    cues: Cues, parameter: int, seen: Float64Array, points_lidar: Float64Array, matrix: Float64Array
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


WIDTHS_PX = (6.0, 3.0, 1.0)
"""How far camera_images are blurred [px of the measured camera_image], from the first look to the last."""

_STRIDES = {6.0: 3, 3.0: 2, 1.0: 1}
"""So many pixels of an image are one of the map: a wide blur leaves nothing between them."""

_WIDER = 4.0

_BRIGHTNESS_SHARE = 0.5
"""Contrasts are known where their points are, edges between two points: brightness is blurred less than edges."""

_CELL_WIDTHS = 2.0
"""Points of a channel within so many widths see the same of an image: they count as one."""


def _fill_maps(cues: Cues, width: float, maps: Float32Array) -> None:
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
class Level:
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

    cues: tuple[Cues, ...]
    width: float
    maps: Float32Array
    rows: AnyArray
    groups: AnyArray
    weights: Float32Array
    chosen: AnyArray | None = None

    @classmethod
    def of(cls, cues: Sequence[Cues], width: float) -> "Level":
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
            np.concatenate([one.channels + len(CHANNELS) * k for k, one in enumerate(cues)]).astype(np.int32),
            np.concatenate([one.weights for one in cues]),
        )

    def part(self, frames: AnyArray, *, most: int | None = None) -> "Level":
        """Keep the points of some frames, (F,) bool, evenly drawn about so many of them; the maps are shared."""
        kept = np.flatnonzero(frames[self.groups // len(CHANNELS)])
        if most is not None:
            kept = kept[:: max(-(-len(kept) // most), 1)]
        return replace(self, chosen=kept if self.chosen is None else self.chosen[kept], **self._rows(kept))

    def _rows(self, kept: AnyArray) -> dict[str, Any]:
        return {"rows": self.rows[kept], "groups": self.groups[kept], "weights": self.weights[kept]}

    def around(self, numbers: Float64Array, free: AnyArray) -> "Linearised":
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
        return Linearised(self, pixels, slopes)


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
class Linearised:
    """A level around a candidate: pixels move straight with the numbers.

    Attributes:
        level: the level.
        pixels: (N, 2) float32 [px of the maps].
        slopes: (N, 2, P) float32, by unit.
    """

    level: Level
    pixels: Float32Array
    slopes: Float32Array

    def sums(self, step: Float64Array) -> Sums:
        """Evaluate at a step, (P,) in units, from the candidate."""
        shape = len(self.level.cues), len(CHANNELS)
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
        taken = np.zeros((len(self.level.cues), len(CHANNELS), across * down), np.bool_)
        taken.reshape(-1)[(groups * np.int64(down) + cells[:, 1]) * across + cells[:, 0]] = True
        counts = np.bincount(groups % len(CHANNELS), minlength=len(CHANNELS)).astype(np.float64)
        return counts, taken.sum(axis=(0, 2)).astype(np.float64)
