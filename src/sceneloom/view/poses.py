"""Poses as the viewer takes them."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import PoseSamples
from sceneloom.view.locations import poses_within_reach
from sceneloom.view.sdk import sdk


def transform(shown_from_sensor: RigidTransform) -> Any:
    """A pose as the transform of an entity."""
    rr = sdk()
    rotation = rr.Quaternion(xyzw=shown_from_sensor.quaternion_xyzw)
    return rr.Transform3D(translation=shown_from_sensor.translation, quaternion=rotation)


def transform_columns(poses: PoseSamples, rows: Int64Array) -> Iterable[Any]:
    """Poses as columns of transforms, (M,) rows of them."""
    columns: Iterable[Any] = sdk().Transform3D.columns(
        translation=poses.positions[rows], quaternion=poses.quaternions_xyzw[rows]
    )
    return columns


def pose_at(source: PoseSource, time_ns: int) -> RigidTransform | None:
    """Give the pose at a time [ns]; None where the trajectory does not reach it, or lies beyond float32."""
    poses, rows = poses_within_reach(source, np.array([time_ns], np.int64))
    if len(rows) == 0:
        return None
    return RigidTransform.from_quaternion(poses.positions[0], poses.quaternions_xyzw[0])
