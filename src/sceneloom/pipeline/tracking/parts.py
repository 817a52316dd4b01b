"""A long drive tracked in parts: objects of neighbouring parts are one where both told them in the same places.

The tracker begins `LEAD_SECONDS` before a part, longer than it remembers an object that is not seen, so that it knows
what a single run would know there; and it goes on for `TRAIL_SECONDS` after it.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, Int64Array
from sceneloom.formats.kitti import KittiTracking
from sceneloom.kernels.assignment import best_columns
from sceneloom.pipeline.detections.detected import DetectedDrive
from sceneloom.pipeline.parts.records import read_records, writing_records
from sceneloom.pipeline.tracking.files import TrackableDrive, track_folder, track_into
from sceneloom.pipeline.tracking.job import TrackingSettings, track
from sceneloom.pipeline.tracking.report import TrackReport
from sceneloom.pipeline.tracking.tracked import COLUMNS, TrackedDrive
from sceneloom.scene import Scene, TrackedObjects
from sceneloom.stages import timed
from sceneloom.tracking import PictureBox

LEAD_SECONDS, TRAIL_SECONDS = 10.0, 3.0
_SAME_PLACE = 2.0
"""Two objects are not one at a time at which they are farther apart than this [m]."""
_SAME_TIMES = 0.5
"""They are one if they are in the same place at this share of the times at which both are told."""

Span = tuple[int, int]


def track_part(
    drive: DetectedDrive,
    target: Path,
    *,
    span_ns: Span,
    settings: TrackingSettings | None = None,
    box2d: PictureBox = PictureBox.IMAGE,
) -> int:
    """Follow the objects of a part of a drive into a file for `join_tracked`; gives how many sweeps it has.

    Args:
        drive: the whole drive.
        target: the file to write.
        span_ns: [start, stop) of its sweeps [ns].
        settings, box2d: as of `track_into`.
    """
    chosen = settings or TrackingSettings()
    chosen = replace(chosen, tracker=replace(chosen.tracker, picture_box=box2d))
    around_ns = (span_ns[0] - round(LEAD_SECONDS * 1e9), span_ns[1] + round(TRAIL_SECONDS * 1e9))
    found = track(drive, settings=chosen, within_ns=around_ns)
    with writing_records(target) as records:
        records.add({"drive": drive.name, "seconds": found.seconds, "span_ns": span_ns}, {})
        for moment in found.moments:
            columns = {name: getattr(moment, name) for name in COLUMNS}
            cameras = list(moment.corners_xyxy)
            corners = {f"corners{k}": moment.corners_xyxy[camera] for k, camera in enumerate(cameras)}
            values = {"timestamp_ns": moment.timestamp_ns, "labels": moment.labels, "cameras": cameras}
            records.add(values, {"ids": moment.ids, **columns, **corners})
    return len(found.moments)


def join_tracked(drive: DetectedDrive, files: Sequence[Path]) -> TrackedDrive:
    """Put the objects of all parts together; one part and what is told in the end are in memory.

    Args:
        drive: the whole drive.
        files: as `track_part` wrote them, in the order of time.

    Raises:
        DataError: a file is damaged.
    """
    joining, told, seconds = Joining(), list[TrackedObjects](), 0.0
    for file in files:
        records = read_records(file)
        head, _ = next(records)
        seconds += head["seconds"]
        moments = [_moment(values, arrays) for values, arrays in records]
        told += joining.add(moments, (head["span_ns"][0], head["span_ns"][1]))
    return TrackedDrive(drive, tuple(told), seconds)


def track_joined(
    drive: DetectedDrive, scene: Scene, files: Sequence[Path], output: str | Path, **how: Any
) -> TrackReport:
    """Write the objects of a drive that was tracked in parts.

    Args:
        drive: the whole drive.
        scene: what labels are put into.
        files: as `track_part` wrote them, in the order of time.
        output: the file.
        how: as of `track_into`.

    Raises:
        SceneloomError: as of `track_into`.
        DataError: a file is damaged.
    """
    with timed() as stages:
        source = TrackableDrive(drive, scene, tracked=join_tracked(drive, files))
        report = track_into(source, output, **how)
    return msgspec.structs.replace(report, stages=dict(stages))


def track_folder_joined(
    folder: KittiTracking, files: Sequence[Path], output: str | Path, **how: Any
) -> TrackReport:
    """Write the objects of KITTI's sequences that were tracked in parts.

    Args:
        folder: of the sequences.
        files: as `track_part` wrote them, those of each sequence in the order of time.
        output: the folder to write.
        how: as of `track_folder`.

    Raises:
        SceneloomError: as of `track_folder`.
        DataError: a file is damaged.
    """
    parts: dict[str, list[Path]] = {}
    for file in files:
        head, _ = next(read_records(file))
        parts.setdefault(head["drive"], []).append(file)
    with timed() as stages:
        report = track_folder(
            folder, output, follow=lambda drive: join_tracked(drive, parts[drive.name]), **how
        )
    return msgspec.structs.replace(report, stages=dict(stages))


@dataclass(slots=True)
class Joining:
    """Gives the objects of one part after another the numbers that they have in the whole.

    Attributes:
        before: what was told of the part before, by time, with the numbers of the whole.
        taken: the highest number that something has.
    """

    before: Mapping[int, TrackedObjects] = field(default_factory=dict)
    taken: int = 0

    def add(self, moments: Sequence[TrackedObjects], span_ns: Span) -> list[TrackedObjects]:
        """Take a part.

        Args:
            moments: of the part and of what leads into it and on from it.
            span_ns: [start, stop) of the part itself [ns].

        Returns:
            its own moments.
        """
        names = same_objects(self.before, moments)
        for number in np.unique(np.concatenate([_NOBODY, *(m.ids for m in moments)])).tolist():
            names.setdefault(number, self.taken + number)
        self.taken = max([self.taken, *names.values()])
        renamed = [_renamed(moment, names) for moment in moments]
        lead_ns = span_ns[1] - round(LEAD_SECONDS * 1e9)
        self.before = {m.timestamp_ns: m for m in renamed if m.timestamp_ns >= lead_ns}
        return [m for m in renamed if span_ns[0] <= m.timestamp_ns < span_ns[1]]


def same_objects(earlier: Mapping[int, TrackedObjects], later: Iterable[TrackedObjects]) -> dict[int, int]:
    """Find which objects of two trackers are one, by where they were at the same times.

    Pairs are chosen so that all of them together are as near as can be; each object is in at most one.

    Args:
        earlier: what one told, by time [ns].
        later: what the other told.

    Returns:
        numbers of the later tracker with those of the earlier one.
    """
    shared = [(earlier[m.timestamp_ns], m) for m in later if m.timestamp_ns in earlier]
    ours = np.unique(np.concatenate([_NOBODY, *(m.ids for m, _ in shared)]))
    theirs = np.unique(np.concatenate([_NOBODY, *(m.ids for _, m in shared)]))
    gains, near, told = np.zeros((3, len(ours), len(theirs)))
    for a, b in shared:
        cells = np.ix_(np.searchsorted(ours, a.ids), np.searchsorted(theirs, b.ids))
        apart = np.linalg.norm(a.centers[:, None] - b.centers[None], axis=2)
        gains[cells] += np.maximum(0.0, 1.0 - apart / _SAME_PLACE)
        near[cells] += apart < _SAME_PLACE
        told[cells] += 1.0
    gains[near < _SAME_TIMES * told] = 0.0
    columns = best_columns(gains)
    return {
        int(theirs[column]): int(ours[row])
        for row, column in enumerate(columns.tolist())
        if column >= 0 and gains[row, column] > 0.0
    }


_NOBODY: Int64Array = np.zeros(0, np.int64)


def _renamed(moment: TrackedObjects, names: Mapping[int, int]) -> TrackedObjects:
    return replace(moment, ids=np.array([names[number] for number in moment.ids.tolist()], np.int64))


def _moment(values: Mapping[str, Any], arrays: Mapping[str, AnyArray]) -> TrackedObjects:
    columns: dict[str, Any] = {name: arrays[name] for name in COLUMNS}
    corners = {camera_id: arrays[f"corners{k}"] for k, camera_id in enumerate(values["cameras"])}
    labels = tuple(values["labels"])
    return TrackedObjects(values["timestamp_ns"], arrays["ids"], labels, corners_xyxy=corners, **columns)
