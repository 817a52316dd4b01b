"""Which of several readings of orientations is the likely one where the IMU cannot tell: positions do."""

from collections.abc import Set as AbstractSet

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.checks.recordings.imu_evidence import FEWEST_INTERVALS, Gravity
from sceneloom.checks.recordings.orientation_readings import (
    AS_GIVEN,
    INVERTED,
    MIRRORED,
    Z_DOWN,
    OrientationReading,
    read_orientations,
)
from sceneloom.checks.recordings.turning import PoseIntervals
from sceneloom.geometry.rotations import conjugate_quaternion, rotate_vectors
from sceneloom.scene import Trajectory

_SLOWEST = 1.0
"""Slower motion [m/s] does not tell where a vehicle's front is."""
_CLEARLY = 0.5
"""A direction of motion that wanders by less than this part of another one is the likely one."""
_SIGNS_KNOWN = 0.5
_SIGNS_TURNED = (
    "the accelerometer's signs are turned: expected what holds it up at rest, not what pulls it down"
)
_WHOLE_POSES = "the poses lead from the world to the device; expected device to world"


def most_likely(
    best: OrientationReading,
    possible: AbstractSet[OrientationReading],
    way: Trajectory,
    intervals: PoseIntervals,
    gravity: Gravity | None,
) -> str:
    """Say what is probably wrong.

    Args:
        best: the reading that agrees best with the IMU.
        possible: all that agree with it.
        way: the trajectory.
        intervals: of it.
        gravity: what the accelerometer measured, where known.
    """
    if best is Z_DOWN:
        return _upside_down(way, gravity)
    if best not in {INVERTED, MIRRORED}:
        return best.told
    spreads = {
        INVERTED.told: _wander(way.positions, way, intervals, INVERTED),
        _WHOLE_POSES: _wander(_inverted_positions(way), way, intervals, INVERTED),
        MIRRORED.told: _wander(way.positions, way, intervals, AS_GIVEN),
    }
    if MIRRORED not in possible:
        del spreads[MIRRORED.told]
    if INVERTED not in possible:
        return MIRRORED.told
    if not np.isfinite(list(spreads.values())).all():
        return " or ".join([INVERTED.told, *([MIRRORED.told] if MIRRORED in possible else [])])
    likely, least = min(spreads.items(), key=lambda item: item[1])
    others = [told for told, spread in spreads.items() if told != likely and not least < _CLEARLY * spread]
    return " or ".join([likely, *others])


def _upside_down(way: Trajectory, gravity: Gravity | None) -> str:
    """Tell a world upside down from an accelerometer with turned signs: that one feels speeding up as braking."""
    felt = 0.0
    if gravity is not None:
        felt = gravity.felt_and_moved(read_orientations(AS_GIVEN, way.poses.quaternions_xyzw), way.positions)
    if felt > _SIGNS_KNOWN:
        return Z_DOWN.told
    return _SIGNS_TURNED if felt < -_SIGNS_KNOWN else f"{Z_DOWN.told}; or {_SIGNS_TURNED}"


def _inverted_positions(way: Trajectory) -> Float64Array:
    quaternions = conjugate_quaternion(read_orientations(AS_GIVEN, way.poses.quaternions_xyzw))
    return -rotate_vectors(quaternions, way.positions)


def _wander(
    positions: Float64Array, way: Trajectory, intervals: PoseIntervals, reading: OrientationReading
) -> float:
    """How far the direction of motion wanders about the device: 0 for a vehicle that drives ahead; NaN if it stands."""
    velocities = intervals.velocities(positions)
    speeds = np.linalg.norm(velocities, axis=1)
    moving = speeds > _SLOWEST
    if np.count_nonzero(moving) < FEWEST_INTERVALS:
        return float("nan")
    world_from_device = read_orientations(reading, way.poses.quaternions_xyzw)
    ahead = intervals.to_world(conjugate_quaternion(world_from_device), velocities)[moving]
    return 1.0 - float(np.linalg.norm((ahead / speeds[moving, None]).mean(axis=0)))
