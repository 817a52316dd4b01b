"""Which frames of a drive show nearly the same, so that they do not report a calibration independently."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.calibrate.frames import CalibrationFrame

_TRAJECTORY, _ROTATION = 2.0, np.radians(6.0)
"""Beyond this trajectory [m] or rotation a view counts as another one."""


def views_of(frames: Sequence[CalibrationFrame]) -> Int64Array:
    """Number the views of frames in the order of their time, (F,) int64; unknown motion is none."""
    numbers, trajectory, rotation = [0], 0.0, 0.0
    for before, after in pairwise(frames):
        if before.twist_lidar is not None:
            seconds = abs(after.image_ns - before.image_ns) * 1e-9
            trajectory += float(np.linalg.norm(before.twist_lidar[3:])) * seconds
            rotation += float(np.linalg.norm(before.twist_lidar[:3])) * seconds
        new = trajectory > _TRAJECTORY or rotation > _ROTATION
        numbers.append(numbers[-1] + int(new))
        trajectory, rotation = (0.0, 0.0) if new else (trajectory, rotation)
    return np.array(numbers[: len(frames)], np.int64)
