"""Headings that are turned by half a circle, repaired by the motion of the object."""

from sceneloom.arrays import Float64Array
from sceneloom.kernels.turned_headings import turn_backward

FASTEST_BACKWARDS = 3.0
"""What moves faster than this moves forward [m/s]: cars leave parking places at 1 to 2 m/s."""
_AGAINST = -0.5
"""Cosine between heading and motion from which on one of them is wrong."""


def turn_with_motion(yaws: Float64Array, velocities: Float64Array | None) -> Float64Array:
    """Turn the headings of objects around that would move backwards too fast.

    Detectors of sweeps know the axis of a box better than its front: 2 % of PointRCNN's cars on KITTI are turned.

    Args:
        yaws: (N,) [rad].
        velocities: (N, 3) [m/s] over ground, in the frame of the headings, or None.
    """
    if velocities is None or not len(yaws):
        return yaws
    turned: Float64Array = turn_backward(yaws, velocities, FASTEST_BACKWARDS, _AGAINST)
    return turned
