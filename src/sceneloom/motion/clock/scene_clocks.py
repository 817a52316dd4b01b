"""Two streams of a drive against each other, by whatever both report the motion."""

from enum import StrEnum

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.motion.clock.estimate import ClockEstimate, ClockVerdict
from sceneloom.motion.clock.rotating import Rotating
from sceneloom.motion.clock.rotating_clock import REACH_NS, compare_turnings
from sceneloom.motion.clock.streams import ReportedMotion, Stream
from sceneloom.motion.clock.trajectory_clock import LEVER_SIGMA, compare_trajectories
from sceneloom.scene.motion import VectorSamples
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.types import Progress

_KNOWN_LEVER_SIGMA = 0.05
"""How well a stated mounting of an antenna is known on each axis [m]."""


class Method(StrEnum):
    """By what two streams were compared."""

    ROTATING = "rotating"
    TRAJECTORY = "estimated_trajectory"
    NONE = "none"


def compare_streams(
    reference: Stream,
    stream: Stream,
    *,
    reach_ns: int = REACH_NS,
    lever_sigma: float = LEVER_SIGMA,
    progress: Progress | None = None,
) -> tuple[Method, ClockEstimate]:
    """Find how the clock of one stream goes against that of another.

    By how the ego rotated, where both report it; else by where it was.

    Args:
        reach_ns: offsets up to this are looked for [ns].
        lever_sigma: how far from the ego's origin a receiver's antenna may be on each axis, where no mounting is
            stated [m].
        progress: reported while images or sweeps are looked at.
    """
    if not stream.meets(reference, reach_ns):
        return Method.NONE, ClockEstimate.unknown("their timestamps have no time in common")
    first, second = reference.reported(progress), stream.reported(progress)
    for name, reported in ((reference.name, first), (stream.name, second)):
        if reported.why_not:
            return Method.NONE, ClockEstimate.unknown(f"{name}: {reported.why_not}")
    by_rotation: ClockEstimate | None = None
    if first.rotating is not None and second.rotating is not None:
        by_rotation = compare_turnings(
            first.rotating, second.rotating, reach_ns=reach_ns, reference_from_stream=_between(first, second)
        )
        if by_rotation.verdict is not ClockVerdict.NOT_OBSERVABLE:
            return Method.ROTATING, by_rotation
    by_trajectory = _by_trajectory(first, second, reach_ns=reach_ns, lever_sigma=lever_sigma)
    if by_trajectory is not None and (
        by_rotation is None or by_trajectory.verdict is not ClockVerdict.NOT_OBSERVABLE
    ):
        return Method.TRAJECTORY, by_trajectory
    if by_rotation is not None:
        return Method.ROTATING, by_rotation
    return Method.NONE, ClockEstimate.unknown(
        "the one reports only where it was, the other only how it rotated"
    )


def _between(reference: ReportedMotion, stream: ReportedMotion) -> Float64Array:
    """The rotation from the stream's body into the reference's, as far as their mountings state it."""
    identity = np.eye(3)
    into_ego = identity if stream.ego_from_body is None else stream.ego_from_body
    from_ego = identity if reference.ego_from_body is None else reference.ego_from_body.T
    return np.asarray(from_ego @ into_ego, np.float64)


def _by_trajectory(
    reference: ReportedMotion, stream: ReportedMotion, *, reach_ns: int, lever_sigma: float
) -> ClockEstimate | None:
    """Compare fixes with a trajectory, where one has the one and the other the other."""
    for reported, estimated_trajectory, fixes_are_reference in (
        (stream, reference.trajectory, False),
        (reference, stream.trajectory, True),
    ):
        fixes = reported.fixes
        if fixes is not None and estimated_trajectory is not None and len(fixes):
            origin_ns = int(fixes.timestamps_ns[0])
            return compare_trajectories(
                fixes,
                estimated_trajectory(origin_ns),
                origin_ns=origin_ns,
                fixes_are_reference=fixes_are_reference,
                reach_ns=reach_ns,
                lever=reported.location,
                lever_sigma=lever_sigma
                if reported.location is None
                else min(lever_sigma, _KNOWN_LEVER_SIGMA),
            )
    return None


def gyroscope_against_trajectory(
    gyroscope: VectorSamples, trajectory: Trajectory, *, reach_ns: int = REACH_NS
) -> ClockEstimate:
    """Find how the timestamps of a trajectory lie against those of the gyroscope that rides along.

    Args:
        gyroscope: yaw rates (N, 3) [rad/s] in the ego's frame; rows that are no numbers are left out.
        trajectory: `world_from_ego`.
        reach_ns: offsets up to this are looked for [ns].

    Returns:
        The trajectory's clock against the gyroscope's. A minute of 100 Hz takes a few tenths of a second.
    """
    if trajectory.quaternions_xyzw is None:
        return ClockEstimate.unknown(f"trajectory {trajectory.name!r} has no orientations")
    rates = Rotating.of_rates(gyroscope.timestamps_ns, gyroscope.values[:, :3])
    estimated_trajectory = Rotating.of_poses(trajectory.timestamps_ns, trajectory.quaternions_xyzw)
    return compare_turnings(rates, estimated_trajectory, reach_ns=reach_ns)
