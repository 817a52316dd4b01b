"""Tracklets as annotations, placed in the world along the ego trajectory."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.kitti.raw.tracklets import FURTHER_FIELDS, POSE_FIELDS, Tracklet
from sceneloom.formats.kitti.scenes.sensors import LIDAR_ID
from sceneloom.formats.ledger import Ledger
from sceneloom.geometry.euler import AngleUnit, cuboid_angles_from_rotation, rotation_from_cuboid_angles
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, CuboidPath
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses
from sceneloom.scene.warnings import WarningKind

ORDER = "zyx"
"""Of a pose's three angles, Rz(rz) Ry(ry) Rx(rx); KITTI's own files have none but rz."""

STATES = (*POSE_FIELDS[6:], *FURTHER_FIELDS)
"""What poses state beside locations: attributes of the boxes."""


def tracklet_annotations(
    tracklets: Sequence[Tracklet],
    path: Path,
    times_ns: Mapping[int, int],
    trajectory: Poses | None,
    ego_from_lidar: RigidTransform,
    ledger: Ledger,
) -> tuple[Annotation, ...]:
    """Give a cuboid for each tracklet, its location in the file as id.

    Args:
        tracklets: those of the file.
        path: the file, for messages.
        times_ns: of the frames, by number [ns].
        trajectory: `world_from_ego`.
        ego_from_lidar: the mounting.
        ledger: reported frames that are not there, and of such beyond the trajectory.

    Raises:
        DataError: a tracklet has a frame beyond the last one.
    """
    source = None if trajectory is None else PoseSource(trajectory, ego_from_lidar)
    last = max(times_ns, default=-1)
    found: list[Annotation] = []
    for k, tracklet in enumerate(tracklets):
        numbers = range(tracklet.first_frame, tracklet.first_frame + len(tracklet.poses))
        if numbers[-1] > last:
            fault = DataError(
                path, f"tracklets/item[{k}]", f"frame {numbers[-1]}; the drive's last is {last}"
            )
            ledger.fault("frames-beyond", fault)
        rows = [row for row, number in enumerate(numbers) if number in times_ns]
        timestamps = np.array([times_ns[numbers[row]] for row in rows], np.int64)
        if source is None or not rows:
            continue
        lidar = source.at(timestamps)
        values = _rows(
            tracklet, tracklet.poses[rows], matrix_from_known(lidar.quaternions_xyzw), lidar.positions
        )
        known = np.isfinite(values).all(axis=1)
        if not known.all():
            message = "boxes in frames beyond the ego trajectory"
            ledger.note(
                WarningKind.SKIPPED, "boxes-beyond-trajectory", str(path), message, count=int((~known).sum())
            )
        if known.any():
            poses = tracklet.poses[rows][known]
            box = CuboidAnnotation(k, CuboidPath(timestamps[known], values[known]), label=tracklet.label)
            reported = _reported(poses, timestamps[known])
            found.append(replace(box, attributes=reported))
    return tuple(found)


def _reported(poses: Float64Array, timestamps_ns: Int64Array) -> tuple[AttributePath, ...]:
    """What poses state beside locations; -1 says nothing."""
    columns = {name: poses[:, 6 + column] for column, name in enumerate(STATES)}
    return tuple(
        AttributePath(name, tuple(_plain(values)), timestamps_ns, LIDAR_ID)
        for name, values in columns.items()
        if (values != -1).any()
    )


def matrix_from_known(quaternions_xyzw: Float64Array) -> Float64Array:
    """(N, 3, 3) rotations of (N, 4) quaternions; NaN where these are."""
    known = np.isfinite(quaternions_xyzw[:, 0])
    matrices = np.full((len(quaternions_xyzw), 3, 3), np.nan)
    if known.any():
        matrices[known] = matrix_from_quaternion(quaternions_xyzw[known])
    return matrices


def _plain(values: Float64Array) -> list[int | float]:
    return [int(value) if value == int(value) else value for value in values.tolist()]


def _rows(
    tracklet: Tracklet, poses: Float64Array, world_from_lidar: Float64Array, origins_world: Float64Array
) -> Float64Array:
    """Rows of a cuboid, (N, 9) float64; NaN where the lidar's location is not known."""
    height, width, length = tracklet.size_hwl
    lidar_from_box = rotation_from_cuboid_angles(poses[:, 3:6], unit=AngleUnit.RADIANS, order=ORDER)
    centers_lidar = poses[:, :3] + lidar_from_box @ np.array([0.0, 0.0, height / 2])
    centers = np.einsum("nij,nj->ni", world_from_lidar, centers_lidar) + origins_world
    angles = cuboid_angles_from_rotation(world_from_lidar @ lidar_from_box)
    sizes = np.tile([length, width, height], (len(poses), 1))
    return np.concatenate([sizes, centers, angles], axis=1)
