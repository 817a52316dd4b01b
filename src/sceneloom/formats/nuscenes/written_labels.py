"""Labelled points as files of classes, a byte for each point of a key frame."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sceneloom.arrays import UInt32Array
from sceneloom.formats.loss import Support
from sceneloom.formats.nuscenes.written_frames import FrameLosses
from sceneloom.formats.nuscenes.written_tables import token_of
from sceneloom.scene.annotations.labelled_points import LabeledPointsAnnotation
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Key, key_of

NOISE = "noise"
"""The class with the number 0, which points without a class get."""

_MOST = 255
_LOCATION = "annotations.labeled_points"


@dataclass(slots=True)
class PointClasses:
    """The classes of points, by lidar and frame.

    Attributes:
        numbers: of the classes, by name; empty where the scene labels no points.
        entries: class and rows of points, by lidar and number of the frame.
        rows: of the table lidarseg.
    """

    numbers: Mapping[str, int] = field(default_factory=dict)
    entries: dict[tuple[Key, int], list[tuple[int, UInt32Array]]] = field(default_factory=dict)
    rows: list[dict[str, str]] = field(default_factory=list)

    @classmethod
    def of(cls, scene: Scene, losses: FrameLosses) -> "PointClasses":
        """Gather the labelled points that are classes; those of single objects are left out."""
        found = [a for a in scene.annotations if isinstance(a, LabeledPointsAnnotation)]
        classes = [a for a in found if a.label is not None and a.is_instance is not True]
        losses.add(
            _LOCATION, "points of single objects, or without a class, are left out", len(found) - len(classes)
        )
        numbers = _numbers(classes)
        left = {a.label for a in classes} - set(numbers)
        losses.add(_LOCATION, f"a byte has {_MOST} classes; further ones are left out", len(left))
        made = cls(numbers)
        for annotation in classes:
            if annotation.label in numbers:
                made._add(annotation, numbers[str(annotation.label)], losses)
        return made

    def _add(self, annotation: LabeledPointsAnnotation, number: int, losses: FrameLosses) -> None:
        for entry in annotation.labeled_points:
            if entry.sensor_frame is None:
                losses.add(_LOCATION, "points of a sensor without frames are left out", len(entry.point_ids))
                continue
            key = (key_of(entry.sensor_id), entry.sensor_frame)
            self.entries.setdefault(key, []).append((number, entry.point_ids))

    def write(
        self, root: Path, version: str, token: str, frame: tuple[Key, int], count: int, losses: FrameLosses
    ) -> None:
        """Write the classes of a key frame, if there are any.

        Args:
            root: the data set.
            version: name of the folder of tables.
            token: of the key frame.
            frame: its lidar and its number.
            count: its points.
            losses: takes points without a class and with several.
        """
        entries = self.entries.pop(frame, None)
        if entries is None:
            return
        labels, reported = np.zeros(count, np.uint8), np.zeros(count, np.int64)
        for number, rows in entries:
            inside = rows[rows < count]
            labels[inside] = number
            reported[inside] += 1
        name = f"lidarseg/{version}/{token}_lidarseg.bin"
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(labels.tobytes())
        self.rows.append({"token": token, "sample_data_token": token, "filename": name})
        location = f"{_LOCATION}.labeled_points.point_ids"
        for what, lost in (
            ("points without a class are written as `noise`", int((reported == 0).sum())),
            ("points of several classes have the last one", int((reported > 1).sum())),
        ):
            losses.add(location, what, lost, Support.APPROXIMATED)

    def left(self) -> int:
        """How many frames with classes were no key frames."""
        return len(self.entries)


def _numbers(classes: Iterable[LabeledPointsAnnotation]) -> dict[str, int]:
    """Numbers of classes: those that they were read with, else the free ones, from 1 on."""
    numbers: dict[str, int] = {}
    waiting: list[str] = []
    for annotation in classes:
        label, known = str(annotation.label), annotation.extras.get("index")
        if label in numbers:
            continue
        if type(known) is int and 0 <= known <= _MOST and known not in numbers.values():
            numbers[label] = known
        elif label not in waiting:
            waiting.append(label)
    for label in waiting:
        if label not in numbers:
            free = 0 if label == NOISE and 0 not in numbers.values() else _free(numbers)
            if free is not None:
                numbers[label] = free
    return numbers


def _free(numbers: Mapping[str, int]) -> int | None:
    return next((k for k in range(1, _MOST + 1) if k not in numbers.values()), None)


def category_rows(categories: Mapping[str, str], classes: PointClasses) -> list[dict[str, str | int]]:
    """Rows of categories: those of boxes and those of points; where points are labelled, each has a number."""
    names = dict.fromkeys([*categories, *classes.numbers])
    if classes.numbers and 0 not in classes.numbers.values():
        names = {NOISE: None, **names}
    taken = {**({NOISE: 0} if NOISE in names else {}), **classes.numbers}
    rows: list[dict[str, str | int]] = []
    number = _MOST
    for name in names:
        row: dict[str, str | int] = {
            "token": categories.get(name, token_of("category", name)),
            "name": name,
            "description": "",
        }
        if classes.numbers:
            number += name not in taken
            row["index"] = taken.get(name, number)
        rows.append(row)
    return rows
