"""The frames of an OpenLABEL file: the time of each frame, the tree of coordinate systems, and transforms."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.geometry.rigid import multiply_quaternions, rotate_vectors
from sceneloom.scene.poses import Poses


@dataclass(frozen=True, slots=True, eq=False)
class Systems:
    """Coordinate systems, each with the one that it is placed in.

    Attributes:
        edges: by name: the name of the next one towards the root, and `next_from_this` over time.
        names: of all systems.
        sensors: those that are sensors'.
    """

    edges: dict[str, tuple[str, Poses]]
    names: frozenset[str]
    sensors: frozenset[str] = frozenset()

    def chain(self, name: str) -> list[str]:
        """The systems from one to its root, both included."""
        found = [name]
        while found[-1] in self.edges and self.edges[found[-1]][0] not in found:
            found.append(self.edges[found[-1]][0])
        return found

    @property
    def ego(self) -> str | None:
        """The moving system that is nearest to its root, and no sensor's; None where nothing moves."""
        moving = [name for name, (_, path) in self.edges.items() if not path.static and name not in self.sensors]
        return min(moving, key=lambda name: (len(self.chain(name)), name), default=None)

    def path_to(self, name: str, goal: str) -> Poses | None:
        """`goal_from_name` over time, at the times of all poses between; None where one does not lead to the other."""
        chain = self.chain(name)
        if goal not in chain:
            return None
        paths = [self.edges[one][1] for one in chain[: chain.index(goal)]]
        moving = [path.timestamps_ns for path in paths if not path.static]
        times = np.unique(np.concatenate(moving)) if moving else np.zeros(1, np.int64)
        positions, quaternions = self._composed(paths, times)
        return Poses(times, positions, quaternions, static=not moving)

    def root_from(self, name: str, times: Int64Array) -> tuple[Float64Array, Float64Array]:
        """`root_from_name` at some times: positions (N, 3) and quaternions (N, 4), scalar last."""
        return self._composed([self.edges[one][1] for one in self.chain(name)[:-1]], times)

    def _composed(self, paths: list[Poses], times: Int64Array) -> tuple[Float64Array, Float64Array]:
        positions = np.zeros((len(times), 3))
        quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
        for path in paths:
            poses = path.held(times)
            positions = rotate_vectors(poses.quaternions_xyzw, positions) + poses.positions
            quaternions = multiply_quaternions(poses.quaternions_xyzw, quaternions)
        return positions, quaternions
