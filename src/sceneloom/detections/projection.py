"""Detection fusion by projection: boxes of the sweep are put into the picture, and paired there with its boxes.

What becomes of the boxes:

- A pair is one object: where and how large the sweep's box says, sharpened by the picture's (`refinement`); with the
  class of the surer detector, the picture's box, and the existence that both together make likely (`existence`).
- A box of the sweep alone stays an object. If the picture shows its place openly, and its detector should have found it
  there, it becomes less likely.
- A box of the picture alone stays an object too, at the distance that its height in the picture and the usual height
  of its class give (`camera_only`); how little that is worth is in its covariance. Its heading is not known, and given
  as 0. Whoever wants measured objects alone takes those with a box in the sweep.

Boxes whose place or size is no number are left out.
"""

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.detections import existence
from sceneloom.detections.assignment import assign, pair_gains
from sceneloom.detections.camera_only import place_by_height
from sceneloom.detections.classes import codes, says_nothing
from sceneloom.detections.noise import center_and_size_covariances
from sceneloom.detections.outlines import Outlines, project_outlines
from sceneloom.detections.refinement import refine
from sceneloom.detections.results import NO_BOX, DetectionPair, FusedBoxes
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.errors import OptionError
from sceneloom.kernels.sound_boxes import have_area, have_place
from sceneloom.scene.detections import Boxes2D, Boxes3D
from sceneloom.scene.types import PointsFrame

DEFAULTS = ProjectionSettings()

Boxes = TypeVar("Boxes", Boxes3D, Boxes2D)


def fuse_by_projection(pair: DetectionPair, *, settings: ProjectionSettings = DEFAULTS) -> FusedBoxes:
    """Fuse the boxes of one sweep with those of one picture.

    Args:
        pair: the boxes, and how their frames lie.
        settings: what is taken for granted about the detectors.

    Returns:
        The objects: those of the boxes of the sweep in their order, then those of the other boxes of the picture.

    Raises:
        CalibrationError: the lens is unknown.
        OptionError: the boxes of the sweep are not in the lidar's frame.

    Source: DB34/T 4101-2022, clause 5.7 and table 10 name what is asked for; how is ours.
    """
    if pair.boxes_3d.frame is not PointsFrame.SENSOR:
        raise OptionError(f"boxes in the {pair.boxes_3d.frame} frame; expected the lidar's")
    seen = _Seen.of(pair, settings)
    likely = existence.probabilities(seen.odds_3d)
    outlines = project_outlines(pair.camera, pair.camera_from_lidar, seen.boxes_3d, likely=likely)
    gains = pair_gains(
        outlines.corners_xyxy,
        seen.boxes_2d.corners_xyxy,
        *codes(seen.boxes_3d.labels, seen.boxes_2d.labels),
        likely,
        existence.probabilities(seen.odds_2d),
        least_iou=settings.least_iou,
    )
    matched = assign(gains)
    columns = _objects_of_sweep(pair, seen, outlines, matched, settings)
    labels = _labels(seen, matched)
    if settings.keep_camera_only and len(matched[1]) < len(seen.boxes_2d):
        others, other_labels = _objects_of_picture(pair, seen, matched[1], settings)
        columns = {name: np.concatenate([values, others[name]]) for name, values in columns.items()}
        labels += other_labels
    velocities = seen.boxes_3d.velocities
    if velocities is not None:
        velocities = np.concatenate([velocities, np.zeros((len(labels) - len(velocities), 3))])
    return FusedBoxes(
        timestamp_ns=pair.boxes_3d.timestamp_ns,
        labels=labels,
        ids=np.arange(len(labels)),
        velocities=velocities,
        **columns,
    )


Matched = tuple[Int64Array, Int64Array]
"""Rows of boxes of the sweep, and of their partners in the picture."""


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """The boxes of a pair that have a place, which rows of it they are, and logarithms of their odds."""

    boxes_3d: Boxes3D
    boxes_2d: Boxes2D
    rows_3d: Int64Array
    rows_2d: Int64Array
    odds_3d: Float64Array
    odds_2d: Float64Array

    @classmethod
    def of(cls, pair: DetectionPair, settings: ProjectionSettings) -> "_Seen":
        found = pair.boxes_3d
        boxes_3d, rows_3d = _some(found, have_place(found.centers, found.sizes_lwh, found.yaws))
        boxes_2d, rows_2d = _some(pair.boxes_2d, have_area(pair.boxes_2d.corners_xyxy))
        odds_3d, odds_2d = (
            existence.log_odds(boxes.scores, boxes.score_form, prior=settings.prior)
            for boxes in (boxes_3d, boxes_2d)
        )
        return cls(boxes_3d, boxes_2d, rows_3d, rows_2d, odds_3d, odds_2d)


def _some(boxes: Boxes, sound: BoolArray) -> tuple[Boxes, Int64Array]:
    rows = np.flatnonzero(sound)
    return (boxes if len(rows) == len(boxes) else boxes.select(rows)), rows


def _objects_of_sweep(
    pair: DetectionPair, seen: _Seen, outlines: Outlines, matched: Matched, settings: ProjectionSettings
) -> dict[str, Any]:
    """Columns of `FusedBoxes` of the boxes of the sweep."""
    boxes, (rows, partners) = seen.boxes_3d, matched
    heights = outlines.corners_xyxy[:, 3] - outlines.corners_xyxy[:, 1]
    expected = settings.recall_2d * outlines.seen_shares * (heights >= settings.least_height_px)
    odds = existence.missed(seen.odds_3d, expected)
    odds[rows] = existence.agreed(seen.odds_3d[rows], seen.odds_2d[partners], prior=settings.prior)
    corners, rows_2d = outlines.corners_xyxy, np.full(len(boxes), NO_BOX)
    corners[rows], rows_2d[rows] = seen.boxes_2d.corners_xyxy[partners], seen.rows_2d[partners]
    states = np.concatenate([boxes.centers, boxes.sizes_lwh], axis=1)
    covariances = center_and_size_covariances(boxes)
    states[rows], covariances[rows] = refine(
        pair.camera,
        pair.camera_from_lidar,
        outlines.axes_camera[rows],
        outlines.corners_camera[rows],
        states[rows],
        covariances[rows],
        corners[rows],
    )
    return {
        "centers": states[:, :3],
        "center_covariances": covariances[:, :3, :3],
        "sizes_lwh": states[:, 3:],
        "size_covariances": covariances[:, 3:, 3:],
        "yaws": boxes.yaws,
        "scores": existence.probabilities(odds),
        "corners_xyxy": corners,
        "rows_3d": seen.rows_3d,
        "rows_2d": rows_2d,
    }


def _objects_of_picture(
    pair: DetectionPair, seen: _Seen, partners: Int64Array, settings: ProjectionSettings
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Columns of `FusedBoxes` of the boxes of the picture without a partner, and their classes."""
    alone = np.ones(len(seen.boxes_2d), np.bool_)
    alone[partners] = False
    rows = np.flatnonzero(alone)
    corners, labels = seen.boxes_2d.corners_xyxy[rows], tuple(seen.boxes_2d.labels[k] for k in rows.tolist())
    placed = place_by_height(pair.camera, pair.camera_from_lidar, corners, labels)
    if not placed.known.all():
        kept = np.flatnonzero(placed.known)
        rows, corners, labels = rows[kept], corners[kept], tuple(labels[k] for k in kept.tolist())
        placed = placed.some(placed.known)
    expected = np.where(placed.ranges <= settings.farthest_3d, settings.recall_3d, 0.0)
    columns = {
        "centers": placed.centers,
        "center_covariances": placed.center_covariances,
        "sizes_lwh": placed.sizes_lwh,
        "size_covariances": placed.size_covariances,
        "yaws": np.zeros(len(rows)),
        "scores": existence.probabilities(existence.missed(seen.odds_2d[rows], expected)),
        "corners_xyxy": corners,
        "rows_3d": np.full(len(rows), NO_BOX),
        "rows_2d": seen.rows_2d[rows],
    }
    return columns, labels


def _labels(seen: _Seen, matched: Matched) -> tuple[str, ...]:
    """The classes of the objects of a sweep: of two detectors what the surer one says, if it says anything."""
    labels, others = list(seen.boxes_3d.labels), seen.boxes_2d.labels
    rows, partners = matched
    surer_2d = seen.odds_2d[partners] > seen.odds_3d[rows]
    for row, partner, surer in zip(rows.tolist(), partners.tolist(), surer_2d.tolist(), strict=True):
        if says_nothing(labels[row]) or (surer and not says_nothing(others[partner])):
            labels[row] = others[partner]
    return tuple(labels)
