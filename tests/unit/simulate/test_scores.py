import numpy as np
import pytest
from scipy.stats import beta, kstest

from sceneloom.errors import OptionError
from sceneloom.scene import ScoreForm
from sceneloom.simulate.detectors import ScoreSpec, deal_out, draw_scores


def draw_boxes(seed, *, frames=4000, false_rate=0.6, repeated=0.0, **spec):
    """Find the same six objects in many frames, with false boxes and duplicates: scores and what is true."""
    generator = np.random.default_rng(seed)
    chances = np.array([0.98, 0.95, 0.8, 0.5, 0.2, 0.03])
    looks = deal_out(np.tile(chances, frames), frames * false_rate, repeated=repeated)
    found = generator.random(6 * frames) < np.tile(chances, frames)
    again = found & (generator.random(6 * frames) < repeated)
    false = generator.choice(6 * frames, generator.poisson(frames * false_rate), p=looks.false_shares)
    alike = np.concatenate([np.flatnonzero(found), np.flatnonzero(again), false])
    true = np.arange(len(alike)) < found.sum()
    return draw_scores(generator, looks.true_shares[alike], true, ScoreSpec(**spec)), true


def calibration_error(scores, true, bins=15):
    """Expected calibration error: mean over equal bins of |share of true - mean score|, weighed by their boxes."""
    which = np.minimum((scores * bins).astype(int), bins - 1)
    gaps = [
        (which == k).sum() * abs(true[which == k].mean() - scores[which == k].mean())
        for k in range(bins)
        if (which == k).any()
    ]
    return sum(gaps) / len(scores)


@pytest.mark.parametrize("concentration", [0.3, 1.0, 5.0])
@pytest.mark.parametrize("repeated", [0.0, 0.3])
def test_of_all_boxes_with_a_score_that_share_is_true(concentration, repeated):
    scores, true = draw_boxes(3, concentration=concentration, repeated=repeated)
    assert len(scores) > 15_000
    # With 16,000 boxes in 15 bins chance alone gives about 0.006.
    assert calibration_error(scores, true) < 0.012
    # Each bin is a binomial of its scores: the sum of squared normalised gaps is a chi-square of 15; 38 is its 99.9 %.
    which = np.minimum((scores * 15).astype(int), 14)
    squares = [
        (true[which == k].sum() - scores[which == k].sum()) ** 2
        / max((scores[which == k] * (1 - scores[which == k])).sum(), 1e-9)
        for k in range(15)
    ]
    assert sum(squares) < 38


def test_scores_that_do_not_know_the_rates_would_be_noticed():
    scores, true = draw_boxes(3)
    odds = scores / (1 - scores) * 3
    assert calibration_error(odds / (1 + odds), true) > 0.03


def test_scores_report_less_the_more_they_are_concentrated():
    areas = []
    for concentration in (0.3, 1.0, 5.0):
        scores, true = draw_boxes(8, frames=500, concentration=concentration)
        areas.append((scores[true][:2000, None] > scores[~true][None, :1000]).mean())
    assert areas == sorted(areas, reverse=True)
    assert areas[0] - areas[2] > 0.01


def test_drawn_scores_are_spread_as_the_derivation_says():
    generator = np.random.default_rng(2)
    share, kappa, count = 0.7, 2.5, 20_000
    for true, shape in ((True, (kappa * 0.7 + 1, kappa * 0.3)), (False, (kappa * 0.7, kappa * 0.3 + 1))):
        scores = draw_scores(
            generator, np.full(count, share), np.full(count, true), ScoreSpec(concentration=kappa)
        )
        assert kstest(scores, beta(*shape).cdf).pvalue > 1e-3


def test_the_dealt_out_boxes_are_all_boxes():
    chances = np.array([0.9, 0.4, 0.01])
    looks = deal_out(chances, 1.7, repeated=0.25)
    assert looks.false_shares.sum() == pytest.approx(1.0)
    everything = chances / looks.true_shares
    assert everything.sum() == pytest.approx(chances.sum() * 1.25 + 1.7)
    assert (np.diff(looks.true_shares) < 0).all()
    np.testing.assert_allclose(deal_out(chances, 0.0).true_shares, 1.0)


def test_logits_are_the_same_scores_in_another_form():
    share, true = np.full(500, 0.6), np.arange(500) % 2 == 0
    plain, logits, warped = (
        draw_scores(np.random.default_rng(1), share, true, spec)
        for spec in (
            ScoreSpec(),
            ScoreSpec(form=ScoreForm.LOGIT),
            ScoreSpec(form=ScoreForm.LOGIT, logit_scale=2.0, logit_shift=-1.0),
        )
    )
    np.testing.assert_allclose(1 / (1 + np.exp(-logits)), plain, rtol=1e-7)
    np.testing.assert_allclose(warped, 2 * logits - 1)
    assert np.abs(logits).max() > 1.5


def test_the_form_can_be_given_by_its_word():
    drawn = [
        draw_scores(np.random.default_rng(1), np.full(9, 0.6), np.full(9, True), ScoreSpec(form=form))
        for form in (ScoreForm.PROBABILITY, "probability")
    ]
    np.testing.assert_array_equal(*drawn)


def test_what_is_never_found_looks_false_and_nothing_else_changes():
    shares = deal_out(np.array([0.0, 0.5]), 0.0).true_shares
    np.testing.assert_array_equal(shares, [0.0, 1.0])


@pytest.mark.parametrize(
    "wrong",
    [
        {"concentration": 0.0},
        {"form": ScoreForm.LOGIT, "logit_scale": 0.0},
        {"form": ScoreForm.LOGIT, "logit_shift": float("nan")},
        {"logit_shift": 1.0},
    ],
)
def test_score_numbers_out_of_bounds_are_refused(wrong):
    with pytest.raises(OptionError, match="scores"):
        ScoreSpec(**wrong)
