"""The objects of a drive, moment by moment: those of several trackers together, and those of tracks."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array
from sceneloom.pipeline.detections.detected import DetectedDrive
from sceneloom.scene.tracks import Track, TrackedObjects, Tracks
from sceneloom.scene.types import Identifier
from sceneloom.tracking.drive import gathered

COLUMNS = tuple(
    f.name for f in fields(TrackedObjects) if f.name not in ("timestamp_ns", "ids", "labels", "corners_xyxy")
)
"""The columns of states that tracks and objects of a moment share, without boxes in images."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackedDrive:
    """The objects of a drive.

    Attributes:
        drive: what they were found in.
        moments: the objects at each sweep.
        seconds: of the processor, for fusing and tracking.
    """

    drive: DetectedDrive
    moments: tuple[TrackedObjects, ...]
    seconds: float

    @property
    def tracks(self) -> Tracks:
        """The same by object."""
        return gathered(list(self.moments))


def moments_of(tracks: Iterable[Track], timestamps_ns: Int64Array) -> tuple[TrackedObjects, ...]:
    """Give the objects at each time; states of tracks at other times are left out.

    Args:
        tracks: of a drive.
        timestamps_ns: (N,) int64 [ns], rising.
    """
    tracks = tuple(tracks)
    counts = [len(track) for track in tracks]
    times = _joined([track.timestamps_ns for track in tracks], (0,), np.int64)
    ids = np.repeat(np.array([track.id for track in tracks], np.int64), counts)
    labels = [track.label for track in tracks for _ in range(len(track))]
    empty = _NOBODY
    columns = {
        name: _joined(
            [getattr(track, name) for track in tracks], getattr(empty, name).shape, getattr(empty, name).dtype
        )
        for name in COLUMNS
    }
    cameras = dict.fromkeys(camera_id for track in tracks for camera_id in track.corners_xyxy)
    corners = {
        camera_id: _joined([_corners(track, camera_id, len(track)) for track in tracks], (0, 4), np.float64)
        for camera_id in cameras
    }
    order = np.lexsort((ids, times))
    first, stop = (np.searchsorted(times[order], timestamps_ns, side=side) for side in ("left", "right"))
    found = []
    for k, time_ns in enumerate(timestamps_ns.tolist()):
        rows = order[first[k] : stop[k]]
        states: dict[str, Any] = {name: values[rows] for name, values in columns.items()}
        boxes = {camera_id: values[rows] for camera_id, values in corners.items()}
        words = tuple(labels[row] for row in rows.tolist())
        found.append(TrackedObjects(time_ns, ids[rows], words, corners_xyxy=boxes, **states))
    return tuple(found)


def joined_moments(parts: Sequence[Sequence[TrackedObjects]]) -> tuple[TrackedObjects, ...]:
    """Put the objects of several trackers of the same moments together; ids of later ones begin behind the others'."""
    if len(parts) == 1:
        return tuple(parts[0])
    shifts, next_id = [], 0
    for part in parts:
        largest = max((int(m.ids.max()) for m in part if len(m)), default=-1)
        shifts.append(next_id)
        next_id += largest + 1
    return tuple(_together(same, shifts) for same in zip(*parts, strict=True))


def _together(same: Sequence[TrackedObjects], shifts: Sequence[int]) -> TrackedObjects:
    columns: dict[str, Any] = {name: np.concatenate([getattr(m, name) for m in same]) for name in COLUMNS}
    cameras = dict.fromkeys(camera_id for m in same for camera_id in m.corners_xyxy)
    return TrackedObjects(
        same[0].timestamp_ns,
        np.concatenate([m.ids + shift for m, shift in zip(same, shifts, strict=True)]),
        tuple(label for m in same for label in m.labels),
        corners_xyxy={
            camera_id: np.concatenate([_corners(m, camera_id, len(m)) for m in same]) for camera_id in cameras
        },
        **columns,
    )


def _corners(states: Track | TrackedObjects, camera_id: Identifier, count: int) -> Float64Array:
    found: Mapping[Identifier, Float64Array] = states.corners_xyxy
    return found[camera_id] if camera_id in found else np.full((count, 4), np.nan)


def _joined(parts: Sequence[AnyArray], shape: tuple[int, ...], dtype: Any) -> Any:
    return np.concatenate(parts) if parts else np.zeros(shape, dtype)


_NOBODY = TrackedObjects(
    0,
    np.zeros(0, np.int64),
    (),
    np.zeros((0, 3)),
    np.zeros((0, 3)),
    np.zeros(0),
    np.zeros((0, 3)),
    np.zeros(0),
    np.zeros((0, 10, 10)),
    np.zeros(0),
    np.zeros(0, np.uint8),
)
"""A moment without objects."""
