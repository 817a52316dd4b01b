"""A time range of a scene: its frames, the poses around it, its annotations, and renumbered labelled points."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from sceneloom.arrays import BoolArray, Int64Array
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
from sceneloom.scene.scene import Posed, Scene, frame_times, time_span
from sceneloom.scene.types import Key, key_of
from sceneloom.warnings import DataWarning, skipped

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
    lost: Counter[str] = Counter()
    known = tuple(annotations)
    entries = [
        (row, k, entry)
        for row, annotation in enumerate(known)
        if isinstance(annotation, LabeledPointsAnnotation)
        for k, entry in enumerate(annotation.labeled_points)
    ]
    # frame by frame, so that each is read once: many annotations have points in one frame
    entries.sort(key=lambda e: (type(e[2].sensor_id).__name__, str(e[2].sensor_id), _frame_number(e[2])))
    moved: dict[tuple[int, int], LabeledPoints | None] = {}
    asked: tuple[Renumbering, int | None] | None = None
    rows: Int64Array | None = None
    for row, k, entry in entries:
        change, number = renumberings.get(key_of(entry.sensor_id)), entry.sensor_frame
        if change is not None and change.rows is not None and asked != (change, number):
            is_kept = change.frames is None or (number is not None and number in change.frames)
            asked, rows = (change, number), change.rows(number) if is_kept else None
        moved[row, k] = entry if change is None else _moved_entry(entry, change, rows, lost)
    found: list[Annotation] = []
    for row, annotation in enumerate(known):
        if not isinstance(annotation, LabeledPointsAnnotation):
            found.append(annotation)
            continue
        new = [moved[row, k] for k in range(len(annotation.labeled_points))]
        kept = tuple(entry for entry in new if entry is not None)
        if kept or not new:
            found.append(replace(annotation, labeled_points=kept))
        lost["annotations"] += bool(new and not kept)
    return tuple(found), _skipped(
        "annotations[].labeled_points",
        ("labelled-points", "labelled points that are no longer in the scene", lost["points"]),
        ("labelled-frames", "labels of frames that are no longer in the scene", lost["frames"]),
        (
            "labelled-sensors",
            "labels of a whole sensor with frames: it is not stated how its points are counted",
            lost["sensors"],
        ),
        ("labelled-annotations", "annotations without a labelled point left", lost["annotations"]),
    )


def _frame_number(entry: LabeledPoints) -> int:
    return -1 if entry.sensor_frame is None else entry.sensor_frame


def _moved_entry(
    entry: LabeledPoints, change: Renumbering, rows: Int64Array | None, lost: Counter[str]
) -> LabeledPoints | None:
    """An entry by the new numbers of frames and points, of which old `rows` stay; None where nothing is left of it."""
    if change.frames is not None:
        numbers = np.flatnonzero(change.frames == _frame_number(entry))
        if len(numbers) == 0:
            lost["sensors" if entry.sensor_frame is None else "frames"] += 1
            return None
        entry = replace(entry, sensor_frame=int(numbers[0]))
    if change.rows is None or rows is None:
        return entry
    new = np.searchsorted(rows, entry.point_ids)
    there = new < len(rows)
    there[there] = rows[new[there]] == entry.point_ids[there]
    lost["points"] += int((~there).sum())
    return replace(entry, point_ids=new[there].astype(np.uint32)) if there.any() else None


def _skipped(location: str, *found: tuple[str, str, int]) -> tuple[DataWarning, ...]:
    """A warning for each code, message and count above 0."""
    return tuple(skipped(code, location, message, count=count) for code, message, count in found if count)


Interval = tuple[int, int]
"""`[first_ns, last_ns)`."""

_POSES_AROUND_NS = 1_000_000_000
"""Poses so long before and after a part stay in it: its last sweep ends later than it begins."""

_SAME_TIME_NS = 100_000  # a frame that comes so long before a bound comes with it: two firings of a lidar
_LONGEST = 9.2e9  # what int64 nanoseconds hold, nearly [s]
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
    times = [frame_times(sensor) for sensor in scene.sensors if isinstance(sensor, Posed)]
    timestamps_ns = np.sort(np.concatenate(times)) if times else np.zeros(0, np.int64)
    return _taking_near(first_ns, timestamps_ns), min(_taking_near(last_ns, timestamps_ns), span_ns[1] + 1)


def _taking_near(bound_ns: int, timestamps_ns: Int64Array) -> int:
    """A bound, or the earliest frame that is as good as on it."""
    # the first sweep of a fused drive begins with its earliest point, some microseconds after the timestamp of the
    # sensor: counted from there, whole seconds would pass over frames that come at whole seconds of the sensor's clock
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
    sensors = tuple(_cut_sensor(sensor, times) for sensor in scene.sensors)
    if not any(len(frame_times(sensor)) for sensor in sensors if isinstance(sensor, Posed)):
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


def _cut_sensor(sensor: Any, times: "_Times") -> Any:
    """Cut frames, samples and poses; sensors that do not measure over time stay whole."""
    part = times.with_images if isinstance(sensor, _CAMERAS) else times.part
    if isinstance(sensor, GnssSensor):
        return select_rows(sensor, _rows_between(sensor.timestamps_ns, part))
    if isinstance(sensor, ImuSensor):
        streams = sensor.streams.items()
        cut = {name: select_rows(s, _rows_between(s.timestamps_ns, part)) for name, s in streams}
        return replace(sensor, streams=cut)
    if not isinstance(sensor, Posed | OdometrySensor):
        return sensor
    cut_sensor: Any = sensor
    if not isinstance(sensor, OdometrySensor):
        rows = _rows_between(frame_times(sensor), part)
        is_camera = isinstance(sensor, _CAMERAS)
        cut_sensor = (
            chosen_shots(cut_sensor, rows) if is_camera else replace(cut_sensor, frames=cut_sensor.frames[rows])
        )
    return replace(cut_sensor, poses=None if sensor.poses is None else cut_path(sensor.poses, part))


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
    left = {key_of(annotation.id) for annotation in there}
    gone = {key_of(annotation.id) for annotation in scene.annotations} - left
    annotations: list[Annotation] = []
    freed = 0
    for annotation in there:
        if isinstance(annotation, LinkAnnotation) and {key_of(annotation.from_id), key_of(annotation.to_id)} & gone:
            continue
        parent = annotation.parent_id
        if parent is not None and key_of(parent) in gone and not isinstance(annotation, PlainAnnotation):
            annotation, freed = replace(annotation, parent_id=None), freed + 1  # noqa: PLW2901
        annotations.append(annotation)
    lost = len(scene.annotations) - len(annotations)
    skipped = _skipped(
        "annotations",
        ("annotations-cut", "annotations that are not in the chosen part were left out", lost),
        ("parents-cut", "annotations whose parents are not in the chosen part were detached from them", freed),
    )
    return tuple(annotations), (*skipped, *reported)


def _kept_frames(scene: Scene, part: Interval) -> dict[Key, Renumbering]:
    """The old numbers of the frames that stay, of each lidar and radar that loses some."""
    clouds = [sensor for sensor in scene.sensors if isinstance(sensor, LidarSensor | RadarSensor)]
    rows = {key_of(sensor.id): (_rows_between(frame_times(sensor), part), len(sensor.frames)) for sensor in clouds}
    return {
        key: Renumbering(np.arange(kept.start, kept.stop))
        for key, (kept, count) in rows.items()
        if (kept.start, kept.stop) != (0, count)
    }


def _cut_annotation(annotation: Annotation, times: _Times) -> Annotation | None:
    """Keep what an annotation says about a part; None for one that is not there in it."""
    # what holds at all times stays, and so do labelled points: it is for the caller to count their frames anew
    found = _cut_part(annotation, times)
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


def _cut_part(annotation: Any, times: _Times) -> Any:  # noqa: PLR0911 - one a kind
    """Cut what an annotation states about times, besides its attributes; None where it is not there in the part."""
    part = times.part
    path: Any
    match annotation:
        case CuboidAnnotation():
            path = _cut_annotated(annotation.path, part, stationary=annotation.stationary)
            activations = (_activation(one, part) for one in annotation.activations)
            projections = (_between(one, times.with_images) for one in annotation.projections)
            return path and replace(
                annotation,
                path=path,
                activations=tuple(one for one in activations if len(one.timestamps_ns)),
                projections=tuple(one for one in projections if len(one.timestamps_ns)),
            )
        case Box2DAnnotation() | ShapeAnnotation():
            in_image = isinstance(annotation, Box2DAnnotation) or annotation.dimensions == 2
            of_path = times.with_images if in_image else part
            path = _cut_annotated(annotation.path, of_path, stationary=annotation.stationary)
            return path and replace(annotation, path=path)
        case PointsAnnotation():
            # a point that is not there keeps its number, and nothing else
            cut = [_cut_annotated(path, part, stationary=annotation.stationary) for path in annotation.paths]
            if cut and all(path is None for path in cut):
                return None
            paths = zip(annotation.paths, cut, strict=True)
            return replace(
                annotation,
                paths=tuple(select_rows(path, slice(0)) if kept is None else kept for path, kept in paths),
                projections=tuple(
                    tuple(_between(one, times.with_images) for one in of_point) for of_point in annotation.projections
                ),
            )
        case EventAnnotation() if not part[0] <= annotation.start_ns < part[1]:
            # one that began before begins with the part and ends when it did
            left_ns = annotation.start_ns + (annotation.duration_ns or 0) - part[0]
            lasts = annotation.start_ns < part[1] and left_ns > 0
            return replace(annotation, start_ns=part[0], duration_ns=left_ns) if lasts else None
        case LocalizationAdjustment():
            poses = _correcting(annotation.poses, part)
            return poses and replace(annotation, poses=poses)
        case CameraCalibration() if annotation.poses is not None:
            return replace(annotation, poses=_correcting(annotation.poses, times.with_images))
    return annotation


def _activation(activation: Activation, part: Interval) -> Activation:
    """Keep what lasts into the part."""
    starts, durations = activation.timestamps_ns, activation.durations_ns
    lasting = 0 if durations is None else np.array(durations, np.float64)
    return select_rows(activation, (starts < part[1]) & ((starts + lasting > part[0]) | (starts >= part[0])))


def _between(projection: _Timed, part: Interval) -> _Timed:
    times_ns = projection.timestamps_ns
    return select_rows(projection, (times_ns >= part[0]) & (times_ns < part[1]))


def _correcting(path: Poses, part: Interval) -> Poses | None:
    return cut_path(path, part, margin_ns=0) if path.static or _overlaps(path.timestamps_ns, part) else None
