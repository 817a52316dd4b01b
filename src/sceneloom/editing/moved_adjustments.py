"""Localization adjustments of a scene whose frame changes."""

from dataclasses import replace

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.editing.frame_change import FrameChange
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations.corrections import LocalizationAdjustment
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses


def led_from(new_from_old: FrameChange, adjustment: LocalizationAdjustment) -> LocalizationAdjustment | None:
    """Give the adjustment that leads from the new frame to where the given one leads from the old one.

    A'(t) = A(t) old_from_new(t). None where the two are known at no common time.
    """
    poses = adjustment.poses
    times = _common_times(poses, new_from_old.knots_ns)
    if len(times) == 0:
        path = new_from_old.inverse().path(Poses.identity())
        return None if path is None else replace(adjustment, poses=_after(poses, path))
    corrected_from_new = FrameChange(PoseSource(poses, RigidTransform.identity()), held=True)
    old_from_new = new_from_old.inverse().path(Poses.identity(), times_ns=times)
    if old_from_new is None:
        return None
    return replace(adjustment, poses=corrected_from_new.path(old_from_new) or poses)


def _common_times(poses: Poses, knots_ns: Int64Array) -> Int64Array:
    """The times at which either has a pose, where both are known."""
    if poses.static:
        return knots_ns
    inside = knots_ns[(knots_ns >= poses.start_ns) & (knots_ns <= poses.stop_ns)]
    return np.union1d(poses.timestamps_ns, inside)


def _after(outer: Poses, inner: Poses) -> Poses:
    """`outer ∘ inner` of two paths that are the same at all times."""
    path = FrameChange(PoseSource(outer, RigidTransform.identity())).path(inner)
    return outer if path is None else path


def seen_from(new_from_old: FrameChange, adjustment: LocalizationAdjustment) -> LocalizationAdjustment | None:
    """Give the adjustment of a world that is seen from another one, before and after it.

    A'(t) = new_from_old(t) A(t) old_from_new(t). None where the two are known at no common time.
    """
    led = led_from(new_from_old, adjustment)
    path = None if led is None else new_from_old.path(led.poses)
    return None if path is None else replace(adjustment, poses=path)
