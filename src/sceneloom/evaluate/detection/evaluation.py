"""How good detections are: those of several sequences held against the truth."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import OptionError
from sceneloom.evaluate.detection.calibration import Calibration, judge_calibration
from sceneloom.evaluate.detection.covariances import CovarianceScores, judge_covariances
from sceneloom.evaluate.detection.curve import ScoreCurve, score_curve, surest_matches
from sceneloom.evaluate.detection.rules import (
    DIFFICULTIES,
    DetectionRules,
    ScoredDetections,
    at_difficulty,
    pair_detections,
)
from sceneloom.evaluate.objects import ObjectTable
from sceneloom.evaluate.overlaps import Similarity
from sceneloom.evaluate.sequences import check_sequences

CLASSES = ("car", "pedestrian", "cyclist")
"""The classes of KITTI's object benchmark."""

KITTI_DIFFICULTIES = ("easy", "moderate", "hard")

KITTI_IN_SPACE = DetectionRules()
"""Those of KITTI's object benchmark in 3D."""

OVERLAP_OF_ERRORS = 0.3
"""Overlap in space from which errors of a detection are reported: such boxes are of one object beyond doubt."""

PARTS = {"center": slice(0, 3), "size": slice(3, 6), "yaw": slice(6, 7)}
"""What covariances are judged of, and where it stands in a box."""


class DetectionScores(msgspec.Struct, frozen=True, kw_only=True):
    """The figures of detections of one class, at one difficulty.

    Attributes:
        ap40: average precision over the recalls 1/40, …, 1.
        ap11: over the recalls 0, 1/10, …, 1, as until 2019.
        max_f1: best F1 of all scores.
        threshold: the score at which it is reached, None without detections.
        precision, recall: there.
        true_objects: how many must be found.
        detections: how many are either right or wrong, of all scores.
        thresholds, recalls, precisions: at KITTI's up to 41 scores, falling; precisions as they are.
        calibration: of the scores, None where they are no probabilities or nothing counts.
    """

    ap40: float
    ap11: float
    max_f1: float
    threshold: float | None
    precision: float
    recall: float
    true_objects: int
    detections: int
    thresholds: tuple[float, ...]
    recalls: tuple[float, ...]
    precisions: tuple[float, ...]
    calibration: Calibration | None


class ClassDetection(msgspec.Struct, frozen=True, kw_only=True):
    """The figures for one class.

    Attributes:
        similarity: what says how much two boxes overlap.
        least_overlap: what pairs must exceed.
        difficulties: the figures, by difficulty.
        covariances: how true the covariances of `PARTS` are, of boxes that overlap in space by at least
            `OVERLAP_OF_ERRORS`; None where detections have none, or nothing overlaps.
        headings_reversed: share of those boxes whose heading is off by more than 90°, None as above.
    """

    similarity: str
    least_overlap: float
    difficulties: dict[str, DetectionScores]
    covariances: dict[str, CovarianceScores] | None
    headings_reversed: float | None


def evaluate_detection(
    results: Mapping[str, ObjectTable],
    truth: Mapping[str, ObjectTable],
    *,
    classes: Sequence[str] = CLASSES,
    difficulties: Sequence[str] = KITTI_DIFFICULTIES,
    rules: DetectionRules = KITTI_IN_SPACE,
    degrees_of_freedom: float | None = None,
) -> dict[str, ClassDetection]:
    """Hold detections of some sequences against the truth.

    Args:
        results, truth: by name of the sequence; sequences without detections have empty ones.
        classes: those to evaluate, each by itself.
        difficulties: of `DIFFICULTIES`.
        rules: what counts.
        degrees_of_freedom: of the detections' errors, as of `judge_covariances`.

    Returns:
        By class.

    Raises:
        OptionError: sequences are not the same on both sides, or there is none, or boxes or scores are missing, or a
            difficulty is unknown.
        ArrayError: a covariance is none.
    """
    check_sequences(results, truth)
    unknown = [name for name in difficulties if name not in DIFFICULTIES]
    if unknown:
        raise OptionError(f"difficulty {unknown[0]!r}; expected one of {', '.join(DIFFICULTIES)}")
    reported = {}
    for label in classes:
        pairs = pair_detections(results, truth, label, rules=rules)
        figures = {name: score_detections(at_difficulty(pairs, DIFFICULTIES[name])) for name in difficulties}
        covariances, reversed_share = _judge_boxes(results, truth, label, rules, degrees_of_freedom)
        reported[label] = ClassDetection(
            similarity=rules.similarity.value,
            least_overlap=pairs.least_overlap,
            difficulties=figures,
            covariances=covariances,
            headings_reversed=reversed_share,
        )
    return reported


def score_detections(detections: ScoredDetections) -> DetectionScores:
    """Compute the figures of what was paired."""
    curve = score_curve(detections)
    sampled = curve.sampled_precisions
    best = int(curve.f1s.argmax()) if len(curve.thresholds) else None
    return DetectionScores(
        ap40=float(sampled[1:].mean()),
        ap11=float(sampled[::4].mean()),
        max_f1=0.0 if best is None else float(curve.f1s[best]),
        threshold=None if best is None else float(curve.thresholds[best]),
        precision=0.0 if best is None else float(curve.precisions[best]),
        recall=0.0 if best is None else float(curve.recalls[best]),
        true_objects=curve.true_count,
        detections=int(curve.tp[-1] + curve.fp[-1]) if len(curve.tp) else 0,
        calibration=_calibration(detections),
        **_sampled(curve),
    )


def _sampled(curve: ScoreCurve) -> dict[str, tuple[float, ...]]:
    columns = {"thresholds": curve.thresholds, "recalls": curve.recalls, "precisions": curve.precisions}
    return {name: tuple(column[curve.samples].tolist()) for name, column in columns.items()}


def outcomes(detections: ScoredDetections) -> tuple[Int64Array, BoolArray]:
    """Report which detections are true; of several of one object the surest one is.

    Returns:
        (K,) int64, the detections that are either true or false, and (K,) bool, whether each is true.
    """
    matches = surest_matches(detections)
    matched = matches >= 0
    of_ignored = np.zeros(len(matches), np.bool_)
    of_ignored[matched] = detections.true_ignored[matches[matched]]
    counts = ~(detections.found_ignored | of_ignored | (detections.excused & ~matched))
    return np.flatnonzero(counts), matched[counts]


def _calibration(detections: ScoredDetections) -> Calibration | None:
    rows, are_true = outcomes(detections)
    scores = detections.scores
    if not len(rows) or scores.min() < 0.0 or scores.max() > 1.0:
        return None
    return judge_calibration(scores[rows], are_true)


def _judge_boxes(
    results: Mapping[str, ObjectTable],
    truth: Mapping[str, ObjectTable],
    label: str,
    rules: DetectionRules,
    degrees_of_freedom: float | None,
) -> tuple[dict[str, CovarianceScores] | None, float | None]:
    """Judge covariances of boxes in space, whatever boxes the rest is judged by."""
    if all(table.covariances is None or table.boxes is None for table in results.values()):
        return None, None
    in_space = replace(
        rules, similarity=Similarity.SPACE, least_overlap=OVERLAP_OF_ERRORS, neighbours={}, regions=""
    )
    detections = pair_detections(results, truth, label, rules=in_space)
    if detections.found.covariances is None or not (surest_matches(detections) >= 0).any():
        return None, None
    errors, covariances = box_errors(detections)
    reversed_share = float((np.abs(errors[:, 6]) > np.pi / 2).mean())
    # a heading the wrong way round is a mistake of its own, which no covariance is meant to report
    errors[:, 6] = (errors[:, 6] + np.pi / 2) % np.pi - np.pi / 2
    judged = {
        name: judge_covariances(
            errors[:, part], covariances[:, part, part], degrees_of_freedom=degrees_of_freedom
        )
        for name, part in PARTS.items()
        if covariances[:, part, part].any()  # what nobody reported has variances of 0
    }
    return judged, reversed_share


def box_errors(detections: ScoredDetections) -> tuple[Float64Array, Float64Array]:
    """Give the errors of the detections that have a true object, and their covariances.

    Returns:
        (K, 7) float64: middle, length, width, height [m], heading [rad] within ±π; (K, 7, 7) float64.

    Raises:
        OptionError: one side has no boxes in space, or detections no covariances.
    """
    found, truth = detections.found, detections.truth
    if found.boxes is None or truth.boxes is None or found.covariances is None:
        raise OptionError("errors of boxes need boxes in space on both sides and covariances of the results")
    matches = surest_matches(detections)
    matched = matches >= 0
    errors = found.boxes[matched] - truth.boxes[matches[matched]]
    errors[:, 6] = (errors[:, 6] + np.pi) % (2 * np.pi) - np.pi
    return errors, found.covariances[matched]
