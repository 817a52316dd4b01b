"""Where a sensor sits on the vehicle, as one transform: what it says itself, or what its poses report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import degrees
from typing import Any, cast

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.errors import CalibrationError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.loss import Loss, Support
from sceneloom.formats.recording.json_faults import DECODER_FAULTS
from sceneloom.formats.recording.mounts import rigid_transform
from sceneloom.formats.recording.written_shots import field_of
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import (
    angle_between,
    conjugate_quaternion,
    multiply_quaternions,
    rotate_vectors,
)
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.shooting import ShootingSensor, mounts_of_shots, shots_of, with_shots
from sceneloom.scene.types import Coordinates

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
        return (sensor.mount or known[0]), (
            [] if each else _one_for_all(sensor, sensor.mount or known[0], known)
        )
    relative, outside = _ego_from_sensor(sensor, ego_path)
    field, losses = f"sensors[{sensor.id}].poses", list[Loss]()
    if outside:
        what = "left out: they lie beyond the ego trajectory, by which recordings location sensors"
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
    """Reads images and gives them their mountings; what `LazyFrames` asks for.

    Attributes:
        shots: as they were.
        ego_from_sensor: over time, its end poses held beyond its ends.
    """

    shots: LazyFrames[Any]
    ego_from_sensor: Poses

    def __call__(self, k: int) -> Any:
        shot = self.shots[k]
        at = self.ego_from_sensor.held(np.array([shot.timestamp_ns], np.int64))
        return replace(shot, mount=RigidTransform.from_quaternion(at.positions[0], at.quaternions_xyzw[0]))


def _moved(
    mount: RigidTransform, positions: Float64Array, quaternions_xyzw: Float64Array
) -> tuple[float, float]:
    """How far poses on the ego are from a mounting, at most [m, deg]."""
    moved = float(np.linalg.norm(positions - mount.translation, axis=1).max())
    return moved, degrees(float(angle_between(quaternions_xyzw, mount.quaternion_xyzw).max()))


def _one_for_all(sensor: Any, mount: RigidTransform, own: Sequence[RigidTransform]) -> list[Loss]:
    """What is lost where one mounting stands for those of all images.

    Raises:
        CalibrationError: they are too far apart.
    """
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
    field = f"{field_of(sensor)}[].mount"
    return [Loss(field=field, what=what, count=len(own), support=Support.APPROXIMATED)]


def _ego_from_sensor(
    sensor: ShootingSensor | LidarSensor, ego_path: Poses | None
) -> tuple[Poses | None, int]:
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


def matrix_entry(transform: RigidTransform) -> list[list[float]]:
    """A transform as four rows of four numbers."""
    rows: list[list[float]] = transform.matrix.tolist()
    return rows


def mount_entry(mount: RigidTransform, before: Mapping[str, Any], *keys: str) -> list[list[float]]:
    """Write a mounting: with the numbers of the entry that it was read from, where they still mean it.

    Args:
        mount: `ego_from_sensor`.
        before: the entry.
        keys: under which of its keys the matrix may stand.
    """
    for numbers in (before[key] for key in keys if key in before):
        if _is_square(numbers) and _means(numbers, mount):
            return [list(map(float, row)) for row in numbers]
    return matrix_entry(mount.inverse())


def _is_square(numbers: object) -> bool:
    return (
        isinstance(numbers, list)
        and len(numbers) == len(np.eye(4))
        and all(isinstance(row, list) and len(row) == len(numbers) for row in numbers)
    )


def _means(numbers: Any, mount: RigidTransform) -> bool:
    try:
        read = rigid_transform(numbers, "", Ledger(lenient=True)).inverse()
    except (CalibrationError, *DECODER_FAULTS, TypeError, ValueError):
        return False
    return np.array_equal(read.matrix, mount.matrix)
