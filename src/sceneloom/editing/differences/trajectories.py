"""Paths that are reported at other timestamps, compared as the trajectories that they stand for."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.geometry.rotations import angle_between
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, CuboidPath
from sceneloom.scene.annotations.keypoints import PointPath, locations_of
from sceneloom.scene.at import cuboid_poses, point_at
from sceneloom.scene.poses import Poses, Trajectory


class Locations(NamedTuple):
    """A trajectory at some times: locations or sizes (M, G, 3) [m], and quaternions (M, 4) where it rotates."""

    straight: Float64Array
    quaternions_xyzw: Float64Array | None


def _cuboid(path: CuboidPath, times_ns: Int64Array, angles: CuboidAngles) -> Locations:
    poses = cuboid_poses(CuboidAnnotation("", path), times_ns, angles=angles)
    return Locations(np.stack([poses.centers_world, poses.sizes_lwh], axis=1), poses.quaternions_xyzw)


def _poses(path: Poses, times_ns: Int64Array, _: CuboidAngles) -> Locations:
    poses = path.interpolate(times_ns)
    return Locations(poses.positions[:, None], poses.quaternions_xyzw)


def _trajectory(trajectory: Trajectory, times_ns: Int64Array, angles: CuboidAngles) -> Locations:
    if trajectory.quaternions_xyzw is not None:
        return _poses(trajectory.poses, times_ns, angles)
    locations, _ = point_at(PointPath(trajectory.timestamps_ns, trajectory.positions), times_ns)
    return Locations(locations[:, None], None)


def _point(path: PointPath, times_ns: Int64Array, _: CuboidAngles) -> Locations:
    locations, _there = point_at(path, times_ns)
    return Locations(locations_of(locations), None)


TRAJECTORIES: Mapping[str, tuple[Callable[[Any, Int64Array, CuboidAngles], Locations], tuple[str, ...]]] = (
    MappingProxyType(
        {
            "CuboidPath": (_cuboid, ("timestamps_ns", "values")),
            "Poses": (_poses, ("timestamps_ns", "positions", "quaternions_xyzw")),
            "Trajectory": (
                _trajectory,
                ("timestamps_ns", "positions", "quaternions_xyzw", "file_seconds", "covariances"),
            ),
            "PointPath": (_point, ("timestamps_ns", "values")),
        }
    )
)
"""How a path of each class is asked for times, and the fields that make the trajectory."""


def is_trajectory(value: Any) -> bool:
    """Whether a value is a path that can be asked for any time: with timestamps, in order, and whole points."""
    if type(value).__name__ not in TRAJECTORIES or len(value.timestamps_ns) == 0:
        return False
    whole = not isinstance(value, PointPath) or value.values.shape[1] % 3 == 0
    return whole and bool((np.diff(value.timestamps_ns) > 0).all())


def trajectories_apart(
    a: Any, b: Any, angles: tuple[CuboidAngles, CuboidAngles]
) -> tuple[float, float] | None:
    """Give how far two paths of one class are apart [m] and [deg], at the timestamps of both.

    None if their times differ.

    Between timestamps both go straight, so that locations are farthest apart at a timestamp of one of them.
    """
    first, second = a.timestamps_ns, b.timestamps_ns
    if (first[0], first[-1]) != (second[0], second[-1]) or getattr(a, "static", 0) != getattr(b, "static", 0):
        return None
    times = np.union1d(first, second)
    at = TRAJECTORIES[type(a).__name__][0]
    here, there = at(a, times, angles[0]), at(b, times, angles[1])
    if here.straight.shape != there.straight.shape:
        return None
    metres = float(np.nan_to_num(np.linalg.norm(here.straight - there.straight, axis=2), nan=np.inf).max())
    if here.quaternions_xyzw is None or there.quaternions_xyzw is None:
        same = here.quaternions_xyzw is there.quaternions_xyzw
        return metres, 0.0 if same else np.inf
    rotations = np.degrees(angle_between(here.quaternions_xyzw, there.quaternions_xyzw))
    return metres, float(np.nan_to_num(rotations, nan=np.inf).max())
