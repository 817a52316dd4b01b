"""Fusing where a detector does not look for a class: its silence says nothing about objects of that class."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Int64Array
from sceneloom.detections.projection import fuse_by_projection
from sceneloom.detections.results import NO_BOX, DetectionPair, FusedBoxes
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.scene.detections import Boxes2D, Boxes3D

Classes = frozenset[str] | None
"""Those that a detector looks for; None for all that there are."""


@dataclass(frozen=True, slots=True, eq=False)
class CoveringFusion:
    """Fusion by projection for detectors that do not look for the same classes.

    Attributes:
        classes_2d, classes_3d: that the detectors of images and of sweeps look for.
        settings: what is taken for granted about detectors otherwise.
    """

    classes_2d: Classes
    classes_3d: Classes
    settings: ProjectionSettings

    def __call__(self, pair: DetectionPair) -> FusedBoxes:
        """Fuse the boxes that both could find, and take those that only one could find as they are."""
        in_space = _looked_for(pair.boxes_3d, self.classes_2d)
        in_image = _looked_for(pair.boxes_2d, self.classes_3d)
        parts = [_part(pair, in_space, in_image, self.settings)]
        none = np.zeros(len(pair.boxes_3d), np.bool_), np.zeros(len(pair.boxes_2d), np.bool_)
        if not in_space.all():
            parts.append(_part(pair, ~in_space, none[1], replace(self.settings, recall_2d=0.0)))
        if not in_image.all():
            parts.append(_part(pair, none[0], ~in_image, replace(self.settings, recall_3d=0.0)))
        return together(parts)


def _looked_for(boxes: Boxes3D | Boxes2D, classes: Classes) -> BoolArray:
    return np.array([classes is None or label in classes for label in boxes.labels], np.bool_)


def _part(
    pair: DetectionPair, in_space: BoolArray, in_image: BoolArray, settings: ProjectionSettings
) -> FusedBoxes:
    """Fuse some of the boxes; rows are reported all."""
    if in_space.all() and in_image.all():
        return fuse_by_projection(pair, settings=settings)
    rows_3d, rows_2d = np.flatnonzero(in_space), np.flatnonzero(in_image)
    some = replace(pair, boxes_3d=pair.boxes_3d.select(rows_3d), boxes_2d=pair.boxes_2d.select(rows_2d))
    fused = fuse_by_projection(some, settings=settings)
    return replace(fused, rows_3d=_of_all(fused.rows_3d, rows_3d), rows_2d=_of_all(fused.rows_2d, rows_2d))


def _of_all(rows: Int64Array, chosen: Int64Array) -> Int64Array:
    return np.array([NO_BOX if row == NO_BOX else chosen[row] for row in rows.tolist()], np.int64)


def together(parts: Sequence[FusedBoxes]) -> FusedBoxes:
    """Put the objects of one pair together, numbered anew; columns that only some have are left out."""
    if len(parts) == 1:
        return parts[0]
    filled = [part for part in parts if len(part)] or parts[:1]
    columns: dict[str, Any] = {}
    for f in fields(FusedBoxes):
        values = [getattr(part, f.name) for part in filled]
        if all(isinstance(value, np.ndarray) for value in values):
            columns[f.name] = np.concatenate(values)
        elif any(isinstance(value, np.ndarray) for value in values):
            columns[f.name] = None
    labels = tuple(label for part in filled for label in part.labels)
    return replace(filled[0], **{**columns, "labels": labels, "ids": np.arange(len(labels))})


def fusion_for(
    classes_2d: Classes, classes_3d: Classes, found: frozenset[str], settings: ProjectionSettings
) -> Callable[[DetectionPair], FusedBoxes] | None:
    """Give the fusion for detectors of some classes; None where both look for all that was found."""
    if all(classes is None or found <= classes for classes in (classes_2d, classes_3d)):
        return None
    return CoveringFusion(classes_2d, classes_3d, settings)
