"""Ways of parts become one way: rigid motions between them are found and taken away."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.errors import PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.odometry.lidar_odometry import Outcome, PoseEstimate
from sceneloom.motion.odometry.motion_state import MotionState
from sceneloom.motion.odometry.stitching import (
    OdometryPiece,
    joint_of,
    stitched_estimates,
    summed_notices,
)
from sceneloom.scene import Notice, NoticeKind

STEP_NS = 100_000_000


def estimate(k, world=None, noise=None):
    """The pose at step k of a bend, seen from another world, with noise."""
    world = world or RigidTransform.identity()
    turn = Rotation.from_rotvec([0.0, 0.0, 0.02 * k])
    position = np.array([1.0 * k, 0.01 * k * k, 0.1 * k])
    if noise is not None:
        turn = Rotation.from_rotvec(noise.normal(0.0, 1e-3, 3)) * turn
        position = position + noise.normal(0.0, 1e-2, 3)
    state = MotionState(
        k * STEP_NS, world.rotation @ turn.as_matrix(), world.apply(position[None])[0],
        world.rotation @ [0.0, 0.0, 0.2], world.rotation @ [10.0, 0.1 * k, 1.0], np.eye(12) * 1e-6,
    )  # fmt: skip
    return PoseEstimate(state, np.eye(6) * 1e-6, Outcome.FITTED, k * STEP_NS, (k + 1) * STEP_NS)


def piece(first, start, stop, world=None, noise=None):
    estimates = tuple(estimate(k, world, noise) for k in range(first, stop))
    return OdometryPiece(estimates, start - first, 0, stop - start)


def elsewhere(seed):
    return RigidTransform(
        Rotation.random(random_state=seed).as_matrix(), np.array([10.0, -20.0, 3.0]) * (seed + 1)
    )


def test_parts_in_any_worlds_of_their_own_give_the_way_of_the_whole():
    parts = [piece(0, 0, 40), piece(20, 40, 80, elsewhere(1)), piece(60, 80, 100, elsewhere(2))]
    found, notices = stitched_estimates(parts)
    assert [e.state.timestamp_ns for e in found] == [k * STEP_NS for k in range(100)]
    for k, one in enumerate(found):
        true = estimate(k).state
        for name in ("rotation", "position", "turn_rate", "velocity"):
            np.testing.assert_allclose(getattr(one.state, name), getattr(true, name), atol=1e-9)
    assert [(n.code, n.count) for n in notices] == [("odometry-in-parts", 2)]
    assert "0.000 m and 0.000 deg" in notices[0].message


def test_noise_of_shared_poses_is_told_and_widens_what_comes_after():
    noise = np.random.default_rng(5)
    earlier, later = piece(0, 0, 40, None, noise), piece(20, 40, 80, elsewhere(1), noise)
    joint = joint_of(earlier.estimates, later.estimates[:20])
    # both ends of a difference are noisy, in three directions: 1 cm and 1 mrad times the root of 6
    assert joint.shift == pytest.approx(np.sqrt(6) * 1e-2, rel=0.5)
    assert joint.turn == pytest.approx(np.sqrt(6) * 1e-3, rel=0.5)
    found, _ = stitched_estimates([earlier, later])
    spreads = [np.trace(e.covariance[3:, 3:]) for e in found]
    assert spreads[40] > spreads[39] + joint.shift**2
    # an angle that is not known moves the end of the way by its length times that angle
    assert spreads[79] - spreads[40] > (0.5 * 40 * joint.turn) ** 2
    errors = [np.linalg.norm(e.state.position - estimate(k).state.position) for k, e in enumerate(found)]
    assert max(errors) < 3 * np.sqrt(max(spreads))


def test_only_the_later_half_of_what_is_shared_counts():
    wrong = [estimate(k, elsewhere(7)) for k in range(20, 30)]
    right = [estimate(k, elsewhere(1)) for k in range(30, 40)]
    joint = joint_of(piece(0, 0, 40).estimates, [*wrong, *right])
    assert (joint.number, joint.shift < 1e-9) == (10, True)


def test_parts_without_a_sweep_in_common_are_refused():
    with pytest.raises(PoseError, match=r"drive\.sfs: two parts .* no sweep in common"):
        stitched_estimates([piece(0, 0, 40), piece(41, 41, 80)], "drive.sfs")


def test_remarks_of_parts_are_told_once_with_their_counts():
    def notice(code, count):
        return Notice(kind=NoticeKind.ASSUMED, code=code, place="lidar", message=code, count=count)

    told = summed_notices([[notice("a", 2), notice("b", 1)], [notice("a", 3)]])
    assert told == (notice("a", 5), notice("b", 1))
