"""How many points of each lidar frame lie in each cuboid, and which; activations and attributes from them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array, UInt32Array
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.rotations import conjugate_quaternion, multiply_quaternions, rotate_vectors
from sceneloom.kernels.boxes import find_points_in_boxes
from sceneloom.kernels.poses import transform_by_path
from sceneloom.scene.annotations import (
    Activation,
    Annotation,
    AttributePath,
    CuboidAnnotation,
    LabeledPoints,
    LabeledPointsAnnotation,
)
from sceneloom.scene.annotations_at import Boxes, BoxTable
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.point_times import timed_frame
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.sampling import ALL, WORLD, Choice, choose_ego, chosen_sensors, frame_of_points
from sceneloom.scene.scene import Scene, sweep_period_ns, usual_period_ns
from sceneloom.scene.types import Identifier, Key, Progress, key_of

_KNOT_NS = 10_000_000
"""Boxes that are met point by point are placed so often during a sweep [ns]; between, they go straight."""

_MOST_KNOTS = 101

_FARTHEST = 1e8
"""Boxes farther away, or larger, have no points [m]: no number of theirs means anything."""

_NOTHING = np.zeros(0, np.int64)
_NO_POINTS = np.zeros(0, np.uint32)

_MEASURED = "measured_timestamps_ns"
"""The further array of a deskewed sweep's points that says when each was measured [ns]."""


class Moment(StrEnum):
    """When boxes and sensor are taken to be where they are."""

    FRAME = "frame"
    """At the frame's timestamp: right for sweeps that were deskewed to it."""
    POINTS = "points"
    """At each point's own time: right for sweeps as measured, and for deskewed ones in the world."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameCounts:
    """The points of one lidar in the cuboids.

    Attributes:
        lidar_id: the lidar.
        timestamps_ns: (F,) int64 [ns], of its frames.
        counts: (F, A) int64, points in each cuboid; 0 where it is not there.
        there: (F, A) bool, whether the cuboid is there and it is known where the frame's points are.
        point_ids: of each frame the rows (N,) uint32 of the points in a cuboid, by its number among the A, where there
            are any; None where they were not asked for.
    """

    lidar_id: Identifier
    timestamps_ns: Int64Array
    counts: Int64Array
    there: BoolArray
    point_ids: Sequence[Mapping[int, UInt32Array]] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PointCounts:
    """The points in the cuboids of a scene.

    Attributes:
        annotation_ids: A ids of the cuboids that have a path, in the order of the scene.
        lidars: one entry per lidar.
        unplaced: frames that were not counted, because it is not known where their sensor was.
    """

    annotation_ids: tuple[Identifier, ...]
    lidars: tuple[FrameCounts, ...]
    unplaced: int = 0


@np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
def count_points(
    scene: Scene,
    *,
    lidars: Choice = ALL,
    moment: Moment | str = Moment.FRAME,
    trajectory: str | EgoMotion | None = None,
    listed: bool = False,
    margin: float = 0.0,
    activations: bool = True,
    progress: Progress | None = None,
) -> PointCounts:
    """Count the points of each lidar frame in each cuboid; a point on a face counts, and in every cuboid it is in.

    Frames are read one after the other and not kept.

    Args:
        scene: with cuboids in its world.
        lidars: whose frames: "all", an id, or several.
        moment: when the boxes and the sensor are taken to be where they are.
        trajectory: name of the ego trajectory, as for `Scene.samples`.
        listed: also list the points.
        margin: how far outside its faces a cuboid still has points [m].
        activations: count cuboids whose activations name a lidar only while they are active for it, by its own
            computed cuboids; False: by their paths alone, as to find activations anew.
        progress: reported after each frame how many are done, and of how many.

    Raises:
        OptionError: there is no such lidar, trajectory or moment, no lidar at all, or the margin is negative.
        PoseError: it is not known where a lidar's points are in the world.
        DataError: a frame cannot be read.
    """
    if moment not in tuple(Moment):
        raise OptionError(f"moment {str(moment)!r}; expected one of {', '.join(Moment)}")
    if not 0.0 <= margin < _FARTHEST:
        raise OptionError(f"margin {margin} m; expected a number from 0 on")
    scene = scene.corrected()
    chosen = chosen_sensors(scene, "lidar", scene.lidars, lidars)
    if not scene.lidars:
        raise OptionError(f"{scene.source}: has no lidar whose points could be counted")
    table, ego = BoxTable(scene), choose_ego(scene, trajectory)
    found: list[FrameCounts] = []
    total, done, unplaced = sum(len(lidar.frames) for lidar in chosen), 0, 0
    for lidar in chosen:
        counter = _Counter(
            table, lidar, points_position(scene, lidar, ego), Moment(moment), margin, listed, activations
        )
        rows: list[_Row | None] = []
        for frame in lidar.frames:
            rows.append(counter.count(frame))
            done += 1
            if progress is not None:
                progress(done, total)
        unplaced += sum(row is None for row in rows)
        found.append(_gathered(lidar, len(table.annotations), rows, listed=listed))
    return PointCounts(tuple(annotation.id for annotation in table.annotations), tuple(found), unplaced)


@dataclass(frozen=True, slots=True, eq=False)
class _Row:
    """What was counted in one frame: of the cuboids `there` (B,) how many points (B,), and which."""

    there: Int64Array
    counts: Int64Array
    point_ids: tuple[UInt32Array, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _Moving:
    """Boxes at K knots, as the kernel takes them, and where among the knots each point was measured."""

    centers: Float64Array
    rotations: Float64Array
    halves: Float64Array
    locations: Float64Array

    @classmethod
    def of(cls, boxes: Sequence[Boxes], locations: Float64Array, margin: float) -> "_Moving":
        sizes = np.stack([each.sizes_lwh for each in boxes])
        return cls(
            np.stack([each.centers_world for each in boxes]),
            np.stack([each.rotations_world for each in boxes]),
            np.where(sizes >= 0.0, sizes / 2.0 + margin, np.nan),
            locations,
        )

    @property
    def usable(self) -> Int64Array:
        """Rows of the boxes that have a size, and whose numbers are numbers and of this world."""
        finite = (np.abs(self.centers) < _FARTHEST).all(axis=(0, 2)) & (np.abs(self.halves) < _FARTHEST).all(
            axis=(0, 2)
        )
        return np.flatnonzero(finite & np.isfinite(self.rotations).all(axis=(0, 2, 3)))

    def count(self, points: FloatArray, *, listed: bool) -> tuple[Int64Array, tuple[UInt32Array, ...]]:
        """Count the points in each box, and list them."""
        rows = self.usable
        counts = np.zeros(self.centers.shape[1], np.int64)
        if len(rows) == 0:
            return counts, (_NO_POINTS,) * len(counts) if listed else ()
        cloud, locations = np.ascontiguousarray(points), self.locations
        centers, rotations = self.centers[:, rows].copy(), self.rotations[:, rows].copy()
        halves, found = self.halves[:, rows].copy(), np.zeros(len(rows), np.int64)
        find_points_in_boxes(cloud, locations, centers, rotations, halves, found, _NOTHING)
        counts[rows] = found
        if not listed:
            return counts, ()
        stops, ids = np.cumsum(found) - found, np.empty(int(found.sum()), np.int64)
        if len(ids):
            find_points_in_boxes(cloud, locations, centers, rotations, halves, stops, ids)
        lists = [_NO_POINTS] * len(counts)
        for row, part in zip(rows.tolist(), np.split(ids.astype(np.uint32), np.cumsum(found)[:-1]), strict=True):
            lists[row] = part
        return counts, tuple(lists)


@dataclass(frozen=True, slots=True, eq=False)
class _Counter:
    """Counts the points of one lidar's frames; `location` takes its points as stored into the world."""

    table: BoxTable
    lidar: LidarSensor
    location: PoseSource
    moment: Moment
    margin: float
    listed: bool
    activations: bool

    @property
    def _query(self) -> Identifier | None:
        """The sensor by whose activations boxes are there; None for none."""
        return self.lidar.id if self.activations else None

    def _find(self, frame: LidarFrame, time_ns: int) -> tuple[Int64Array, Boxes]:
        """The boxes at a time that are active at any time of a frame."""
        times = frame.points.timestamps_ns
        last_ns = frame.timestamp_ns if times is None or not len(times) else int(times.max())
        return self.table.find(time_ns, sensor_id=self._query, window_ns=(frame.timestamp_ns, last_ns))

    def count(self, frame: LidarFrame) -> _Row | None:
        """Count in one frame; None where it is not known where its points are."""
        if self.moment is Moment.POINTS:
            timed = timed_frame(frame, sweep_period_ns(self.lidar)).frame
            if timed.points.timestamps_ns is not None and len(timed.points):
                return self._at_points(timed)
        return self._at_frame(frame)

    def _at_frame(self, frame: LidarFrame) -> _Row | None:
        """Take the boxes into the frame of the points: there are fewer of them."""
        there, boxes = self._find(frame, frame.timestamp_ns)
        pose = self.location.at(np.array([frame.timestamp_ns], np.int64))
        position, rotation = pose.positions[0], pose.quaternions_xyzw[0]
        if not np.isfinite(position).all():
            return None
        back = conjugate_quaternion(rotation)
        moved = replace(
            boxes,
            centers_world=rotate_vectors(back, boxes.centers_world - position),
            quaternions_xyzw=multiply_quaternions(back, boxes.quaternions_xyzw),
        )
        return self._row(there, _Moving.of([moved], np.zeros(0), self.margin), frame.points.positions)

    def _at_points(self, frame: LidarFrame) -> _Row | None:
        """Take each point into the world at its own time, and the boxes to the times of the points."""
        points = frame.points
        times = np.asarray(points.timestamps_ns, np.int64)
        positions = points_in_world(self.location, points.positions, times)
        if positions is None:
            return None
        measured = points.extras.get(_MEASURED, times)
        first, last = int(measured.min()), int(measured.max())
        count = min(max(-(-(last - first) // _KNOT_NS) + 1, 2), _MOST_KNOTS)
        knots = np.rint(np.linspace(first, last, count)).astype(np.int64)
        there, _ = self._find(frame, int(np.median(measured)))
        boxes = [self.table.placed(there, int(knot), sensor_id=self._query) for knot in knots]
        locations = (measured - first) * ((count - 1) / max(last - first, 1))
        return self._row(there, _Moving.of(boxes, locations, self.margin), positions)

    def _row(self, there: Int64Array, boxes: _Moving, points: FloatArray) -> _Row:
        return _Row(there, *boxes.count(points, listed=self.listed))


def points_in_world(location: PoseSource, positions: Float32Array, timestamps_ns: Int64Array) -> FloatArray | None:
    """Take points (N, 3) [m] into the world, each at its own time (N,) [ns].

    None where the trajectory does not reach so far.

    Args:
        location: takes the points as stored into the world; those that are there already stay as they are.
    """
    if location is WORLD or len(positions) == 0:
        return positions
    path, reach_ns = location.path, location.reach_ns
    first, last = int(timestamps_ns.min()), int(timestamps_ns.max())
    if not path.static and (first < path.start_ns - reach_ns or last > path.stop_ns + reach_ns):
        return None
    world = np.empty(positions.shape)
    transform_by_path(
        np.ascontiguousarray(positions), timestamps_ns, np.ascontiguousarray(location.mount.matrix[:3]),
        path.timestamps_ns, path.positions, path.quaternions_xyzw, world,
    )  # fmt: skip
    return world


def points_position(scene: Scene, lidar: LidarSensor, ego: EgoMotion | None) -> PoseSource:
    """Give what takes a lidar's points as stored into the world.

    Raises:
        PoseError: it is not known.
    """
    location = frame_of_points(scene, lidar, ego)
    if location.source is None:
        raise PoseError(
            f"{scene.source}: it is not known where the points of lidar {lidar.id!r} are in the world; it needs poses "
            "of its own, or a mounting on the ego and a trajectory with orientations"
        )
    return location.source


def _gathered(lidar: LidarSensor, count: int, rows: Sequence[_Row | None], *, listed: bool) -> FrameCounts:
    counts, there = np.zeros((len(rows), count), np.int64), np.zeros((len(rows), count), np.bool_)
    lists: list[Mapping[int, UInt32Array]] = []
    for k, row in enumerate(rows):
        lists.append({})
        if row is not None:
            counts[k, row.there], there[k, row.there] = row.counts, True
            lists[k] = {b: ids for b, ids in zip(row.there.tolist(), row.point_ids, strict=False) if len(ids)}
    return FrameCounts(lidar.id, lidar.frames.timestamps_ns, counts, there, lists if listed else None)


def activation_of(
    sensor_id: Identifier,
    timestamps_ns: Int64Array,
    seen: BoolArray,
    cuboids: Float64Array | None = None,
) -> Activation | None:
    """Give the times in which a sensor sees a cuboid; None where it never does.

    Each begins with a frame that sees it, and lasts until the next frame that does not; after the last frame of all, as
    long as it usually is from frame to frame.

    Args:
        sensor_id: the sensor.
        timestamps_ns: (F,) int64 [ns], its frames in order.
        seen: (F,) bool, which of them see the cuboid.
        cuboids: (F, 9) float64, the cuboid at each frame, to be reported where each time begins.
    """
    steps = np.diff(np.concatenate([[False], seen, [False]]).astype(np.int8))
    first, beyond = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)
    if len(first) == 0:
        return None
    end_ns = min(int(timestamps_ns[-1]) + int(usual_period_ns(timestamps_ns)), 2**63 - 1)
    stops = np.append(timestamps_ns, np.int64(end_ns))[beyond]
    return Activation(
        sensor_id,
        timestamps_ns[first],
        tuple((stops - timestamps_ns[first]).view(np.uint64).tolist()),  # which holds any difference
        None if cuboids is None else cuboids[first],
    )


_POINTS = "points"
"""Name of the attribute that holds the counts."""


def with_attributes(
    annotation: CuboidAnnotation,
    attributes: Iterable[AttributePath],
    *,
    names: Iterable[str],
    sensor_ids: Iterable[Identifier],
) -> CuboidAnnotation:
    """Give a cuboid new attributes instead of all of these names that it had of these sensors."""
    reported, sensors = set(names), {key_of(sensor_id) for sensor_id in sensor_ids}
    kept = [
        path
        for path in annotation.attributes
        if path.name not in reported or path.sensor_id is None or key_of(path.sensor_id) not in sensors
    ]
    return replace(annotation, attributes=(*kept, *attributes))


def with_counts(scene: Scene, counts: PointCounts) -> Scene:
    """Report in an attribute `points` of each cuboid, per lidar.

    How many points it holds at each frame while it is there.

    Args:
        scene: the scene, or one with the same cuboids.
        counts: what `count_points` found.
    """
    rows = {key_of(identifier): row for row, identifier in enumerate(counts.annotation_ids)}
    return replace(scene, annotations=tuple(_counted(each, rows, counts) for each in scene.annotations))


def _counted(annotation: Annotation, rows: dict[Key, int], counts: PointCounts) -> Annotation:
    row = rows.get(key_of(annotation.id))
    if not isinstance(annotation, CuboidAnnotation) or row is None:
        return annotation
    reported = [path for lidar in counts.lidars if (path := _attribute(lidar, row)) is not None]
    sensor_ids = [lidar.lidar_id for lidar in counts.lidars]
    return with_attributes(annotation, reported, names=[_POINTS], sensor_ids=sensor_ids)


def _attribute(lidar: FrameCounts, row: int) -> AttributePath | None:
    frames = np.flatnonzero(lidar.there[:, row])
    if len(frames) == 0:
        return None
    values = tuple(lidar.counts[frames, row].tolist())
    return AttributePath(_POINTS, values, lidar.timestamps_ns[frames], sensor_id=lidar.lidar_id)


def with_activations(scene: Scene, counts: PointCounts, *, min_points: int = 1) -> Scene:
    """Report when each lidar sees each cuboid: while frame after frame has points of it.

    Replaces what was reported them.

    Args:
        scene: the scene, or one with the same cuboids.
        counts: what `count_points` found.
        min_points: fewer points in a frame are not seen.
    """
    rows = {key_of(identifier): row for row, identifier in enumerate(counts.annotation_ids)}
    keys = {key_of(lidar.lidar_id) for lidar in counts.lidars}
    annotations: list[Annotation] = []
    for each in scene.annotations:
        row = rows.get(key_of(each.id))
        if isinstance(each, CuboidAnnotation) and row is not None:
            kept = [reported for reported in each.activations if key_of(reported.sensor_id) not in keys]
            made = [
                activation_of(lidar.lidar_id, lidar.timestamps_ns, lidar.counts[:, row] >= min_points)
                for lidar in counts.lidars
            ]
            annotations.append(
                replace(each, activations=(*kept, *(reported for reported in made if reported is not None)))
            )
        else:
            annotations.append(each)
    return replace(scene, annotations=tuple(annotations))


def with_labeled_points(scene: Scene, counts: PointCounts) -> Scene:
    """Add an annotation of labelled points for each cuboid that holds any; the cuboid is its parent.

    Its id is that of the cuboid with ":points" behind it; an annotation of that id is replaced if it is one of these.

    Args:
        scene: the scene, or one with the same cuboids and frames.
        counts: what `count_points` found, the points listed.

    Raises:
        OptionError: the points were not listed, or another annotation has such an id.
    """
    if any(lidar.point_ids is None for lidar in counts.lidars):
        raise OptionError("the points in the cuboids were counted, not listed; count with `listed=True`")
    cuboids = {key_of(each.id): each for each in scene.annotations if isinstance(each, CuboidAnnotation)}
    made = [
        _labelled(cuboids[key_of(identifier)], entries)
        for row, identifier in enumerate(counts.annotation_ids)
        if (entries := _entries(counts.lidars, row))
    ]
    ids = {each.id for each in made}
    kept = [each for each in scene.annotations if each.id not in ids or not _is_ours(each)]
    return replace(scene, annotations=(*kept, *made))


def _is_ours(annotation: Annotation) -> bool:
    return isinstance(annotation, LabeledPointsAnnotation) and annotation.id == _points_id(annotation.parent_id)


def _points_id(identifier: Identifier | None) -> str:
    return f"{identifier}:{_POINTS}"


def _labelled(cuboid: CuboidAnnotation, entries: tuple[LabeledPoints, ...]) -> LabeledPointsAnnotation:
    return LabeledPointsAnnotation(
        _points_id(cuboid.id), entries, label=cuboid.label, is_instance=True, parent_id=cuboid.id
    )


def _entries(lidars: Sequence[FrameCounts], row: int) -> tuple[LabeledPoints, ...]:
    return tuple(
        LabeledPoints(lidar.lidar_id, lists[row], sensor_frame=k)
        for lidar in lidars
        for k, lists in enumerate(lidar.point_ids or ())
        if row in lists
    )
