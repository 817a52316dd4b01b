"""Several scenes of one drive merged: whether they are of one drive, in one world and with one set of ids."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.editing.move_points import FrameChange
from sceneloom.editing.move_world import moved_world
from sceneloom.editing.references import (
    OURS,
    NewIds,
    assumed,
    attributes_of,
    metadata_of,
    ours_of,
    recounted,
    skipped,
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
    CuboidPath,
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
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, Shooting, shots_of, with_shots
from sceneloom.scene.clouds import LidarFrame, LidarSensor, PointsSensor, RadarFrame, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor, VectorSamples
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene, Sensor, frame_times
from sceneloom.scene.types import Coordinates, Identifier, Key, key_of
from sceneloom.warnings import DataWarning

_SAME_TOLERANCE = 1e-6
"""Numbers of two scenes that differ by no more are the same, brought into one world by computing [m], …"""


def _is_same(a: Any, b: Any) -> bool:
    """Whether two values, records or arrays state the same, numbers within `_SAME_TOLERANCE`."""
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return _same_arrays(np.asarray(a), np.asarray(b))
    if hasattr(a, "__dataclass_fields__"):
        names = a.__dataclass_fields__
        return type(a) is type(b) and all(_is_same(getattr(a, name), getattr(b, name)) for name in names)
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(_is_same(a[name], b[name]) for name in a)
    if isinstance(a, Sequence) and isinstance(b, Sequence) and not isinstance(a, str):
        return len(a) == len(b) and all(_is_same(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b)


def _same_arrays(a: Any, b: Any) -> bool:
    if a.shape != b.shape or a.dtype.kind != b.dtype.kind:
        return False
    if a.dtype.kind != "f":
        return bool(np.array_equal(a, b))
    return bool(np.allclose(a, b, rtol=0.0, atol=_SAME_TOLERANCE, equal_nan=True))


_JOINED = frozenset(
    (
        *("frames", "images", "video", "poses", "mount", "streams"),
        *("timestamps_ns", "positions_lla", "accuracies", "vertical_accuracies", "file_seconds"),
        *("path", "paths", "activations", "projections", "labeled_points", "start_ns", "duration_ns"),
        "attributes",
    )
)
"""Fields of sensors and annotations that are joined from those of both parts, or that must be the same in both."""


def _differing_fields(first: Any, second: Any) -> tuple[str, ...]:
    """Name the fields in which two parts of one sensor or annotation differ, and of which only one can stand."""
    names = [name for name in first.__dataclass_fields__ if name not in _JOINED]
    differing = [name for name in names if not _is_same(getattr(first, name), getattr(second, name))]
    attributes = (getattr(part, "attributes", ()) for part in (first, second))
    return (*differing, *_contradicting(*attributes))


def _contradicting(first: Iterable[AttributePath], second: Iterable[AttributePath]) -> tuple[str, ...]:
    """Name the attributes that two parts have both, without times by which they could go on, and that differ."""
    known = {_stated_of(attribute): attribute for attribute in first}
    return tuple(
        f"attributes[{attribute.name}]"
        for attribute in second
        if _stated_of(attribute) in known
        and not (attribute.is_timed and known[_stated_of(attribute)].is_timed)
        and not _is_same(known[_stated_of(attribute)], attribute)
    )


def _stated_of(attribute: AttributePath) -> tuple[Any, ...]:
    """What an attribute reports: two of the same are one."""
    sensor = None if attribute.sensor_id is None else key_of(attribute.sensor_id)
    return attribute.name, sensor, attribute.static, attribute.point_index


_Moving = TypeVar("_Moving", LidarSensor, RadarSensor, CameraSensor, DepthCameraSensor)

_MOUNT_TOLERANCE = 1e-9
"""Mountings of the parts of one sensor that differ by more are two mountings [m], [rad]."""


def _frame_of_parts(parts: tuple[LazyFrames[Any], LazyFrames[Any]], locations: Int64Array, k: int) -> Any:
    part, number = locations[k].tolist()
    return parts[part][number]


@dataclass(frozen=True, slots=True, eq=False)
class _Joint:
    """How the frames of a second part go on from those of a first.

    Attributes:
        locations: (N, 2) int64, of each frame of the whole its part and its number there.
        first, second: (M,) int64, new number of each frame of a part.
        twice: how many frames are in both.
    """

    locations: Int64Array
    first: Int64Array
    second: Int64Array
    twice: int

    @classmethod
    def of(cls, first_ns: Int64Array, second_ns: Int64Array, name: str) -> "_Joint":
        """Join by timestamps; frames of equal timestamps are one.

        Raises:
            OptionError: frames of one part lie between those of the other.
        """
        alone = np.flatnonzero(~np.isin(second_ns, first_ns))
        timestamps = np.concatenate([first_ns, second_ns[alone]])
        parts = np.concatenate([np.zeros(len(first_ns), np.int64), np.ones(len(alone), np.int64)])
        numbers = np.concatenate([np.arange(len(first_ns)), alone])
        order = np.argsort(timestamps, kind="stable")
        if np.count_nonzero(np.diff(parts[order])) > 1:
            raise OptionError(
                f"{name}: the frames of the second part lie between those of the first; expected parts that follow "
                "each other"
            )
        new = np.empty(len(order), np.int64)
        new[order] = np.arange(len(order))
        second = np.empty(len(second_ns), np.int64)
        second[alone] = new[len(first_ns) :]
        both = np.flatnonzero(np.isin(second_ns, first_ns))
        by_time = np.argsort(first_ns, kind="stable")
        second[both] = new[by_time[np.searchsorted(first_ns, second_ns[both], sorter=by_time)]]
        locations = np.stack([parts[order], numbers[order]], axis=1)
        return cls(locations, new[: len(first_ns)], second, len(both))

    def frames(self, first: LazyFrames[Any], second: LazyFrames[Any]) -> LazyFrames[Any]:
        """The frames of the whole."""
        timestamps = [(first, second)[part].timestamps_ns[number] for part, number in self.locations.tolist()]
        return LazyFrames(np.array(timestamps, np.int64), partial(_frame_of_parts, (first, second), self.locations))


_Joined = tuple[Sensor, _Joint | None]


def _joined_sensor(first: Sensor, second: Sensor, name: str) -> _Joined:
    """Join two parts of one sensor.

    Returns:
        The sensor, and how its frames were joined; None for one without frames.

    Raises:
        OptionError: they are of different kinds, differently mounted, or do not follow each other.
        DataError: a frame that is in both parts cannot be read.
    """
    join = _SENSOR_JOINS.get(type(first))
    if type(first) is not type(second) or join is None:
        raise OptionError(f"{name}: a {first.type} in one scene and a {second.type} in another; expected one kind")
    joined: _Joined = join(first, second, name)
    return joined


def _cloud(first: Any, second: Any, name: str) -> _Joined:
    joint = _cloud_joint(first, second, name)
    return replace(_placed(first, second, name), frames=joint.frames(first.frames, second.frames)), joint


def _cloud_joint(first: Any, second: Any, name: str) -> _Joint:
    """Join frames; those of equal timestamps must have equal points."""
    if first.points_frame is not second.points_frame:
        raise OptionError(
            f"{name}: points in the {first.points_frame} frame in one scene and in the {second.points_frame} frame in "
            "another; expected one frame"
        )
    joint = _Joint.of(first.frames.timestamps_ns, second.frames.timestamps_ns, name)
    for k in np.flatnonzero(np.isin(second.frames.timestamps_ns, first.frames.timestamps_ns)).tolist():
        part, number = joint.locations[joint.second[k]].tolist()
        if part == 0 and not _equal_points(first.frames[number], second.frames[k]):
            timestamp = second.frames.timestamps_ns[k]
            raise OptionError(f"{name}: two frames at {timestamp} ns whose points differ; expected one")
    return joint


def _equal_points(a: LidarFrame | RadarFrame, b: LidarFrame | RadarFrame) -> bool:
    return np.array_equal(a.points.positions, b.points.positions, equal_nan=True)


def _camera(first: Shooting, second: Shooting, name: str) -> _Joined:
    """Join shots; those of equal timestamps are one, though another encoding may have changed them."""
    shots, further = shots_of(first), shots_of(second)
    joint = _Joint.of(shots.timestamps_ns, further.timestamps_ns, name)
    placed = _placed(first, second, name)
    if len(further) == joint.twice:
        return placed, joint
    video = second.video if len(shots) == 0 else None
    return with_shots(placed, joint.frames(shots, further), video), joint


def _placed(first: _Moving, second: _Moving, name: str) -> _Moving:
    """The first part with the poses of both."""
    _check_mounts(first.mount, second.mount, name)
    if first.poses is None or second.poses is None:
        return replace(first, poses=first.poses or second.poses)
    if first.coordinates is not second.coordinates:
        raise OptionError(f"{name}: poses in {first.coordinates} and in {second.coordinates}; expected one frame")
    return replace(first, poses=_joined_path(first.poses, second.poses, name))


def _check_mounts(first: RigidTransform | None, second: RigidTransform | None, name: str) -> None:
    if (first is None) != (second is None) or (
        first is not None and second is not None and np.abs(first.matrix - second.matrix).max() > _MOUNT_TOLERANCE
    ):
        raise OptionError(f"{name}: mounted otherwise in one scene than in another; expected one mounting")


def _joined_path(first: Poses, second: Poses, name: str) -> Poses:
    """The poses of both; of two at one time that of the first.

    Raises:
        OptionError: one holds at all times and is not the same in both.
    """
    if first.static and second.static:
        same = np.allclose(first.positions, second.positions, rtol=0, atol=_MOUNT_TOLERANCE) and np.allclose(
            first.quaternions_xyzw, second.quaternions_xyzw, rtol=0, atol=_MOUNT_TOLERANCE
        )
        if same:
            return first
    if first.static or second.static:
        raise OptionError(f"{name}: is stationary in one scene, and elsewhere or moves in another")
    rows = _new_rows(first.timestamps_ns, second.timestamps_ns)
    return Poses(
        np.concatenate([first.timestamps_ns, second.timestamps_ns])[rows],
        np.concatenate([first.positions, second.positions])[rows],
        np.concatenate([first.quaternions_xyzw, second.quaternions_xyzw])[rows],
    )


def _new_rows(first_ns: Int64Array, second_ns: Int64Array) -> Int64Array:
    """The rows of two series put one behind the other that make one series in order; of equal times the first."""
    return np.unique(np.concatenate([first_ns, second_ns]), return_index=True)[1]


def _odometry(first: OdometrySensor, second: OdometrySensor, name: str) -> _Joined:
    return replace(first, poses=_joined_path(first.poses, second.poses, name)), None


def _joined_trajectory(first: Trajectory, second: Trajectory) -> Trajectory:
    """The poses of both; of two at one time that of the first, and only what both have."""
    rows = _new_rows(first.timestamps_ns, second.timestamps_ns)
    names = ("positions", "quaternions_xyzw", "file_seconds", "covariances")
    timestamps = np.concatenate([first.timestamps_ns, second.timestamps_ns])[rows]
    return Trajectory(
        first.name, timestamps, *(_both(getattr(first, name), getattr(second, name), rows) for name in names)
    )


def _both(a: Any, b: Any, rows: Int64Array) -> Any:
    return None if a is None or b is None else np.concatenate([a, b])[rows]


def _imu(first: ImuSensor, second: ImuSensor, name: str) -> _Joined:
    del name
    streams = {**second.streams, **first.streams}
    for stream in set(first.streams) & set(second.streams):
        a, b = first.streams[stream], second.streams[stream]
        rows = _new_rows(a.timestamps_ns, b.timestamps_ns)
        streams[stream] = VectorSamples(
            np.concatenate([a.timestamps_ns, b.timestamps_ns])[rows],
            np.concatenate([a.values, b.values])[rows],
            _both(a.file_seconds, b.file_seconds, rows),
        )
    return replace(first, streams=streams), None


def _gnss(first: GnssSensor, second: GnssSensor, name: str) -> _Joined:
    _check_mounts(first.mount, second.mount, name)
    rows = _new_rows(first.timestamps_ns, second.timestamps_ns)
    names = ("timestamps_ns", "positions_lla", "accuracies", "vertical_accuracies", "file_seconds")
    arrays = {what: _both(getattr(first, what), getattr(second, what), rows) for what in names}
    return replace(first, **arrays), None


def _unchanging(first: Any, second: Any, name: str) -> _Joined:
    if not _is_same(first, second):
        raise OptionError(f"{name}: differs between the scenes and has no time; expected the same, or another id")
    return first, None


_SENSOR_JOINS: Mapping[type, Callable[[Any, Any, str], _Joined]] = MappingProxyType(
    {
        LidarSensor: _cloud,
        RadarSensor: _cloud,
        CameraSensor: _camera,
        DepthCameraSensor: _camera,
        OdometrySensor: _odometry,
        ImuSensor: _imu,
        GnssSensor: _gnss,
        PointsSensor: _unchanging,
        PlainSensor: _unchanging,
    }
)
"""How the parts of each kind of sensor are joined."""

_ROWS = ("values", "vertices", "boxes", "cuboids", "points", "positions", "durations_ns", "confirmed")
"""Fields of paths, activations and projections that have one entry per timestamp."""


def _joined_annotation(first: Annotation, second: Annotation, name: str) -> Annotation:
    """Join two parts of one annotation; of two keyframes at one time that of the first counts.

    Raises:
        OptionError: they are of different types, or cannot be parts of one.
    """
    join = _ANNOTATION_JOINS.get(type(first))
    if type(first) is not type(second) or first.type != second.type or join is None:
        if _is_same(first, second):
            return first
        raise OptionError(f"{name}: a {first.type} in one scene and a {second.type} in another; expected one")
    joined: Any = join(first, second, name)
    if isinstance(first, LocalizationAdjustment | CameraCalibration):
        return joined  # type: ignore[no-any-return]
    stated: Any = second
    return replace(joined, attributes=_joined_attributes(joined.attributes, stated.attributes))  # type: ignore[no-any-return]


def _joined_rows(first: Any, second: Any) -> Any:
    """Join what has timestamps and an entry of some fields for each; a field that one lacks is left out."""
    rows = _new_rows(first.timestamps_ns, second.timestamps_ns)
    chosen: dict[str, Any] = {"timestamps_ns": np.concatenate([first.timestamps_ns, second.timestamps_ns])[rows]}
    for name in _ROWS:
        if hasattr(first, name):
            chosen[name] = _joined_columns(getattr(first, name), getattr(second, name), rows)
    return replace(first, **chosen)


def _joined_columns(a: Any, b: Any, rows: Int64Array) -> Any:
    if a is None or b is None:
        return None
    if isinstance(a, tuple):
        both = (*a, *b)
        return tuple(both[row] for row in rows.tolist())
    return np.concatenate([a, b])[rows]


def _joined_attributes(
    first: tuple[AttributePath, ...], second: tuple[AttributePath, ...]
) -> tuple[AttributePath, ...]:
    """Join attributes of one name, sensor and point; one whose values have no times each is that of the first."""
    joined = {_stated_of(attribute): attribute for attribute in first}
    alone = []
    for attribute in second:
        known = joined.get(_stated_of(attribute))
        if known is None:
            alone.append(attribute)
        elif known.is_timed and attribute.is_timed:
            joined[_stated_of(attribute)] = _joined_rows(known, attribute)
    return (*joined.values(), *alone)


def _joined_entries(first: tuple[Any, ...], second: tuple[Any, ...]) -> tuple[Any, ...]:
    """Join entries per sensor."""
    joined = {key_of(entry.sensor_id): entry for entry in first}
    for entry in second:
        key = key_of(entry.sensor_id)
        joined[key] = _joined_rows(joined[key], entry) if key in joined else entry
    return tuple(joined.values())


def _joined_paths(first: Any, second: Any) -> Any:
    """The path of both; of what is stationary at one location in both parts that of the first."""
    still = all(getattr(part, "stationary", None) for part in (first, second))
    a, b = first.path, second.path
    there = all(_is_same(getattr(a, name), getattr(b, name)) for name in _ROWS if hasattr(a, name))
    return a if still and there else _joined_rows(a, b)


def _cuboid(first: CuboidAnnotation, second: CuboidAnnotation, name: str) -> CuboidAnnotation:
    del name
    return replace(
        first,
        path=_joined_paths(first, second),
        activations=_joined_entries(first.activations, second.activations),
        projections=_joined_entries(first.projections, second.projections),
    )


def _path(first: Any, second: Any, name: str) -> Any:
    if not _is_same(first.sensor_id, second.sensor_id):
        raise OptionError(f"{name}: of sensor {first.sensor_id!r} and of {second.sensor_id!r}; expected one sensor")
    return replace(first, path=_joined_paths(first, second))


def _points(first: PointsAnnotation, second: PointsAnnotation, name: str) -> PointsAnnotation:
    if len(first.paths) != len(second.paths):
        raise OptionError(f"{name}: {len(first.paths)} points and {len(second.paths)} points; expected as many")
    paths = (_joined_rows(a, b) for a, b in zip(first.paths, second.paths, strict=True))
    count = max(len(first.projections), len(second.projections))
    a, b = (((*given, *((),) * count)[:count]) for given in (first.projections, second.projections))
    projections = (_joined_entries(x, y) for x, y in zip(a, b, strict=True))
    return replace(first, paths=tuple(paths), projections=tuple(projections))


def _labelled(first: LabeledPointsAnnotation, second: LabeledPointsAnnotation, name: str) -> LabeledPointsAnnotation:
    del name
    joined = {(key_of(entry.sensor_id), entry.sensor_frame): entry for entry in first.labeled_points}
    for entry in second.labeled_points:
        location = (key_of(entry.sensor_id), entry.sensor_frame)
        known = joined.get(location)
        ids = entry.point_ids if known is None else np.union1d(known.point_ids, entry.point_ids)
        joined[location] = replace(entry, point_ids=ids.astype(np.uint32))
    return replace(first, labeled_points=tuple(joined.values()))


def _event(first: EventAnnotation, second: EventAnnotation, name: str) -> EventAnnotation:
    """From the beginning of the earlier part to the end of the later one."""
    del name
    start_ns = min(first.start_ns, second.start_ns)
    duration_ns = max(event.start_ns + (event.duration_ns or 0) for event in (first, second)) - start_ns
    untold = first.duration_ns is None and second.duration_ns is None and duration_ns == 0
    return replace(first, start_ns=start_ns, duration_ns=None if untold else duration_ns)


def _adjustment(first: LocalizationAdjustment, second: LocalizationAdjustment, name: str) -> LocalizationAdjustment:
    return replace(first, poses=_joined_path(first.poses, second.poses, name))


def _calibration(first: CameraCalibration, second: CameraCalibration, name: str) -> CameraCalibration:
    poses = first.poses if second.poses is None else second.poses
    if first.poses is not None and second.poses is not None:
        poses = _joined_path(first.poses, second.poses, name)
    stated = ((a.sensor_id, a.intrinsics, a.time_offset_ns) for a in (first, second))
    if not _is_same(*stated):
        raise OptionError(
            f"{name}: another camera, camera model or time offset in one scene than in another; expected one"
        )
    return replace(first, poses=poses)


def _first(first: Any, second: Any, name: str) -> Any:
    del second, name
    return first


def _link(first: LinkAnnotation, second: LinkAnnotation, name: str) -> LinkAnnotation:
    if not _is_same((first.from_id, first.to_id), (second.from_id, second.to_id)):
        raise OptionError(f"{name}: joins other annotations in one scene than in another; expected one link")
    return first


_ANNOTATION_JOINS: Mapping[type, Callable[[Any, Any, str], Any]] = MappingProxyType(
    {
        CuboidAnnotation: _cuboid,
        Box2DAnnotation: _path,
        ShapeAnnotation: _path,
        PointsAnnotation: _points,
        LabeledPointsAnnotation: _labelled,
        EventAnnotation: _event,
        LocalizationAdjustment: _adjustment,
        CameraCalibration: _calibration,
        ObjectAnnotation: _first,
        GroupAnnotation: _first,
        LinkAnnotation: _link,
    }
)
"""How the parts of each kind of annotation are joined."""


_WORLD_FROM_FILE = "world_from_file"
"""Our entry of the metadata with the transform that an earlier edit took off all locations in the world."""

_SAME_WORLD = 1e-9
"""Transforms that differ by no more are one [m], [rad]."""


def _in_world_of(scene: Scene, first: Scene) -> Scene:
    """Give a scene in the world of another one, as far as their metadata report how the two are related.

    Raises:
        DataError: the metadata of one hold no rigid transform where they should.
    """
    mine, other = _world_from_file(scene), _world_from_file(first)
    if mine is None and other is None:
        return scene
    here = RigidTransform.identity() if mine is None else mine
    there = RigidTransform.identity() if other is None else other
    first_from_here = there.inverse() @ here
    reported = scene
    if mine is None or other is None:
        which = scene if mine is None else first
        what = "nothing says that its origin was moved; taken to be the world that the others were moved from"
        reported = with_warnings(scene, [assumed("worlds-related", which.source, what)])
    if np.abs(first_from_here.matrix - np.eye(4)).max() > _SAME_WORLD:
        reported = moved_world(reported, FrameChange.constant(first_from_here))
    entry = ours_of(first).get(_WORLD_FROM_FILE)
    return with_ours(reported, **{_WORLD_FROM_FILE: entry})


_CITY_WORDS = frozenset({"city", "city_name", "location", "map_name"})
"""Names of metadata that state where a drive was."""

_LONGEST_GAP_S = 3600.0
"""Parts of one drive are not further apart in time."""

_FASTEST = 100.0
"""No vehicle is faster [m/s]."""

_SAME_LOCATION = 100.0
"""How far apart fixes or poses of one ego may be at one time [m]: receivers and their antennas differ."""


def _different_drives(first: Scene, second: Scene) -> list[str]:
    """Report why two scenes in one world are not of one drive; empty where nothing speaks against it."""
    reasons = []
    here, there = _cities(first.metadata), _cities(second.metadata)
    if here and there and here.isdisjoint(there):
        reasons.append(f"it was in {', '.join(sorted(there))}, the other in {', '.join(sorted(here))}")
    spans = _span_ns(first), _span_ns(second)
    if None not in spans:
        gap_s = (max(span[0] for span in spans if span) - min(span[1] for span in spans if span)) / 1e9
        if gap_s > _LONGEST_GAP_S:
            reasons.append(f"{_duration(gap_s)} are between them")
    apart = _apart(_fixes(first), _fixes(second))
    if apart is not None:
        reasons.append(f"their satellite fixes are {apart / 1000:,.1f} km apart")
    apart = _apart(_ego(first), _ego(second))
    if apart is not None:
        reasons.append(f"their egos are {apart:,.0f} m apart at one time")
    return reasons


def _nothing_relates(first: Scene, second: Scene) -> bool:
    """Whether `_different_drives` had nothing to compare but times, which of clocks that begin at 0 state nothing."""
    evidence = ((_cities(scene.metadata), _fixes(scene), _ego(scene)) for scene in (first, second))
    return not any(here and there for here, there in zip(*evidence, strict=True))


def _cities(metadata: Mapping[str, Any], depth: int = 0) -> set[str]:
    """What metadata call the location, in words without case."""
    found: set[str] = set()
    for name, value in metadata.items():
        if isinstance(value, str) and value.strip() and name.lower() in _CITY_WORDS:
            found.add(value.strip().casefold())
        elif isinstance(value, Mapping) and depth < 3:
            found |= _cities(value, depth + 1)
    return found


def _span_ns(scene: Scene) -> tuple[int, int] | None:
    stated = [*map(frame_times, scene.sensors), *(one.timestamps_ns for one in scene.trajectories.values())]
    times = np.concatenate([np.zeros(0, np.int64), *stated])
    return (int(times.min()), int(times.max())) if len(times) else None


def _duration(seconds: float) -> str:
    return f"{seconds / 3600:,.1f} h" if seconds < 172_800 else f"{seconds / 86_400:,.0f} days"


_Track = tuple[Int64Array, Float64Array] | None
"""Times (N,) and locations (N, 3) [m]."""


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
    found = [(trajectory.timestamps_ns, trajectory.positions) for trajectory in scene.trajectories.values()]
    for one in scene.sensors:
        if isinstance(one, LidarSensor | RadarSensor | CameraSensor) and one.coordinates is Coordinates.WORLD:
            path = one.poses
            found += [] if path is None or path.static else [(path.timestamps_ns, path.positions)]
    if not found or not len(found[0][0]) or not np.isfinite(found[0][1]).all():
        return None
    return found[0]


def _apart(first: _Track, second: _Track) -> float | None:
    """How far apart two ways are where an ego cannot be on both [m]; None where it can."""
    if first is None or second is None:
        return None
    (times, locations), (other_times, other_locations) = first, second
    inside = (other_times >= times[0]) & (other_times <= times[-1])
    if inside.any():
        with np.errstate(over="ignore", invalid="ignore"):
            at = other_times[inside]
            expected = np.column_stack([np.interp(at, times, locations[:, axis]) for axis in range(3)])
            apart = float(np.median(np.linalg.norm(other_locations[inside] - expected, axis=1)))
        return apart if apart > _SAME_LOCATION else None
    early, late = ((times, locations), (other_times, other_locations))
    if other_times[-1] < times[0]:
        early, late = late, early
    with np.errstate(over="ignore"):
        apart = float(np.linalg.norm(late[1][0] - early[1][-1]))
    gap_s = (int(late[0][0]) - int(early[0][-1])) / 1e9
    return apart if gap_s >= 0 and apart > _SAME_LOCATION + _FASTEST * gap_s else None


def _world_from_file(scene: Scene) -> RigidTransform | None:
    """The transform that was taken off a scene's locations; None where none is named.

    Raises:
        DataError: what is named is no rigid transform.
    """
    named: Any = ours_of(scene).get(_WORLD_FROM_FILE)
    if named is None:
        return None
    location = f"metadata.sceneloom.{_WORLD_FROM_FILE}"
    try:
        matrix: Float64Array = np.array(named, np.float64)
        return RigidTransform.nearest(matrix)[0]
    except (TypeError, ValueError, CalibrationError):
        raise DataError(scene.source, location, f"{named!r}; expected a rigid 4x4 matrix") from None


def _in_words_of(scene: Scene, first: Scene) -> Scene:
    """Give a scene whose cuboids have their angles in the unit and order of another one.

    Raises:
        OptionError: the annotations of one are in the world and those of the other on the ego.
    """
    frames = {annotations_frame(one) for one in (scene, first) if one.annotations}
    if len(frames) > 1:
        raise OptionError(
            f"{scene.source}: its annotations are in the {annotations_frame(scene)} frame, those of {first.source} in "
            f"the {annotations_frame(first)} frame; bring both into the world first: `sceneloom edit to-world`"
        )
    mine, theirs = CuboidAngles.of(scene), CuboidAngles.of(first)
    there = any(isinstance(annotation, CuboidAnnotation) for annotation in scene.annotations)
    if mine == theirs or not there:
        return scene
    annotations = tuple(_stated_otherwise(annotation, mine, theirs) for annotation in scene.annotations)
    changed = replace(scene, annotations=annotations)
    return with_ours(changed, euler_unit=str(theirs.unit), euler_order=theirs.order)


def _stated_otherwise(annotation: Annotation, mine: CuboidAngles, theirs: CuboidAngles) -> Annotation:
    if not isinstance(annotation, CuboidAnnotation):
        return annotation
    path = annotation.path
    return replace(
        annotation,
        path=CuboidPath(path.timestamps_ns, _rows(path.values, mine, theirs), path.extras),
        activations=tuple(_with_rows(entry, mine, theirs) for entry in annotation.activations),
        projections=tuple(_with_rows(entry, mine, theirs) for entry in annotation.projections),
    )


def _with_rows(entry: Any, mine: CuboidAngles, theirs: CuboidAngles) -> Any:
    return entry if entry.cuboids is None else replace(entry, cuboids=_rows(entry.cuboids, mine, theirs))


def _rows(rows: Float64Array, mine: CuboidAngles, theirs: CuboidAngles) -> Float64Array:
    stated = rows.copy()
    there = np.isfinite(rows[:, 6:]).all(axis=1)
    stated[there, 6:] = theirs.from_quaternions(mine.quaternions(rows[there, 6:]))
    return stated


def _merged_metadata(first: Mapping[str, Any], second: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The fields of both; of those that differ the first's. Gives the names of these, too."""
    differing = [name for name in first.keys() & second.keys() if not _is_same(first[name], second[name])]
    return {**second, **first}, sorted(differing)


_SHARED = (OdometrySensor, ImuSensor, GnssSensor, PointsSensor)
"""What several scenes of one drive may each bring along; where it is the same, it stands in the merged scene once."""

_LISTED = ("deskew", "unfused", "extrapolated", "to_ego", "applied")
"""Our entries of the metadata that are lists, of which a merged scene has all."""


def merge_scenes(scenes: Sequence[Scene], *, rename: bool = False, join: bool = False, force: bool = False) -> Scene:
    """Make one scene of several of one drive on one clock.

    Scenes whose metadata state which world they were moved from are brought into the first one's. References follow the
    ids of sensors and annotations that change, and points name the cameras by their new locations. The ego trajectory,
    an IMU, a receiver or a map that is the same in several scenes is taken once.

    Args:
        scenes: two or more; what differs and can stand once only is the first one's, with a warning.
        rename: give new ids to sensors and annotations whose ids stand in an earlier scene, instead of refusing them.
        force: merge scenes, too, that are of different drives by their cities, times, fixes or ego poses; each reason
            is a warning then.
        join: take sensors and annotations of equal ids for consecutive parts of one: frames, poses and paths go on;
            frames with equal timestamps and points are taken once.

    Raises:
        OptionError: there are fewer than two, they are of different drives, or ids, worlds or parts do not go together.
        DataError: a frame that this needs cannot be read.
    """
    if len(scenes) < 2:
        raise OptionError(f"{len(scenes)} scene to merge; expected two or more")
    merged = scenes[0]
    for scene in scenes[1:]:
        placed = _in_world_of(scene, merged)
        reasons = _different_drives(merged, placed)
        if reasons and not force:
            raise OptionError(
                f"{scene.source}: of another drive than {merged.source}: {'; '.join(reasons)}; expected parts of one "
                "drive in one world; state `--force` to merge them all the same"
            )
        unrelated = not reasons and _nothing_relates(merged, placed)
        placed = _in_words_of(placed, merged)
        reported = [assumed("different-drives", scene.source, f"merged all the same: {why}") for why in reasons]
        if unrelated:
            what = "no city, satellite fixes or ego poses to compare with the others; taken to be of one drive"
            reported.append(assumed("drives-unrelated", scene.source, what))
        placed = with_warnings(placed, reported)
        merged = _Merger(merged, rename=rename, join=join).with_scene(placed)
    return replace(
        merged,
        source=" + ".join(scene.source for scene in scenes),
        on_close=partial(_close, tuple(scene.on_close for scene in scenes)),
    )


def _close(closing: tuple[Callable[[], None], ...]) -> None:
    for close in closing:
        close()


@dataclass(slots=True, eq=False)
class _Merger:
    """Takes one more scene into a scene."""

    first: Scene
    rename: bool
    join: bool
    sensor_ids: dict[Key, Identifier | None] = field(default_factory=dict)
    annotation_ids: dict[Key, Identifier | None] = field(default_factory=dict)
    joints: dict[Key, _Joint] = field(default_factory=dict)
    warnings: list[DataWarning] = field(default_factory=list)

    def with_scene(self, scene: Scene) -> Scene:
        self._choose_sensor_ids(scene)
        ids = NewIds(self.sensor_ids)
        renamed = tuple(with_sensor_parent(sensor, ids) for sensor in scene.sensors)
        sensors = self._sensors(scene, renamed)
        moved = [self._follows(annotation, ids) for annotation in scene.annotations]
        first = self._first_annotations()
        annotations = self._annotations(scene, first, [found for found in moved if found is not None])
        stated = attributes_of(scene.attributes, ids)
        attributes = _joined_attributes(self.first.attributes, stated)
        extras, differing = _merged_metadata(self.first.extras, scene.extras)
        self._report_differing("", (*_contradicting(self.first.attributes, stated), *differing))
        metadata = self._metadata(scene, ids)
        merged = replace(
            self.first,
            sensors=sensors,
            annotations=annotations,
            trajectories=self._trajectories(scene),
            attributes=attributes,
            metadata=metadata,
            extras=MappingProxyType(extras),
        )
        new = [warning for warning in scene.warnings if warning not in self.first.warnings]
        return with_warnings(merged, (*new, *self.warnings))

    def _location(self, scene: Scene, kind: str, identifier: Identifier) -> str:
        return f"{scene.source}: {kind}[{identifier!r}]"

    def _choose_sensor_ids(self, scene: Scene) -> None:
        """Find the new id of each sensor whose id stands in the first scene; one that is joined or shared keeps it."""
        taken = {key_of(sensor.id): sensor for sensor in self.first.sensors}
        used = set(taken) | {key_of(sensor.id) for sensor in scene.sensors}
        for sensor in scene.sensors:
            known = taken.get(key_of(sensor.id))
            if known is None or self.join or _shared(known, sensor):
                continue
            if not self.rename:
                raise OptionError(
                    f"{self._location(scene, 'sensors', sensor.id)}: this id stands in {self.first.source}, too; state "
                    "`--rename` to give it another, or `--join` if the two are parts of one sensor"
                )
            self.sensor_ids[key_of(sensor.id)] = _free(sensor.id, used)

    def _sensors(self, scene: Scene, renamed: tuple[Sensor, ...]) -> tuple[Sensor, ...]:
        """The sensors of both; cameras first in the order of the first scene, as points name them."""
        known = {key_of(sensor.id): k for k, sensor in enumerate(self.first.sensors)}
        further = [sensor for sensor in renamed if key_of(sensor.id) not in known]
        cameras = [s for s in (*self.first.sensors, *further) if isinstance(s, CameraSensor)]
        locations = {key_of(camera.id): location for location, camera in enumerate(cameras)}
        old = [camera for camera in renamed if isinstance(camera, CameraSensor)]
        numbers = {k: locations[key_of(camera.id)] for k, camera in enumerate(old)}
        sensors = list(self.first.sensors)
        for sensor in renamed:
            counted = _recounted(sensor, numbers)
            k = known.get(key_of(sensor.id))
            if k is None:
                sensors.append(counted)
            elif self.join:
                sensors[k] = self._joined(scene, sensors[k], counted)
            else:
                what = "the same in both scenes; taken once"
                self.warnings.append(assumed("same-sensor", f"sensors[{sensor.id}]", what))
        return tuple(sensors)

    def _joined(self, scene: Scene, first: Sensor, second: Sensor) -> Sensor:
        location = self._location(scene, "sensors", second.id)
        joined, joint = _joined_sensor(first, second, location)
        self._report_differing(f"sensors[{second.id}].", _differing_fields(first, second))
        if joint is not None:
            self.joints[key_of(second.id)] = joint
            what = "frames that are in both scenes; taken once"
            self.warnings.append(skipped("frames-twice", f"sensors[{second.id}]", what, count=joint.twice))
        if (
            isinstance(first, CameraSensor | DepthCameraSensor)
            and isinstance(joined, CameraSensor | DepthCameraSensor)
            and first.video is not joined.video
        ):
            what = "the videos of parts cannot be joined; its images are taken one by one"
            self.warnings.append(assumed("video-in-images", f"sensors[{second.id}].video", what))
        return joined

    def _report_differing(self, where: str, names: Iterable[str], *, code: str = "fields-differ") -> None:
        what = "differs between the scenes; that of the first is kept"
        self.warnings.extend(skipped(code, f"{where}{name}", what) for name in names)

    def _first_annotations(self) -> list[Annotation]:
        numbers = {key: joint.first for key, joint in self.joints.items()}
        return [_renumbered(annotation, numbers) for annotation in self.first.annotations]

    def _follows(self, annotation: Annotation, ids: NewIds) -> Annotation | None:
        """An annotation of the second scene by the new ids of its sensors and the new numbers of its frames."""
        named = with_sensor_ids(annotation, ids)
        numbers = {key: joint.second for key, joint in self.joints.items()}
        return None if named is None else _renumbered(named, numbers)

    def _annotations(self, scene: Scene, first: list[Annotation], second: list[Annotation]) -> tuple[Annotation, ...]:
        known = {key_of(annotation.id): k for k, annotation in enumerate(first)}
        used = set(known) | {key_of(annotation.id) for annotation in second}
        joined: set[Key] = set()
        for annotation in second:
            key = key_of(annotation.id)
            if key not in known:
                continue
            location = self._location(scene, "annotations", annotation.id)
            if self.join and first[known[key]].type == annotation.type:
                joined.add(key)
                part = first[known[key]]
                first[known[key]] = _joined_annotation(part, annotation, location)
                self._report_differing(f"annotations[{annotation.id}].", _differing_fields(part, annotation))
            elif self.rename:
                self.annotation_ids[key] = _free(annotation.id, used)
            else:
                raise OptionError(f"{location}: this id stands in {self.first.source}, too; state `--rename`")
        ids = NewIds(self.annotation_ids)
        further = [with_annotation_ids(a, ids) for a in second if key_of(a.id) not in joined]
        return (*first, *(annotation for annotation in further if annotation is not None))

    def _trajectories(self, scene: Scene) -> Mapping[str, Trajectory]:
        trajectories = dict(self.first.trajectories)
        for name, trajectory in scene.trajectories.items():
            renamed = NewIds(self.sensor_ids)(name)
            new = name if renamed is None else str(renamed)
            known = trajectories.get(new)
            if known is None:
                trajectories[new] = replace(trajectory, name=new)
            elif self.join:
                trajectories[new] = _joined_trajectory(known, trajectory)
            elif not _is_same(known, trajectory):
                if not self.rename:
                    raise OptionError(
                        f"{scene.source}: trajectories[{name}]: another way of that name stands in "
                        f"{self.first.source}; state `--rename` to give it another name, or `--join` if the two are "
                        f"parts"
                    )
                new = str(_free(name, {key_of(other) for other in trajectories}))
                trajectories[new] = replace(trajectory, name=new)
        return trajectories

    def _metadata(self, scene: Scene, ids: NewIds) -> Mapping[str, Any]:
        mine, other = ours_of(self.first), metadata_of(ours_of(scene), ids)
        free = [{name: v for name, v in s.metadata.items() if name != OURS} for s in (self.first, scene)]
        merged, differing = _merged_metadata(free[0], free[1])
        ours, ours_differing = _merged_metadata(mine, other)
        for name in _LISTED:
            lists = [stated[name] for stated in (mine, other) if isinstance(stated.get(name), list)]
            if len(lists) == 2:
                ours[name] = [*lists[0], *(entry for entry in lists[1] if entry not in lists[0])]
        ours.update(_fusion(mine, other))
        reported = [
            *differing,
            *(f"{OURS}.{name}" for name in ours_differing if name not in (*_LISTED, "fusion")),
        ]
        self._report_differing("metadata.", reported, code="metadata-differ")
        return MappingProxyType({**merged, **({OURS: ours} if ours else {})})


def _fusion(mine: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """What the first fusion stated, with the cameras of both in the order that points name them by."""
    stated = [entry.get("fusion") for entry in (mine, other)]
    if not all(isinstance(entry, Mapping) and isinstance(entry.get("cameras"), list) for entry in stated):
        return {}
    cameras = list(stated[0]["cameras"])  # type: ignore[index]
    cameras += [camera for camera in stated[1]["cameras"] if camera not in cameras]  # type: ignore[index]
    return {"fusion": {**stated[0], "cameras": cameras}}  # type: ignore[dict-item]


def _shared(known: Sensor, sensor: Sensor) -> bool:
    return isinstance(sensor, _SHARED) and _is_same(known, sensor)


def _recounted(sensor: Sensor, numbers: dict[int, int]) -> Sensor:
    same = all(old == new for old, new in numbers.items())
    return sensor if same or not isinstance(sensor, LidarSensor) else recounted(sensor, numbers)


def _free(identifier: Identifier, used: set[Key]) -> Identifier:
    """A new id that is not used, and now is."""
    number = 2
    if isinstance(identifier, int):
        new: Identifier = 1 + max(value for _, value in used if isinstance(value, int))
    else:
        while (str, f"{identifier}-{number}") in used:
            number += 1
        new = f"{identifier}-{number}"
    used.add(key_of(new))
    return new


def _renumbered(annotation: Annotation, numbers: Mapping[Key, Int64Array]) -> Annotation:
    """Give labelled points by the new numbers of their frames."""
    if not isinstance(annotation, LabeledPointsAnnotation) or not numbers:
        return annotation
    entries = []
    for entry in annotation.labeled_points:
        new = numbers.get(key_of(entry.sensor_id))
        frame = entry.sensor_frame
        known = new is not None and frame is not None and 0 <= frame < len(new)
        entries.append(replace(entry, sensor_frame=int(new[frame])) if known else entry)  # type: ignore[index]
    return replace(annotation, labeled_points=tuple(entries))
