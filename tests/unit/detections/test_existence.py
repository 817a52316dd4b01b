"""Existence, against counting all that can happen."""

import numpy as np
import pytest

from sceneloom.detections.detectors import find_detectors, independent_detectors
from sceneloom.detections.settings import existence_table
from sceneloom.kernels import existence
from sceneloom.scene.detections import ScoreForm

PRIOR = 0.15
SAYS_IF_THERE = {0: 0.1, 1: 0.3, 2: 0.6}
SAYS_IF_NOT = {0: 0.9, 1: 0.08, 2: 0.02}
"""A detector that says nothing (0) or reports a box with one of two scores, and how often it does."""


def share_true(*stated):
    """Of all locations at which two such detectors state this, the share that holds an object."""
    there, not_there = PRIOR, 1 - PRIOR
    for what in stated:
        there *= SAYS_IF_THERE[what]
        not_there *= SAYS_IF_NOT[what]
    return there / (there + not_there)


DETECTORS = independent_detectors(prior=PRIOR, recall_2d=1 - SAYS_IF_THERE[0], recall_3d=1 - SAYS_IF_THERE[0])
TABLE = existence_table(DETECTORS)
CAR = np.zeros(1, np.int64)
OUTLINE = np.array([[10.0, 20, 110, 120]])


def reported(score, form=ScoreForm.PROBABILITY, *, of_image=False):
    logit = form is ScoreForm.LOGIT
    return existence.reported_odds(np.array([score]), CAR, logit, of_image, CAR, TABLE)


def exists(of_sweep, of_image=None, *, seen_share=1.0):
    """How likely the object of a box of a sweep is, with a partner in the image or without."""
    partners, others = (CAR - 1, CAR * 0.0) if of_image is None else (CAR, of_image[0])
    shares = np.array([seen_share])
    return existence.scores_of_sweep(
        OUTLINE, shares, partners, of_sweep[0], of_sweep[1], OUTLINE, others, CAR, TABLE
    )[0]


@pytest.mark.parametrize("first", [1, 2])
@pytest.mark.parametrize("second", [1, 2])
def test_two_reports_are_worth_what_counting_says(first, second):
    both = exists(reported(share_true(first)), reported(share_true(second)))
    assert both == pytest.approx(share_true(first, second), rel=1e-12)


def test_a_report_that_the_other_detector_does_not_share_is_worth_what_counting_says():
    # where nothing is, silence is taken for certain; here it is so in 0.9 of the cases
    odds = share_true(2, 0) / (1 - share_true(2, 0)) * SAYS_IF_NOT[0]
    assert exists(reported(share_true(2))) == pytest.approx(odds / (1 + odds), rel=1e-12)
    of_image = existence.scores_of_image(CAR, np.array([20.0]), reported(share_true(2))[1], CAR, TABLE)
    assert of_image[0] == pytest.approx(odds / (1 + odds), rel=1e-12)


def test_what_cannot_be_seen_is_not_missed():
    assert exists(reported(0.7), seen_share=0.0) == pytest.approx(0.7, rel=1e-12)
    far = existence.scores_of_image(CAR, np.array([71.0]), reported(0.7)[1], CAR, TABLE)
    assert far[0] == pytest.approx(0.7, rel=1e-12)


def test_logits_are_logarithms_of_odds():
    np.testing.assert_allclose(reported(np.log(3.0), ScoreForm.LOGIT), reported(0.75), rtol=1e-12)
    np.testing.assert_allclose(reported(0.75), [[np.log(3.0)], [np.log(3.0)], [0.75]], rtol=1e-12)


@pytest.mark.parametrize("form", list(ScoreForm))
def test_a_score_that_is_no_number_leaves_what_the_other_detector_says(form):
    assert exists(reported(np.nan, form), reported(0.7)) == pytest.approx(0.7, rel=1e-12)


@pytest.mark.parametrize(("one", "other"), [(0.0, 1.0), (1.0, 1.0), (np.inf, 0.0), (-5.0, 7.0)])
def test_the_surest_scores_give_a_probability(one, other):
    assert 0.0 <= exists(reported(one), reported(other)) <= 1.0


FITTED = find_detectors("simulated")
CAR_NUMBERS = FITTED.classes["car"]
FITTED_TABLE = existence_table(FITTED)


def logistic(odds):
    return 1 / (1 + np.exp(-odds))


def scores_without_boxes(count):
    """How likely sure objects of a sweep are, of which so many have no box in the image, all of them plain to see."""
    kinds = np.zeros(count, np.int64)
    reported_3d, odds, _ = existence.reported_odds(
        np.full(count, 5.0), np.arange(count), True, False, kinds, FITTED_TABLE
    )
    outlines, none = np.tile(OUTLINE, (count, 1)), np.zeros((0, 4))
    return existence.scores_of_sweep(
        outlines, np.ones(count), kinds - 1, reported_3d, odds, none, np.zeros(0), kinds, FITTED_TABLE
    )


def test_a_fitted_pair_has_the_odds_that_the_formula_says():
    score_3d, score_2d, (low, high) = 1.5, 0.8, (CAR_NUMBERS.image.low, CAR_NUMBERS.image.high)
    reported_3d = existence.reported_odds(np.array([score_3d]), CAR, True, False, CAR, FITTED_TABLE)
    reported_2d = existence.reported_odds(np.array([score_2d]), CAR, False, True, CAR, FITTED_TABLE)
    # half as wide as the outline: an overlap of one half
    partner = OUTLINE - np.array([[0.0, 0, 50, 0]])
    found = existence.scores_of_sweep(
        OUTLINE, np.ones(1), CAR, reported_3d[0], reported_3d[1], partner, reported_2d[0], CAR, FITTED_TABLE
    )
    both = CAR_NUMBERS.both
    of_image = np.clip(np.log(score_2d / (1 - score_2d)), low, high)
    odds = both.base + both.sweep * score_3d + both.image * of_image + both.overlap * (0.5 - 0.7)
    assert found[0] == pytest.approx(logistic(odds), rel=1e-9)


def test_a_single_box_that_the_image_lacks_has_the_odds_of_a_camera_that_is_good_or_poor():
    reported, visibility = CAR_NUMBERS.sweep, CAR_NUMBERS.visibility
    recall = (
        1 - visibility.weak_share
    ) * visibility.recall_2d + visibility.weak_share * visibility.weak_recall_2d
    odds = reported.base + reported.slope * 5.0 + np.log(1 - recall)
    assert scores_without_boxes(1)[0] == pytest.approx(logistic(odds), rel=1e-9)


def test_an_image_that_lacks_all_sure_objects_is_believed_less():
    alone, together = scores_without_boxes(1)[0], scores_without_boxes(6)
    assert (together > alone).all()
    reported, visibility = CAR_NUMBERS.sweep, CAR_NUMBERS.visibility
    # it is as good as certain that such a camera is the poor one
    poor = logistic(reported.base + reported.slope * 5.0 + np.log(1 - visibility.weak_recall_2d))
    assert together[0] == pytest.approx(poor, abs=0.02)
