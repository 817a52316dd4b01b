"""How many points of each lidar frame lie in each cuboid, and which; activations and attributes from them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array, UInt32Array
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.rigid import conjugate_quaternion, multiply_quaternions, rotate_vectors
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
from sceneloom.scene.samples import ALL, WORLD, Choice, choose_ego, chosen_sensors, frame_of_points
from sceneloom.scene.scene import Scene, sweep_period_ns, usual_period_ns
from sceneloom.scene.types import Identifier, Progress, key_of

_KNOT_NS = 10_000_000
"""With times of points, boxes are placed this often during a sweep [ns]; between, they move linearly."""

_MOST_KNOTS = 101
_FARTHEST = 1e8  # boxes farther away, or larger, have no points [m]: their numbers are meaningless
_NOTHING = np.zeros(0, np.int64)
_NO_POINTS = np.zeros(0, np.uint32)

_MEASURED = "measured_timestamps_ns"
"""The additional array of a deskewed sweep's points with the time when each was measured [ns]."""

_POINTS = "points"  # name of the attribute that holds the counts


class Moment(StrEnum):
    """The time at which boxes and sensor are placed."""

    FRAME = "frame"
    """The frame's timestamp: right for sweeps that were deskewed to it."""
    POINTS = "points"
    """Each point's own time: right for sweeps as measured, and for deskewed ones in the world."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameCounts:
    """The points of one lidar in the cuboids.

    Attributes:
        lidar_id: the lidar.
        timestamps_ns: (F,) int64 [ns], of its frames.
        counts: (F, A) int64, points in each cuboid; 0 where it is not there.
        there: (F, A) bool, whether the cuboid is there and the pose of the frame's points is known.
        point_ids: for each frame the rows (N,) uint32 of the points in a cuboid, by its number among the A, where there
            are any; None where not listed.
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
        unplaced: frames that were not counted, because the pose of their sensor is unknown.
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
        moment: the time at which boxes and sensor are placed.
        trajectory: name of the ego trajectory, as for `Scene.samples`.
        listed: also list the points.
        margin: how far outside its faces a cuboid still has points [m].
        activations: count cuboids whose activations name a lidar only while they are active for it, by its own
            computed cuboids; False: by their paths alone, as to compute activations anew.
        progress: called after each frame with how many are done, and of how many.

    Raises:
        OptionError: there is no such lidar, trajectory or moment, no lidar at all, or the margin is negative.
        PoseError: the pose of a lidar's points in the world is unknown.
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
        source = points_position(scene, lidar, ego)
        counter = _Counter(table, lidar, source, Moment(moment), margin, listed, lidar.id if activations else None)
        shape = len(lidar.frames), len(table.annotations)
        counts, there = np.zeros(shape, np.int64), np.zeros(shape, np.bool_)
        lists: list[Mapping[int, UInt32Array]] = []
        for k, frame in enumerate(lidar.frames):
            counted = counter.count(frame)
            lists.append({})
            if counted is None:
                unplaced += 1
            else:
                rows, counts[k, counted[0]], point_ids = counted
                there[k, rows] = True
                lists[k] = {row: ids for row, ids in zip(rows.tolist(), point_ids, strict=False) if len(ids)}
            done += 1
            if progress is not None:
                progress(done, total)
        found.append(FrameCounts(lidar.id, lidar.frames.timestamps_ns, counts, there, lists if listed else None))
    return PointCounts(tuple(annotation.id for annotation in table.annotations), tuple(found), unplaced)


_Counted = tuple[Int64Array, Int64Array, Sequence[UInt32Array]]
"""Of one frame: rows of the cuboids that are there (B,), how many points each has (B,), and which."""


@dataclass(frozen=True, slots=True, eq=False)
class _Counter:
    """Counts the points of one lidar's frames."""

    table: BoxTable
    lidar: LidarSensor
    source: PoseSource  # transforms its points as stored into the world
    moment: Moment
    margin: float
    listed: bool
    sensor_id: Identifier | None  # the sensor by whose activations boxes are there; None for none

    def count(self, frame: LidarFrame) -> _Counted | None:
        """Count in one frame; None where the pose of its points is unknown."""
        if self.moment is Moment.POINTS:
            timed = timed_frame(frame, sweep_period_ns(self.lidar)).frame
            if timed.points.timestamps_ns is not None and len(timed.points):
                return self._at_points(timed, np.asarray(timed.points.timestamps_ns, np.int64))
        return self._at_frame(frame)

    def _at_frame(self, frame: LidarFrame) -> _Counted | None:
        """Transform the boxes into the frame of the points: there are fewer of them."""
        rows, boxes = self._find(frame, frame.timestamp_ns)
        pose = self.source.at(np.array([frame.timestamp_ns], np.int64))
        position, rotation = pose.positions[0], pose.quaternions_xyzw[0]
        if not np.isfinite(position).all():
            return None
        back = conjugate_quaternion(rotation)
        moved = replace(
            boxes,
            centers_world=rotate_vectors(back, boxes.centers_world - position),
            quaternions_xyzw=multiply_quaternions(back, boxes.quaternions_xyzw),
        )
        return rows, *self._inside([moved], np.zeros(0), frame.points.positions)

    def _at_points(self, frame: LidarFrame, times: Int64Array) -> _Counted | None:
        """Transform each point into the world at its own time, and the boxes to the times of the points."""
        positions = points_in_world(self.source, frame.points.positions, times)
        if positions is None:
            return None
        measured = frame.points.extras.get(_MEASURED, times)
        first, last = int(measured.min()), int(measured.max())
        count = min(max(-(-(last - first) // _KNOT_NS) + 1, 2), _MOST_KNOTS)
        knots = np.rint(np.linspace(first, last, count)).astype(np.int64)
        rows, _ = self._find(frame, int(np.median(measured)))
        boxes = [self.table.placed(rows, int(knot), sensor_id=self.sensor_id) for knot in knots]
        locations = (measured - first) * ((count - 1) / max(last - first, 1))
        return rows, *self._inside(boxes, locations, positions)

    def _find(self, frame: LidarFrame, time_ns: int) -> tuple[Int64Array, Boxes]:
        """The boxes at a time that are active at any time of a frame."""
        times = frame.points.timestamps_ns
        last_ns = frame.timestamp_ns if times is None or not len(times) else int(times.max())
        return self.table.find(time_ns, sensor_id=self.sensor_id, window_ns=(frame.timestamp_ns, last_ns))

    def _inside(
        self, boxes: Sequence[Boxes], locations: Float64Array, points: FloatArray
    ) -> tuple[Int64Array, Sequence[UInt32Array]]:
        """Count the points in each of B boxes at K knots, and list them; `locations` of the points among the knots."""
        centers = np.stack([each.centers_world for each in boxes])
        rotations = np.stack([each.rotations_world for each in boxes])
        sizes = np.stack([each.sizes_lwh for each in boxes])
        halves = np.where(sizes >= 0.0, sizes / 2.0 + self.margin, np.nan)
        # boxes that have a size, and whose numbers are finite and plausible
        usable = ((np.abs(centers) < _FARTHEST) & (np.abs(halves) < _FARTHEST)).all(axis=(0, 2))
        rows = np.flatnonzero(usable & np.isfinite(rotations).all(axis=(0, 2, 3)))
        counts, lists = np.zeros(centers.shape[1], np.int64), [_NO_POINTS] * centers.shape[1]
        if len(rows) == 0:
            return counts, lists
        found, cloud = np.zeros(len(rows), np.int64), np.ascontiguousarray(points)
        moving = locations, centers[:, rows].copy(), rotations[:, rows].copy(), halves[:, rows].copy()
        find_points_in_boxes(cloud, *moving, found, _NOTHING)
        counts[rows] = found
        if self.listed:
            stops, ids = np.cumsum(found) - found, np.empty(int(found.sum()), np.int64)
            if len(ids):
                find_points_in_boxes(cloud, *moving, stops, ids)
            for row, part in zip(rows.tolist(), np.split(ids.astype(np.uint32), np.cumsum(found)[:-1]), strict=True):
                lists[row] = part
        return counts, lists


def points_in_world(source: PoseSource, positions: Float32Array, timestamps_ns: Int64Array) -> FloatArray | None:
    """Transform points (N, 3) [m] into the world, each at its own time (N,) [ns]; None beyond the trajectory.

    Args:
        source: transforms the points as stored into the world; those that are there already stay as they are.
    """
    if source is WORLD or len(positions) == 0:
        return positions
    path, reach_ns = source.path, source.reach_ns
    first, last = int(timestamps_ns.min()), int(timestamps_ns.max())
    if not path.static and (first < path.start_ns - reach_ns or last > path.stop_ns + reach_ns):
        return None
    world = np.empty(positions.shape)
    transform_by_path(
        np.ascontiguousarray(positions), timestamps_ns, np.ascontiguousarray(source.mount.matrix[:3]),
        path.timestamps_ns, path.positions, path.quaternions_xyzw, world,
    )  # fmt: skip
    return world


def points_position(scene: Scene, lidar: LidarSensor, ego: EgoMotion | None) -> PoseSource:
    """The poses that transform a lidar's points as stored into the world.

    Raises:
        PoseError: they are unknown.
    """
    location = frame_of_points(scene, lidar, ego)
    if location.source is None:
        raise PoseError(
            f"{scene.source}: the pose of the points of lidar {lidar.id!r} in the world is unknown; it needs poses "
            "of its own, or a mounting on the ego and a trajectory with orientations"
        )
    return location.source


def activation_of(
    sensor_id: Identifier, timestamps_ns: Int64Array, seen: BoolArray, cuboids: Float64Array | None = None
) -> Activation | None:
    """The times in which a sensor sees a cuboid; None where it never does.

    Each begins with a frame that sees it, and lasts until the next frame that does not; after the last frame of all, as
    long as the usual period of the frames.

    Args:
        sensor_id: the sensor.
        timestamps_ns: (F,) int64 [ns], its frames in order.
        seen: (F,) bool, which of them see the cuboid.
        cuboids: (F, 9) float64, the cuboid at each frame, to be included where each time begins.
    """
    steps = np.diff(np.concatenate([[False], seen, [False]]).astype(np.int8))
    first, beyond = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)
    if len(first) == 0:
        return None
    end_ns = min(int(timestamps_ns[-1]) + int(usual_period_ns(timestamps_ns)), 2**63 - 1)
    stops = np.append(timestamps_ns, np.int64(end_ns))[beyond]
    durations = tuple((stops - timestamps_ns[first]).view(np.uint64).tolist())  # uint64 holds any difference
    return Activation(sensor_id, timestamps_ns[first], durations, None if cuboids is None else cuboids[first])


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


def _with_changed(scene: Scene, counts: PointCounts, change: Callable[[CuboidAnnotation, int], Annotation]) -> Scene:
    """The scene with each counted cuboid changed; `change` gets its number among the counts."""
    rows = {key_of(identifier): row for row, identifier in enumerate(counts.annotation_ids)}

    def changed(annotation: Annotation) -> Annotation:
        row = rows.get(key_of(annotation.id))
        return change(annotation, row) if isinstance(annotation, CuboidAnnotation) and row is not None else annotation

    return replace(scene, annotations=tuple(map(changed, scene.annotations)))


def with_counts(scene: Scene, counts: PointCounts) -> Scene:
    """Set an attribute `points` of each cuboid, per lidar: how many points it holds at each frame while it is there.

    Args:
        scene: the scene, or one with the same cuboids.
        counts: the result of `count_points`.
    """
    sensor_ids = [lidar.lidar_id for lidar in counts.lidars]

    def change(cuboid: CuboidAnnotation, row: int) -> CuboidAnnotation:
        paths = []
        for lidar in counts.lidars:
            frames = np.flatnonzero(lidar.there[:, row])
            if len(frames):
                values, times = tuple(lidar.counts[frames, row].tolist()), lidar.timestamps_ns[frames]
                paths.append(AttributePath(_POINTS, values, times, sensor_id=lidar.lidar_id))
        return with_attributes(cuboid, paths, names=[_POINTS], sensor_ids=sensor_ids)

    return _with_changed(scene, counts, change)


def with_activations(scene: Scene, counts: PointCounts, *, min_points: int = 1) -> Scene:
    """Set when each lidar sees each cuboid: while frame after frame has points of it; older activations are replaced.

    Args:
        scene: the scene, or one with the same cuboids.
        counts: the result of `count_points`.
        min_points: a frame with fewer points does not see it.
    """
    keys = {key_of(lidar.lidar_id) for lidar in counts.lidars}

    def change(cuboid: CuboidAnnotation, row: int) -> CuboidAnnotation:
        kept = [activation for activation in cuboid.activations if key_of(activation.sensor_id) not in keys]
        found = [
            activation_of(lidar.lidar_id, lidar.timestamps_ns, lidar.counts[:, row] >= min_points)
            for lidar in counts.lidars
        ]
        return replace(cuboid, activations=(*kept, *(activation for activation in found if activation is not None)))

    return _with_changed(scene, counts, change)


def with_labeled_points(scene: Scene, counts: PointCounts) -> Scene:
    """Add an annotation of labelled points for each cuboid that holds any; the cuboid is its parent.

    Its id is that of the cuboid followed by ":points"; an annotation of that id is replaced if it is one of these.

    Args:
        scene: the scene, or one with the same cuboids and frames.
        counts: the result of `count_points`, with the points listed.

    Raises:
        OptionError: the points were not listed, or another annotation has such an id.
    """
    if any(lidar.point_ids is None for lidar in counts.lidars):
        raise OptionError("the points in the cuboids were counted, not listed; count with `listed=True`")
    cuboids = {key_of(each.id): each for each in scene.annotations if isinstance(each, CuboidAnnotation)}
    made = {}
    for row, identifier in enumerate(counts.annotation_ids):
        entries = tuple(
            LabeledPoints(lidar.lidar_id, lists[row], sensor_frame=k)
            for lidar in counts.lidars
            for k, lists in enumerate(lidar.point_ids or ())
            if row in lists
        )
        if entries:
            cuboid = cuboids[key_of(identifier)]
            own = f"{cuboid.id}:{_POINTS}"
            made[own] = LabeledPointsAnnotation(own, entries, label=cuboid.label, is_instance=True, parent_id=cuboid.id)
    kept = [
        each
        for each in scene.annotations
        if each.id not in made
        or not (isinstance(each, LabeledPointsAnnotation) and each.id == f"{each.parent_id}:{_POINTS}")
    ]
    return replace(scene, annotations=(*kept, *made.values()))
