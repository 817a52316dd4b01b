"""Which moments become samples, and which frame of each sensor belongs to a sample."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.nuscenes.written_tables import token_of
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.scene import Scene

RATE_HZ = 2.0
"""Samples a second in nuScenes."""

KEY_FRAMES = "key_frames_us"
"""Under this name a sensor that was read from nuScenes keeps the times of its key frames."""

Written = LidarSensor | RadarSensor | CameraSensor

_SECOND = 1_000_000_000
_MICROSECOND = 1000


def timestamps_of(sensor: Written) -> Int64Array:
    """The times of a sensor's frames [ns]."""
    return (sensor.images if isinstance(sensor, CameraSensor) else sensor.frames).timestamps_ns


def microseconds(timestamps_ns: Int64Array) -> Int64Array:
    """Times [ns] as the tables have them [µs]; halves go to the even one."""
    whole: Int64Array = np.rint(timestamps_ns % _SECOND / _MICROSECOND).astype(np.int64)
    return timestamps_ns // _SECOND * 1_000_000 + whole


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """The samples of a scene.

    Attributes:
        tokens: of each.
        timestamps_ns: (S,) int64 [ns], ascending.
        reach_ns: how far from a sample its frames may be.
    """

    tokens: tuple[str, ...]
    timestamps_ns: Int64Array
    reach_ns: int

    def key_rows(self, sensor: Written) -> BoolArray:
        """(N,) bool: which frames of a sensor are key frames: the nearest one of each sample, at most one each."""
        timestamps = timestamps_of(sensor)
        known = sensor.extras.get(KEY_FRAMES)
        if isinstance(known, list | tuple):
            return np.isin(microseconds(timestamps), np.array(known, np.int64))
        chosen = np.zeros(len(timestamps), np.bool_)
        for time in self.timestamps_ns.tolist():
            after = int(np.searchsorted(timestamps, time))
            near = [row for row in (after - 1, after) if 0 <= row < len(timestamps) and not chosen[row]]
            best = min(near, key=lambda row: abs(int(timestamps[row]) - time), default=None)
            if best is not None and abs(int(timestamps[best]) - time) <= self.reach_ns:
                chosen[best] = True
        return chosen

    def numbers(self, sensor: Written, is_key: BoolArray) -> Int64Array:
        """(N,) int64: the sample that each frame belongs to: of key frames the nearest, else the next one."""
        timestamps = timestamps_of(sensor)
        after = np.minimum(np.searchsorted(self.timestamps_ns, timestamps), len(self.timestamps_ns) - 1)
        before = np.maximum(after - 1, 0)
        nearer = np.abs(timestamps - self.timestamps_ns[before]) < np.abs(
            timestamps - self.timestamps_ns[after]
        )
        return np.where(is_key & nearer, before, after).astype(np.int64)


def choose_samples(scene: Scene, sensors: list[Written], *, rate_hz: float | None, name: str) -> Samples:
    """Choose the samples: those that the scene was read with, else so many a second of the first lidar's frames.

    Args:
        scene: what is written.
        sensors: those that are written; without a lidar the first of them counts.
        rate_hz: samples a second; None: as read, else two.
        name: of the scene, for the tokens.

    Raises:
        DataError: no sensor has a frame.
    """
    framed = [sensor for sensor in sensors if len(timestamps_of(sensor))]
    if not framed:
        raise DataError(scene.source, "", "holds no sweep, radar cycle or image that nuScenes could hold")
    reference = next((sensor for sensor in framed if isinstance(sensor, LidarSensor)), framed[0])
    timestamps = np.sort(timestamps_of(reference))
    if rate_hz is None:
        read = _samples_read(scene.metadata.get("nuscenes"), timestamps)
        if read is not None:
            return read
    chosen = _spread(timestamps, _SECOND / (rate_hz or RATE_HZ))
    tokens = tuple(token_of("sample", name, time) for time in chosen.tolist())
    return Samples(tokens, chosen, round(_SECOND / (rate_hz or RATE_HZ) / 2))


def _samples_read(about: Any, timestamps_ns: Int64Array) -> Samples | None:
    """The samples that the scene was read with, as far as the reference still has their frames."""
    rows = about.get("samples") if isinstance(about, Mapping) else None
    if not isinstance(rows, list | tuple):
        return None
    there = set(microseconds(timestamps_ns).tolist())
    kept = [(str(token), int(time)) for token, time in rows if int(time) in there]
    if not kept:
        return None
    times = np.array([time for _, time in kept], np.int64) * _MICROSECOND
    return Samples(tuple(token for token, _ in kept), times, round(_SECOND / RATE_HZ / 2))


def _spread(timestamps_ns: Int64Array, period_ns: float) -> Int64Array:
    """Timestamps that are a period apart, as nearly as there are."""
    slack = float(np.median(np.diff(timestamps_ns))) / 2 if len(timestamps_ns) > 1 else 0.0
    chosen: list[int] = []
    due = float(timestamps_ns[0])
    for time in timestamps_ns.tolist():
        if time >= due - slack and (not chosen or time > chosen[-1]):
            chosen.append(time)
            due = max(due + period_ns, time + period_ns / 2)
    return np.array(chosen, np.int64)
