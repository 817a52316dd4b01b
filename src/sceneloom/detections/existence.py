r"""How likely it is that an object exists which one detector or both report.

A place where a detector could report something holds an object (e) with the prior probability π. A score is what it
says: of the boxes with the score s the share s is true. By Bayes' theorem a box with the score s has told

    P(box, s | e) / P(box, s | not e) = [s / (1 - s)] / [π / (1 - π)].

Given what is there, detectors err independently of one another, so the ratios of both multiply:

    odds(e | both) = odds(s_3d) odds(s_2d) / odds(π).

Two false boxes seldom fall on one place: the smaller π, the more an agreement says. A detector that had to see the
object and reports nothing tells too, with its chance D to find what is there:

    odds(e | box, none) = odds(s) (1 - D),

since where nothing is, it was all but certain to report nothing. D falls with what the sensor can see of it.

Source: Bayes' theorem under conditional independence: Chen et al. 2022, "Multimodal Object Detection via Probabilistic
Ensembling", eq. 4 for the agreement; Thrun, Burgard and Fox 2005, "Probabilistic Robotics", ch. 4.2 for log odds.
"""

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.scene.detections import ScoreForm

_SUREST = 1e-6
"""No detector is surer than this of what is there or not: two of them could not contradict each other."""
_LIMIT = float(np.log((1.0 - _SUREST) / _SUREST))


def log_odds(scores: Float64Array, form: ScoreForm, *, prior: float) -> Float64Array:
    """Give scores as logarithms of odds; one that is no number tells nothing, and leaves the prior.

    Args:
        scores: (N,) float64.
        form: what they are.
        prior: of what a score that is no number says.
    """
    if form is ScoreForm.LOGIT:
        odds = np.minimum(np.maximum(scores, -_LIMIT), _LIMIT)
    else:
        shares = np.minimum(np.maximum(scores, _SUREST), 1.0 - _SUREST)
        odds = np.log(shares / (1.0 - shares))
    known: Float64Array = np.where(np.isnan(scores), np.log(prior / (1.0 - prior)), odds)
    return known


def probabilities(odds: Float64Array) -> Float64Array:
    """Give logarithms of odds as probabilities."""
    shares: Float64Array = 1.0 / (1.0 + np.exp(-odds))
    return shares


def agreed(odds_3d: Float64Array, odds_2d: Float64Array, *, prior: float) -> Float64Array:
    """Logarithms of odds of objects that both detectors report."""
    return odds_3d + odds_2d - float(np.log(prior / (1.0 - prior)))


def missed(odds: Float64Array, chances: Float64Array) -> Float64Array:
    """Logarithms of odds of objects that one detector reports, and the other one had these chances to find."""
    return odds + np.log1p(-chances)
