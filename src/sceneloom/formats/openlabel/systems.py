"""The tree of coordinate systems of a file, and where each was at any time.

Source: ASAM OpenLABEL 1.0.0, "coordinate_system" and "transform": a pose takes what is in a system into its parent, a
transform what is in `src` into `dst`.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.openlabel.document import Part
from sceneloom.formats.openlabel.frame_times import FrameTimes
from sceneloom.formats.openlabel.transforms import read_transform
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions, rotate_vectors
from sceneloom.scene.poses import Poses
from sceneloom.scene.warnings import WarningKind

Edges = dict[str, tuple[str, Poses]]


@dataclass(frozen=True, slots=True, eq=False)
class Systems:
    """Coordinate systems, each with the one that it is placed in.

    Attributes:
        edges: by name: the name of the next one towards the root, and `next_from_this` over time.
        names: of all systems.
        sensors: those that are sensors'.
    """

    edges: Edges
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
        moving = [
            name for name, (_, path) in self.edges.items() if not path.static and name not in self.sensors
        ]
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


def read_systems(document: Part, times: FrameTimes, ledger: Ledger) -> Systems:
    """Read the coordinate systems and the transforms of all frames.

    Raises:
        DataError: one is wrong.
    """
    parents: dict[str, str] = {}
    edges: Edges = {}
    for name, system in document.each("coordinate_systems"):
        parent = system.get("parent")
        parents[name] = "" if parent is None else parent.text()
        pose = system.get("pose_wrt_parent")
        if parents[name] and pose is not None:
            edges[name] = (parents[name], _still(read_transform(pose)))
    moving = _moving(document, times)
    for (source, goal), path in moving.items():
        if parents.get(goal) == source:
            edges[goal] = (source, _inverted(path))
        else:
            edges[source] = (goal, path)
    names = frozenset({*parents, *(goal for goal, _ in edges.values())})
    for name, parent_name in parents.items():
        if parent_name and name not in edges:
            reported = f"it is not stated where it is in {parent_name!r}; taken for a root of its own"
            location = f"{document.file}: openlabel.coordinate_systems.{name}"
            ledger.note(WarningKind.ASSUMED, "coordinate-system-unplaced", location, reported)
    return Systems(edges, names, frozenset(name for name, _ in document.each("streams")))


def _still(transform: RigidTransform) -> Poses:
    return Poses(
        np.zeros(1, np.int64), transform.translation[None], transform.quaternion_xyzw[None], static=True
    )


def _moving(document: Part, times: FrameTimes) -> dict[tuple[str, str], Poses]:
    """The transforms of the frames, by source and destination."""
    rows: dict[tuple[str, str], dict[int, RigidTransform]] = {}
    for number, part in _transforms(document):
        pair = (part.need("src").text(), part.need("dst").text())
        found = read_transform(part.need("transform_src_to_dst"))
        rows.setdefault(pair, {})[times.at(number)] = found
    return {pair: _path(poses) for pair, poses in rows.items() if pair[0] != pair[1]}


def _transforms(document: Part) -> Iterator[tuple[int, Part]]:
    for key, frame in document.each("frames"):
        properties = frame.get("frame_properties")
        if properties is not None and key.isdigit():
            for _, transform in properties.each("transforms"):
                yield int(key), transform


def _path(poses: dict[int, RigidTransform]) -> Poses:
    timestamps = sorted(poses)
    return Poses(
        np.array(timestamps, np.int64),
        np.stack([poses[timestamp].translation for timestamp in timestamps]),
        np.stack([poses[timestamp].quaternion_xyzw for timestamp in timestamps]),
    )


def _inverted(path: Poses) -> Poses:
    backwards = [
        RigidTransform.from_quaternion(position, quaternion).inverse()
        for position, quaternion in zip(path.positions, path.quaternions_xyzw, strict=True)
    ]
    return Poses(
        path.timestamps_ns,
        np.stack([one.translation for one in backwards]),
        np.stack([one.quaternion_xyzw for one in backwards]),
    )
