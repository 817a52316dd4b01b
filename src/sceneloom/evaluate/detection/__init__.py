"""How good detections are: precision and recall by KITTI's rules, and whether scores and covariances are true."""

from sceneloom.evaluate.detection.calibration import Calibration, ReliabilityBin, judge_calibration
from sceneloom.evaluate.detection.comparison import SIMILARITIES, DetectionReport, compare_detections
from sceneloom.evaluate.detection.covariances import CovarianceScores, Coverage, judge_covariances
from sceneloom.evaluate.detection.curve import ScoreCurve, score_curve
from sceneloom.evaluate.detection.evaluation import (
    CLASSES,
    KITTI_DIFFICULTIES,
    KITTI_IN_SPACE,
    ClassDetection,
    DetectionScores,
    box_errors,
    evaluate_detection,
    outcomes,
    score_detections,
)
from sceneloom.evaluate.detection.rules import (
    DIFFICULTIES,
    LEAST_OVERLAPS,
    DetectionRules,
    Difficulty,
    ScoredDetections,
    at_difficulty,
    pair_detections,
)

__all__ = [
    "CLASSES",
    "DIFFICULTIES",
    "KITTI_DIFFICULTIES",
    "KITTI_IN_SPACE",
    "LEAST_OVERLAPS",
    "SIMILARITIES",
    "Calibration",
    "ClassDetection",
    "CovarianceScores",
    "Coverage",
    "DetectionReport",
    "DetectionRules",
    "DetectionScores",
    "Difficulty",
    "ReliabilityBin",
    "ScoreCurve",
    "ScoredDetections",
    "at_difficulty",
    "box_errors",
    "compare_detections",
    "evaluate_detection",
    "judge_calibration",
    "judge_covariances",
    "outcomes",
    "pair_detections",
    "score_curve",
    "score_detections",
]
