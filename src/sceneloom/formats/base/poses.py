"""Poses as files have them: quaternion lengths, poses and mountings of sensors, and the ego trajectory of writers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import degrees
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import CalibrationError, PoseError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.losses import Loss, Support
from sceneloom.geometry.rigid import (
    RigidTransform,
    angle_between,
    conjugate_quaternion,
    multiply_quaternions,
    rotate_vectors,
)
from sceneloom.motion.ego_trajectory import (
    GNSS,
    IDENTITY,
    LIDAR,
    check_odometry,
    computed_name,
    find_ego_motion,
    gnss_receivers,
    is_computed,
    placeable_lidars,
)
from sceneloom.scene.cameras import (
    CameraSensor,
    DepthCameraSensor,
    ShootingSensor,
    mounts_of_shots,
    shots_of,
    with_shots,
)
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates
from sceneloom.warnings import WarningKind

GREATEST_NORM_ERROR = 0.01
"""The length of a quaternion may be off 1 by this much: files round them to a few digits."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseRows:
    """Poses of a body in a world, one per line of a file.

    Attributes:
        timestamps_ns: (N,) int64 [ns], in the order of the file.
        positions: (N, 3) float64 [m].
        quaternions_xyzw: (N, 4) float64, of any length, or None.
        lines: number of each pose's line.
    """

    timestamps_ns: Int64Array
    positions: Float64Array
    quaternions_xyzw: Float64Array | None
    lines: Sequence[int] = field(default_factory=tuple)


def lengths_of(quaternions: Float64Array) -> tuple[Float64Array, BoolArray]:
    """Lengths (N,) of quaternions (N, 4) in any order, and which of them are off 1 by too much."""
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(quaternions, axis=1)
    return lengths, ~(np.abs(lengths - 1.0) <= GREATEST_NORM_ERROR)


def default_poses(trajectories: Mapping[Any, Trajectory], location: str, ledger: Ledger) -> Poses | None:
    """Give `world_from_ego` of the first trajectory; None, with a warning at `location`, where it has no orientations.

    None as well where there is no trajectory.
    """
    default = next(iter(trajectories.values()), None)
    if default is None:
        return None
    if default.quaternions_xyzw is None:
        message = f"trajectory {default.name!r} holds positions without orientations, so the sensors have no poses"
        ledger.note(WarningKind.SKIPPED, "orientations-missing", location, message)
        return None
    return default.poses


_COMPUTED = MappingProxyType(
    {
        GNSS: "not known: computed from the GNSS fixes, with IMU and lidar as far as there are",
        LIDAR: "not known: computed by lidar odometry",
    }
)
"""What is reported of a trajectory that is computed, by its name."""


def ego_in_world(scene: Scene, *, name: str | None = None) -> tuple[EgoMotion, list[Loss]]:
    """Give the ego's trajectory to a target that needs it; what is computed or assumed is reported.

    By default the scene's first trajectory that has orientations; without one "gnss" is computed, else "lidar"; where
    neither can be, the ego is taken to stand. What reads the sweeps reports its progress as they are read.

    Args:
        scene: what is written.
        name: of a trajectory of the scene, "gnss", "lidar", or "identity" for an ego that stands; None: the default.

    Returns:
        ego: the trajectory.
        losses: that it was computed or assumed; empty where it is the scene's own.

    Raises:
        OptionError: there is no trajectory of that name.
        PoseError: the named one has no orientations or cannot be computed; or poses lead to an ego of which the scene
            does not state where it was.
        DataError: a sweep cannot be read.
    """
    if name is not None:
        ego = find_ego_motion(scene, name=name)
        if ego.name == IDENTITY and name not in scene.trajectories:
            return ego, [STATIONARY_EGO]
        return ego, [_computed(computed_name(scene, name) or name)] if is_computed(scene, name) else []
    for trajectory in scene.trajectories.values():
        if trajectory.quaternions_xyzw is not None:
            return EgoMotion.of(trajectory), []
    check_odometry(scene)
    faults: list[str] = []
    names = [(GNSS, gnss_receivers(scene)), (LIDAR, placeable_lidars(scene))]
    for computed in (computed for computed, sources in names if sources):
        try:
            ego = find_ego_motion(scene, name=computed)
        except PoseError as error:
            faults.append(str(error).removeprefix(f"{scene.source}: "))
            continue
        if any(warning.code == "odometry-without-motion" for warning in ego.warnings):
            faults.append("no two sweeps could be compared")
            continue
        return ego, [_computed(computed)]
    return find_ego_motion(scene, name=IDENTITY), [_stationary_ego(*faults)]


def _computed(name: str) -> Loss:
    return Loss(field="trajectories.positions", what=_COMPUTED[name], support=Support.APPROXIMATED)


def _stationary_ego(*faults: str) -> Loss:
    """That nothing is known of the trajectory, and why it could not be computed."""
    what = "; ".join(("not known: the ego is taken to stand at the world's origin", *faults))
    return Loss(field="trajectories.positions", what=what, support=Support.APPROXIMATED)


STATIONARY_EGO = _stationary_ego()
"""What every target that locations things in the world reports of a drive whose trajectory is not known."""


_RIGID_WITHIN_M, _RIGID_WITHIN_DEG = 0.001, 0.05
"""How far a sensor may move on the vehicle before it is reported that one mounting does not describe it."""

_EACH_BEYOND_M, _EACH_BEYOND_DEG = 0.01, 0.1
"""Beyond this, images get mountings of their own where the target holds them."""

_REFUSED_M, _REFUSED_DEG = 0.1, 1.0
"""Mountings of single images that are further apart than this are not replaced by one for all."""


def mounting(
    sensor: ShootingSensor | LidarSensor, ego_path: Poses | None, *, each: bool = False
) -> tuple[RigidTransform | None, list[Loss]]:
    """Find `ego_from_sensor`: what the sensor says, else where its poses put it against the ego.

    Args:
        sensor: a camera or lidar.
        ego_path: `world_from_ego`, or None.
        each: whether the target holds the mounting of each image, so that one for all need not state it.

    Returns:
        The mounting, None where neither reports it; and what one mounting cannot state.

    Raises:
        CalibrationError: images have mountings of their own, too far from one another for a target that holds one.
    """
    own = mounts_of_shots(sensor) if isinstance(sensor, CameraSensor | DepthCameraSensor) else None
    if own is not None:
        known = [mount for mount in own if mount is not None]
        return (sensor.mount or known[0]), ([] if each else _one_for_all(sensor, sensor.mount or known[0], known))
    relative, outside = _ego_from_sensor(sensor, ego_path)
    field, losses = f"sensors[{sensor.id}].poses", list[Loss]()
    if outside:
        what = "left out: they lie beyond the ego trajectory, by which sensors are placed"
        losses.append(Loss(field=field, what=what, count=outside))
    mount = sensor.mount
    if mount is None and relative is not None:
        mount = RigidTransform.from_quaternion(relative.positions[0], relative.quaternions_xyzw[0])
    if mount is None or relative is None:
        return mount, losses
    moved, rotated = _moved(mount, relative.positions, relative.quaternions_xyzw)
    if moved > _RIGID_WITHIN_M or rotated > _RIGID_WITHIN_DEG:
        held = "as its mounting says" if sensor.mount is not None else "as at its first pose"
        found = f"up to {round(moved, 3):g} m and {round(rotated, 3):g} degrees"
        what = f"taken to be mounted {held}, from which it moves {found} on the vehicle"
        losses.append(
            Loss(
                field=field,
                what=what,
                count=len(relative.timestamps_ns),
                support=Support.APPROXIMATED,
                largest_error=moved,
            )
        )
    return mount, losses


def each_mounted(scene: Scene, ego_path: Poses | None) -> Scene:
    """Give each image of a camera that moves on the ego a mounting of its own, where only its poses state that it does.

    Those of a camera that says how it is mounted, and images that have no pose of camera and ego, stay as they are.
    """
    changed = tuple(_each_mounted(sensor, ego_path) for sensor in scene.sensors)
    moved = any(new is not old for new, old in zip(changed, scene.sensors, strict=True))
    return replace(scene, sensors=changed) if moved else scene


def _each_mounted(sensor: Any, ego_path: Poses | None) -> Any:
    if not isinstance(sensor, CameraSensor | DepthCameraSensor) or sensor.mount is not None:
        return sensor
    relative, _ = _ego_from_sensor(sensor, ego_path)
    if relative is None or len(relative.timestamps_ns) < 2 or mounts_of_shots(sensor) is not None:
        return sensor
    first = RigidTransform.from_quaternion(relative.positions[0], relative.quaternions_xyzw[0])
    moved, rotated = _moved(first, relative.positions, relative.quaternions_xyzw)
    if moved <= _EACH_BEYOND_M and rotated <= _EACH_BEYOND_DEG:
        return sensor
    shots, either = shots_of(sensor), cast("Any", sensor)  # the two kinds of cameras alike
    mounted = LazyFrames(shots.timestamps_ns, _MountedShots(shots, relative))
    return with_shots(either, mounted, sensor.video)


@dataclass(frozen=True, slots=True, eq=False)
class _MountedShots:
    """Reads images and gives them their mountings; what `LazyFrames` asks for."""

    shots: LazyFrames[Any]
    ego_from_sensor: Poses  # over time, its end poses held beyond its ends

    def __call__(self, k: int) -> Any:
        shot = self.shots[k]
        at = self.ego_from_sensor.held(np.array([shot.timestamp_ns], np.int64))
        return replace(shot, mount=RigidTransform.from_quaternion(at.positions[0], at.quaternions_xyzw[0]))


def _moved(mount: RigidTransform, positions: Float64Array, quaternions_xyzw: Float64Array) -> tuple[float, float]:
    """How far poses on the ego are from a mounting, at most [m, deg]."""
    moved = float(np.linalg.norm(positions - mount.translation, axis=1).max())
    return moved, degrees(float(angle_between(quaternions_xyzw, mount.quaternion_xyzw).max()))


def _one_for_all(sensor: Any, mount: RigidTransform, own: Sequence[RigidTransform]) -> list[Loss]:
    """What is lost where one mounting stands for those of all images."""
    moved, rotated = _moved(
        mount, np.array([one.translation for one in own]), np.array([one.quaternion_xyzw for one in own])
    )
    found = f"{round(moved, 3):g} m and {round(rotated, 3):g} degrees"
    if moved > _REFUSED_M or rotated > _REFUSED_DEG:
        raise CalibrationError(
            f"camera {sensor.id!r}: its images have mountings of their own, up to {found} apart, and the target "
            "holds one for all of them; write to a format that holds each (sfs, recording, mcap, ros1, ros2, "
            "nuscenes, kitti-object), or leave the camera out"
        )
    what = f"one mounting stands for those of the images, which are up to {found} apart"
    frames = "images" if isinstance(sensor, CameraSensor) else "frames"
    return [
        Loss(field=f"sensors[{sensor.id}].{frames}[].mount", what=what, count=len(own), support=Support.APPROXIMATED)
    ]


def _ego_from_sensor(sensor: ShootingSensor | LidarSensor, ego_path: Poses | None) -> tuple[Poses | None, int]:
    """The poses of a sensor on the ego, None where they are not known; and how many have none of the ego."""
    poses = sensor.poses
    if poses is None or sensor.coordinates is Coordinates.EGO:
        return poses, 0
    if ego_path is None:
        return None, 0
    ego = ego_path.interpolate(poses.timestamps_ns)
    inside: BoolArray = ego.coverage == 0
    outside = int((~inside).sum())
    if not inside.any():
        return None, outside
    ego_from_world = conjugate_quaternion(ego.quaternions_xyzw[inside])
    positions = rotate_vectors(ego_from_world, poses.positions[inside] - ego.positions[inside])
    quaternions = multiply_quaternions(ego_from_world, poses.quaternions_xyzw[inside])
    return Poses(poses.timestamps_ns[inside], positions, quaternions), outside
