"""Headings that are turned by half a circle, told by the motion of the objects."""

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.kernels.cache import kernel


@kernel(
    "float64[::1](Array(float64, 1, 'C', readonly=True), Array(float64, 2, 'C', readonly=True), float64, float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def turn_backward(
    yaws: Float64Array, velocities: Float64Array, fastest: float, against: float
) -> Float64Array:
    """Turn around the headings of those that move backwards too fast.

    Args:
        yaws: (N,) [rad].
        velocities: (N, 3) [m/s], in the frame of the headings.
        fastest: what moves no faster may move backwards [m/s].
        against: cosine between heading and motion below which one of them is wrong.

    Returns:
        (N,) float64 [rad], those that are turned within half a circle of 0.
    """
    turned = yaws.copy()
    for n in range(len(yaws)):
        speed = np.hypot(velocities[n, 0], velocities[n, 1])
        along = velocities[n, 0] * np.cos(yaws[n]) + velocities[n, 1] * np.sin(yaws[n])
        if speed > fastest and along < against * speed:
            turned[n] = (yaws[n] + 2.0 * np.pi) % (2.0 * np.pi) - np.pi
    return turned
