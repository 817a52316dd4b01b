"""Scenes with the clocks of their streams corrected: every time that belongs to a stream is moved."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array, read_only
from sceneloom.editing.references import LINES, TEXTS, streams_of
from sceneloom.errors import OptionError
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, shots_of, with_shots
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.ego import camera_path, sensor_path
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.poses import Poses, PoseSource, Trajectory, same_direction
from sceneloom.scene.scene import Posed, Scene, Sensor, scene_period_ns, time_span
from sceneloom.scene.types import Key, key_of

_CLOCKED = (LidarSensor, RadarSensor, CameraSensor, DepthCameraSensor, ImuSensor, GnssSensor)  # sensors with a clock
_SAME_CLOCK_NS = 10_000_000_000  # point times farther from their sweep's timestamp are not on its clock, and stay [ns]
_MEASURED = "measured_timestamps_ns"  # the extra array of deskewed points that holds times


@dataclass(frozen=True, slots=True)
class ClockCorrection:
    """What is subtracted from the times of a stream: t - offset - skew (t - offset - at).

    Attributes:
        offset_ns: how much too late the stream's timestamps are at `at_ns` [ns].
        skew_ppm: how much too fast its clock runs [parts in a million].
        at_ns: on the corrected clock [ns].
    """

    offset_ns: float
    skew_ppm: float = 0.0
    at_ns: int = 0

    def right(self, timestamps_ns: Int64Array) -> Int64Array:
        """The corrected times (…,) int64 [ns] of timestamps of the stream, rounded to whole nanoseconds."""
        times = np.asarray(timestamps_ns, np.int64)
        whole_ns = round(self.offset_ns)
        drift = self.skew_ppm * 1e-6 * (times - whole_ns - self.at_ns)
        right: Int64Array = times - whole_ns - np.rint(drift).astype(np.int64)
        return right

    def right_ns(self, timestamp_ns: int) -> int:
        """The corrected time of one timestamp [ns]."""
        return int(self.right(np.array(timestamp_ns, np.int64)))


def retimed_scene(
    scene: Scene,
    *,
    sensors: Mapping[Key, ClockCorrection] = MappingProxyType({}),
    trajectories: Mapping[str, ClockCorrection] = MappingProxyType({}),
) -> Scene:
    """Give the scene with the clocks of some sensors and trajectories corrected.

    All their times move: timestamps, times of points, samples and fixes. Poses of sensors that are mounted on the ego
    are taken anew from the default trajectory, at the corrected times. Annotations of one sensor go with that sensor,
    others with the first lidar, in whose sweeps they were drawn. Frames are read and moved when asked for.

    Args:
        scene: the scene.
        sensors: by id and its type (`scene.types.key_of`).
        trajectories: by name.

    Raises:
        OptionError: there is no such sensor or trajectory, or it has no times.
    """
    known = {key_of(sensor.id): sensor for sensor in scene.sensors}
    for key in sensors:
        if not isinstance(known.get(key), _CLOCKED):
            raise OptionError(f"{scene.source}: no sensor {key[1]!r} whose times could be corrected")
    for name in trajectories:
        if name not in scene.trajectories:
            raise OptionError(f"{scene.source}: no trajectory {name!r}")
    new_trajectories = {
        name: _retimed(trajectory, trajectories[name]) if name in trajectories else trajectory
        for name, trajectory in scene.trajectories.items()
    }
    default_name, default = next(iter(new_trajectories.items()), (None, None))
    default_moved, period_ns = default_name in trajectories, scene_period_ns(scene)

    def corrected(sensor: Sensor) -> Sensor:
        key = key_of(sensor.id)
        if isinstance(sensor, OdometrySensor):
            # goes with a trajectory that it repeats
            same = (n for n in trajectories if same_direction(sensor.poses, scene.trajectories[n]))
            name = next(same, None)
            return sensor if name is None else replace(sensor, poses=new_trajectories[name].poses)
        moved = _retimed_sensor(sensor, sensors[key]) if key in sensors else sensor
        return _placed(moved, default, period_ns) if key in sensors or default_moved else moved

    own = {key: correction.right for key, correction in sensors.items()}
    first = next((own.get(key_of(lidar.id)) for lidar in scene.lidars), None)
    return replace(
        scene,
        sensors=tuple(map(corrected, scene.sensors)),
        trajectories=new_trajectories,
        annotations=tuple(_retimed_part(annotation, own, first) for annotation in scene.annotations),
        attributes=tuple(_retimed_part(path, own, None) for path in scene.attributes),
        metadata=_retimed_lines(scene, sensors, trajectories),
    )


def clock_from_zero(scene: Scene) -> Scene:
    """Give the scene with all times counted from the first timestamp of what was measured.

    Frames are read and moved when asked for. The file's own form of times is removed.
    """
    span_ns = time_span(scene)
    if span_ns is None:
        return replace(scene, time_offset_ns=0)
    # an int, since a float of today's times holds no single nanoseconds
    correction = ClockCorrection(offset_ns=span_ns[0])
    own = {key_of(sensor.id): correction.right for sensor in scene.sensors}

    def moved(sensor: Sensor) -> Sensor:
        sensor = _retimed_sensor(sensor, correction)
        poses = getattr(sensor, "poses", None)
        return sensor if poses is None or poses.static else replace(sensor, poses=_retimed(poses, correction))

    return replace(
        scene,
        sensors=tuple(map(moved, scene.sensors)),
        trajectories={name: _retimed(trajectory, correction) for name, trajectory in scene.trajectories.items()},
        annotations=tuple(_retimed_part(one, own, correction.right) for one in scene.annotations),
        attributes=tuple(_retimed_part(one, own, correction.right) for one in scene.attributes),
        time_offset_ns=0,
    )


def _retimed(series: Any, correction: ClockCorrection) -> Any:
    """A series of poses, samples or fixes with its times moved, and without the file's own form of them."""
    own = {"file_seconds": None} if hasattr(series, "file_seconds") else {}
    return replace(series, timestamps_ns=read_only(correction.right(series.timestamps_ns)), **own)


def _retimed_sensor(sensor: Any, correction: ClockCorrection) -> Any:
    """Give a sensor with the times of all that it measured moved; its poses are not among them."""
    match sensor:
        case LidarSensor() | RadarSensor():
            change, times_ns = partial(_retimed_cloud, correction), correction.right(sensor.frames.timestamps_ns)
            frames: Any = sensor.frames.mapped(change, timestamps_ns=times_ns)
            return replace(sensor, frames=frames)
        case CameraSensor() | DepthCameraSensor():
            shots = shots_of(sensor)
            change, times_ns = partial(_retimed_frame, correction), correction.right(shots.timestamps_ns)
            return with_shots(sensor, shots.mapped(change, timestamps_ns=times_ns), sensor.video)  # type: ignore[type-var]
        case ImuSensor(streams=streams):
            moved = {name: _retimed(samples, correction) for name, samples in streams.items()}
            return replace(sensor, streams=MappingProxyType(moved))
        case GnssSensor():
            return _retimed(sensor, correction)
    return sensor


def _retimed_frame(correction: ClockCorrection, frame: Any) -> Any:
    """A frame or an image with its time moved."""
    timestamp_ns = correction.right_ns(frame.timestamp_ns)
    return replace(frame, timestamp_ns=timestamp_ns, extras=_without_file_times(frame.extras))


def _retimed_cloud(correction: ClockCorrection, frame: LidarFrame | RadarFrame) -> Any:
    """A sweep or radar cycle with its time and those of its points moved."""

    def moved(times: Int64Array) -> Int64Array:
        far = np.abs(times - frame.timestamp_ns) > _SAME_CLOCK_NS
        return read_only(np.where(far, times, correction.right(times)))

    points: Any = frame.points
    extras = dict(_without_file_times(points.extras))
    if _MEASURED in extras:
        extras[_MEASURED] = moved(np.asarray(extras[_MEASURED]))
    times_ns = None if points.timestamps_ns is None else moved(points.timestamps_ns)
    points = replace(points, timestamps_ns=times_ns, extras=MappingProxyType(extras))
    return replace(_retimed_frame(correction, frame), points=points)


def _without_file_times(extras: Mapping[str, Any]) -> Mapping[str, Any]:
    """Extra fields of a frame without the file's own form of its time, which holds no more."""
    return MappingProxyType({k: v for k, v in extras.items() if k not in {"file_seconds", "line_seconds"}})


def _placed(sensor: Sensor, trajectory: Trajectory | None, period_ns: int) -> Sensor:
    """A mounted sensor with its poses along a trajectory, at its own times."""
    if not isinstance(sensor, Posed) or sensor.poses is None or sensor.mount is None:
        return sensor
    if trajectory is None or trajectory.quaternions_xyzw is None:
        return sensor
    source = PoseSource(trajectory.poses, sensor.mount, period_ns)
    if isinstance(sensor, CameraSensor):
        return replace(sensor, poses=camera_path(source, sensor.images))
    return replace(sensor, poses=sensor_path(source, sensor.frames.timestamps_ns))


_Right = Callable[[Int64Array], Int64Array]  # gives the corrected times of timestamps (…,) int64 [ns]


def _retimed_part(part: Any, sensors: Mapping[Key, _Right], otherwise: _Right | None) -> Any:
    """Move times of a part of an annotation: by the sensor it or an outer part names, else `otherwise` (None: not)."""
    if isinstance(part, tuple) and any(is_dataclass(item) or isinstance(item, tuple) for item in part):
        return tuple(_retimed_part(item, sensors, otherwise) for item in part)
    if not is_dataclass(part) or isinstance(part, type) or (isinstance(part, Poses) and part.static):
        return part
    named = getattr(part, "sensor_id", None)
    right = otherwise if named is None else sensors.get(key_of(named))
    changes: dict[str, Any] = {}
    for field in fields(part):
        value = getattr(part, field.name)
        if field.name in {"start_ns", "timestamp_ns"} and isinstance(value, int):
            new: Any = value if right is None else int(right(np.array(value, np.int64)))
        elif field.name == "timestamps_ns" and isinstance(value, np.ndarray):
            new = value if right is None or len(value) == 0 else read_only(right(value))
        else:
            new = _retimed_part(value, sensors, right)
        if new is not value:
            changes[field.name] = new
    return replace(part, **changes) if changes else part


def _retimed_lines(
    scene: Scene, sensors: Mapping[Key, ClockCorrection], trajectories: Mapping[str, ClockCorrection]
) -> Mapping[str, Any]:
    """Give the scene's metadata with the keys of lines moved as their samples are."""
    kept = scene.metadata.get(LINES)
    if not isinstance(kept, Mapping):
        return scene.metadata
    clocks = {f"trajectories.{name}": clock for name, clock in trajectories.items()}
    for sensor in scene.sensors:
        if key_of(sensor.id) in sensors:
            clocks |= dict.fromkeys(streams_of(sensor), sensors[key_of(sensor.id)])
    changed = dict(kept)
    texts = kept.get(TEXTS)
    if isinstance(texts, Mapping):
        changed[TEXTS] = {
            name: _moved_keys(lines, clocks[name]) if name in clocks and isinstance(lines, Mapping) else lines
            for name, lines in texts.items()
        }
    return MappingProxyType({**scene.metadata, LINES: MappingProxyType(changed)})


def _moved_keys(lines: Mapping[str, Any], clock: ClockCorrection) -> dict[str, Any]:
    moved = {}
    for key, text in lines.items():
        timestamp, mark, count = key.partition("#")
        if timestamp.removeprefix("-").isdecimal():
            moved[f"{clock.right_ns(int(timestamp))}{mark}{count}"] = text
    return moved
