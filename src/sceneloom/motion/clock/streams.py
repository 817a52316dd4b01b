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
    compare_trajectories,
    compare_turnings,
)
from sceneloom.motion.clock.signals import (
    DeadReckonedTrajectory,
    Fixes,
    Rotating,
    SmoothedTrajectory,
    TrajectoryCurve,
    Unit,
)
from sceneloom.motion.imu import ACCELEROMETER, GYROSCOPE
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, frame_times
from sceneloom.scene.types import Identifier, PointsFrame, Progress


class StreamKind(StrEnum):
    """What a stream is."""

    IMU = "imu"
    TRAJECTORY = "trajectory"
    LIDAR = "lidar"
    CAMERA = "camera"
    GNSS = "gnss"


@dataclass(frozen=True, slots=True, eq=False)
class _ReportedMotion:
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
    _reported: _ReportedMotion | None = field(default=None)

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

    def reported(self, progress: Progress | None = None) -> _ReportedMotion:
        """What it reports the motion; worked out once, which for images and sweeps takes long.

        Args:
            progress: reported how many frames have been looked at.
        """
        if self._reported is None:
            try:
                self._reported = _TELLERS[self.kind](self, progress)
            except SceneloomError as error:
                self._reported = _ReportedMotion(why_not=str(error))
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


def _of_imu(stream: Stream, progress: Progress | None) -> _ReportedMotion:
    del progress
    imu: ImuSensor = stream.source
    rates, forces = imu.streams[GYROSCOPE], imu.streams.get(ACCELEROMETER)
    rotating = Rotating.of_rates(rates.timestamps_ns, rates.values[:, :3])
    if forces is None:
        return _ReportedMotion(rotating)
    return _ReportedMotion(
        rotating, trajectory=lambda origin_ns: DeadReckonedTrajectory(Unit.of(rates, forces), origin_ns)
    )


def _of_trajectory(stream: Stream, progress: Progress | None) -> _ReportedMotion:
    del progress
    return _trajectory_reported(stream.source)


def _trajectory_reported(trajectory: Trajectory) -> _ReportedMotion:
    rotations = trajectory.quaternions_xyzw
    return _ReportedMotion(
        None if rotations is None else Rotating.of_poses(trajectory.timestamps_ns, rotations),
        Fixes.of_trajectory(trajectory),
        lambda origin_ns: TrajectoryCurve(trajectory, origin_ns),
    )


def _of_lidar(stream: Stream, progress: Progress | None) -> _ReportedMotion:
    from sceneloom.motion.odometry import lidar_odometry

    lidar: LidarSensor = stream.source
    if lidar.points_frame is PointsFrame.WORLD:
        return _ReportedMotion(why_not="its points are in the world already, by a clock that is not reported")
    alone = replace(stream.scene, sensors=(lidar,), annotations=(), attributes=())
    return _trajectory_reported(lidar_odometry(alone, progress=progress, lenient=True).trajectory)


def _of_camera(stream: Stream, progress: Progress | None) -> _ReportedMotion:
    from sceneloom.motion.clock.camera_rotation import camera_rotating

    camera: CameraSensor = stream.source
    rotating = camera_rotating(camera, progress=progress)
    return _ReportedMotion(rotating, ego_from_body=None if camera.mount is None else camera.mount.rotation)


def _of_receiver(stream: Stream, progress: Progress | None) -> _ReportedMotion:
    del progress
    receiver: GnssSensor = stream.source
    return _ReportedMotion(
        fixes=Fixes.of_receiver(receiver),
        location=None if receiver.mount is None else receiver.mount.translation,
    )


_TELLERS: Mapping[StreamKind, Callable[[Stream, Progress | None], _ReportedMotion]] = MappingProxyType(
    {
        StreamKind.IMU: _of_imu,
        StreamKind.TRAJECTORY: _of_trajectory,
        StreamKind.LIDAR: _of_lidar,
        StreamKind.CAMERA: _of_camera,
        StreamKind.GNSS: _of_receiver,
    }
)
"""How each kind of stream reports the motion."""

_KNOWN_LEVER_SIGMA = 0.05
"""How well a stated mounting of an antenna is known on each axis [m]."""


class Method(StrEnum):
    """By what two streams were compared."""

    ROTATING = "rotating"
    TRAJECTORY = "estimated_trajectory"
    NONE = "none"


def compare_streams(
    reference: Stream,
    stream: Stream,
    *,
    reach_ns: int = REACH_NS,
    lever_sigma: float = LEVER_SIGMA,
    progress: Progress | None = None,
) -> tuple[Method, ClockEstimate]:
    """Find how the clock of one stream goes against that of another.

    By how the ego rotated, where both report it; else by where it was.

    Args:
        reach_ns: offsets up to this are looked for [ns].
        lever_sigma: how far from the ego's origin a receiver's antenna may be on each axis, where no mounting is
            stated [m].
        progress: reported while images or sweeps are looked at.
    """
    if not stream.meets(reference, reach_ns):
        return Method.NONE, ClockEstimate.unknown("their timestamps have no time in common")
    first, second = reference.reported(progress), stream.reported(progress)
    for name, reported in ((reference.name, first), (stream.name, second)):
        if reported.why_not:
            return Method.NONE, ClockEstimate.unknown(f"{name}: {reported.why_not}")
    by_rotation: ClockEstimate | None = None
    if first.rotating is not None and second.rotating is not None:
        by_rotation = compare_turnings(
            first.rotating, second.rotating, reach_ns=reach_ns, reference_from_stream=_between(first, second)
        )
        if by_rotation.verdict is not ClockVerdict.NOT_OBSERVABLE:
            return Method.ROTATING, by_rotation
    by_trajectory = _by_trajectory(first, second, reach_ns=reach_ns, lever_sigma=lever_sigma)
    if by_trajectory is not None and (
        by_rotation is None or by_trajectory.verdict is not ClockVerdict.NOT_OBSERVABLE
    ):
        return Method.TRAJECTORY, by_trajectory
    if by_rotation is not None:
        return Method.ROTATING, by_rotation
    return Method.NONE, ClockEstimate.unknown(
        "the one reports only where it was, the other only how it rotated"
    )


def _between(reference: _ReportedMotion, stream: _ReportedMotion) -> Float64Array:
    """The rotation from the stream's body into the reference's, as far as their mountings state it."""
    identity = np.eye(3)
    into_ego = identity if stream.ego_from_body is None else stream.ego_from_body
    from_ego = identity if reference.ego_from_body is None else reference.ego_from_body.T
    return np.asarray(from_ego @ into_ego, np.float64)


def _by_trajectory(
    reference: _ReportedMotion, stream: _ReportedMotion, *, reach_ns: int, lever_sigma: float
) -> ClockEstimate | None:
    """Compare fixes with a trajectory, where one has the one and the other the other."""
    for reported, estimated_trajectory, fixes_are_reference in (
        (stream, reference.trajectory, False),
        (reference, stream.trajectory, True),
    ):
        fixes = reported.fixes
        if fixes is not None and estimated_trajectory is not None and len(fixes):
            origin_ns = int(fixes.timestamps_ns[0])
            return compare_trajectories(
                fixes,
                estimated_trajectory(origin_ns),
                origin_ns=origin_ns,
                fixes_are_reference=fixes_are_reference,
                reach_ns=reach_ns,
                lever=reported.location,
                lever_sigma=lever_sigma
                if reported.location is None
                else min(lever_sigma, _KNOWN_LEVER_SIGMA),
            )
    return None


def gyroscope_against_trajectory(
    gyroscope: VectorSamples, trajectory: Trajectory, *, reach_ns: int = REACH_NS
) -> ClockEstimate:
    """Find how the timestamps of a trajectory lie against those of the gyroscope that rides along.

    Args:
        gyroscope: yaw rates (N, 3) [rad/s] in the ego's frame; rows that are no numbers are left out.
        trajectory: `world_from_ego`.
        reach_ns: offsets up to this are looked for [ns].

    Returns:
        The trajectory's clock against the gyroscope's. A minute of 100 Hz takes a few tenths of a second.
    """
    if trajectory.quaternions_xyzw is None:
        return ClockEstimate.unknown(f"trajectory {trajectory.name!r} has no orientations")
    rates = Rotating.of_rates(gyroscope.timestamps_ns, gyroscope.values[:, :3])
    estimated_trajectory = Rotating.of_poses(trajectory.timestamps_ns, trajectory.quaternions_xyzw)
    return compare_turnings(rates, estimated_trajectory, reach_ns=reach_ns)
