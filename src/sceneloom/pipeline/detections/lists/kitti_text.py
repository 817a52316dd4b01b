"""KITTI's text as lists of boxes: the detectors' lists with commas, and results with blanks."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.kitti.camera_boxes import CENTRE_TO_CORNER, lidar_boxes
from sceneloom.formats.kitti.detection_lists import (
    COLUMNS_2D,
    COLUMNS_3D,
    TYPES,
    class_word,
    read_boxes_2d_list,
    read_boxes_3d_list,
)
from sceneloom.formats.kitti.labels import DONT_CARE, KittiLabels, read_labels
from sceneloom.formats.ledger import Ledger
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.detections.lists.context import ListContext, ListForm
from sceneloom.scene.detections import Boxes2D, Boxes3D, ScoreForm
from sceneloom.scene.warnings import WarningKind


def _has_commas(head: str) -> bool:
    words = head.split("\n", 1)[0].split(",")
    return len(words) in (len(COLUMNS_2D), len(COLUMNS_3D)) and words[0].strip().lstrip("-").isdigit()


def _has_blanks(head: str) -> bool:
    words = head.split("\n", 1)[0].split()
    return len(words) in (15, 16, 17, 18) and any(word[:1].isalpha() for word in words[:3])


def _lists_3d(path: Path, context: ListContext, ledger: Ledger) -> Sequence[Boxes3D]:
    label = context.label or (_folder_label(path) if path.parent.name in TYPES.values() else None)
    found = read_boxes_3d_list(path, label, ledger)
    values = found.values
    centers, sizes, yaws = _in_sensor(path, context, ledger, values[:, 7:10], values[:, 10:13], values[:, 13])
    rows = _rows_by_frame(found.frames, context, path)
    return [
        Boxes3D(
            time_ns,
            centers[kept],
            sizes[kept],
            yaws[kept],
            values[kept, 6],
            tuple(found.labels[k] for k in kept.tolist()),
            score_form=ScoreForm.LOGIT,
            sensor_id=context.sensor_id,
        )
        for time_ns, kept in rows
    ]


def _lists_2d(path: Path, context: ListContext, ledger: Ledger) -> Sequence[Boxes2D]:
    found = read_boxes_2d_list(path, context.label or _folder_label(path), ledger)
    return [
        Boxes2D(
            time_ns,
            found.values[kept, 1:5] + CENTRE_TO_CORNER,
            found.values[kept, 5],
            tuple(found.labels[k] for k in kept.tolist()),
            sensor_id=context.sensor_id,
        )
        for time_ns, kept in _rows_by_frame(found.frames, context, path)
    ]


def _folder_label(path: Path) -> str:
    return class_word(path.resolve().parent.name)


def _results_3d(path: Path, context: ListContext, ledger: Ledger) -> Sequence[Boxes3D]:
    results = _results(path)
    results = results.select(results.have_position)
    placed = _in_sensor(path, context, ledger, results.sizes_hwl, results.bottoms, results.rotations_y)
    centers, sizes, yaws = placed
    scores, form = _scores(results)
    return [
        Boxes3D(
            time_ns,
            centers[kept],
            sizes[kept],
            yaws[kept],
            scores[kept],
            tuple(results.types[k] for k in kept.tolist()),
            score_form=form,
            sensor_id=context.sensor_id,
        )
        for time_ns, kept in _rows_by_frame(results.frames, context, path)
    ]


def _results_2d(path: Path, context: ListContext, ledger: Ledger) -> Sequence[Boxes2D]:
    del ledger
    results = _results(path)
    scores, form = _scores(results)
    return [
        Boxes2D(
            time_ns,
            results.corners_xyxy[kept] + CENTRE_TO_CORNER,
            scores[kept],
            tuple(results.types[k] for k in kept.tolist()),
            score_form=form,
            sensor_id=context.sensor_id,
        )
        for time_ns, kept in _rows_by_frame(results.frames, context, path)
    ]


def _results(path: Path) -> KittiLabels:
    labels = read_labels(path)
    return labels.select(np.array([word != DONT_CARE for word in labels.types], np.bool_))


def _scores(results: KittiLabels) -> tuple[Float64Array, ScoreForm]:
    """Labels without scores are certain; scores beyond 0 to 1 are logits."""
    if results.scores is None:
        return np.ones(len(results)), ScoreForm.PROBABILITY
    within = len(results) == 0 or (results.scores.min() >= 0.0 and results.scores.max() <= 1.0)
    return results.scores, ScoreForm.PROBABILITY if within else ScoreForm.LOGIT


def _in_sensor(
    path: Path,
    context: ListContext,
    ledger: Ledger,
    sizes_hwl: Float64Array,
    bottoms: Float64Array,
    rotations_y: Float64Array,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    sensor_from_camera = context.sensor_from_camera
    if sensor_from_camera is None:
        if len(bottoms):
            problem = (
                "its boxes are in the camera's frame, and no camera is known; expected one, or `--camera ID`"
            )
            raise DataError(path, "", problem)
        sensor_from_camera = RigidTransform.identity()
    message = "its boxes are taken to be in the frame of the camera that was chosen"
    ledger.note(WarningKind.ASSUMED, "boxes-in-camera-frame", str(path), message)
    return lidar_boxes(sizes_hwl, bottoms, rotations_y, sensor_from_camera.inverse())


def _rows_by_frame(frames: Int64Array, context: ListContext, path: Path) -> list[tuple[int, Int64Array]]:
    """For each frame of the sensor its time and the rows of its boxes, in the order of the file.

    Raises:
        DataError: a box is of a frame that the sensor does not have.
    """
    if len(frames):
        context.time_of(int(frames.min()), path, "")
        context.time_of(int(frames.max()), path, "")
    return [
        (time_ns, np.flatnonzero(frames == frame))
        for frame, time_ns in enumerate(context.timestamps_ns.tolist())
    ]


LISTS = ListForm(
    "kitti-lists",
    "lines of 6 or 15 numbers with commas, a frame's number first",
    _has_commas,
    _lists_3d,
    _lists_2d,
)
RESULTS = ListForm(
    "kitti-results",
    "KITTI's text of labels or results, 15 to 18 words a line",
    _has_blanks,
    _results_3d,
    _results_2d,
)
