"""Existence, against counting all that can happen."""

import numpy as np
import pytest

from sceneloom.detections import existence
from sceneloom.scene.detections import ScoreForm

PRIOR = 0.15
SAYS_IF_THERE = {0: 0.1, 1: 0.3, 2: 0.6}
SAYS_IF_NOT = {0: 0.9, 1: 0.08, 2: 0.02}
"""A detector that says nothing (0) or reports a box with one of two scores, and how often it does."""


def share_true(*said):
    """Of all places at which two such detectors say this, the share that holds an object."""
    there, not_there = PRIOR, 1 - PRIOR
    for what in said:
        there *= SAYS_IF_THERE[what]
        not_there *= SAYS_IF_NOT[what]
    return there / (there + not_there)


def odds_of(score, form=ScoreForm.PROBABILITY):
    return existence.log_odds(np.array([score]), form, prior=PRIOR)


@pytest.mark.parametrize("first", [1, 2])
@pytest.mark.parametrize("second", [1, 2])
def test_two_reports_are_worth_what_counting_says(first, second):
    both = existence.agreed(odds_of(share_true(first)), odds_of(share_true(second)), prior=PRIOR)
    assert existence.probabilities(both)[0] == pytest.approx(share_true(first, second), rel=1e-12)


def test_a_report_that_the_other_detector_does_not_share_is_worth_what_counting_says():
    odds = existence.missed(odds_of(share_true(2)), np.array([1 - SAYS_IF_THERE[0]]))
    # where nothing is, silence is taken for certain; here it is so in 0.9 of the cases
    expected = share_true(2, 0) / (1 - share_true(2, 0)) * SAYS_IF_NOT[0]
    assert np.exp(odds[0]) == pytest.approx(expected, rel=1e-12)


def test_logits_are_logarithms_of_odds():
    assert odds_of(np.log(3.0), ScoreForm.LOGIT)[0] == pytest.approx(odds_of(0.75)[0], rel=1e-12)


@pytest.mark.parametrize("form", list(ScoreForm))
def test_a_score_that_is_no_number_leaves_what_the_other_detector_says(form):
    both = existence.agreed(odds_of(np.nan, form), odds_of(0.7), prior=PRIOR)
    assert existence.probabilities(both)[0] == pytest.approx(0.7, rel=1e-12)


@pytest.mark.parametrize(("one", "other"), [(0.0, 1.0), (1.0, 1.0), (np.inf, 0.0), (-5.0, 7.0)])
def test_the_surest_scores_give_a_probability(one, other):
    shares = existence.probabilities(existence.agreed(odds_of(one), odds_of(other), prior=PRIOR))
    assert 0.0 <= shares[0] <= 1.0
