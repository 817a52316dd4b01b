"""Precision and recall over scores: every threshold, KITTI's average precision, and the best F1."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.evaluate.detection.rules import ScoredDetections
from sceneloom.kernels import detection_scores

SAMPLES = 41
"""Thresholds at which KITTI looks at precision: one for recalls of 0, 1/40, …, 1."""


@dataclass(frozen=True, slots=True, eq=False)
class ScoreCurve:
    """What is right, wrong and missed among the detections of at least a score, for every score that there is.

    Attributes:
        thresholds: (K,) float64, falling.
        tp, fp, fn: (K,) int64.
        samples: (S,) int64, S <= `SAMPLES`, which of the thresholds KITTI looks at.
        true_count: objects that must be found.
    """

    thresholds: Float64Array
    tp: Int64Array
    fp: Int64Array
    fn: Int64Array
    samples: Int64Array
    true_count: int

    @property
    def precisions(self) -> Float64Array:
        """(K,) float64, 0 where no detection counts."""
        return np.asarray(self.tp / np.maximum(1, self.tp + self.fp), np.float64)

    @property
    def recalls(self) -> Float64Array:
        """(K,) float64."""
        return np.asarray(self.tp / np.maximum(1, self.tp + self.fn), np.float64)

    @property
    def f1s(self) -> Float64Array:
        """(K,) float64."""
        return np.asarray(2.0 * self.tp / np.maximum(1, 2 * self.tp + self.fp + self.fn), np.float64)

    @property
    def sampled_precisions(self) -> Float64Array:
        """(`SAMPLES`,) float64, the best precision at a recall or beyond it; 0 at recalls that are not reached."""
        sampled = np.zeros(SAMPLES)
        sampled[: len(self.samples)] = self.precisions[self.samples]
        return np.maximum.accumulate(sampled[::-1])[::-1]


def score_curve(detections: ScoredDetections) -> ScoreCurve:
    """Count what is right, wrong and missed at each score.

    With each least score objects and detections are paired anew, as KITTI's development kit does at its 41 scores.
    """
    scores = detections.scores
    steps = detection_scores.score_steps(
        detections.overlaps,
        *detections.pairs.locations,
        detections.true_ignored,
        detections.found_ignored,
        detections.excused,
        scores,
        detections.least_overlap,
    )
    order = np.argsort(-scores, kind="stable")
    ends = np.flatnonzero(np.diff(scores[order], append=-np.inf))
    tp, fp, passed = np.cumsum(steps[order], axis=0)[ends].T
    true_count = int((~detections.true_ignored).sum())
    thresholds = scores[order][ends]
    return ScoreCurve(
        thresholds, tp, fp, true_count - tp - passed, _samples(detections, thresholds, true_count), true_count
    )


def _samples(detections: ScoredDetections, thresholds: Float64Array, true_count: int) -> Int64Array:
    """The thresholds whose recalls are nearest to 0, 1/40, …, 1.

    Source: the development kit of KITTI's object benchmark, `getThresholds`; Simonelli et al. 2019 for 40 recalls.
    """
    matches = surest_matches(detections)
    right = (matches >= 0) & ~detections.found_ignored
    right[right] = ~detections.true_ignored[matches[right]]
    scores = np.sort(detections.scores[right])[::-1]
    chosen, recall = [], 0.0
    for k, score in enumerate(scores.tolist()):
        here, after = (k + 1) / true_count, (k + 2) / true_count
        if k + 1 < len(scores) and after - recall < recall - here:
            continue
        chosen.append(score)
        recall += 1.0 / (SAMPLES - 1)
    return np.searchsorted(-thresholds, -np.array(chosen)).astype(np.int64)


def surest_matches(detections: ScoredDetections) -> Int64Array:
    """The true object of each detection, (N,) int64, -1 for none; of several the surest one has it."""
    return detection_scores.surest_matches(
        detections.overlaps, *detections.pairs.locations, detections.scores, detections.least_overlap
    )
