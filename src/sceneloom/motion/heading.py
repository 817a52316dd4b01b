"""Orientation from motion: a vehicle looks where it goes."""

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import PoseError
from sceneloom.scene.poses import Poses, Trajectory

LEAST_TRAJECTORY = 0.5
"""The trajectory [m] over which a direction is measured: well above the noise of a smoothed position."""


def headed_poses(trajectory: Trajectory) -> Poses:
    """Give each position the yaw and pitch of the way around it, without roll.

    The direction at a position is the chord from the last position at least `LEAST_TRAJECTORY` behind to the first at
    least `LEAST_TRAJECTORY` ahead along the trajectory; while the ego stands, it keeps the direction that it came with.

    Raises:
        PoseError: the ego never moves `LEAST_TRAJECTORY`.
    """
    positions = trajectory.positions
    estimated_trajectory = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))]
    )
    if len(estimated_trajectory) == 0 or estimated_trajectory[-1] < LEAST_TRAJECTORY:
        raise PoseError(
            f"trajectory {trajectory.name!r} moves "
            f"{estimated_trajectory[-1] if len(estimated_trajectory) else 0.0:.2f} m in all; "
            f"a heading needs at least {LEAST_TRAJECTORY} m; choose another with `--trajectory NAME`"
        )
    behind = np.maximum(
        np.searchsorted(estimated_trajectory, estimated_trajectory - LEAST_TRAJECTORY, side="right") - 1, 0
    )
    ahead = np.minimum(
        np.searchsorted(estimated_trajectory, estimated_trajectory + LEAST_TRAJECTORY, side="left"),
        len(estimated_trajectory) - 1,
    )
    return Poses(
        trajectory.timestamps_ns, positions, _quaternions_along(positions[ahead] - positions[behind])
    )


def _quaternions_along(directions: Float64Array) -> Float64Array:
    """(N, 4) xyzw: x axis along (N, 3) directions, y axis level."""
    half_yaw = 0.5 * np.unwrap(np.arctan2(directions[:, 1], directions[:, 0]))
    half_pitch = -0.5 * np.arctan2(directions[:, 2], np.hypot(directions[:, 0], directions[:, 1]))
    sin_y, cos_y, sin_p, cos_p = np.sin(half_yaw), np.cos(half_yaw), np.sin(half_pitch), np.cos(half_pitch)
    return np.stack([-sin_y * sin_p, cos_y * sin_p, sin_y * cos_p, cos_y * cos_p], axis=1)
