"""How good something is: trajectories against a reference."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
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
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "ALIGNMENTS": "sceneloom.evaluate.alignment:ALIGNMENTS",
            "RPE_DELTAS": "sceneloom.evaluate.trajectory:RPE_DELTAS",
            "AbsoluteErrors": "sceneloom.evaluate.report:AbsoluteErrors",
            "AlignmentReport": "sceneloom.evaluate.report:AlignmentReport",
            "ErrorStatistics": "sceneloom.evaluate.report:ErrorStatistics",
            "KittiErrors": "sceneloom.evaluate.report:KittiErrors",
            "RelativeErrors": "sceneloom.evaluate.report:RelativeErrors",
            "SegmentErrors": "sceneloom.evaluate.report:SegmentErrors",
            "TrajectoryReport": "sceneloom.evaluate.report:TrajectoryReport",
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
