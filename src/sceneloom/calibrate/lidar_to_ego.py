"""How a lidar is mounted on the ego, from its own odometry and a trajectory that other sensors reported."""

from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.calibrate.frames import chosen_lidar
from sceneloom.calibrate.hand_eye import HandEye, align_motions, paired_motions
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.clock.estimate import ClockEstimate, ClockVerdict
from sceneloom.motion.clock.rotating import Rotating
from sceneloom.motion.clock.rotating_clock import compare_turnings
from sceneloom.motion.ego_motion import find_ego_motion
from sceneloom.motion.gnss_receivers import gnss_receivers
from sceneloom.motion.odometry.run import lidar_odometry
from sceneloom.motion.trajectories import LIDAR
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, PointsFrame, Progress

_GREATEST_OFFSET_NS = 1_000_000_000
"""Clocks of one drive are not farther apart than this [ns]."""


@dataclass(frozen=True, slots=True, eq=False)
class LidarToEgo:
    """What was found of a lidar's mounting.

    Attributes:
        lidar_id: whose.
        trajectory: name of the ego trajectory that the lidar's was compared with.
        stated: `ego_from_lidar` as the scene has it, or None.
        found: what the motions report; `found.mounting.a_from_b` is `ego_from_lidar`.
        clock: the lidar's clock against the trajectory's.
    """

    lidar_id: Identifier
    trajectory: str
    stated: RigidTransform | None
    found: HandEye
    clock: ClockEstimate


def lidar_to_ego(
    scene: Scene,
    lidar_id: Identifier | None = None,
    *,
    trajectory: str | None = None,
    progress: Progress | None = None,
) -> LidarToEgo:
    """Find `ego_from_lidar` by hand-eye alignment of the lidar's odometry and a trajectory of the ego.

    The mounting that the scene states is where the search starts, and what is kept where the drive does not report.

    Args:
        lidar_id: the lidar; None for the first one with sweeps.
        trajectory: name of the ego trajectory, None for the scene's default.
        progress: reported after each sweep.

    Raises:
        OptionError: there is no such lidar, or the trajectory is the lidar's own.
        PoseError: there is no trajectory, or both ways have too little motion or time in common.
        DataError: a sweep cannot be read.
    """
    lidar = chosen_lidar(scene, lidar_id)
    if trajectory == LIDAR and LIDAR not in scene.trajectories:
        raise OptionError(
            "trajectory 'lidar' is found from the lidar itself; expected one that other sensors reported"
        )
    if lidar.points_frame is not PointsFrame.SENSOR:
        raise PoseError(
            f"{scene.source}: points of lidar {lidar.id!r} are in the {lidar.points_frame} frame already; "
            "expected its own: its mounting cannot be found from them"
        )
    if not scene.trajectories and not gnss_receivers(scene):
        raise PoseError(
            f"{scene.source}: no trajectory and no satellite fixes in it; expected a ego trajectory that others "
            "than the lidar reported, to compare the lidar's own with"
        )
    ego = find_ego_motion(_without_lidars(scene), name=trajectory)
    sensor = _lidar_trajectory(scene, lidar, progress)
    clock = _compared_clocks(ego.path, sensor, lidar.mount)
    shifted = replace(sensor, timestamps_ns=sensor.timestamps_ns - _offset_ns(clock))
    found = align_motions(paired_motions(ego.path, shifted, _middles(shifted)), guess=lidar.mount)
    return LidarToEgo(lidar.id, ego.name, lidar.mount, found, clock)


def _without_lidars(scene: Scene) -> Scene:
    """A trajectory that lidars took part in would report the stated mounting back."""
    return replace(
        scene, sensors=tuple(sensor for sensor in scene.sensors if not isinstance(sensor, LidarSensor))
    )


def _lidar_trajectory(scene: Scene, lidar: LidarSensor, progress: Progress | None) -> Poses:
    """The lidar's own trajectory, `start_from_lidar`; its stated mounting only reports odometry which way it looks."""
    run = lidar_odometry(replace(scene, sensors=(lidar,)), progress=progress)
    path = run.trajectory.poses
    if lidar.mount is None:
        return path
    seen = PoseSource(path, lidar.mount).at(path.timestamps_ns)
    return Poses(path.timestamps_ns, seen.positions, seen.quaternions_xyzw)


def _middles(path: Poses) -> Int64Array:
    """Of the knots of odometry every second is the middle of a sweep; those between are means of two of them."""
    return path.timestamps_ns[1::2]


def _compared_clocks(ego: Poses, sensor: Poses, mount: RigidTransform | None) -> ClockEstimate:
    reference = Rotating.of_poses(ego.timestamps_ns, ego.quaternions_xyzw)
    middles = sensor.interpolate(_middles(sensor))
    stream = Rotating.of_poses(_middles(sensor), middles.quaternions_xyzw)
    rotation = None if mount is None else np.asarray(mount.rotation)
    return compare_turnings(reference, stream, reach_ns=_GREATEST_OFFSET_NS, reference_from_stream=rotation)


def _offset_ns(clock: ClockEstimate) -> int:
    if clock.verdict is not ClockVerdict.OFF or clock.offset_ns is None:
        return 0
    return round(clock.offset_ns)
