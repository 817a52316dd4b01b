"""Lidar odometry as measurements between the smoother's states."""

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.motion.gnss_imu.carried_fixes import Fixes
from sceneloom.motion.gnss_imu.chain import RelativePoses
from sceneloom.scene.poses import Trajectory

_LEAST_ROTATION, _LEAST_TRAJECTORY = 3e-4, 5e-3
"""No step is believed to be better [rad] and [m]: what a fit onto the map repeats to."""
_ROUNDS = 8
"""Rounds of weighting the fixes by how they agree (L1)."""


def lidar_steps(lidar: Trajectory, knots_ns: Int64Array) -> RelativePoses:
    """Give the steps from each state to the next within the odometry's trajectory, with what they add to its errors."""
    found = lidar.poses.interpolate(knots_ns)
    inside = found.coverage == 0
    locations = np.flatnonzero(inside[:-1] & inside[1:])
    rotations = np.full((len(knots_ns), 3, 3), np.nan)
    rotations[inside] = matrix_from_quaternion(found.quaternions_xyzw[inside])
    before, after = rotations[locations], rotations[locations + 1]
    steps = found.positions[locations + 1] - found.positions[locations]
    delta_rotations = np.swapaxes(before, 1, 2) @ after
    trajectories = np.einsum("nji,nj->ni", before, steps)
    added = _added(lidar, knots_ns, locations, steps)
    covariances = np.zeros((len(locations), 6, 6))
    covariances[:, :3, :3] = np.swapaxes(after, 1, 2) @ added[:, :3, :3] @ after
    covariances[:, 3:, 3:] = np.swapaxes(before, 1, 2) @ added[:, 3:, 3:] @ before
    covariances += np.diag(np.repeat([_LEAST_ROTATION**2, _LEAST_TRAJECTORY**2], 3))
    return RelativePoses(
        locations, delta_rotations, trajectories, np.asarray(np.linalg.inv(covariances), np.float64)
    )


def _added(
    lidar: Trajectory, knots_ns: Int64Array, locations: Int64Array, steps: Float64Array
) -> Float64Array:
    """What the odometry's covariance grows by in each step beyond what the error before it makes of it, (F, 6, 6)."""
    if lidar.covariances is None:
        return np.zeros((len(locations), 6, 6))
    rows = np.clip(np.searchsorted(lidar.timestamps_ns, knots_ns), 0, len(lidar.timestamps_ns) - 1)
    known = lidar.covariances[rows]
    levers = np.tile(np.eye(6), (len(locations), 1, 1))
    x, y, z = steps.T
    nothing = np.zeros(len(locations))
    levers[:, 3:, :3] = np.stack([nothing, z, -y, -z, nothing, x, y, -x, nothing], axis=1).reshape(-1, 3, 3)
    grown = known[locations + 1] - levers @ known[locations] @ np.swapaxes(levers, 1, 2)
    values, axes = np.linalg.eigh(0.5 * (grown + np.swapaxes(grown, 1, 2)))
    positive: Float64Array = (axes * np.maximum(values, 0.0)[:, None, :]) @ np.swapaxes(axes, 1, 2)
    return positive


def led_by_lidar(lidar: Trajectory, knots_ns: Int64Array, fixes: Fixes) -> Float64Array:
    """Give orientations of the states, (K, 3, 3): the odometry's, its world rotated about up onto the fixes."""
    known = lidar.poses.held(knots_ns)
    here, there = known.positions[fixes.locations, :2], fixes.positions[:, :2]
    weights = np.ones(len(fixes))
    angle = 0.0
    for _ in range(_ROUNDS):
        share = weights / weights.sum()
        one, other = here - share @ here, there - share @ there
        dot = (share[:, None] * one * other).sum()
        cross = (share * (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])).sum()
        angle = float(np.arctan2(cross, dot))
        cosine, sine = np.cos(angle), np.sin(angle)
        apart = np.hypot(*(one @ np.array([[cosine, sine], [-sine, cosine]]) - other).T)
        weights = 1.0 / np.maximum(apart, 0.1)
    delta_rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    rotations: Float64Array = delta_rotation @ matrix_from_quaternion(known.quaternions_xyzw)
    return rotations
