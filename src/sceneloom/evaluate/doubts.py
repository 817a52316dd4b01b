"""What is to be known about the figures of an evaluation."""

from collections.abc import Mapping

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.evaluate.alignment import Alignment
from sceneloom.evaluate.association import Pairs, Poses
from sceneloom.geometry.rotations import (
    angle_between,
    conjugate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
    nearest_rotation,
    quaternion_from_matrix,
)
from sceneloom.scene.notices import Notice, NoticeKind
from sceneloom.scene.poses import Trajectory

_TURNED_DEG = 5.0
_STEADY = 0.25
"""A mean turn of the device's axes beyond so many degrees, from which single ones stray by less than this share of it,
is taken for another choice of axes."""


def doubts_of(alignment: Alignment, pairs: Pairs, aligned: Poses) -> list[Notice]:
    """What the shape of the way, missing orientations or other axes of the device do to the numbers."""
    found = [_notice("doubtful-alignment", doubt) for doubt in alignment.doubts]
    ours, theirs = aligned.quaternions_xyzw, pairs.reference.quaternions_xyzw
    if ours is None or theirs is None:
        side = "estimate" if ours is None else "reference"
        message = (
            f"the {side} has no orientations: motions are compared in the aligned world, turns not at all"
        )
        return [*found, _notice("no-orientations", message)]
    turn, strays_deg = _turn_of_axes(ours, theirs)
    # a way that hardly tells the alignment's turn tells nothing about that of the axes, either
    if not found and turn > _TURNED_DEG and strays_deg < _STEADY * turn:
        message = (
            f"the device's axes differ by a steady turn of {turn:.1f}° (single poses stray by {strays_deg:.2g}°): if "
            "one side tells a camera's poses, say `--est-optical` or `--ref-optical`"
        )
        found.append(_notice("other-axes", message))
    return found


def _turn_of_axes(ours: Float64Array, theirs: Float64Array) -> tuple[float, float]:
    """The mean turn between the axes of both devices, and the mean angle by which single ones stray from it [deg]."""
    turns = multiply_quaternions(conjugate_quaternion(ours), theirs)
    mean, _ = nearest_rotation(matrix_from_quaternion(turns).mean(axis=0))
    axes = quaternion_from_matrix(mean)
    angle = angle_between(axes, np.array([0.0, 0.0, 0.0, 1.0]))
    return float(np.degrees(angle)), float(np.degrees(angle_between(turns, axes).mean()))


def same_poses(estimate: Trajectory, reference: Trajectory) -> list[Notice]:
    """Say that both are one trajectory, be it by one file or by a copy: its errors say nothing."""
    pairs = [
        (getattr(estimate, name), getattr(reference, name))
        for name in ("timestamps_ns", "positions", "quaternions_xyzw")
    ]
    if not all(a is b or (a is not None and b is not None and np.array_equal(a, b)) for a, b in pairs):
        return []
    return [_notice("same-poses", "estimate and reference are the same poses at the same times")]


def unmeasured(relative: Mapping[str, object]) -> list[Notice]:
    """The steps for which the way is too short."""
    missing = [delta for delta, errors in relative.items() if errors is None]
    if not missing:
        return []
    return [_notice("no-steps", f"the way is too short for steps of {', '.join(missing)}")]


def _notice(code: str, message: str) -> Notice:
    return Notice(kind=NoticeKind.ASSUMED, code=code, place="", message=message)
