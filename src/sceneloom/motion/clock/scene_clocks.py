"""Two streams of a drive against each other, by whatever both tell of the motion."""

from enum import StrEnum

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.motion.clock.estimate import ClockEstimate, ClockVerdict
from sceneloom.motion.clock.streams import MotionTold, Stream
from sceneloom.motion.clock.turning import Turning
from sceneloom.motion.clock.turning_clock import REACH_NS, compare_turnings
from sceneloom.motion.clock.way_clock import LEVER_SIGMA, compare_ways
from sceneloom.scene.motion import VectorSamples
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.types import Progress

_KNOWN_LEVER_SIGMA = 0.05
"""How well a stated mounting of an antenna is known on each axis [m]."""


class Method(StrEnum):
    """By what two streams were compared."""

    TURNING = "turning"
    WAY = "way"
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

    By how the ego turned, where both tell it; else by where it was.

    Args:
        reach_ns: offsets up to this are looked for [ns].
        lever_sigma: how far from the ego's origin a receiver's antenna may be on each axis, where no mounting is
            stated [m].
        progress: told while pictures or sweeps are looked at.
    """
    if not stream.meets(reference, reach_ns):
        return Method.NONE, ClockEstimate.unknown("their stamps have no time in common")
    first, second = reference.told(progress), stream.told(progress)
    for name, told in ((reference.name, first), (stream.name, second)):
        if told.why_not:
            return Method.NONE, ClockEstimate.unknown(f"{name}: {told.why_not}")
    by_turning: ClockEstimate | None = None
    if first.turning is not None and second.turning is not None:
        by_turning = compare_turnings(
            first.turning, second.turning, reach_ns=reach_ns, reference_from_stream=_between(first, second)
        )
        if by_turning.verdict is not ClockVerdict.NOT_OBSERVABLE:
            return Method.TURNING, by_turning
    by_way = _by_way(first, second, reach_ns=reach_ns, lever_sigma=lever_sigma)
    if by_way is not None and (by_turning is None or by_way.verdict is not ClockVerdict.NOT_OBSERVABLE):
        return Method.WAY, by_way
    if by_turning is not None:
        return Method.TURNING, by_turning
    return Method.NONE, ClockEstimate.unknown("the one tells only where it was, the other only how it turned")


def _between(reference: MotionTold, stream: MotionTold) -> Float64Array:
    """The rotation from the stream's body into the reference's, as far as their mountings say it."""
    identity = np.eye(3)
    into_ego = identity if stream.ego_from_body is None else stream.ego_from_body
    from_ego = identity if reference.ego_from_body is None else reference.ego_from_body.T
    return np.asarray(from_ego @ into_ego, np.float64)


def _by_way(
    reference: MotionTold, stream: MotionTold, *, reach_ns: int, lever_sigma: float
) -> ClockEstimate | None:
    """Compare fixes with a way, where one has the one and the other the other."""
    for told, way, fixes_are_reference in ((stream, reference.way, False), (reference, stream.way, True)):
        fixes = told.fixes
        if fixes is not None and way is not None and len(fixes):
            origin_ns = int(fixes.timestamps_ns[0])
            return compare_ways(
                fixes,
                way(origin_ns),
                origin_ns=origin_ns,
                fixes_are_reference=fixes_are_reference,
                reach_ns=reach_ns,
                lever=told.place,
                lever_sigma=lever_sigma if told.place is None else min(lever_sigma, _KNOWN_LEVER_SIGMA),
            )
    return None


def gyroscope_against_trajectory(
    gyroscope: VectorSamples, trajectory: Trajectory, *, reach_ns: int = REACH_NS
) -> ClockEstimate:
    """Find how the stamps of a trajectory lie against those of the gyroscope that rides along.

    Args:
        gyroscope: turn rates (N, 3) [rad/s] in the ego's frame; rows that are no numbers are left out.
        trajectory: `world_from_ego`.
        reach_ns: offsets up to this are looked for [ns].

    Returns:
        The trajectory's clock against the gyroscope's. A minute of 100 Hz takes a few tenths of a second.
    """
    if trajectory.quaternions_xyzw is None:
        return ClockEstimate.unknown(f"trajectory {trajectory.name!r} has no orientations")
    rates = Turning.of_rates(gyroscope.timestamps_ns, gyroscope.values[:, :3])
    way = Turning.of_poses(trajectory.timestamps_ns, trajectory.quaternions_xyzw)
    return compare_turnings(rates, way, reach_ns=reach_ns)
