"""The tree of frames that transforms build: which frame is the ego and which the world.

Extrinsics and poses of sensors.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.poses import lengths_of
from sceneloom.formats.messages.records import TransformRecord
from sceneloom.geometry.rigid import RigidTransform, multiply_quaternions, normalise_quaternion, rotate_vectors
from sceneloom.scene.poses import Poses, poses_along
from sceneloom.scene.types import PointsFrame
from sceneloom.warnings import WarningKind

_STANDS_M, _STANDS_ROTATION = 1e-9, 1e-12  # a frame whose transforms all agree within this does not move


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
        if rows.fixed or (np.abs(positions - positions[0]).max() <= _STANDS_M and rotations <= _STANDS_ROTATION):
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
        times = np.unique(np.concatenate([path.timestamps_ns for path in paths]))
        start, stop = max(path.start_ns for path in paths), min(path.stop_ns for path in paths)
        return _composed(edges, times[(times >= start) & (times <= stop)])


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


_EGO_NAMES = ("base_link", "ego", "ego_vehicle", "base_footprint", "vehicle", "base", "body")
"""What the frame of a vehicle is called, the likeliest first. Source: REP 105 for the first."""


@dataclass(frozen=True, slots=True)
class _Roles:
    """The frames of a scene: ego, None where no sensor has a frame; world, None where nothing moves."""

    ego: str | None
    world: str | None


def choose_roles(
    tree: FrameTree, sensor_frames: Iterable[str], *, ego: str | None, world: str | None, location: str, ledger: Ledger
) -> _Roles:
    """Choose the frames.

    The ego is a frame of one of the usual names, below the lowest frame that moves and above most sensors; without
    such a name that frame itself. The world is the highest frame above it.

    Args:
        tree: the frames.
        sensor_frames: of all sensors.
        ego, world: frames that somebody chose, or None.
        location: for warnings.
        ledger: takes what was chosen.

    Raises:
        OptionError: a frame that was chosen is not there.
    """
    frames = tree.frames
    for role, frame in (("ego", ego), ("world", world)):
        if frame is not None and frame not in frames:
            raise OptionError(f"{role} {frame!r}; the frames are {', '.join(sorted(frames)) or 'none'}")
    own = [frame for frame in sensor_frames if frame in frames]
    chosen = ego or _ego(tree, own)
    if chosen is None:
        return _Roles(None, world)
    above = tree.ancestors(chosen)[1:]
    moving = [frame for frame in (chosen, *above) if tree.moves(frame)]
    if world is None and moving:
        world = above[-1]
        others = above[above.index(tree.edges[moving[0]].parent) : -1]
        choice = f"; {', '.join(others)} could be it, too" if others else ""
        message = f"frame {chosen!r} is the ego, {world!r} the world{choice}"
        ledger.note(WarningKind.ASSUMED, "frames-chosen", location, message)
    return _Roles(chosen, world)


def _ego(tree: FrameTree, sensor_frames: list[str]) -> str | None:
    """The frame that carries most sensors."""
    movers = Counter(
        next((frame for frame in tree.ancestors(frame) if tree.moves(frame)), None) for frame in sensor_frames
    )
    movers.pop(None, None)
    if not movers:
        moving = [frame for frame in tree.frames if tree.moves(frame)]
        body = moving[0] if moving and not sensor_frames else None
    else:
        body = movers.most_common(1)[0][0]
    candidates = [name for name in _EGO_NAMES if name in tree.frames]
    if body is not None:
        above = tree.ancestors(body)[1:]
        near = [name for name in candidates if name in above or tree.mount(body, name) is not None]
        return near[0] if near else body
    if candidates:
        return candidates[0]
    roots = Counter(tree.ancestors(frame)[-1] for frame in sensor_frames)
    return roots.most_common(1)[0][0] if roots else None


@dataclass(frozen=True, slots=True, eq=False)
class Locations:
    """The frames, and the ego trajectory.

    Attributes:
        tree: of the frames.
        roles: which of them is the ego, and which the world.
        trajectory: `world_from_ego`, the default one; None where none is known.
    """

    tree: FrameTree
    roles: _Roles
    trajectory: Poses | None

    def points_frame(self, frame_id: str) -> PointsFrame:
        """Whose frame it is: the world's, the ego's, or a sensor's own."""
        if frame_id == self.roles.world:
            return PointsFrame.WORLD
        return PointsFrame.EGO if frame_id == self.roles.ego else PointsFrame.SENSOR

    def mount(self, frame_id: str) -> RigidTransform | None:
        """`ego_from_sensor`, or None."""
        ego = self.roles.ego
        return None if ego is None else self.tree.mount(ego, frame_id)

    def mounts_at(self, frame_id: str, times_ns: Int64Array) -> list[RigidTransform | None]:
        """`ego_from_sensor` at each of some times, for a sensor that moves on the ego; None beyond what is known."""
        ego = self.roles.ego
        path = None if ego is None else self.tree.path(ego, frame_id)
        if path is None:
            return [self.mount(frame_id)] * len(times_ns)
        samples = path.interpolate(times_ns)
        return [
            RigidTransform.from_quaternion(position, quaternion) if np.isfinite(position).all() else None
            for position, quaternion in zip(samples.positions, samples.quaternions_xyzw, strict=True)
        ]

    def poses(self, frame_id: str, mount: RigidTransform | None, times_ns: Int64Array) -> Poses | None:
        """`world_from_sensor` at some times: along the ego trajectory, else by the sensor's own frames."""
        if len(times_ns) == 0:
            return None
        if mount is not None:
            return poses_along(self.trajectory, {0: mount}, np.zeros(len(times_ns), np.int64), times_ns)
        world = self.roles.world
        return None if world is None or frame_id == world else self.tree.path(world, frame_id)

    def world_from(self, frame_id: str, times_ns: Int64Array) -> tuple[Poses | None, RigidTransform | None]:
        """What takes points of a frame into the world: a path, or one transform; neither where it is not known."""
        world = self.roles.world
        if world is None or frame_id == world:
            return None, RigidTransform.identity()
        path = self.tree.path(world, frame_id)
        if path is not None:
            return path, None
        fixed = self.tree.mount(world, frame_id)
        if fixed is not None:
            return None, fixed
        mount = self.mount(frame_id)
        return (None if mount is None else self.poses(frame_id, mount, times_ns)), None
