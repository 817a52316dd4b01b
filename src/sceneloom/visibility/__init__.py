"""Who sees what: cuboids in pictures, points in cuboids."""

from sceneloom.visibility.counted import with_activations, with_counts, with_labeled_points
from sceneloom.visibility.points import FrameCounts, Moment, PointCounts, count_points
from sceneloom.visibility.projected import project_cuboids
from sceneloom.visibility.sights import Sights, sight

__all__ = [
    "FrameCounts",
    "Moment",
    "PointCounts",
    "Sights",
    "count_points",
    "project_cuboids",
    "sight",
    "with_activations",
    "with_counts",
    "with_labeled_points",
]
