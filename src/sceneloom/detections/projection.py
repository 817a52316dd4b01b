"""Detection fusion by projection: boxes of the sweep are put into the image, and paired there with its boxes.

What becomes of the boxes:

- A pair is one object: where and how large the sweep's box says, sharpened by the image's (`refinement`); with the
  class of the surer detector, the image's box, and the existence that both together make likely (`existence`).
- A box of the sweep alone stays an object. If the image shows its location openly, and its detector should have found
it
  there, it becomes less likely.
- A box of the image alone stays an object too, at the distance that its height in the image and the usual height
  of its class give (`camera_only`), or that of the points of the sweep behind it, where these are given and report one
  (`frustum`); how little that is worth is in its covariance. Its heading is not known, and given as 0. Whoever wants
  measured objects alone takes those with a box in the sweep.

Boxes whose location or size is no number are left out.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.detections.assignment import assign, pair_gains
from sceneloom.detections.camera_only import Placed, position_by_height
from sceneloom.detections.classes import numbers_of, says_nothing, table_rows
from sceneloom.detections.frustum import position_by_points
from sceneloom.detections.headings import orient_by_motion
from sceneloom.detections.noise import box_covariances, image_sigmas, widen_agreed
from sceneloom.detections.outlines import Outlines, boxes_with_area, boxes_with_position, project_outlines
from sceneloom.detections.refinement import refine
from sceneloom.detections.results import NO_BOX, DetectionPair, FusedBoxes
from sceneloom.detections.settings import ProjectionSettings, Tables, tables_of
from sceneloom.errors import OptionError
from sceneloom.kernels import existence_probability
from sceneloom.scene.detections import Boxes2D, Boxes3D, ScoreForm
from sceneloom.scene.types import PointsFrame

DEFAULTS = ProjectionSettings()


def fuse_by_projection(pair: DetectionPair, *, settings: ProjectionSettings = DEFAULTS) -> FusedBoxes:
    """Fuse the boxes of one sweep with those of one image.

    Args:
        pair: the boxes, and how their frames lie.
        settings: what is taken for granted about the detectors.

    Returns:
        The objects: those of the boxes of the sweep in their order, then those of the other boxes of the image.

    Raises:
        CalibrationError: the camera model is unknown.
        OptionError: the boxes of the sweep are not in the lidar's frame, or there are no such detectors.
        DataError: the file of the detectors says something else.

    Source: DB34/T 4101-2022, clause 5.7 and table 10 name what is asked for; how is ours.
    """
    if pair.boxes_3d.frame is not PointsFrame.SENSOR:
        raise OptionError(f"boxes in the {pair.boxes_3d.frame} frame; expected the lidar's")
    tables = tables_of(settings)
    sweep, image = _seen(pair, tables.existence)
    outlines = project_outlines(pair.camera, pair.camera_from_lidar, sweep.numbers, likely=sweep.likely)
    gains = pair_gains(
        outlines.corners_xyxy,
        image.numbers,
        sweep.classes,
        image.classes,
        sweep.likely,
        image.likely,
        least_iou=settings.least_iou,
    )
    partners, taken = assign(gains)
    scores = existence_probability.scores_of_sweep(
        outlines.corners_xyxy,
        outlines.seen_shares,
        partners,
        sweep.reported,
        sweep.odds,
        image.numbers,
        image.reported,
        sweep.kinds,
        tables.existence,
    )
    spread = _refined(pair, sweep, image, outlines, partners, tables, settings)
    alone = np.flatnonzero(taken == NO_BOX) if settings.keep_camera_only else _NO_ROWS
    placed, by_points = _placed(pair, sweep, image, alone)
    others = existence_probability.scores_of_image(
        placed.rows, placed.ranges, image.odds, image.kinds, tables.existence
    )
    scores = np.concatenate([scores, others])
    labels = (*_labels(sweep, image, partners), *(image.labels[k] for k in placed.rows.tolist()))
    fused = _joined(
        pair, sweep, image, outlines, partners, spread, placed, scores, labels, tables.degrees_of_freedom
    )
    if by_points is None:
        return fused
    return replace(fused, by_points=np.concatenate([np.zeros(len(sweep.rows), np.bool_), by_points]))


_BELIEVED = 0.3
"""Points in a box of the sweep that is less likely than this may be another object's."""
_NO_ROWS = np.zeros(0, np.int64)
_NOT_REPORTED = np.zeros((0, 7, 7))
_ANY_YAW = np.pi**2 / 3.0
"""Variance of a heading of which nothing is known [rad²]."""


class _Seen(NamedTuple):
    """The boxes of one detector that have a location.

    Attributes:
        numbers: (N, 7) float64 of `outlines.boxes_with_position`, or (N, 4) of `outlines.boxes_with_area`.
        rows: (N,) int64, which of the detector's boxes these are.
        labels: N classes.
        classes: (N,) int64 of `classes.numbers_of`.
        kinds: (N,) int64, rows of tables.
        reported: (N,) float64, logarithms of the odds that each exists, as the detector names them; NaN for no numbers.
        odds: (N,) float64, the same as they come true of that detector.
        likely: (N,) float64, the probabilities.
    """

    numbers: Float64Array
    rows: Int64Array
    labels: Sequence[str]
    classes: Int64Array
    kinds: Int64Array
    reported: Float64Array
    odds: Float64Array
    likely: Float64Array


def _seen(pair: DetectionPair, table: Float64Array) -> tuple[_Seen, _Seen]:
    three, two = pair.boxes_3d, pair.boxes_2d
    boxes, rows_3d = boxes_with_position(three.centers, three.sizes_lwh, three.yaws)
    corners, rows_2d = boxes_with_area(two.corners_xyxy)
    labels_3d, labels_2d = _some(three.labels, rows_3d), _some(two.labels, rows_2d)
    classes_3d, classes_2d = numbers_of(labels_3d, labels_2d)
    return (
        _weighed(three, boxes, rows_3d, labels_3d, classes_3d, table),
        _weighed(two, corners, rows_2d, labels_2d, classes_2d, table),
    )


def _some(labels: tuple[str, ...], rows: Int64Array) -> Sequence[str]:
    return labels if len(rows) == len(labels) else [labels[k] for k in rows.tolist()]


def _weighed(
    boxes: Boxes3D | Boxes2D,
    numbers: Float64Array,
    rows: Int64Array,
    labels: Sequence[str],
    classes: Int64Array,
    table: Float64Array,
) -> _Seen:
    kinds = table_rows(classes)
    odds = existence_probability.reported_odds(
        boxes.scores, rows, boxes.score_form is ScoreForm.LOGIT, isinstance(boxes, Boxes2D), kinds, table
    )
    return _Seen(numbers, rows, labels, classes, kinds, *odds)


class _Spread(NamedTuple):
    """How uncertain the objects of a sweep are.

    Attributes:
        covariances: (N, 6, 6) float64 [m²], of middles and sizes.
        of_yaws: (N,) float64 [rad²].
    """

    covariances: Float64Array
    of_yaws: Float64Array


def _refined(
    pair: DetectionPair,
    sweep: _Seen,
    image: _Seen,
    outlines: Outlines,
    partners: Int64Array,
    tables: Tables,
    settings: ProjectionSettings,
) -> _Spread:
    """Sharpen the boxes of a sweep by their partners; how uncertain they are is as their detector reports, or usual."""
    reported = _NOT_REPORTED if pair.boxes_3d.covariances is None else pair.boxes_3d.covariances
    covariances, of_yaws, own = box_covariances(
        sweep.numbers, sweep.reported, reported, sweep.rows, sweep.kinds, tables.noise
    )
    off_px = pair.camera.fx * np.radians(settings.rotation_sigma_deg)
    refine(
        pair.camera,
        pair.camera_from_lidar,
        outlines,
        sweep.numbers,
        covariances,
        partners,
        image.numbers,
        image_sigmas(tables.noise, sweep.kinds, added_px=off_px),
    )
    widen_agreed(covariances, partners, own, sweep.kinds, tables.noise)
    velocities = pair.boxes_3d.velocities
    if settings.time_sigma > 0.0 and velocities is not None:
        moved = np.where(np.isfinite(velocities), velocities, 0.0)[sweep.rows] * settings.time_sigma
        covariances[:, :3, :3] += moved[:, :, None] * moved[:, None]
    return _Spread(covariances, of_yaws)


def _placed(
    pair: DetectionPair, sweep: _Seen, image: _Seen, alone: Int64Array
) -> tuple[Placed, BoolArray | None]:
    """The objects of boxes of the image alone, and which of them points of the sweep have placed."""
    camera, camera_from_lidar = pair.camera, pair.camera_from_lidar
    placed = position_by_height(camera, camera_from_lidar, image.numbers, alone, image.kinds)
    if pair.points_lidar is None:
        return placed, None
    boxes = sweep.numbers[sweep.likely >= _BELIEVED]
    return position_by_points(
        camera, camera_from_lidar, pair.points_lidar, image.numbers, image.kinds, boxes, placed
    )


def _labels(sweep: _Seen, image: _Seen, partners: Int64Array) -> list[str]:
    """The classes of the objects of a sweep: of two detectors what the surer one says, if it says anything."""
    labels = list(sweep.labels)
    for row, partner in enumerate(partners.tolist()):
        if partner == NO_BOX or image.labels[partner] == labels[row]:
            continue
        other, surer = image.labels[partner], image.odds[partner] > sweep.odds[row]
        if says_nothing(labels[row]) or (surer and not says_nothing(other)):
            labels[row] = other
    return labels


def _joined(
    pair: DetectionPair,
    sweep: _Seen,
    image: _Seen,
    outlines: Outlines,
    partners: Int64Array,
    spread: _Spread,
    placed: Placed,
    scores: Float64Array,
    labels: tuple[str, ...],
    degrees_of_freedom: float,
) -> FusedBoxes:
    """The objects of the sweep, then those of the image alone."""
    count, spreads = len(placed.rows), spread.covariances
    sources = np.concatenate([partners, placed.rows])
    shown = np.flatnonzero(sources != NO_BOX)
    corners = np.concatenate([outlines.corners_xyxy, np.empty((count, 4))])
    corners[shown] = image.numbers[sources[shown]]
    rows_2d = np.full(len(sources), NO_BOX)
    rows_2d[shown] = image.rows[sources[shown]]
    yaws = np.concatenate([sweep.numbers[:, 6], np.zeros(count)])
    velocities = pair.boxes_3d.velocities
    if velocities is not None:
        velocities = np.concatenate([velocities[sweep.rows], np.zeros((count, 3))])
    return FusedBoxes(
        timestamp_ns=pair.boxes_3d.timestamp_ns,
        centers=np.concatenate([sweep.numbers[:, :3], placed.centers]),
        center_covariances=np.concatenate([spreads[:, :3, :3], placed.center_covariances]),
        sizes_lwh=np.concatenate([sweep.numbers[:, 3:6], placed.sizes_lwh]),
        size_covariances=np.concatenate([spreads[:, 3:, 3:], placed.size_covariances]),
        yaws=orient_by_motion(yaws, velocities),
        velocities=velocities,
        scores=scores,
        labels=labels,
        corners_xyxy=corners,
        ids=np.arange(len(labels)),
        rows_3d=np.concatenate([sweep.rows, np.full(count, NO_BOX)]),
        rows_2d=rows_2d,
        yaw_variances=np.concatenate([spread.of_yaws, np.full(count, _ANY_YAW)]),
        degrees_of_freedom=degrees_of_freedom,
    )
