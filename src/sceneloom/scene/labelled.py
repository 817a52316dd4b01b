"""Labelled points that follow when frames or points are left out: their numbers change, or they go."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import Int64Array, UInt32Array
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.labelled_points import LabeledPoints, LabeledPointsAnnotation
from sceneloom.scene.types import Key, key_of
from sceneloom.scene.warnings import DataWarning, WarningKind

Rows = Callable[[int | None], Int64Array | None]
"""Gives the rows of the points that stay of a frame (by its old number), or of a sensor without frames (None); or
None where all of them stay."""


@dataclass(frozen=True, slots=True, eq=False)
class Renumbering:
    """What becomes of the points of one sensor.

    Attributes:
        frames: old numbers of the frames that stay, ascending; None where all of them stay.
        rows: which points of a frame stay; None where all of them do.
    """

    frames: Int64Array | None = None
    rows: Rows | None = None


@dataclass(slots=True)
class _Statistics:
    points: int = 0
    frames: int = 0
    unplaced: int = 0
    annotations: int = 0


def renumbered(
    annotations: Iterable[Annotation], renumberings: Mapping[Key, Renumbering]
) -> tuple[tuple[Annotation, ...], tuple[DataWarning, ...]]:
    """Give annotations whose labelled points follow their sensors; one without points goes.

    Frames with labelled points are read now, all others when they are asked for.

    Args:
        annotations: of any kind.
        renumberings: by sensor; sensors that are not named stay as they are.

    Raises:
        DataError: a frame with labelled points cannot be read.
    """
    statistics = _Statistics()
    known = tuple(annotations)
    moved = _moved_entries(known, renumberings, statistics)
    found = [
        _with_entries(annotation, [moved[row, k] for k in range(len(annotation.labeled_points))], statistics)
        if isinstance(annotation, LabeledPointsAnnotation)
        else annotation
        for row, annotation in enumerate(known)
    ]
    return tuple(annotation for annotation in found if annotation is not None), _reported(statistics)


def _moved_entries(
    annotations: tuple[Annotation, ...], renumberings: Mapping[Key, Renumbering], statistics: _Statistics
) -> dict[tuple[int, int], LabeledPoints | None]:
    """What becomes of each entry, by its annotation's number and its own; frame by frame, so that each is read once."""
    entries = [
        (row, k, entry)
        for row, annotation in enumerate(annotations)
        if isinstance(annotation, LabeledPointsAnnotation)
        for k, entry in enumerate(annotation.labeled_points)
    ]
    by_frame = sorted(entries, key=lambda found: _frame_of(found[2]))
    latest = _Latest()
    return {
        (row, k): _entry(entry, renumberings.get(key_of(entry.sensor_id)), latest, statistics)
        for row, k, entry in by_frame
    }


def _frame_of(entry: LabeledPoints) -> tuple[str, str, int]:
    number = -1 if entry.sensor_frame is None else entry.sensor_frame
    return type(entry.sensor_id).__name__, str(entry.sensor_id), number


@dataclass(slots=True)
class _Latest:
    """The rows that were asked for last: many annotations have points in one frame."""

    asked: tuple[Renumbering, int | None] | None = None
    found: Int64Array | None = None

    def rows(self, change: Renumbering, number: int | None) -> Int64Array | None:
        if change.rows is None:
            return None
        if self.asked != (change, number):
            self.asked, self.found = (change, number), change.rows(number)
        return self.found


def _with_entries(
    annotation: LabeledPointsAnnotation, entries: Iterable[LabeledPoints | None], statistics: _Statistics
) -> LabeledPointsAnnotation | None:
    kept = tuple(entry for entry in entries if entry is not None)
    if annotation.labeled_points and not kept:
        statistics.annotations += 1
        return None
    return replace(annotation, labeled_points=kept)


def _entry(
    entry: LabeledPoints, change: Renumbering | None, latest: _Latest, statistics: _Statistics
) -> LabeledPoints | None:
    if change is None:
        return entry
    number = entry.sensor_frame
    if change.frames is not None:
        if number is None:
            # rows of a whole sensor with frames: no one says how they are counted
            statistics.unplaced += 1
            return None
        found = np.flatnonzero(change.frames == number)
        if len(found) == 0:
            statistics.frames += 1
            return None
        entry = replace(entry, sensor_frame=int(found[0]))
    rows = latest.rows(change, number)
    if rows is None:
        return entry
    ids = new_ids(entry.point_ids, rows)
    statistics.points += len(entry.point_ids) - len(ids)
    return replace(entry, point_ids=ids) if len(ids) else None


def new_ids(point_ids: UInt32Array, rows: Int64Array) -> UInt32Array:
    """Where the points with these old numbers stand among the rows that stay; the others are left out.

    Args:
        point_ids: (N,) uint32, old numbers.
        rows: (M,) int64, ascending, old numbers of the points that stay.

    Returns:
        (K,) uint32, new numbers, K <= N.
    """
    locations = np.searchsorted(rows, point_ids)
    there = locations < len(rows)
    there[there] = rows[locations[there]] == point_ids[there]
    return locations[there].astype(np.uint32)


_LOCATION = "annotations[].labeled_points"


def _reported(statistics: _Statistics) -> tuple[DataWarning, ...]:
    found = (
        ("points", "labelled points that are not in the scene any more", statistics.points),
        ("frames", "labels of frames that are not in the scene any more", statistics.frames),
        (
            "sensors",
            "labels of a whole sensor with frames: it is not stated how its points are counted",
            statistics.unplaced,
        ),
        ("annotations", "annotations without a labelled point left", statistics.annotations),
    )
    return tuple(
        DataWarning(
            kind=WarningKind.SKIPPED,
            code=f"labelled-{what}",
            location=_LOCATION,
            message=message,
            count=count,
        )
        for what, message, count in found
        if count
    )
