"""The points of a frame that must fall onto something in its picture: edges in depth, edges and levels of intensity."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int64Array
from sceneloom.calibrate.frames import CalibrationFrame
from sceneloom.calibrate.measures.features import FrameFeatures, extract
from sceneloom.calibrate.measures.pictures import DIRECTIONS
from sceneloom.cameras.models import project_unbounded

CHANNELS = ("depth edges", "intensity edges", "intensity levels")
"""What is compared with a picture; levels are compared with its brightness, edges with its edges."""

LEVEL_MAP = DIRECTIONS
"""Number of the map of brightness; those of edges come before it."""

_MOST_LEVELS = 2500
_MOST_EDGES = 1500
"""Points of a channel in a frame, evenly drawn."""
_BRIGHT_SHARE = 0.1
"""Of the steps in intensity along the scan lines the greatest, so many, are edges."""
_LEAST_STEP = 6.0
_STRONGEST_STEP = 60.0
_SMOOTH_SHARE, _LEAST_SMOOTH = 0.02, 0.1
"""Neighbours are of one surface where the range changes by less than this share, or this many metres."""
_GAP_STEPS = 2.5
_SURROUNDINGS = 61
"""Points along a line whose intensities a point's own is compared with."""


@dataclass(frozen=True, slots=True, eq=False)
class Cues:
    """The points of one frame, all channels one after the other.

    Attributes:
        features: what the frame's picture and points were taken from.
        points_lidar: (N, 3) float64 [m].
        weights: (N,) float32; of a channel they have the mean square 1.
        maps: (N,) int32, which of the picture's maps counts for each.
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
    """Take the points of a frame that are compared with its picture."""
    features = extract(frame)
    bright, kinds, steps = _intensity_edges(features)
    levels = _spread_out(features.levels)
    parts: list[tuple[Float64Array, AnyArray, AnyArray, int]] = [
        (features.edge_points, np.sqrt(features.edge_weights), features.edge_kinds, _MOST_EDGES),
        (bright, steps, kinds, _MOST_EDGES),
        (features.level_points, levels, np.full(len(levels), LEVEL_MAP), _MOST_LEVELS),
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


def _spread_out(levels: Float32Array) -> Float32Array:
    """Levels about their mean; points come in the order of the scan, so neighbours are surroundings."""
    if len(levels) == 0:
        return levels
    usual = ndimage.uniform_filter1d(levels, min(_SURROUNDINGS, len(levels)), mode="nearest")
    return np.asarray(levels - usual, np.float32)


def _intensity_edges(features: FrameFeatures) -> tuple[Float64Array, Int64Array, Float32Array]:
    """Where the intensity of one surface changes along a scan line: places, kinds of edge, strengths."""
    frame = features.frame
    none = np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.float32)
    if frame.scan is None or frame.intensities is None or len(frame.scan.order) < 2:
        return none
    rows = _near_view(features)
    if len(rows) < 2:
        return none
    scan, levels = frame.scan, frame.intensities.astype(np.float64)
    azimuths, ranges, order = scan.azimuths[rows], scan.ranges[rows], scan.order[rows]
    same = np.diff(scan.lines[rows]) == 0
    usual = float(np.median(np.diff(azimuths)[same])) if same.any() else 0.0
    smooth = np.abs(np.diff(ranges)) < np.maximum(_LEAST_SMOOTH, _SMOOTH_SHARE * ranges[1:])
    pairs = np.flatnonzero(same & smooth & (np.diff(azimuths) < _GAP_STEPS * usual))
    if len(pairs) == 0:
        return none
    first, second = order[pairs], order[pairs + 1]
    steps = np.minimum(np.abs(levels[second] - levels[first]), _STRONGEST_STEP)
    strong = steps > max(float(np.quantile(steps, 1.0 - _BRIGHT_SHARE)), _LEAST_STEP)
    first, second = first[strong], second[strong]
    points = 0.5 * (frame.points_lidar[first] + frame.points_lidar[second])
    kinds = _across(features, frame.points_lidar[first], frame.points_lidar[second])
    known = kinds >= 0
    return points[known], kinds[known], np.sqrt(steps[strong][known]).astype(np.float32)


def _near_view(features: FrameFeatures) -> Int64Array:
    """Rows of the scan order that fall into the picture, or a little beside it."""
    frame, scan = features.frame, features.frame.scan
    if scan is None:
        return np.zeros(0, np.int64)
    camera = frame.camera
    pixels = project_unbounded(camera, frame.camera_from_lidar.apply(frame.points_lidar[scan.order]))
    margin = 0.05 * camera.width
    size = np.array([camera.width, camera.height])
    with np.errstate(invalid="ignore"):
        return np.flatnonzero(np.all((pixels > -margin) & (pixels < size + margin), axis=1))


def _across(features: FrameFeatures, first: Float64Array, second: Float64Array) -> Int64Array:
    """Which direction of the picture leads from one point to the other; -1 where that is not known."""
    stated, camera = features.frame.camera_from_lidar, features.picture.camera
    a, b = (project_unbounded(camera, stated.apply(points)) for points in (first, second))
    towards = np.arctan2(b[:, 1] - a[:, 1], b[:, 0] - a[:, 0])
    known = np.isfinite(towards)
    kinds = np.rint(np.where(known, towards, 0.0) * DIRECTIONS / np.pi).astype(np.int64) % DIRECTIONS
    return np.where(known, kinds, -1)
