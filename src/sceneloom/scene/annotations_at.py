"""Annotations at any time (between, at and beyond timestamps), cuboid angles, and all boxes of a scene at a moment.

Source: READING of "paths" in docs/CONVENTIONS.md.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, hold_arrays
from sceneloom.errors import DataError, OptionError
from sceneloom.geometry.boxes import box_corners
from sceneloom.geometry.euler import AngleUnit, cuboid_angles_from_rotation, rotation_from_cuboid_angles
from sceneloom.geometry.rigid import (
    conjugate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
    quaternion_from_matrix,
    slerp,
)
from sceneloom.scene.annotations import (
    Activation,
    AttributePath,
    Box2DAnnotation,
    CuboidAnnotation,
    PointPath,
    PointsAnnotation,
    ShapeAnnotation,
)
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates, Identifier, Key, key_of


@dataclass(frozen=True, slots=True)
class CuboidAngles:
    """The reading of roll, pitch and yaw.

    Attributes:
        unit: what they are counted in.
        order: in which order the three rotations are multiplied.

    Source: READING of "cuboids" in docs/CONVENTIONS.md.
    """

    unit: str = AngleUnit.DEGREES
    order: str = "xyz"

    @classmethod
    def of(cls, scene: "Scene") -> "CuboidAngles":
        """The reading that a scene's metadata name, or the default one."""
        named: Any = scene.metadata.get("sceneloom")
        ours = named if isinstance(named, Mapping) else {}
        return cls(ours.get("euler_unit") or AngleUnit.DEGREES, ours.get("euler_order") or "xyz")

    def quaternions(self, angles_rpy: Float64Array) -> Float64Array:
        """Give `world_from_box` (..., 4), scalar last, of roll, pitch and yaw (..., 3).

        Raises:
            OptionError: unit or order is none of those known.
        """
        return quaternion_from_matrix(rotation_from_cuboid_angles(angles_rpy, unit=self.unit, order=self.order))

    def from_quaternions(self, quaternions_xyzw: Float64Array, *, near: Float64Array | None = None) -> Float64Array:
        """Give roll, pitch and yaw (..., 3) of rotations (..., 4).

        Args:
            quaternions_xyzw: the rotations, `world_from_box`.
            near: (..., 3) angles: of those that differ by whole rotates the nearest to these are given.

        Raises:
            OptionError: unit or order is none of those known.
        """
        angles = cuboid_angles_from_rotation(matrix_from_quaternion(quaternions_xyzw), unit=self.unit, order=self.order)
        if near is None:
            return angles
        rotation = 360.0 if self.unit == AngleUnit.DEGREES else 2.0 * np.pi
        nearest: Float64Array = angles + rotation * np.rint((near - angles) / rotation)
        return nearest


ANNOTATIONS_FRAME = "annotations_frame"
"""Our entry of the metadata that names it."""


def annotations_frame(scene: Scene) -> Coordinates:
    """The frame that the metadata name, else the world.

    Raises:
        DataError: what they name is no frame.
    """
    ours: Any = scene.metadata.get("sceneloom")
    named = ours.get(ANNOTATIONS_FRAME) if isinstance(ours, Mapping) else None
    if named is None:
        return Coordinates.WORLD
    if named not in tuple(Coordinates):
        location = f"metadata.sceneloom.{ANNOTATIONS_FRAME}"
        raise DataError(scene.source, location, f"{named!r}; expected one of {', '.join(Coordinates)}")
    return Coordinates(named)


def not_in_world(source: str) -> OptionError:
    """What to state of a scene of that name whose annotations are on the ego, where they are needed in the world."""
    return OptionError(
        f"{source}: its annotations are in the ego frame; bring them into the world first: `sceneloom edit to-world`"
    )


STANDARD_ANGLES = CuboidAngles()


@dataclass(frozen=True, slots=True, eq=False)
class _Bracket:
    """Between which rows of a path times lie."""

    before: Int64Array  # (M,) rows
    after: Int64Array  # (M,) rows, the same ones at a timestamp and beyond the ends
    share: Float64Array  # (M,) how far from `before` to `after`, 0 to 1
    there: BoolArray  # (M,) whether the path has a value at that time

    @classmethod
    def of(cls, timestamps_ns: Int64Array, times_ns: ArrayLike, *, stationary: bool = False) -> "_Bracket":
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
    onward = multiply_quaternions(poses.quaternions_xyzw[moves], conjugate_quaternion(begun.quaternions_xyzw[moves]))
    later: BoolArray = np.logical_and(moves, times_ns != starts[rows])
    centers[later] += poses.centers_world[later] - begun.centers_world[later]
    rotations[later] = multiply_quaternions(onward[later[moves]], delta_rotations[later])
    return CuboidPoses(centers, sizes, rotations, poses.there | reported)


@np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
def _path_poses(annotation: CuboidAnnotation, times_ns: ArrayLike, angles: CuboidAngles) -> CuboidPoses:
    path = annotation.path
    found = _Bracket.of(path.timestamps_ns, times_ns, stationary=bool(annotation.stationary))
    if len(path.timestamps_ns) == 0:
        nowhere = np.full((len(found.share), 4), np.nan)
        return CuboidPoses(nowhere[:, :3], nowhere[:, :3], nowhere, found.there)
    rows = found.blend(path.values[:, :6])
    delta_rotations = rotated(angles, path.values[found.before, 6:], path.values[found.after, 6:], found.share)
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
    found = _Bracket.of(path.timestamps_ns, times_ns, stationary=bool(annotation.stationary))
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
        own = activation.cuboids[np.clip(np.searchsorted(activation.timestamps_ns, times, side="right") - 1, 0, None)]
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


def point_at(path: PointPath, times_ns: ArrayLike, *, stationary: bool = False) -> tuple[Float64Array, BoolArray]:
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
    found = _Bracket.of(path.timestamps_ns, times_ns, stationary=bool(annotation.stationary))
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
    found = _Bracket.of(timestamps_ns, times_ns, stationary=stationary)
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


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """The objects that are there at a moment, one row each.

    Attributes:
        ids: ids of their annotations.
        labels: their classes, None where not stated.
        centers_world: (B, 3) float64 [m].
        sizes_lwh: (B, 3) float64 [m], length, width, height.
        quaternions_xyzw: (B, 4) float64, `world_from_box`.
        numbers: (B,) int64, of the annotations among the scene's cuboids: one object has the same in all samples.
    """

    ids: tuple[Identifier, ...]
    labels: tuple[str | None, ...]
    centers_world: Float64Array
    sizes_lwh: Float64Array
    quaternions_xyzw: Float64Array
    numbers: Int64Array | None = None

    def __post_init__(self) -> None:
        n = len(self.ids)
        fields = {
            "numbers?": (np.int64, n),
            "centers_world": (np.float64, n, 3),
            "sizes_lwh": (np.float64, n, 3),
            "quaternions_xyzw": (np.float64, n, 4),
        }
        hold_arrays(self, "boxes", fields)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def rotations_world(self) -> Float64Array:
        """(B, 3, 3) float64 `world_from_box`: the columns are the boxes' forward, left and up."""
        return matrix_from_quaternion(self.quaternions_xyzw)

    @property
    def corners_world(self) -> Float64Array:
        """(B, 8, 3) float64 [m], in the order of `geometry.boxes.CORNER_SIGNS`."""
        return box_corners(self.centers_world, self.sizes_lwh, self.quaternions_xyzw)

    @property
    def yaws_world(self) -> Float64Array:
        """(B,) float64 [rad], direction of the boxes' forward axis, counter-clockwise from the world's x."""
        forward = self.rotations_world[:, :, 0]
        yaws: Float64Array = np.arctan2(forward[:, 1], forward[:, 0])
        return yaws


class BoxTable:
    """All boxes of a scene with their trajectories, to be asked for a moment.

    Attributes:
        annotations: the cuboids of the scene that have a path, in order.
        angles: how their angles are meant.
    """

    def __init__(self, scene: Scene) -> None:
        """Collect the boxes; unit and order of their angles are those that the scene's metadata name."""
        found = [a for a in scene.annotations if isinstance(a, CuboidAnnotation) and len(a.path.timestamps_ns)]
        self.annotations = tuple(found)
        self._in_world = annotations_frame(scene) is Coordinates.WORLD
        self._source = scene.source
        self.angles = CuboidAngles.of(scene)

    @cached_property
    def _paths(self) -> tuple[Int64Array, Float64Array, Int64Array, Int64Array]:
        """Timestamps and rows of all paths one after the other, and where each path begins and ends."""
        if not self._in_world:
            raise not_in_world(self._source)
        paths = [annotation.path for annotation in self.annotations]
        lengths = np.array([len(path.timestamps_ns) for path in paths], np.int64)
        stops = np.cumsum(lengths)
        timestamps = np.concatenate([path.timestamps_ns for path in paths])
        return timestamps, np.concatenate([path.values for path in paths]), stops - lengths, stops

    def at(
        self, time_ns: int, *, sensor_id: Identifier | None = None, window_ns: tuple[int, int] | None = None
    ) -> Boxes:
        """Give the boxes that are there at a time [ns], as `find` does."""
        return self.find(time_ns, sensor_id=sensor_id, window_ns=window_ns)[1]

    def find(
        self, time_ns: int, *, sensor_id: Identifier | None = None, window_ns: tuple[int, int] | None = None
    ) -> tuple[Int64Array, Boxes]:
        """Give the boxes that are there at a time [ns], and whose they are: rows (B,) of `annotations`.

        A box is there from its first timestamp to its last, a stationary one always. Between two timestamps centre and
        size go straight and the rotation rotates the shorter arc. As a sensor sees them, boxes are there while they are
        active for it, by its own computed cuboids (`scene.at.cuboid_poses`).

        Args:
            time_ns: when.
            sensor_id: the sensor by which is asked; None for the objects themselves.
            window_ns: first and last time of the sensor's frame: boxes count that are active at any time of it.

        Raises:
            OptionError: unit or order of the angles is none of those known, or the annotations are not in the world.

        Source: READING of "paths" in docs/CONVENTIONS.md.
        """
        there = self._there(time_ns)
        for row, annotation in self._activated(sensor_id):
            first, last = (time_ns, time_ns) if window_ns is None else sorted(window_ns)
            if active_at(annotation, sensor_id, [last], since_ns=[first])[0]:
                there[row] = self._seen(annotation, sensor_id, time_ns).there[0]
            else:
                there[row] = False
        rows = np.flatnonzero(there)
        return rows, self.placed(rows, time_ns, sensor_id=sensor_id)

    def _activated(self, sensor_id: Identifier | None) -> Sequence[tuple[int, CuboidAnnotation]]:
        """The cuboids of whose activations some are for a sensor, by row."""
        return () if sensor_id is None else self._by_sensor.get(key_of(sensor_id), ())

    def _seen(self, annotation: CuboidAnnotation, sensor_id: Identifier | None, time_ns: int) -> CuboidPoses:
        """A cuboid with the own cuboids of activations, whether it is active or not."""
        path = cuboid_poses(annotation, [time_ns], angles=self.angles)
        return activated(annotation, sensor_id, np.array([time_ns], np.int64), path, angles=self.angles)

    @cached_property
    def _by_sensor(self) -> Mapping[Key, Sequence[tuple[int, CuboidAnnotation]]]:
        found: dict[Key, list[tuple[int, CuboidAnnotation]]] = {}
        for row, annotation in enumerate(self.annotations):
            for key in dict.fromkeys(key_of(activation.sensor_id) for activation in annotation.activations):
                found.setdefault(key, []).append((row, annotation))
        return found

    def placed(self, rows: Int64Array, time_ns: int, *, sensor_id: Identifier | None = None) -> Boxes:
        """Give some boxes at a time [ns], by rows of `annotations`; each holds beyond its first and last timestamp.

        Args:
            rows: which.
            time_ns: when.
            sensor_id: the sensor whose own computed cuboids count.

        Raises:
            OptionError: unit or order of the angles is none of those known.
        """
        boxes = self._placed(rows, time_ns)
        computed = [
            (k, annotation)
            for row, annotation in self._activated(sensor_id)
            for k in np.flatnonzero(rows == row).tolist()
        ]
        if not computed:
            return boxes
        parts = [part.copy() for part in (boxes.centers_world, boxes.sizes_lwh, boxes.quaternions_xyzw)]
        for k, annotation in computed:
            seen = self._seen(annotation, sensor_id, time_ns)
            if not seen.there[0]:
                continue  # it holds beyond the ends of its path
            for part, own in zip(parts, (seen.centers_world, seen.sizes_lwh, seen.quaternions_xyzw), strict=True):
                part[k] = own[0]
        return replace(boxes, centers_world=parts[0], sizes_lwh=parts[1], quaternions_xyzw=parts[2])

    @np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
    def _placed(self, rows: Int64Array, time_ns: int) -> Boxes:
        """The same by their paths."""
        if len(rows) == 0:
            nowhere = np.zeros((0, 3))
            return Boxes((), (), nowhere, nowhere, np.zeros((0, 4)), np.zeros(0, np.int64))
        timestamps, values, starts, stops = self._paths
        passed = np.add.reduceat((timestamps <= time_ns).astype(np.int64), starts)[rows]
        last = stops[rows] - 1
        before = np.clip(starts[rows] + passed - 1, starts[rows], last)
        after = np.minimum(before + 1, last)
        span = np.maximum(timestamps[after] - timestamps[before], 1)
        share = np.clip((time_ns - timestamps[before]) / span, 0.0, 1.0)
        blended = values[before, :6] + share[:, None] * (values[after, :6] - values[before, :6])
        chosen = [self.annotations[k] for k in rows.tolist()]
        return Boxes(
            tuple(annotation.id for annotation in chosen),
            tuple(annotation.label for annotation in chosen),
            np.ascontiguousarray(blended[:, 3:]),
            np.ascontiguousarray(blended[:, :3]),
            rotated(self.angles, values[before, 6:], values[after, 6:], share),
            np.asarray(rows, np.int64),
        )

    def _there(self, time_ns: int) -> BoolArray:
        if not self.annotations:
            return np.zeros(0, np.bool_)
        timestamps, _, starts, stops = self._paths
        covered: BoolArray = (timestamps[starts] <= time_ns) & (time_ns <= timestamps[stops - 1])
        return covered | self._stationary

    @cached_property
    def _stationary(self) -> BoolArray:
        return np.array([bool(annotation.stationary) for annotation in self.annotations], np.bool_)
