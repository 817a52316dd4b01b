"""How good something is: trajectories against a reference."""

from sceneloom.evaluate.alignment import ALIGNMENTS
from sceneloom.evaluate.report import (
    AbsoluteErrors,
    AlignmentReport,
    ErrorStatistics,
    KittiErrors,
    RelativeErrors,
    SegmentErrors,
    TrajectoryReport,
)
from sceneloom.evaluate.trajectory import RPE_DELTAS, evaluate_trajectory

__all__ = [
    "ALIGNMENTS",
    "RPE_DELTAS",
    "AbsoluteErrors",
    "AlignmentReport",
    "ErrorStatistics",
    "KittiErrors",
    "RelativeErrors",
    "SegmentErrors",
    "TrajectoryReport",
    "evaluate_trajectory",
]
