"""Who sees what: cuboids in images, points in cuboids."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.visibility.counted import with_activations, with_counts, with_labeled_points
    from sceneloom.visibility.observations import Observations, visibility
    from sceneloom.visibility.points import FrameCounts, Moment, PointCounts, count_points
    from sceneloom.visibility.projected import project_cuboids
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "FrameCounts": "sceneloom.visibility.points:FrameCounts",
            "Moment": "sceneloom.visibility.points:Moment",
            "PointCounts": "sceneloom.visibility.points:PointCounts",
            "Observations": "sceneloom.visibility.observations:Observations",
            "count_points": "sceneloom.visibility.points:count_points",
            "project_cuboids": "sceneloom.visibility.projected:project_cuboids",
            "visibility": "sceneloom.visibility.observations:visibility",
            "with_activations": "sceneloom.visibility.counted:with_activations",
            "with_counts": "sceneloom.visibility.counted:with_counts",
            "with_labeled_points": "sceneloom.visibility.counted:with_labeled_points",
        },
    )

__all__ = [
    "FrameCounts",
    "Moment",
    "Observations",
    "PointCounts",
    "count_points",
    "project_cuboids",
    "visibility",
    "with_activations",
    "with_counts",
    "with_labeled_points",
]
