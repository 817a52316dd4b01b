"""The streams of a drive that have a clock, and what each reports the ego's motion."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from types import MappingProxyType
from typing import Any

from sceneloom.arrays import Float64Array
from sceneloom.errors import SceneloomError
from sceneloom.motion.clock.dead_reckoning import DeadReckonedTrajectory, Unit
from sceneloom.motion.clock.rotating import Rotating
from sceneloom.motion.clock.trajectories import Fixes, SmoothedTrajectory, TrajectoryCurve
from sceneloom.motion.imu_samples import ACCELEROMETER, GYROSCOPE
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene
from sceneloom.scene.span import frame_times
from sceneloom.scene.types import Identifier, PointsFrame, Progress


class StreamKind(StrEnum):
    """What a stream is."""

    IMU = "imu"
    TRAJECTORY = "trajectory"
    LIDAR = "lidar"
    CAMERA = "camera"
    GNSS = "gnss"


@dataclass(frozen=True, slots=True, eq=False)
class ReportedMotion:
    """What a stream reports the ego's motion.

    Attributes:
        rotating: how it rotated, or None.
        fixes: where it was, or None.
        trajectory: makes the trajectory from the time that its seconds count from, or None.
        ego_from_body: (3, 3), the rotation from the body that becomes the ego's frame, as far as it is known.
        location: (3,) [m], where on the ego the fixes are of, where that is known.
        why_not: why it states nothing.
    """

    rotating: Rotating | None = None
    fixes: Fixes | None = None
    trajectory: Callable[[int], SmoothedTrajectory] | None = None
    ego_from_body: Float64Array | None = None
    location: Float64Array | None = None
    why_not: str = ""


@dataclass(slots=True, eq=False)
class Stream:
    """One stream of a drive.

    Attributes:
        name: id of the sensor, or name of the trajectory; with its kind before it where two are named alike.
        kind: what it is.
        source: the sensor or the trajectory.
        scene: the drive that it is of.
    """

    name: str
    kind: StreamKind
    source: Any
    scene: Scene
    _reported: ReportedMotion | None = field(default=None)

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Its first and last timestamp [ns]; None where it has none."""
        source = self.source.streams[GYROSCOPE] if self.kind is StreamKind.IMU else self.source
        times = source.timestamps_ns if hasattr(source, "timestamps_ns") else frame_times(source)
        return (int(times.min()), int(times.max())) if len(times) else None

    def meets(self, other: "Stream", reach_ns: int) -> bool:
        """Whether the timestamps of both have time in common, if one is shifted by so much at most [ns]."""
        mine, others = self.span_ns, other.span_ns
        if mine is None or others is None:
            return False
        return max(mine[0], others[0]) <= min(mine[1], others[1]) + reach_ns

    def reported(self, progress: Progress | None = None) -> ReportedMotion:
        """What it reports the motion; worked out once, which for images and sweeps takes long.

        Args:
            progress: reported how many frames have been looked at.
        """
        if self._reported is None:
            try:
                self._reported = _TELLERS[self.kind](self, progress)
            except SceneloomError as error:
                self._reported = ReportedMotion(why_not=str(error))
        return self._reported


def streams_of(scene: Scene) -> tuple[Stream, ...]:
    """The streams of a drive: IMUs with a gyroscope, trajectories, lidars, cameras and satellite receivers."""
    found: list[tuple[StreamKind, Identifier, Any]] = [
        *(
            (StreamKind.IMU, sensor.id, sensor)
            for sensor in scene.sensors
            if isinstance(sensor, ImuSensor) and GYROSCOPE in sensor.streams
        ),
        *((StreamKind.TRAJECTORY, name, trajectory) for name, trajectory in scene.trajectories.items()),
        *((StreamKind.LIDAR, lidar.id, lidar) for lidar in scene.lidars if len(lidar.frames)),
        *((StreamKind.CAMERA, camera.id, camera) for camera in scene.cameras if len(camera.images)),
        *((StreamKind.GNSS, sensor.id, sensor) for sensor in scene.sensors if isinstance(sensor, GnssSensor)),
    ]
    texts = [str(name) for _, name, _ in found]
    return tuple(
        Stream(text if texts.count(text) == 1 else f"{kind}:{text}", kind, source, scene)
        for (kind, _, source), text in zip(found, texts, strict=True)
    )


def _of_imu(stream: Stream, progress: Progress | None) -> ReportedMotion:
    del progress
    imu: ImuSensor = stream.source
    rates, forces = imu.streams[GYROSCOPE], imu.streams.get(ACCELEROMETER)
    rotating = Rotating.of_rates(rates.timestamps_ns, rates.values[:, :3])
    if forces is None:
        return ReportedMotion(rotating)
    return ReportedMotion(
        rotating, trajectory=lambda origin_ns: DeadReckonedTrajectory(Unit.of(rates, forces), origin_ns)
    )


def _of_trajectory(stream: Stream, progress: Progress | None) -> ReportedMotion:
    del progress
    return _trajectory_reported(stream.source)


def _trajectory_reported(trajectory: Trajectory) -> ReportedMotion:
    rotations = trajectory.quaternions_xyzw
    return ReportedMotion(
        None if rotations is None else Rotating.of_poses(trajectory.timestamps_ns, rotations),
        Fixes.of_trajectory(trajectory),
        lambda origin_ns: TrajectoryCurve(trajectory, origin_ns),
    )


def _of_lidar(stream: Stream, progress: Progress | None) -> ReportedMotion:
    from sceneloom.motion.odometry.run import lidar_odometry

    lidar: LidarSensor = stream.source
    if lidar.points_frame is PointsFrame.WORLD:
        return ReportedMotion(why_not="its points are in the world already, by a clock that is not reported")
    alone = replace(stream.scene, sensors=(lidar,), annotations=(), attributes=())
    return _trajectory_reported(lidar_odometry(alone, progress=progress, lenient=True).trajectory)


def _of_camera(stream: Stream, progress: Progress | None) -> ReportedMotion:
    from sceneloom.motion.clock.camera_rotating import camera_rotating

    camera: CameraSensor = stream.source
    rotating = camera_rotating(camera, progress=progress)
    return ReportedMotion(rotating, ego_from_body=None if camera.mount is None else camera.mount.rotation)


def _of_receiver(stream: Stream, progress: Progress | None) -> ReportedMotion:
    del progress
    receiver: GnssSensor = stream.source
    return ReportedMotion(
        fixes=Fixes.of_receiver(receiver),
        location=None if receiver.mount is None else receiver.mount.translation,
    )


_TELLERS: Mapping[StreamKind, Callable[[Stream, Progress | None], ReportedMotion]] = MappingProxyType(
    {
        StreamKind.IMU: _of_imu,
        StreamKind.TRAJECTORY: _of_trajectory,
        StreamKind.LIDAR: _of_lidar,
        StreamKind.CAMERA: _of_camera,
        StreamKind.GNSS: _of_receiver,
    }
)
"""How each kind of stream reports the motion."""
