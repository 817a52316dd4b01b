"""The streams of a drive that have a clock, and what each tells of the ego's motion."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from types import MappingProxyType
from typing import Any

from sceneloom.arrays import Float64Array
from sceneloom.errors import SceneloomError
from sceneloom.motion.clock.reckoning import ReckonedWay, Unit
from sceneloom.motion.clock.turning import Turning
from sceneloom.motion.clock.ways import Fixes, TrajectoryWay, Way
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
class MotionTold:
    """What a stream tells of the ego's motion.

    Attributes:
        turning: how it turned, or None.
        fixes: where it was, or None.
        way: makes the way from the time that its seconds count from, or None.
        ego_from_body: (3, 3), the rotation from the body that turns into the ego's frame, as far as it is known.
        place: (3,) [m], where on the ego the fixes are of, where that is known.
        why_not: why it tells nothing.
    """

    turning: Turning | None = None
    fixes: Fixes | None = None
    way: Callable[[int], Way] | None = None
    ego_from_body: Float64Array | None = None
    place: Float64Array | None = None
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
    _told: MotionTold | None = field(default=None)

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Its first and last stamp [ns]; None where it has none."""
        source = self.source.streams[GYROSCOPE] if self.kind is StreamKind.IMU else self.source
        times = source.timestamps_ns if hasattr(source, "timestamps_ns") else frame_times(source)
        return (int(times.min()), int(times.max())) if len(times) else None

    def meets(self, other: "Stream", reach_ns: int) -> bool:
        """Whether the stamps of both have time in common, if one is shifted by so much at most [ns]."""
        mine, others = self.span_ns, other.span_ns
        if mine is None or others is None:
            return False
        return max(mine[0], others[0]) <= min(mine[1], others[1]) + reach_ns

    def told(self, progress: Progress | None = None) -> MotionTold:
        """What it tells of the motion; worked out once, which for pictures and sweeps takes long.

        Args:
            progress: told how many frames have been looked at.
        """
        if self._told is None:
            try:
                self._told = _TELLERS[self.kind](self, progress)
            except SceneloomError as error:
                self._told = MotionTold(why_not=str(error))
        return self._told


def streams_of(scene: Scene) -> tuple[Stream, ...]:
    """The streams of a drive: IMUs with a gyroscope, trajectories, lidars, cameras and satellite receivers."""
    found: list[tuple[StreamKind, Identifier, Any]] = [
        *(
            (StreamKind.IMU, sensor.id, sensor)
            for sensor in scene.sensors
            if isinstance(sensor, ImuSensor) and GYROSCOPE in sensor.streams
        ),
        *((StreamKind.TRAJECTORY, name, way) for name, way in scene.trajectories.items()),
        *((StreamKind.LIDAR, lidar.id, lidar) for lidar in scene.lidars if len(lidar.frames)),
        *((StreamKind.CAMERA, camera.id, camera) for camera in scene.cameras if len(camera.pictures)),
        *((StreamKind.GNSS, sensor.id, sensor) for sensor in scene.sensors if isinstance(sensor, GnssSensor)),
    ]
    texts = [str(name) for _, name, _ in found]
    return tuple(
        Stream(text if texts.count(text) == 1 else f"{kind}:{text}", kind, source, scene)
        for (kind, _, source), text in zip(found, texts, strict=True)
    )


def _of_imu(stream: Stream, progress: Progress | None) -> MotionTold:
    del progress
    imu: ImuSensor = stream.source
    rates, forces = imu.streams[GYROSCOPE], imu.streams.get(ACCELEROMETER)
    turning = Turning.of_rates(rates.timestamps_ns, rates.values[:, :3])
    if forces is None:
        return MotionTold(turning)
    return MotionTold(turning, way=lambda origin_ns: ReckonedWay(Unit.of(rates, forces), origin_ns))


def _of_trajectory(stream: Stream, progress: Progress | None) -> MotionTold:
    del progress
    return _trajectory_told(stream.source)


def _trajectory_told(trajectory: Trajectory) -> MotionTold:
    turns = trajectory.quaternions_xyzw
    return MotionTold(
        None if turns is None else Turning.of_poses(trajectory.timestamps_ns, turns),
        Fixes.of_trajectory(trajectory),
        lambda origin_ns: TrajectoryWay(trajectory, origin_ns),
    )


def _of_lidar(stream: Stream, progress: Progress | None) -> MotionTold:
    from sceneloom.motion.odometry.run import lidar_odometry

    lidar: LidarSensor = stream.source
    if lidar.points_frame is PointsFrame.WORLD:
        return MotionTold(why_not="its points are in the world already, by a clock that is not told")
    alone = replace(stream.scene, sensors=(lidar,), annotations=(), attributes=())
    return _trajectory_told(lidar_odometry(alone, progress=progress, lenient=True).trajectory)


def _of_camera(stream: Stream, progress: Progress | None) -> MotionTold:
    from sceneloom.motion.clock.camera_turning import camera_turning

    camera: CameraSensor = stream.source
    turning = camera_turning(camera, progress=progress)
    return MotionTold(turning, ego_from_body=None if camera.mount is None else camera.mount.rotation)


def _of_receiver(stream: Stream, progress: Progress | None) -> MotionTold:
    del progress
    receiver: GnssSensor = stream.source
    return MotionTold(
        fixes=Fixes.of_receiver(receiver),
        place=None if receiver.mount is None else receiver.mount.translation,
    )


_TELLERS: Mapping[StreamKind, Callable[[Stream, Progress | None], MotionTold]] = MappingProxyType(
    {
        StreamKind.IMU: _of_imu,
        StreamKind.TRAJECTORY: _of_trajectory,
        StreamKind.LIDAR: _of_lidar,
        StreamKind.CAMERA: _of_camera,
        StreamKind.GNSS: _of_receiver,
    }
)
"""How each kind of stream tells of the motion."""
