"""Making a scene wrong on request: the timestamps, frames, contents and mountings of its sensors."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.span import frame_times
from sceneloom.scene.types import Identifier, SensorType
from sceneloom.simulate.faults import POSSIBLE_FAULTS, Faults, SensorFaults
from sceneloom.simulate.faulty_frames import Clock, FaultyClouds, FaultyImages, FramePlan, refocused

Cloud = TypeVar("Cloud", LidarSensor, RadarSensor)


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """The faults of one sensor, and what its random losses start from."""

    wrong: SensorFaults
    clock: Clock
    seed: int
    sensor_id: Identifier

    @classmethod
    def of(cls, sensor: Sensor, wrong: SensorFaults, seed: int) -> "_Job":
        times = frame_times(sensor)
        first_ns = int(times.min()) if len(times) else 0
        clock = Clock(first_ns, wrong.time_offset_ns, wrong.clock_skew_ppm)
        return cls(wrong, clock, seed, sensor.id)

    def plan(self, timestamps_ns: Int64Array) -> FramePlan:
        return FramePlan.of(self.wrong, timestamps_ns, self.clock, seed=self.seed, sensor_id=self.sensor_id)


def _plant_in_cloud(sensor: Cloud, job: _Job) -> tuple[Cloud, Int64Array]:
    plan = job.plan(sensor.frames.timestamps_ns)
    frames = LazyFrames(plan.stated_ns, FaultyClouds(sensor.frames, plan, job.clock, job.wrong))
    return replace(sensor, frames=frames, **_placement(sensor, job.wrong)), plan.contents


def _plant_in_camera(sensor: CameraSensor, job: _Job) -> tuple[CameraSensor, Int64Array]:
    plan, scale = job.plan(sensor.images.timestamps_ns), job.wrong.focal_scale
    images = LazyFrames(plan.stated_ns, FaultyImages(sensor.images, plan, job.wrong.error, scale))
    camera = refocused(sensor.camera, scale)
    placed = _placement(sensor, job.wrong)
    return replace(sensor, camera=camera, images=images, video=None, **placed), plan.contents


def _placement(sensor: LidarSensor | RadarSensor | CameraSensor, wrong: SensorFaults) -> dict[str, Any]:
    """The mounting and the poses that the scene states, where they are wrong."""
    if not wrong.named & {"rotation_deg", "shift"}:
        return {}
    poses: Poses | None = sensor.poses
    if poses is not None:
        stated = PoseSource(poses, wrong.error).at(poses.timestamps_ns)
        poses = replace(poses, positions=stated.positions, quaternions_xyzw=stated.quaternions_xyzw)
    return {"poses": poses, "mount": None if sensor.mount is None else sensor.mount @ wrong.error}


def _plant_in_imu(sensor: ImuSensor, job: _Job) -> tuple[ImuSensor, Int64Array]:
    plans = {name: job.plan(samples.timestamps_ns) for name, samples in sensor.streams.items()}
    streams = {
        name: VectorSamples(
            plans[name].stated_ns, _rotated(samples.values[plans[name].contents], job.wrong.error)
        )
        for name, samples in sensor.streams.items()
    }
    contents = max((plan.contents for plan in plans.values()), key=len, default=np.zeros(0, np.int64))
    return replace(sensor, streams=streams), contents


def _rotated(values: Float64Array, error: RigidTransform) -> Float64Array:
    """What a unit reports that is rotated while its frame counts as the ego's; only vectors of space rotate."""
    return error.rotate(values) if values.shape[1] == 3 else values


def _plant_in_gnss(sensor: GnssSensor, job: _Job) -> tuple[GnssSensor, Int64Array]:
    plan = job.plan(sensor.timestamps_ns)
    rows = plan.contents
    changed = replace(
        sensor,
        timestamps_ns=plan.stated_ns,
        positions_lla=sensor.positions_lla[rows],
        accuracies=sensor.accuracies[rows],
        vertical_accuracies=sensor.vertical_accuracies[rows],
        file_seconds=None,
    )
    return changed, rows


_PLANTERS: Mapping[str, Callable[[Any, _Job], tuple[Any, Int64Array]]] = MappingProxyType(
    {
        SensorType.LIDAR: _plant_in_cloud,
        SensorType.RADAR: _plant_in_cloud,
        SensorType.CAMERA: _plant_in_camera,
        SensorType.IMU: _plant_in_imu,
        SensorType.GNSS: _plant_in_gnss,
    }
)


def plant_in_scene(scene: Scene, faults: Faults) -> tuple[Scene, Mapping[Identifier, Int64Array]]:
    """Make a scene wrong; its frames are still read when asked for, each the same whenever it is.

    Returns:
        The scene, and for each sensor with faults (F,) int64: the number of the true frame that each of its frames
        shows (of an IMU: of its longest stream).

    Raises:
        OptionError: there is no such sensor or frame, or a fault means nothing for that kind of sensor.
    """
    for sensor_id, wrong in faults.sensors.items():
        _check_possible(scene.sensor(sensor_id), wrong)
    sensors: list[Sensor] = []
    true_frames: dict[Identifier, Int64Array] = {}
    for sensor in scene.sensors:
        changed = sensor
        if sensor.id in faults.sensors:
            job = _Job.of(sensor, faults.sensors[sensor.id], faults.seed)
            changed, true_frames[sensor.id] = _PLANTERS[str(sensor.type)](sensor, job)
        sensors.append(changed)
    return replace(scene, sensors=tuple(sensors)), true_frames


def _check_possible(sensor: Sensor, wrong: SensorFaults) -> None:
    possible = POSSIBLE_FAULTS.get(str(sensor.type), frozenset())
    strange = sorted(wrong.named - possible)
    if strange:
        raise OptionError(
            f"faults of sensor {sensor.id!r}: {', '.join(strange)}; a sensor of type {sensor.type} can have "
            f"{', '.join(sorted(possible)) or 'none'}"
        )
