"""Sensors and annotations of consecutive parts of a drive, joined into one each."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import OptionError
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
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, Shooting, shots_of, with_shots
from sceneloom.scene.clouds import LidarFrame, LidarSensor, PointsSensor, RadarFrame, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor, VectorSamples
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Sensor
from sceneloom.scene.types import key_of

_SAME_TOLERANCE = 1e-6
"""Numbers of two scenes that differ by no more are the same, brought into one world by computing [m], …"""


def is_same(a: Any, b: Any) -> bool:
    """Whether two values, records or arrays state the same, numbers within `_SAME_TOLERANCE`."""
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return _same_arrays(np.asarray(a), np.asarray(b))
    if hasattr(a, "__dataclass_fields__"):
        names = a.__dataclass_fields__
        return type(a) is type(b) and all(is_same(getattr(a, name), getattr(b, name)) for name in names)
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(is_same(a[name], b[name]) for name in a)
    if isinstance(a, Sequence) and isinstance(b, Sequence) and not isinstance(a, str):
        return len(a) == len(b) and all(is_same(x, y) for x, y in zip(a, b, strict=True))
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


def differing_fields(first: Any, second: Any) -> tuple[str, ...]:
    """Name the fields in which two parts of one sensor or annotation differ, and of which only one can stand."""
    names = [name for name in first.__dataclass_fields__ if name not in _JOINED]
    differing = [name for name in names if not is_same(getattr(first, name), getattr(second, name))]
    attributes = (getattr(part, "attributes", ()) for part in (first, second))
    return (*differing, *contradicting(*attributes))


def contradicting(first: Iterable[AttributePath], second: Iterable[AttributePath]) -> tuple[str, ...]:
    """Name the attributes that two parts have both, without times by which they could go on, and that differ."""
    known = {_stated_of(attribute): attribute for attribute in first}
    return tuple(
        f"attributes[{attribute.name}]"
        for attribute in second
        if _stated_of(attribute) in known
        and not (attribute.is_timed and known[_stated_of(attribute)].is_timed)
        and not is_same(known[_stated_of(attribute)], attribute)
    )


def _stated_of(attribute: AttributePath) -> tuple[Any, ...]:
    """What an attribute reports: two of the same are one."""
    sensor = None if attribute.sensor_id is None else key_of(attribute.sensor_id)
    return attribute.name, sensor, attribute.static, attribute.point_index


_Item_co = TypeVar("_Item_co", covariant=True)

_Moving = TypeVar("_Moving", LidarSensor, RadarSensor, CameraSensor, DepthCameraSensor)

_MOUNT_TOLERANCE = 1e-9
"""Mountings of the parts of one sensor that differ by more are two mountings [m], [rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class JoinedFrames(Generic[_Item_co]):
    """Reads the frames of two parts; what `LazyFrames` asks for.

    Attributes:
        parts: the two.
        locations: (N, 2) int64, of each frame its part and its number there.
    """

    parts: tuple[LazyFrames[_Item_co], LazyFrames[_Item_co]]
    locations: Int64Array

    def __call__(self, k: int) -> _Item_co:
        """Read frame `k`.

        Raises:
            DataError: it cannot be read.
        """
        part, number = (int(location) for location in self.locations[k])
        return self.parts[part][number]


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
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
    def of(cls, first_ns: Int64Array, second_ns: Int64Array, name: str) -> "Joint":
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
        return LazyFrames(np.array(timestamps, np.int64), JoinedFrames((first, second), self.locations))


_Joined = tuple[Sensor, Joint | None]


def joined_sensor(first: Sensor, second: Sensor, name: str) -> _Joined:
    """Join two parts of one sensor.

    Returns:
        The sensor, and how its frames were joined; None for one without frames.

    Raises:
        OptionError: they are of different kinds, differently mounted, or do not follow each other.
        DataError: a frame that is in both parts cannot be read.
    """
    join = _JOINS.get(type(first))
    if type(first) is not type(second) or join is None:
        raise OptionError(
            f"{name}: a {first.type} in one scene and a {second.type} in another; expected one kind"
        )
    joined: _Joined = join(first, second, name)
    return joined


def _lidar(first: LidarSensor, second: LidarSensor, name: str) -> _Joined:
    joint = _cloud_joint(first, second, name)
    frames = joint.frames(first.frames, second.frames)
    return replace(_placed(first, second, name), frames=frames), joint


def _radar(first: RadarSensor, second: RadarSensor, name: str) -> _Joined:
    joint = _cloud_joint(first, second, name)
    frames = joint.frames(first.frames, second.frames)
    return replace(_placed(first, second, name), frames=frames), joint


def _cloud_joint(first: Any, second: Any, name: str) -> Joint:
    """Join frames; those of equal timestamps must have equal points."""
    if first.points_frame is not second.points_frame:
        raise OptionError(
            f"{name}: points in the {first.points_frame} frame in one scene and in the {second.points_frame} frame in "
            "another; expected one frame"
        )
    joint = Joint.of(first.frames.timestamps_ns, second.frames.timestamps_ns, name)
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
    joint = Joint.of(shots.timestamps_ns, further.timestamps_ns, name)
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
        raise OptionError(
            f"{name}: poses in {first.coordinates} and in {second.coordinates}; expected one frame"
        )
    return replace(first, poses=_joined_path(first.poses, second.poses, name))


def _check_mounts(first: RigidTransform | None, second: RigidTransform | None, name: str) -> None:
    if (first is None) != (second is None) or (
        first is not None
        and second is not None
        and np.abs(first.matrix - second.matrix).max() > _MOUNT_TOLERANCE
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


def joined_trajectory(first: Trajectory, second: Trajectory) -> Trajectory:
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
    if not is_same(first, second):
        raise OptionError(
            f"{name}: differs between the scenes and has no time; expected the same, or another id"
        )
    return first, None


_JOINS: Mapping[type, Callable[[Any, Any, str], _Joined]] = MappingProxyType(
    {
        LidarSensor: _lidar,
        RadarSensor: _radar,
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


def joined_annotation(first: Annotation, second: Annotation, name: str) -> Annotation:
    """Join two parts of one annotation; of two keyframes at one time that of the first counts.

    Raises:
        OptionError: they are of different types, or cannot be parts of one.
    """
    join = _JOINED_ANNOTATIONS_JOINS.get(type(first))
    if type(first) is not type(second) or first.type != second.type or join is None:
        if is_same(first, second):
            return first
        raise OptionError(f"{name}: a {first.type} in one scene and a {second.type} in another; expected one")
    joined: Any = join(first, second, name)
    if isinstance(first, LocalizationAdjustment | CameraCalibration):
        return joined  # type: ignore[no-any-return]
    stated: Any = second
    return replace(joined, attributes=joined_attributes(joined.attributes, stated.attributes))  # type: ignore[no-any-return]


def _joined_rows(first: Any, second: Any) -> Any:
    """Join what has timestamps and an entry of some fields for each; a field that one lacks is left out."""
    rows = _new_rows(first.timestamps_ns, second.timestamps_ns)
    chosen: dict[str, Any] = {
        "timestamps_ns": np.concatenate([first.timestamps_ns, second.timestamps_ns])[rows]
    }
    for name in _ROWS:
        if hasattr(first, name):
            chosen[name] = _rows(getattr(first, name), getattr(second, name), rows)
    return replace(first, **chosen)


def _rows(a: Any, b: Any, rows: Int64Array) -> Any:
    if a is None or b is None:
        return None
    if isinstance(a, tuple):
        both = (*a, *b)
        return tuple(both[row] for row in rows.tolist())
    return np.concatenate([a, b])[rows]


def joined_attributes(
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


def _entries(first: tuple[Any, ...], second: tuple[Any, ...]) -> tuple[Any, ...]:
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
    there = all(is_same(getattr(a, name), getattr(b, name)) for name in _ROWS if hasattr(a, name))
    return a if still and there else _joined_rows(a, b)


def _cuboid(first: CuboidAnnotation, second: CuboidAnnotation, name: str) -> CuboidAnnotation:
    del name
    return replace(
        first,
        path=_joined_paths(first, second),
        activations=_entries(first.activations, second.activations),
        projections=_entries(first.projections, second.projections),
    )


def _path(first: Any, second: Any, name: str) -> Any:
    if not is_same(first.sensor_id, second.sensor_id):
        raise OptionError(
            f"{name}: of sensor {first.sensor_id!r} and of {second.sensor_id!r}; expected one sensor"
        )
    return replace(first, path=_joined_paths(first, second))


def _points(first: PointsAnnotation, second: PointsAnnotation, name: str) -> PointsAnnotation:
    if len(first.paths) != len(second.paths):
        raise OptionError(
            f"{name}: {len(first.paths)} points and {len(second.paths)} points; expected as many"
        )
    paths = (_joined_rows(a, b) for a, b in zip(first.paths, second.paths, strict=True))
    count = max(len(first.projections), len(second.projections))
    a, b = (((*given, *((),) * count)[:count]) for given in (first.projections, second.projections))
    projections = (_entries(x, y) for x, y in zip(a, b, strict=True))
    return replace(first, paths=tuple(paths), projections=tuple(projections))


def _labelled(
    first: LabeledPointsAnnotation, second: LabeledPointsAnnotation, name: str
) -> LabeledPointsAnnotation:
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


def _adjustment(
    first: LocalizationAdjustment, second: LocalizationAdjustment, name: str
) -> LocalizationAdjustment:
    return replace(first, poses=_joined_path(first.poses, second.poses, name))


def _calibration(first: CameraCalibration, second: CameraCalibration, name: str) -> CameraCalibration:
    poses = first.poses if second.poses is None else second.poses
    if first.poses is not None and second.poses is not None:
        poses = _joined_path(first.poses, second.poses, name)
    stated = ((a.sensor_id, a.intrinsics, a.time_offset_ns) for a in (first, second))
    if not is_same(*stated):
        raise OptionError(
            f"{name}: another camera, camera model or time offset in one scene than in another; expected one"
        )
    return replace(first, poses=poses)


def _first(first: Any, second: Any, name: str) -> Any:
    del second, name
    return first


def _link(first: LinkAnnotation, second: LinkAnnotation, name: str) -> LinkAnnotation:
    if not is_same((first.from_id, first.to_id), (second.from_id, second.to_id)):
        raise OptionError(f"{name}: joins other annotations in one scene than in another; expected one link")
    return first


_JOINED_ANNOTATIONS_JOINS: Mapping[type, Callable[[Any, Any, str], Any]] = MappingProxyType(
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
