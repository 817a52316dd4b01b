"""How good a tracker is: HOTA, CLEAR and identities, by KITTI's rules or for boxes in space."""

from sceneloom.evaluate.tracking.comparison import TrackingReport, compare_tracks
from sceneloom.evaluate.tracking.evaluation import (
    CLASSES,
    ClassTracking,
    TrackingScores,
    combine_scores,
    evaluate_tracking,
    score_sequence,
)
from sceneloom.evaluate.tracking.protocol import KITTI_RULES, NEIGHBOURS, TrackingRules
from sceneloom.evaluate.tracking.scores import ALPHAS, ClearScores, HotaScores, IdentityScores

__all__ = [
    "ALPHAS",
    "CLASSES",
    "KITTI_RULES",
    "NEIGHBOURS",
    "ClassTracking",
    "ClearScores",
    "HotaScores",
    "IdentityScores",
    "TrackingReport",
    "TrackingRules",
    "TrackingScores",
    "combine_scores",
    "compare_tracks",
    "evaluate_tracking",
    "score_sequence",
]
