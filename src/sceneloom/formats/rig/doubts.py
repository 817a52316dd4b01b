"""What looks like a slip in a manifest although it can be read: distances in millimetres, clocks that never meet."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from sceneloom.formats.ledger import Ledger
from sceneloom.scene import CameraSensor, LidarSensor, NoticeKind, Sensor, Trajectory
from sceneloom.scene.span import frame_times

FARTHEST_MOUNT = 30.0
"""A sensor that is mounted farther than this from the ego [m] is remarked: no vehicle is as long."""

_WITHIN_NS = 1_000_000_000
"""Streams that miss each other by less may well belong together."""


def note_doubts(
    path: Path, sensors: Sequence[Sensor], trajectories: Mapping[str, Trajectory], ledger: Ledger
) -> None:
    """Remark what can hardly be meant.

    Args:
        path: the manifest.
        sensors: of the scene.
        trajectories: of the scene.
        ledger: takes the notices.
    """
    for sensor in sensors:
        if isinstance(sensor, LidarSensor | CameraSensor) and sensor.mount is not None:
            distance = float(np.linalg.norm(sensor.mount.translation))
            if distance > FARTHEST_MOUNT:
                message = f"sensor {sensor.id!r} is {distance:.5g} m from the ego; are these millimetres?"
                ledger.note(NoticeKind.ASSUMED, "far-mount", str(path), message)
    spans = [(f"sensor {sensor.id!r}", frame_times(sensor)) for sensor in sensors]
    spans += [(f"trajectory {name!r}", way.timestamps_ns) for name, way in trajectories.items()]
    ordered = sorted((int(times.min()), int(times.max()), name) for name, times in spans if len(times))
    latest = ordered[0][1] if ordered else 0
    for before, after in pairwise(ordered):
        latest = max(latest, before[1])
        if after[0] > latest + _WITHIN_NS:
            message = (
                f"{after[2]} begins {(after[0] - latest) / 1e9:.3f} s after {before[2]} and all before it end; "
                "are their clocks or units the same?"
            )
            ledger.note(NoticeKind.ASSUMED, "clocks-apart", str(path), message)
