"""Consecutive parts of one sensor joined into one sensor."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.editing.sameness import is_same
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, PointsSensor, RadarFrame, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, VectorSamples
from sceneloom.scene.plain import PlainSensor
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Sensor
from sceneloom.scene.shooting import Shooting, shots_of, with_shots

Item_co = TypeVar("Item_co", covariant=True)
Moving = TypeVar("Moving", LidarSensor, RadarSensor, CameraSensor, DepthCameraSensor)

MOUNT_TOLERANCE = 1e-9
"""Mountings of the parts of one sensor that differ by more are two mountings [m], [rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class JoinedFrames(Generic[Item_co]):
    """Reads the frames of two parts; what `LazyFrames` asks for.

    Attributes:
        parts: the two.
        locations: (N, 2) int64, of each frame its part and its number there.
    """

    parts: tuple[LazyFrames[Item_co], LazyFrames[Item_co]]
    locations: Int64Array

    def __call__(self, k: int) -> Item_co:
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


Joined = tuple[Sensor, Joint | None]


def joined_sensor(first: Sensor, second: Sensor, name: str) -> Joined:
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
    joined: Joined = join(first, second, name)
    return joined


def _lidar(first: LidarSensor, second: LidarSensor, name: str) -> Joined:
    joint = _cloud_joint(first, second, name)
    frames = joint.frames(first.frames, second.frames)
    return replace(_placed(first, second, name), frames=frames), joint


def _radar(first: RadarSensor, second: RadarSensor, name: str) -> Joined:
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


def _camera(first: Shooting, second: Shooting, name: str) -> Joined:
    """Join shots; those of equal timestamps are one, though another encoding may have changed them."""
    shots, further = shots_of(first), shots_of(second)
    joint = Joint.of(shots.timestamps_ns, further.timestamps_ns, name)
    placed = _placed(first, second, name)
    if len(further) == joint.twice:
        return placed, joint
    video = second.video if len(shots) == 0 else None
    return with_shots(placed, joint.frames(shots, further), video), joint


def _placed(first: Moving, second: Moving, name: str) -> Moving:
    """The first part with the poses of both."""
    _check_mounts(first.mount, second.mount, name)
    if first.poses is None or second.poses is None:
        return replace(first, poses=first.poses or second.poses)
    if first.coordinates is not second.coordinates:
        raise OptionError(
            f"{name}: poses in {first.coordinates} and in {second.coordinates}; expected one frame"
        )
    return replace(first, poses=joined_path(first.poses, second.poses, name))


def _check_mounts(first: RigidTransform | None, second: RigidTransform | None, name: str) -> None:
    if (first is None) != (second is None) or (
        first is not None
        and second is not None
        and np.abs(first.matrix - second.matrix).max() > MOUNT_TOLERANCE
    ):
        raise OptionError(f"{name}: mounted otherwise in one scene than in another; expected one mounting")


def joined_path(first: Poses, second: Poses, name: str) -> Poses:
    """The poses of both; of two at one time that of the first.

    Raises:
        OptionError: one holds at all times and is not the same in both.
    """
    if first.static and second.static:
        same = np.allclose(first.positions, second.positions, rtol=0, atol=MOUNT_TOLERANCE) and np.allclose(
            first.quaternions_xyzw, second.quaternions_xyzw, rtol=0, atol=MOUNT_TOLERANCE
        )
        if same:
            return first
    if first.static or second.static:
        raise OptionError(f"{name}: is stationary in one scene, and elsewhere or moves in another")
    rows = new_rows(first.timestamps_ns, second.timestamps_ns)
    return Poses(
        np.concatenate([first.timestamps_ns, second.timestamps_ns])[rows],
        np.concatenate([first.positions, second.positions])[rows],
        np.concatenate([first.quaternions_xyzw, second.quaternions_xyzw])[rows],
    )


def new_rows(first_ns: Int64Array, second_ns: Int64Array) -> Int64Array:
    """The rows of two series put one behind the other that make one series in order; of equal times the first."""
    return np.unique(np.concatenate([first_ns, second_ns]), return_index=True)[1]


def _odometry(first: OdometrySensor, second: OdometrySensor, name: str) -> Joined:
    return replace(first, poses=joined_path(first.poses, second.poses, name)), None


def joined_trajectory(first: Trajectory, second: Trajectory) -> Trajectory:
    """The poses of both; of two at one time that of the first, and only what both have."""
    rows = new_rows(first.timestamps_ns, second.timestamps_ns)
    names = ("positions", "quaternions_xyzw", "file_seconds", "covariances")
    timestamps = np.concatenate([first.timestamps_ns, second.timestamps_ns])[rows]
    return Trajectory(
        first.name, timestamps, *(_both(getattr(first, name), getattr(second, name), rows) for name in names)
    )


def _both(a: Any, b: Any, rows: Int64Array) -> Any:
    return None if a is None or b is None else np.concatenate([a, b])[rows]


def _imu(first: ImuSensor, second: ImuSensor, name: str) -> Joined:
    del name
    streams = {**second.streams, **first.streams}
    for stream in set(first.streams) & set(second.streams):
        a, b = first.streams[stream], second.streams[stream]
        rows = new_rows(a.timestamps_ns, b.timestamps_ns)
        streams[stream] = VectorSamples(
            np.concatenate([a.timestamps_ns, b.timestamps_ns])[rows],
            np.concatenate([a.values, b.values])[rows],
            _both(a.file_seconds, b.file_seconds, rows),
        )
    return replace(first, streams=streams), None


def _gnss(first: GnssSensor, second: GnssSensor, name: str) -> Joined:
    _check_mounts(first.mount, second.mount, name)
    rows = new_rows(first.timestamps_ns, second.timestamps_ns)
    names = ("timestamps_ns", "positions_lla", "accuracies", "vertical_accuracies", "file_seconds")
    arrays = {what: _both(getattr(first, what), getattr(second, what), rows) for what in names}
    return replace(first, **arrays), None


def _unchanging(first: Any, second: Any, name: str) -> Joined:
    if not is_same(first, second):
        raise OptionError(
            f"{name}: differs between the scenes and has no time; expected the same, or another id"
        )
    return first, None


_JOINS: Mapping[type, Callable[[Any, Any, str], Joined]] = MappingProxyType(
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
