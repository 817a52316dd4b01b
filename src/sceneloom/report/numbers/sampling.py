"""Which frames of a drive are looked at: some, spread evenly, so that a long drive takes no longer than a short one."""

from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.span import sweep_period_ns

Frame = TypeVar("Frame")


def spread_rows(count: int, most: int) -> Int64Array:
    """At most so many row numbers out of `count`, evenly spread, the first and the last among them."""
    if count < 1:
        return np.zeros(0, np.int64)
    rows: Int64Array = np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(np.int64))
    return rows


def chosen_frames(frames: LazyFrames[Frame], rows: Int64Array) -> LazyFrames[Frame]:
    """Some of the frames, by their numbers."""
    if len(rows) == len(frames):
        return frames
    return LazyFrames(frames.timestamps_ns[rows], partial(_frame_of, frames, tuple(rows.tolist())))


def _frame_of(frames: LazyFrames[Frame], rows: tuple[int, ...], k: int) -> Frame:
    return frames[rows[k]]


def with_some_sweeps(scene: Scene, most: int) -> Scene:
    """The scene with at most so many sweeps of each lidar, and of cameras the images within two sweeps of these."""
    kept = {lidar.id: spread_rows(len(lidar.frames), most) for lidar in scene.lidars}
    spans = [
        (lidar.frames.timestamps_ns[kept[lidar.id]], 2 * sweep_period_ns(lidar)) for lidar in scene.lidars
    ]

    def thinned(sensor: Sensor) -> Sensor:
        if isinstance(sensor, LidarSensor):
            return replace(sensor, frames=chosen_frames(sensor.frames, kept[sensor.id]))
        if isinstance(sensor, CameraSensor):
            rows = _rows_around(sensor.images.timestamps_ns, spans)
            return replace(sensor, images=chosen_frames(sensor.images, rows), video=None)
        return sensor

    return replace(scene, sensors=tuple(map(thinned, scene.sensors)))


def _rows_around(times_ns: Int64Array, spans: list[tuple[Int64Array, int]]) -> Int64Array:
    """Which of the times (N,) lie within reach of one of the sweeps; each span is (timestamps, reach)."""
    near = np.zeros(len(times_ns), np.bool_)
    for sweeps_ns, reach_ns in spans:
        for sweep_ns in sweeps_ns.tolist():
            near |= np.abs(times_ns - sweep_ns) <= reach_ns
    return np.flatnonzero(near)
