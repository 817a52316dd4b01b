"""Paths that are told at other stamps, compared as the ways that they stand for."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.geometry.rotations import angle_between
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, CuboidPath
from sceneloom.scene.annotations.keypoints import PointPath, places_of
from sceneloom.scene.at import cuboid_poses, point_at
from sceneloom.scene.poses import PosePath, Trajectory


class Places(NamedTuple):
    """A way at some times: places or sizes (M, G, 3) [m], and quaternions (M, 4) where it turns."""

    straight: Float64Array
    quaternions_xyzw: Float64Array | None


def _cuboid(path: CuboidPath, times_ns: Int64Array, angles: CuboidAngles) -> Places:
    poses = cuboid_poses(CuboidAnnotation("", path), times_ns, angles=angles)
    return Places(np.stack([poses.centers_world, poses.sizes_lwh], axis=1), poses.quaternions_xyzw)


def _poses(path: PosePath, times_ns: Int64Array, _: CuboidAngles) -> Places:
    poses = path.interpolate(times_ns)
    return Places(poses.positions[:, None], poses.quaternions_xyzw)


def _trajectory(way: Trajectory, times_ns: Int64Array, angles: CuboidAngles) -> Places:
    if way.quaternions_xyzw is not None:
        return _poses(way.poses, times_ns, angles)
    places, _ = point_at(PointPath(way.timestamps_ns, way.positions), times_ns)
    return Places(places[:, None], None)


def _point(path: PointPath, times_ns: Int64Array, _: CuboidAngles) -> Places:
    places, _there = point_at(path, times_ns)
    return Places(places_of(places), None)


WAYS: Mapping[str, tuple[Callable[[Any, Int64Array, CuboidAngles], Places], tuple[str, ...]]] = (
    MappingProxyType(
        {
            "CuboidPath": (_cuboid, ("timestamps_ns", "values")),
            "PosePath": (_poses, ("timestamps_ns", "positions", "quaternions_xyzw")),
            "Trajectory": (
                _trajectory,
                ("timestamps_ns", "positions", "quaternions_xyzw", "file_seconds", "covariances"),
            ),
            "PointPath": (_point, ("timestamps_ns", "values")),
        }
    )
)
"""How a path of each class is asked for times, and the fields that make the way."""


def is_way(value: Any) -> bool:
    """Whether a value is a path that can be asked for any time: with stamps, in order, and whole points."""
    if type(value).__name__ not in WAYS or len(value.timestamps_ns) == 0:
        return False
    whole = not isinstance(value, PointPath) or value.values.shape[1] % 3 == 0
    return whole and bool((np.diff(value.timestamps_ns) > 0).all())


def ways_apart(a: Any, b: Any, angles: tuple[CuboidAngles, CuboidAngles]) -> tuple[float, float] | None:
    """Give how far two paths of one class are apart [m] and [deg], at the stamps of both; None if their times differ.

    Between stamps both go straight, so that places are farthest apart at a stamp of one of them.
    """
    first, second = a.timestamps_ns, b.timestamps_ns
    if (first[0], first[-1]) != (second[0], second[-1]) or getattr(a, "endless", 0) != getattr(
        b, "endless", 0
    ):
        return None
    times = np.union1d(first, second)
    at = WAYS[type(a).__name__][0]
    here, there = at(a, times, angles[0]), at(b, times, angles[1])
    if here.straight.shape != there.straight.shape:
        return None
    metres = float(np.nan_to_num(np.linalg.norm(here.straight - there.straight, axis=2), nan=np.inf).max())
    if here.quaternions_xyzw is None or there.quaternions_xyzw is None:
        same = here.quaternions_xyzw is there.quaternions_xyzw
        return metres, 0.0 if same else np.inf
    turns = np.degrees(angle_between(here.quaternions_xyzw, there.quaternions_xyzw))
    return metres, float(np.nan_to_num(turns, nan=np.inf).max())
