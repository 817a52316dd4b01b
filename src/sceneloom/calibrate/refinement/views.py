"""Which frames of a drive show nearly the same, so that they do not tell of a calibration independently."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.calibrate.frames import CalibrationFrame

_WAY, _TURN = 2.0, np.radians(6.0)
"""Beyond this way [m] or turn a view counts as another one."""


def views_of(frames: Sequence[CalibrationFrame]) -> Int64Array:
    """Number the views of frames in the order of their time, (F,) int64; unknown motion is none."""
    numbers, way, turn = [0], 0.0, 0.0
    for before, after in pairwise(frames):
        if before.twist_lidar is not None:
            seconds = abs(after.picture_ns - before.picture_ns) * 1e-9
            way += float(np.linalg.norm(before.twist_lidar[3:])) * seconds
            turn += float(np.linalg.norm(before.twist_lidar[:3])) * seconds
        new = way > _WAY or turn > _TURN
        numbers.append(numbers[-1] + int(new))
        way, turn = (0.0, 0.0) if new else (way, turn)
    return np.array(numbers[: len(frames)], np.int64)
