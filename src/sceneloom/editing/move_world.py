"""Scenes with points, poses and annotations in another frame: world, ego, sensor, or another world."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from math import radians
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int64Array, finite_rows
from sceneloom.editing.move_points import KNOWN, FrameChange, chosen_frames, points_change
from sceneloom.editing.references import assumed, ours_of, skipped, with_ours, with_warnings
from sceneloom.errors import ArrayError, OptionError, PoseError
from sceneloom.geometry.interpolation import thin_poses
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import matrix_from_quaternion, multiply_quaternions
from sceneloom.motion.ego_trajectory import ego_motion_as_given, is_computed, with_trajectory_estimated
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
from sceneloom.scene.annotations_at import (
    ANNOTATIONS_FRAME,
    CuboidAngles,
    annotations_frame,
    cuboid_at,
    point_at,
    shape_at,
)
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, shots_of
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.ego import EgoMotion, Posed, camera_path, ego_path, needs_ego, sensor_path, sensor_source
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import OdometrySensor, PlainSensor
from sceneloom.scene.poses import Poses, PoseSource, Trajectory, same_direction
from sceneloom.scene.scene import Scene, Sensor, frame_times, scene_period_ns
from sceneloom.scene.time_range import Renumbering, renumbered
from sceneloom.scene.types import Coordinates, Identifier, Key, PointsFrame, Progress, key_of
from sceneloom.warnings import DataWarning

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
class _KeyframeStatistics:
    """What became of paths.

    Attributes:
        added: keyframes that were added, by path; of every path where the change is not constant.
        left_out: how many were left out, since the change is not known at their times.
    """

    added: dict[_PathKey, _AddedKeyframes] = field(default_factory=dict)
    left_out: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class _Keyframer:
    """Chooses the keyframes of paths in another frame.

    Attributes:
        change: `new_from_old`.
        span_ns: what is stationary in the old frame moves in the new one: it gets keyframes from the first to the last
            of these times. None: it is stationary in both.
        looks_ns: (L,) int64 [ns], ascending, when paths shall be true besides at their keyframes: the times of the
            scene's frames, since annotations are about what these show.
        added_before: what an earlier change added, to be taken away again.
        statistics: of all choices.
    """

    change: FrameChange
    span_ns: tuple[int, int] | None = None
    looks_ns: Int64Array = field(default_factory=lambda: np.zeros(0, np.int64))
    added_before: Mapping[_PathKey, _AddedKeyframes] = field(default_factory=lambda: MappingProxyType({}))
    statistics: _KeyframeStatistics = field(default_factory=_KeyframeStatistics)

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

    def times(self, path: _PathKey, timestamps_ns: Int64Array, *, stationary: bool, sample: _Sampler) -> Int64Array:
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
class _AnnotationMover:
    """Takes annotations into another frame.

    Attributes:
        keyframer: knows the change, and chooses the keyframes.
        angles: how the angles of cuboids are meant.
        adjustments: `new_from_corrected` and `old_from_new` around a localization adjustment; None leaves those.
    """

    keyframer: _Keyframer
    angles: CuboidAngles
    adjustments: Callable[[LocalizationAdjustment], LocalizationAdjustment | None] | None = None

    @property
    def change(self) -> FrameChange:
        """`new_from_old`."""
        return self.keyframer.change

    def moved(self, annotations: Iterable[Annotation]) -> tuple[Annotation, ...]:
        """Give the annotations in the new frame; those that are known at no time there are left out."""
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


def _moved_cuboid(mover: _AnnotationMover, annotation: CuboidAnnotation) -> CuboidAnnotation | None:
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


def _seen(mover: _AnnotationMover, entry: Any) -> Any:
    """Of an activation or a projection the cuboids, as the sensor's own time has them."""
    return replace(entry, cuboids=mover.seen_rows(entry.timestamps_ns, entry.cuboids))


def _moved_shape(mover: _AnnotationMover, annotation: ShapeAnnotation) -> ShapeAnnotation | None:
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
    vertices = tuple(mover.change.locations(times_ns[k : k + 1], shape[None])[0] for k, shape in enumerate(found))
    return replace(
        annotation,
        path=VertexPath(times_ns, vertices, path.extras),
        stationary=keyframer.stationary(key, was=annotation.stationary),
    )


def _moved_points_annotation(mover: _AnnotationMover, annotation: PointsAnnotation) -> PointsAnnotation | None:
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
        projections=tuple(tuple(_seen_point(mover, entry) for entry in entries) for entries in annotation.projections),
    )


def _moved_point(
    mover: _AnnotationMover, annotation: PointsAnnotation, number: int, path: PointPath, *, stationary: bool
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


def _seen_point(mover: _AnnotationMover, entry: PointProjection) -> PointProjection:
    if entry.positions is None:
        return entry
    return replace(entry, positions=mover.change.locations(entry.timestamps_ns, entry.positions))


_MOVES: Mapping[type, Callable[[_AnnotationMover, Any], Annotation | None]] = MappingProxyType(
    {
        CuboidAnnotation: _moved_cuboid,
        ShapeAnnotation: _moved_shape,
        PointsAnnotation: _moved_points_annotation,
    }
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


def _seen_from(new_from_old: FrameChange, adjustment: LocalizationAdjustment) -> LocalizationAdjustment | None:
    """Give the adjustment of a world that is seen from another one, before and after it.

    A'(t) = new_from_old(t) A(t) old_from_new(t). None where the two are known at no common time.
    """
    led = _led_from(new_from_old, adjustment)
    path = None if led is None else new_from_old.path(led.poses)
    return None if path is None else replace(adjustment, poses=path)


_TO_EGO = "to_ego"
"""Our entry of the metadata that says what bringing a scene onto the ego added, so that it can be taken away again."""


def _annotations_moved(
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
        entry: what is added is written here, as `_added_before` reads it.
    """
    times = _known(change, frames_ns(scene))
    span_ns = (int(times[0]), int(times[-1])) if len(times) else None
    keyframer = _Keyframer(change, span_ns, times, before)
    mover = _AnnotationMover(keyframer, CuboidAngles.of(scene), partial(_led_from, change))
    moved = mover.moved(scene.annotations)
    if entry is not None:
        entry.extend(_entry(path, added) for path, added in keyframer.statistics.added.items())
    left, gone = keyframer.statistics.left_out, len(scene.annotations) - len(moved)
    unplaced = "keyframes at whose time the ego trajectory is not known"
    absent = "annotations at none of whose times the ego trajectory is known"
    warnings = (
        skipped("keyframes-beyond-the-trajectory", "annotations", unplaced, count=left),
        skipped("annotations-beyond-the-trajectory", "annotations", absent, count=gone),
        _annotations_not_moved(scene.annotations),
    )
    return with_warnings(replace(scene, annotations=moved), warnings)


def frames_ns(scene: Scene) -> Int64Array:
    """The times (N,) int64 [ns], ascending, of all sweeps, radar cycles and images of a scene."""
    timestamps = [frame_times(sensor) for sensor in scene.sensors if isinstance(sensor, Posed)]
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


def _added_before(scene: Scene) -> Mapping[_PathKey, _AddedKeyframes]:
    """What bringing the scene onto the ego added, as far as the metadata report it in a form that we know."""
    entries = ours_of(scene).get(_TO_EGO)
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


EGO_ID = "ego"
"""Id of an odometry sensor that is made, if it is free."""


def _odometry_of(scene: Scene, path: Poses) -> OdometrySensor | None:
    """The odometry sensor that reports this very path; None where there is none."""
    for sensor in scene.sensors:
        if isinstance(sensor, OdometrySensor) and same_direction(sensor.poses, path):
            return sensor
    return None


def with_odometry(scene: Scene, path: Poses) -> tuple[Scene, Identifier]:
    """Give the scene with an odometry sensor that reports this path, and the sensor's id."""
    reported = _odometry_of(scene, path)
    if reported is not None:
        return scene, reported.id
    sensor = OdometrySensor(free_id(scene, EGO_ID), path)
    return replace(scene, sensors=(*scene.sensors, sensor)), sensor.id


def free_id(scene: Scene, wanted: str) -> str:
    """The id itself, or with a number where another sensor has it."""
    taken = {sensor.id for sensor in scene.sensors}
    choices = (wanted if number == 1 else f"{wanted}{number}" for number in range(1, len(taken) + 2))
    return next(choice for choice in choices if choice not in taken)


def to_world(
    scene: Scene,
    *,
    trajectory: str | None = None,
    heading: str | None = None,
    annotations_in: Coordinates | str | None = None,
    progress: Progress | None = None,
) -> Scene:
    """Bring points, poses and annotations into the world, each frame and keyframe at its own time.

    A frame moves as a whole: the motion during a sweep is not undone. Frames and keyframes at whose times the ego
    trajectory is not known, nor within one sweep period of it, are left out.

    Args:
        scene: as it is.
        trajectory: name of the ego trajectory, "identity", "lidar" to find it from the sweeps, or None for the default.
        heading: "motion" to derive orientations where the trajectory has positions only.
        annotations_in: "world" or "ego", where the scene does not state in which frame its annotations are.
        progress: reported after each sweep that the trajectory is found from.

    Raises:
        PoseError: the poses that this needs are not known.
        OptionError: a value cannot be followed.
        DataError: a frame that this needs cannot be read.
    """
    stated = _annotations_in(scene, annotations_in)
    needed = trajectory is not None or stated is Coordinates.EGO or _rides_on_ego(scene)
    ego = _found(scene, trajectory, heading, progress) if needed else None
    sensors = partial(_sensor_in_world, scene, ego, anew=trajectory is not None)
    changed = _moved_sensors(_with_trajectory(scene, ego), sensors)
    if stated is Coordinates.EGO and ego is not None:
        changed = _annotations_moved(changed, FrameChange(_trajectory(scene, ego)), _added_before(scene))
    return with_ours(changed, **{ANNOTATIONS_FRAME: Coordinates.WORLD.value, _TO_EGO: None})


def annotations_to_world(scene: Scene, *, trajectory: str | None = None, heading: str | None = None) -> Scene:
    """Bring only the annotations into the world, if the scene says that they are on the ego.

    Arguments and errors as in `to_world`.
    """
    if annotations_frame(scene) is Coordinates.WORLD:
        return scene
    ego = _found(scene, trajectory, heading, None)
    moved = _annotations_moved(scene, FrameChange(_trajectory(scene, ego)), _added_before(scene))
    return with_ours(moved, **{ANNOTATIONS_FRAME: Coordinates.WORLD.value, _TO_EGO: None})


def to_ego(
    scene: Scene,
    *,
    trajectory: str | None = None,
    heading: str | None = None,
    annotations_in: Coordinates | str | None = None,
    progress: Progress | None = None,
) -> Scene:
    """Bring points, poses and annotations onto the ego, each frame and keyframe at its own time.

    An odometry sensor reports where the ego was. Annotations get keyframes at the times of frames at which they would
    otherwise be further than 1 mm or 0.01 degrees off; what is stationary in the world moves on the ego. `to_world`
    takes these away again. Maps stay in the world, as the format has them. Arguments and errors as in `to_world`.
    """
    stated = _annotations_in(scene, annotations_in)
    ego = _found(scene, trajectory, heading, progress)
    changed, odometry_id = with_odometry(_with_trajectory(scene, ego), ego.path)
    changed = _moved_sensors(changed, partial(_sensor_on_ego, scene, ego, odometry_id))
    entry: list[dict[str, Any]] = []
    if stated is Coordinates.WORLD:
        changed = _annotations_moved(changed, FrameChange(None, _trajectory(scene, ego)), {}, entry)
    elif isinstance(ours_of(scene).get(_TO_EGO), list):
        entry = ours_of(scene)[_TO_EGO]
    return with_ours(changed, **{ANNOTATIONS_FRAME: Coordinates.EGO.value, _TO_EGO: entry or None})


def to_sensor(
    scene: Scene,
    *,
    trajectory: str | None = None,
    heading: str | None = None,
    progress: Progress | None = None,
) -> Scene:
    """Bring the points of lidars and radars into the frames of their sensors, each frame at its own time.

    Poses and annotations stay where they are. Arguments and errors as in `to_world`.
    """
    needed = trajectory is not None or bool(scene.trajectories)
    ego = _found(scene, trajectory, heading, progress) if needed else None
    return _moved_sensors(_with_trajectory(scene, ego), partial(_points_in_sensor, scene, ego))


def _rides_on_ego(scene: Scene) -> bool:
    """Whether something has its location on the ego."""
    posed = [s for s in scene.sensors if isinstance(s, Posed)]
    clouds = [s for s in posed if isinstance(s, LidarSensor | RadarSensor)]
    return (
        needs_ego(scene)
        or any(sensor.coordinates is Coordinates.EGO for sensor in posed)
        or any(sensor.points_frame is PointsFrame.EGO for sensor in clouds)
        or any(s.mount is not None and s.points_frame is not PointsFrame.WORLD for s in clouds)
    )


def _found(scene: Scene, trajectory: str | None, heading: str | None, progress: Progress | None) -> EgoMotion:
    return ego_motion_as_given(scene, name=trajectory, heading=heading, progress=progress)


def _with_trajectory(scene: Scene, ego: EgoMotion | None) -> Scene:
    """The scene with the way in it, where it was found from the sweeps, and what is to be stated of it."""
    if ego is None:
        return scene
    if is_computed(scene, ego.name):
        return with_trajectory_estimated(scene, ego)
    return replace(scene, warnings=(*scene.warnings, *ego.warnings))


def _trajectory(scene: Scene, ego: EgoMotion) -> PoseSource:
    return PoseSource(ego.path, RigidTransform.identity(), scene_period_ns(scene))


@dataclass(slots=True)
class _Moves:
    """Moves the points of sensors.

    Attributes:
        frames: the numbers of the frames that stay, by sensor, where some go.
        warnings: what is to be reported.
    """

    frames: dict[Key, Renumbering] = field(default_factory=dict)
    warnings: list[DataWarning] = field(default_factory=list)

    def points(self, sensor: LidarSensor | RadarSensor, change: FrameChange | None, frame: PointsFrame) -> Sensor:
        """Move the points of a sensor; frames at whose times the change is not known are left out."""
        if change is None:
            return replace(sensor, points_frame=frame)
        times_ns, location = sensor.frames.timestamps_ns, f"sensors[{sensor.id}].frames"
        coverage = change.at(times_ns).coverage
        numbers = np.flatnonzero(coverage <= KNOWN)
        known: Any = chosen_frames(sensor.frames, numbers)
        lost, beyond = len(times_ns) - len(numbers), int(np.count_nonzero(coverage[numbers] == KNOWN))
        if lost:
            self.frames[key_of(sensor.id)] = Renumbering(numbers)
        what = "frames at whose time the ego trajectory is not known"
        self.warnings.append(skipped("frames-beyond-the-trajectory", location, what, count=lost))
        what = "frames beyond the ends of the trajectory, placed as if it went on"
        self.warnings.append(assumed("frames-extrapolated", location, what, count=beyond))
        moved: Any = LazyFrames(known.timestamps_ns, partial(_moved_frame, known, change))
        return replace(sensor, frames=moved, points_frame=frame)

    def not_moved(self, sensor: PlainSensor) -> PlainSensor:
        """Report a sensor of an unknown type."""
        what = f"a sensor of type {sensor.type!r}: it is not known what in it has a location; left as it is"
        self.warnings.append(assumed("sensor-not-moved", f"sensors[{sensor.id}]", what))
        return sensor


def _moved_frame(frames: LazyFrames[Any], change: FrameChange, k: int) -> Any:
    """A frame whose points are in another frame; a radar's directions rotate, too."""
    frame, new_from_old = frames[k], change.transform(int(frames.timestamps_ns[k]))
    points: Any = replace(frame.points, positions=_moved_positions(frame.points.positions, new_from_old))
    directions = getattr(points, "directions", None)
    if directions is not None:
        points = replace(points, directions=new_from_old.rotate(directions).astype(np.float32))
    return replace(frame, points=points)


def _moved_positions(positions: Float32Array, new_from_old: RigidTransform) -> Float32Array:
    """Take positions (N, 3) float32 [m] into another frame, computed in float64.

    Raises:
        ArrayError: a point that has coordinates would have none there, as float32 does not reach so far.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        moved = new_from_old.apply(positions).astype(np.float32)
    lost = finite_rows(positions) & ~finite_rows(moved)
    if lost.any():
        row = int(lost.argmax())
        raise ArrayError(
            f"points.positions[{row}]: {positions[row].tolist()} moved by {new_from_old.translation.tolist()}; "
            "expected metres that float32 holds"
        )
    return moved


def _moved_sensors(scene: Scene, move: Callable[[_Moves, Sensor], Sensor]) -> Scene:
    """Move every sensor; labelled points follow their frames."""
    moves = _Moves()
    sensors = tuple(move(moves, sensor) for sensor in scene.sensors)
    annotations, reported = renumbered(scene.annotations, moves.frames)
    moved = replace(scene, sensors=sensors, annotations=annotations)
    return with_warnings(moved, (*moves.warnings, *reported))


def _sensor_in_world(scene: Scene, ego: EgoMotion | None, moves: _Moves, sensor: Sensor, *, anew: bool) -> Sensor:
    reach_ns = scene_period_ns(scene)
    if isinstance(sensor, PlainSensor):
        return moves.not_moved(sensor)
    if not isinstance(sensor, Posed):
        return sensor
    poses = _poses_in_world(scene, sensor, ego, reach_ns=reach_ns, anew=anew)
    placed = replace(sensor, poses=poses, coordinates=Coordinates.WORLD)
    if not isinstance(sensor, LidarSensor | RadarSensor) or not isinstance(placed, LidarSensor | RadarSensor):
        return placed
    change = points_change(scene, sensor, ego, PointsFrame.WORLD, reach_ns=reach_ns)
    return moves.points(placed, change, PointsFrame.WORLD)


def _sensor_on_ego(scene: Scene, ego: EgoMotion, odometry_id: Identifier, moves: _Moves, sensor: Sensor) -> Sensor:
    reach_ns = scene_period_ns(scene)
    if isinstance(sensor, PlainSensor):
        return moves.not_moved(sensor)
    if isinstance(sensor, PointsSensor):
        what = "a map has no time, so it has no location on the ego; it stays in the world"
        moves.warnings.append(assumed("map-in-world", f"sensors[{sensor.id}]", what))
        return sensor
    if not isinstance(sensor, Posed):
        return sensor
    poses, parent_id = _poses_on_ego(sensor, ego, reach_ns=reach_ns), _parent(scene, sensor, odometry_id)
    placed = replace(sensor, poses=poses, coordinates=Coordinates.EGO, parent_id=parent_id)
    if not isinstance(sensor, LidarSensor | RadarSensor) or not isinstance(placed, LidarSensor | RadarSensor):
        return placed
    change = points_change(scene, sensor, ego, PointsFrame.EGO, reach_ns=reach_ns)
    return moves.points(placed, change, PointsFrame.EGO)


def _points_in_sensor(scene: Scene, ego: EgoMotion | None, moves: _Moves, sensor: Sensor) -> Sensor:
    if not isinstance(sensor, LidarSensor | RadarSensor):
        return sensor
    change = points_change(scene, sensor, ego, PointsFrame.SENSOR, reach_ns=scene_period_ns(scene))
    return moves.points(sensor, change, PointsFrame.SENSOR)


def _parent(scene: Scene, sensor: Posed, odometry_id: Identifier) -> Identifier | None:
    """The parent of a sensor on the ego: the odometry, where there are several and it would not be clear.

    Source: READING of "GPSSensor" in docs/CONVENTIONS.md.
    """
    odometries = [key_of(other.id) for other in scene.sensors if isinstance(other, OdometrySensor)]
    if sensor.coordinates is Coordinates.EGO or not set(odometries) - {key_of(odometry_id)}:
        return sensor.parent_id
    if sensor.parent_id is not None and key_of(sensor.parent_id) not in odometries:
        raise OptionError(
            f"{scene.source}: sensor {sensor.id!r} has the parent {sensor.parent_id!r}, and several odometry sensors "
            "could be its ego; leave out all but one with `sceneloom edit crop --without ID`"
        )
    return odometry_id


def _annotations_in(scene: Scene, stated: Coordinates | str | None) -> Coordinates:
    if stated is None:
        return annotations_frame(scene)
    if stated not in tuple(Coordinates):
        raise OptionError(f"annotations in {stated!r}; expected one of {', '.join(Coordinates)}")
    return Coordinates(stated)


def moved_world(scene: Scene, change: FrameChange) -> Scene:
    """Give the scene in a world of which `new_world_from_old` is given, each thing at its own time.

    What rides on the ego or in a sensor stays there; maps move only where the change is the same at all times.

    Raises:
        DataError: a frame with labelled points cannot be read.
    """
    moves = _Moves()
    sensors = tuple(_sensor_in_new_world(moves, change, sensor) for sensor in scene.sensors)
    annotations, reported = renumbered(scene.annotations, moves.frames)
    keyframer = _Keyframer(change, looks_ns=frames_ns(scene))
    if annotations_frame(scene) is Coordinates.WORLD:
        mover = _AnnotationMover(keyframer, CuboidAngles.of(scene), partial(_seen_from, change))
        annotations = mover.moved(annotations)
    found = {name: moved_trajectory(trajectory, change) for name, trajectory in scene.trajectories.items()}
    trajectories = {name: trajectory for name, trajectory in found.items() if trajectory is not None}
    what, left = "keyframes at whose time the new world is not known", keyframer.statistics.left_out
    warnings = (
        *moves.warnings,
        *reported,
        _annotations_not_moved(annotations),
        skipped("keyframes-left-out", "annotations", what, count=left),
    )
    moved = replace(scene, sensors=sensors, annotations=annotations, trajectories=trajectories)
    return with_warnings(moved, warnings)


def _annotations_not_moved(annotations: Iterable[Annotation]) -> DataWarning:
    what = "annotations of unknown types: it is not known what in them has a location; left as they are"
    count = sum(isinstance(annotation, PlainAnnotation) for annotation in annotations)
    return assumed("annotations-not-moved", "annotations", what, count=count)


def moved_trajectory(trajectory: Trajectory, change: FrameChange) -> Trajectory | None:
    """A way in the new world, at those of its own times at which that is known; None where there are none."""
    unturned = np.tile([0.0, 0.0, 0.0, 1.0], (len(trajectory.timestamps_ns), 1))
    rotations = unturned if trajectory.quaternions_xyzw is None else trajectory.quaternions_xyzw
    new = change.poses(trajectory.timestamps_ns, trajectory.positions, rotations)
    known = new.coverage <= KNOWN
    if not known.any():
        return None
    covariances = trajectory.covariances
    if covariances is not None:
        axes = matrix_from_quaternion(change.at(trajectory.timestamps_ns).quaternions_xyzw)
        both = np.zeros((len(axes), 6, 6))
        both[:, :3, :3] = both[:, 3:, 3:] = axes
        covariances = (both @ covariances @ both.transpose(0, 2, 1))[known]
    return Trajectory(
        trajectory.name,
        trajectory.timestamps_ns[known],
        new.positions[known],
        None if trajectory.quaternions_xyzw is None else new.quaternions_xyzw[known],
        None if trajectory.file_seconds is None else trajectory.file_seconds[known],
        covariances,
    )


def _sensor_in_new_world(moves: _Moves, change: FrameChange, sensor: Sensor) -> Sensor:  # noqa: PLR0911 - one a kind
    if isinstance(sensor, PointsSensor):
        if change.is_constant:
            return replace(sensor, positions=_moved_positions(sensor.positions, change.transform(0)))
        what = "a map has no time, and the change is not the same at all times; left as it is"
        moves.warnings.append(assumed("map-not-moved", f"sensors[{sensor.id}]", what))
        return sensor
    if isinstance(sensor, PlainSensor):
        return moves.not_moved(sensor)
    if isinstance(sensor, OdometrySensor):
        return replace(sensor, poses=_moved_path(change, sensor) or sensor.poses)
    if not isinstance(sensor, Posed):
        return sensor
    if sensor.poses is not None and sensor.coordinates is Coordinates.WORLD:
        sensor = replace(sensor, poses=_moved_path(change, sensor))
    if isinstance(sensor, LidarSensor | RadarSensor):
        return moves.points(sensor, change if sensor.points_frame is PointsFrame.WORLD else None, sensor.points_frame)
    return sensor


def _moved_path(change: FrameChange, sensor: Posed | OdometrySensor) -> Poses | None:
    """The poses of a sensor; those of a stationary one at the times of its frames where the change varies."""
    if sensor.poses is None or not sensor.poses.static or change.is_constant:
        return None if sensor.poses is None else change.path(sensor.poses)
    times_ns = np.unique(frame_times(sensor))
    return change.path(sensor.poses, times_ns=times_ns if len(times_ns) else change.knots_ns)


def _poses_in_world(
    scene: Scene, sensor: Posed, ego: EgoMotion | None, *, reach_ns: int, anew: bool = False
) -> Poses | None:
    """Give where a sensor was in the world, at the times of its own poses, else as its frames need it.

    Args:
        scene: the sensor's.
        sensor: which one.
        ego: the ego trajectory, if it is needed.
        reach_ns: how far beyond a path's ends its velocity is continued.
        anew: take the ego trajectory even where the poses of the sensor are in the world.

    Returns:
        The path; None where it is not known.

    Raises:
        PoseError: the sensor's location on the ego is known, and that of the ego is not.
    """
    own = sensor.poses
    if own is not None and sensor.coordinates is Coordinates.WORLD and not (anew and sensor.mount is not None):
        return own
    if own is not None and len(own.timestamps_ns) > 1 and sensor.coordinates is Coordinates.EGO:
        # at its own times, not by a path composed of both: that would end where the shorter of them ends
        trajectory = PoseSource(ego_path(scene, sensor, ego), RigidTransform.identity(), reach_ns)
        return FrameChange(trajectory).path(own)
    try:
        source = sensor_source(scene, sensor, ego, reach_ns=reach_ns)
    except PoseError:
        if own is None:
            return None
        raise
    return _as_needed(source, sensor)


def _as_needed(source: PoseSource, sensor: Posed) -> Poses | None:
    """The poses at the times of a sensor's own, else as its frames need them, else as many as the trajectory has."""
    own, times_ns = sensor.poses, frame_times(sensor)
    if own is not None and len(own.timestamps_ns) > 1:
        return _path_at(source, own.timestamps_ns)
    if len(times_ns) == 0:
        return _path_at(source, source.path.timestamps_ns)
    if isinstance(sensor, CameraSensor | DepthCameraSensor):
        return camera_path(source, shots_of(sensor))
    return sensor_path(source, times_ns)


def _poses_on_ego(sensor: Posed, ego: EgoMotion, *, reach_ns: int) -> Poses | None:
    """Give where a sensor was on the ego, at the times of its own poses; None where it has none there."""
    if sensor.poses is None or sensor.coordinates is Coordinates.EGO:
        return sensor.poses
    ego_from_world = FrameChange(None, PoseSource(ego.path, RigidTransform.identity(), reach_ns))
    times_ns = np.unique(frame_times(sensor)) if sensor.poses.static else None
    if times_ns is not None and len(times_ns) == 0:
        times_ns = ego.path.timestamps_ns
    return ego_from_world.path(sensor.poses, times_ns=times_ns)


def _path_at(source: PoseSource, times_ns: Int64Array) -> Poses | None:
    """Give the poses at those of the times that the source reaches; None where it reaches none."""
    poses = source.at(times_ns)
    known = poses.coverage <= KNOWN
    if not known.any():
        return None
    return Poses(times_ns[known], poses.positions[known], poses.quaternions_xyzw[known])
