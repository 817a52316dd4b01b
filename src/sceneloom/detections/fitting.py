"""Detector statistics fitted to drives whose truth is known: existence probabilities and box noise."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.detections.detectors import (
    KINDS,
    Agreement,
    BoxNoise,
    ClassStatistics,
    Detectors,
    ImageNoise,
    Reported,
    Visibility,
    independent_detectors,
    numbers_of,
    table_rows,
)
from sceneloom.detections.projection import Outlines, assign, differences, pair_gains, project_outlines, refine
from sceneloom.detections.results import NO_BOX, DetectionPair
from sceneloom.detections.settings import box_covariances, existence_table, image_sigmas, noise_table, radius_squared
from sceneloom.errors import OptionError
from sceneloom.kernels import existence
from sceneloom.kernels.box_fusion import NEAREST, USUAL, boxes_with_area, boxes_with_position
from sceneloom.kernels.existence import USUAL_OVERLAP
from sceneloom.kernels.overlaps import overlaps_in_space
from sceneloom.scene.detections import Boxes2D, Boxes3D, ScoreForm

_ROUNDS = 200
_SMALL = 1e-8

_EXACT = 1e-3  # errors below are none [m or rad]


def fit_odds(
    features: Float64Array, came_true: BoolArray, *, expected: Float64Array, weights: Float64Array
) -> Float64Array:
    """Fit the logarithm of odds as a sum of features, by Newton's steps on the penalised likelihood.

    Args:
        features: (N, K), the first column of ones.
        came_true: (N,).
        expected: (K,), what coefficients are where data state nothing.
        weights: (K,), as how many examples' worth that counts.

    Returns:
        (K,) float64, those of features after the first 0 or more: surer signs never make less likely.

    Source: le Cessie and van Houwelingen 1992, "Ridge Estimators in Logistic Regression".
    """
    found = expected.copy()
    loss = _loss(features, came_true, found, expected, weights)
    for _ in range(_ROUNDS):
        shares = 1.0 / (1.0 + np.exp(-features @ found))
        slope = features.T @ (shares - came_true) + weights * (found - expected)
        curve = (features * (shares * (1.0 - shares))[:, None]).T @ features + np.diag(weights)
        step, size = np.linalg.solve(curve + _SMALL * np.eye(len(found)), slope), 1.0
        while size > _SMALL:
            tried = found - size * step
            tried[1:] = np.maximum(tried[1:], 0.0)
            after = _loss(features, came_true, tried, expected, weights)
            if after <= loss:
                break
            size /= 2.0
        else:
            break
        if loss - after < _SMALL:
            return tried
        found, loss = tried, after
    return found


def _loss(
    features: Float64Array, came_true: BoolArray, found: Float64Array, expected: Float64Array, weights: Float64Array
) -> float:
    odds = features @ found
    return float((np.logaddexp(0.0, odds) - odds * came_true).sum() + (weights * (found - expected) ** 2).sum() / 2)


def fit_deviations(
    features: Float64Array, errors: Float64Array, *, weights: Float64Array, degrees_of_freedom: float
) -> Float64Array:
    """Fit logarithms of deviations as sums of features, for errors that follow a Student distribution together.

    Args:
        features: (N, K), the first column of ones.
        errors: (N, D).
        weights: (N,), of the examples.

    Returns:
        (D, K) float64 of its scales.

    Source: Fisher's scoring of the likelihood of Lange, Little and Taylor 1989, "Robust Statistical Modeling
    Using the t Distribution".
    """
    dimensions = errors.shape[1]
    found = np.zeros((dimensions, features.shape[1]))
    found[:, 0] = np.log(np.median(np.abs(errors), axis=0) + 1e-3)
    weighted = features * weights[:, None]
    curve = features.T @ weighted + 1e-3 * weights.sum() * np.diag([0.0, *np.ones(features.shape[1] - 1)])
    for _ in range(_ROUNDS):
        squares = (errors**2 + _EXACT**2) * np.exp(-2.0 * features @ found.T)
        shrunk = (degrees_of_freedom + dimensions) / (degrees_of_freedom + squares.sum(axis=1))
        slope = weighted.T @ np.minimum(shrunk[:, None] * squares - 1.0, 4.0)
        step = np.linalg.solve(curve, slope).T / 2.0
        found += step
        if np.abs(step).max() < 1e-6:
            break
    return found


def weighted_quantile(values: Float64Array, weights: Float64Array, share: float) -> float:
    """The value below which a share of the weight lies."""
    order = np.argsort(values)
    below = np.cumsum(weights[order]) / weights.sum()
    return float(values[order][min(int(np.searchsorted(below, share)), len(order) - 1)])


IGNORED = -1
"""A verdict: neither true nor false."""

LEAST_IOU = 0.3
"""Overlap in the image from which on boxes may be one object, as fusion has it."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelledPair:
    """What detectors reported at one time, and what was there.

    Attributes:
        pair: their report.
        truth: the exact boxes, lidar frame.
        counts: (T,) bool, those that detectors must find; a box of another one is neither true nor false.
        neighbours: (T,) bool, those that are of another class and only look like theirs, so that errors of their boxes
            state nothing.
        regions_xyxy: (R, 4) float64 [px], parts of the image whose objects nobody wrote down.
        group: of what belongs together, such as a drive: errors within are alike.
        least_height_px: a box without an object is not false where the image shows it, but less high than this [px].
        drawn_xyxy: (T, 4) float64 [px], the boxes that people drew around the objects in the image, or None.
        ids: (T,) int64, numbers of the objects, the same in all examples of the group, or None.
    """

    pair: DetectionPair
    truth: Boxes3D
    counts: BoolArray
    neighbours: BoolArray
    regions_xyxy: Float64Array
    group: str
    least_height_px: float = 25.0
    drawn_xyxy: Float64Array | None = None
    ids: Int64Array | None = None


class SweepColumns(NamedTuple):
    """Boxes of sweeps, row by row.

    Attributes:
        group: (N,) int64, of the example.
        kind: (N,) int64, of the class.
        reported: (N,) what the score says, as logarithm of odds.
        partner_reported: (N,) the same of the partner in the image, NaN without one.
        matched: (N,) bool, whether there is a partner.
        overlap: (N,) with the partner in the image.
        seen: (N,) share that the image shows.
        height: (N,) [px], in the image.
        distance: (N,) [m].
        verdict: (N,) int64, 1 true, 0 false, or IGNORED.
        errors: (N, 7) of the box in its own axes: middle, sizes [m] and heading [rad]; NaN where no object is near.
        apart: (N, 11), how far the partner's middle across and upright and its height are off the outline of the
            object [px]; `differences` of the box that people drew from the outline; those of the partner less these.
            NaN where none is known.
        sides: (N, 2) [px], width and height of the partner.
        object: (N,) int64, number of the object, or NO_BOX.
        seconds: (N,) of the sweep.
    """

    group: Int64Array
    kind: Int64Array
    reported: Float64Array
    partner_reported: Float64Array
    matched: BoolArray
    overlap: Float64Array
    seen: Float64Array
    height: Float64Array
    distance: Float64Array
    verdict: Int64Array
    errors: Float64Array
    apart: Float64Array
    sides: Float64Array
    object: Int64Array
    seconds: Float64Array


class ImageColumns(NamedTuple):
    """Boxes of images, row by row: group, class, what the score says, verdict, whether the sweep has one too."""

    group: Int64Array
    kind: Int64Array
    reported: Float64Array
    verdict: Int64Array
    matched: BoolArray


class Prepared(NamedTuple):
    """One example, ready for the update by the image: rows of the columns, boxes, their outlines and partners."""

    pair: DetectionPair
    first: int
    boxes: Float64Array
    outlines: Outlines
    partners: Int64Array
    corners_xyxy: Float64Array


class Columns(NamedTuple):
    """All examples."""

    groups: tuple[str, ...]
    sweep: SweepColumns
    image: ImageColumns
    prepared: tuple[Prepared, ...]

    def without(self, *groups: int) -> "Columns":
        """The same rows, of which those of some groups state nothing."""
        out, hidden = np.isin(self.sweep.group, groups), np.isin(self.image.group, groups)
        return self._replace(
            sweep=self.sweep._replace(
                verdict=np.where(out, IGNORED, self.sweep.verdict),
                errors=np.where(out[:, None], np.nan, self.sweep.errors),
                apart=np.where(out[:, None], np.nan, self.sweep.apart),
            ),
            image=self.image._replace(verdict=np.where(hidden, IGNORED, self.image.verdict)),
        )


def columns_of(examples: Iterable[LabelledPair], *, overlap: float) -> Columns:
    """Hold what was reported against what was there.

    Args:
        overlap: in space, from which on a box is true.
    """
    groups: dict[str, int] = {}
    sweeps, images, prepared, first = list[Any](), list[Any](), list[Prepared](), 0
    for example in examples:
        number = groups.setdefault(example.group, len(groups))
        ready, sweep, image = _example(example, number, overlap)
        prepared.append(ready._replace(first=first))
        first += len(ready.boxes)
        sweeps.append(sweep)
        images.append(image)
    return Columns(
        tuple(groups),
        SweepColumns(*(np.concatenate(parts) for parts in zip(*sweeps, strict=True))),
        ImageColumns(*(np.concatenate(parts) for parts in zip(*images, strict=True))),
        tuple(prepared),
    )


_TABLE = existence_table(independent_detectors())


def _example(example: LabelledPair, group: int, overlap: float) -> tuple[Prepared, SweepColumns, ImageColumns]:
    pair = example.pair
    three, two = pair.boxes_3d, pair.boxes_2d
    boxes, rows_3d = boxes_with_position(three.centers, three.sizes_lwh, three.yaws)
    corners, rows_2d = boxes_with_area(two.corners_xyxy)
    labels_3d, labels_2d = ([b.labels[k] for k in rows.tolist()] for b, rows in ((three, rows_3d), (two, rows_2d)))
    classes_3d, classes_2d = numbers_of(labels_3d, labels_2d)
    kinds_3d, kinds_2d = table_rows(classes_3d), table_rows(classes_2d)
    (reported_3d, likely_3d), (reported_2d, likely_2d) = (
        existence.reported_odds(b.scores, rows, b.score_form is ScoreForm.LOGIT, isinstance(b, Boxes2D), kinds, _TABLE)[
            ::2
        ]
        for b, rows, kinds in ((three, rows_3d, kinds_3d), (two, rows_2d, kinds_2d))
    )
    outlines = project_outlines(pair.camera, pair.camera_from_lidar, boxes, likely=likely_3d)
    shown = outlines.corners_xyxy
    gains = pair_gains(shown, corners, classes_3d, classes_2d, likely_3d, likely_2d, least_iou=LEAST_IOU)
    partners, taken = assign(gains)
    truth = _Truth.of(example, labels_3d)
    verdicts, _ = truth.judge(boxes, classes_3d, likely_3d, shown, overlap)
    near = truth.judge(boxes, classes_3d, likely_3d, shown, LEAST_IOU)[1]
    fits = image_overlaps(shown, corners)
    has = partners != NO_BOX
    rows = np.arange(len(boxes))
    count = len(boxes)
    reported_by_partner, overlaps = np.full(count, np.nan), np.zeros(count)
    reported_by_partner[has], overlaps[has] = reported_2d[partners[has]], fits[rows[has], partners[has]]
    sides = np.full((count, 2), np.nan)
    sides[has] = corners[partners[has], 2:] - corners[partners[has], :2]
    sweep = SweepColumns(
        np.full(count, group),
        kinds_3d,
        reported_3d,
        reported_by_partner,
        has,
        overlaps,
        outlines.seen_shares,
        shown[:, 3] - shown[:, 1],
        np.sqrt((boxes[:, :3] ** 2).sum(axis=1)),
        verdicts,
        truth.errors(boxes, near),
        truth.apart(near, corners, partners),
        sides,
        np.full(count, NO_BOX) if example.ids is None else np.append(example.ids, NO_BOX)[near],
        np.full(count, three.timestamp_ns / 1e9),
    )
    image = ImageColumns(
        np.full(len(corners), group),
        kinds_2d,
        reported_2d,
        truth.judge_image(corners, classes_2d, likely_2d),
        taken != NO_BOX,
    )
    return Prepared(pair, 0, boxes, outlines, partners, corners), sweep, image


class _Truth(NamedTuple):
    """The truth of one example: boxes (T, 7), classes as numbers, and what `LabelledPair` says of them."""

    boxes: Float64Array
    classes: Int64Array
    example: LabelledPair

    @classmethod
    def of(cls, example: LabelledPair, labels_3d: Sequence[str]) -> "_Truth":
        truth = example.truth
        boxes = np.column_stack([truth.centers, truth.sizes_lwh, truth.yaws])
        return cls(boxes, numbers_of(list(truth.labels), labels_3d)[0], example)

    def judge(
        self, boxes: Float64Array, classes: Int64Array, likely: Float64Array, shown: Float64Array, overlap: float
    ) -> tuple[Int64Array, Int64Array]:
        """Verdicts over boxes, the surest first, and which object each is of, NO_BOX for none."""
        overlaps = overlaps_in_space(
            boxes,
            self.boxes,
            np.array([0, len(boxes)]),
            np.array([0, len(self.boxes)]),
            np.array([0, len(boxes) * len(self.boxes)]),
        ).reshape(len(boxes), len(self.boxes))
        return self._judge(overlaps, classes, likely, shown, overlap)

    def judge_image(self, corners: Float64Array, classes: Int64Array, likely: Float64Array) -> Int64Array:
        """Verdicts over boxes of the image, by the outlines of the true boxes there."""
        return self._judge(image_overlaps(corners, self._outlines()), classes, likely, corners, 0.5)[0]

    def _outlines(self) -> Float64Array:
        """The true boxes in the image, (T, 4) [px]."""
        pair = self.example.pair
        return project_outlines(pair.camera, pair.camera_from_lidar, self.boxes.copy()).corners_xyxy

    def _judge(
        self, overlaps: Float64Array, classes: Int64Array, likely: Float64Array, shown: Float64Array, least: float
    ) -> tuple[Int64Array, Int64Array]:
        example = self.example
        fits = np.where((classes[:, None] == self.classes) & (overlaps >= least), overlaps, 0.0)
        verdicts, found = np.zeros(len(classes), np.int64), np.full(len(classes), NO_BOX)
        for row in np.argsort(-likely, kind="stable").tolist():
            # objects that count come first
            worth = fits[row] + np.where((fits[row] > 0.0) & example.counts, 1.0, 0.0)
            if len(worth) and worth.max() > 0.0:
                best = int(worth.argmax())
                fits[:, best] = 0.0
                verdicts[row], found[row] = 1 if example.counts[best] else IGNORED, best
        heights = shown[:, 3] - shown[:, 1]
        low = (heights > 0.0) & (heights < example.least_height_px)
        excused = (_common(shown, example.regions_xyxy) > 0.0).any(axis=1)
        verdicts[(found == NO_BOX) & (low | excused)] = IGNORED
        return verdicts, found

    def _own(self, found: Int64Array) -> Int64Array:
        """Rows of boxes that are of an object of their class."""
        rows = np.flatnonzero(found != NO_BOX)
        own: Int64Array = rows[~self.example.neighbours[found[rows]]]
        return own

    def errors(self, boxes: Float64Array, found: Int64Array) -> Float64Array:
        """How far off boxes are, (N, 7), in their own axes; NaN without an object of their class."""
        errors = np.full((len(boxes), 7), np.nan)
        rows = self._own(found)
        off = boxes[rows] - self.boxes[found[rows]]
        cosines, sines = np.cos(boxes[rows, 6]), np.sin(boxes[rows, 6])
        errors[rows] = off
        errors[rows, 0] = cosines * off[:, 0] + sines * off[:, 1]
        errors[rows, 1] = cosines * off[:, 1] - sines * off[:, 0]
        # front and back mixed up is another mistake
        errors[rows, 6] = (off[:, 6] + np.pi / 2) % np.pi - np.pi / 2
        return errors

    def apart(self, found: Int64Array, corners: Float64Array, partners: Int64Array) -> Float64Array:
        """How far partners are off the true outlines, (N, 11); NaN where one of them may be cut."""
        apart, drawn = np.full((len(found), 11), np.nan), self.example.drawn_xyxy
        rows = self._own(np.where(partners == NO_BOX, NO_BOX, found))
        if not len(rows):
            return apart
        camera, true, own = self.example.pair.camera, self._outlines()[found[rows]], corners[partners[rows]]
        limits = np.array([camera.width, camera.height]) - _BORDER_PX
        low, high = np.minimum(true, own)[:, :2], np.maximum(true, own)[:, 2:]
        whole = np.column_stack([low > _BORDER_PX, high < limits]).min(axis=1)
        off = own - true
        numbers = (off[:, 0] + off[:, 2]) / 2, (off[:, 1] + off[:, 3]) / 2, off[:, 3] - off[:, 1]
        rows, true, own, off = rows[whole], true[whole], own[whole], np.column_stack(numbers)[whole]
        apart[rows, :3] = off
        if drawn is not None and len(rows):
            apart[rows, 3:7] = differences(drawn[found[rows]], true)
            apart[rows, 7:] = differences(own, true) - apart[rows, 3:7]
        return apart


_BORDER_PX = 3.0


def image_overlaps(one: Float64Array, other: Float64Array) -> Float64Array:
    """Intersections over unions of boxes of an image, (N, M)."""
    common = _common(one, other)
    areas = [(boxes[:, 2:] - boxes[:, :2]).prod(axis=1) for boxes in (one, other)]
    overlaps: Float64Array = common / np.maximum(areas[0][:, None] + areas[1] - common, 1e-9)
    return overlaps


def _common(one: Float64Array, other: Float64Array) -> Float64Array:
    wide = np.minimum(one[:, None, 2:], other[None, :, 2:]) - np.maximum(one[:, None, :2], other[None, :, :2])
    common: Float64Array = np.maximum(wide, 0.0).prod(axis=2)
    return common


_LOWEST = 0.001  # scores are held above those of so few true boxes, the lowest of which report few

_SURE, _SURE_ENDS = 0.99, (0.65, 0.99)
"""Scores are held from where on so many are true: nothing is known of the slope there. That is not below and not above
the scores of these shares of the true boxes."""

_SUREST_2D = 5.0  # probabilities of images are held at 0.993: what is surer says how they were rounded

_AGREEMENT, _AGREEMENT_WEIGHTS = (1.0, 0.5, 0.2, 2.0), (30.0, 300.0, 1000.0, 300.0)
"""What boxes of both come to where data state nothing, and as how many examples' worth that counts: half the slope of a
calibrated score, since what one detector takes for an object misleads the other one, too."""

_HEIGHTS_PX = ((10.0, 20.0), (15.0, 25.0), (20.0, 35.0), (25.0, 50.0))
_SEEN_SHARES = (0.1, 0.25, 0.5, 1.0)

_FLOOR = 0.03  # what an image shows nothing of is found by chance

_PRIOR = 0.1

_SUREST_RECALL = 0.98  # no detector is taken to find a larger share than this: the next drive has another light

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


def _fit_agreement(columns: SweepColumns, of_sweep: Reported, of_image: Reported) -> Agreement:
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
        features, columns.verdict[rows] == 1, expected=np.array(_AGREEMENT), weights=np.array(_AGREEMENT_WEIGHTS)
    )
    base, sweep, image, overlap = found.tolist()
    return Agreement(base=base, sweep=sweep, image=image, overlap=overlap)


def _fit_visibility(
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


_LEVEL = 0.95
_LEAST_ERRORS = 30

_UNKNOWN = BoxNoise(
    scores=(0.0, 0.0),
    center_base=(-1.0, -1.5, -1.5),
    center_by_score=(0.0, 0.0, 0.0),
    center_by_range=(0.5, 0.5, 0.5),
    size_base=(-1.0, -1.5, -1.5),
    size_by_score=(0.0, 0.0, 0.0),
    size_by_range=(0.5, 0.5, 0.5),
    yaw=(-2.0, 0.0, 0.0),
)  # deviations of 20 to 40 cm at 20 m, where too few errors are known

_PARTS = (slice(0, 3), slice(3, 6), slice(6, 7))


def _fit_noise(columns: SweepColumns, reported: Reported, degrees_of_freedom: float) -> BoxNoise:
    """Fit scales of a Student distribution; `_widened` makes covariances of them."""
    rows = np.isfinite(columns.errors).all(axis=1) & np.isfinite(columns.reported)
    if rows.sum() < _LEAST_ERRORS:
        return _UNKNOWN
    far = np.log(np.maximum(columns.distance[rows], NEAREST) / USUAL)
    held = np.clip(columns.reported[rows], reported.low, reported.high)
    features = np.column_stack([np.ones(len(held)), held, far])
    groups = columns.group[rows]
    weights = 1.0 / np.sqrt(np.bincount(groups)[groups])  # long drives count more, but not in proportion
    parts = [
        fit_deviations(features, columns.errors[rows][:, part], weights=weights, degrees_of_freedom=degrees_of_freedom)
        for part in _PARTS
    ]
    numbers = [[tuple(column) for column in part.T.tolist()] for part in parts]
    scaled = columns.errors[rows][:, :6] / np.exp(np.concatenate([features @ part.T for part in parts[:2]], axis=1))
    return BoxNoise(
        scores=(reported.low, reported.high),
        center_base=numbers[0][0],
        center_by_score=numbers[0][1],
        center_by_range=numbers[0][2],
        size_base=numbers[1][0],
        size_by_score=numbers[1][1],
        size_by_range=numbers[1][2],
        yaw=(numbers[2][0][0], numbers[2][1][0], numbers[2][2][0]),
        lasting=_lasting(np.column_stack([groups, columns.object[rows], columns.seconds[rows]]), scaled),
    )


def _lasting(rows: Float64Array, scaled: Float64Array) -> tuple[float, float]:
    """Which share of the squares of scaled errors (N, 6) of middles and sizes an object's boxes of a second have alike.

    `rows` (N, 3) are group, object and time [s] of each.
    """
    order = np.lexsort(rows.T[::-1])
    order = order[rows[order, 1] != NO_BOX]
    known, off = rows[order], np.clip(scaled[order], -_FARTHEST, _FARTHEST)
    alike, squares = np.zeros(6), np.zeros(6)
    for lag in range(1, _NEAR_BOXES + 1):
        step = known[lag:] - known[:-lag]
        pairs = np.flatnonzero((step[:, :2] == 0.0).all(axis=1) & (step[:, 2] <= 1.0))
        alike += (off[pairs] * off[pairs + lag]).sum(axis=0)
        squares += (off[pairs] ** 2 + off[pairs + lag] ** 2).sum(axis=0) / 2.0
    if not squares.all():
        return _UNKNOWN.lasting
    shares = (alike / squares).clip(0.0, 1.0)
    return float(shares[:3].mean()), float(shares[3:].mean())


_NEAR_BOXES = 10  # so many boxes later an object's box is compared with one at most
_FARTHEST = 3.0  # errors beyond so many deviations count as these


def _fit_image_noise(columns: SweepColumns) -> ImageNoise:
    """Fit how far partners are off the true outlines: robust deviations in four classes of size, on a line."""
    rows = np.isfinite(columns.apart[:, :3]).all(axis=1)
    if rows.sum() < _LEAST_ERRORS:
        return ImageNoise(across=(2.0, 0.03), upright=(2.0, 0.03), height=(2.0, 0.06))
    apart, sides = columns.apart[rows], columns.sides[rows]

    def line(number: int, side: int) -> tuple[float, float]:
        order = np.array_split(np.argsort(sides[:, side]), 4)
        middles = np.array([sides[rows, side].mean() for rows in order])
        sigmas = np.array([_NORMAL * np.median(np.abs(apart[rows, number])) for rows in order])
        share, least = np.polyfit(middles, sigmas, 1)
        share = max(share, _LEAST_SHARE)
        return float(max(np.mean(sigmas - share * middles), least, _LEAST_PX)), float(share)

    return ImageNoise(across=line(0, 0), upright=line(1, 1), height=line(2, 1), **_fit_drawn(columns))


def _fit_drawn(columns: SweepColumns) -> dict[str, Any]:
    """Fit how the boxes that people draw differ from outlines, and the detector's from those."""
    rows = np.isfinite(columns.apart).all(axis=1)
    if rows.sum() < _LEAST_ERRORS:
        return {}
    group, apart = columns.group[rows], columns.apart[rows, 3:]
    middles = np.array([np.median(apart[group == one, :4], axis=0) for one in np.unique(group)])
    # what groups do not agree on is not usual
    usual, doubt = middles.mean(axis=0), middles.var(axis=0) / len(middles)
    usual *= usual**2 / np.maximum(usual**2 + doubt, _SMALL)
    spread, error = (_NORMAL * np.median(np.abs(off), axis=0) for off in (apart[:, :4] - usual, apart[:, 4:]))
    found = {"usual": usual, "spread": np.maximum(spread, _LEAST_SHARE), "error": np.maximum(error, _LEAST_SHARE)}
    return {name: tuple(values.tolist()) for name, values in found.items()}


_NORMAL = 1.4826  # a Gaussian's deviation by its median absolute value

_LEAST_PX, _LEAST_SHARE = 0.5, 0.01


def _widened(columns: Columns, draft: Detectors) -> Detectors:
    """Scale covariances so that their regions hold what they promise, in groups that were left out."""
    # the squared radius is halfway, as a ratio, between those of a Student distribution and a Gaussian with the same
    # covariances, so that neither reading of them is off by much
    promised = np.sqrt(
        radius_squared(_LEVEL, degrees_of_freedom=draft.degrees_of_freedom)
        * radius_squared(_LEVEL, degrees_of_freedom=float("inf"))
    )
    drafts = _left_out(columns, draft)
    alone = _distances(columns, drafts, by_image=False)
    first = {name: _ratios(columns, name, alone, promised, matched=False) for name in draft.classes}
    drafts = [_scaled(left, first) for left in drafts]
    both = _distances(columns, drafts, by_image=True)
    second = {name: _ratios(columns, name, both, promised, matched=True) for name in draft.classes}
    return _scaled(draft, first, agreed=second)


def _left_out(columns: Columns, draft: Detectors) -> list[Detectors]:
    """For each group what the others state; of a single group there are no others."""
    if len(columns.groups) < 2:
        return [draft]
    drafts = []
    for group in range(len(columns.groups)):
        others, classes = columns.without(group).sweep, {}
        for name, own in draft.classes.items():
            rows = others.kind == list(KINDS).index(name)
            sweep = SweepColumns(*(column[rows] for column in others))
            noise = _fit_noise(sweep, own.sweep, draft.degrees_of_freedom)
            classes[name] = replace(own, noise=noise, image_noise=_fit_image_noise(sweep))
        drafts.append(replace(draft, classes=MappingProxyType(classes)))
    return drafts


def _distances(columns: Columns, drafts: list[Detectors], *, by_image: bool) -> Float64Array:
    """Squared Mahalanobis distances of the errors of middles, sizes and headings, (N, 3), each by its own group."""
    tables = [noise_table(draft) for draft in drafts]
    found = np.full((len(columns.sweep.kind), 3), np.nan)
    for ready in columns.prepared:
        rows = slice(ready.first, ready.first + len(ready.boxes))
        kinds, reported = columns.sweep.kind[rows], columns.sweep.reported[rows]
        group = int(columns.sweep.group[ready.first]) if len(ready.boxes) else 0
        table = tables[min(group, len(tables) - 1)]
        boxes, none = ready.boxes.copy(), np.zeros((0, 7, 7))
        covariances, of_yaws, _ = box_covariances(boxes, reported, none, np.arange(len(boxes)), kinds, table)
        if by_image:
            refine(
                ready.pair.camera,
                ready.pair.camera_from_lidar,
                ready.outlines,
                boxes,
                covariances,
                ready.partners,
                ready.corners_xyxy,
                image_sigmas(table, kinds),
            )
        errors = columns.sweep.errors[rows].copy()
        # from the axes of the boxes into their frame
        along, across, yaws = errors[:, 0].copy(), errors[:, 1].copy(), boxes[:, 6]
        errors[:, 0] = np.cos(yaws) * along - np.sin(yaws) * across
        errors[:, 1] = np.sin(yaws) * along + np.cos(yaws) * across
        errors[:, :6] += boxes[:, :6] - ready.boxes[:, :6]
        for k, part in enumerate(_PARTS[:2]):
            solved = np.linalg.solve(covariances[:, part, part], errors[:, part, None])[..., 0]
            found[rows, k] = (errors[:, part] * solved).sum(axis=1)
        found[rows, 2] = errors[:, 6] ** 2 / of_yaws
    return found


_Ratios = tuple[float, float, float]


def _ratios(columns: Columns, name: str, distances: Float64Array, promised: float, *, matched: bool) -> _Ratios:
    """By how much covariances of middles, sizes and headings are too small."""
    rows: BoolArray = (columns.sweep.kind == list(KINDS).index(name)) & np.isfinite(distances).all(axis=1)
    if matched:
        rows &= columns.sweep.matched
    if rows.sum() < _LEAST_ERRORS:
        return (1.0, 1.0, 1.0)
    weights, found = np.ones(int(rows.sum())), []
    for k in range(3):
        # of a single number the same rule of thumb, by a Gaussian's square
        limit = promised if k < 2 else promised / 3.0 * _OF_ONE
        found.append(max(weighted_quantile(distances[rows, k], weights, _LEVEL) / limit, _LEAST_RATIO))
    return (found[0], found[1], found[2])


_LEAST_RATIO = 0.01

_OF_ONE = 3.0 * 3.84 / 7.81  # a Gaussian's 95 % of one number against those of three


def _scaled(
    draft: Detectors, ratios: Mapping[str, _Ratios], *, agreed: Mapping[str, _Ratios] | None = None
) -> Detectors:
    classes = {}
    for name, own in draft.classes.items():
        center, size, yaw = (float(np.log(ratio) / 2.0) for ratio in ratios[name])
        (x, y, z), (length, width, height) = own.noise.center_base, own.noise.size_base
        noise = replace(
            own.noise,
            center_base=(x + center, y + center, z + center),
            size_base=(length + size, width + size, height + size),
            yaw=(own.noise.yaw[0] + yaw, *own.noise.yaw[1:]),
        )
        if agreed is not None:
            noise = replace(noise, agreed=agreed[name][:2])
        classes[name] = replace(own, noise=noise)
    return replace(draft, classes=MappingProxyType(classes))


@dataclass(frozen=True, slots=True, kw_only=True)
class FitSettings:
    """Settings of a fit.

    Attributes:
        overlap: in space, from which on a box is true.
        surest_3d: scores of sweeps are held at these logarithms of odds at the most.
        least_count: classes with fewer boxes that are true or false get no numbers of their own.
        degrees_of_freedom: of the Student distribution of errors.
        weak_recall_2d, weak_share: how poorly a camera may do, and in what share of images; drives by day do not state.
        otherwise: class whose numbers hold for words that no table has. [default: the class with the most boxes]
    """

    overlap: float = 0.5
    surest_3d: float = float("inf")
    least_count: int = 200
    degrees_of_freedom: float = 5.0
    weak_recall_2d: float = 0.7
    weak_share: float = 0.1
    otherwise: str | None = None


DEFAULTS = FitSettings()


def fit_detectors(
    examples: Iterable[LabelledPair],
    *,
    name: str,
    settings: FitSettings = DEFAULTS,
    provenance: Mapping[str, str] | None = None,
) -> Detectors:
    """Fit what two detectors are like to drives of which the truth is known.

    Widths of regions are fitted by leaving out one group after the other, since errors of one drive are alike.

    Args:
        examples: of several groups, best ten or more, in which the detectors did not learn.
        provenance: where the examples are from; kept with the numbers.

    Raises:
        OptionError: no class has enough boxes.
    """
    columns = columns_of(examples, overlap=settings.overlap)
    return fit_columns(columns, name=name, settings=settings, provenance=provenance)


def fit_columns(
    columns: Columns, *, name: str, settings: FitSettings = DEFAULTS, provenance: Mapping[str, str] | None = None
) -> Detectors:
    """Fit what two detectors are like to examples that were held against the truth; else as `fit_detectors`."""
    names = tuple(KINDS)
    judged = columns.sweep.kind[columns.sweep.verdict != IGNORED]
    counts = np.bincount(judged, minlength=len(names))[: len(names)]
    kinds = [k for k, count in enumerate(counts.tolist()) if count >= settings.least_count]
    if not kinds:
        raise OptionError(f"boxes of one class {counts.max(initial=0)}; expected {settings.least_count} or more")
    classes = {names[kind]: _fit_class(columns, kind, settings) for kind in kinds}
    draft = Detectors(
        name=name,
        classes=MappingProxyType(classes),
        otherwise=settings.otherwise or names[max(kinds, key=lambda kind: int(counts[kind]))],
        degrees_of_freedom=settings.degrees_of_freedom,
        provenance=MappingProxyType(dict(provenance or {})),
    )
    return _widened(columns, draft)


def _fit_class(columns: Columns, kind: int, settings: FitSettings) -> ClassStatistics:
    sweep = SweepColumns(*(column[columns.sweep.kind == kind] for column in columns.sweep))
    image = ImageColumns(*(column[columns.image.kind == kind] for column in columns.image))
    of_sweep = fit_reported(sweep.reported, sweep.verdict, highest=settings.surest_3d)
    of_image = fit_reported(image.reported, image.verdict, highest=_SUREST_2D)
    return ClassStatistics(
        sweep=of_sweep,
        image=of_image,
        both=_fit_agreement(sweep, of_sweep, of_image),
        visibility=_fit_visibility(
            sweep, image, weak_recall_2d=settings.weak_recall_2d, weak_share=settings.weak_share
        ),
        noise=_fit_noise(sweep, of_sweep, settings.degrees_of_freedom),
        image_noise=_fit_image_noise(sweep),
    )
