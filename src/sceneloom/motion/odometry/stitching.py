"""One way of the ego out of several, each found from the sweeps of a part of a drive.

Neighbouring parts share the sweeps that lead into the later one. There both know where the ego was, each in its own
world; the rigid motion that brings the one onto the other best takes the later part into the world of the earlier one.
Only the later half of the shared sweeps counts: before, the later part has little of a map.

At a joint the way errs by as much as that motion does: a shift, and a turn, which moves everything after by its angle
times the way from there. Both are of the size by which shared poses differ after the motion, which is told; they are
added to the covariances of all poses after.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.odometry.lidar_odometry import Outcome, PoseEstimate, carried_covariance
from sceneloom.motion.odometry.motion_state import MotionState, turn_vector
from sceneloom.scene import Notice, NoticeKind


@dataclass(frozen=True, slots=True, eq=False)
class OdometryPiece:
    """What the sweeps of a part of a drive tell.

    Attributes:
        estimates: of the sweeps that lead into the part, then of its own; the world is the ego's first pose.
        leading: how many lead into it.
        late: own sweeps that were left out because they were not later than the one before.
        clouds: how many clouds of its own there were.
        notices: what is to be said of the whole drive.
        counted: what is to be said of its own sweeps.
    """

    estimates: tuple[PoseEstimate, ...]
    leading: int
    late: int
    clouds: int
    notices: tuple[Notice, ...] = ()
    counted: tuple[Notice, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """How two parts meet.

    Attributes:
        earlier_from_later: takes the world of the later part into that of the earlier one.
        shift, turn: how far shared poses are apart then, root mean square [m], [rad].
        number: of shared poses that count.
    """

    earlier_from_later: RigidTransform
    shift: float
    turn: float
    number: int

    @property
    def covariance(self) -> Float64Array:
        """(6, 6) of a small turn and shift, what `earlier_from_later` may err by at the joint."""
        return np.diag(np.repeat([self.turn**2, self.shift**2], 3))


def stitched_estimates(
    pieces: Sequence[OdometryPiece], source: str = ""
) -> tuple[list[PoseEstimate], tuple[Notice, ...]]:
    """Bring the parts of a drive into the world of the first one; each sweep counts as its own part has it.

    Raises:
        PoseError: two neighbours have no sweep in common.
    """
    found = list(pieces[0].estimates)
    joints = []
    for piece in pieces[1:]:
        own = piece.estimates[piece.leading :]
        if not own:
            continue
        joint = joint_of(found, piece.estimates[: piece.leading], source)
        before, at_joint = found[-1].covariance, found[-1].state.position
        for estimate in own:
            state = _moved(estimate.state, joint.earlier_from_later)
            drift = carried_covariance(before + joint.covariance, state.position - at_joint)
            axes = np.kron(np.eye(2), joint.earlier_from_later.rotation)
            covariance = drift + axes @ estimate.covariance @ axes.T
            outcome = Outcome.RESTARTED if estimate.outcome is Outcome.STARTED else estimate.outcome
            found.append(
                replace(estimate, state=state, covariance=covariance, outcome=outcome, first_state=None)
            )
        joints.append(joint)
    return found, _told(joints, source)


def joint_of(earlier: Sequence[PoseEstimate], later: Sequence[PoseEstimate], source: str = "") -> Joint:
    """Find how a part lies in the world of the one before, by the sweeps that both have.

    Raises:
        PoseError: there is none.
    """
    known = {estimate.state.timestamp_ns: estimate for estimate in earlier[-2 * len(later) - 1 :]}
    shared = [(known[e.state.timestamp_ns], e) for e in later if e.state.timestamp_ns in known]
    fitted = [pair for pair in shared if all(e.outcome is Outcome.FITTED for e in pair)]
    pairs = fitted[len(fitted) // 2 :] or shared[-1:]
    if not pairs:
        raise PoseError(
            f"{source}: two parts of the drive have no sweep in common that tells the ego's way; say longer `--parts`"
        )
    turned = sum((a.state.rotation @ b.state.rotation.T for a, b in pairs), np.zeros((3, 3)))
    left, _, right = np.linalg.svd(turned)
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    shifts = np.array([a.state.position - rotation @ b.state.position for a, b in pairs])
    moved = RigidTransform(rotation, shifts.mean(axis=0))
    turns = [turn_vector(a.state.rotation @ b.state.rotation.T @ rotation.T) for a, b in pairs]
    return Joint(moved, _rms(shifts - shifts.mean(axis=0)), _rms(np.array(turns)), len(pairs))


def summed_notices(parts: Sequence[Sequence[Notice]]) -> tuple[Notice, ...]:
    """The remarks on all parts, each once, with their counts added up."""
    counts = Counter[Notice]()
    for notice in chain.from_iterable(parts):
        counts[msgspec.structs.replace(notice, count=1)] += notice.count
    return tuple(msgspec.structs.replace(notice, count=count) for notice, count in counts.items())


def _moved(state: MotionState, world_from_here: RigidTransform) -> MotionState:
    turn = world_from_here.rotation
    axes = np.kron(np.eye(4), turn)
    return MotionState(
        state.timestamp_ns,
        turn @ state.rotation,
        world_from_here.apply(state.position[None])[0],
        turn @ state.turn_rate,
        turn @ state.velocity,
        axes @ state.covariance @ axes.T,
    )


def _rms(vectors: Float64Array) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def _told(joints: Sequence[Joint], source: str) -> tuple[Notice, ...]:
    if not joints:
        return ()
    shift, turn = max(joint.shift for joint in joints), max(joint.turn for joint in joints)
    message = (
        "joints between parts of the drive whose ways were found apart and laid onto one another; where they overlap "
        f"they differ by at most {shift:.3f} m and {np.degrees(turn):.3f} deg, root mean square"
    )
    return (
        Notice(
            kind=NoticeKind.ASSUMED,
            code="odometry-in-parts",
            place=source,
            message=message,
            count=len(joints),
        ),
    )
