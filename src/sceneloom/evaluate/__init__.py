"""How good something is: trajectories against a reference."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.evaluate.trajectory import RPE_DELTAS, evaluate_trajectory
    from sceneloom.evaluate.trajectory_errors import (
        ALIGNMENTS,
        AbsoluteErrors,
        AlignmentReport,
        ErrorStatistics,
        KittiErrors,
        RelativeErrors,
        SegmentErrors,
        TrajectoryReport,
    )
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "ALIGNMENTS": "sceneloom.evaluate.trajectory_errors:ALIGNMENTS",
            "RPE_DELTAS": "sceneloom.evaluate.trajectory:RPE_DELTAS",
            "AbsoluteErrors": "sceneloom.evaluate.trajectory_errors:AbsoluteErrors",
            "AlignmentReport": "sceneloom.evaluate.trajectory_errors:AlignmentReport",
            "ErrorStatistics": "sceneloom.evaluate.trajectory_errors:ErrorStatistics",
            "KittiErrors": "sceneloom.evaluate.trajectory_errors:KittiErrors",
            "RelativeErrors": "sceneloom.evaluate.trajectory_errors:RelativeErrors",
            "SegmentErrors": "sceneloom.evaluate.trajectory_errors:SegmentErrors",
            "TrajectoryReport": "sceneloom.evaluate.trajectory_errors:TrajectoryReport",
            "evaluate_trajectory": "sceneloom.evaluate.trajectory:evaluate_trajectory",
        },
    )

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
