"""What is kept of a recording's lines by their samples' times, moved with the samples."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Key, key_of

LINES, TEXTS, SHARED = "recording", "further_keys", "shared_lines"
"""Where a scene keeps lines that state more than their samples, by stream and by time [ns] as text.

And those of several
records, with stream and time of each."""


class Clock(Protocol):
    """What moves times."""

    def right(self, timestamps_ns: Int64Array) -> Int64Array:
        """The right times of timestamps [ns]."""
        ...


def retimed_lines(
    scene: Scene, sensors: Mapping[Key, Clock], trajectories: Mapping[str, Clock]
) -> Mapping[str, Any]:
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
