"""Numbers of detectors, fitted to examples whose numbers are known."""

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.detections import DetectionPair, fitting
from sceneloom.detections.projection import fuse_by_projection
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.detections import Boxes2D, Boxes3D, ScoreForm

CAMERA = Camera("pinhole", 1000, 600, 500.0, 500.0, 499.5, 299.5)
CAMERA_FROM_LIDAR = RigidTransform(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3))
CAR = np.array([4.2, 1.8, 1.5])
SIGMAS = np.array([0.3, 0.1, 0.08])
RECALL_2D = 0.8


def test_odds_and_deviations_are_found_again_stay_finite_and_never_fall():
    generator = np.random.default_rng(0)
    features = np.column_stack([np.ones(4000), generator.normal(size=4000)])
    true = generator.random(4000) < 1 / (1 + np.exp(-(0.5 + 1.2 * features[:, 1])))
    found = fitting.fit_odds(features, true, expected=np.zeros(2), weights=np.full(2, 1e-6))
    # the slope of 4000 examples is known to 0.05
    np.testing.assert_allclose(found, [0.5, 1.2], atol=0.15)
    features = np.column_stack([np.ones(50), np.linspace(-1, 1, 50)])
    always = fitting.fit_odds(features, np.ones(50, np.bool_), expected=np.zeros(2), weights=np.ones(2))
    assert np.isfinite(always).all()
    falling = fitting.fit_odds(features, features[:, 1] < 0, expected=np.zeros(2), weights=np.ones(2))
    assert falling[1] == 0.0
    generator = np.random.default_rng(1)
    features = np.column_stack([np.ones(5000), generator.uniform(-1, 1, 5000)])
    sigmas = np.exp(features @ np.array([[-1.0, -2.0], [0.5, -0.3]]))
    errors = sigmas * generator.normal(size=(5000, 2))
    errors[:25] = 100.0
    found = fitting.fit_deviations(features, errors, weights=np.ones(5000), degrees_of_freedom=5.0)
    # a Student's scale is smaller than the deviation of the Gaussian that it is fitted to, by 15 % at the most
    np.testing.assert_allclose(found[:, 0], [-1.0, -2.0], atol=0.2)
    np.testing.assert_allclose(found[:, 1], [0.5, -0.3], atol=0.1)


def reported_and_verdicts(slope, base):
    """Scores, and boxes of which as many are true as a logistic function says."""
    generator = np.random.default_rng(3)
    reported = generator.normal(2.0, 3.0, 20_000)
    return reported, (generator.random(20_000) < 1 / (1 + np.exp(-(base + slope * reported)))).astype(np.int64)


def test_scores_are_held_from_where_on_nearly_all_boxes_are_true():
    reported, verdicts = reported_and_verdicts(1.0, -2.0)
    high = fitting.fit_reported(reported, verdicts).high
    low, most = np.quantile(reported[verdicts == 1], (0.65, 0.99))
    assert low + 0.3 < high < most - 0.3
    # the share of true ones above a score rises with it
    assert verdicts[reported >= high].mean() == pytest.approx(0.99, abs=1e-3)
    for slope, base, share in [(1.0, 4.0, 0.65), (0.0, 0.5, 0.99)]:
        reported, verdicts = reported_and_verdicts(slope, base)
        assert fitting.fit_reported(reported, verdicts).high == pytest.approx(
            np.quantile(reported[verdicts == 1], share)
        )


def outline(center):
    corners = np.array([center + CAR / 2 * [i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    u, v = 500.0 - 500.0 * corners[:, 1] / corners[:, 0], 300.0 - 500.0 * corners[:, 2] / corners[:, 0]
    return [u.min(), v.min(), u.max(), v.max()]


def example(seed):
    """Six cars seen by both, of which the camera misses some, and three false boxes of the sweep."""
    generator = np.random.default_rng(seed)
    locations = np.column_stack([generator.uniform(15, 45, 6), np.linspace(-10, 10, 6), np.full(6, -1.0)])
    false = locations[:3] + np.array([0.0, 2.0, 6.0])
    centers = np.vstack([locations + SIGMAS * generator.normal(size=(6, 3)), false])
    # the logarithm of the odds is twice as sure as it should be: 2 x, of which half is true
    scores = np.concatenate([generator.normal(3.0, 2.0, 6), generator.normal(-3.0, 2.0, 3)])
    three = Boxes3D(0, centers, np.tile(CAR, (9, 1)), np.zeros(9), scores, ("Car",) * 9, score_form=ScoreForm.LOGIT)
    shown = np.array([outline(location) for location in locations]) + generator.normal(size=(6, 4))
    kept = generator.random(6) < RECALL_2D
    two = Boxes2D(0, shown[kept], np.full(int(kept.sum()), 0.9), ("car",) * int(kept.sum()))
    truth = Boxes3D(0, locations, np.tile(CAR, (6, 1)), np.zeros(6), np.ones(6), ("Car",) * 6)
    pair = DetectionPair(three, two, CAMERA, CAMERA_FROM_LIDAR)
    return fitting.LabelledPair(pair, truth, np.ones(6, bool), np.zeros(6, bool), np.zeros((0, 4)), f"{seed % 5}")


@pytest.fixture(scope="module")
def fitted():
    examples = [example(seed) for seed in range(80)]
    return fitting.fit_detectors(examples, name="made up", settings=fitting.FitSettings(overlap=0.3))


def test_new_boxes_lie_in_the_regions_that_are_promised_and_all_scores_are_probabilities(fitted):
    settings, squares = ProjectionSettings(detectors=fitted), []
    for seed in range(1000, 1060):
        reported = example(seed)
        fused = fuse_by_projection(reported.pair, settings=settings)
        assert ((fused.scores >= 0) & (fused.scores <= 1)).all()
        assert (fused.yaw_variances > 0).all()
        errors, covariances = fused.centers[:6] - reported.truth.centers, fused.center_covariances[:6]
        squares += [error @ np.linalg.solve(own, error) for error, own in zip(errors, covariances, strict=True)]
        assert fused.degrees_of_freedom == fitted.degrees_of_freedom
    # the promise lies between a Student's 9.7 and a Gaussian's 7.8; 360 boxes report 95 % to 1.2 %
    assert 0.92 < np.mean(np.array(squares) < 8.7) < 0.985


def test_what_detectors_find_is_found_again_if_there_is_enough(fitted):
    car = fitted.classes["car"]
    assert (fitted.otherwise, car.visibility.recall_2d) == ("car", pytest.approx(RECALL_2D, abs=0.05))
    assert car.visibility.weak_recall_2d <= car.visibility.recall_2d
    assert car.sweep.slope > 0.3
    with pytest.raises(OptionError, match="expected 200 or more"):
        fitting.fit_detectors([example(0)], name="few")
