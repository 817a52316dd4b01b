"""A part of a scene in time: what lies in it, and the poses around it."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from sceneloom.arrays import BoolArray, Int64Array
from sceneloom.errors import OptionError
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.labelled import Renumbering, renumbered
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, VectorSamples
from sceneloom.scene.part_annotations import (
    Interval,
    cut_annotation,
    cut_attributes,
    cut_poses,
    rows_around,
    rows_between,
    without_loose_ends,
)
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.shooting import Shooting, chosen_shots
from sceneloom.scene.span import frame_times, time_span
from sceneloom.scene.types import Key, key_of
from sceneloom.scene.warnings import DataWarning, WarningKind

_POSES_AROUND_NS = 1_000_000_000
"""Poses so long before and after a part stay in it: its last sweep ends later than it begins."""

_SAME_TIME_NS = 100_000
"""A frame that comes so long before a bound comes with it: two firings of a lidar."""

_LONGEST = 9.2e9
"""What int64 nanoseconds hold, nearly [s]."""

Moving = TypeVar("Moving", LidarSensor, RadarSensor, CameraSensor, DepthCameraSensor)
Cloud = TypeVar("Cloud", LidarSensor, RadarSensor)


def chosen_interval(
    scene: Scene, *, start: float | None = None, stop: float | None = None
) -> Interval | None:
    """Rotate seconds after a scene's first timestamp into times; None for the whole scene.

    Args:
        start: None for the beginning.
        stop: exclusive, None for the end.

    Raises:
        OptionError: the interval is empty.
    """
    span_ns = time_span(scene)
    if (start is None and stop is None) or span_ns is None:
        return None
    start_s, stop_s = start or 0.0, float("inf") if stop is None else stop
    if not (start_s >= 0 and stop_s > start_s):
        raise OptionError(f"from {start_s} s to {stop_s} s; expected 0 <= start < stop")
    first_ns = span_ns[0] + round(min(start_s, _LONGEST) * 1e9)
    last_ns = span_ns[0] + round(min(stop_s, _LONGEST) * 1e9)
    timestamps_ns = _frame_timestamps(scene)
    return _taking_near(first_ns, timestamps_ns), min(_taking_near(last_ns, timestamps_ns), span_ns[1] + 1)


def _frame_timestamps(scene: Scene) -> Int64Array:
    """The times of all frames and images (N,) int64 [ns], in order."""
    kinds = LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor
    times = [frame_times(sensor) for sensor in scene.sensors if isinstance(sensor, kinds)]
    return np.sort(np.concatenate(times)) if times else np.zeros(0, np.int64)


def _taking_near(bound_ns: int, timestamps_ns: Int64Array) -> int:
    """A bound, or the earliest frame that is as good as on it.

    The first sweep of a fused drive begins with its earliest point, some microseconds after the timestamp of the
    sensor: counted from there, whole seconds would pass over frames that come at whole seconds of the sensor's clock.
    """
    row = int(np.searchsorted(timestamps_ns, bound_ns - _SAME_TIME_NS))
    return min(bound_ns, int(timestamps_ns[row])) if row < len(timestamps_ns) else bound_ns


def cut_scene(scene: Scene, *, start: float | None = None, stop: float | None = None) -> Scene:
    """Keep a part of a scene: frames, images, samples and annotations in it, and the poses in and around it.

    Images are kept to the end of the last sweep, since that is paired with one later than its start. Annotations
    that are not there in the part are left out, labelled points follow their frames, and what holds at all times
    stays.

    Args:
        start: seconds after the scene's first timestamp, None for the beginning.
        stop: seconds after it, exclusive, None for the end.

    Raises:
        OptionError: the interval is empty, or no frame lies in it.
    """
    part = chosen_interval(scene, start=start, stop=stop)
    if part is None:
        return scene
    with_images = (part[0], max([part[1], *(_sweeps_end(lidar, part) for lidar in scene.lidars)]))
    sensors = tuple(
        _cut_sensor(sensor, with_images if isinstance(sensor, CameraSensor | DepthCameraSensor) else part)
        for sensor in scene.sensors
    )
    kinds = LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor
    if not any(len(frame_times(sensor)) for sensor in sensors if isinstance(sensor, kinds)):
        length = np.ptp(time_span(scene) or (0, 0)) / 1e9
        until = "the end" if stop is None else f"{stop} s"
        raise OptionError(
            f"{scene.source}: no frame from {start or 0.0} s to {until}; the scene lasts {length:.3f} s"
        )
    annotations, reported = _cut_annotations(scene, part, with_images)
    return replace(
        scene,
        sensors=sensors,
        annotations=annotations,
        attributes=cut_attributes(scene.attributes, part),
        trajectories={
            name: _cut_trajectory(trajectory, part) for name, trajectory in scene.trajectories.items()
        },
        warnings=scene.warnings + reported,
    )


def cut_path(path: Poses, part: Interval) -> Poses:
    """Keep the poses in and around a part, so that between its times nothing changes."""
    return cut_poses(path, part, _POSES_AROUND_NS)


def _sweeps_end(lidar: LidarSensor, part: Interval) -> int:
    """When the last sweep that begins in the part ends, as far as the timestamps can report."""
    times = lidar.frames.timestamps_ns
    rows = rows_between(times, part)
    if rows.start == rows.stop or len(times) < 2:
        return part[1]
    return int(times[rows.stop - 1]) + int(np.median(np.diff(times)))


def _cut_trajectory(trajectory: Trajectory, part: Interval) -> Trajectory:
    rows = rows_around(trajectory.timestamps_ns, part, _POSES_AROUND_NS)
    return Trajectory(
        trajectory.name,
        trajectory.timestamps_ns[rows],
        trajectory.positions[rows],
        None if trajectory.quaternions_xyzw is None else trajectory.quaternions_xyzw[rows],
        None if trajectory.file_seconds is None else trajectory.file_seconds[rows],
        None if trajectory.covariances is None else trajectory.covariances[rows],
    )


def _cut_sensor(sensor: Sensor, part: Interval) -> Sensor:
    cut = next((cut for kind, cut in _CUTS.items() if isinstance(sensor, kind)), None)
    return sensor if cut is None else cut(sensor, part)


def _cut_cloud(sensor: Cloud, part: Interval) -> Cloud:
    return _with_cut_poses(replace(sensor, frames=sensor.frames[_rows_in(sensor, part)]), part)


def _cut_camera(sensor: Shooting, part: Interval) -> Shooting:
    return _with_cut_poses(chosen_shots(sensor, _rows_in(sensor, part)), part)


def _with_cut_poses(sensor: Moving, part: Interval) -> Moving:
    return sensor if sensor.poses is None else replace(sensor, poses=cut_path(sensor.poses, part))


def _cut_odometry(sensor: OdometrySensor, part: Interval) -> OdometrySensor:
    return replace(sensor, poses=cut_path(sensor.poses, part))


def _cut_imu(sensor: ImuSensor, part: Interval) -> ImuSensor:
    return replace(sensor, streams={name: _cut_samples(s, part) for name, s in sensor.streams.items()})


def _cut_samples(samples: VectorSamples, part: Interval) -> VectorSamples:
    rows = rows_between(samples.timestamps_ns, part)
    seconds = samples.file_seconds
    return VectorSamples(
        samples.timestamps_ns[rows], samples.values[rows], None if seconds is None else seconds[rows]
    )


def _cut_fixes(sensor: GnssSensor, part: Interval) -> GnssSensor:
    return chosen_fixes(sensor, rows_between(sensor.timestamps_ns, part))


def chosen_fixes(sensor: GnssSensor, rows: slice | Int64Array | BoolArray) -> GnssSensor:
    """Give the receiver with some of its fixes."""
    return replace(
        sensor,
        timestamps_ns=sensor.timestamps_ns[rows],
        positions_lla=sensor.positions_lla[rows],
        accuracies=sensor.accuracies[rows],
        vertical_accuracies=sensor.vertical_accuracies[rows],
        file_seconds=None if sensor.file_seconds is None else sensor.file_seconds[rows],
    )


_CUTS: Mapping[type, Callable[[Any, Interval], Sensor]] = MappingProxyType(
    {
        CameraSensor: _cut_camera,
        DepthCameraSensor: _cut_camera,
        LidarSensor: _cut_cloud,
        RadarSensor: _cut_cloud,
        OdometrySensor: _cut_odometry,
        ImuSensor: _cut_imu,
        GnssSensor: _cut_fixes,
    }
)
"""How the sensors that measure over time are cut; the others stay whole."""


def _cut_annotations(
    scene: Scene, part: Interval, with_images: Interval
) -> tuple[tuple[Annotation, ...], tuple[DataWarning, ...]]:
    """Cut the annotations; labelled points follow their frames, links and children what they name."""
    cut = [cut_annotation(a, part, with_images=with_images) for a in scene.annotations]
    there, reported = renumbered((a for a in cut if a is not None), _kept_frames(scene, part))
    annotations, freed = without_loose_ends(scene.annotations, there)
    gone = len(scene.annotations) - len(annotations)
    return annotations, (*_warnings(_LEFT_OUT, gone), *_warnings(_FREED, freed), *reported)


def _kept_frames(scene: Scene, part: Interval) -> dict[Key, Renumbering]:
    """The old numbers of the frames that stay, of each lidar and radar that loses some."""
    clouds = [sensor for sensor in scene.sensors if isinstance(sensor, LidarSensor | RadarSensor)]
    rows = {key_of(sensor.id): (_rows_in(sensor, part), len(sensor.frames)) for sensor in clouds}
    return {
        key: Renumbering(np.arange(kept.start, kept.stop))
        for key, (kept, count) in rows.items()
        if (kept.start, kept.stop) != (0, count)
    }


def _rows_in(sensor: LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor, part: Interval) -> slice:
    return rows_between(frame_times(sensor), part)


_LEFT_OUT = ("annotations-cut", "annotations that are not there in the chosen part were left out")
_FREED = ("parents-cut", "annotations whose parents are not there in the chosen part stand without them")


def _warnings(reported: tuple[str, str], count: int) -> tuple[DataWarning, ...]:
    if count == 0:
        return ()
    code, message = reported
    return (
        DataWarning(
            kind=WarningKind.SKIPPED, code=code, location="annotations", message=message, count=count
        ),
    )
