"""What is to be known about the figures of an evaluation."""

from collections.abc import Mapping

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.evaluate.alignment import Alignment
from sceneloom.evaluate.association import MatchedPoses, Pairs
from sceneloom.geometry.rotations import (
    angle_between,
    conjugate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
    nearest_rotation,
    quaternion_from_matrix,
)
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.warnings import DataWarning, WarningKind

_ROTATED_DEG = 5.0
_STEADY = 0.25
"""A mean rotation of the device's axes beyond so many degrees.

From which single ones stray by less than this share of it,
is taken for another choice of axes."""


def doubts_of(alignment: Alignment, pairs: Pairs, aligned: MatchedPoses) -> list[DataWarning]:
    """What the shape of the trajectory, missing orientations or other axes of the device do to the numbers."""
    found = [_warning("doubtful-alignment", doubt) for doubt in alignment.doubts]
    ours, theirs = aligned.quaternions_xyzw, pairs.reference.quaternions_xyzw
    if ours is None or theirs is None:
        side = "estimate" if ours is None else "reference"
        message = (
            f"the {side} has no orientations: motions are compared in the aligned world, rotates not at all"
        )
        return [*found, _warning("no-orientations", message)]
    rotation, strays_deg = _rotation_of_axes(ours, theirs)
    # a trajectory that hardly reports the alignment's rotation states nothing about that of the axes, either
    if not found and rotation > _ROTATED_DEG and strays_deg < _STEADY * rotation:
        message = (
            f"the device's axes differ by a steady rotation of {rotation:.1f}° (single poses stray by "
            f"{strays_deg:.2g}°): if "
            "one side reports a camera's poses, state `--est-optical` or `--ref-optical`"
        )
        found.append(_warning("other-axes", message))
    return found


def _rotation_of_axes(ours: Float64Array, theirs: Float64Array) -> tuple[float, float]:
    """The mean rotation between the axes of both devices.

    And the mean angle by which single ones stray from it [deg].
    """
    rotations = multiply_quaternions(conjugate_quaternion(ours), theirs)
    mean, _ = nearest_rotation(matrix_from_quaternion(rotations).mean(axis=0))
    axes = quaternion_from_matrix(mean)
    angle = angle_between(axes, np.array([0.0, 0.0, 0.0, 1.0]))
    return float(np.degrees(angle)), float(np.degrees(angle_between(rotations, axes).mean()))


def same_poses(estimate: Trajectory, reference: Trajectory) -> list[DataWarning]:
    """Report that both are one trajectory, be it by one file or by a copy: its errors state nothing."""
    pairs = [
        (getattr(estimate, name), getattr(reference, name))
        for name in ("timestamps_ns", "positions", "quaternions_xyzw")
    ]
    if not all(a is b or (a is not None and b is not None and np.array_equal(a, b)) for a, b in pairs):
        return []
    return [_warning("same-poses", "estimate and reference are the same poses at the same times")]


def unmeasured(relative: Mapping[str, object]) -> list[DataWarning]:
    """The steps for which the trajectory is too short."""
    missing = [delta for delta, errors in relative.items() if errors is None]
    if not missing:
        return []
    return [_warning("no-steps", f"the trajectory is too short for steps of {', '.join(missing)}")]


def _warning(code: str, message: str) -> DataWarning:
    return DataWarning(kind=WarningKind.ASSUMED, code=code, location="", message=message)
