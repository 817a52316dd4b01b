"""A time range of a scene: its frames, the poses around it, its annotations, and renumbered labelled points."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from sceneloom.arrays import BoolArray, Int64Array, UInt32Array
from sceneloom.errors import OptionError
from sceneloom.scene.annotations import (
    Activation,
    Annotation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CameraCalibration,
    CuboidAnnotation,
    CuboidPath,
    EventAnnotation,
    LabeledPoints,
    LabeledPointsAnnotation,
    LinkAnnotation,
    LocalizationAdjustment,
    PlainAnnotation,
    PointPath,
    PointProjection,
    PointsAnnotation,
    Projection,
    ShapeAnnotation,
    VertexPath,
)
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, chosen_shots
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, VectorSamples
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene, frame_times, time_span
from sceneloom.scene.types import Key, key_of
from sceneloom.warnings import DataWarning, WarningKind

_Rows = Callable[[int | None], Int64Array | None]
"""Gives the rows of the points that stay of a frame (by its old number), or of a sensor without frames (None); or
None where all of them stay."""


@dataclass(frozen=True, slots=True, eq=False)
class Renumbering:
    """What becomes of the points of one sensor.

    Attributes:
        frames: old numbers of the frames that stay, ascending; None where all of them stay.
        rows: which points of a frame stay; None where all of them do.
    """

    frames: Int64Array | None = None
    rows: _Rows | None = None


@dataclass(slots=True)
class _Statistics:
    points: int = 0
    frames: int = 0
    unplaced: int = 0
    annotations: int = 0


def renumbered(
    annotations: Iterable[Annotation], renumberings: Mapping[Key, Renumbering]
) -> tuple[tuple[Annotation, ...], tuple[DataWarning, ...]]:
    """Give annotations whose labelled points follow their sensors; one without points goes.

    Frames with labelled points are read now, all others when they are asked for.

    Args:
        annotations: of any kind.
        renumberings: by sensor; sensors that are not named stay as they are.

    Raises:
        DataError: a frame with labelled points cannot be read.
    """
    statistics = _Statistics()
    known = tuple(annotations)
    moved = _moved_entries(known, renumberings, statistics)
    found = [
        _with_entries(annotation, [moved[row, k] for k in range(len(annotation.labeled_points))], statistics)
        if isinstance(annotation, LabeledPointsAnnotation)
        else annotation
        for row, annotation in enumerate(known)
    ]
    return tuple(annotation for annotation in found if annotation is not None), _reported(statistics)


def _moved_entries(
    annotations: tuple[Annotation, ...], renumberings: Mapping[Key, Renumbering], statistics: _Statistics
) -> dict[tuple[int, int], LabeledPoints | None]:
    """What becomes of each entry, by its annotation's number and its own; frame by frame, so that each is read once."""
    entries = [
        (row, k, entry)
        for row, annotation in enumerate(annotations)
        if isinstance(annotation, LabeledPointsAnnotation)
        for k, entry in enumerate(annotation.labeled_points)
    ]
    by_frame = sorted(entries, key=lambda found: _frame_of(found[2]))
    latest = _Latest()
    return {
        (row, k): _entry(entry, renumberings.get(key_of(entry.sensor_id)), latest, statistics)
        for row, k, entry in by_frame
    }


def _frame_of(entry: LabeledPoints) -> tuple[str, str, int]:
    number = -1 if entry.sensor_frame is None else entry.sensor_frame
    return type(entry.sensor_id).__name__, str(entry.sensor_id), number


@dataclass(slots=True)
class _Latest:
    """The rows that were asked for last: many annotations have points in one frame."""

    asked: tuple[Renumbering, int | None] | None = None
    found: Int64Array | None = None

    def rows(self, change: Renumbering, number: int | None) -> Int64Array | None:
        if change.rows is None:
            return None
        if self.asked != (change, number):
            self.asked, self.found = (change, number), change.rows(number)
        return self.found


def _with_entries(
    annotation: LabeledPointsAnnotation, entries: Iterable[LabeledPoints | None], statistics: _Statistics
) -> LabeledPointsAnnotation | None:
    kept = tuple(entry for entry in entries if entry is not None)
    if annotation.labeled_points and not kept:
        statistics.annotations += 1
        return None
    return replace(annotation, labeled_points=kept)


def _entry(
    entry: LabeledPoints, change: Renumbering | None, latest: _Latest, statistics: _Statistics
) -> LabeledPoints | None:
    if change is None:
        return entry
    number = entry.sensor_frame
    if change.frames is not None:
        if number is None:
            # rows of a whole sensor with frames: no one says how they are counted
            statistics.unplaced += 1
            return None
        found = np.flatnonzero(change.frames == number)
        if len(found) == 0:
            statistics.frames += 1
            return None
        entry = replace(entry, sensor_frame=int(found[0]))
    rows = latest.rows(change, number)
    if rows is None:
        return entry
    ids = _new_ids(entry.point_ids, rows)
    statistics.points += len(entry.point_ids) - len(ids)
    return replace(entry, point_ids=ids) if len(ids) else None


def _new_ids(point_ids: UInt32Array, rows: Int64Array) -> UInt32Array:
    """Where the points with these old numbers stand among the rows that stay; the others are left out.

    Args:
        point_ids: (N,) uint32, old numbers.
        rows: (M,) int64, ascending, old numbers of the points that stay.

    Returns:
        (K,) uint32, new numbers, K <= N.
    """
    locations = np.searchsorted(rows, point_ids)
    there = locations < len(rows)
    there[there] = rows[locations[there]] == point_ids[there]
    return locations[there].astype(np.uint32)


def _reported(statistics: _Statistics) -> tuple[DataWarning, ...]:
    found = (
        ("points", "labelled points that are not in the scene any more", statistics.points),
        ("frames", "labels of frames that are not in the scene any more", statistics.frames),
        (
            "sensors",
            "labels of a whole sensor with frames: it is not stated how its points are counted",
            statistics.unplaced,
        ),
        ("annotations", "annotations without a labelled point left", statistics.annotations),
    )
    return _skipped(
        "annotations[].labeled_points",
        *((f"labelled-{what}", message, count) for what, message, count in found),
    )


def _skipped(location: str, *found: tuple[str, str, int]) -> tuple[DataWarning, ...]:
    """A warning for each code, message and count above 0."""
    return tuple(
        DataWarning(kind=WarningKind.SKIPPED, code=code, location=location, message=message, count=count)
        for code, message, count in found
        if count
    )


Interval = tuple[int, int]
"""`[first_ns, last_ns)`."""

_POSES_AROUND_NS = 1_000_000_000
"""Poses so long before and after a part stay in it: its last sweep ends later than it begins."""

_SAME_TIME_NS = 100_000
"""A frame that comes so long before a bound comes with it: two firings of a lidar."""

_LONGEST = 9.2e9
"""What int64 nanoseconds hold, nearly [s]."""

_FRAMED = (LidarSensor, RadarSensor, CameraSensor, DepthCameraSensor)
_CAMERAS = (CameraSensor, DepthCameraSensor)

TIMED_COLUMNS: Mapping[type, tuple[str, ...]] = MappingProxyType(
    {
        Poses: ("positions", "quaternions_xyzw"),
        Trajectory: ("positions", "quaternions_xyzw", "file_seconds", "covariances"),
        VectorSamples: ("values", "file_seconds"),
        GnssSensor: ("positions_lla", "accuracies", "vertical_accuracies", "file_seconds"),
        CuboidPath: ("values",),
        BoxPath: ("values",),
        PointPath: ("values",),
        VertexPath: ("vertices",),
        AttributePath: ("values",),
        Activation: ("durations_ns", "cuboids"),
        Projection: ("boxes", "cuboids", "confirmed"),
        PointProjection: ("points", "positions", "confirmed"),
    }
)
"""The attributes that have a row for each of `timestamps_ns`."""

_Timed = TypeVar("_Timed", bound=Any)
_Drawn = TypeVar("_Drawn", Box2DAnnotation, ShapeAnnotation)


def select_rows(holder: _Timed, rows: slice | Int64Array | BoolArray) -> _Timed:
    """Give poses, samples, fixes or a path of an annotation with some of its rows; absent columns stay absent."""
    columns = {name: getattr(holder, name) for name in ("timestamps_ns", *TIMED_COLUMNS[type(holder)])}
    chosen = {
        name: tuple(values[row] for row in np.arange(len(values))[rows].tolist())
        if isinstance(values, tuple)
        else values[rows]
        for name, values in columns.items()
        if values is not None
    }
    return replace(holder, **chosen)


def chosen_interval(scene: Scene, *, start: float | None = None, stop: float | None = None) -> Interval | None:
    """Convert seconds after a scene's first timestamp to timestamps; None for the whole scene.

    Args:
        start: None for the beginning.
        stop: exclusive, None for the end.

    Raises:
        OptionError: the interval is empty.
    """
    span_ns = time_span(scene)
    if (start is None and stop is None) or span_ns is None:
        return None
    start_s, stop_s = start or 0.0, float("inf") if stop is None else stop
    if not (start_s >= 0 and stop_s > start_s):
        raise OptionError(f"from {start_s} s to {stop_s} s; expected 0 <= start < stop")
    first_ns = span_ns[0] + round(min(start_s, _LONGEST) * 1e9)
    last_ns = span_ns[0] + round(min(stop_s, _LONGEST) * 1e9)
    times = [frame_times(sensor) for sensor in scene.sensors if isinstance(sensor, _FRAMED)]
    timestamps_ns = np.sort(np.concatenate(times)) if times else np.zeros(0, np.int64)
    return _taking_near(first_ns, timestamps_ns), min(_taking_near(last_ns, timestamps_ns), span_ns[1] + 1)


def _taking_near(bound_ns: int, timestamps_ns: Int64Array) -> int:
    """A bound, or the earliest frame that is as good as on it.

    The first sweep of a fused drive begins with its earliest point, some microseconds after the timestamp of the
    sensor: counted from there, whole seconds would pass over frames that come at whole seconds of the sensor's clock.
    """
    row = int(np.searchsorted(timestamps_ns, bound_ns - _SAME_TIME_NS))
    return min(bound_ns, int(timestamps_ns[row])) if row < len(timestamps_ns) else bound_ns


def cut_scene(scene: Scene, *, start: float | None = None, stop: float | None = None) -> Scene:
    """Keep a part of a scene: frames, images, samples and annotations in it, and the poses in and around it.

    Images are kept to the end of the last sweep, since that is paired with one later than its start. Annotations
    that are not there in the part are left out, labelled points follow their frames, and what holds at all times
    stays.

    Args:
        start: seconds after the scene's first timestamp, None for the beginning.
        stop: seconds after it, exclusive, None for the end.

    Raises:
        OptionError: the interval is empty, or no frame lies in it.
    """
    part = chosen_interval(scene, start=start, stop=stop)
    if part is None:
        return scene
    times = _Times(part, (part[0], max([part[1], *(_sweeps_end(lidar, part) for lidar in scene.lidars)])))
    sensors = tuple(
        _cut_sensor(sensor, times.with_images if isinstance(sensor, _CAMERAS) else part) for sensor in scene.sensors
    )
    if not any(len(frame_times(sensor)) for sensor in sensors if isinstance(sensor, _FRAMED)):
        length = np.ptp(time_span(scene) or (0, 0)) / 1e9
        until = "the end" if stop is None else f"{stop} s"
        raise OptionError(f"{scene.source}: no frame from {start or 0.0} s to {until}; the scene lasts {length:.3f} s")
    annotations, reported = _cut_annotations(scene, times)
    return replace(
        scene,
        sensors=sensors,
        annotations=annotations,
        attributes=_cut_attributes(scene.attributes, part),
        trajectories={
            name: select_rows(trajectory, _rows_around(trajectory.timestamps_ns, part, _POSES_AROUND_NS))
            for name, trajectory in scene.trajectories.items()
        },
        warnings=scene.warnings + reported,
    )


def cut_path(path: Poses, part: Interval, *, margin_ns: int = _POSES_AROUND_NS) -> Poses:
    """Keep the poses in and around a part, so that between its times nothing changes."""
    return path if path.static else select_rows(path, _rows_around(path.timestamps_ns, part, margin_ns))


def _sweeps_end(lidar: LidarSensor, part: Interval) -> int:
    """When the last sweep that begins in the part ends, as far as the timestamps can report."""
    times = lidar.frames.timestamps_ns
    rows = _rows_between(times, part)
    if rows.start == rows.stop or len(times) < 2:
        return part[1]
    return int(times[rows.stop - 1]) + int(np.median(np.diff(times)))


def _cut_sensor(sensor: Any, part: Interval) -> Any:
    """Cut frames, samples and poses; sensors that do not measure over time stay whole."""
    if isinstance(sensor, GnssSensor):
        return select_rows(sensor, _rows_between(sensor.timestamps_ns, part))
    if isinstance(sensor, ImuSensor):
        streams = sensor.streams.items()
        cut = {name: select_rows(s, _rows_between(s.timestamps_ns, part)) for name, s in streams}
        return replace(sensor, streams=cut)
    if not isinstance(sensor, (*_FRAMED, OdometrySensor)):
        return sensor
    if isinstance(sensor, OdometrySensor):
        return replace(sensor, poses=cut_path(sensor.poses, part))
    poses = None if sensor.poses is None else cut_path(sensor.poses, part)
    rows = _rows_between(frame_times(sensor), part)
    of_rows = chosen_shots if isinstance(sensor, _CAMERAS) else _chosen_sweeps
    return replace(of_rows(sensor, rows), poses=poses)


def _chosen_sweeps(sensor: Any, rows: slice) -> Any:
    return replace(sensor, frames=sensor.frames[rows])


def _rows_between(times_ns: Int64Array, part: Interval) -> slice:
    """The rows in a part."""
    first, last = np.searchsorted(times_ns, part)
    return slice(int(first), int(last))


def _rows_around(times_ns: Int64Array, part: Interval, margin_ns: int) -> slice:
    """The rows of a part and its surroundings, with at least one at or before it and one after it, where there are."""
    inner = _rows_between(times_ns, part)
    outer = _rows_between(times_ns, (part[0] - margin_ns, part[1] + margin_ns))
    return slice(max(min(outer.start, inner.start - 1), 0), max(outer.stop, inner.stop + 1))


def _overlaps(times_ns: Int64Array, part: Interval) -> bool:
    """Whether what lasts from the first time to the last one is there in a part."""
    return len(times_ns) > 0 and bool(times_ns[0] < part[1] and times_ns[-1] >= part[0])


@dataclass(frozen=True, slots=True)
class _Times:
    """When a part is, and the same until its last sweep ends, for what is drawn into images."""

    part: Interval
    with_images: Interval


def _cut_annotations(scene: Scene, times: _Times) -> tuple[tuple[Annotation, ...], tuple[DataWarning, ...]]:
    """Cut the annotations; labelled points follow their frames, links and children what they name."""
    cut = [_cut_annotation(annotation, times) for annotation in scene.annotations]
    there, reported = renumbered((a for a in cut if a is not None), _kept_frames(scene, times.part))
    annotations, freed = _without_loose_ends(scene.annotations, there)
    gone = len(scene.annotations) - len(annotations)
    skipped = _skipped(
        "annotations",
        ("annotations-cut", "annotations that are not there in the chosen part were left out", gone),
        (
            "parents-cut",
            "annotations whose parents are not there in the chosen part stand without them",
            freed,
        ),
    )
    return annotations, (*skipped, *reported)


def _kept_frames(scene: Scene, part: Interval) -> dict[Key, Renumbering]:
    """The old numbers of the frames that stay, of each lidar and radar that loses some."""
    clouds = [sensor for sensor in scene.sensors if isinstance(sensor, LidarSensor | RadarSensor)]
    rows = {key_of(sensor.id): (_rows_between(frame_times(sensor), part), len(sensor.frames)) for sensor in clouds}
    return {
        key: Renumbering(np.arange(kept.start, kept.stop))
        for key, (kept, count) in rows.items()
        if (kept.start, kept.stop) != (0, count)
    }


def _without_loose_ends(
    before: Iterable[Annotation], after: Iterable[Annotation]
) -> tuple[tuple[Annotation, ...], int]:
    """Take away links to annotations that were left out, and parents that were.

    Returns:
        annotations: those after, each without what is gone.
        freed: how many lost their parent.
    """
    kept = tuple(after)
    gone = {key_of(a.id) for a in before} - {key_of(a.id) for a in kept}
    if not gone:
        return kept, 0
    firm = [a for a in kept if not (isinstance(a, LinkAnnotation) and {key_of(a.from_id), key_of(a.to_id)} & gone)]
    freed = [_freed(a, gone) for a in firm]
    return tuple(freed), sum(now is not then for now, then in zip(freed, firm, strict=True))


def _freed(annotation: Annotation, gone: set[Key]) -> Annotation:
    parent = annotation.parent_id
    if isinstance(annotation, PlainAnnotation) or parent is None or key_of(parent) not in gone:
        return annotation
    return replace(annotation, parent_id=None)


def _cut_annotation(annotation: Annotation, times: _Times) -> Annotation | None:
    """Keep what an annotation says about a part; None for one that is not there in it.

    What holds at all times stays, and so do labelled points: it is for the caller to count their frames anew.
    """
    cut = _CUTS.get(type(annotation))
    found: Any = annotation if cut is None else cut(annotation, times)
    stated: tuple[AttributePath, ...] = getattr(found, "attributes", ())
    kept = _cut_attributes(stated, times.part)
    changed: Annotation | None = found if kept == stated else replace(found, attributes=kept)
    return changed


def _cut_attributes(attributes: tuple[AttributePath, ...], part: Interval) -> tuple[AttributePath, ...]:
    """Keep what attributes state about a part: a value holds until the next one, so the last one before begins it."""
    cut = (_cut_attribute(attribute, part) for attribute in attributes)
    return tuple(attribute for attribute in cut if attribute is not None)


def _cut_attribute(attribute: AttributePath, part: Interval) -> AttributePath | None:
    times = attribute.timestamps_ns
    if times is None or not len(times) or not attribute.is_timed or not _increase(times):
        return attribute  # without times it holds at all of them, or is at fault: a part keeps it
    rows = slice(max(int(np.searchsorted(times, part[0], "right")) - 1, 0), _rows_between(times, part).stop)
    if rows.start >= rows.stop:
        return None
    if rows == slice(0, len(times)) and times[0] >= part[0]:
        return attribute
    return replace(attribute, timestamps_ns=np.maximum(times[rows], part[0]), values=attribute.values[rows])


def _increase(times_ns: Int64Array) -> bool:
    """Whether times can be searched; paths that run backwards stay whole."""
    return bool((np.diff(times_ns) >= 0).all())


def _cut_annotated(path: _Timed, part: Interval, *, stationary: bool | None) -> _Timed | None:
    """Cut the path of an annotation; None where it is not there in the part."""
    times = path.timestamps_ns
    if len(times) == 0 or not _increase(times):
        return path
    if stationary:
        # what is stationary holds at all times, so one of its rows serves the part, at a time in it
        rows = _rows_between(times, part)
        cut = select_rows(path, rows if rows.start < rows.stop else slice(0, 1))
        return replace(cut, timestamps_ns=np.clip(cut.timestamps_ns, part[0], part[1] - 1))
    return select_rows(path, _rows_around(times, part, 0)) if _overlaps(times, part) else None


def _cuboid(cuboid: CuboidAnnotation, times: _Times) -> CuboidAnnotation | None:
    path = _cut_annotated(cuboid.path, times.part, stationary=cuboid.stationary)
    if path is None:
        return None
    activations = (_activation(activation, times.part) for activation in cuboid.activations)
    projections = (_projection(projection, times.with_images) for projection in cuboid.projections)
    return replace(
        cuboid,
        path=path,
        activations=tuple(a for a in activations if len(a.timestamps_ns)),
        projections=tuple(p for p in projections if len(p.timestamps_ns)),
    )


def _activation(activation: Activation, part: Interval) -> Activation:
    """Keep what lasts into the part."""
    starts, durations = activation.timestamps_ns, activation.durations_ns
    lasting = 0 if durations is None else np.array(durations, np.float64)
    rows = np.flatnonzero((starts < part[1]) & ((starts + lasting > part[0]) | (starts >= part[0])))
    return select_rows(activation, rows)


def _projection(projection: _Timed, part: Interval) -> _Timed:
    times_ns = projection.timestamps_ns
    return select_rows(projection, np.flatnonzero((times_ns >= part[0]) & (times_ns < part[1])))


def _drawn(annotation: _Drawn, times: _Times) -> _Drawn | None:
    in_image = isinstance(annotation, Box2DAnnotation) or annotation.dimensions == 2
    part = times.with_images if in_image else times.part
    path = _cut_annotated(annotation.path, part, stationary=annotation.stationary)
    return None if path is None else replace(annotation, path=path)


def _points(points: PointsAnnotation, times: _Times) -> PointsAnnotation | None:
    """Cut the trajectories of all points; one that is not there keeps its number, and nothing else."""
    cut = [_cut_annotated(path, times.part, stationary=points.stationary) for path in points.paths]
    if cut and all(path is None for path in cut):
        return None
    paths = zip(points.paths, cut, strict=True)
    return replace(
        points,
        paths=tuple(select_rows(path, slice(0)) if kept is None else kept for path, kept in paths),
        projections=tuple(
            tuple(_projection(projection, times.with_images) for projection in of_point)
            for of_point in points.projections
        ),
    )


def _event(event: EventAnnotation, times: _Times) -> EventAnnotation | None:
    """Keep an event that lasts into the part; one that began before begins with it and ends when it did."""
    first_ns, last_ns = times.part
    if first_ns <= event.start_ns < last_ns:
        return event
    left_ns = event.start_ns + (event.duration_ns or 0) - first_ns
    if event.start_ns >= last_ns or left_ns <= 0:
        return None
    return replace(event, start_ns=first_ns, duration_ns=left_ns)


def _adjustment(adjustment: LocalizationAdjustment, times: _Times) -> LocalizationAdjustment | None:
    poses = _correcting(adjustment.poses, times.part)
    return None if poses is None else replace(adjustment, poses=poses)


def _calibration(calibration: CameraCalibration, times: _Times) -> CameraCalibration:
    """Cut the poses; camera model and time hold in any part."""
    if calibration.poses is None:
        return calibration
    return replace(calibration, poses=_correcting(calibration.poses, times.with_images))


def _correcting(path: Poses, part: Interval) -> Poses | None:
    return cut_path(path, part, margin_ns=0) if path.static or _overlaps(path.timestamps_ns, part) else None


_CUTS: Mapping[type, Callable[[Any, _Times], Annotation | None]] = MappingProxyType(
    {
        CuboidAnnotation: _cuboid,
        Box2DAnnotation: _drawn,
        ShapeAnnotation: _drawn,
        PointsAnnotation: _points,
        EventAnnotation: _event,
        LocalizationAdjustment: _adjustment,
        CameraCalibration: _calibration,
    }
)
"""How the annotations that state when are cut; the others stay."""
