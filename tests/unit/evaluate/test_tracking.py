"""Figures of trackers by hand: what counts, what does not, in images and in space."""

import numpy as np
import pytest

from sceneloom.errors import ArrayError, OptionError
from sceneloom.evaluate.objects import ObjectTable, Similarity
from sceneloom.evaluate.tracking import TrackingRules, evaluate_tracking, score_sequence

IN_SPACE = TrackingRules(similarity=Similarity.SPACE)


def table(rows, **columns) -> ObjectTable:
    """Rows of frame, id, label and the left edge of a box of 100 x 80 pixels."""
    frames, ids, labels, lefts = zip(*rows, strict=True)
    left = np.array(lefts, float)
    corners = np.column_stack([left, np.zeros(len(left)), left + 100, np.full(len(left), 80.0)])
    reported = {name: np.asarray(column, float) for name, column in columns.items()}
    return ObjectTable(np.array(frames), np.array(ids), labels, reported.pop("corners_xyxy", corners), **reported)


def track(label: str, number: int, left: float, frames=range(10)) -> list:
    return [(frame, number, label, left) for frame in frames]


def clear_of(found: ObjectTable, truth: ObjectTable, label: str = "car", **how):
    return score_sequence(found, truth, label, **how).clear


def test_tracks_of_one_object_gaps_and_the_order_of_rows():
    truth = table(track("Car", 0, 0))
    found = table(track("Car", 1, 0, range(5)) + track("Car", 2, 0, range(5, 10)))
    reported = score_sequence(found, truth, "car")
    assert (reported.clear.idsw, reported.clear.frag, reported.clear.tp) == (1, 0, 10)
    # each pair lasts 5 frames of the 10 in which one of both is there
    assert (reported.hota.deta, reported.hota.assa) == (1.0, 0.5)
    assert reported.hota.hota == pytest.approx(np.sqrt(0.5))
    assert (reported.hota.assre, reported.hota.asspr) == (0.5, 1.0)
    assert reported.identity.idf1 == 0.5
    # a gap is a fragment and no switch
    gap = track("Car", 7, 0, [0, 1, 2, 6, 7, 8, 9])
    truth = table(track("Car", 0, 0) + track("Car", 1, 500))
    reported = clear_of(table(gap + track("Car", 8, 500)), truth)
    assert (reported.frag, reported.idsw, reported.fn, reported.fp) == (1, 0, 3, 0)
    assert (reported.mt, reported.pt, reported.ml) == (1, 1, 0)
    # frames in which nothing is found at all end no track, as in TrackEval, whose memory of the frame before stays
    assert clear_of(table(gap), table(track("Car", 0, 0))).frag == 0
    # the order of rows says nothing
    rng = np.random.default_rng(1)
    truth = table(track("Car", 0, 0) + track("Car", 1, 60) + track("Car", 2, 130))
    found = table(track("Car", 5, 10) + track("Car", 6, 75, range(6)) + track("Car", 7, 75, range(6, 10)))
    shuffled = [side.select(rng.permutation(len(side))) for side in (found, truth)]
    assert score_sequence(*shuffled, "car") == score_sequence(found, truth, "car")


def test_what_neither_counts_nor_is_false():
    # hidden, cut and similar objects
    for columns, label in (
        ({"occlusions": [3] * 10}, "Car"),
        ({"truncations": [1] * 10}, "Car"),
        ({}, "Van"),
        ({}, "van"),
    ):
        truth, found = table(track(label, 0, 0), **columns), table(track("Car", 1, 0))
        reported = clear_of(found, truth)
        assert (reported.tp, reported.fn, reported.fp) == (0, 0, 0)
    # small boxes, and boxes in regions, where no object is
    truth = table([(0, 0, "Car", 900), (0, -1, "DontCare", 0)])
    corners = np.array([[0, 0, 90, 80], [60, 0, 160, 80], [500, 0, 540, 25], [500, 100, 540, 126]], float)
    found = table([(0, k, "Car", 0) for k in range(4)], corners_xyxy=corners)
    # in the region with all of it; with 40 %; 25 pixels high; 26 pixels high
    assert clear_of(found, truth).fp == 2
    # other classes; names do not depend on capitals
    truth = table(track("Car", 0, 0) + track("Cyclist", 1, 300))
    found = table(track("Car", 5, 0) + track("Pedestrian", 6, 600))
    reported = clear_of(found, truth)
    assert (reported.tp, reported.fn, reported.fp) == (10, 0, 0)
    assert clear_of(table(track("car", 1, 0)), table(track("CAR", 0, 0)), "Car").tp == 10
    # the same id of two classes is no mistake
    both = table([(0, 9, "Car", 0), (0, 9, "Pedestrian", 300)])
    assert clear_of(both, both).tp == 1


def in_space(rows) -> ObjectTable:
    """Rows of frame, id and x of boxes of 4 x 2 x 1.5 m."""
    frames, ids, locations = (np.array(column) for column in zip(*rows, strict=True))
    boxes = np.zeros((len(rows), 7))
    boxes[:, 0], boxes[:, 3:6] = locations, (4, 2, 1.5)
    return ObjectTable(frames, ids, ("Car",) * len(rows), boxes=boxes)


def test_tracks_in_space_need_no_images_and_distances_fall_to_nothing_at_four_metres():
    truth = in_space([(f, 0, 10.0 + f) for f in range(10)])
    found = in_space([(f, 3, 11.0 + f) for f in range(10)])
    reported = score_sequence(found, truth, "car", rules=IN_SPACE)
    # a metre off: 3 m of 5 m in common
    assert reported.clear.motp == pytest.approx(0.6)
    assert reported.hota.curves["tp"][10:13] == (10, 10, 0)
    truth = in_space([(0, 0, 0.0), (1, 0, 0.0), (2, 0, 0.0)])
    found = in_space([(0, 1, 1.0), (1, 1, 2.0), (2, 1, 2.1)])
    reported = score_sequence(found, truth, "car", rules=TrackingRules(similarity=Similarity.DISTANCE))
    assert reported.clear.tp == 2
    assert reported.clear.motp == pytest.approx((0.75 + 0.5) / 2)


def test_what_is_wrong_is_named():
    for side in ("results", "truth"):
        good, bad = table(track("Car", 0, 0)), table([(0, 0, "Car", 0), (4, 9, "Car", 0), (4, 9, "Car", 200)])
        sides = (bad, good) if side == "results" else (good, bad)
        with pytest.raises(ArrayError, match=f"{side}: frame 4: two boxes of Car with id 9"):
            score_sequence(*sides, "car")
        with pytest.raises(ArrayError, match=f"sequence 0007: {side}: frame 4"):
            evaluate_tracking({"0007": sides[0]}, {"0007": sides[1]}, classes=("car",))
    truth = table(track("Car", 0, 0))
    with pytest.raises(ArrayError, match=r"corners_xyxy\[1\] \(frame 3\).*nan.*expected finite"):
        table([(0, 1, "Car", 0.0), (3, 1, "Car", float("nan"))])
    with pytest.raises(ArrayError, match=r"frames: -1; expected 0 or more"):
        table([(-1, 1, "Car", 0)])
    with pytest.raises(OptionError, match="similarity '3d': the truth without boxes"):
        score_sequence(truth, truth, "car", rules=IN_SPACE)
    one = table(track("Car", 0, 0))
    with pytest.raises(OptionError, match="results without the sequences 0001"):
        evaluate_tracking({"0000": one}, {"0000": one, "0001": one})
    with pytest.raises(OptionError, match="truth without the sequences 0002"):
        evaluate_tracking({"0000": one, "0002": one}, {"0000": one})
    with pytest.raises(OptionError, match="no sequence"):
        evaluate_tracking({}, {})


def test_nothing_on_a_side_has_defined_figures_and_sequences_are_weighted_by_their_boxes():
    for empty in ("results", "truth", "both"):
        nothing, one = ObjectTable.empty(), table(track("Car", 0, 0))
        found, truth = (nothing if empty in (side, "both") else one for side in ("results", "truth"))
        reported = score_sequence(found, truth, "car")
        figures = reported.hota.hota, reported.clear.mota, reported.identity.idf1, reported.hota.loca
        assert figures == (0.0, 0.0, 0.0, 1.0)
        assert (reported.clear.fn, reported.clear.fp) == (10 * (empty == "results"), 10 * (empty == "truth"))
    good, bad, nothing = table(track("Car", 0, 0)), table(track("Car", 0, 500, range(2))), ObjectTable.empty()
    reported = evaluate_tracking({"a": good, "b": bad}, {"a": good, "b": good}, classes=("car",))["car"].combined
    assert (reported.clear.tp, reported.clear.fn, reported.clear.fp) == (10, 10, 2)
    assert reported.hota.deta == pytest.approx(10 / 22)
    assert reported.hota.assa == 1.0
    # sequences without any object count their false boxes when taken together, as TrackEval has it
    reported = evaluate_tracking({"a": good, "b": good}, {"a": nothing, "b": nothing}, classes=("car",))["car"]
    assert (reported.sequences["a"].clear.mota, reported.combined.clear.mota) == (0.0, -20.0)
