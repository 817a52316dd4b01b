"""The streams of a drive that have a clock, and the comparison of two of them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import SceneloomError
from sceneloom.motion.clock.comparison import (
    LEVER_SIGMA,
    REACH_NS,
    ClockEstimate,
    ClockVerdict,
    compare_rotations,
    compare_trajectories,
)
from sceneloom.motion.clock.signals import (
    DeadReckonedTrajectory,
    Fixes,
    ImuSamples,
    Orientations,
    SmoothedTrajectory,
    TrajectoryCurve,
)
from sceneloom.motion.imu import ACCELEROMETER, GYROSCOPE
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, frame_times
from sceneloom.scene.types import Identifier, PointsFrame, Progress

_KNOWN_LEVER_SIGMA = 0.05  # standard deviation of a known antenna position on each axis [m]


class StreamKind(StrEnum):
    """What a stream is."""

    IMU = "imu"
    TRAJECTORY = "trajectory"
    LIDAR = "lidar"
    CAMERA = "camera"
    GNSS = "gnss"


class Method(StrEnum):
    """By what two streams were compared."""

    ROTATION = "rotation"
    TRAJECTORY = "trajectory"
    NONE = "none"


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """The ego's motion as a stream measures it."""

    orientations: Orientations | None = None  # of the body, or None
    fixes: Fixes | None = None  # positions, or None
    trajectory: Callable[[int], SmoothedTrajectory] | None = None  # with times in seconds after its argument [ns]
    ego_from_body: Float64Array | None = None  # (3, 3), as far as known
    location: Float64Array | None = None  # (3,) [m], where on the ego the fixes are measured, or None
    why_not: str = ""  # why there is no motion


@dataclass(slots=True, eq=False)
class Stream:
    """One stream of a drive.

    Attributes:
        name: id of the sensor, or name of the trajectory; prefixed with its kind where two have the same name.
        kind: what it is.
        source: the sensor or the trajectory.
        scene: the drive.
    """

    name: str
    kind: StreamKind
    source: Any
    scene: Scene
    _motion: _Motion | None = field(default=None)

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """First and last timestamp [ns]; None where it has none."""
        source = self.source.streams[GYROSCOPE] if self.kind is StreamKind.IMU else self.source
        times = source.timestamps_ns if hasattr(source, "timestamps_ns") else frame_times(source)
        return (int(times.min()), int(times.max())) if len(times) else None

    def motion(self, progress: Progress | None = None) -> _Motion:
        """The motion that it measures; computed once, which takes long for images and sweeps.

        Args:
            progress: called with the number of frames done.
        """
        if self._motion is None:
            try:
                self._motion = _MOTIONS[self.kind](self, progress)
            except SceneloomError as error:
                self._motion = _Motion(why_not=str(error))
        return self._motion


def streams_of(scene: Scene) -> tuple[Stream, ...]:
    """The streams of a drive: IMUs with a gyroscope, trajectories, lidars, cameras and GNSS receivers."""
    imus = [s for s in scene.sensors if isinstance(s, ImuSensor) and GYROSCOPE in s.streams]
    found: list[tuple[StreamKind, Identifier, Any]] = [
        *((StreamKind.IMU, imu.id, imu) for imu in imus),
        *((StreamKind.TRAJECTORY, name, trajectory) for name, trajectory in scene.trajectories.items()),
        *((StreamKind.LIDAR, lidar.id, lidar) for lidar in scene.lidars if len(lidar.frames)),
        *((StreamKind.CAMERA, camera.id, camera) for camera in scene.cameras if len(camera.images)),
        *((StreamKind.GNSS, sensor.id, sensor) for sensor in scene.sensors if isinstance(sensor, GnssSensor)),
    ]
    names = [str(name) for _, name, _ in found]
    return tuple(
        Stream(name if names.count(name) == 1 else f"{kind}:{name}", kind, source, scene)
        for (kind, _, source), name in zip(found, names, strict=True)
    )


def _imu_motion(stream: Stream, _: Progress | None) -> _Motion:
    imu: ImuSensor = stream.source
    rates, forces = imu.streams[GYROSCOPE], imu.streams.get(ACCELEROMETER)
    orientations = Orientations.of_rates(rates.timestamps_ns, rates.values[:, :3])
    if forces is None:
        return _Motion(orientations)
    return _Motion(
        orientations, trajectory=lambda origin_ns: DeadReckonedTrajectory(ImuSamples.of(rates, forces), origin_ns)
    )


def _trajectory_motion(trajectory: Trajectory) -> _Motion:
    rotations = trajectory.quaternions_xyzw
    return _Motion(
        None if rotations is None else Orientations.of_poses(trajectory.timestamps_ns, rotations),
        Fixes.of_trajectory(trajectory),
        lambda origin_ns: TrajectoryCurve(trajectory, origin_ns),
    )


def _lidar_motion(stream: Stream, progress: Progress | None) -> _Motion:
    from sceneloom.motion.odometry import lidar_odometry

    lidar: LidarSensor = stream.source
    if lidar.points_frame is PointsFrame.WORLD:
        return _Motion(why_not="its points are in world coordinates; the clock of that transform is unknown")
    alone = replace(stream.scene, sensors=(lidar,), annotations=(), attributes=())
    return _trajectory_motion(lidar_odometry(alone, progress=progress, lenient=True).trajectory)


def _camera_motion(stream: Stream, progress: Progress | None) -> _Motion:
    from sceneloom.motion.clock.camera_rotation import camera_rotation

    mount = stream.source.mount
    orientations = camera_rotation(stream.source, progress=progress)
    return _Motion(orientations, ego_from_body=None if mount is None else mount.rotation)


def _receiver_motion(stream: Stream, _: Progress | None) -> _Motion:
    mount = stream.source.mount
    return _Motion(fixes=Fixes.of_receiver(stream.source), location=None if mount is None else mount.translation)


_MOTIONS: Mapping[StreamKind, Callable[[Stream, Progress | None], _Motion]] = MappingProxyType(
    {
        StreamKind.IMU: _imu_motion,
        StreamKind.TRAJECTORY: lambda stream, _: _trajectory_motion(stream.source),
        StreamKind.LIDAR: _lidar_motion,
        StreamKind.CAMERA: _camera_motion,
        StreamKind.GNSS: _receiver_motion,
    }
)


def compare_streams(
    reference: Stream,
    stream: Stream,
    *,
    reach_ns: int = REACH_NS,
    lever_sigma: float = LEVER_SIGMA,
    progress: Progress | None = None,
) -> tuple[Method, ClockEstimate]:
    """Estimate offset and skew of a stream's clock against that of a reference.

    By the rotation of the ego, where both measure it; else by its positions.

    Args:
        reach_ns: largest offset that is searched [ns].
        lever_sigma: standard deviation of the antenna's position on the ego on each axis, where it is unknown [m].
        progress: called while images or sweeps are processed.
    """
    spans = [span for span in (reference.span_ns, stream.span_ns) if span is not None]
    if len(spans) < 2 or max(first for first, _ in spans) > min(last for _, last in spans) + reach_ns:
        return Method.NONE, ClockEstimate.unknown("their timestamps have no time in common")
    first, second = reference.motion(progress), stream.motion(progress)
    for name, motion in ((reference.name, first), (stream.name, second)):
        if motion.why_not:
            return Method.NONE, ClockEstimate.unknown(f"{name}: {motion.why_not}")
    by_rotation: ClockEstimate | None = None
    if first.orientations is not None and second.orientations is not None:
        ego_from_stream, ego_from_reference = (
            np.eye(3) if motion.ego_from_body is None else motion.ego_from_body for motion in (second, first)
        )
        by_rotation = compare_rotations(
            first.orientations,
            second.orientations,
            reach_ns=reach_ns,
            reference_from_stream=ego_from_reference.T @ ego_from_stream,
        )
        if by_rotation.verdict is not ClockVerdict.NOT_OBSERVABLE:
            return Method.ROTATION, by_rotation
    by_trajectory = _by_trajectory(first, second, reach_ns, lever_sigma)
    if by_trajectory is not None and (by_rotation is None or by_trajectory.verdict is not ClockVerdict.NOT_OBSERVABLE):
        return Method.TRAJECTORY, by_trajectory
    if by_rotation is not None:
        return Method.ROTATION, by_rotation
    return Method.NONE, ClockEstimate.unknown("one measures only positions, the other only rotation")


def _by_trajectory(reference: _Motion, stream: _Motion, reach_ns: int, lever_sigma: float) -> ClockEstimate | None:
    """Compare fixes with a trajectory, where one stream has fixes and the other a trajectory."""
    for measured, trajectory, fixes_are_reference in (
        (stream, reference.trajectory, False),
        (reference, stream.trajectory, True),
    ):
        fixes, lever = measured.fixes, measured.location
        if fixes is not None and trajectory is not None and len(fixes):
            origin_ns = int(fixes.timestamps_ns[0])
            return compare_trajectories(
                fixes,
                trajectory(origin_ns),
                origin_ns=origin_ns,
                fixes_are_reference=fixes_are_reference,
                reach_ns=reach_ns,
                lever=lever,
                lever_sigma=lever_sigma if lever is None else min(lever_sigma, _KNOWN_LEVER_SIGMA),
            )
    return None
