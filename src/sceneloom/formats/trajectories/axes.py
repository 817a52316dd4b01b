"""Poses in the axes of cameras (x right, y down, z forward) reported in those of vehicles (x forward, z up).

And back.
"""

from dataclasses import replace

import numpy as np

from sceneloom.arrays import Float64Array, read_only
from sceneloom.formats.trajectories.content import TrajectoryFile

_VEHICLE_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def from_optical(content: TrajectoryFile) -> TrajectoryFile:
    """The same way with the world's and the device's axes rotated from x right, y down, z forward to x forward.

    Z up.
    """
    return _rotated(content, _VEHICLE_FROM_OPTICAL)


def to_optical(content: TrajectoryFile) -> TrajectoryFile:
    """The same way with the world's and the device's axes rotated from x forward, y left, z up to z forward, y down."""
    return _rotated(content, _VEHICLE_FROM_OPTICAL.T)


def _rotated(content: TrajectoryFile, here_from_there: Float64Array) -> TrajectoryFile:
    """Exchange axes, which rounds nothing: a rotation seen in other axes has its own axis rotated like any vector."""
    trajectory, six = content.trajectory, np.kron(np.eye(2), here_from_there)
    quaternions, covariances = trajectory.quaternions_xyzw, trajectory.covariances
    if quaternions is not None:
        quaternions = np.concatenate([quaternions[:, :3] @ here_from_there.T, quaternions[:, 3:]], axis=1)
    trajectory = replace(
        trajectory,
        positions=read_only(trajectory.positions @ here_from_there.T),
        quaternions_xyzw=None if quaternions is None else read_only(quaternions),
        covariances=None if covariances is None else read_only(six @ covariances @ six.T),
    )
    columns = {name: read_only(values @ here_from_there.T) for name, values in content.columns.items()}
    return replace(content, trajectory=trajectory, columns=columns)
