"""Leaving out what has the time of the sample before, for fixes."""

from dataclasses import replace
from types import MappingProxyType

import msgspec
import numpy as np

from sceneloom.arrays import Int64Array, read_only
from sceneloom.checks.reordering import chosen_frames
from sceneloom.scene import (
    CameraSensor,
    GnssSensor,
    ImuSensor,
    LidarSensor,
    Scene,
    Sensor,
    VectorSamples,
)


def without_repeated_times(scene: Scene) -> Scene:
    """Keep the first of several samples, sweeps and pictures of one time; pictures of a video stay, as it has them."""
    sensors = tuple(map(_without, scene.sensors))
    if any(new is not old for new, old in zip(sensors, scene.sensors, strict=True)):
        scene = replace(scene, sensors=sensors)
    return _without_kept_poses(scene)


def _without_kept_poses(scene: Scene) -> Scene:
    """Leave out the texts of poses: those of a time that the trajectory has already were kept as text."""
    kept = scene.metadata.get("recording", {})
    texts, seconds = kept.get("other_lines", ()), kept.get("other_seconds", {})
    places = [place for place, text in enumerate(texts) if not _tells_a_pose(text)]
    if len(places) == len(texts):
        return scene
    others = {
        "other_lines": [texts[place] for place in places],
        "other_seconds": {
            str(k): seconds[str(place)] for k, place in enumerate(places) if str(place) in seconds
        },
    }
    further = {name: value for name, value in {**kept, **others}.items() if value}
    return replace(scene, metadata=MappingProxyType({**scene.metadata, "recording": further}))


def _tells_a_pose(text: str) -> bool:
    try:
        content = msgspec.json.decode(text)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return False
    if not isinstance(content, dict):
        return False
    parts = [content, *(value for value in content.values() if isinstance(value, dict))]
    return any(isinstance(part.get("position"), dict) for part in parts) or "gnssEnu" in content


def _without(sensor: Sensor) -> Sensor:
    if isinstance(sensor, ImuSensor):
        return _imu(sensor)
    if isinstance(sensor, GnssSensor):
        return _receiver(sensor)
    if isinstance(sensor, LidarSensor):
        rows = _kept(sensor.frames.timestamps_ns)
        return sensor if rows is None else replace(sensor, frames=chosen_frames(sensor.frames, rows))
    if isinstance(sensor, CameraSensor) and sensor.video is None:
        rows = _kept(sensor.pictures.timestamps_ns)
        return sensor if rows is None else replace(sensor, pictures=chosen_frames(sensor.pictures, rows))
    return sensor


def _kept(timestamps_ns: Int64Array) -> Int64Array | None:
    """The first row of each time, (M,) int64; None where each has its own."""
    first = np.concatenate([[True], np.diff(timestamps_ns) != 0])[: len(timestamps_ns)]
    return None if first.all() else np.flatnonzero(first).astype(np.int64)


def _imu(sensor: ImuSensor) -> ImuSensor:
    streams = {name: _samples(samples) for name, samples in sensor.streams.items()}
    changed = any(streams[name] is not samples for name, samples in sensor.streams.items())
    return replace(sensor, streams=streams) if changed else sensor


def _samples(samples: VectorSamples) -> VectorSamples:
    rows = _kept(samples.timestamps_ns)
    if rows is None:
        return samples
    seconds = samples.file_seconds
    return VectorSamples(
        read_only(samples.timestamps_ns[rows]),
        read_only(samples.values[rows]),
        None if seconds is None else read_only(seconds[rows]),
    )


def _receiver(sensor: GnssSensor) -> GnssSensor:
    rows = _kept(sensor.timestamps_ns)
    if rows is None:
        return sensor
    seconds = sensor.file_seconds
    return replace(
        sensor,
        timestamps_ns=read_only(sensor.timestamps_ns[rows]),
        positions_lla=read_only(sensor.positions_lla[rows]),
        accuracies=read_only(sensor.accuracies[rows]),
        vertical_accuracies=read_only(sensor.vertical_accuracies[rows]),
        file_seconds=None if seconds is None else read_only(seconds[rows]),
    )
