"""Two ways along a curve whose drift is written in formulas, for everyone's arithmetic to agree on."""

import numpy as np
import pytest

from sceneloom.scene import Trajectory


def quaternions(yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """(N, 4) xyzw of rotates about z, then y, then x."""
    (cy, cp, cr), (sy, sp, sr) = ([f(a / 2) for a in (yaw, pitch, roll)] for f in (np.cos, np.sin))
    xy = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy
    return np.stack([*xy, cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy], axis=1)


@pytest.fixture
def curve() -> tuple[Trajectory, Trajectory]:
    """Estimate and reference: 60 poses at 10 Hz; the estimate drifts, is 0.9 times as large, rotated and shifted."""
    t = np.arange(60) * 0.1
    timestamps = np.arange(60, dtype=np.int64) * 100_000_000
    true = np.stack([5 * t, 4 * np.sin(0.7 * t), 0.3 * np.cos(1.1 * t)], axis=1)
    drift = np.stack([0.02 * t**1.5, 0.1 * np.sin(2 * t), 0.05 * t], axis=1)
    yaw, pitch, roll = 0.5 * np.cos(0.7 * t), 0.05 * np.sin(t), 0.03 * np.cos(2 * t)
    c, s = np.cos(0.4), np.sin(0.4)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    found = 0.9 * (true + drift) @ rotation.T + np.array([10.0, -20, 3])
    rotations = quaternions(yaw + 0.01 * t + 0.4, pitch + 0.01, roll - 0.02 * np.sin(t))
    reference = Trajectory("true", timestamps, true, quaternions(yaw, pitch, roll))
    return Trajectory("found", timestamps, found, rotations), reference
