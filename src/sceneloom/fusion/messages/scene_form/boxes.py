"""Boxes of records and of the scene model."""

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, UInt32Array
from sceneloom.errors import OptionError
from sceneloom.fusion.messages.basic_types import INTEGER_RANGES, BasicType
from sceneloom.fusion.messages.boxes import Boxes2d, Boxes3d
from sceneloom.fusion.messages.timestamps import Timestamp
from sceneloom.scene.detections import Boxes2D, Boxes3D, ScoreForm
from sceneloom.scene.types import Identifier, PointsFrame


def boxes_3d_of(record: Boxes3d, *, sensor_id: Identifier | None = None) -> Boxes3D:
    """Give the boxes of a list of table 7.

    A heading's vertical part is dropped: the model's boxes are upright. Velocities are the vectors, where the record
    has them, else the speeds along the directions.

    Args:
        sensor_id: the lidar in the scene; None for the record's own number.
    """
    directions = record.directions.astype(np.float64)
    if record.velocity_vectors is None:
        along = record.velocities / np.sqrt((directions * directions).sum(axis=1))
        velocities = directions * along[:, None]
    else:
        velocities = record.velocity_vectors.astype(np.float64)
    return Boxes3D(
        record.timestamp.nanoseconds,
        record.centers.astype(np.float64),
        record.sizes_lwh.astype(np.float64),
        np.arctan2(directions[:, 1], directions[:, 0]),
        record.confidence.astype(np.float64),
        record.class_names,
        velocities=velocities,
        ids=record.id.astype(np.int64),
        sensor_id=record.sensor_id if sensor_id is None else sensor_id,
    )


def boxes_3d_record(boxes: Boxes3D, *, sensor_id: int, seq: int) -> Boxes3d:
    """Give the list of table 7 of boxes in a lidar's frame.

    Boxes without ids are numbered, those without velocities are stationary, and covariances have no location. Scores of
    the form `logit` become probabilities.

    Raises:
        DataError: a number cannot stand in the record.
        OptionError: the boxes are in another frame.
    """
    if boxes.frame is not PointsFrame.SENSOR:
        raise OptionError(f"boxes in the {boxes.frame} frame; expected the lidar's")
    speeds = boxes.speeds
    return Boxes3d(
        sensor_id=sensor_id,
        seq=seq,
        timestamp=Timestamp.of(boxes.timestamp_ns),
        id=_ids(boxes),
        class_names=boxes.labels,
        confidence=_confidence(boxes),
        centers=boxes.centers.astype(np.float32),
        sizes_lwh=boxes.sizes_lwh.astype(np.float32),
        directions=boxes.directions.astype(np.float32),
        velocities=np.zeros(len(boxes), np.float32) if speeds is None else speeds.astype(np.float32),
        velocity_vectors=None if boxes.velocities is None else boxes.velocities.astype(np.float32),
    )


def boxes_2d_of(record: Boxes2d, *, sensor_id: Identifier | None = None) -> Boxes2D:
    """Give the boxes of a list of table 8; both count pixels from the image's own corner.

    Args:
        sensor_id: the camera in the scene; None for the record's own number.
    """
    return Boxes2D(
        record.timestamp.nanoseconds,
        record.corners_xyxy.astype(np.float64),
        record.confidence.astype(np.float64),
        record.class_names,
        ids=record.id.astype(np.int64),
        sensor_id=record.sensor_id if sensor_id is None else sensor_id,
    )


def boxes_2d_record(
    boxes: Boxes2D, *, sensor_id: int, seq: int, size_wh: tuple[int, int] | None = None
) -> Boxes2d:
    """Give the list of table 8 of boxes in an image, with the whole pixels that each touches.

    Boxes that have no area within the image, or are not finite, are left out: the record has fewer then.

    Args:
        size_wh: of the image [px], to which boxes are cut; None to cut at 0 alone.

    Raises:
        DataError: a number cannot stand in the record.
    """
    corners = _whole_corners(boxes.corners_xyxy, size_wh)
    sides = corners[:, 2:] > corners[:, :2]
    kept = np.logical_and(sides[:, 0], sides[:, 1])
    return Boxes2d(
        sensor_id=sensor_id,
        seq=seq,
        timestamp=Timestamp.of(boxes.timestamp_ns),
        id=_ids(boxes)[kept],
        class_names=tuple(name for name, keep in zip(boxes.labels, kept.tolist(), strict=True) if keep),
        confidence=_confidence(boxes)[kept],
        corners_xyxy=corners[kept],
    )


def _whole_corners(corners_xyxy: Float64Array, size_wh: tuple[int, int] | None) -> UInt32Array:
    """Give the whole pixels that boxes touch.

    Args:
        corners_xyxy: (N, 4) [px], left, upper, right and lower edge; of a box that is not finite all become 0.
        size_wh: of the image [px], to which boxes are cut.

    Returns:
        (N, 4) uint32: lower edges rounded down, upper ones up.
    """
    largest = 2**32 - 1
    width, height = (largest, largest) if size_wh is None else size_wh
    finite = np.isfinite(corners_xyxy).all(axis=1, keepdims=True)
    corners = np.where(finite, corners_xyxy, 0.0)
    whole = np.column_stack([np.floor(corners[:, :2]), np.ceil(corners[:, 2:])])
    cut: UInt32Array = np.clip(whole, 0, [width, height, width, height]).astype(np.uint32)
    return cut


def _ids(boxes: Boxes3D | Boxes2D) -> AnyArray:
    if boxes.ids is None:
        return np.arange(len(boxes), dtype=np.int32)
    low, high = INTEGER_RANGES[BasicType.INT32]
    if len(boxes) and (boxes.ids.min() < low or boxes.ids.max() > high):
        raise OptionError(f"ids up to {boxes.ids.max()}; expected {low} to {high}")
    return boxes.ids.astype(np.int32)


def _confidence(boxes: Boxes3D | Boxes2D) -> Float32Array:
    scores = boxes.scores
    if boxes.score_form is ScoreForm.LOGIT:
        # of large numbers of either sign, the exponential of the negative one
        small = np.exp(-np.abs(scores))
        scores = np.where(scores >= 0, 1.0, small) / (1.0 + small)
    return scores.astype(np.float32)
