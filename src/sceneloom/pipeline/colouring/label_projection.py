"""Labelled points of a scene, drawn into the images that show them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from sceneloom.arrays import UInt16Array
from sceneloom.colouring.labels import LabelCanvas
from sceneloom.colouring.results import FusedFrame
from sceneloom.errors import DataError
from sceneloom.formats.clouds.written import NO_LABEL
from sceneloom.formats.label_folders import NAMES_FILE
from sceneloom.formats.label_images import write_label_png
from sceneloom.pipeline.colouring.sweeps import SweepColouring
from sceneloom.scene.annotations.labelled_points import LabeledPointsAnnotation
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Key, key_of

_CANVASES = 2
"""Images of a camera that are drawn at once: sweeps of several lidars may meet them alternately."""


def numbered_labels(scene: Scene) -> dict[str, int]:
    """The number of each label of labelled points: the label itself where all are numbers, else 1, 2, … by name.

    Raises:
        DataError: there are no labelled points, or too many different labels.
    """
    names = sorted({_name(each) for each in _labelled(scene)})
    if not names:
        raise DataError(
            scene.source, "annotations", "no labelled points in it; expected labels of lidar frames"
        )
    if len(names) >= NO_LABEL:
        raise DataError(scene.source, "annotations", f"{len(names)} labels; expected at most {NO_LABEL - 1}")
    if all(name.isascii() and name.isdigit() and 0 < int(name) < NO_LABEL for name in names):
        return {name: int(name) for name in names}
    return {name: k for k, name in enumerate(names, 1)}


def _labelled(scene: Scene) -> list[LabeledPointsAnnotation]:
    return [each for each in scene.annotations if isinstance(each, LabeledPointsAnnotation)]


def _name(annotation: LabeledPointsAnnotation) -> str:
    return str(annotation.id) if annotation.label is None else annotation.label


@dataclass(slots=True)
class LabelProjection:
    """Draws labels: `<camera>/<image number>.png`, 0 where no labelled point is, and what the numbers mean.

    Attributes:
        scene: with labelled points, whose frames are counted as the results of the fusion are.
        folder: an empty folder.
        names: folder of each camera.
        colouring: knows the numbers of images.
        radius_px: of the square that a point fills beside its pixel.
        written: images so far.
    """

    scene: Scene
    folder: Path
    names: Mapping[Identifier, str]
    colouring: SweepColouring
    radius_px: int = 0
    written: int = 0
    numbers: dict[str, int] = field(default_factory=dict)
    _entries: dict[tuple[Key, int], list[tuple[int, Sequence[int]]]] = field(default_factory=dict)
    _open: dict[Identifier, dict[int, LabelCanvas]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.numbers = numbered_labels(self.scene)
        for annotation in _labelled(self.scene):
            for entry in annotation.labeled_points:
                if entry.sensor_frame is not None:
                    key = (key_of(entry.sensor_id), entry.sensor_frame)
                    reported = (self.numbers[_name(annotation)], entry.point_ids)
                    self._entries.setdefault(key, []).append(reported)  # type: ignore[arg-type]

    def add(self, frame: FusedFrame) -> None:
        """Draw the labels of one sweep into its images.

        Raises:
            DataError: a label names a point that the sweep does not have.
        """
        labels = self._labels(frame)
        for view in frame.views:
            canvases = self._open.setdefault(view.camera_id, {})
            number = self.colouring.number(view)
            if number not in canvases:
                if len(canvases) == _CANVASES:
                    self._write(view.camera_id, next(iter(canvases)))
                width, height = view.camera.width, view.camera.height
                canvases[number] = LabelCanvas.blank(width, height, radius_px=self.radius_px)
            canvases[number].draw(view, labels)

    def _labels(self, frame: FusedFrame) -> UInt16Array:
        labels = np.full(len(frame.points), NO_LABEL, np.uint16)
        for number, ids in self._entries.get((key_of(frame.lidar_id), frame.index), ()):
            if len(ids) and int(np.max(ids)) >= len(labels):
                location = f"annotations[].labeled_points[{frame.lidar_id}, frame {frame.index}]"
                problem = f"point {int(np.max(ids))}; expected numbers below {len(labels)}"
                raise DataError(self.scene.source, location, problem)
            labels[np.asarray(ids)] = number
        return labels

    def _write(self, camera_id: Identifier, number: int) -> None:
        canvas = self._open[camera_id].pop(number)
        folder = self.folder / self.names[camera_id]
        folder.mkdir(parents=True, exist_ok=True)
        write_label_png(canvas.labels, folder / f"{number:06d}.png", overwrite=True)
        self.written += 1

    def finish(self) -> None:
        """Write the last images, and what the numbers mean."""
        for camera_id, canvases in self._open.items():
            for number in [*canvases]:
                self._write(camera_id, number)
        reported = {str(number): name for name, number in self.numbers.items()}
        (self.folder / NAMES_FILE).write_bytes(msgspec.json.format(msgspec.json.encode(reported), indent=2))
