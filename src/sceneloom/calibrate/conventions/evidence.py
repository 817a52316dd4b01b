"""What speaks for and against a way to read an extrinsic: where is up, how much is seen, and whether edges meet."""

from collections.abc import Sequence

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.calibrate.frames import CalibrationFrame
from sceneloom.cameras.models import project

_WITHIN = 40.0
"""Points so near are asked where up is [m]."""

_MOST_POINTS = 20_000
_LEAST_POINTS = 200

_UPRIGHT_DEG = 50.0
"""A camera is taken to be mounted upright within this angle."""

_LEAST_SHARE = 0.005
"""Of the points, so many must fall into the picture; less is no camera that was mounted to see what the lidar sees."""

_MOST_APART = 10.0
"""Sensors of one vehicle lie within this distance [m]."""


def find_up(frames: Sequence[CalibrationFrame]) -> Float64Array | None:
    """Find which way is up in the frame of the points, as (3,) unit vector along an axis; None where it is not clear.

    A sweep spreads along the ground, so it is thinnest along the vertical; and things stand on the ground but do not
    hang below it, so that its heights trail off upwards.
    """
    votes = np.zeros(6)
    for frame in frames:
        near = frame.points_lidar[np.linalg.norm(frame.points_lidar, axis=1) < _WITHIN]
        if len(near) < _LEAST_POINTS:
            continue
        some = near[:: len(near) // _MOST_POINTS + 1]
        low, middle, high = np.quantile(some, [0.02, 0.5, 0.98], axis=0)
        axis = int(np.argmin(high - low))
        below, above = middle[axis] - low[axis], high[axis] - middle[axis]
        votes[2 * axis + (above < below)] += 1
    if votes.sum() == 0 or votes.max() < 0.75 * votes.sum():
        return None
    axis, downward = divmod(int(np.argmax(votes)), 2)
    up = np.zeros(3)
    up[axis] = -1.0 if downward else 1.0
    return up


def is_upright(camera_from_points: Float64Array, up: Float64Array) -> bool:
    """Say whether the camera's top points up."""
    return bool(-(camera_from_points[1, :3] @ up) > np.cos(np.radians(_UPRIGHT_DEG)))


def is_near(camera_from_points: Float64Array) -> bool:
    """Say whether camera and lidar can sit on one vehicle."""
    return bool(np.linalg.norm(camera_from_points[:3, 3]) < _MOST_APART)


def share_seen(camera_from_points: Float64Array, frames: Sequence[CalibrationFrame]) -> float:
    """Give the share of the points that falls into the pictures."""
    shares = []
    for frame in frames:
        some = frame.points_lidar[:: len(frame.points_lidar) // _MOST_POINTS + 1]
        placed = some @ camera_from_points[:3, :3].T + camera_from_points[:3, 3]
        shares.append(float(project(frame.camera, placed)[1].mean()) if len(some) else 0.0)
    return float(np.mean(shares)) if shares else 0.0


def sees_enough(share: float) -> bool:
    """Say whether a camera that was mounted to see what the lidar sees would see so small a share of its points."""
    return share >= _LEAST_SHARE
