"""Scenes with the clocks of their streams corrected: every time that belongs to a stream is moved."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from types import MappingProxyType
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from sceneloom.arrays import Int64Array, read_only
from sceneloom.errors import OptionError
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, Shooting, shots_of, with_shots
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.ego import camera_path, sensor_path
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.poses import Poses, PoseSource, Trajectory, same_direction
from sceneloom.scene.scene import Scene, Sensor, scene_period_ns
from sceneloom.scene.types import Key, key_of

_Right = Callable[[Int64Array], Int64Array]
"""Gives the right times of timestamps (…,) int64 [ns]."""

_Part = TypeVar("_Part")
_MOMENTS = ("start_ns", "timestamp_ns")


def retimed_annotation(part: _Part, sensors: Mapping[Key, _Right], otherwise: _Right | None) -> _Part:
    """Move the times of an annotation or of a part of one.

    Args:
        part: any object of the annotations' model.
        sensors: by sensor; a part that names one of them goes with it, with all that is in it.
        otherwise: for what names no sensor; None: its times stay.
    """
    named = getattr(part, "sensor_id", None)
    right = otherwise if named is None else sensors.get(key_of(named))
    if right is None and not sensors:
        return part
    changes = {
        field.name: changed
        for field in fields(part)  # type: ignore[arg-type]
        if (changed := _changed(field.name, getattr(part, field.name), sensors, right)) is not None
    }
    if not changes:
        return part
    moved: _Part = replace(part, **changes)  # type: ignore[type-var]
    return moved


def _changed(name: str, value: Any, sensors: Mapping[Key, _Right], right: _Right | None) -> Any:
    """A field's new value; None where it stays."""
    if name == "timestamps_ns" and isinstance(value, np.ndarray):
        return None if right is None or len(value) == 0 else read_only(right(value))
    if name in _MOMENTS and isinstance(value, int):
        return None if right is None else int(right(np.array(value, np.int64)))
    if isinstance(value, Poses) and value.static:
        return None
    if isinstance(value, tuple) and any(is_dataclass(item) or isinstance(item, tuple) for item in value):
        return tuple(_retimed_item(item, sensors, right) for item in value)
    if is_dataclass(value) and not isinstance(value, type):
        return _retimed_item(value, sensors, right)
    return None


def _retimed_item(item: Any, sensors: Mapping[Key, _Right], right: _Right | None) -> Any:
    if isinstance(item, tuple):
        return tuple(_retimed_item(inner, sensors, right) for inner in item)
    return retimed_annotation(item, sensors, right) if is_dataclass(item) else item


LINES, TEXTS, SHARED = "recording", "further_keys", "shared_lines"
"""Where a scene keeps lines that state more than their samples, by stream and by time [ns] as text.

And those of several
records, with stream and time of each."""


class Clock(Protocol):
    """What moves times."""

    def right(self, timestamps_ns: Int64Array) -> Int64Array:
        """The right times of timestamps [ns]."""
        ...


def _retimed_lines(scene: Scene, sensors: Mapping[Key, Clock], trajectories: Mapping[str, Clock]) -> Mapping[str, Any]:
    """Give the scene's metadata with the keys of lines moved as their samples are.

    Lines of several records of which one is moved are lines no longer: they would report it twice.

    Args:
        scene: as it is.
        sensors: clocks by id and its type (`scene.types.key_of`).
        trajectories: clocks by name.
    """
    kept = scene.metadata.get(LINES)
    if not isinstance(kept, Mapping):
        return scene.metadata
    clocks = {f"trajectories.{name}": clock for name, clock in trajectories.items()}
    for sensor in scene.sensors:
        if key_of(sensor.id) in sensors:
            clocks |= dict.fromkeys(streams_of(sensor), sensors[key_of(sensor.id)])
    changed = dict(kept)
    texts, shared = kept.get(TEXTS), kept.get(SHARED)
    if isinstance(texts, Mapping):
        changed[TEXTS] = {
            name: _moved(lines, clocks[name]) if name in clocks and isinstance(lines, Mapping) else lines
            for name, lines in texts.items()
        }
    if isinstance(shared, list):
        changed[SHARED] = [line for line in shared if not _has_part(line, clocks)]
    return MappingProxyType({**scene.metadata, LINES: MappingProxyType(changed)})


def _has_part(line: Any, clocks: Mapping[str, Clock]) -> bool:
    records = line.get("records") if isinstance(line, Mapping) else None
    return any(record and record[0] in clocks for record in records or ())


def streams_of(sensor: Sensor) -> list[str]:
    """The names under which a recording keeps lines of a sensor."""
    if isinstance(sensor, ImuSensor):
        return [f"imu.{name}" for name in sensor.streams]
    if isinstance(sensor, GnssSensor):
        return ["gnss" if sensor.id == "gnss" else f"gnss.{sensor.id}"]
    if isinstance(sensor, LidarSensor):
        return [f"lidars.{str(sensor.id).removeprefix('lidar') or 0}"]
    return []


def _moved(lines: Mapping[str, Any], clock: Clock) -> dict[str, Any]:
    moved = {}
    for key, text in lines.items():
        timestamp, mark, count = key.partition("#")
        if not timestamp.removeprefix("-").isdecimal():
            continue
        right = int(clock.right(np.array(int(timestamp), np.int64)))
        moved[f"{right}{mark}{count}"] = text
    return moved


_Cloud = TypeVar("_Cloud", LidarFrame, RadarFrame)

_SAME_CLOCK_NS = 10_000_000_000
"""Point times farther from their sweep's timestamp are not on its clock, and stay [ns]."""

_MEASURED = "measured_timestamps_ns"
"""The further array of deskewed points that holds times."""


@dataclass(frozen=True, slots=True)
class ClockCorrection:
    """What is taken off the times of a stream: t - offset - skew (t - offset - at).

    Attributes:
        offset_ns: what the stream's timestamps state too much, at `at_ns` [ns].
        skew_ppm: how much too fast its clock runs [parts in a million].
        at_ns: on the right clock [ns].
    """

    offset_ns: float
    skew_ppm: float = 0.0
    at_ns: int = 0

    def right(self, timestamps_ns: Int64Array) -> Int64Array:
        """The right times (…,) int64 [ns] of timestamps of the stream, rounded to whole nanoseconds."""
        times = np.asarray(timestamps_ns, np.int64)
        whole_ns = round(self.offset_ns)
        drift = self.skew_ppm * 1e-6 * (times - whole_ns - self.at_ns)
        right: Int64Array = times - whole_ns - np.rint(drift).astype(np.int64)
        return right

    def right_ns(self, timestamp_ns: int) -> int:
        """The right time of one timestamp [ns]."""
        return int(self.right(np.array(timestamp_ns, np.int64)))


def retimed_scene(
    scene: Scene,
    *,
    sensors: Mapping[Key, ClockCorrection] = MappingProxyType({}),
    trajectories: Mapping[str, ClockCorrection] = MappingProxyType({}),
) -> Scene:
    """Give the scene with the clocks of some sensors and trajectories corrected.

    All their times move: timestamps, times of points, samples and fixes. Where a sensor is mounted on the ego, its
        poses
    are taken anew from the default trajectory, at its right times. Annotations of one sensor go with that sensor,
    others with the first lidar, in whose sweeps such are drawn. Frames are read and moved when asked for.

    Args:
        scene: as it is.
        sensors: by id and its type (`scene.types.key_of`).
        trajectories: by name.

    Raises:
        OptionError: there is no such sensor or trajectory, or it has no times.
    """
    known = {key_of(sensor.id): sensor for sensor in scene.sensors}
    for key in sensors:
        if key not in known or type(known[key]) not in _RETIMED:
            raise OptionError(f"{scene.source}: no sensor {key[1]!r} whose times could be corrected")
    for name in trajectories:
        if name not in scene.trajectories:
            raise OptionError(f"{scene.source}: no trajectory {name!r}")
    new_trajectories = {
        name: retimed_trajectory(trajectory, trajectories[name]) if name in trajectories else trajectory
        for name, trajectory in scene.trajectories.items()
    }
    moved = [
        _RETIMED[type(sensor)](sensor, sensors[key_of(sensor.id)]) if key_of(sensor.id) in sensors else sensor
        for sensor in scene.sensors
    ]
    changed = replace(
        scene,
        sensors=tuple(_along(moved, scene, new_trajectories, trajectories)),
        trajectories=new_trajectories,
    )
    placed = [
        _placed(sensor, changed) if key_of(sensor.id) in sensors or _default_moved(scene, trajectories) else sensor
        for sensor in changed.sensors
    ]
    own: Mapping[Key, Callable[[Int64Array], Int64Array]] = {key: c.right for key, c in sensors.items()}
    first = next((own.get(key_of(lidar.id)) for lidar in scene.lidars), None)
    return replace(
        changed,
        sensors=tuple(placed),
        annotations=tuple(retimed_annotation(annotation, own, first) for annotation in scene.annotations),
        attributes=tuple(retimed_annotation(path, own, None) for path in scene.attributes),
        metadata=_retimed_lines(scene, sensors, trajectories),
    )


def _default_moved(scene: Scene, trajectories: Mapping[str, ClockCorrection]) -> bool:
    return next(iter(scene.trajectories), None) in trajectories


def retimed_sensor(sensor: Sensor, correction: ClockCorrection) -> Sensor:
    """Give a sensor with the times of all that it measured moved; its poses are not among them."""
    move = _RETIMED.get(type(sensor))
    moved: Sensor = sensor if move is None else move(sensor, correction)
    return moved


def retimed_trajectory(trajectory: Trajectory, correction: ClockCorrection) -> Trajectory:
    """Give a trajectory with its times moved."""
    return replace(trajectory, timestamps_ns=read_only(correction.right(trajectory.timestamps_ns)), file_seconds=None)


def _cloud(sensor: Any, correction: ClockCorrection) -> Any:
    times = correction.right(sensor.frames.timestamps_ns)
    return replace(sensor, frames=LazyFrames(times, RetimedClouds(sensor.frames, correction)))


def _camera(camera: Shooting, correction: ClockCorrection) -> Shooting:
    shots = shots_of(camera)
    retimed = LazyFrames(correction.right(shots.timestamps_ns), RetimedImages(shots, correction))
    return with_shots(camera, retimed, camera.video)


def _imu(imu: ImuSensor, correction: ClockCorrection) -> ImuSensor:
    streams = {
        name: replace(samples, timestamps_ns=read_only(correction.right(samples.timestamps_ns)), file_seconds=None)
        for name, samples in imu.streams.items()
    }
    return replace(imu, streams=MappingProxyType(streams))


def _receiver(receiver: GnssSensor, correction: ClockCorrection) -> GnssSensor:
    times = read_only(correction.right(receiver.timestamps_ns))
    return replace(receiver, timestamps_ns=times, file_seconds=None)


_RETIMED: Mapping[type, Callable[[Any, ClockCorrection], Any]] = MappingProxyType(
    {
        LidarSensor: _cloud,
        RadarSensor: _cloud,
        CameraSensor: _camera,
        DepthCameraSensor: _camera,
        ImuSensor: _imu,
        GnssSensor: _receiver,
    }
)
"""How the times of each kind of sensor are moved."""


@dataclass(frozen=True, slots=True, eq=False)
class RetimedClouds(Generic[_Cloud]):
    """Reads sweeps or radar cycles and moves their times; what `LazyFrames` asks for."""

    frames: LazyFrames[_Cloud]
    correction: ClockCorrection

    def __call__(self, k: int) -> Any:
        """Read frame `k`.

        Raises:
            DataError: it cannot be read.
        """
        frame: Any = self.frames[k]
        points: Any = frame.points
        if points.timestamps_ns is not None:
            points = replace(points, timestamps_ns=self._right(points.timestamps_ns, frame.timestamp_ns))
        extras = dict(_without_own_times(points.extras))
        if _MEASURED in extras:
            extras[_MEASURED] = self._right(np.asarray(extras[_MEASURED]), frame.timestamp_ns)
        points = replace(points, extras=MappingProxyType(extras))
        timestamp_ns = self.correction.right_ns(frame.timestamp_ns)
        changed: Any = replace(frame, timestamp_ns=timestamp_ns, points=points, extras=_without_own_times(frame.extras))
        return changed

    def _right(self, times: Int64Array, timestamp_ns: int) -> Int64Array:
        far = np.abs(times - timestamp_ns) > _SAME_CLOCK_NS
        return read_only(np.where(far, times, self.correction.right(times)))


@dataclass(frozen=True, slots=True, eq=False)
class RetimedImages:
    """Reads images or depth images and moves their times; what `LazyFrames` asks for."""

    images: LazyFrames[Any]
    correction: ClockCorrection

    def __call__(self, k: int) -> Any:
        """Read image `k`.

        Raises:
            DataError: its record cannot be read.
        """
        image = self.images[k]
        return replace(
            image,
            timestamp_ns=self.correction.right_ns(image.timestamp_ns),
            extras=_without_own_times(image.extras),
        )


def _without_own_times(extras: Mapping[str, Any]) -> Mapping[str, Any]:
    """Further fields of a frame without the file's own form of its time, which holds no more."""
    return MappingProxyType({k: v for k, v in extras.items() if k not in {"file_seconds", "line_seconds"}})


def _along(
    sensors: list[Any],
    scene: Scene,
    new_trajectories: Mapping[str, Trajectory],
    corrected: Mapping[str, ClockCorrection],
) -> list[Sensor]:
    """Odometry sensors that report the same way as a corrected trajectory go with it."""
    return [
        replace(sensor, poses=new_trajectories[name].poses)
        if isinstance(sensor, OdometrySensor)
        and (name := next((n for n in corrected if same_direction(sensor.poses, scene.trajectories[n])), None))
        else sensor
        for sensor in sensors
    ]


def _placed(sensor: Sensor, scene: Scene) -> Sensor:
    """A mounted sensor with its poses along the default trajectory, at its right times."""
    if not isinstance(sensor, LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor):
        return sensor
    trajectory = next(iter(scene.trajectories.values()), None)
    if sensor.poses is None or sensor.mount is None or trajectory is None or trajectory.quaternions_xyzw is None:
        return sensor
    source = PoseSource(trajectory.poses, sensor.mount, scene_period_ns(scene))
    poses: Poses | None
    if isinstance(sensor, CameraSensor):
        poses = camera_path(source, sensor.images)
    else:
        poses = sensor_path(source, sensor.frames.timestamps_ns)
    return replace(sensor, poses=poses)
