"""Objects through a whole drive: what the tracker reports online, or what it could report knowing what came later."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from sceneloom.scene.tracks import Track, TrackedObjects, Tracks
from sceneloom.tracking.observation import Observation
from sceneloom.tracking.settings import TrackerSettings
from sceneloom.tracking.smoother import look_back
from sceneloom.tracking.tracker import DEFAULTS, Tracker

_COLUMNS = (
    *("centers", "sizes_lwh", "yaws", "velocities", "yaw_rates", "covariances", "scores", "supports"),
)


def track_drive(
    observations: Iterable[Observation], *, settings: TrackerSettings = DEFAULTS, offline: bool = False
) -> Tracks:
    """Follow the objects of a drive.

    Args:
        observations: moment by moment, in the order of their times.
        settings: what is taken for granted.
        offline: whether later moments may report earlier ones.
    """
    tracker = Tracker(settings)
    if offline:
        return look_back([tracker.advance(observation) for observation in observations], settings)
    return gathered([tracker.step(observation) for observation in observations])


def gathered(moments: list[TrackedObjects]) -> Tracks:
    """Give objects reported moment by moment as one track each; of several tellings of one time the last counts."""
    latest = list({moment.timestamp_ns: moment for moment in moments}.values())
    latest.sort(key=lambda moment: moment.timestamp_ns)
    rows: dict[int, list[tuple[TrackedObjects, int]]] = {}
    for moment in latest:
        for row, number in enumerate(moment.ids.tolist()):
            rows.setdefault(number, []).append((moment, row))
    return Tracks(tuple(_track(number, rows[number]) for number in sorted(rows)))


def _track(number: int, states: list[tuple[TrackedObjects, int]]) -> Track:
    columns: dict[str, Any] = {
        name: np.array([getattr(moment, name)[row] for moment, row in states]) for name in _COLUMNS
    }
    cameras = dict.fromkeys(camera_id for moment, _ in states for camera_id in moment.corners_xyxy)
    corners = {
        camera_id: np.array(
            [
                moment.corners_xyxy[camera_id][row] if camera_id in moment.corners_xyxy else [np.nan] * 4
                for moment, row in states
            ]
        )
        for camera_id in cameras
    }
    return Track(
        id=number,
        label=states[-1][0].labels[states[-1][1]],
        timestamps_ns=np.array([moment.timestamp_ns for moment, _ in states], np.int64),
        corners_xyxy=corners,
        **columns,
    )
