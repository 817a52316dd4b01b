"""The tree of frames that transforms build: fixed ones, and those that move; the trajectories between frames."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.quaternion_lengths import lengths_of
from sceneloom.formats.topics.records import TransformRecord
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions, normalise_quaternion, rotate_vectors
from sceneloom.scene.poses import Poses

_STANDS_M, _STANDS_ROTATION = 1e-9, 1e-12
"""A frame whose transforms all agree within this does not move."""


@dataclass(slots=True)
class _Rows:
    """The transforms of one frame as they come."""

    parent: str
    times_ns: list[int] = field(default_factory=list)
    positions: list[Float64Array] = field(default_factory=list)
    quaternions: list[Float64Array] = field(default_factory=list)
    fixed: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """How a frame is, or moves, in its parent.

    Attributes:
        parent: the frame above.
        fixed: `parent_from_child` where it never changes, else None.
        path: the same over time where it moves, else None.
    """

    parent: str
    fixed: RigidTransform | None = None
    path: Poses | None = None


class FrameTree:
    """Frames by their ids.

    Attributes:
        edges: of each frame that has a parent.
        repeated: how many transforms stated the same time once more.
        other_parents: how many transforms named another parent than those before.
    """

    def __init__(self, records: Iterable[TransformRecord], name: str) -> None:
        """Build the tree.

        Args:
            records: in any order; the first of several with one time counts, and the first parent.
            name: what messages call their log.

        Raises:
            DataError: a transform is none, or frames are their own parents.
        """
        self.edges: dict[str, Edge] = {}
        self.repeated = self.other_parents = 0
        rows: dict[str, _Rows] = {}
        for record in records:
            _check(record, name)
            found = rows.setdefault(record.child, _Rows(record.parent))
            if found.parent != record.parent:
                self.other_parents += 1
                continue
            found.times_ns.append(record.timestamp_ns)
            found.positions.append(record.position)
            found.quaternions.append(record.quaternion_xyzw)
            found.fixed &= record.fixed
        for child, found in rows.items():
            self.edges[child] = self._edge(found)
        for child in self.edges:
            self._check_chain(child, name)

    def _edge(self, rows: _Rows) -> Edge:
        positions = np.array(rows.positions).reshape(-1, 3)
        quaternions = normalise_quaternion(np.array(rows.quaternions).reshape(-1, 4))
        signs = np.where((quaternions * quaternions[0]).sum(axis=1) < 0, -1.0, 1.0)
        rotations = np.abs(quaternions * signs[:, None] - quaternions[0]).max()
        if rows.fixed or (
            np.abs(positions - positions[0]).max() <= _STANDS_M and rotations <= _STANDS_ROTATION
        ):
            # of a frame that is stated to be fixed, the latest word counts
            return Edge(rows.parent, fixed=RigidTransform.from_quaternion(positions[-1], quaternions[-1]))
        times, first = np.unique(np.array(rows.times_ns, np.int64), return_index=True)
        self.repeated += len(rows.times_ns) - len(times)
        return Edge(rows.parent, path=Poses(times, positions[first], quaternions[first]))

    def _check_chain(self, frame: str, name: str) -> None:
        seen = {frame}
        while frame in self.edges:
            frame = self.edges[frame].parent
            if frame in seen:
                raise DataError(name, f"frame {frame!r}", "is its own ancestor; expected a tree of frames")
            seen.add(frame)

    @property
    def frames(self) -> list[str]:
        """All frames, each once."""
        return [*dict.fromkeys([*self.edges, *(edge.parent for edge in self.edges.values())])]

    def ancestors(self, frame: str) -> list[str]:
        """The frame, its parent, and so on up to the root."""
        found = [frame]
        while found[-1] in self.edges:
            found.append(self.edges[found[-1]].parent)
        return found

    def moves(self, frame: str) -> bool:
        """Whether a frame moves in its parent."""
        return frame in self.edges and self.edges[frame].path is not None

    def mount(self, ancestor: str, frame: str) -> RigidTransform | None:
        """`ancestor_from_frame` where nothing moves between them; None where something does, or there is no way.

        The ancestor may be any frame that shares fixed ancestors with the other.
        """
        above, below = self._fixed_above(ancestor), self._fixed_above(frame)
        for common in below:
            if common in above:
                return above[common].inverse() @ below[common]
        return None

    def _fixed_above(self, frame: str) -> dict[str, RigidTransform]:
        """`ancestor_from_frame` of all ancestors up to the first that moves."""
        found, transform = {frame: RigidTransform.identity()}, RigidTransform.identity()
        while frame in self.edges:
            edge = self.edges[frame]
            if edge.fixed is None:
                break
            frame, transform = edge.parent, edge.fixed @ transform
            found[frame] = transform
        return found

    def path(self, ancestor: str, frame: str) -> Poses | None:
        """`ancestor_from_frame` over time, at the times of all that moves between them.

        None where the ancestor is none, nothing moves, or what moves shares no time.
        """
        chain = self.ancestors(frame)
        if ancestor not in chain:
            return None
        edges = [self.edges[name] for name in chain[: chain.index(ancestor)]]
        paths = [edge.path for edge in edges if edge.path is not None]
        if not paths:
            return None
        return _composed(edges, _common_times(paths))


def _common_times(paths: Sequence[Poses]) -> Int64Array:
    times = np.unique(np.concatenate([path.timestamps_ns for path in paths]))
    start, stop = max(path.start_ns for path in paths), min(path.stop_ns for path in paths)
    return times[(times >= start) & (times <= stop)]


def _composed(edges: Sequence[Edge], times: Int64Array) -> Poses | None:
    """Compose edges, the lowest first."""
    if len(times) == 0:
        return None
    positions, quaternions = np.zeros((len(times), 3)), np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
    for edge in edges:
        if edge.path is not None:
            known = np.array_equal(edge.path.timestamps_ns, times)
            poses = edge.path if known else edge.path.interpolate(times)
            shift, rotation = poses.positions, poses.quaternions_xyzw
        elif edge.fixed is not None:
            shift = np.tile(edge.fixed.translation, (len(times), 1))
            rotation = np.tile(edge.fixed.quaternion_xyzw, (len(times), 1))
        positions = rotate_vectors(rotation, positions) + shift
        quaternions = multiply_quaternions(rotation, quaternions)
    return Poses(times, positions, quaternions)


def _check(record: TransformRecord, name: str) -> None:
    norms, wrong = lengths_of(record.quaternion_xyzw[None])
    if wrong[0] or not np.isfinite(record.position).all():
        problem = (
            f"position {record.position.tolist()}, orientation {record.quaternion_xyzw.tolist()} "
            f"of length {norms[0]:.4g}; expected finite numbers and a unit quaternion x y z w"
        )
        raise DataError(name, f"transform {record.parent!r} to {record.child!r}", problem)
    if record.parent == record.child:
        raise DataError(name, f"transform {record.parent!r} to {record.child!r}", "is from a frame to itself")
