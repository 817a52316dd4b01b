"""Annotations at any time: between two timestamps, exactly at one, before the first and after the last.

Source: READING of "paths" in docs/CONVENTIONS.md.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.geometry.rotations import conjugate_quaternion, multiply_quaternions, slerp
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.cuboids import Activation, CuboidAnnotation
from sceneloom.scene.annotations.keypoints import PointPath, PointsAnnotation
from sceneloom.scene.annotations.shapes import ShapeAnnotation
from sceneloom.scene.types import Identifier, key_of

STANDARD_ANGLES = CuboidAngles()


@dataclass(frozen=True, slots=True, eq=False)
class Bracket:
    """Between which rows of a path times lie.

    Attributes:
        before, after: (M,) int64, rows; the same one at a timestamp and beyond the ends.
        share: (M,) float64, how far on the way from `before` to `after`, 0 to 1.
        there: (M,) bool, whether the path says anything at that time.
    """

    before: Int64Array
    after: Int64Array
    share: Float64Array
    there: BoolArray

    @classmethod
    def of(cls, timestamps_ns: Int64Array, times_ns: ArrayLike, *, stationary: bool = False) -> "Bracket":
        """Find times (M,) [ns] among the timestamps (N,) of a path, in order; of equal timestamps the last one counts.

        Args:
            timestamps_ns: the path's timestamps.
            times_ns: what is asked for.
            stationary: the path holds at all times: its first row before it, its last row after it.
        """
        times = np.asarray(times_ns, np.int64).reshape(-1)
        if len(timestamps_ns) == 0:
            none = np.zeros(len(times), np.int64)
            return cls(none, none, np.zeros(len(times)), np.zeros(len(times), np.bool_))
        last = len(timestamps_ns) - 1
        # differences of int64 are taken as uint64, which holds each of them
        there = (times >= timestamps_ns[0]) & (times <= timestamps_ns[last])
        before = np.clip(np.searchsorted(timestamps_ns, times, side="right") - 1, 0, last)
        inside = (times > timestamps_ns[before]) & (before < last)
        after = before + inside
        span = np.maximum((timestamps_ns[after] - timestamps_ns[before]).view(np.uint64), 1)
        share = np.where(inside, (times - timestamps_ns[before]).view(np.uint64) / span, 0.0)
        return cls(before, after, share, there | stationary)

    @np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
    def blend(self, values: Float64Array) -> Float64Array:
        """Go straight between the rows of values (N, …); rows of times that the path does not cover mean nothing."""
        start = values[self.before]
        share = self.share.reshape(-1, *(1,) * (values.ndim - 1))
        between: Float64Array = start + share * (values[self.after] - start)
        return between


@dataclass(frozen=True, slots=True, eq=False)
class CuboidPoses:
    """A cuboid at M times; of times at which it is not there all numbers are NaN.

    Attributes:
        centers_world: (M, 3) float64 [m].
        sizes_lwh: (M, 3) float64 [m], length, width, height.
        quaternions_xyzw: (M, 4) float64, `world_from_box`.
        there: (M,) bool.
    """

    centers_world: Float64Array
    sizes_lwh: Float64Array
    quaternions_xyzw: Float64Array
    there: BoolArray


def rotated(
    angles: CuboidAngles, before_rpy: Float64Array, after_rpy: Float64Array, share: Float64Array
) -> Float64Array:
    """Rotate from angles (M, 3) to others the shorter arc; gives the quaternions (M, 4)."""
    return slerp(angles.quaternions(before_rpy), angles.quaternions(after_rpy), share)


def activation_for(annotation: CuboidAnnotation, sensor_id: Identifier | None) -> Activation | None:
    """Give when a sensor sees a cuboid; None where nothing is stated for it, or of no sensor."""
    if sensor_id is None or not annotation.activations:
        return None
    key = key_of(sensor_id)
    return next((found for found in annotation.activations if key_of(found.sensor_id) == key), None)


def active_at(
    annotation: CuboidAnnotation,
    sensor_id: Identifier | None,
    times_ns: ArrayLike,
    *,
    since_ns: ArrayLike | None = None,
) -> BoolArray:
    """Report whether a cuboid is active for a sensor at times (M,) [ns].

    A sensor that the activations do not name sees it at all times. One that they name sees it from each timestamp, for
    the duration, whose end no longer counts; a duration of 0 is that very moment. Without durations each activation
    lasts until the next one, the last one without end.

    Args:
        annotation: the cuboid.
        sensor_id: the sensor; None for the object itself, which is always active.
        times_ns: when.
        since_ns: (M,) [ns], when what is asked for began, such as a sweep: active at any time since then counts.

    Source: "activations" of "Cuboid Annotation" in the SFS description; READING of them in docs/CONVENTIONS.md.
    """
    times = np.asarray(times_ns, np.int64).reshape(-1)
    activation = activation_for(annotation, sensor_id)
    if activation is None:
        return np.ones(len(times), np.bool_)
    first = times if since_ns is None else np.minimum(np.asarray(since_ns, np.int64).reshape(-1), times)
    starts = activation.timestamps_ns.astype(np.float64)
    if activation.durations_ns is None:
        stops = np.append(starts[1:], np.inf)
    else:
        stops = starts + np.asarray(activation.durations_ns, np.float64)
    inside = (starts <= times[:, None]) & ((first[:, None] < stops) | (first[:, None] == starts))
    active: BoolArray = (inside | ((starts >= first[:, None]) & (starts <= times[:, None]))).any(axis=1)
    return active


def cuboid_poses(
    annotation: CuboidAnnotation,
    times_ns: ArrayLike,
    *,
    angles: CuboidAngles = STANDARD_ANGLES,
    sensor_id: Identifier | None = None,
) -> CuboidPoses:
    """Give a cuboid at times (M,) [ns]: centre and size go straight, the rotation rotates the shorter arc.

    It is there from its first timestamp to its last, a stationary one always. As a sensor sees it, it is there only
    while it is active, and where the activation has a cuboid of its own that holds: see `activated`.

    Args:
        annotation: the cuboid.
        times_ns: when.
        angles: how its angles are meant; `CuboidAngles.of(scene)`.
        sensor_id: the sensor by which it is asked for; None for the object itself.

    Raises:
        OptionError: unit or order of the angles is none of those known.
    """
    poses = _path_poses(annotation, times_ns, angles)
    if activation_for(annotation, sensor_id) is None:
        return poses
    times = np.asarray(times_ns, np.int64).reshape(-1)
    active = active_at(annotation, sensor_id, times)
    seen = activated(annotation, sensor_id, times, poses, angles=angles)
    there = seen.there & active
    parts = [part.copy() for part in (seen.centers_world, seen.sizes_lwh, seen.quaternions_xyzw)]
    for part in parts:
        part[~there] = np.nan
    return CuboidPoses(parts[0], parts[1], parts[2], there)


@np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
def activated(
    annotation: CuboidAnnotation,
    sensor_id: Identifier | None,
    times_ns: Int64Array,
    poses: CuboidPoses,
    *,
    angles: CuboidAngles = STANDARD_ANGLES,
) -> CuboidPoses:
    """Give a cuboid with the own cuboids of a sensor's activations instead of its path.

    At the timestamp of an activation that is its own cuboid, number by number. Afterwards it has the size of that, and
    moves as the path does from there on; where the path says nothing, it stays. Activations without a cuboid, or with
    null, leave the path as it is.

    Args:
        annotation: the cuboid.
        sensor_id: the sensor.
        times_ns: (M,) [ns]; the last activation that began counts, before the first the first.
        poses: by the path, at these times.
        angles: how its angles are meant.
    """
    activation = activation_for(annotation, sensor_id)
    if activation is None or activation.cuboids is None or not len(activation.timestamps_ns):
        return poses
    starts = activation.timestamps_ns
    rows = np.clip(np.searchsorted(starts, times_ns, side="right") - 1, 0, len(starts) - 1)
    own = activation.cuboids[rows]
    reported: BoolArray = np.isfinite(own.sum(axis=1))
    if not reported.any():
        return poses
    begun = _path_poses(annotation, starts[rows], angles)
    delta_rotations = angles.quaternions(np.where(reported[:, None], own[:, 6:], 0.0))
    moves: BoolArray = np.logical_and(np.logical_and(reported, begun.there), poses.there)
    centers, sizes = np.array(poses.centers_world), np.array(poses.sizes_lwh)
    rotations = np.array(poses.quaternions_xyzw)
    centers[reported], sizes[reported], rotations[reported] = (
        own[reported, 3:6],
        own[reported, :3],
        delta_rotations[reported],
    )
    # the object moved as its path did since the activation began, rotating about its own centre
    onward = multiply_quaternions(
        poses.quaternions_xyzw[moves], conjugate_quaternion(begun.quaternions_xyzw[moves])
    )
    later: BoolArray = np.logical_and(moves, times_ns != starts[rows])
    centers[later] += poses.centers_world[later] - begun.centers_world[later]
    rotations[later] = multiply_quaternions(onward[later[moves]], delta_rotations[later])
    return CuboidPoses(centers, sizes, rotations, poses.there | reported)


@np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
def _path_poses(annotation: CuboidAnnotation, times_ns: ArrayLike, angles: CuboidAngles) -> CuboidPoses:
    path = annotation.path
    found = Bracket.of(path.timestamps_ns, times_ns, stationary=bool(annotation.stationary))
    if len(path.timestamps_ns) == 0:
        nowhere = np.full((len(found.share), 4), np.nan)
        return CuboidPoses(nowhere[:, :3], nowhere[:, :3], nowhere, found.there)
    rows = found.blend(path.values[:, :6])
    delta_rotations = rotated(
        angles, path.values[found.before, 6:], path.values[found.after, 6:], found.share
    )
    rows[~found.there], delta_rotations[~found.there] = np.nan, np.nan
    return CuboidPoses(np.ascontiguousarray(rows[:, 3:]), rows[:, :3], delta_rotations, found.there)


@np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
def cuboid_at(
    annotation: CuboidAnnotation,
    times_ns: ArrayLike,
    *,
    angles: CuboidAngles = STANDARD_ANGLES,
    sensor_id: Identifier | None = None,
) -> tuple[Float64Array, BoolArray]:
    """Give the rows of a cuboid at times (M,) [ns], as a `CuboidPath` stores them.

    Rows at timestamps are those of the path, number by number. Between timestamps the angles are the ones nearest to
    the row before, so that they do not jump by whole rotations.

    Args:
        annotation: the cuboid.
        times_ns: when.
        angles: how its angles are meant, and given; `CuboidAngles.of(scene)`.
        sensor_id: the sensor by which it is asked for, as of `cuboid_poses`.

    Returns:
        rows: (M, 9) float64; NaN where it is not there.
        there: (M,) bool.

    Raises:
        OptionError: unit or order of the angles is none of those known.
    """
    path = annotation.path
    found = Bracket.of(path.timestamps_ns, times_ns, stationary=bool(annotation.stationary))
    rows = np.full((len(found.share), 9), np.nan)
    if len(path.timestamps_ns) == 0:
        return rows, found.there
    rows[:] = path.values[found.before]
    moving = np.flatnonzero(found.there & (found.share > 0))
    if len(moving):
        start, stop = path.values[found.before[moving]], path.values[found.after[moving]]
        share = found.share[moving]
        rows[moving, :6] = start[:, :6] + share[:, None] * (stop[:, :6] - start[:, :6])
        delta_rotations = rotated(angles, start[:, 6:], stop[:, 6:], share)
        differs = (start[:, 6:] != stop[:, 6:]).any(axis=1)
        rows[moving[differs], 6:] = angles.from_quaternions(delta_rotations[differs], near=start[differs, 6:])
    rows[~found.there] = np.nan
    activation = activation_for(annotation, sensor_id)
    if activation is None:
        return rows, found.there
    times = np.asarray(times_ns, np.int64).reshape(-1)
    seen = cuboid_poses(annotation, times, angles=angles, sensor_id=sensor_id)
    if activation.cuboids is not None and seen.there.any():
        own = activation.cuboids[
            np.clip(np.searchsorted(activation.timestamps_ns, times, side="right") - 1, 0, None)
        ]
        reported = np.flatnonzero(seen.there & np.isfinite(own).all(axis=1))
        rows[reported, :3], rows[reported, 3:6] = seen.sizes_lwh[reported], seen.centers_world[reported]
        rows[reported, 6:] = angles.from_quaternions(seen.quaternions_xyzw[reported], near=own[reported, 6:])
        begins = reported[np.isin(times[reported], activation.timestamps_ns)]
        rows[begins] = own[begins]
    rows[~seen.there] = np.nan
    return rows, seen.there


def box_2d_at(annotation: Box2DAnnotation, times_ns: ArrayLike) -> tuple[Float64Array, BoolArray]:
    """Give a box in images at times (M,) [ns]: rows (M, 4) `left top width height` [px], and where it is there.

    Its edges go straight from timestamp to timestamp; it is there from the first timestamp to the last, a stationary
    one always.
    """
    path = annotation.path
    return _straight(path.timestamps_ns, path.values, times_ns, stationary=bool(annotation.stationary))


def point_at(
    path: PointPath, times_ns: ArrayLike, *, stationary: bool = False
) -> tuple[Float64Array, BoolArray]:
    """Give a named point at times (M,) [ns]: locations (M, 3) [m], and where it is there."""
    return _straight(path.timestamps_ns, path.values, times_ns, stationary=stationary)


def points_at(annotation: PointsAnnotation, times_ns: ArrayLike) -> list[tuple[Float64Array, BoolArray]]:
    """Give all points of an annotation at times (M,) [ns], each as `point_at` does."""
    return [point_at(path, times_ns, stationary=bool(annotation.stationary)) for path in annotation.paths]


def shape_at(annotation: ShapeAnnotation, times_ns: ArrayLike) -> list[Float64Array | None]:
    """Give the vertices of a shape at times (M,) [ns]; None where it is not there.

    Between two timestamps with as many vertices each vertex goes straight; otherwise the earlier vertices hold.

    Source: READING of "paths" in docs/CONVENTIONS.md.
    """
    path = annotation.path
    found = Bracket.of(path.timestamps_ns, times_ns, stationary=bool(annotation.stationary))
    return [
        _between(path.vertices, int(found.before[k]), int(found.after[k]), float(found.share[k]))
        if found.there[k]
        else None
        for k in range(len(found.share))
    ]


def attribute_at(attribute: AttributePath, times_ns: ArrayLike) -> list[Any]:
    """Give the value of an attribute at times (M,) [ns]: each holds until the next; None before the first.

    One that is static, or has no timestamps, holds its only value at all times; a timestamp without a value says None.
    """
    times = np.asarray(times_ns, np.int64).reshape(-1)
    timestamps = attribute.timestamps_ns
    if not attribute.values:
        return [None] * len(times)
    if attribute.static or timestamps is None:
        return [attribute.values[0]] * len(times)
    rows = np.searchsorted(timestamps, times, side="right") - 1
    count = len(attribute.values)
    return [attribute.values[row] if 0 <= row < count else None for row in rows.tolist()]


def _straight(
    timestamps_ns: Int64Array, values: Float64Array, times_ns: ArrayLike, *, stationary: bool
) -> tuple[Float64Array, BoolArray]:
    found = Bracket.of(timestamps_ns, times_ns, stationary=stationary)
    if len(timestamps_ns) == 0:
        return np.full((len(found.share), values.shape[1]), np.nan), found.there
    rows = found.blend(values)
    rows[~found.there] = np.nan
    return rows, found.there


def _between(vertices: tuple[Float64Array, ...], before: int, after: int, share: float) -> Float64Array:
    start, stop = vertices[before], vertices[after]
    if start.shape != stop.shape:
        return start
    between: Float64Array = start + share * (stop - start)
    return between
