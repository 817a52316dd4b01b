"""Poses in the axes of cameras (x right, y down, z forward) told in those of vehicles (x forward, z up), and back."""

from dataclasses import replace

import numpy as np

from sceneloom.arrays import Float64Array, read_only
from sceneloom.formats.trajectories.content import TrajectoryFile

_VEHICLE_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def from_optical(content: TrajectoryFile) -> TrajectoryFile:
    """The same way with the world's and the device's axes turned from x right, y down, z forward to x forward, z up."""
    return _turned(content, _VEHICLE_FROM_OPTICAL)


def to_optical(content: TrajectoryFile) -> TrajectoryFile:
    """The same way with the world's and the device's axes turned from x forward, y left, z up to z forward, y down."""
    return _turned(content, _VEHICLE_FROM_OPTICAL.T)


def _turned(content: TrajectoryFile, here_from_there: Float64Array) -> TrajectoryFile:
    """Exchange axes, which rounds nothing: a rotation seen in other axes has its own axis turned like any vector."""
    way, six = content.trajectory, np.kron(np.eye(2), here_from_there)
    quaternions, covariances = way.quaternions_xyzw, way.covariances
    if quaternions is not None:
        quaternions = np.concatenate([quaternions[:, :3] @ here_from_there.T, quaternions[:, 3:]], axis=1)
    way = replace(
        way,
        positions=read_only(way.positions @ here_from_there.T),
        quaternions_xyzw=None if quaternions is None else read_only(quaternions),
        covariances=None if covariances is None else read_only(six @ covariances @ six.T),
    )
    columns = {name: read_only(values @ here_from_there.T) for name, values in content.columns.items()}
    return replace(content, trajectory=way, columns=columns)
