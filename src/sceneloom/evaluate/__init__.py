"""How good something is: trajectories against a reference."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.evaluate.trajectory import (
        ALIGNMENTS,
        RPE_DELTAS,
        ErrorStatistics,
        RelativeErrors,
        TrajectoryReport,
        evaluate_trajectory,
    )
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {"trajectory": "ALIGNMENTS RPE_DELTAS ErrorStatistics RelativeErrors TrajectoryReport evaluate_trajectory"},
    )

__all__ = ["ALIGNMENTS", "RPE_DELTAS", "ErrorStatistics", "RelativeErrors", "TrajectoryReport", "evaluate_trajectory"]
