"""What an extrinsic of unknown kind means: its direction, layout, order, unit and axes, told by the drive itself."""

from sceneloom.calibrate.conventions.deciding import Decision, Score, decide
from sceneloom.calibrate.conventions.hypotheses import CHOICES, Hypothesis, hypotheses
from sceneloom.calibrate.conventions.point_frames import possible_frames
from sceneloom.calibrate.conventions.reading import Extrinsic, read_extrinsics
from sceneloom.calibrate.conventions.time_units import RATES_HZ, UNITS_NS, time_units

__all__ = [
    "CHOICES",
    "RATES_HZ",
    "UNITS_NS",
    "Decision",
    "Extrinsic",
    "Hypothesis",
    "Score",
    "decide",
    "hypotheses",
    "possible_frames",
    "read_extrinsics",
    "time_units",
]
