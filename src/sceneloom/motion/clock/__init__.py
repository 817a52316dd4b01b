"""Clocks against each other: the time offset and the skew between two streams that tell of the same motion."""

from sceneloom.motion.clock.estimate import ClockEstimate, ClockVerdict, OffsetPiece
from sceneloom.motion.clock.scene_clocks import gyroscope_against_trajectory
from sceneloom.motion.clock.turning import Turning
from sceneloom.motion.clock.turning_clock import compare_turnings

__all__ = [
    "ClockEstimate",
    "ClockVerdict",
    "OffsetPiece",
    "Turning",
    "compare_turnings",
    "gyroscope_against_trajectory",
]
