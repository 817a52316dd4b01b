"""What detectors reported where the truth is known, as columns that numbers can be fitted to."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.detections.assignment import assign, pair_gains
from sceneloom.detections.classes import numbers_of, table_rows
from sceneloom.detections.existence import existence_table
from sceneloom.detections.independent import independent_detectors
from sceneloom.detections.outlines import Outlines, boxes_with_area, boxes_with_position, project_outlines
from sceneloom.detections.results import NO_BOX, DetectionPair
from sceneloom.kernels import existence_probability
from sceneloom.kernels.upright_overlaps import overlaps_in_space
from sceneloom.scene.detections import Boxes2D, Boxes3D, ScoreForm

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
    """

    pair: DetectionPair
    truth: Boxes3D
    counts: BoolArray
    neighbours: BoolArray
    regions_xyxy: Float64Array
    group: str
    least_height_px: float = 25.0


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
        apart: (N, 3) [px], how far the partner's middle across and upright and its height are off the outline of the
            object; NaN where none is known.
        sides: (N, 2) [px], width and height of the partner.
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
        examples: of a few drives.
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


def _example(
    example: LabelledPair, group: int, overlap: float
) -> tuple[Prepared, SweepColumns, ImageColumns]:
    pair = example.pair
    three, two = pair.boxes_3d, pair.boxes_2d
    boxes, rows_3d = boxes_with_position(three.centers, three.sizes_lwh, three.yaws)
    corners, rows_2d = boxes_with_area(two.corners_xyxy)
    labels_3d, labels_2d = _some(three.labels, rows_3d), _some(two.labels, rows_2d)
    classes_3d, classes_2d = numbers_of(labels_3d, labels_2d)
    kinds_3d, kinds_2d = table_rows(classes_3d), table_rows(classes_2d)
    reported_3d, likely_3d = _reported(three, rows_3d, kinds_3d)
    reported_2d, likely_2d = _reported(two, rows_2d, kinds_2d)
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
        truth.apart(pair, near, corners, partners),
        sides,
    )
    image = ImageColumns(
        np.full(len(corners), group),
        kinds_2d,
        reported_2d,
        truth.judge_image(pair, corners, classes_2d, likely_2d),
        taken != NO_BOX,
    )
    return Prepared(pair, 0, boxes, outlines, partners, corners), sweep, image


def _reported(
    boxes: Boxes3D | Boxes2D, rows: Int64Array, kinds: Int64Array
) -> tuple[Float64Array, Float64Array]:
    """What scores name: logarithms of odds, and probabilities."""
    logit, flat = boxes.score_form is ScoreForm.LOGIT, isinstance(boxes, Boxes2D)
    reported, _, likely = existence_probability.reported_odds(boxes.scores, rows, logit, flat, kinds, _TABLE)
    return reported, likely


def _some(labels: Sequence[str], rows: Int64Array) -> list[str]:
    return [labels[k] for k in rows.tolist()]


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
        self,
        boxes: Float64Array,
        classes: Int64Array,
        likely: Float64Array,
        shown: Float64Array,
        overlap: float,
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

    def judge_image(
        self, pair: DetectionPair, corners: Float64Array, classes: Int64Array, likely: Float64Array
    ) -> Int64Array:
        """Verdicts over boxes of the image, by the outlines of the true boxes there."""
        shown = project_outlines(pair.camera, pair.camera_from_lidar, self.boxes.copy()).corners_xyxy
        return self._judge(image_overlaps(corners, shown), classes, likely, corners, 0.5)[0]

    def _judge(
        self,
        overlaps: Float64Array,
        classes: Int64Array,
        likely: Float64Array,
        shown: Float64Array,
        least: float,
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
        excused = _shares_in(shown, example.regions_xyxy).max(axis=1, initial=0.0) > 0.0
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

    def apart(
        self, pair: DetectionPair, found: Int64Array, corners: Float64Array, partners: Int64Array
    ) -> Float64Array:
        """How far partners are off the true outlines, (N, 3) [px]; NaN where one of them may be cut."""
        apart = np.full((len(found), 3), np.nan)
        rows = self._own(np.where(partners == NO_BOX, NO_BOX, found))
        if not len(rows):
            return apart
        true = project_outlines(pair.camera, pair.camera_from_lidar, self.boxes.copy()).corners_xyxy[
            found[rows]
        ]
        own = corners[partners[rows]]
        limits = np.array([pair.camera.width, pair.camera.height]) - _BORDER_PX
        low, high = np.minimum(true, own)[:, :2], np.maximum(true, own)[:, 2:]
        whole = np.column_stack([low > _BORDER_PX, high < limits]).min(axis=1)
        off = own - true
        numbers = (off[:, 0] + off[:, 2]) / 2, (off[:, 1] + off[:, 3]) / 2, off[:, 3] - off[:, 1]
        apart[rows] = np.where(whole[:, None], np.column_stack(numbers), np.nan)
        return apart


_BORDER_PX = 3.0


def image_overlaps(one: Float64Array, other: Float64Array) -> Float64Array:
    """Intersections over unions of boxes of an image, (N, M)."""
    common = _common(one, other)
    areas = [_areas(boxes) for boxes in (one, other)]
    overlaps: Float64Array = common / np.maximum(areas[0][:, None] + areas[1] - common, 1e-9)
    return overlaps


def _shares_in(boxes: Float64Array, regions: Float64Array) -> Float64Array:
    """Which share of boxes lies in regions, (N, M)."""
    shares: Float64Array = _common(boxes, regions) / np.maximum(_areas(boxes), 1e-9)[:, None]
    return shares


def _areas(boxes: Float64Array) -> Float64Array:
    areas: Float64Array = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    return areas


def _common(one: Float64Array, other: Float64Array) -> Float64Array:
    wide = np.minimum(one[:, None, 2:], other[None, :, 2:]) - np.maximum(one[:, None, :2], other[None, :, :2])
    common: Float64Array = np.maximum(wide, 0.0).prod(axis=2)
    return common
