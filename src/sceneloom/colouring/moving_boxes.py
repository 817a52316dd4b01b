"""Which points lie in annotated boxes that move."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.at import CuboidPoses, cuboid_poses
from sceneloom.scene.scene import Scene

MOVES = 1.0
"""A box moves if its centre comes so far from its first location [m]; annotators' hands are steadier than that."""
_ROOM = 0.15
"""Boxes are taken larger by this on all sides but below [m]: they are drawn around most points, not around all."""
_GROUND = 0.08
"""Points so near to the bottom of a box are those of the road, which it stands on [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class MovingBoxes:
    """The cuboids of a scene that move.

    Attributes:
        cuboids: the annotations, centres in the world.
        angles: how their angles are meant.
    """

    cuboids: tuple[CuboidAnnotation, ...]
    angles: CuboidAngles

    @classmethod
    def of(cls, scene: Scene) -> "MovingBoxes":
        """Choose the cuboids that leave their first location."""
        cuboids = (each for each in scene.annotations if isinstance(each, CuboidAnnotation))
        return cls(tuple(each for each in cuboids if _moves(each)), CuboidAngles.of(scene))

    def inside(self, points_world: Float64Array, timestamps_ns: Int64Array) -> BoolArray:
        """Which points lie in one of them at their own time.

        Args:
            points_world: (N, 3) float64 [m].
            timestamps_ns: (N,) int64 [ns].
        """
        found = np.zeros(len(points_world), np.bool_)
        if len(points_world) == 0:
            return found
        ends_ns = [int(timestamps_ns.min()), int(timestamps_ns.max())]
        for cuboid in self.cuboids:
            rows = self._near(cuboid, points_world, ends_ns)
            if len(rows):
                poses = cuboid_poses(cuboid, timestamps_ns[rows], angles=self.angles)
                found[rows] |= _within(points_world[rows], poses)
        return found

    def _near(
        self, cuboid: CuboidAnnotation, points_world: Float64Array, ends_ns: Sequence[int]
    ) -> Int64Array:
        """Points within reach of the box between two times."""
        poses = cuboid_poses(cuboid, ends_ns, angles=self.angles)
        if not poses.there.any():
            return np.zeros(0, np.int64)
        centers, sizes = poses.centers_world[poses.there], poses.sizes_lwh[poses.there]
        reach = np.linalg.norm(sizes, axis=1).max() / 2 + _ROOM * 2 + np.ptp(centers, axis=0).max()
        apart = np.abs(points_world - centers.mean(axis=0)).max(axis=1)
        # a box that comes or goes within the sweep is known at one end only
        return np.flatnonzero(apart <= reach + (0.0 if poses.there.all() else 5.0))


def _moves(cuboid: CuboidAnnotation) -> bool:
    centers = cuboid.path.values[:, 3:6]
    if cuboid.stationary or len(centers) < 2:
        return False
    with np.errstate(invalid="ignore"):
        return bool(np.nanmax(np.linalg.norm(centers - centers[0], axis=1)) > MOVES)


def _within(points_world: Float64Array, poses: CuboidPoses) -> BoolArray:
    inside = np.zeros(len(points_world), np.bool_)
    there = np.flatnonzero(poses.there)
    world_from_box = matrix_from_quaternion(poses.quaternions_xyzw[there])
    apart = points_world[there] - poses.centers_world[there]
    in_box = np.einsum("nij,ni->nj", world_from_box, apart)
    halves = poses.sizes_lwh[there] / 2
    above = in_box[:, 2] >= np.minimum(_GROUND, halves[:, 2]) - halves[:, 2]
    inside[there] = (np.abs(in_box) <= halves + _ROOM).all(axis=1) & above
    return inside
