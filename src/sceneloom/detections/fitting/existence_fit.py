"""What scores come to, fitted: logistic functions of few numbers that start from what is plausible."""

import itertools

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.detections.detectors import Agreement, Reported, Visibility
from sceneloom.detections.fitting.examples import IGNORED, ImageColumns, SweepColumns
from sceneloom.detections.fitting.regression import fit_odds
from sceneloom.kernels.existence_probability import USUAL_OVERLAP

_LOWEST = 0.001
"""Scores are held above those of so few true boxes, the lowest of which report few."""
_SURE, _SURE_ENDS = 0.99, (0.65, 0.99)
"""Scores are held from where on so many are true: nothing is known of the slope there. That is not below and not above
the scores of these shares of the true boxes."""
SUREST_2D = 5.0
"""Probabilities of images are held at 0.993: what is surer says how they were rounded."""
_AGREEMENT, _AGREEMENT_WEIGHTS = (1.0, 0.5, 0.2, 2.0), (30.0, 300.0, 1000.0, 300.0)
"""What boxes of both come to where data state nothing, and as how many examples' worth that counts: half the slope of a
calibrated score, since what one detector takes for an object misleads the other one, too."""
_HEIGHTS_PX = ((10.0, 20.0), (15.0, 25.0), (20.0, 35.0), (25.0, 50.0))
_SEEN_SHARES = (0.1, 0.25, 0.5, 1.0)
_FLOOR = 0.03
"""What an image shows nothing of is found by chance."""
_PRIOR = 0.1
_SUREST_RECALL = 0.98
"""No detector is taken to find a larger share than this: the next drive has another light."""
_OPEN = 0.5


def fit_reported(reported: Float64Array, verdicts: Int64Array, *, highest: float = np.inf) -> Reported:
    """Fit what the scores of one detector come to, with or without a box of the other one."""
    rows = (verdicts != IGNORED) & np.isfinite(reported)
    came_true = verdicts[rows] == 1
    if not came_true.any():
        return Reported(low=0.0, high=0.0, base=float(np.log(_PRIOR / (1.0 - _PRIOR))), slope=0.0)
    low, high = np.minimum(_ends(reported[rows], came_true), highest).tolist()
    held = np.clip(reported[rows], low, high)
    base, slope = fit_odds(
        np.column_stack([np.ones(len(held)), held]),
        came_true,
        expected=np.array([0.0, 1.0]),
        weights=np.array([1e-2, 1.0]),
    )
    return Reported(low=low, high=high, base=float(base), slope=float(slope))


def _ends(reported: Float64Array, came_true: BoolArray) -> tuple[float, float]:
    """Between which scores are held."""
    low, least, most = np.quantile(reported[came_true], (_LOWEST, *_SURE_ENDS)).tolist()
    order = np.argsort(-reported, kind="stable")
    shares = np.cumsum(came_true[order]) / np.arange(1, len(order) + 1)
    sure = np.flatnonzero(shares >= _SURE)
    high = reported[order[sure[-1]]] if len(sure) else most
    return low, max(float(np.clip(high, least, most)), low)


def fit_agreement(columns: SweepColumns, of_sweep: Reported, of_image: Reported) -> Agreement:
    """Fit what two boxes of one object come to."""
    rows = columns.matched & (columns.verdict != IGNORED)
    rows &= np.isfinite(columns.reported) & np.isfinite(columns.partner_reported)
    features = np.column_stack(
        [
            np.ones(int(rows.sum())),
            np.clip(columns.reported[rows], of_sweep.low, of_sweep.high),
            np.clip(columns.partner_reported[rows], of_image.low, of_image.high),
            columns.overlap[rows] - USUAL_OVERLAP,
        ]
    )
    found = fit_odds(
        features,
        columns.verdict[rows] == 1,
        expected=np.array(_AGREEMENT),
        weights=np.array(_AGREEMENT_WEIGHTS),
    )
    base, sweep, image, overlap = found.tolist()
    return Agreement(base=base, sweep=sweep, image=image, overlap=overlap)


def fit_visibility(
    columns: SweepColumns, image: ImageColumns, *, weak_recall_2d: float, weak_share: float
) -> Visibility:
    """Fit what detectors find: of the objects of one, the share of which the other one has a box."""
    true = columns.verdict == 1
    found, heights, shares = columns.matched[true], columns.height[true], columns.seen[true]
    best, visibility = -np.inf, (_HEIGHTS_PX[0], _SEEN_SHARES[0], 0.5)
    for (low, high), seen in itertools.product(_HEIGHTS_PX, _SEEN_SHARES):
        openness = np.clip((heights - low) / (high - low), 0.0, 1.0) * np.minimum(shares / seen, 1.0)
        plain = openness > _OPEN
        recall = min((found[plain].sum() + 1.0) / (plain.sum() + 2.0), _SUREST_RECALL)
        chances = np.maximum(recall * openness, _FLOOR)
        likelihood = np.log(np.where(found, chances, 1.0 - chances)).sum()
        if likelihood > best:
            best, visibility = likelihood, ((low, high), seen, float(recall))
    reported = image.verdict == 1
    recall_3d = min(float((image.matched[reported].sum() + 1.0) / (reported.sum() + 2.0)), _SUREST_RECALL)
    return Visibility(
        recall_2d=visibility[2],
        recall_3d=recall_3d,
        weak_recall_2d=min(weak_recall_2d, visibility[2]),
        weak_share=weak_share,
        heights_px=visibility[0],
        seen_share=visibility[1],
        prior=_PRIOR,
    )
