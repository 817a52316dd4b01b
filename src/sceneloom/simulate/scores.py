"""Scores that mean what they state: of all boxes with the score s, the share s is true.

How it is done. Detector and street together expect, over the frames that are looked at, p_m true boxes of object m
(its chance to be found) and F false ones. The false ones are dealt out to the objects, f_m to object m, more to those
that are hard to find: a false box looks like a poor observation. So among the boxes that look like object m the share

    π_m = p_m / (p_m + f_m)

is true. Let the scores of all these together be spread as g = Beta(κ π_m, κ (1 - π_m)), whose mean is π_m, and draw

    true boxes from  s g(s) / π_m              = Beta(κ π_m + 1, κ (1 - π_m)),
    false ones from  (1 - s) g(s) / (1 - π_m)  = Beta(κ π_m, κ (1 - π_m) + 1).

Bayes then gives P(true | s) = π_m s g / π_m / (s g + (1 - s) g) = s for every object, hence for all boxes together.
The concentration κ says how little a score reports: towards 0 all are 0 or 1, and far above 1 all are π_m.
Duplicates count as false: object m bears r p_m more of them, where r boxes are repeated.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.errors import OptionError
from sceneloom.scene.detections import ScoreForm
from sceneloom.simulate.bounds import check_bounds

_SMALLEST = 1e-9
"""Scores keep this far from 0 and 1, so that their logits are finite."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoreSpec:
    """How a detector reports how sure it is.

    Attributes:
        concentration: κ above 0; the larger, the less a score reports true from false.
        likeness: above 0; how much the false boxes look like objects that are easy to find: a sure one draws this
            share of them, against 1 + this for one that is never found.
        form: probabilities, or logits: ln(s / (1 - s)).
        logit_scale, logit_shift: logits come as scale · logit + shift; any but 1 and 0 are not calibrated.

    Raises:
        OptionError: a number is out of bounds.
    """

    concentration: float = 2.0
    likeness: float = 0.2
    form: ScoreForm = ScoreForm.PROBABILITY
    logit_scale: float = 1.0
    logit_shift: float = 0.0

    def __post_init__(self) -> None:
        bounds = (
            ("concentration", self.concentration, 0.01, 1e4),
            ("likeness", self.likeness, 1e-3, 1e3),
            ("logit_scale", self.logit_scale, 1e-3, 1e3),
            ("logit_shift", self.logit_shift, -1e3, 1e3),
        )
        check_bounds("scores", bounds)
        if self.form == ScoreForm.PROBABILITY and (self.logit_scale, self.logit_shift) != (1.0, 0.0):
            raise OptionError(
                "scores: logit_scale and logit_shift are for logits; set form to ScoreForm.LOGIT"
            )


class LooksLike(NamedTuple):
    """What the boxes of one class look like.

    Attributes:
        true_shares: (M,) float64, π_m: share of the boxes looking like object m that are true.
        false_shares: (M,) float64, share of the false boxes that look like object m; they sum to 1.
    """

    true_shares: Float64Array
    false_shares: Float64Array


def deal_out(
    chances: Float64Array, false_count: float, *, repeated: float = 0.0, likeness: float = 0.2
) -> LooksLike:
    """Deal the expected false boxes of a class out to its objects.

    Args:
        chances: (M,) float64, 0 to 1: chance of each object in each frame to be found.
        false_count: how many false boxes are expected in all these frames.
        repeated: how many duplicates a true box has.
        likeness: as in `ScoreSpec`.
    """
    lent = 1.0 + likeness - chances
    false_shares = lent / max(float(lent.sum()), _SMALLEST)
    expected = chances * (1.0 + repeated) + false_count * false_shares
    true_shares = chances / np.maximum(expected, np.finfo(np.float64).tiny)
    return LooksLike(true_shares, false_shares)


def draw_scores(
    generator: np.random.Generator, true_shares: Float64Array, true: BoolArray, spec: ScoreSpec
) -> Float64Array:
    """Draw the score of each box.

    Args:
        generator: where the numbers come from.
        true_shares: (N,) float64, π of what each box looks like.
        true: (N,) bool, whether it is true.
        spec: concentration and form of the scores.

    Returns:
        (N,) float64, in the form that the spec asks for.
    """
    a = spec.concentration * true_shares + true
    b = spec.concentration * (1.0 - true_shares) + ~true
    scores = np.clip(
        generator.beta(np.maximum(a, _SMALLEST), np.maximum(b, _SMALLEST)), _SMALLEST, 1.0 - _SMALLEST
    )
    if spec.form == ScoreForm.PROBABILITY:
        return scores
    logits: Float64Array = spec.logit_scale * np.log(scores / (1.0 - scores)) + spec.logit_shift
    return logits
