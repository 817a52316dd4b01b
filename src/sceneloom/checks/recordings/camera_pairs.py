"""Cameras of a recording that look the same way side by side: what makes a stereo pair."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.checks.subject import Subject
from sceneloom.geometry.rigid import RigidTransform

ALIKE_DEG = 15.0
"""Cameras whose axes differ by no more are a pair [deg]."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraPair:
    """Two cameras that look the same way.

    Attributes:
        first, second: their `cameraInd`.
        first_from_second: takes points of the second camera into the first.
    """

    first: int
    second: int
    first_from_second: RigidTransform

    @property
    def baseline(self) -> Float64Array:
        """Where the second camera is, seen from the first, (3,) [m]: x right, y down, z forward."""
        return self.first_from_second.translation


def stereo_pairs(subject: Subject) -> Sequence[CameraPair]:
    """All pairs by their mountings in the calibration."""
    return subject.table("stereo pairs", _pairs)


def _pairs(subject: Subject) -> list[CameraPair]:
    if subject.recording is None:
        return []
    cameras = subject.recording.calibration.cameras
    mounted = [
        (index, c.camera_from_imu) for index, c in sorted(cameras.items()) if c.camera_from_imu is not None
    ]
    found = []
    for (first, a), (second, b) in combinations(mounted, 2):
        pair = CameraPair(first, second, a @ b.inverse())
        rotated = np.degrees(
            np.arccos(np.clip((np.trace(pair.first_from_second.rotation) - 1) / 2, -1.0, 1.0))
        )
        if rotated <= ALIKE_DEG:
            found.append(pair)
    return found
