"""Several scenes of one drive merged: whether they are of one drive, in one world and with one set of ids."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count, zip_longest
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.editing.move_world import FrameChange, moved_world
from sceneloom.editing.references import (
    OURS,
    NewIds,
    entries_of,
    metadata_of,
    ours_of,
    recounted,
    with_annotation_ids,
    with_ours,
    with_sensor_ids,
    with_sensor_parent,
    with_warnings,
)
from sceneloom.errors import CalibrationError, DataError, OptionError
from sceneloom.geometry.geodesy import ecef_from_geodetic
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations import (
    Annotation,
    AttributePath,
    Box2DAnnotation,
    CameraCalibration,
    CuboidAnnotation,
    EventAnnotation,
    GroupAnnotation,
    LabeledPointsAnnotation,
    LinkAnnotation,
    LocalizationAdjustment,
    ObjectAnnotation,
    PointsAnnotation,
    ShapeAnnotation,
)
from sceneloom.scene.annotations_at import CuboidAngles, annotations_frame
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, shots_of, with_shots
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Posed, Scene, Sensor, frame_times
from sceneloom.scene.time_range import TIMED_COLUMNS
from sceneloom.scene.types import Coordinates, Identifier, Key, key_of
from sceneloom.warnings import DataWarning, assumed, skipped

_SAME_TOLERANCE = 1e-6
"""Numbers of two scenes that differ by no more are equal, since they were computed into one world [m], …"""

_SAME_MOUNT = _SAME_WORLD = 1e-9
"""Mountings of one sensor, and transforms to the world, that differ by more are two [m], [rad]."""

_SHARED = (OdometrySensor, ImuSensor, GnssSensor, PointsSensor)
"""Sensors that several scenes of one drive may each contain; where they are equal, the merged scene has them once."""

_LISTED = ("deskew", "unfused", "extrapolated", "to_ego", "applied")
"""Our entries of the metadata that are lists, of which a merged scene has all."""


def merge_scenes(scenes: Sequence[Scene], *, rename: bool = False, join: bool = False, force: bool = False) -> Scene:
    """Make one scene of several of one drive on one clock.

    Scenes whose metadata state which world they were moved from are brought into the first one's. References follow the
    ids of sensors and annotations that change, and the `camera_index` of points the order of the cameras. The ego
    trajectory, an IMU, a receiver or a map that is the same in several scenes is taken once.

    Args:
        scenes: two or more; of what differs and can be there only once the first one's is kept, with a warning.
        rename: give new ids to sensors and annotations whose ids an earlier scene has, instead of refusing them.
        force: merge even scenes of different drives by their cities, times, fixes or ego poses; each reason becomes a
            warning.
        join: take sensors and annotations of equal ids for consecutive parts of one: frames, poses and paths are
            concatenated; frames with equal timestamps and points are taken once.

    Raises:
        OptionError: there are fewer than two, they are of different drives, or ids, worlds or parts are incompatible.
        DataError: a frame that this needs cannot be read.
    """
    if len(scenes) < 2:
        raise OptionError(f"{len(scenes)} scene to merge; expected two or more")
    merged = scenes[0]
    for scene in scenes[1:]:
        placed = _in_world_of(scene, merged)
        reasons, is_compared = _different_drives(merged, placed)
        if reasons and not force:
            raise OptionError(
                f"{scene.source}: of another drive than {merged.source}: {'; '.join(reasons)}; expected parts of one "
                "drive in one world; `--force` merges them all the same"
            )
        reported = [assumed("different-drives", scene.source, f"merged all the same: {why}") for why in reasons]
        if not reasons and not is_compared:
            what = "no city, satellite fixes or ego poses to compare with the others; taken to be of one drive"
            reported.append(assumed("drives-unrelated", scene.source, what))
        placed = with_warnings(_with_angles_of(placed, merged), reported)
        merged = _Merger(merged, placed, rename=rename, join=join).merged()
    return replace(
        merged,
        source=" + ".join(scene.source for scene in scenes),
        on_close=partial(_close, tuple(scene.on_close for scene in scenes)),
    )


def _close(closing: tuple[Callable[[], None], ...]) -> None:
    for close in closing:
        close()


def _in_world_of(scene: Scene, first: Scene) -> Scene:
    """Move a scene into the world of another, as far as their metadata relate the two."""
    mine, other = _world_from_file(scene), _world_from_file(first)
    if mine is None and other is None:
        return scene
    identity = RigidTransform.identity()
    first_from_here = (other or identity).inverse() @ (mine or identity)
    placed = scene
    if mine is None or other is None:
        which = scene if mine is None else first
        what = "its metadata do not state that its origin was moved; taken to be in the world of the original file"
        placed = with_warnings(scene, [assumed("worlds-related", which.source, what)])
    if np.abs(first_from_here.matrix - np.eye(4)).max() > _SAME_WORLD:
        placed = moved_world(placed, FrameChange.constant(first_from_here))
    return with_ours(placed, world_from_file=ours_of(first).get("world_from_file"))


def _world_from_file(scene: Scene) -> RigidTransform | None:
    """The transform that an earlier edit removed from all positions in the world; None where none is stated."""
    stated: Any = ours_of(scene).get("world_from_file")
    if stated is None:
        return None
    try:
        matrix: Float64Array = np.array(stated, np.float64)
        return RigidTransform.nearest(matrix)[0]
    except (TypeError, ValueError, CalibrationError):
        location = "metadata.sceneloom.world_from_file"
        raise DataError(scene.source, location, f"{stated!r}; expected a rigid 4x4 matrix") from None


def _with_angles_of(scene: Scene, first: Scene) -> Scene:
    """Give a scene whose cuboids have their angles in the unit and order of another one."""
    if scene.annotations and first.annotations and annotations_frame(scene) != annotations_frame(first):
        raise OptionError(
            f"{scene.source}: its annotations are in the {annotations_frame(scene)} frame, those of {first.source} in "
            f"the {annotations_frame(first)} frame; bring both into the world first: `sceneloom edit to-world`"
        )
    mine, theirs = CuboidAngles.of(scene), CuboidAngles.of(first)
    if mine == theirs or not any(isinstance(annotation, CuboidAnnotation) for annotation in scene.annotations):
        return scene

    def converted(entry: Any, name: str) -> Any:
        if getattr(entry, name) is None:
            return entry
        rows = getattr(entry, name).copy()
        known = np.isfinite(rows[:, 6:]).all(axis=1)
        rows[known, 6:] = theirs.from_quaternions(mine.quaternions(rows[known, 6:]))
        return replace(entry, **{name: rows})

    annotations = tuple(
        replace(
            annotation,
            path=converted(annotation.path, "values"),
            activations=tuple(converted(entry, "cuboids") for entry in annotation.activations),
            projections=tuple(converted(entry, "cuboids") for entry in annotation.projections),
        )
        if isinstance(annotation, CuboidAnnotation)
        else annotation
        for annotation in scene.annotations
    )
    return with_ours(replace(scene, annotations=annotations), euler_unit=str(theirs.unit), euler_order=theirs.order)


# Whether two scenes are of one drive.

_CITY_FIELDS = frozenset({"city", "city_name", "location", "map_name"})
"""Names of metadata that state where a drive was."""

_LONGEST_GAP_S = 3600.0  # parts of one drive are not further apart in time
_FASTEST = 100.0  # no vehicle is faster [m/s]

_SAME_LOCATION = 100.0
"""How far apart fixes or poses of one ego may be at one time [m]: receivers and their antennas differ."""

_Track = tuple[Int64Array, Float64Array] | None  # times (N,) and positions (N, 3) [m]


def _different_drives(first: Scene, second: Scene) -> tuple[list[str], bool]:
    """Why two scenes in one world are not of one drive, and whether they have more than times to compare."""
    # times of clocks that begin at 0 relate nothing
    reasons = []
    here, there = _cities(first.metadata), _cities(second.metadata)
    if here and there and here.isdisjoint(there):
        reasons.append(f"it was in {', '.join(sorted(there))}, the other in {', '.join(sorted(here))}")
    spans = [span for span in map(_span_ns, (first, second)) if span is not None]
    gap_s = (max(span[0] for span in spans) - min(span[1] for span in spans)) / 1e9 if len(spans) == 2 else 0.0
    if gap_s > _LONGEST_GAP_S:
        gap = f"{gap_s / 3600:,.1f} h" if gap_s < 172_800 else f"{gap_s / 86_400:,.0f} days"
        reasons.append(f"{gap} are between them")
    fixes, egos = (_fixes(first), _fixes(second)), (_ego(first), _ego(second))
    if (apart := _apart(*fixes)) is not None:
        reasons.append(f"their satellite fixes are {apart / 1000:,.1f} km apart")
    if (apart := _apart(*egos)) is not None:
        reasons.append(f"their egos are {apart:,.0f} m apart at one time")
    return reasons, bool(here and there) or None not in fixes or None not in egos


def _cities(metadata: Mapping[str, Any], depth: int = 0) -> set[str]:
    """What metadata call the location, in lower case."""
    found: set[str] = set()
    for name, value in metadata.items():
        if isinstance(value, str) and value.strip() and name.lower() in _CITY_FIELDS:
            found.add(value.strip().casefold())
        elif isinstance(value, Mapping) and depth < 3:
            found |= _cities(value, depth + 1)
    return found


def _span_ns(scene: Scene) -> tuple[int, int] | None:
    stated = [*map(frame_times, scene.sensors), *(one.timestamps_ns for one in scene.trajectories.values())]
    times = np.concatenate([np.zeros(0, np.int64), *stated])
    return (int(times.min()), int(times.max())) if len(times) else None


def _fixes(scene: Scene) -> _Track:
    """The fixes of the first receiver on the ellipsoid, earth-centred."""
    for sensor in scene.sensors:
        if isinstance(sensor, GnssSensor) and len(sensor.timestamps_ns):
            lla = sensor.positions_lla
            known = np.isfinite(lla).all(axis=1) & (np.abs(lla[:, 0]) <= 90) & (np.abs(lla[:, 2]) < 1e5)
            if known.any():
                return sensor.timestamps_ns[known], ecef_from_geodetic(lla[known])
    return None


def _ego(scene: Scene) -> _Track:
    """The ego's trajectory, else that of the first sensor whose poses in the world are known, which is close to it."""
    found: list[Trajectory | Poses] = list(scene.trajectories.values())
    for one in scene.sensors:
        if isinstance(one, LidarSensor | RadarSensor | CameraSensor) and one.coordinates is Coordinates.WORLD:
            found += [] if one.poses is None or one.poses.static else [one.poses]
    if not found or not len(found[0].timestamps_ns) or not np.isfinite(found[0].positions).all():
        return None
    return found[0].timestamps_ns, found[0].positions


def _apart(first: _Track, second: _Track) -> float | None:
    """How far apart two tracks are where an ego cannot have been on both [m]; None where it can."""
    if first is None or second is None:
        return None
    (times, positions), (other_times, other_positions) = first, second
    inside = (other_times >= times[0]) & (other_times <= times[-1])
    with np.errstate(over="ignore", invalid="ignore"):
        if inside.any():
            at = other_times[inside]
            expected = np.column_stack([np.interp(at, times, positions[:, axis]) for axis in range(3)])
            apart = float(np.median(np.linalg.norm(other_positions[inside] - expected, axis=1)))
            return apart if apart > _SAME_LOCATION else None
        early, late = (second, first) if other_times[-1] < times[0] else (first, second)
        apart = float(np.linalg.norm(late[1][0] - early[1][-1]))
    gap_s = (int(late[0][0]) - int(early[0][-1])) / 1e9
    return apart if gap_s >= 0 and apart > _SAME_LOCATION + _FASTEST * gap_s else None


# What is the same in both scenes.


def _is_same(a: Any, b: Any) -> bool:
    """Whether two values, records or arrays are equal, numbers in arrays within `_SAME_TOLERANCE`."""
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        a, b = np.asarray(a), np.asarray(b)
        if a.dtype.kind == b.dtype.kind == "f" and a.shape == b.shape:
            return bool(np.allclose(a, b, rtol=0.0, atol=_SAME_TOLERANCE, equal_nan=True))
        return a.dtype.kind == b.dtype.kind and bool(np.array_equal(a, b))
    if hasattr(a, "__dataclass_fields__"):
        names = a.__dataclass_fields__
        return type(a) is type(b) and all(_is_same(getattr(a, name), getattr(b, name)) for name in names)
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(_is_same(a[name], b[name]) for name in a)
    if isinstance(a, Sequence) and isinstance(b, Sequence) and not isinstance(a, str):
        return len(a) == len(b) and all(_is_same(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b)


_JOINED = frozenset(
    (
        *("frames", "images", "video", "poses", "mount", "streams"),
        *("timestamps_ns", "positions_lla", "accuracies", "vertical_accuracies", "file_seconds"),
        *("path", "paths", "activations", "projections", "labeled_points", "start_ns", "duration_ns"),
        "attributes",
    )
)  # fields of sensors and annotations that are joined from those of both parts, or that must be the same in both


def _differing_fields(first: Any, second: Any) -> tuple[str, ...]:
    """Name the fields in which two parts of one sensor or annotation differ, and of which only one can be kept."""
    names = [name for name in first.__dataclass_fields__ if name not in _JOINED]
    differing = [name for name in names if not _is_same(getattr(first, name), getattr(second, name))]
    return (*differing, *_differing_attributes(*(getattr(part, "attributes", ()) for part in (first, second))))


def _differing_attributes(first: Iterable[AttributePath], second: Iterable[AttributePath]) -> list[str]:
    """Name the attributes that differ in two parts and have no times by which one could continue the other."""
    known = {_attribute_key(attribute): attribute for attribute in first}
    pairs = [(known.get(_attribute_key(attribute)), attribute) for attribute in second]
    return [
        f"attributes[{other.name}]"
        for one, other in pairs
        if one is not None and not (one.is_timed and other.is_timed) and not _is_same(one, other)
    ]


def _attribute_key(attribute: AttributePath) -> tuple[Any, ...]:
    sensor = None if attribute.sensor_id is None else key_of(attribute.sensor_id)
    return attribute.name, sensor, attribute.static, attribute.point_index


# Parts of one series, one sensor or one annotation joined. What cannot be joined is an OptionError without a location.


def _joined_rows(first: Any, second: Any) -> Any:
    """Join two series in the order of time; of rows at one time the first's; a column that one lacks is left out."""
    timestamps = np.concatenate([first.timestamps_ns, second.timestamps_ns])
    rows = np.unique(timestamps, return_index=True)[1]
    columns: dict[str, Any] = {"timestamps_ns": timestamps[rows]}
    for name in TIMED_COLUMNS[type(first)]:
        a, b = getattr(first, name), getattr(second, name)
        if a is None or b is None:
            columns[name] = None
        elif isinstance(a, tuple):
            both = (*a, *b)
            columns[name] = tuple(both[row] for row in rows.tolist())
        else:
            columns[name] = np.concatenate([a, b])[rows]
    return replace(first, **columns)


def _joined_poses(first: Poses, second: Poses) -> Poses:
    """Join two series of poses; one that holds at all times must be the same in both."""
    if first.static and second.static:
        pairs = (first.positions, second.positions), (first.quaternions_xyzw, second.quaternions_xyzw)
        if all(np.allclose(a, b, rtol=0, atol=_SAME_MOUNT) for a, b in pairs):
            return first
    if first.static or second.static:
        raise OptionError("is stationary in one scene, and elsewhere or moves in another")
    joined: Poses = _joined_rows(first, second)
    return joined


@dataclass(frozen=True, slots=True, eq=False)
class _Joint:
    """How the frames of a second part continue those of a first."""

    sources: Int64Array  # (N, 2), of each frame of the whole its part and its number there
    first: Int64Array  # (M,), new number of each frame of the part
    second: Int64Array  # likewise
    twice: int  # how many frames are in both

    @classmethod
    def of(cls, first_ns: Int64Array, second_ns: Int64Array) -> "_Joint":
        """Join by timestamps; frames of equal timestamps are one."""
        is_twice = np.isin(second_ns, first_ns)
        alone, twice = np.flatnonzero(~is_twice), np.flatnonzero(is_twice)
        parts = np.repeat([0, 1], [len(first_ns), len(alone)])
        numbers = np.concatenate([np.arange(len(first_ns)), alone])
        order = np.argsort(np.concatenate([first_ns, second_ns[alone]]), kind="stable")
        if np.count_nonzero(np.diff(parts[order])) > 1:
            raise OptionError(
                "the frames of the second part lie between those of the first; expected parts that follow each other"
            )
        new = np.empty(len(order), np.int64)
        new[order] = np.arange(len(order))
        second = np.empty(len(second_ns), np.int64)
        second[alone] = new[len(first_ns) :]
        by_time = np.argsort(first_ns, kind="stable")
        second[twice] = new[by_time[np.searchsorted(first_ns, second_ns[twice], sorter=by_time)]]
        return cls(np.stack([parts[order], numbers[order]], axis=1), new[: len(first_ns)], second, len(twice))

    def frames(self, *parts: LazyFrames[Any]) -> LazyFrames[Any]:
        """The frames of the whole."""
        timestamps = [parts[part].timestamps_ns[number] for part, number in self.sources.tolist()]
        return LazyFrames(np.array(timestamps, np.int64), partial(_frame_of_parts, parts, self.sources))


def _frame_of_parts(parts: tuple[LazyFrames[Any], ...], sources: Int64Array, k: int) -> Any:
    part, number = sources[k].tolist()
    return parts[part][number]


_Moving = TypeVar("_Moving", LidarSensor, RadarSensor, CameraSensor, DepthCameraSensor)


def _joined_sensor(first: Any, second: Any) -> tuple[Sensor, _Joint | None]:
    """Join two parts of one sensor; gives how its frames were joined, too, None for one without frames."""
    joint, joined = None, first
    match first:
        case _ if type(first) is not type(second):
            raise OptionError(f"a {first.type} in one scene and a {second.type} in another; expected one kind")
        case LidarSensor() | RadarSensor():
            joint = _joined_clouds(first, second)
            joined = replace(_with_both_poses(first, second), frames=joint.frames(first.frames, second.frames))
        case CameraSensor() | DepthCameraSensor():
            # images of equal timestamps are one, though another encoding may have changed them
            shots, further = shots_of(first), shots_of(second)
            joint = _Joint.of(shots.timestamps_ns, further.timestamps_ns)
            joined = _with_both_poses(first, second)
            if len(further) > joint.twice:
                joined = with_shots(joined, joint.frames(shots, further), None if len(shots) else second.video)
        case OdometrySensor():
            joined = replace(first, poses=_joined_poses(first.poses, second.poses))
        case ImuSensor():
            twice = first.streams.keys() & second.streams.keys()
            both = {name: _joined_rows(first.streams[name], second.streams[name]) for name in twice}
            joined = replace(first, streams={**second.streams, **first.streams, **both})
        case GnssSensor():
            _check_mounts(first, second)
            joined = _joined_rows(first, second)
        case _ if not _is_same(first, second):
            raise OptionError("differs between the scenes and has no time; expected the same, or another id")
    return joined, joint


def _joined_clouds(first: LidarSensor | RadarSensor, second: LidarSensor | RadarSensor) -> _Joint:
    """Join sweeps or radar cycles; those of equal timestamps must have equal points."""
    if first.points_frame is not second.points_frame:
        raise OptionError(
            f"points in the {first.points_frame} frame in one scene and in the {second.points_frame} frame in "
            "another; expected one frame"
        )
    joint = _Joint.of(first.frames.timestamps_ns, second.frames.timestamps_ns)
    for k in np.flatnonzero(np.isin(second.frames.timestamps_ns, first.frames.timestamps_ns)).tolist():
        part, number = joint.sources[joint.second[k]].tolist()
        if part == 0:
            here, there = first.frames[number].points.positions, second.frames[k].points.positions
            if not np.array_equal(here, there, equal_nan=True):
                timestamp = second.frames.timestamps_ns[k]
                raise OptionError(f"two frames at {timestamp} ns whose points differ; expected one")
    return joint


def _with_both_poses(first: _Moving, second: _Moving) -> _Moving:
    """The first part with the poses of both."""
    _check_mounts(first, second)
    if first.poses is None or second.poses is None:
        return replace(first, poses=first.poses or second.poses)
    if first.coordinates is not second.coordinates:
        raise OptionError(f"poses in {first.coordinates} and in {second.coordinates}; expected one frame")
    return replace(first, poses=_joined_poses(first.poses, second.poses))


def _check_mounts(first: Posed | GnssSensor, second: Posed | GnssSensor) -> None:
    a, b = first.mount, second.mount
    if (a is None) != (b is None) or (
        a is not None and b is not None and np.abs(a.matrix - b.matrix).max() > _SAME_MOUNT
    ):
        raise OptionError("mounted otherwise in one scene than in another; expected one mounting")


def _joined_annotation(first: Any, second: Any) -> Annotation:
    """Join two parts of one annotation; of two keyframes at one time that of the first counts."""
    join = _ANNOTATION_JOINS.get(type(first))
    if type(first) is not type(second) or first.type != second.type or join is None:
        if not _is_same(first, second):
            raise OptionError(f"a {first.type} in one scene and a {second.type} in another; expected one")
        return first  # type: ignore[no-any-return]
    changes = join(first, second)
    if not isinstance(first, LocalizationAdjustment | CameraCalibration):
        changes["attributes"] = _joined_attributes(first.attributes, second.attributes)
    return replace(first, **changes)  # type: ignore[no-any-return]


def _joined_attributes(first: Iterable[AttributePath], second: Iterable[AttributePath]) -> tuple[AttributePath, ...]:
    """Join attributes of one name, sensor and point; of those without times the first is kept."""
    joined = {_attribute_key(attribute): attribute for attribute in first}
    alone = []
    for attribute in second:
        known = joined.get(_attribute_key(attribute))
        if known is None:
            alone.append(attribute)
        elif known.is_timed and attribute.is_timed:
            joined[_attribute_key(attribute)] = _joined_rows(known, attribute)
    return (*joined.values(), *alone)


def _joined_entries(first: Iterable[Any], second: Iterable[Any]) -> tuple[Any, ...]:
    """Join activations or projections of the same sensor."""
    joined = {key_of(entry.sensor_id): entry for entry in first}
    for entry in second:
        key = key_of(entry.sensor_id)
        joined[key] = _joined_rows(joined[key], entry) if key in joined else entry
    return tuple(joined.values())


def _joined_paths(first: Any, second: Any) -> Any:
    """Join two paths; of what is stationary at one position in both parts the first is kept."""
    a, b = first.path, second.path
    same = all(_is_same(getattr(a, name), getattr(b, name)) for name in TIMED_COLUMNS[type(a)])
    return a if first.stationary and second.stationary and same else _joined_rows(a, b)


def _cuboid(first: CuboidAnnotation, second: CuboidAnnotation) -> dict[str, Any]:
    return {
        "path": _joined_paths(first, second),
        "activations": _joined_entries(first.activations, second.activations),
        "projections": _joined_entries(first.projections, second.projections),
    }


def _drawn(first: Any, second: Any) -> dict[str, Any]:
    if not _is_same(first.sensor_id, second.sensor_id):
        raise OptionError(f"of sensor {first.sensor_id!r} and of {second.sensor_id!r}; expected one sensor")
    return {"path": _joined_paths(first, second)}


def _points(first: PointsAnnotation, second: PointsAnnotation) -> dict[str, Any]:
    if len(first.paths) != len(second.paths):
        raise OptionError(f"{len(first.paths)} points and {len(second.paths)} points; expected as many")
    paths = (_joined_rows(a, b) for a, b in zip(first.paths, second.paths, strict=True))
    projections = (_joined_entries(a, b) for a, b in zip_longest(first.projections, second.projections, fillvalue=()))
    return {"paths": tuple(paths), "projections": tuple(projections)}


def _labelled(first: LabeledPointsAnnotation, second: LabeledPointsAnnotation) -> dict[str, Any]:
    joined = {(key_of(entry.sensor_id), entry.sensor_frame): entry for entry in first.labeled_points}
    for entry in second.labeled_points:
        key = (key_of(entry.sensor_id), entry.sensor_frame)
        ids = np.union1d(joined[key].point_ids, entry.point_ids) if key in joined else entry.point_ids
        joined[key] = replace(entry, point_ids=ids.astype(np.uint32))
    return {"labeled_points": tuple(joined.values())}


def _event(first: EventAnnotation, second: EventAnnotation) -> dict[str, Any]:
    """From the beginning of the earlier part to the end of the later one."""
    start_ns = min(first.start_ns, second.start_ns)
    duration_ns = max(event.start_ns + (event.duration_ns or 0) for event in (first, second)) - start_ns
    unknown = first.duration_ns is None and second.duration_ns is None and duration_ns == 0
    return {"start_ns": start_ns, "duration_ns": None if unknown else duration_ns}


def _calibration(first: CameraCalibration, second: CameraCalibration) -> dict[str, Any]:
    poses = first.poses if second.poses is None else second.poses
    if first.poses is not None and second.poses is not None:
        poses = _joined_poses(first.poses, second.poses)
    if not _is_same(*((one.sensor_id, one.intrinsics, one.time_offset_ns) for one in (first, second))):
        raise OptionError("another camera, camera model or time offset in one scene than in another; expected one")
    return {"poses": poses}


def _link(first: LinkAnnotation, second: LinkAnnotation) -> dict[str, Any]:
    if not _is_same((first.from_id, first.to_id), (second.from_id, second.to_id)):
        raise OptionError("links other annotations in one scene than in another; expected one link")
    return {}


_ANNOTATION_JOINS: Mapping[type, Callable[[Any, Any], dict[str, Any]]] = MappingProxyType(
    {
        CuboidAnnotation: _cuboid,
        Box2DAnnotation: _drawn,
        ShapeAnnotation: _drawn,
        PointsAnnotation: _points,
        LabeledPointsAnnotation: _labelled,
        EventAnnotation: _event,
        LocalizationAdjustment: lambda first, second: {"poses": _joined_poses(first.poses, second.poses)},
        CameraCalibration: _calibration,
        ObjectAnnotation: lambda *_: {},
        GroupAnnotation: lambda *_: {},
        LinkAnnotation: _link,
    }
)  # what becomes of the fields of two parts of one annotation, besides their attributes


@dataclass(slots=True, eq=False)
class _Merger:
    """Merges one more scene, in the same world, into a scene."""

    first: Scene
    second: Scene
    rename: bool
    join: bool
    sensor_ids: dict[Key, Identifier | None] = field(default_factory=dict)
    joints: dict[Key, _Joint] = field(default_factory=dict)
    warnings: list[DataWarning] = field(default_factory=list)

    def merged(self) -> Scene:
        self._choose_sensor_ids()
        ids = NewIds(self.sensor_ids)
        sensors = self._sensors([with_sensor_parent(sensor, ids) for sensor in self.second.sensors])
        annotations = self._annotations(ids)
        attributes = entries_of(self.second.attributes, ids)
        extras, differing = _both_mappings(self.first.extras, self.second.extras)
        self._report_differing("", (*_differing_attributes(self.first.attributes, attributes), *differing))
        merged = replace(
            self.first,
            sensors=sensors,
            annotations=annotations,
            trajectories=self._trajectories(ids),
            attributes=_joined_attributes(self.first.attributes, attributes),
            metadata=self._metadata(ids),
            extras=MappingProxyType(extras),
        )
        new = [warning for warning in self.second.warnings if warning not in self.first.warnings]
        return with_warnings(merged, (*new, *self.warnings))

    def _location(self, kind: str, identifier: Identifier) -> str:
        return f"{self.second.source}: {kind}[{identifier!r}]"

    def _report_differing(self, prefix: str, names: Iterable[str], *, code: str = "fields-differ") -> None:
        what = "differs between the scenes; that of the first is kept"
        self.warnings.extend(skipped(code, f"{prefix}{name}", what) for name in names)

    def _choose_sensor_ids(self) -> None:
        """Find the new id of each sensor whose id the first scene has; one that is joined or shared keeps it."""
        taken = {key_of(sensor.id): sensor for sensor in self.first.sensors}
        used = set(taken) | {key_of(sensor.id) for sensor in self.second.sensors}
        for sensor in self.second.sensors:
            known = taken.get(key_of(sensor.id))
            if known is None or self.join or (isinstance(sensor, _SHARED) and _is_same(known, sensor)):
                continue
            if not self.rename:
                raise OptionError(
                    f"{self._location('sensors', sensor.id)}: {self.first.source} has this id, too; `--rename` gives "
                    "it another, `--join` joins the two as parts of one sensor"
                )
            self.sensor_ids[key_of(sensor.id)] = _free_id(sensor.id, used)

    def _sensors(self, renamed: list[Sensor]) -> tuple[Sensor, ...]:
        """The sensors of both; cameras first in the order of the first scene, as points name them."""
        known = {key_of(sensor.id): k for k, sensor in enumerate(self.first.sensors)}
        further = [sensor for sensor in renamed if key_of(sensor.id) not in known]
        cameras = [s for s in (*self.first.sensors, *further) if isinstance(s, CameraSensor)]
        order = {key_of(camera.id): k for k, camera in enumerate(cameras)}
        second_cameras = [camera for camera in renamed if isinstance(camera, CameraSensor)]
        numbers = {k: order[key_of(camera.id)] for k, camera in enumerate(second_cameras)}
        moved = any(old != new for old, new in numbers.items())
        sensors = list(self.first.sensors)
        for renamed_sensor in renamed:
            sensor = renamed_sensor
            if moved and isinstance(sensor, LidarSensor):
                sensor = recounted(sensor, numbers)
            k = known.get(key_of(sensor.id))
            if k is None:
                sensors.append(sensor)
            elif self.join:
                sensors[k] = self._joined_sensor(sensors[k], sensor)
            else:
                what = "the same in both scenes; taken once"
                self.warnings.append(assumed("same-sensor", f"sensors[{sensor.id}]", what))
        return tuple(sensors)

    def _joined_sensor(self, first: Sensor, second: Sensor) -> Sensor:
        joined, joint = self._located("sensors", second.id, _joined_sensor, first, second)
        self._report_differing(f"sensors[{second.id}].", _differing_fields(first, second))
        if joint is not None:
            self.joints[key_of(second.id)] = joint
            what = "frames that are in both scenes; taken once"
            self.warnings.append(skipped("frames-twice", f"sensors[{second.id}]", what, count=joint.twice))
        if getattr(first, "video", None) is not getattr(joined, "video", None):
            what = "the videos of parts cannot be joined; its images are taken one by one"
            self.warnings.append(assumed("video-in-images", f"sensors[{second.id}].video", what))
        sensor: Sensor = joined
        return sensor

    def _located(self, kind: str, identifier: Identifier, join: Callable[[Any, Any], Any], *parts: Any) -> Any:
        """Join parts; an error names them."""
        try:
            return join(*parts)
        except OptionError as error:
            raise OptionError(f"{self._location(kind, identifier)}: {error}") from None

    def _annotations(self, ids: NewIds) -> tuple[Annotation, ...]:
        """The annotations of both: those of parts by the new numbers of frames, those of the second by new ids."""
        first_numbers = {key: joint.first for key, joint in self.joints.items()}
        second_numbers = {key: joint.second for key, joint in self.joints.items()}
        first = [_with_frame_numbers(annotation, first_numbers) for annotation in self.first.annotations]
        named = [with_sensor_ids(annotation, ids) for annotation in self.second.annotations]
        second = [_with_frame_numbers(one, second_numbers) for one in named if one is not None]
        known = {key_of(annotation.id): k for k, annotation in enumerate(first)}
        used = set(known) | {key_of(annotation.id) for annotation in second}
        new_ids: dict[Key, Identifier | None] = {}
        joined: set[Key] = set()
        for annotation in second:
            key = key_of(annotation.id)
            if key not in known:
                continue
            part = first[known[key]]
            if self.join and part.type == annotation.type:
                joined.add(key)
                first[known[key]] = self._located("annotations", annotation.id, _joined_annotation, part, annotation)
                self._report_differing(f"annotations[{annotation.id}].", _differing_fields(part, annotation))
            elif self.rename:
                new_ids[key] = _free_id(annotation.id, used)
            else:
                location = self._location("annotations", annotation.id)
                raise OptionError(f"{location}: {self.first.source} has this id, too; `--rename` gives it another")
        further = [with_annotation_ids(a, NewIds(new_ids)) for a in second if key_of(a.id) not in joined]
        return (*first, *(annotation for annotation in further if annotation is not None))

    def _trajectories(self, ids: NewIds) -> Mapping[str, Trajectory]:
        trajectories = dict(self.first.trajectories)
        for name, trajectory in self.second.trajectories.items():
            renamed = ids(name)
            new = name if renamed is None else str(renamed)
            known = trajectories.get(new)
            if known is not None and self.join:
                trajectories[new] = _joined_rows(known, trajectory)
                continue
            if known is not None and _is_same(known, trajectory):
                continue
            if known is not None:
                if not self.rename:
                    raise OptionError(
                        f"{self.second.source}: trajectories[{name}]: {self.first.source} has another trajectory of "
                        "that name; `--rename` gives it another name, `--join` joins the two as parts of one"
                    )
                new = str(_free_id(name, {key_of(other) for other in trajectories}))
            trajectories[new] = replace(trajectory, name=new)
        return trajectories

    def _metadata(self, ids: NewIds) -> Mapping[str, Any]:
        mine, other = ours_of(self.first), metadata_of(ours_of(self.second), ids)
        free = ({name: v for name, v in s.metadata.items() if name != OURS} for s in (self.first, self.second))
        merged, differing = _both_mappings(*free)
        ours, ours_differing = _both_mappings(mine, other)
        for name in _LISTED:
            if isinstance(mine.get(name), list) and isinstance(other.get(name), list):
                ours[name] = [*mine[name], *(entry for entry in other[name] if entry not in mine[name])]
        fusions: list[Any] = [entry.get("fusion") for entry in (mine, other)]
        if all(isinstance(entry, Mapping) and isinstance(entry.get("cameras"), list) for entry in fusions):
            # the cameras of both in the order that `camera_index` counts
            cameras = list(fusions[0]["cameras"])
            cameras += [camera for camera in fusions[1]["cameras"] if camera not in cameras]
            ours["fusion"] = {**fusions[0], "cameras": cameras}
        reported = [f"{OURS}.{name}" for name in ours_differing if name not in (*_LISTED, "fusion")]
        self._report_differing("metadata.", (*differing, *reported), code="metadata-differ")
        return MappingProxyType({**merged, **({OURS: ours} if ours else {})})


def _both_mappings(first: Mapping[str, Any], second: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The fields of both, and the names of those that differ, of which the first's are kept."""
    differing = [name for name in first.keys() & second.keys() if not _is_same(first[name], second[name])]
    return {**second, **first}, sorted(differing)


def _free_id(identifier: Identifier, used: set[Key]) -> Identifier:
    """A new id that is not used, and now is."""
    if isinstance(identifier, int):
        new: Identifier = 1 + max(value for _, value in used if isinstance(value, int))
    else:
        new = next(f"{identifier}-{k}" for k in count(2) if (str, f"{identifier}-{k}") not in used)
    used.add(key_of(new))
    return new


def _with_frame_numbers(annotation: Annotation, numbers: Mapping[Key, Int64Array]) -> Annotation:
    """Give labelled points by the new numbers of their frames."""
    if not isinstance(annotation, LabeledPointsAnnotation) or not numbers:
        return annotation
    entries = []
    for entry in annotation.labeled_points:
        new, frame = numbers.get(key_of(entry.sensor_id)), entry.sensor_frame
        known = new is not None and frame is not None and 0 <= frame < len(new)
        entries.append(replace(entry, sensor_frame=int(new[frame])) if known else entry)  # type: ignore[index]
    return replace(annotation, labeled_points=tuple(entries))
