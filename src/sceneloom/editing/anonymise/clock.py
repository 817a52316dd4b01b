"""A drive whose clock begins with it, so that nothing reports the day."""

from dataclasses import replace
from typing import Any

from sceneloom.arrays import read_only
from sceneloom.editing.retimed_annotations import retimed_annotation
from sceneloom.editing.retiming import ClockCorrection, retimed_sensor, retimed_trajectory
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.span import time_span
from sceneloom.scene.types import key_of


def clock_from_zero(scene: Scene) -> Scene:
    """Give the scene with all times counted from the first timestamp of what was measured.

    Frames are read and moved when asked for. What only a file's own form of times holds goes.
    """
    span_ns = time_span(scene)
    if span_ns is None:
        return replace(scene, time_offset_ns=0)
    # an int, since a float of today's times holds no single nanoseconds
    correction = ClockCorrection(offset_ns=span_ns[0])
    own = {key_of(sensor.id): correction.right for sensor in scene.sensors}
    return replace(
        scene,
        sensors=tuple(_moved(sensor, correction) for sensor in scene.sensors),
        trajectories={
            name: retimed_trajectory(trajectory, correction)
            for name, trajectory in scene.trajectories.items()
        },
        annotations=tuple(retimed_annotation(one, own, correction.right) for one in scene.annotations),
        attributes=tuple(retimed_annotation(one, own, correction.right) for one in scene.attributes),
        time_offset_ns=0,
    )


def _moved(sensor: Sensor, correction: ClockCorrection) -> Sensor:
    """A sensor with all its times moved, those of its poses too."""
    moved: Any = retimed_sensor(sensor, correction)
    poses = getattr(moved, "poses", None)
    if not isinstance(poses, Poses) or poses.static:
        return sensor if moved is sensor else _typed(moved)
    return _typed(
        replace(moved, poses=replace(poses, timestamps_ns=read_only(correction.right(poses.timestamps_ns))))
    )


def _typed(sensor: Any) -> Sensor:
    found: Sensor = sensor
    return found
