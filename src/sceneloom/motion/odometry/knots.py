"""From one pose and motion per sweep to a path that linear interpolation may be used on."""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions, quaternion_from_matrix, slerp
from sceneloom.motion.odometry.lidar_odometry import PoseEstimate
from sceneloom.scene.poses import Trajectory


def trajectory_of(name: str, estimates: list[PoseEstimate]) -> Trajectory:
    """Lay a path through the sweeps' poses, from the first point to the last, that begins with the identity.

    There is a knot in the middle of every sweep, and one between two sweeps half-way in time, where both motions
    meet. Where the sweeps are far apart in time, each motion ends with its own points.

    Args:
        estimates: at least one, in the order of their time.
    """
    knots: list[tuple[int, Float64Array, Float64Array, int]] = []
    for k, estimate in enumerate(estimates):
        before = estimates[k - 1] if k else None
        if before is None:
            knots.append(_own(estimate, estimate.first_ns, k))
        else:
            knots += _between(before, estimate, k)
        knots.append(_own(estimate, estimate.state.timestamp_ns, k))
    knots.append(_own(estimates[-1], estimates[-1].last_ns, len(estimates) - 1))
    return _from_first_pose(name, knots, estimates)


def _own(estimate: PoseEstimate, timestamp_ns: int, k: int) -> tuple[int, Float64Array, Float64Array, int]:
    rotation, position = estimate.state.at(timestamp_ns)
    return timestamp_ns, position, quaternion_from_matrix(rotation), k


def _between(
    before: PoseEstimate, after: PoseEstimate, k: int
) -> list[tuple[int, Float64Array, Float64Array, int]]:
    """The knots between the middles of two sweeps."""
    middles_ns = before.state.timestamp_ns, after.state.timestamp_ns
    longest_ns = 2 * max(before.last_ns - before.first_ns, after.last_ns - after.first_ns)
    if 0 < longest_ns < middles_ns[1] - middles_ns[0]:
        return [_own(before, before.last_ns, k - 1), _own(after, after.first_ns, k)]
    halfway_ns = sum(middles_ns) // 2
    _, first_position, first_rotation, _ = _own(before, halfway_ns, k - 1)
    _, second_position, second_rotation, _ = _own(after, halfway_ns, k)
    return [
        (
            halfway_ns,
            0.5 * (first_position + second_position),
            slerp(first_rotation, second_rotation, 0.5),
            k - 1,
        )
    ]


def _from_first_pose(
    name: str, knots: list[tuple[int, Float64Array, Float64Array, int]], estimates: list[PoseEstimate]
) -> Trajectory:
    """Move the world's origin and axes to the first knot's pose."""
    times = np.array([knot[0] for knot in knots], np.int64)
    kept = np.concatenate([[0], 1 + np.flatnonzero(_rises(times))])
    positions = np.array([knots[k][1] for k in kept])
    quaternions = np.array([knots[k][2] for k in kept])
    origin = RigidTransform.from_quaternion(positions[0], quaternions[0]).inverse()
    axes = np.kron(np.eye(2), origin.rotation)
    covariances = np.array([axes @ estimates[knots[k][3]].covariance @ axes.T for k in kept])
    return Trajectory(
        name,
        times[kept],
        origin.apply(positions),
        multiply_quaternions(origin.quaternion_xyzw, quaternions),
        covariances=covariances,
    )


def _rises(times: Int64Array) -> BoolArray:
    """Which times are later than every one before, but for the first: overlapping sweeps may put a knot too early."""
    return times[1:] > np.maximum.accumulate(times)[:-1]
