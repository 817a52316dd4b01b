"""Detection fusion by projection: boxes of the sweep are put into the picture, and paired there with its boxes.

What becomes of the boxes:

- A pair is one object: where and how large the sweep's box says; with the class of the surer detector, the picture's
  box, and the existence that both together make likely.
- A box of the sweep alone stays an object. If the picture shows its place, and its detector should have found it
  there, it becomes less likely.
- A box of the picture alone stays an object too, at the distance that its height in the picture and the usual height
  of its class give; how little that is worth is in its covariance. Whoever wants measured objects alone takes those
  with a box in the sweep.

Boxes whose place or size is no number are left out.
"""

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.detections import existence
from sceneloom.detections.assignment import assign, pair_gains
from sceneloom.detections.camera_only import Placed, place_by_height
from sceneloom.detections.classes import codes, says_nothing
from sceneloom.detections.noise import center_and_size_covariances
from sceneloom.detections.outlines import Outlines, project_outlines
from sceneloom.detections.refinement import refine
from sceneloom.detections.results import NO_BOX, DetectionPair, FusedBoxes
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.errors import OptionError
from sceneloom.scene.detections import Boxes2D, Boxes3D
from sceneloom.scene.types import PointsFrame

DEFAULTS = ProjectionSettings()


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
    rows_3d, rows_2d = _sound_3d(pair.boxes_3d), _sound_2d(pair.boxes_2d)
    boxes_3d, boxes_2d = pair.boxes_3d.select(rows_3d), pair.boxes_2d.select(rows_2d)
    outlines = project_outlines(pair.camera, pair.camera_from_lidar, boxes_3d)
    odds_3d = existence.log_odds(boxes_3d.scores, boxes_3d.score_form, prior=settings.prior)
    odds_2d = existence.log_odds(boxes_2d.scores, boxes_2d.score_form, prior=settings.prior)
    gains = pair_gains(
        outlines.corners_xyxy,
        boxes_2d.corners_xyxy,
        *codes(boxes_3d.labels, boxes_2d.labels),
        existence.probabilities(odds_3d),
        existence.probabilities(odds_2d),
        least_iou=settings.least_iou,
    )
    matched_3d, matched_2d = assign(gains)
    partners = np.full(len(boxes_3d), NO_BOX)
    partners[matched_3d] = matched_2d
    alone = (
        np.setdiff1d(np.arange(len(boxes_2d)), matched_2d) if settings.keep_camera_only else matched_2d[:0]
    )
    placed = place_by_height(pair.camera, pair.camera_from_lidar, boxes_2d.select(alone))
    alone, placed = alone[placed.known], placed.some(placed.known)

    odds = odds_3d + np.log1p(-_chances_2d(outlines, settings))
    odds[matched_3d] = existence.agreed(odds_3d[matched_3d], odds_2d[matched_2d], prior=settings.prior)
    odds_alone = existence.missed(odds_2d[alone], _chances_3d(placed, settings))
    corners = outlines.corners_xyxy.copy()
    corners[matched_3d] = boxes_2d.corners_xyxy[matched_2d]
    states = np.concatenate([boxes_3d.centers, boxes_3d.sizes_lwh], axis=1)
    covariances = center_and_size_covariances(boxes_3d)
    states[matched_3d], covariances[matched_3d] = refine(
        pair.camera,
        pair.camera_from_lidar,
        outlines.axes_camera[matched_3d],
        outlines.corners_camera[matched_3d],
        states[matched_3d],
        covariances[matched_3d],
        boxes_2d.corners_xyxy[matched_2d],
    )
    count = len(boxes_3d) + len(alone)
    return FusedBoxes(
        pair.boxes_3d.timestamp_ns,
        np.concatenate([states[:, :3], placed.centers]),
        np.concatenate([covariances[:, :3, :3], placed.center_covariances]),
        np.concatenate([states[:, 3:], placed.sizes_lwh]),
        np.concatenate([covariances[:, 3:, 3:], placed.size_covariances]),
        np.concatenate([boxes_3d.yaws, np.zeros(len(alone))]),
        _velocities(boxes_3d, len(alone)),
        existence.probabilities(np.concatenate([odds, odds_alone])),
        _labels(boxes_3d, boxes_2d, partners, odds_3d, odds_2d)
        + tuple(boxes_2d.labels[k] for k in alone.tolist()),
        np.concatenate([corners, boxes_2d.corners_xyxy[alone]]),
        np.arange(count),
        np.concatenate([rows_3d, np.full(len(alone), NO_BOX)]),
        np.concatenate(
            [np.where(partners == NO_BOX, NO_BOX, np.append(rows_2d, NO_BOX)[partners]), rows_2d[alone]]
        ),
    )


def _sound_3d(boxes: Boxes3D) -> Int64Array:
    sound = np.isfinite(boxes.centers).all(axis=1) & np.isfinite(boxes.yaws)
    sound &= (np.isfinite(boxes.sizes_lwh) & (boxes.sizes_lwh > 0.0)).all(axis=1)
    return np.flatnonzero(sound)


def _sound_2d(boxes: Boxes2D) -> Int64Array:
    corners = boxes.corners_xyxy
    sound = np.isfinite(corners).all(axis=1) & (corners[:, 2:] > corners[:, :2]).all(axis=1)
    return np.flatnonzero(sound)


def _chances_2d(outlines: Outlines, settings: ProjectionSettings) -> Float64Array:
    """The chances that the detector of the picture had to find boxes of the sweep, (N,)."""
    heights = outlines.corners_xyxy[:, 3] - outlines.corners_xyxy[:, 1]
    return np.where(heights >= settings.least_height_px, settings.recall_2d * outlines.seen_shares, 0.0)


def _chances_3d(placed: Placed, settings: ProjectionSettings) -> Float64Array:
    """The chances that the detector of the sweep had to find objects of the picture, (N,)."""
    return np.where(placed.ranges <= settings.farthest_3d, settings.recall_3d, 0.0)


def _labels(
    boxes_3d: Boxes3D, boxes_2d: Boxes2D, partners: Int64Array, odds_3d: Float64Array, odds_2d: Float64Array
) -> tuple[str, ...]:
    """The classes of the objects of a sweep: of two detectors what the surer one says, if it says anything."""
    labels = list(boxes_3d.labels)
    for k in np.flatnonzero(partners != NO_BOX).tolist():
        other = boxes_2d.labels[partners[k]]
        surer = odds_2d[partners[k]] > odds_3d[k]
        if says_nothing(labels[k]) or (surer and not says_nothing(other)):
            labels[k] = other
    return tuple(labels)


def _velocities(boxes: Boxes3D, others: int) -> Float64Array | None:
    """Velocities, of objects that the sweep does not have 0; None where its detector gives none."""
    return None if boxes.velocities is None else np.concatenate([boxes.velocities, np.zeros((others, 3))])
