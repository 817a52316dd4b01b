"""Annotations from one frame into another: the keyframes that a path needs there, and localization adjustments."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from math import radians
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.editing.move_points import KNOWN, FrameChange
from sceneloom.editing.references import assumed, ours_of, skipped, with_warnings
from sceneloom.geometry.interpolation import thin_poses
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions
from sceneloom.scene.annotations import (
    Annotation,
    CuboidAnnotation,
    CuboidPath,
    LocalizationAdjustment,
    PlainAnnotation,
    PointPath,
    PointProjection,
    PointsAnnotation,
    ShapeAnnotation,
    VertexPath,
    locations_of,
)
from sceneloom.scene.annotations_at import CuboidAngles, cuboid_at, point_at, shape_at
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.scene import Scene, frame_times
from sceneloom.scene.types import Identifier

_LOCATION_TOLERANCE, _ROTATION_TOLERANCE = 1e-3, radians(0.01)
"""A keyframe is added at a frame's time where without it something would be further off then [m], [rad]."""

_PathKey = tuple[type, Identifier, int]
"""A path of an annotation: type of its id, its id, number of the path among those of its points."""

_ROUNDED_NS = 500
"""How far rounding to microseconds, the coarsest unit of files, moves a timestamp [ns]."""

_Sampler = Callable[[Int64Array], tuple[Float64Array, Float64Array | None]]
"""Gives, at times (M,), locations (M, V, 3) [m] in the old frame that shall be true, and a rotation (M, 4) or None."""


@dataclass(frozen=True, slots=True)
class _AddedKeyframes:
    """What a path got because it moves otherwise in the new frame.

    Attributes:
        timestamps_ns: of the added keyframes.
        stationary: whether it was stationary in the old frame.
    """

    timestamps_ns: tuple[int, ...]
    stationary: bool


@dataclass(slots=True)
class KeyframeStatistics:
    """What became of paths.

    Attributes:
        added: keyframes that were added, by path; of every path where the change is not constant.
        left_out: how many were left out, since the change is not known at their times.
    """

    added: dict[_PathKey, _AddedKeyframes] = field(default_factory=dict)
    left_out: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Keyframer:
    """Chooses the keyframes of paths in another frame.

    Attributes:
        change: `new_from_old`.
        span_ns: what is stationary in the old frame moves in the new one: it gets keyframes from the first to the last
            of these times. None: it is stationary in both.
        looks_ns: (L,) int64 [ns], ascending, when paths shall be true besides at their keyframes: the times of the
            scene's frames, since annotations are about what these show.
        added_before: what an earlier change added, to be taken away again.
        statistics: reported all choices.
    """

    change: FrameChange
    span_ns: tuple[int, int] | None = None
    looks_ns: Int64Array = field(default_factory=lambda: np.zeros(0, np.int64))
    added_before: Mapping[_PathKey, _AddedKeyframes] = field(default_factory=lambda: MappingProxyType({}))
    statistics: KeyframeStatistics = field(default_factory=KeyframeStatistics)

    def own_rows(self, path: _PathKey, timestamps_ns: Int64Array) -> Int64Array:
        """The rows of a path without those that an earlier change added; one where no others are left."""
        before = self.added_before.get(path)
        if before is None:
            return np.arange(len(timestamps_ns))
        own = np.flatnonzero(~_near(timestamps_ns, np.array(before.timestamps_ns, np.int64)))
        return own if len(own) else np.arange(min(1, len(timestamps_ns)))

    def stationary(self, path: _PathKey, *, was: bool | None) -> bool | None:
        """Whether what was stationary, or did not, is stationary in the new frame."""
        before = self.added_before.get(path)
        if before is not None and before.stationary:
            return True
        return False if was and self._sets_moving else was

    @property
    def _sets_moving(self) -> bool:
        return self.span_ns is not None and not self.change.is_constant

    def times(
        self, path: _PathKey, timestamps_ns: Int64Array, *, stationary: bool, sample: _Sampler
    ) -> Int64Array:
        """Give the times (K,) int64 [ns] of the keyframes in the new frame, ascending; none where it is not known.

        Args:
            path: which one.
            timestamps_ns: (N,) its keyframes in the old frame, in order.
            stationary: whether it is stationary in the old frame.
            sample: where it is in the old frame.
        """
        moving = stationary and self._sets_moving
        times = self._within_span(timestamps_ns) if moving else np.unique(timestamps_ns)
        times = times[self.change.at(times).coverage <= KNOWN]
        # what an earlier change took apart is put together as it was
        looks = times if path in self.added_before else self._looks(times)
        if len(looks) > len(times):
            times = np.union1d(times, looks[self._bends(looks, times, sample)])
        added = np.setdiff1d(times, timestamps_ns)
        if not moving:
            self.statistics.left_out += len(np.setdiff1d(timestamps_ns, times))
        if not self.change.is_constant:
            self.statistics.added[path] = _AddedKeyframes(tuple(added.tolist()), moving)
        return times

    def _within_span(self, timestamps_ns: Int64Array) -> Int64Array:
        """The span's ends and the keyframes between them."""
        span = np.array(self.span_ns, np.int64)
        return np.union1d(span, timestamps_ns[(timestamps_ns >= span[0]) & (timestamps_ns <= span[1])])

    def _looks(self, times_ns: Int64Array) -> Int64Array:
        """These times, and those of the scene's frames between the first and the last of them."""
        if self.change.is_constant or len(times_ns) < 2:
            return times_ns
        looks = self.looks_ns
        return np.union1d(times_ns, looks[(looks > times_ns[0]) & (looks < times_ns[-1])])

    def _bends(self, looks_ns: Int64Array, required_ns: Int64Array, sample: _Sampler) -> Int64Array:
        """Rows of the looks that are needed besides the required times."""
        locations, rotations = sample(looks_ns)
        change = self.change.at(looks_ns)
        known = np.flatnonzero(change.coverage <= KNOWN)
        new = self.change.locations(looks_ns[known], locations[known])
        quaternions = change.quaternions_xyzw[known] * 0.0 + (0.0, 0.0, 0.0, 1.0)
        if rotations is not None:
            quaternions = multiply_quaternions(change.quaternions_xyzw[known], rotations[known])
        rows = [
            thin_poses(
                looks_ns[known],
                np.ascontiguousarray(new[:, vertex]),
                quaternions,
                required_ns,
                position_tolerance=_LOCATION_TOLERANCE,
                rotation_tolerance=_ROTATION_TOLERANCE,
            )
            for vertex in range(new.shape[1])
        ]
        return known[np.unique(np.concatenate(rows))] if rows else known[:0]


def _near(timestamps_ns: Int64Array, others_ns: Int64Array) -> BoolArray:
    """Report which timestamps are one of the others, as a file of microseconds may have rounded it."""
    others = np.sort(others_ns)
    near = np.zeros(len(timestamps_ns), np.bool_)
    after = np.searchsorted(others, timestamps_ns)
    for locations in (after - 1, after):
        there = np.flatnonzero((locations >= 0) & (locations < len(others)))
        near[there] |= np.abs(timestamps_ns[there] - others[locations[there]]) <= _ROUNDED_NS
    return near


@dataclass(frozen=True, slots=True, eq=False)
class AnnotationMover:
    """Takes annotations into another frame.

    Attributes:
        keyframer: knows the change, and chooses the keyframes.
        angles: how the angles of cuboids are meant.
        adjustments: `new_from_corrected` and `old_from_new` around a localization adjustment; None leaves those.
    """

    keyframer: Keyframer
    angles: CuboidAngles
    adjustments: Callable[[LocalizationAdjustment], LocalizationAdjustment | None] | None = None

    @property
    def change(self) -> FrameChange:
        """`new_from_old`."""
        return self.keyframer.change

    def moved(self, annotations: Iterable[Annotation]) -> tuple[Annotation, ...]:
        """Give the annotations in the new frame; those that are nowhere known there are left out."""
        found = [self._moved(annotation) for annotation in annotations]
        return tuple(annotation for annotation in found if annotation is not None)

    def _moved(self, annotation: Annotation) -> Annotation | None:
        if isinstance(annotation, LocalizationAdjustment):
            return annotation if self.adjustments is None else self.adjustments(annotation)
        move = next((move for kind, move in _MOVES.items() if isinstance(annotation, kind)), None)
        return annotation if move is None else move(self, annotation)

    def cuboid_rows(self, times_ns: Int64Array, rows: Float64Array) -> Float64Array:
        """Take rows (M, 9) of cuboids, row k at time k, of whose angles those nearest to the old ones are given."""
        new = self.change.poses(times_ns, rows[:, 3:6], self.angles.quaternions(rows[:, 6:]))
        angles = self.angles.from_quaternions(new.quaternions_xyzw, near=rows[:, 6:])
        return np.concatenate([rows[:, :3], new.positions, angles], axis=1)

    def seen_rows(self, times_ns: Int64Array, rows: Float64Array | None) -> Float64Array | None:
        """The same of rows some of which are NaN, for null; None of None."""
        if rows is None:
            return None
        moved = np.full(rows.shape, np.nan)
        there = np.flatnonzero(np.isfinite(rows).all(axis=1))
        moved[there] = self.cuboid_rows(times_ns[there], rows[there])
        return moved


def _moved_cuboid(mover: AnnotationMover, annotation: CuboidAnnotation) -> CuboidAnnotation | None:
    key = (type(annotation.id), annotation.id, 0)
    path, keyframer, angles = annotation.path, mover.keyframer, mover.angles
    if len(path.timestamps_ns):
        own = keyframer.own_rows(key, path.timestamps_ns)
        timestamps_ns = path.timestamps_ns[own]
        old = replace(annotation, path=CuboidPath(timestamps_ns, path.values[own], path.extras))

        def sample(times_ns: Int64Array) -> tuple[Float64Array, Float64Array]:
            rows = cuboid_at(old, times_ns, angles=angles)[0]
            return rows[:, None, 3:6], angles.quaternions(rows[:, 6:])

        times_ns = keyframer.times(key, timestamps_ns, stationary=bool(annotation.stationary), sample=sample)
        if len(times_ns) == 0:
            return None
        rows = cuboid_at(old, times_ns, angles=angles)[0]
        path = CuboidPath(times_ns, mover.cuboid_rows(times_ns, rows), path.extras)
    return replace(
        annotation,
        path=path,
        stationary=keyframer.stationary(key, was=annotation.stationary),
        activations=tuple(_seen(mover, entry) for entry in annotation.activations),
        projections=tuple(_seen(mover, entry) for entry in annotation.projections),
    )


def _seen(mover: AnnotationMover, entry: Any) -> Any:
    """Of an activation or a projection the cuboids, as the sensor's own time has them."""
    return replace(entry, cuboids=mover.seen_rows(entry.timestamps_ns, entry.cuboids))


def _moved_shape(mover: AnnotationMover, annotation: ShapeAnnotation) -> ShapeAnnotation | None:
    if annotation.dimensions == 2 or len(annotation.path.timestamps_ns) == 0:
        return annotation
    key = (type(annotation.id), annotation.id, 0)
    path, keyframer = annotation.path, mover.keyframer
    own = keyframer.own_rows(key, path.timestamps_ns)
    timestamps_ns = path.timestamps_ns[own]
    old = replace(
        annotation, path=VertexPath(timestamps_ns, tuple(path.vertices[k] for k in own.tolist()), path.extras)
    )
    counts = {len(vertices) for vertices in old.path.vertices}

    def sample(times_ns: Int64Array) -> tuple[Float64Array, None]:
        # vertices that come and go are at no location between keyframes
        if len(counts) > 1:
            return np.zeros((len(times_ns), 0, 3)), None
        found = shape_at(old, times_ns)
        nowhere = np.full((next(iter(counts)), 3), np.nan)
        return np.stack([nowhere if vertices is None else vertices for vertices in found]), None

    times_ns = keyframer.times(key, timestamps_ns, stationary=bool(annotation.stationary), sample=sample)
    if len(times_ns) == 0:
        return None
    found = [vertices for vertices in shape_at(old, times_ns) if vertices is not None]
    vertices = tuple(
        mover.change.locations(times_ns[k : k + 1], shape[None])[0] for k, shape in enumerate(found)
    )
    return replace(
        annotation,
        path=VertexPath(times_ns, vertices, path.extras),
        stationary=keyframer.stationary(key, was=annotation.stationary),
    )


def _moved_points(mover: AnnotationMover, annotation: PointsAnnotation) -> PointsAnnotation | None:
    stationary = bool(annotation.stationary)
    paths = tuple(
        _moved_point(mover, annotation, number, path, stationary=stationary)
        for number, path in enumerate(annotation.paths)
    )
    if annotation.paths and not any(len(path.timestamps_ns) for path in paths):
        return None
    first = (type(annotation.id), annotation.id, 0)
    return replace(
        annotation,
        paths=paths,
        stationary=mover.keyframer.stationary(first, was=annotation.stationary),
        projections=tuple(
            tuple(_seen_point(mover, entry) for entry in entries) for entries in annotation.projections
        ),
    )


def _moved_point(
    mover: AnnotationMover, annotation: PointsAnnotation, number: int, path: PointPath, *, stationary: bool
) -> PointPath:
    key = (type(annotation.id), annotation.id, number)
    if len(path.timestamps_ns) == 0 or path.values.shape[1] % 3:
        return path
    own = mover.keyframer.own_rows(key, path.timestamps_ns)
    old = replace(path, timestamps_ns=path.timestamps_ns[own], values=path.values[own])

    def locations(times_ns: Int64Array) -> Float64Array:
        return locations_of(point_at(old, times_ns, stationary=stationary)[0])

    times_ns = mover.keyframer.times(
        key, old.timestamps_ns, stationary=stationary, sample=lambda times: (locations(times), None)
    )
    moved = mover.change.locations(times_ns, locations(times_ns))
    return replace(path, timestamps_ns=times_ns, values=moved.reshape(len(times_ns), path.values.shape[1]))


def _seen_point(mover: AnnotationMover, entry: PointProjection) -> PointProjection:
    if entry.positions is None:
        return entry
    return replace(entry, positions=mover.change.locations(entry.timestamps_ns, entry.positions))


_MOVES: Mapping[type, Callable[[AnnotationMover, Any], Annotation | None]] = MappingProxyType(
    {CuboidAnnotation: _moved_cuboid, ShapeAnnotation: _moved_shape, PointsAnnotation: _moved_points}
)
"""How the annotations that have a location in space are moved; the others have none."""


def _led_from(new_from_old: FrameChange, adjustment: LocalizationAdjustment) -> LocalizationAdjustment | None:
    """Give the adjustment that leads from the new frame to where the given one leads from the old one.

    A'(t) = A(t) old_from_new(t). None where the two are known at no common time.
    """
    poses = adjustment.poses
    times = _common_times(poses, new_from_old.knots_ns)
    if len(times) == 0:
        path = new_from_old.inverse().path(Poses.identity())
        return None if path is None else replace(adjustment, poses=_after(poses, path))
    corrected_from_new = FrameChange(PoseSource(poses, RigidTransform.identity()), held=True)
    old_from_new = new_from_old.inverse().path(Poses.identity(), times_ns=times)
    if old_from_new is None:
        return None
    return replace(adjustment, poses=corrected_from_new.path(old_from_new) or poses)


def _common_times(poses: Poses, knots_ns: Int64Array) -> Int64Array:
    """The times at which either has a pose, where both are known."""
    if poses.static:
        return knots_ns
    inside = knots_ns[(knots_ns >= poses.start_ns) & (knots_ns <= poses.stop_ns)]
    return np.union1d(poses.timestamps_ns, inside)


def _after(outer: Poses, inner: Poses) -> Poses:
    """`outer ∘ inner` of two paths that are the same at all times."""
    path = FrameChange(PoseSource(outer, RigidTransform.identity())).path(inner)
    return outer if path is None else path


def seen_from(new_from_old: FrameChange, adjustment: LocalizationAdjustment) -> LocalizationAdjustment | None:
    """Give the adjustment of a world that is seen from another one, before and after it.

    A'(t) = new_from_old(t) A(t) old_from_new(t). None where the two are known at no common time.
    """
    led = _led_from(new_from_old, adjustment)
    path = None if led is None else new_from_old.path(led.poses)
    return None if path is None else replace(adjustment, poses=path)


TO_EGO = "to_ego"
"""Our entry of the metadata that says what bringing a scene onto the ego added, so that it can be taken away again."""


def annotations_moved(
    scene: Scene,
    change: FrameChange,
    before: Mapping[_PathKey, _AddedKeyframes],
    entry: list[dict[str, Any]] | None = None,
) -> Scene:
    """Move the annotations of a scene.

    Args:
        scene: theirs.
        change: `new_from_old`.
        before: what an earlier change added, to be taken away.
        entry: what is added is written here, as `added_before` reads it.
    """
    times = _known(change, frames_ns(scene))
    span_ns = (int(times[0]), int(times[-1])) if len(times) else None
    keyframer = Keyframer(change, span_ns, times, before)
    mover = AnnotationMover(keyframer, CuboidAngles.of(scene), partial(_led_from, change))
    moved = mover.moved(scene.annotations)
    if entry is not None:
        entry.extend(_entry(path, added) for path, added in keyframer.statistics.added.items())
    unknown = sum(isinstance(annotation, PlainAnnotation) for annotation in scene.annotations)
    warnings = (
        skipped(
            "keyframes-beyond-the-trajectory",
            "annotations",
            "keyframes at whose time the ego trajectory is not known",
            count=keyframer.statistics.left_out,
        ),
        skipped(
            "annotations-beyond-the-trajectory",
            "annotations",
            "annotations at none of whose times the ego trajectory is known",
            count=len(scene.annotations) - len(moved),
        ),
        assumed(
            "annotations-not-moved",
            "annotations",
            "annotations of unknown types: it is not known what in them has a location; left as they are",
            count=unknown,
        ),
    )
    return with_warnings(replace(scene, annotations=moved), warnings)


def frames_ns(scene: Scene) -> Int64Array:
    """The times (N,) int64 [ns], ascending, of all sweeps, radar cycles and images of a scene."""
    framed = [
        s
        for s in scene.sensors
        if isinstance(s, LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor)
    ]
    timestamps = [frame_times(sensor) for sensor in framed]
    return np.unique(np.concatenate(timestamps)) if timestamps else np.zeros(0, np.int64)


def _known(change: FrameChange, times_ns: Int64Array) -> Int64Array:
    """Those of the times at which the change is known; those of its own poses where there are none."""
    times = times_ns if len(times_ns) else change.knots_ns
    return times[change.at(times).coverage <= KNOWN]


def _entry(path: _PathKey, added: _AddedKeyframes) -> dict[str, Any]:
    return {
        "annotation_id": path[1],
        "path": path[2],
        "stationary": added.stationary,
        "added_ns": list(added.timestamps_ns),
    }


def added_before(scene: Scene) -> Mapping[_PathKey, _AddedKeyframes]:
    """What bringing the scene onto the ego added, as far as the metadata report it in a form that we know."""
    entries = ours_of(scene).get(TO_EGO)
    found: dict[_PathKey, _AddedKeyframes] = {}
    for entry in entries if isinstance(entries, list) else []:
        if not isinstance(entry, Mapping):
            continue
        identifier, path, times = (entry.get(name) for name in ("annotation_id", "path", "added_ns"))
        if not (isinstance(identifier, str | int) and isinstance(path, int) and isinstance(times, list)):
            continue
        if all(isinstance(time_ns, int) for time_ns in times):
            added = _AddedKeyframes(tuple(times), bool(entry.get("stationary")))
            found[type(identifier), identifier, path] = added
    return MappingProxyType(found)
