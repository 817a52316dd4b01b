"""Clocks of a scene's streams."""

from sceneloom.motion.clock.estimate import ClockEstimate
from sceneloom.motion.clock.turning import Turning
from sceneloom.motion.clock.turning_clock import REACH_NS, compare_turnings
from sceneloom.scene import Trajectory, VectorSamples


def gyroscope_against_trajectory(
    gyroscope: VectorSamples, trajectory: Trajectory, *, reach_ns: int = REACH_NS
) -> ClockEstimate:
    """Find how the stamps of a trajectory lie against those of the gyroscope that rides along.

    Args:
        gyroscope: turn rates (N, 3) [rad/s] in the ego's frame; rows that are no numbers are left out.
        trajectory: `world_from_ego`.
        reach_ns: offsets up to this are looked for [ns].

    Returns:
        The trajectory's clock against the gyroscope's. A minute of 100 Hz takes a few hundredths of a second.
    """
    if trajectory.quaternions_xyzw is None:
        return ClockEstimate.unknown(f"trajectory {trajectory.name!r} has no orientations")
    rates = Turning.of_rates(gyroscope.timestamps_ns, gyroscope.values[:, :3])
    way = Turning.of_poses(trajectory.timestamps_ns, trajectory.quaternions_xyzw)
    return compare_turnings(rates, way, reach_ns=reach_ns)
