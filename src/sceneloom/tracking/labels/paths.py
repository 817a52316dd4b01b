"""From the states of a track to the path of a cuboid: one size, one pose where it stands, few keyframes."""

from dataclasses import dataclass, replace
from math import degrees, pi, radians

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.kernels.fewest_keyframes import fewest_keyframes
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.cuboids import CuboidPath
from sceneloom.scene.tracks import Support, Track
from sceneloom.tracking.labels.settings import LabelSettings

BOXED = (Support.BOTH, Support.SWEEP, Support.IMAGE)
"""States that rest on a box of a detector."""
_MEASURED = (Support.BOTH, Support.SWEEP)
_ROUNDING = 1e-9
"""Tolerances are kept this share smaller, so that another order of the same sums does not break the promise."""
_MOST_UNSURE = 0.6
"""However little is known of a speed, what gets on faster does not stand [m/s]."""
_LEAST_VARIANCE = 1e-6
"""No variance counts as less than this [m²]."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelPath:
    """An object over time as it is to be labelled.

    Attributes:
        timestamps_ns: (K,) int64 [ns], of the track's states from the first to the last that rests on a box.
        boxes: (K, 7) float64, centre and size [m] and heading [rad], which goes on beyond half rotations.
        stands: whether it is stationary.
    """

    timestamps_ns: Int64Array
    boxes: Float64Array
    stands: bool

    def keyframes(self, settings: LabelSettings) -> Int64Array:
        """Which states are keyframes: the fewest that give the others within the tolerances; one of what stands."""
        if self.stands:
            return np.zeros(1, np.int64)
        keep = 1.0 - _ROUNDING
        return fewest_keyframes(
            np.array(self.timestamps_ns),
            np.array(self.boxes),
            settings.tolerance_m * keep,
            radians(settings.tolerance_deg) * keep,
        )

    def cuboids(self, rows: Int64Array, angles: CuboidAngles) -> CuboidPath:
        """The path of a cuboid through some states, its angles as the scene means them."""
        boxes = self.boxes[rows]
        values = np.zeros((len(rows), 9))
        values[:, :3], values[:, 3:6] = boxes[:, 3:6], boxes[:, :3]
        unit = degrees(1.0) if angles.unit == CuboidAngles().unit else 1.0
        # of boxes that are rotated about z alone, the order of the rotations does not matter
        values[:, 8] = boxes[:, 6] * unit
        return CuboidPath(self.timestamps_ns[rows], values)


def boxed_part(track: Track) -> Track | None:
    """The states of a track from the first that rests on a box to the last that does; None where none does."""
    rows = np.flatnonzero(boxed(track))
    return None if len(rows) == 0 else part_of(track, slice(int(rows[0]), int(rows[-1]) + 1))


def boxed(track: Track) -> BoolArray:
    """Which states rest on a box, (K,) bool."""
    return np.isin(track.supports, BOXED)


def part_of(track: Track, rows: slice) -> Track:
    """Some states of a track."""
    names = (
        "timestamps_ns",
        "centers",
        "sizes_lwh",
        "yaws",
        "velocities",
        "yaw_rates",
        "covariances",
        "scores",
    )
    corners = {camera_id: boxes[rows] for camera_id, boxes in track.corners_xyxy.items()}
    kept = {name: getattr(track, name)[rows] for name in (*names, "supports")}
    return replace(track, corners_xyxy=corners, **kept)


def label_path(track: Track, settings: LabelSettings) -> LabelPath:
    """Give an object over time as it is to be labelled.

    Args:
        track: from its first box to its last.
        settings: whether sizes are made constant and stationary objects found.
    """
    yaws = np.unwrap(track.yaws)
    boxes = np.column_stack([track.centers, track.sizes_lwh, yaws])
    weights = _weights(track)
    if settings.constant_sizes:
        boxes[:, 3:6] = weighted_medians(track.sizes_lwh, weights[:, 3:6])
    if not (settings.stationary and stands(track, settings)):
        return LabelPath(track.timestamps_ns, boxes, stands=False)
    boxes[:, :3] = weighted_medians(track.centers, weights[:, :3])
    boxes[:, 3:6] = weighted_medians(track.sizes_lwh, weights[:, 3:6])
    boxes[:, 6] = usual_heading(yaws, weights[:, 6])
    return LabelPath(track.timestamps_ns, boxes, stands=True)


def stands(track: Track, settings: LabelSettings) -> bool:
    """Report whether an object is stationary: never far from its usual location, and not getting on from there.

    It may get on as fast as the settings state, or as its speed is uncertain by one deviation.
    """
    rows = np.flatnonzero(np.isin(track.supports, _MEASURED))
    if len(rows) < 2:
        return False
    locations, times = (
        track.centers[rows, :2],
        (track.timestamps_ns[rows] - track.timestamps_ns[rows[0]]) * 1e-9,
    )
    away = np.linalg.norm(locations - np.median(locations, axis=0), axis=1)
    if float(away.max()) > settings.stationary_spread:
        return False
    slopes = np.polynomial.polynomial.polyfit(times, locations, 1)[1]
    known = np.trace(track.covariances[rows, 7:9, 7:9], axis1=1, axis2=2) / 2.0
    unsure = min(float(np.sqrt(max(float(np.median(known)), 0.0))), _MOST_UNSURE)
    return float(np.hypot(*slopes)) <= max(settings.stationary_speed, unsure)


def _weights(track: Track) -> Float64Array:
    """What each number of each state is worth, (K, 7): the inverse of its variance; least without a box of a sweep."""
    variances = np.diagonal(track.covariances[:, :7, :7], axis1=1, axis2=2)
    sound = np.isfinite(variances) & (variances >= 0.0)
    weights: Float64Array = 1.0 / np.maximum(np.where(sound, variances, 1.0), _LEAST_VARIANCE)
    measured = np.isin(track.supports, _MEASURED)
    return np.where(measured[:, None], weights, weights * _LEAST_VARIANCE) if measured.any() else weights


def weighted_medians(values: Float64Array, weights: Float64Array) -> Float64Array:
    """The median of each column of (K, C) values, (C,): as much weight below it as above."""
    order = np.argsort(values, axis=0, kind="stable")
    heaped = np.cumsum(np.take_along_axis(weights, order, axis=0), axis=0)
    middles = (heaped >= heaped[-1] / 2.0).argmax(axis=0)
    medians: Float64Array = values[order[middles, np.arange(values.shape[1])], np.arange(values.shape[1])]
    return medians


def usual_heading(yaws: Float64Array, weights: Float64Array) -> float:
    """The heading that most of (K,) headings [rad] agree with, those that are half a switch off counting against it.

    The axis is the mean of doubled angles, for which a heading and its opposite are the same; the trajectory along it
    is what the larger weight says.

    Source: Mardia and Jupp 2000, "Directional Statistics", ch. 2, for means of axes.
    """
    axis = 0.5 * float(np.angle((weights * np.exp(2j * yaws)).sum()))
    along = float((weights * np.cos(yaws - axis)).sum())
    return axis if along >= 0.0 else axis - pi * np.sign(axis or 1.0)
