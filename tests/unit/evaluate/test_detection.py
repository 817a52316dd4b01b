"""Figures of detections: against KITTI's rules written out slowly, against SciPy's distributions, and by hand."""

import numpy as np
import pytest
from scipy import stats

from sceneloom.errors import ArrayError, OptionError
from sceneloom.evaluate import detection as ev
from sceneloom.evaluate.detection import DIFFICULTIES, DetectionRules, judge_covariances
from sceneloom.evaluate.objects import ObjectTable, Similarity

IN_IMAGE = DetectionRules(similarity=Similarity.IMAGE, least_overlap=0.5)


def table(frames, labels, corners, **columns) -> ObjectTable:
    columns = {name: np.asarray(column, float) for name, column in columns.items()}
    frames, corners = np.asarray(frames, np.int64), np.asarray(corners, float).reshape(-1, 4)
    return ObjectTable(frames, np.full(len(frames), -1), tuple(labels), corners, **columns)


def cars_of(found, truth, **options):
    return ev.evaluate_detection({"a": found}, {"a": truth}, classes=("car",), **{"rules": IN_IMAGE, **options})["car"]


def overlap(one, other, *, of_first=False) -> float:
    wide = min(one[2], other[2]) - max(one[0], other[0])
    high = min(one[3], other[3]) - max(one[1], other[1])
    common = max(wide, 0) * max(high, 0)
    first, second = ((box[2] - box[0]) * (box[3] - box[1]) for box in (one, other))
    return common / (first if of_first else first + second - common)


def judged_truth(truth: ObjectTable, label: str, neighbour: str, difficulty) -> list:
    """KITTI's states of true objects: (frame, box, whether it need not be found); others are left out."""
    judged = []
    for k, own in enumerate(truth.labels):
        if own not in (label, neighbour):
            continue
        box = truth.corners_xyxy[k]
        hard = (
            truth.occlusions[k] > difficulty.most_occlusion
            or truth.truncations[k] > difficulty.most_truncation
            or box[3] - box[1] <= difficulty.least_height_px
        )
        judged.append((truth.frames[k], box, own == neighbour or hard))
    return judged


def count_slowly(truth, found, label, neighbour, difficulty, least, threshold, *, by_score):
    """Right, wrong and missed detections from a score on, and the scores of the right ones."""
    objects = judged_truth(truth, label, neighbour, difficulty)
    heights = found.corners_xyxy[:, 3] - found.corners_xyxy[:, 1]
    small = heights < difficulty.least_height_px
    usable = [k for k, own in enumerate(found.labels) if own == label and found.scores[k] >= threshold]
    used, tp, fn, right = set(), 0, 0, []
    for frame, box, need_not in objects:
        near = [k for k in usable if found.frames[k] == frame and k not in used]
        near = [k for k in near if overlap(box, found.corners_xyxy[k]) > least]
        if not near:
            fn += not need_not
            continue
        if by_score:
            best = max(near, key=lambda k: found.scores[k])
        else:
            large = [k for k in near if not small[k]]
            best = max(large, key=lambda k: overlap(box, found.corners_xyxy[k])) if large else near[0]
        used.add(best)
        if not need_not and not small[best]:
            tp += 1
            right.append(found.scores[best])
    regions = [(truth.frames[k], truth.corners_xyxy[k]) for k, own in enumerate(truth.labels) if own == "DontCare"]
    fp = 0
    for k in set(usable) - used:
        inside = any(
            frame == found.frames[k] and overlap(found.corners_xyxy[k], region, of_first=True) > least
            for frame, region in regions
        )
        fp += not (small[k] or inside)
    return tp, fp, fn, right


def thresholds_slowly(scores: list[float], count: int) -> list[float]:
    """The scores whose recalls are nearest to each fortieth."""
    chosen, wanted = [], 0.0
    scores = sorted(scores, reverse=True)
    for k, score in enumerate(scores):
        here, after = (k + 1) / count, (k + 2) / count
        if k == len(scores) - 1 or abs(here - wanted) <= abs(after - wanted):
            chosen.append(score)
            wanted += 1 / 40
    return chosen


def street(seed: int) -> tuple[ObjectTable, ObjectTable]:
    """Cars, vans and regions over 40 frames, and detections near them, beside them, small ones and doubled ones."""
    rng = np.random.default_rng(seed)
    true_rows, found_rows = [], []
    for frame in range(40):
        for _ in range(rng.integers(0, 7)):
            left, top = rng.uniform(0, 400), rng.uniform(0, 100)
            box = np.array([left, top, left + rng.uniform(20, 120), top + rng.uniform(18, 80)])
            kind = rng.choice(["Car", "Van", "DontCare", "Cyclist"], p=[0.6, 0.15, 0.15, 0.1])
            true_rows.append((frame, kind, box, rng.integers(0, 4), rng.choice([0, 0, 0, 1])))
            # scores of few values, so that many are equal
            found_rows += [
                (frame, "Car", box + rng.normal(0, 4, 4), np.round(rng.random(), 1))
                for _ in range(rng.choice([0, 1, 1, 2]))
            ]
        for _ in range(rng.integers(0, 3)):
            left, top = rng.uniform(0, 400), rng.uniform(0, 100)
            box = [left, top, left + 60, top + rng.uniform(15, 60)]
            found_rows.append((frame, "Car", box, np.round(rng.random(), 1)))
    frames, labels, corners, occlusions, truncations = zip(*true_rows, strict=True)
    truth = table(frames, labels, corners, occlusions=occlusions, truncations=truncations)
    frames, labels, corners, scores = zip(*found_rows, strict=True)
    return truth, table(frames, labels, corners, scores=scores)


@pytest.mark.parametrize("difficulty", ["easy", "moderate", "hard", "all"])
@pytest.mark.parametrize("seed", [1, 2])
def test_counts_of_every_score_are_those_of_the_rules_written_out(seed, difficulty):
    truth, found = street(seed)
    pairs = ev.pair_detections({"a": found}, {"a": truth}, "car", rules=IN_IMAGE)
    curve = ev.score_curve(ev.at_difficulty(pairs, DIFFICULTIES[difficulty]))
    assert len(curve.thresholds) == len(set(found.scores.tolist()))
    for k, threshold in enumerate(curve.thresholds):
        counted = count_slowly(truth, found, "Car", "Van", DIFFICULTIES[difficulty], 0.5, threshold, by_score=False)
        assert (curve.tp[k], curve.fp[k], curve.fn[k]) == counted[:3]


@pytest.mark.parametrize("difficulty", ["easy", "moderate", "hard"])
def test_average_precision_and_best_f1_are_those_of_the_rules_written_out(difficulty):
    truth, found = street(3)
    scores = found.scores + np.linspace(0, 0.01, len(found))
    found = table(found.frames, found.labels, found.corners_xyxy, scores=scores)
    rule = DIFFICULTIES[difficulty]
    *_, right = count_slowly(truth, found, "Car", "Van", rule, 0.5, -1, by_score=True)
    count = sum(not need_not for *_, need_not in judged_truth(truth, "Car", "Van", rule))
    precisions = np.zeros(41)
    for k, threshold in enumerate(thresholds_slowly(right, count)):
        tp, fp, *_ = count_slowly(truth, found, "Car", "Van", rule, 0.5, threshold, by_score=False)
        precisions[k] = tp / (tp + fp)
    best = [precisions[k:].max() for k in range(41)]
    scores = cars_of(found, truth).difficulties[difficulty]
    assert scores.ap40 == pytest.approx(np.mean(best[1:]), abs=1e-12)
    assert scores.ap11 == pytest.approx(np.mean(best[::4]), abs=1e-12)
    assert 0.05 < scores.ap40 < 0.95
    counts = [
        count_slowly(truth, found, "Car", "Van", rule, 0.5, threshold, by_score=False)
        for threshold in set(found.scores.tolist())
    ]
    assert scores.max_f1 == pytest.approx(max(2 * tp / (2 * tp + fp + fn) for tp, fp, fn, _ in counts), abs=1e-12)


def test_what_is_missing_has_defined_figures_or_is_named_and_regions_excuse_boxes_in_space_where_asked():
    truth, found = street(5)
    empty = ObjectTable.empty()
    for results, true in ((empty, truth), (found, empty), (empty, empty)):
        scores = cars_of(results, true).difficulties["moderate"]
        assert (scores.ap40, scores.max_f1, scores.recall) == (0.0, 0.0, 0.0)
        assert (scores.threshold is None) == (results is empty)
    # frames of different sequences do not meet
    box, nothing = [[0, 0, 100, 60]], ObjectTable.empty()
    there = table([0], ["Car"], box, occlusions=[0], truncations=[0])
    sides = {"a": table([0], ["Car"], box, scores=[0.9]), "b": nothing}, {"a": nothing, "b": there}
    scores = ev.evaluate_detection(*sides, classes=("car",), rules=IN_IMAGE)["car"].difficulties["moderate"]
    assert (scores.true_objects, scores.detections, scores.max_f1) == (1, 1, 0.0)
    truth, found = street(6)
    bare = table(found.frames, found.labels, found.corners_xyxy)
    with pytest.raises(OptionError, match="no scores"):
        ev.evaluate_detection({"a": bare}, {"a": truth}, rules=IN_IMAGE)
    with pytest.raises(OptionError, match="similarity '3d': the truth without boxes"):
        ev.evaluate_detection({"a": found}, {"a": truth})
    with pytest.raises(OptionError, match="difficulty 'tough'; expected one of easy"):
        ev.evaluate_detection({"a": found}, {"a": truth}, rules=IN_IMAGE, difficulties=("tough",))
    boxes = np.array([[10.0, 0, 0, 4, 2, 1.5, 0]])
    one = np.zeros(1, np.int64), np.full(1, -1)
    truth = ObjectTable(*one, ("DontCare",), np.array([[0.0, 0, 100, 100]]), boxes - 1000)
    found = ObjectTable(*one, ("Car",), np.array([[10.0, 10, 60, 60]]), boxes, scores=np.ones(1))
    for asked, wrong in ((False, 1), (True, 0)):
        reported = cars_of(found, truth, rules=DetectionRules(regions_in_space=asked))
        assert reported.difficulties["hard"].detections == wrong


def test_calibration_of_scores():
    rng = np.random.default_rng(7)
    probabilities = rng.random(40_000)
    are_true = rng.random(40_000) < probabilities
    reported = ev.judge_calibration(probabilities, are_true)
    assert reported.error < 0.01  # 15 bins of 2700 draws, each off by 0.004 on the average
    assert reported.brier == pytest.approx(1 / 6, abs=0.005)  # the integral of p (1 - p); 3 deviations are 0.0028
    assert sum(part.count for part in reported.bins) == reported.count == 40_000
    # scores that state too much have their excess as error
    true = np.repeat([True, False, True, False], [6, 4, 3, 7])
    reported = ev.judge_calibration(np.repeat([0.9, 0.3], 10), true)
    assert reported.error == pytest.approx(0.15)  # half of them by 0.3, the others by nothing
    assert reported.largest_error == pytest.approx(0.3)
    filled = [part for part in reported.bins if part.count]
    assert [(part.mean_score, part.share_true) for part in filled] == [
        (pytest.approx(0.3), pytest.approx(0.3)),
        (pytest.approx(0.9), pytest.approx(0.6)),
    ]
    # a score of one is in the last bin; logits have no error of calibration
    reported = ev.judge_calibration(np.array([1.0, 0.0]), np.array([True, False]))
    assert (reported.bins[0].count, reported.bins[-1].count, reported.error) == (1, 1, 0.0)
    truth, found = street(8)
    logits = table(found.frames, found.labels, found.corners_xyxy, scores=10 * found.scores - 5)
    assert cars_of(logits, truth).difficulties["hard"].calibration is None


@pytest.mark.parametrize("degrees_of_freedom", [None, 4.0, 9.0])
def test_regions_hold_what_they_promise_of_errors_of_their_own_kind(degrees_of_freedom):
    rng = np.random.default_rng(9)
    count, roots = 20_000, rng.normal(0, 1, (20_000, 3, 3))
    covariances = roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(3)
    errors = (np.linalg.cholesky(covariances) @ rng.normal(0, 1, (count, 3, 1)))[..., 0]
    if degrees_of_freedom is not None:
        share = degrees_of_freedom / rng.chisquare(degrees_of_freedom, count)
        errors *= np.sqrt(share * (degrees_of_freedom - 2) / degrees_of_freedom)[:, None]
    reported = judge_covariances(errors, covariances, degrees_of_freedom=degrees_of_freedom)
    for part in reported.coverages:
        deviation = np.sqrt(part.level * (1 - part.level) / count)
        assert part.share == pytest.approx(part.level, abs=4 * deviation)
    if degrees_of_freedom is None:
        assert reported.nees_low < reported.nees < reported.nees_high
        assert reported.nees_high == pytest.approx(3 + 1.96 * np.sqrt(6 / count), rel=1e-3)


def test_a_student_with_many_degrees_of_freedom_is_a_gaussian_and_covariances_are_judged_by_part():
    errors, covariances = np.random.default_rng(10).normal(0, 1, (500, 2)), np.tile(np.eye(2), (500, 1, 1))
    gaussian = judge_covariances(errors, covariances)
    student = judge_covariances(errors, covariances, degrees_of_freedom=1e7)
    assert student.coverages == gaussian.coverages
    assert gaussian.nees == pytest.approx(np.mean((errors**2).sum(axis=1)))
    assert gaussian.coverages[1].share == np.mean((errors**2).sum(axis=1) <= stats.chi2.ppf(0.9, 2))
    with pytest.raises(ArrayError, match=r"covariances\[1\].*positive definite"):
        judge_covariances(np.zeros((2, 2)), np.array([np.eye(2), [[1.0, 2], [2, 1]]]))
    with pytest.raises(ArrayError, match=r"\(2, 3, 3\); expected \(2, 2, 2\)"):
        judge_covariances(np.zeros((2, 2)), np.tile(np.eye(3), (2, 1, 1)))
    with pytest.raises(OptionError, match="expected more than 2"):
        judge_covariances(np.zeros((1, 2)), np.eye(2)[None], degrees_of_freedom=2.0)
    rng = np.random.default_rng(11)
    count, deviations = 3000, np.array([0.2, 0.1, 0.05, 0.2, 0.1, 0.1, 0.03])
    sizes, yaws = np.tile([4.2, 1.8, 1.5], (count, 1)), rng.uniform(-3, 3, count)
    true = np.column_stack([np.arange(count) * 20.0, np.zeros((count, 2)), sizes, yaws])
    boxes = true + rng.normal(0, 1, (count, 7)) * deviations
    boxes[::10, 6] += np.pi
    rows = np.zeros(count, np.int64), np.full(count, -1), ("Car",) * count
    covariances = np.tile(np.diag(deviations**2), (count, 1, 1))
    found = ObjectTable(*rows, boxes=boxes, scores=np.full(count, 0.5), covariances=covariances)
    truth = ObjectTable(*rows, boxes=true)
    reported = cars_of(found, truth, rules=DetectionRules(), difficulties=("all",))
    assert reported.headings_reversed == pytest.approx(0.1)
    assert {name: part.dimensions for name, part in reported.covariances.items()} == {"center": 3, "size": 3, "yaw": 1}
    for part in reported.covariances.values():
        assert part.nees == pytest.approx(part.dimensions, rel=0.1)  # 3000 draws: 3 deviations are 0.08
