"""A part of a scene in time."""

from dataclasses import replace

import numpy as np

from sceneloom.errors import OptionError
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import ImuSensor, OdometrySensor
from sceneloom.scene.scene import Scene, Sensor


def frame_times(sensor: Sensor) -> "np.ndarray[tuple[int], np.dtype[np.int64]]":
    """The time stamps (N,) int64 [ns] of whatever the sensor gives over time; empty where it has no time."""
    if isinstance(sensor, LidarSensor | RadarSensor):
        return sensor.frames.timestamps_ns
    if isinstance(sensor, CameraSensor):
        return sensor.pictures.timestamps_ns
    if isinstance(sensor, OdometrySensor):
        return np.zeros(0, np.int64) if sensor.poses.endless else sensor.poses.timestamps_ns
    if isinstance(sensor, ImuSensor):
        streams = [stream.timestamps_ns for stream in sensor.streams.values()]
        return np.sort(np.concatenate(streams)) if streams else np.zeros(0, np.int64)
    return getattr(sensor, "timestamps_ns", np.zeros(0, np.int64))


def time_span(scene: Scene) -> tuple[int, int] | None:
    """First and last time stamp of all sensors [ns]; None for a scene without time."""
    stamps = [times for times in map(frame_times, scene.sensors) if len(times)]
    if not stamps:
        return None
    return min(int(times.min()) for times in stamps), max(int(times.max()) for times in stamps)


def cut_scene(scene: Scene, *, start: float | None = None, stop: float | None = None) -> Scene:
    """Keep the lidar and radar frames and the pictures of a part of a scene.

    Args:
        start: seconds after the scene's first time stamp, None for the beginning.
        stop: seconds after it, exclusive, None for the end.

    Raises:
        OptionError: the interval is empty, or no frame lies in it.
    """
    span = time_span(scene)
    if (start is None and stop is None) or span is None:
        return scene
    start_s, stop_s = start or 0.0, float("inf") if stop is None else stop
    if not (start_s >= 0 and stop_s > start_s):
        raise OptionError(f"from {start_s} s to {stop_s} s; expected 0 <= start < stop")
    first = span[0] + round(start_s * 1e9)
    last = span[1] + 1 if stop is None else span[0] + round(stop_s * 1e9)
    sensors = tuple(_cut_sensor(sensor, first, last) for sensor in scene.sensors)
    kept = sum(
        len(frame_times(s)) for s in sensors if isinstance(s, LidarSensor | RadarSensor | CameraSensor)
    )
    if kept == 0:
        length = (span[1] - span[0]) / 1e9
        raise OptionError(
            f"{scene.source}: no frame from {start_s} s to {stop_s} s; the scene lasts {length:.3f} s"
        )
    return replace(scene, sensors=sensors)


def _cut_sensor(sensor: Sensor, first_ns: int, last_ns: int) -> Sensor:
    if isinstance(sensor, CameraSensor):
        inside = _inside(sensor.pictures, first_ns, last_ns)
        video = sensor.video
        if video is not None and (inside.start, inside.stop) != (0, len(sensor.pictures)):
            indices = range(len(sensor.pictures)) if video.frame_indices is None else video.frame_indices
            video = replace(video, frame_indices=tuple(indices[inside]))
        return replace(sensor, pictures=sensor.pictures[inside], video=video)
    if isinstance(sensor, LidarSensor):
        return replace(sensor, frames=sensor.frames[_inside(sensor.frames, first_ns, last_ns)])
    if isinstance(sensor, RadarSensor):
        return replace(sensor, frames=sensor.frames[_inside(sensor.frames, first_ns, last_ns)])
    return sensor


def _inside(frames: LazyFrames[object], first_ns: int, last_ns: int) -> slice:
    first, last = np.searchsorted(frames.timestamps_ns, [first_ns, last_ns])
    return slice(int(first), int(last))
