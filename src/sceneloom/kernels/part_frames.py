"""Frames that the bodies of movers move with, one for each pose of a sensor and each part of a mover."""

import math

from numba import njit, prange

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.raycast import INNER, Int32Array

_FAR = 1e7
"""Where rays are taken to in the frame of something that is not there [m]: no ray reaches back."""


@njit(**INNER)
def _swing_back(frame: Float64Array, angle: float, x: float, z: float) -> None:
    """Rotate a frame (3, 4) backwards about an axis along y through (x, z), as a part has swung forwards."""
    cosine, sine = math.cos(angle), math.sin(angle)
    for i in range(4):
        forward, upward = frame[0, i], frame[2, i]
        if i == 3:
            forward, upward = forward - x, upward - z
        frame[0, i] = cosine * forward + sine * upward
        frame[2, i] = cosine * upward - sine * forward
    frame[0, 3] += x
    frame[2, 3] += z


@kernel(
    "void(float64[:,:,::1], boolean[:,::1], int32[::1], float64[:,::1], float64[::1], float64[::1], "
    "float64[:,:,:,::1])",
    parallel=True,
    nogil=True,
    cache=True,
    error_model="numpy",
)
def put_parts(
    states: Float64Array, there: BoolArray, mover_of_part: Int32Array, hinges: Float64Array, swings: Float64Array,
    leads: Float64Array, frames: Float64Array,
) -> None:  # fmt: skip
    """Write `part_from_world` of every part at every time.

    Args:
        states: (M, K, 4) float64, x, y [m], yaw and gait [rad] of K movers at M times.
        there: (M, K) bool; the frames of what is not there lie out of reach of any ray.
        mover_of_part: (F,) int32, column of `states`.
        hinges: (F, 3) float64 [m]; swings, leads: (F,) float64 [rad]: a part swings forwards by its swing times the
            sine of gait and lead, about an axis along y through its hinge.
        frames: (M, F, 3, 4) float64, written.
    """
    for time in prange(len(states)):
        for part in range(len(mover_of_part)):
            mover, frame = mover_of_part[part], frames[time, part]
            x, y, yaw = states[time, mover, 0], states[time, mover, 1], states[time, mover, 2]
            cosine, sine = math.cos(yaw), math.sin(yaw)
            if not there[time, mover]:
                x, y, cosine, sine = -_FAR, -_FAR, 1.0, 0.0
            frame[0, 0], frame[0, 1], frame[0, 2], frame[0, 3] = cosine, sine, 0.0, -(cosine * x + sine * y)
            frame[1, 0], frame[1, 1], frame[1, 2], frame[1, 3] = -sine, cosine, 0.0, sine * x - cosine * y
            frame[2, 0], frame[2, 1], frame[2, 2], frame[2, 3] = 0.0, 0.0, 1.0, 0.0
            if swings[part] != 0.0 and there[time, mover]:
                angle = swings[part] * math.sin(states[time, mover, 3] + leads[part])
                _swing_back(frame, angle, hinges[part, 0], hinges[part, 2])
