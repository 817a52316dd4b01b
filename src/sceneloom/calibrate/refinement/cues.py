"""The points of a frame that must fall onto something in its image: edges in depth and in intensity, contrasts."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int64Array
from sceneloom.calibrate.frames import CalibrationFrame
from sceneloom.calibrate.measures.depth_edges import rows_above
from sceneloom.calibrate.measures.features import FrameFeatures, extract
from sceneloom.calibrate.measures.images import DIRECTIONS, measured_image
from sceneloom.calibrate.scan_order import ScanOrder
from sceneloom.cameras.models import project_unbounded

CHANNELS = ("depth edges", "intensity edges", "contrasts")
"""What is compared with an image; contrasts of intensity are compared with its brightness, edges with its edges."""

LEVEL_MAP = DIRECTIONS
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
        (locations[strongest], contrasts, np.full(len(contrasts), LEVEL_MAP), _MOST_CONTRASTS),
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
