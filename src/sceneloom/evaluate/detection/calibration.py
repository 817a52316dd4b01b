"""Whether scores are what they state: of the detections with a score of 0.8, are 80 % true?"""

from itertools import pairwise

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Float64Array

BINS = 15
"""Bins of equal width into which scores are sorted. Source: Guo et al. 2017, "On Calibration of Modern Networks"."""


class ReliabilityBin(msgspec.Struct, frozen=True, kw_only=True):
    """The detections with scores of one bin.

    Attributes:
        low, high: its bounds.
        count: how many detections it has.
        mean_score: what they state on the average, None of an empty bin.
        share_true: how many are true, of all, None of an empty bin.
    """

    low: float
    high: float
    count: int
    mean_score: float | None
    share_true: float | None


class Calibration(msgspec.Struct, frozen=True, kw_only=True):
    """How true scores are as probabilities.

    Attributes:
        count: detections that are either true or false.
        error: expected calibration error: |mean score - share true| of the bins, weighted by their detections.
        largest_error: of a bin with at least 1 % of the detections.
        brier: mean square of score - (1 for true ones, 0 for false ones).
        bins: of equal width.
    """

    count: int
    error: float
    largest_error: float
    brier: float
    bins: tuple[ReliabilityBin, ...]


def judge_calibration(
    probabilities: Float64Array, are_true: BoolArray, *, bin_count: int = BINS
) -> Calibration:
    """Hold scores against what came true.

    Args:
        probabilities: (N,), 0 to 1, N >= 1.
        are_true: (N,).
        bin_count: how many bins of equal width.
    """
    edges = np.linspace(0.0, 1.0, bin_count + 1)
    locations = np.clip(np.searchsorted(edges, probabilities, side="right") - 1, 0, bin_count - 1)
    counts = np.bincount(locations, minlength=bin_count)
    stated = np.bincount(locations, weights=probabilities, minlength=bin_count)
    came = np.bincount(locations, weights=are_true.astype(np.float64), minlength=bin_count)
    gaps = np.abs(stated - came)
    large = counts >= max(1.0, 0.01 * len(probabilities))
    return Calibration(
        count=len(probabilities),
        error=float(gaps.sum() / len(probabilities)),
        largest_error=float((gaps[large] / counts[large]).max()),
        brier=float(((probabilities - are_true) ** 2).mean()),
        bins=tuple(
            ReliabilityBin(
                low=low,
                high=high,
                count=count,
                mean_score=mean / count if count else None,
                share_true=true / count if count else None,
            )
            for (low, high), count, mean, true in zip(
                pairwise(edges.tolist()), counts.tolist(), stated.tolist(), came.tolist(), strict=True
            )
        ),
    )
