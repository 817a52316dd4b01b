"""Detector models: classes, statistics, their files, the tables made of them, and numbers fitted to examples."""

from dataclasses import asdict

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.detections import DetectionPair, fitting, settings
from sceneloom.detections import detectors as det
from sceneloom.detections.detectors import KINDS, independent_detectors, numbers_of, table_rows
from sceneloom.detections.projection import fuse_by_projection, orient_by_motion, says_nothing
from sceneloom.detections.settings import ProjectionSettings, existence_table, find_detectors
from sceneloom.errors import DataError, OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels import existence
from sceneloom.scene.detections import Boxes2D, Boxes3D, ScoreForm


def test_words_are_found_whatever_their_case_and_dashes_and_unknown_ones_are_of_no_family():
    words = {"Car": "car", "Person_sitting": "pedestrian", "BICYCLIST": "cyclist", "Pick-up Truck": "van"}
    assert {word: det.kind_name(word) for word in words} == words
    words = [word for name, kind in KINDS.items() for word in (name, *kind.words)]
    assert len(words) == len(set(words))
    assert says_nothing("Unknown")
    assert says_nothing("")
    assert not says_nothing("dragon")
    three, two = numbers_of(["dragon", "Dragon", "car"], ["DRAGON", "griffin", "van", "Sedan"])
    assert three[0] == three[1] == two[0]
    assert three[0] != two[1]
    assert three[2] == two[3] != two[2]
    rows = table_rows(np.concatenate([three, two]))
    assert rows.tolist() == [det.UNLISTED, det.UNLISTED, 0, det.UNLISTED, det.UNLISTED, list(KINDS).index("van"), 0]
    assert det.FAMILIES[det.UNLISTED] == -1
    assert det.FAMILIES[0] == det.FAMILIES[list(KINDS).index("van")] >= 0
    people, dragons = det.SIZES[table_rows(numbers_of(["Pedestrian", "dragon"], [])[0])]
    assert people[2] == pytest.approx(1.7, abs=0.1)
    assert (dragons[3:] > people[3:]).all()


TEXT = det.format_detectors(independent_detectors())


def flat(value):
    if isinstance(value, dict):
        return [x for inner in value.values() for x in flat(inner)]
    return [x for inner in value for x in flat(inner)] if isinstance(value, tuple) else [value]


@pytest.mark.parametrize("name", det.detector_names())
def test_what_is_written_is_read_again_and_surer_scores_never_make_an_object_less_likely(tmp_path, name):
    detectors, path = find_detectors(name), tmp_path / "mine.toml"
    path.write_text(det.format_detectors(detectors), "utf-8")
    again = find_detectors(str(path))
    for field in ("name", "otherwise", "provenance", "degrees_of_freedom"):
        assert getattr(again, field) == getattr(detectors, field)
    for label, own in detectors.classes.items():
        # five digits are written
        assert flat(asdict(again.classes[label])) == pytest.approx(flat(asdict(own)), rel=1e-4)
        assert min(own.sweep.slope, own.image.slope, own.both.sweep, own.both.image, own.both.overlap) >= 0.0
        assert own.visibility.weak_recall_2d <= own.visibility.recall_2d


def test_wrong_and_absent_files_are_reported_with_their_location_and_the_known_detectors(tmp_path):
    for old, new, location in [
        ('otherwise = "car"', 'otherwise = "cart"', "otherwise: 'cart'"),
        ("prior = 0.1", "prior = 0.0", "classes.car.visibility.prior: 0.0"),
        ("slope = 1.0", "slope = nan", "classes.car.sweep.slope: nan"),
        ("slope = 1.0", "slop = 1.0", "slope"),
        ("degrees_of_freedom = inf", "degrees_of_freedom = 2.0", "degrees_of_freedom: 2.0"),
        ("lasting = [0.4, 0.8]", "lasting = [0.4, -0.8]", "classes.car.noise.lasting: [0.4, -0.8]; expected 0 to 1"),
        ("[provenance]", "[provenance", "expected the TOML of detectors"),
        ("classes.van.", "classes.unicorn.", "classes.unicorn: no known class"),
    ]:
        assert old in TEXT
        path = tmp_path / "wrong.toml"
        path.write_text(TEXT.replace(old, new), "utf-8")
        with pytest.raises(DataError, match=str(path)) as caught:
            settings.read_detectors(path)
        assert location in str(caught.value)
    with pytest.raises(OptionError, match=r"detectors 'kiti'; expected one of .*independent"):
        find_detectors("kiti")
    with pytest.raises(DataError, match=r"none\.toml"):
        find_detectors(str(tmp_path / "none.toml"))


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
    given = OUTLINE, shares, partners, of_sweep[0], of_sweep[1], OUTLINE, others, CAR, TABLE
    return existence.scores_of_sweep(*given)[0]


def test_reports_are_worth_what_counting_says_and_extreme_scores_and_none_leave_probabilities():
    for second in [1, 2]:
        for first in [1, 2]:
            both = exists(reported(share_true(first)), reported(share_true(second)))
            assert both == pytest.approx(share_true(first, second), rel=1e-12)
    # where nothing is, silence is taken for certain; here it is so in 0.9 of the cases
    odds = share_true(2, 0) / (1 - share_true(2, 0)) * SAYS_IF_NOT[0]
    assert exists(reported(share_true(2))) == pytest.approx(odds / (1 + odds), rel=1e-12)
    of_image = existence.scores_of_image(CAR, np.array([20.0]), reported(share_true(2))[1], CAR, TABLE)
    assert of_image[0] == pytest.approx(odds / (1 + odds), rel=1e-12)
    assert exists(reported(0.7), seen_share=0.0) == pytest.approx(0.7, rel=1e-12)
    far = existence.scores_of_image(CAR, np.array([71.0]), reported(0.7)[1], CAR, TABLE)
    assert far[0] == pytest.approx(0.7, rel=1e-12)
    np.testing.assert_allclose(reported(np.log(3.0), ScoreForm.LOGIT), reported(0.75), rtol=1e-12)
    np.testing.assert_allclose(reported(0.75), [[np.log(3.0)], [np.log(3.0)], [0.75]], rtol=1e-12)
    for form in list(ScoreForm):
        assert exists(reported(np.nan, form), reported(0.7)) == pytest.approx(0.7, rel=1e-12)
    for one, other in [(0.0, 1.0), (1.0, 1.0), (np.inf, 0.0), (-5.0, 7.0)]:
        assert 0.0 <= exists(reported(one), reported(other)) <= 1.0


FITTED = find_detectors("simulated")
CAR_NUMBERS = FITTED.classes["car"]
FITTED_TABLE = existence_table(FITTED)


def logistic(odds):
    return 1 / (1 + np.exp(-odds))


def scores_without_boxes(count):
    """How likely sure objects of a sweep are, of which so many have no box in the image, all of them plain to see."""
    kinds = np.zeros(count, np.int64)
    surely = np.full(count, 5.0), np.arange(count), True, False, kinds, FITTED_TABLE
    reported_3d, odds, _ = existence.reported_odds(*surely)
    none = np.zeros((0, 4)), np.zeros(0), kinds, FITTED_TABLE
    outlines = np.tile(OUTLINE, (count, 1))
    return existence.scores_of_sweep(outlines, np.ones(count), kinds - 1, reported_3d, odds, *none)


def test_fitted_pairs_have_the_odds_that_the_formula_says_and_boxes_without_partner_those_of_a_poor_camera_too():
    score_3d, score_2d, (low, high) = 1.5, 0.8, (CAR_NUMBERS.image.low, CAR_NUMBERS.image.high)
    reported_3d = existence.reported_odds(np.array([score_3d]), CAR, True, False, CAR, FITTED_TABLE)
    reported_2d = existence.reported_odds(np.array([score_2d]), CAR, False, True, CAR, FITTED_TABLE)
    # half as wide as the outline: an overlap of one half
    partner = OUTLINE - np.array([[0.0, 0, 50, 0]])
    given = OUTLINE, np.ones(1), CAR, *reported_3d[:2], partner, reported_2d[0], CAR, FITTED_TABLE
    found, both = existence.scores_of_sweep(*given), CAR_NUMBERS.both
    of_image = np.clip(np.log(score_2d / (1 - score_2d)), low, high)
    odds = both.base + both.sweep * score_3d + both.image * of_image + both.overlap * (0.5 - 0.7)
    assert found[0] == pytest.approx(logistic(odds), rel=1e-9)
    reported, visibility = CAR_NUMBERS.sweep, CAR_NUMBERS.visibility
    recall = (1 - visibility.weak_share) * visibility.recall_2d + visibility.weak_share * visibility.weak_recall_2d
    sure, alone, together = reported.base + reported.slope * 5.0, scores_without_boxes(1)[0], scores_without_boxes(6)
    assert alone == pytest.approx(logistic(sure + np.log(1 - recall)), rel=1e-9)
    assert (together > alone).all()
    # it is as good as certain that such a camera is the poor one
    assert together[0] == pytest.approx(logistic(sure + np.log(1 - visibility.weak_recall_2d)), abs=0.02)


NOISE = settings.noise_table(independent_detectors())
YAWS = np.array([0.4, -2.0, 1.0, 0.2])


def covariances_of(reported=None):
    centers = np.array([[30.0, 40.0, 0.0], [0.0, 60.0, 0.0], [5.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    sizes = np.array([[4.0, 2.0, 1.5], [1.0, 0.5, 1.7], [4.0, 2.0, 1.5], [4.0, 2.0, 1.5]])
    reported = np.zeros((0, 7, 7)) if reported is None else reported
    boxes, cars = np.column_stack([centers, sizes, YAWS]), np.zeros(4, np.int64)
    return settings.box_covariances(boxes, np.zeros(4), reported, np.arange(4), cars, NOISE)[0]


def test_deviations_lie_along_the_axes_of_the_box_and_those_reported_count_where_they_are_covariances():
    found, growth = covariances_of()[0], np.sqrt(50 / 20)
    rotation = np.array([[np.cos(0.4), -np.sin(0.4), 0], [np.sin(0.4), np.cos(0.4), 0], [0, 0, 1]])
    size = np.array(KINDS["car"].size_lwh)
    along = np.diag(((det.CENTER_SIGMAS[0] * size + det.CENTER_SIGMAS[1]) * growth) ** 2)
    np.testing.assert_allclose(found[:3, :3], rotation @ along @ rotation.T, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(found[3:, 3:], np.diag(((det.SIZE_SIGMAS[0] * size + det.SIZE_SIGMAS[1]) * growth) ** 2))
    assert not found[:3, 3:].any()
    generator = np.random.default_rng(0)
    factor = generator.normal(size=(7, 7))
    reported = np.array([factor @ factor.T] * 4)
    reported[1, 0, 0] = np.nan
    reported[2, 4, 4] = -1.0
    reported[3] = 0.0
    found, assumed = covariances_of(reported), covariances_of()
    np.testing.assert_allclose(found[0], reported[0, :6, :6], rtol=1e-12)
    np.testing.assert_array_equal(found[1:], assumed[1:])


@pytest.mark.parametrize(
    ("speed", "off_deg", "rotated"),
    [(8.0, 180.0, True), (8.0, 150.0, True), (8.0, 90.0, False), (8.0, 0.0, False), (2.0, 180.0, False)],
)
def test_what_drives_backwards_fast_is_reversed(speed, off_deg, rotated):
    yaw, trajectory = 2.5, 2.5 + np.radians(off_deg)
    velocities = np.array([[speed * np.cos(trajectory), speed * np.sin(trajectory), 0.0]])
    found = orient_by_motion(np.array([yaw]), velocities)[0]
    assert np.cos(found - yaw) == pytest.approx(-1.0 if rotated else 1.0)
    assert -np.pi <= found <= np.pi
    for unknown in (None, np.full((1, 3), np.nan)):
        np.testing.assert_array_equal(orient_by_motion(np.array([yaw]), unknown), [yaw])


CAMERA = Camera("pinhole", 1000, 600, 500.0, 500.0, 499.5, 299.5)
CAMERA_FROM_LIDAR = RigidTransform(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3))
CAR_SIZE = np.array([4.2, 1.8, 1.5])
SIGMAS = np.array([0.3, 0.1, 0.08])
RECALL_2D = 0.8


def test_odds_and_deviations_are_found_again_and_scores_held_from_where_on_nearly_all_boxes_are_true():
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


def reported_and_verdicts(slope, base):
    """Scores, and boxes of which as many are true as a logistic function says."""
    generator = np.random.default_rng(3)
    reported = generator.normal(2.0, 3.0, 20_000)
    return reported, (generator.random(20_000) < 1 / (1 + np.exp(-(base + slope * reported)))).astype(np.int64)


def outline_of(center):
    corners = np.array([center + CAR_SIZE / 2 * [i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
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
    sizes, labels = np.tile(CAR_SIZE, (9, 1)), ("Car",) * 9
    three = Boxes3D(0, centers, sizes, np.zeros(9), scores, labels, score_form=ScoreForm.LOGIT)
    shown = np.array([outline_of(location) for location in locations]) + generator.normal(size=(6, 4))
    kept = generator.random(6) < RECALL_2D
    two = Boxes2D(0, shown[kept], np.full(int(kept.sum()), 0.9), ("car",) * int(kept.sum()))
    truth = Boxes3D(0, locations, sizes[:6], np.zeros(6), np.ones(6), labels[:6])
    pair = DetectionPair(three, two, CAMERA, CAMERA_FROM_LIDAR)
    # people draw boxes 3 % lower than outlines, and 10 % narrower
    boxes = np.array([outline_of(location) for location in locations])
    sides = np.tile(boxes[:, 2:] - boxes[:, :2], 2)
    drawn = boxes + sides * [0.05, 0.03, -0.05, 0.03]
    counts, others, regions = np.ones(6, bool), np.zeros(6, bool), np.zeros((0, 4))
    return fitting.LabelledPair(pair, truth, counts, others, regions, f"{seed % 5}", drawn_xyxy=drawn)


@pytest.fixture(scope="module")
def fitted():
    examples = [example(seed) for seed in range(80)]
    return fitting.fit_detectors(examples, name="made up", settings=fitting.FitSettings(overlap=0.3))


def test_what_errs_alike_in_all_boxes_of_an_object_is_told_from_what_does_not():
    generator = np.random.default_rng(5)
    objects = np.repeat(np.arange(300), 12)
    alike, own = generator.normal(size=(300, 6))[objects], generator.normal(size=(3600, 6))
    shares = np.array([0.2] * 3 + [0.7] * 3)
    errors = np.sqrt(shares) * alike + np.sqrt(1.0 - shares) * own
    rows = np.column_stack([objects % 3, objects, np.tile(np.arange(12) / 10.0, 300)])[::-1]
    assert fitting._lasting(rows, errors[::-1]) == pytest.approx((0.2, 0.7), abs=0.03)
    for column, value in ((1, -1.0), (2, 5.0 * np.arange(3600))):  # no object is known, or none is seen twice a second
        others = rows.copy()
        others[:, column] = value
        assert fitting._lasting(others, errors) == fitting._UNKNOWN.lasting


def test_what_detectors_find_is_found_again_and_new_boxes_lie_in_the_regions_that_are_promised(fitted):
    projection, squares = ProjectionSettings(detectors=fitted), []
    for seed in range(1000, 1060):
        reported = example(seed)
        fused = fuse_by_projection(reported.pair, settings=projection)
        assert ((fused.scores >= 0) & (fused.scores <= 1)).all()
        assert (fused.yaw_variances > 0).all()
        errors, covariances = fused.centers[:6] - reported.truth.centers, fused.center_covariances[:6]
        squares += [error @ np.linalg.solve(own, error) for error, own in zip(errors, covariances, strict=True)]
        assert fused.degrees_of_freedom == fitted.degrees_of_freedom
    # the promise lies between a Student's 9.7 and a Gaussian's 7.8; 360 boxes report 95 % to 1.2 %
    assert 0.92 < np.mean(np.array(squares) < 8.7) < 0.985
    car = fitted.classes["car"]
    assert (fitted.otherwise, car.visibility.recall_2d) == ("car", pytest.approx(RECALL_2D, abs=0.05))
    assert car.visibility.weak_recall_2d <= car.visibility.recall_2d
    assert car.sweep.slope > 0.3
    noise = car.image_noise
    assert noise.usual == pytest.approx([0.0, 0.03, np.log(0.9), 0.0], abs=1e-3)
    assert noise.spread == (0.01,) * 4  # the least there is
    assert 0.03 < noise.error[1] < 0.05  # edges are off by a pixel, too
    assert -np.log(0.9) < noise.error[2] < 0.17
    with pytest.raises(OptionError, match="expected 200 or more"):
        fitting.fit_detectors([example(0)], name="few")
