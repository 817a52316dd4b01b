"""Tracked objects as lines of JSON, one for each sweep."""

from collections.abc import Iterable, Iterator
from typing import Any

import msgspec
import numpy as np

from sceneloom.scene.tracks import Support, TrackedObjects

_BLOCKS = {"center_cov": slice(0, 3), "size_cov": slice(3, 6), "velocity_cov": slice(7, 10)}
"""Which rows and columns of the covariance of a state each 3x3 block has."""


def track_lines(moments: Iterable[TrackedObjects]) -> Iterator[bytes]:
    """Give a line for each moment, without its end.

    Each is `{"timestamp_ns", "objects": [{"id", "class", "confidence", "center", "center_cov", "size_lwh", "size_cov",
    "yaw", "yaw_rate", "yaw_var", "velocity", "velocity_cov", "support", "boxes_2d": {camera: [x1, y1, x2, y2]}}]}`:
    world frame, metres, seconds and radians, 3x3 covariances row by row, pixels counted from the image's corner.
    """
    for moment in moments:
        rows = [_object(moment, k) for k in range(len(moment))]
        yield msgspec.json.encode({"timestamp_ns": moment.timestamp_ns, "objects": rows})


def _object(moment: TrackedObjects, k: int) -> dict[str, Any]:
    covariance = moment.covariances[k]
    reported: dict[str, Any] = {
        "id": int(moment.ids[k]),
        "class": moment.labels[k],
        "confidence": float(moment.scores[k]),
        "center": moment.centers[k].tolist(),
        "size_lwh": moment.sizes_lwh[k].tolist(),
        "yaw": float(moment.yaws[k]),
        "yaw_rate": float(moment.yaw_rates[k]),
        "yaw_var": float(covariance[6, 6]),
        "velocity": moment.velocities[k].tolist(),
        "support": Support(int(moment.supports[k])).name.lower(),
    }
    reported |= {name: covariance[block, block].reshape(-1).tolist() for name, block in _BLOCKS.items()}
    reported["boxes_2d"] = {
        str(camera_id): corners[k].tolist()
        for camera_id, corners in moment.corners_xyxy.items()
        if np.isfinite(corners[k]).all()
    }
    return reported
