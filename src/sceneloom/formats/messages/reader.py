"""A log of messages as a scene: topics become sensors, frames become extrinsics and the ego trajectory."""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any, TypeVar, cast

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError, MissingExtraError, OptionError, UnknownFormatError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.poses import lengths_of
from sceneloom.formats.messages.cameras import CameraDraft, is_known_model
from sceneloom.formats.messages.packets import PacketDraft, PacketReading, draft_packets
from sceneloom.formats.messages.points import CloudDraft
from sceneloom.formats.messages.records import (
    LARGE,
    VELOCITIES,
    AnyRecord,
    Boxes2DRecord,
    Boxes3DRecord,
    CameraModelRecord,
    FixRecord,
    GridRecord,
    Kind,
    PoseRecord,
    SampleRecord,
    Topic,
    TopicLog,
    TransformRecord,
)
from sceneloom.formats.messages.survey import ATTRIBUTE_PARTS, Survey, in_order
from sceneloom.formats.points.cloud import unique_names
from sceneloom.formats.rig_files.matching import (
    EGO_FRAMES,
    RigSensor,
    fitted_camera,
    lacking,
    match_cameras,
    match_frames,
    note_replaced,
    oriented,
)
from sceneloom.formats.rig_files.reader import Rig, RigCamera, RigTransform
from sceneloom.geometry.rigid import RigidTransform, multiply_quaternions, normalise_quaternion, rotate_vectors
from sceneloom.scene.annotations import (
    Annotation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CuboidAnnotation,
    CuboidPath,
)
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, VectorSamples
from sceneloom.scene.poses import Poses, Trajectory, placed_along, poses_along
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import NO_FIELDS, Coordinates, PointsFrame
from sceneloom.warnings import WarningKind

_TIMESTAMPS = ("header", "receive")  # which times can be asked for
_FAR_NS = 60_000_000_000  # no network delays messages by more than this: another clock timestamped them
_ZERO_NS = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class _TopicTimes:
    """The times of one topic's messages, (N,) int64 [ns]; `fixed` ones state what always holds."""

    topic: Topic
    timestamps_ns: Int64Array
    received_ns: Int64Array
    fixed: bool = False

    @property
    def unset(self) -> BoolArray:
        """(N,) bool, which messages are timestamped 0 and were received at another time."""
        unset: BoolArray = (self.timestamps_ns == 0) & (np.abs(self.received_ns) > _ZERO_NS)
        return unset

    @property
    def delay_ns(self) -> int | None:
        """How long after its timestamp a message was received, in the middle; None where no message has a timestamp."""
        timestamped = ~self.unset
        if self.fixed or not timestamped.any():
            return None
        return int(np.median(self.received_ns[timestamped] - self.timestamps_ns[timestamped]))


def _settle_times(
    all_times: Sequence[_TopicTimes], name: str, ledger: Ledger, *, wanted: str | None
) -> dict[int, Int64Array]:
    """By number of the topic, the times that count: of the heads, unless topics are on different clocks."""
    if wanted not in (None, *_TIMESTAMPS):
        raise OptionError(f"timestamps {wanted!r}; expected one of {', '.join(_TIMESTAMPS)}")
    strangers = _strangers(all_times, name, ledger) if wanted is None else frozenset()
    found = {}
    for times in all_times:
        if wanted == "receive" or times.topic.number in strangers:
            found[times.topic.number] = times.received_ns
            continue
        unset = times.unset
        if unset.any() and not times.fixed:
            message = "messages timestamped 0; the time at which they were received counts"
            location = f"{name}: {times.topic.name}"
            ledger.note(WarningKind.REPAIRED, "timestamps-zero", location, message, count=int(unset.sum()))
        found[times.topic.number] = np.where(unset, times.received_ns, times.timestamps_ns)
    return found


def _strangers(all_times: Sequence[_TopicTimes], name: str, ledger: Ledger) -> frozenset[int]:
    """The topics whose timestamps are of another clock than those of the others."""
    delays = {
        times.topic.number: (times.topic.name, delay) for times in all_times if (delay := times.delay_ns) is not None
    }
    if not delays:
        return frozenset()
    near = {number for number, (_, delay) in delays.items() if abs(delay) <= _FAR_NS}
    if not near:
        usual = int(np.median([delay for _, delay in delays.values()]))
        near = {number for number, (_, delay) in delays.items() if abs(delay - usual) <= _FAR_NS}
        message = f"messages were received {usual / 1e9:.3f} s after their timestamps; the timestamps count"
        ledger.note(WarningKind.ASSUMED, "received-much-later", name, message, count=len(near))
    far = {number: row for number, row in delays.items() if number not in near}
    if far:
        reported = "; ".join(f"{topic} {delay / 1e9:+.3f} s" for topic, delay in sorted(far.values()))
        usual = int(np.median([delays[number][1] for number in near]))
        problem = (
            f"mixed time bases: messages were received {usual / 1e9:+.3f} s after their timestamps, but of {reported}; "
            'expected one clock: use timestamps="receive" to go by when they were received, timestamps="header" by '
            "the "
            "timestamps as they are, or `--lenient` to go by when those few were received"
        )
        ledger.fault("mixed-time-bases", DataError(name, "", problem), count=len(far))
    return frozenset(far)


def _survey(log: TopicLog, ledger: Ledger, *, timestamps: str | None) -> Survey:
    """Look at all topics; `timestamps`: which times count, "header" or "receive", None: see `_settle_times`."""
    found = Survey.begun(log, ledger)
    _note_unknown(log, ledger)
    times: list[_TopicTimes] = []
    rows: dict[int, list[tuple[int, list[AnyRecord]]]] = {}
    for topic in log.topics:
        if topic.kind in (None, Kind.NOTES, Kind.DESCRIPTION) or not topic.count:
            continue
        received = log.receive_times(topic)
        if topic.kind in LARGE:
            reported, looked = log.timestamps(topic)
            if not looked and not found.notes.ours:
                message = "some messages state the time at which they were received, so the others are taken to do so"
                ledger.note(WarningKind.ASSUMED, "timestamps-from-index", f"{log.name}: {topic.name}", message)
            times.append(_TopicTimes(topic, reported, received))
        else:
            rows[topic.number] = _read(log, topic, ledger)
            first = np.array([records[0].timestamp_ns for _, records in rows[topic.number]], np.int64)
            kept = received[np.array([k for k, _ in rows[topic.number]], np.int64)]
            records = [record for _, row in rows[topic.number] for record in row]
            fixed = all(isinstance(record, TransformRecord) and record.fixed for record in records)
            fixed = topic.kind is Kind.CAMERA_MODEL or (bool(records) and fixed)
            times.append(_TopicTimes(topic, first, kept, fixed))
    settled = _settle_times([row for row in times if len(row.timestamps_ns)], log.name, ledger, wanted=timestamps)
    # our own writer moves scenes that begin before 0 where a format knows no such times
    moved_ns = int(found.notes.root.get("time_shift_ns", 0))
    for row in times:
        number = row.topic.number
        settled[number] = settled.get(number, row.timestamps_ns) - moved_ns
        if number in rows:
            counted = settled[number] - row.timestamps_ns
            found.records[number] = [
                _moved(record, int(shift))
                for (_, records), shift in zip(rows[number], counted.tolist(), strict=True)
                for record in records
            ]
        else:
            found.times_ns[number] = settled[number]
    return found


def _moved(record: AnyRecord, shift_ns: int) -> AnyRecord:
    if shift_ns == 0:
        return record
    return cast("AnyRecord", replace(cast("Any", record), timestamp_ns=record.timestamp_ns + shift_ns))


def _read(log: TopicLog, topic: Topic, ledger: Ledger) -> list[tuple[int, list[AnyRecord]]]:
    """Read all messages of a topic; those that state nothing are left out."""
    found = []
    for k in range(topic.count):
        try:
            records = list(log.read(topic, k))
        except DataError as error:
            ledger.fault("messages-at-fault", error)
            continue
        if records:
            found.append((k, records))
    return found


def _note_unknown(log: TopicLog, ledger: Ledger) -> None:
    """Report which messages are not read, by their type."""
    groups: dict[tuple[str, str], list[Topic]] = {}
    for topic in log.topics:
        if topic.kind is None and topic.count:
            groups.setdefault((topic.schema, topic.why), []).append(topic)
    for (schema, why), topics in groups.items():
        names = ", ".join(sorted({topic.name for topic in topics}))
        message = f"messages {schema or 'without a type'} on {names}: {why}"
        count = sum(topic.count for topic in topics)
        ledger.note(WarningKind.SKIPPED, "unknown-messages", log.name, message, count=count)


_STANDS_M, _STANDS_ROTATION = 1e-9, 1e-12  # a frame whose transforms all agree within this does not move


@dataclass(slots=True)
class _TransformRows:
    """The transforms of one frame as they come."""

    parent: str
    times_ns: list[int] = field(default_factory=list)
    positions: list[Float64Array] = field(default_factory=list)
    quaternions: list[Float64Array] = field(default_factory=list)
    fixed: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class _Edge:
    """How a frame is, or moves, in its parent: `parent_from_child` where it never changes, else over time."""

    parent: str
    fixed: RigidTransform | None = None
    path: Poses | None = None


class _FrameTree:
    """Frames by their ids."""

    def __init__(self, records: Iterable[TransformRecord], name: str) -> None:
        """Build the tree: the first of several transforms with one time counts, and the first parent."""
        self.edges: dict[str, _Edge] = {}  # of each frame that has a parent
        self.repeated = self.other_parents = 0  # transforms of the same time, or of another parent than before
        rows: dict[str, _TransformRows] = {}
        for record in records:
            _check_transform(record, name)
            found = rows.setdefault(record.child, _TransformRows(record.parent))
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

    def _edge(self, rows: _TransformRows) -> _Edge:
        positions = np.array(rows.positions).reshape(-1, 3)
        quaternions = normalise_quaternion(np.array(rows.quaternions).reshape(-1, 4))
        signs = np.where((quaternions * quaternions[0]).sum(axis=1) < 0, -1.0, 1.0)
        rotations = np.abs(quaternions * signs[:, None] - quaternions[0]).max()
        if rows.fixed or (np.abs(positions - positions[0]).max() <= _STANDS_M and rotations <= _STANDS_ROTATION):
            # of a frame that is stated to be fixed, the latest word counts
            return _Edge(rows.parent, fixed=RigidTransform.from_quaternion(positions[-1], quaternions[-1]))
        times, first = np.unique(np.array(rows.times_ns, np.int64), return_index=True)
        self.repeated += len(rows.times_ns) - len(times)
        return _Edge(rows.parent, path=Poses(times, positions[first], quaternions[first]))

    def add(self, rig: Rig, transforms: Sequence[RigTransform], name: str) -> None:
        """Add the transforms of a rig, which replace fixed ones of the log; frames that move in the log go on to move.

        Raises:
            DataError: transforms contradict one another, or lead in a circle.
        """
        frames = {frame for one in transforms for frame in (one.parent, one.child)}
        moving = [frame for frame in self.edges if self.moves(frame)]
        hanging = [frame for frame, edge in self.edges.items() if edge.parent not in frames]
        for one in oriented(transforms, [*moving, *hanging]):
            if self.moves(one.child):
                message = f"{one.location}: frame {one.child!r} moves in the drive; its fixed transform is not used"
                rig.ledger.note(WarningKind.SKIPPED, "rig-frame-moves", name, message)
                continue
            before = self.mount(one.parent, one.child)
            if before is not None:
                note_replaced(rig, f"frame {one.child!r} in {one.parent!r}", before, one.parent_from_child)
            self.edges[one.child] = _Edge(one.parent, fixed=one.parent_from_child)
        for child in self.edges:
            self._check_chain(child, name)

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


def _composed(edges: Sequence[_Edge], times: Int64Array) -> Poses | None:
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


def _check_transform(record: TransformRecord, name: str) -> None:
    norms, wrong = lengths_of(record.quaternion_xyzw[None])
    if wrong[0] or not np.isfinite(record.position).all():
        problem = (
            f"position {record.position.tolist()}, orientation {record.quaternion_xyzw.tolist()} "
            f"of length {norms[0]:.4g}; expected finite numbers and a unit quaternion x y z w"
        )
        raise DataError(name, f"transform {record.parent!r} to {record.child!r}", problem)
    if record.parent == record.child:
        raise DataError(name, f"transform {record.parent!r} to {record.child!r}", "is from a frame to itself")


@dataclass(frozen=True, slots=True)
class _Roles:
    """The frames of a scene: ego, None where no sensor has a frame; world, None where nothing moves."""

    ego: str | None
    world: str | None


def _choose_roles(
    tree: _FrameTree, sensor_frames: Iterable[str], *, ego: str | None, world: str | None, location: str, ledger: Ledger
) -> _Roles:
    """Choose the frames, unless somebody chose `ego` and `world`.

    The ego is a frame of one of the usual names, below the lowest frame that moves and above most sensors; without
    such a name that frame itself. The world is the highest frame above it.
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


def _ego(tree: _FrameTree, sensor_frames: list[str]) -> str | None:
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
    candidates = [name for name in EGO_FRAMES if name in tree.frames]
    if body is not None:
        above = tree.ancestors(body)[1:]
        near = [name for name in candidates if name in above or tree.mount(body, name) is not None]
        return near[0] if near else body
    if candidates:
        return candidates[0]
    roots = Counter(tree.ancestors(frame)[-1] for frame in sensor_frames)
    return roots.most_common(1)[0][0] if roots else None


@dataclass(frozen=True, slots=True, eq=False)
class _Locations:
    """The frames, and the ego trajectory."""

    tree: _FrameTree
    roles: _Roles
    trajectory: Poses | None  # `world_from_ego`, the default one; None where none is known

    def points_frame(self, frame_id: str) -> PointsFrame:
        """Whose frame it is: the world's, the ego's, or a sensor's own."""
        if frame_id == self.roles.world:
            return PointsFrame.WORLD
        return PointsFrame.EGO if frame_id == self.roles.ego else PointsFrame.SENSOR

    def is_placed(self, frame_id: str) -> bool:
        """Whether it is known where a frame is on the ego or in the world."""
        roots = [frame for frame in (self.roles.ego, self.roles.world) if frame is not None]
        return self.mount(frame_id) is not None or any(frame in self.tree.ancestors(frame_id) for frame in roots)

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


_Key = tuple[str, str]  # topic and id of an object


@dataclass(slots=True)
class _Track:
    """The boxes of one object in the order of the messages."""

    times_ns: list[int] = field(default_factory=list)
    boxes: list[Any] = field(default_factory=list)

    def drawn(self) -> tuple[Int64Array, list[Any]]:
        """Times and boxes in order, the last one of several with one time: a drawing replaces the one before."""
        latest = dict(zip(self.times_ns, self.boxes, strict=True))
        times = sorted(latest)
        return np.array(times, np.int64), [latest[time] for time in times]

    @property
    def label(self) -> str | None:
        """The class that is stated first."""
        return next((box.label for box in self.boxes if box.label), None)


def _gather(topic: str, records: Iterable[Boxes3DRecord | Boxes2DRecord], survey: Survey) -> dict[_Key, _Track]:
    """Collect the boxes of each object; a box without an id is an object of its own."""
    tracks: dict[_Key, _Track] = {}
    nameless = others = 0
    for record in records:
        others += record.no_boxes
        for box in record.boxes:
            identifier = box.id
            if not identifier:
                nameless += 1
                identifier = f"{topic.strip('/')}/{nameless}"
            track = tracks.setdefault((topic, identifier), _Track())
            track.times_ns.append(record.timestamp_ns)
            track.boxes.append(box)
    location = f"{survey.log.name}: {topic}"
    if others:
        survey.ledger.note(WarningKind.SKIPPED, "plots-not-read", location, "plots that are no boxes", count=others)
    if nameless:
        message = "boxes without an id; each is an object of its own"
        survey.ledger.note(WarningKind.ASSUMED, "boxes-without-id", location, message, count=nameless)
    return tracks


def _annotation_ids(keys: Sequence[_Key]) -> list[str]:
    """Ids of annotations: those of the objects, with the topic where several topics or frames have the same."""
    seen = Counter(identifier for _, identifier in keys)
    return [name if seen[name] == 1 else f"{topic.strip('/')}/{name}" for topic, name in keys]


def _cuboid_of_boxes(
    identifier: str | int, track: _Track, locations: _Locations, survey: Survey, location: str
) -> CuboidAnnotation | None:
    """Make the cuboid of an object; None where none of its boxes can be placed in the world."""
    times, boxes = track.drawn()
    centers = np.array([box.center for box in boxes]).reshape(-1, 3)
    rotations = np.array([box.quaternion_xyzw for box in boxes]).reshape(-1, 4)
    sizes = np.array([box.size_lwh for box in boxes]).reshape(-1, 3)
    sound = ~lengths_of(rotations)[1]
    sound &= np.isfinite(np.hstack([centers, rotations, sizes])).all(axis=1)
    _note(survey, sound, "boxes-at-fault", location, "boxes without position, size or orientation")
    placed = np.zeros(len(boxes), np.bool_)
    for frame in dict.fromkeys(box.frame_id for box in boxes):
        same = np.array([box.frame_id == frame for box in boxes]) & sound
        if same.any():
            with np.errstate(over="ignore", invalid="ignore"):
                placed[same] = _to_world(centers, rotations, same, times, frame, locations)
    placed &= np.isfinite(centers).all(axis=1)
    message = "boxes in frames that are not placed in the world then"
    _note(survey, placed | ~sound, "boxes-not-placed", location, message)
    if not placed.any():
        return None
    angles = CuboidAngles().from_quaternions(normalise_quaternion(rotations[placed]))
    path = CuboidPath(times[placed], np.hstack([sizes[placed], centers[placed], angles]))
    kept = [box for box, good in zip(boxes, placed.tolist(), strict=True) if good]
    return CuboidAnnotation(identifier, path, track.label, attributes=_attributes(times[placed], kept))


def _note(survey: Survey, good: Any, code: str, location: str, message: str) -> None:
    lost = int((~good).sum())
    if lost:
        survey.ledger.note(WarningKind.SKIPPED, code, location, message, count=lost)


def _to_world(
    centers: Float64Array, rotations: Float64Array, same: Any, times: Int64Array, frame: str, locations: _Locations
) -> Any:
    """Move the chosen boxes of one frame into the world, in place; report which of them could be."""
    path, fixed = locations.world_from(frame, times[same])
    if fixed is not None:
        if not np.array_equal(fixed.matrix, np.eye(4)):
            centers[same] = fixed.apply(centers[same])
            rotations[same] = multiply_quaternions(fixed.quaternion_xyzw, rotations[same])
        return True
    if path is None:
        return False
    poses = path.interpolate(times[same], reach_ns=_REACH_NS)
    known = poses.coverage < 2
    centers[same] = rotate_vectors(poses.quaternions_xyzw, centers[same]) + poses.positions
    rotations[same] = multiply_quaternions(poses.quaternions_xyzw, rotations[same])
    return known


_REACH_NS = 100_000_000  # boxes may be this much before or after all that is known of the ego trajectory


def _box_2d(identifier: str | int, sensor_id: str | int, track: _Track) -> Box2DAnnotation:
    """Make the box of an object in the images of a camera."""
    times, boxes = track.drawn()
    values = np.array([box.box_ltwh for box in boxes], np.float64).reshape(-1, 4)
    return Box2DAnnotation(
        identifier, sensor_id, BoxPath(times, values), track.label, attributes=_attributes(times, boxes)
    )


def _attributes(times: Int64Array, boxes: Sequence[Any]) -> tuple[AttributePath, ...]:
    """What is stated for an object beside its class, where it changes."""
    found = []
    for name in dict.fromkeys(name for box in boxes for name in box.reported):
        values = [box.reported.get(name) for box in boxes]
        changes = [k for k, value in enumerate(values) if value is not None and (k == 0 or values[k - 1] != value)]
        found.append(AttributePath(name, tuple(_value(values[k]) for k in changes), times[changes]))
    return tuple(found)


def _value(text: str) -> Any:
    """A number where the text is one."""
    try:
        number = float(text)
    except ValueError:
        return text
    return int(number) if number.is_integer() and abs(number) < 2**53 else number


def _read_annotations(survey: Survey, locations: _Locations, cameras: Mapping[str, Any]) -> list[Annotation]:
    """Annotations of all topics of boxes, those in notes as these state; `cameras`: ids by topics of images."""
    found = [*_cuboids(survey, locations), *_boxes_2d(survey, cameras)]
    notes = {(str(note.get("topic")), str(note.get("key"))): note for note in survey.notes.annotations}
    order = {key: row for row, key in enumerate(notes)}
    found.sort(key=lambda pair: order.get(pair[0], len(order)))
    annotations = [_with_note(annotation, notes.get(key)) for key, annotation in found]
    # an object may be a cuboid and a box in images
    taken = Counter[Any]()
    for k, annotation in enumerate(annotations):
        key = type(annotation.id), annotation.id
        taken[key] += 1
        if taken[key] > 1:
            annotations[k] = replace(annotation, id=f"{annotation.id}~{taken[key]}")
    return annotations


def _cuboids(survey: Survey, locations: _Locations) -> list[tuple[_Key, Annotation]]:
    tracks: dict[_Key, _Track] = {}
    for topic in survey.topics(Kind.BOXES_3D):
        tracks |= _gather(topic.name, survey.of(topic, Boxes3DRecord), survey)
    location = f"{survey.log.name}: boxes"
    made = [
        (key, _cuboid_of_boxes(identifier, track, locations, survey, location))
        for (key, track), identifier in zip(tracks.items(), _annotation_ids([*tracks]), strict=True)
    ]
    return [(key, annotation) for key, annotation in made if annotation is not None]


def _boxes_2d(survey: Survey, cameras: Mapping[str, Any]) -> list[tuple[_Key, Annotation]]:
    found: list[tuple[_Key, Box2DAnnotation]] = []
    noted = {note["boxes_topic"]: note["id"] for note in survey.notes.sensors if {"boxes_topic", "id"} <= note.keys()}
    for topic in survey.topics(Kind.BOXES_2D):
        records = survey.of(topic, Boxes2DRecord)
        # the camera whose topic stands beside that of boxes; the only one where there is only one
        name = _nearest(topic.name, cameras) or (next(iter(cameras)) if len(cameras) == 1 else None)
        camera = noted.get(topic.name, None if name is None else cameras[name])
        if camera is None:
            message = "boxes in images of a camera that is not reported"
            location = f"{survey.log.name}: {topic.name}"
            count = sum(len(record.boxes) for record in records)
            survey.ledger.note(WarningKind.SKIPPED, "boxes-without-camera", location, message, count=count)
            continue
        tracks = _gather(topic.name, records, survey)
        named = zip(tracks.items(), _annotation_ids([*tracks]), strict=True)
        found += [(key, _box_2d(identifier, camera, track)) for (key, track), identifier in named]
    # objects that several cameras see become an annotation for each
    counts = Counter(annotation.id for _, annotation in found)
    return [
        (key, replace(one, id=f"{key[0].strip('/')}/{one.id}") if counts[one.id] > 1 else one) for key, one in found
    ]


def _with_note(annotation: Annotation, note: Mapping[str, Any] | None) -> Annotation:
    if note is None:
        return annotation
    fields: dict[str, Any] = {name: note.get(name) for name in ("id", "parent_id", "label", "stationary")}
    fields["attributes"] = _attributes_from(note.get("attributes", ()))
    if note.get("extras"):
        fields["extras"] = MappingProxyType(note["extras"])
    return replace(annotation, **fields)


_ROTATION_FIRST = np.array([3, 4, 5, 0, 1, 2])
"""Messages have covariances of position, then rotation; trajectories of rotation, then position."""

_R = TypeVar("_R")
_VECTORS = frozenset({"accelerometer", "gyroscope", "magnetometer", *VELOCITIES})


@dataclass(frozen=True, slots=True, eq=False)
class _PoseRows:
    """The poses of a topic, in order."""

    timestamps_ns: Int64Array
    positions: Float64Array
    quaternions_xyzw: Float64Array | None  # None where some are not stated
    covariances: Float64Array | None  # (N, 6, 6), as trajectories have them
    frame_id: str
    body: str  # as `frame_id`, named by the first one


def _pose_rows(survey: Survey, name: str, records: Sequence[PoseRecord]) -> _PoseRows | None:
    """Bring the poses of a topic into order; None where there are none."""
    location = f"{survey.log.name}: {name}"
    kept = []
    for k, record in enumerate(records):
        fault = _pose_fault(record)
        if fault is None:
            kept.append(record)
        else:
            survey.ledger.fault("poses-at-fault", DataError(survey.log.name, f"{name}[{k}]", fault))
    if not kept:
        return None
    rows = in_order(np.array([record.timestamp_ns for record in kept], np.int64), location, survey.ledger)
    chosen = [kept[row] for row in rows.tolist()]
    rotations = [record.quaternion_xyzw for record in chosen]
    spreads = [record.covariance for record in chosen]
    quaternions = [rotation for rotation in rotations if rotation is not None]
    covariances = [spread for spread in spreads if spread is not None]
    if 0 < len(quaternions) < len(chosen):
        message = "poses with and without orientation; none of the orientations is used"
        survey.ledger.note(WarningKind.SKIPPED, "orientations-missing", location, message, count=len(quaternions))
    return _PoseRows(
        np.array([record.timestamp_ns for record in chosen], np.int64),
        np.array([record.position for record in chosen]),
        np.array(quaternions) if len(quaternions) == len(chosen) else None,
        np.array(covariances)[:, _ROTATION_FIRST][:, :, _ROTATION_FIRST] if len(covariances) == len(chosen) else None,
        chosen[0].frame_id,
        chosen[0].body,
    )


def _pose_fault(record: PoseRecord) -> str | None:
    if not np.isfinite(record.position).all():
        return f"position {record.position.tolist()}; expected finite numbers"
    if record.quaternion_xyzw is None:
        return None
    norms, wrong = lengths_of(record.quaternion_xyzw[None])
    if wrong[0]:
        return f"orientation {record.quaternion_xyzw.tolist()} of length {norms[0]:.4g}; expected 1 within 0.01"
    return None


def _trajectory(name: str, rows: _PoseRows, locations: _Locations, survey: Survey) -> Trajectory:
    """The ego trajectory that a topic reports, if need be through the frame of the body that it is of."""
    location = f"{survey.log.name}: {name}"
    ego = locations.roles.ego
    body_from_ego = None
    if rows.body and ego is not None and rows.body != ego:
        mount = locations.mount(rows.body)
        if mount is None:
            message = f"poses of frame {rows.body!r}, which is not connected with {ego!r}, are taken for the ego's"
            survey.ledger.note(WarningKind.ASSUMED, "pose-of-other-body", location, message)
        else:
            body_from_ego = mount.inverse()
    positions, quaternions = rows.positions, rows.quaternions_xyzw
    if body_from_ego is not None and quaternions is not None:
        positions = rotate_vectors(quaternions, body_from_ego.translation) + positions
        quaternions = multiply_quaternions(quaternions, body_from_ego.quaternion_xyzw)
    return Trajectory(
        name,
        read_only(rows.timestamps_ns),
        read_only(positions),
        None if quaternions is None else read_only(quaternions),
        covariances=None if rows.covariances is None else read_only(rows.covariances),
    )


def _gnss_sensor(
    log: "_Log", sensor_id: str | int, records: Sequence[FixRecord], location: str, **fields: Any
) -> GnssSensor:
    """A satellite receiver from its fixes; those without reception are left out."""
    survey = log.survey
    received = [record for record in records if record.received]
    if len(received) < len(records):
        count = len(records) - len(received)
        survey.ledger.note(WarningKind.SKIPPED, "no-reception", location, "fixes without reception", count=count)
    rows = in_order(np.array([record.timestamp_ns for record in received], np.int64), location, survey.ledger)
    chosen = [received[row] for row in rows.tolist()]
    unknown = (np.nan, np.nan, np.nan)
    variances = np.array([record.variances or unknown for record in chosen]).reshape(-1, 3)
    with np.errstate(invalid="ignore"):
        deviations = np.sqrt(np.where(variances >= 0, variances, np.nan))
        equal = deviations[:, 0] == deviations[:, 1]
        level = np.where(equal, deviations[:, 0], np.sqrt((variances[:, 0] + variances[:, 1]) / 2))
    return GnssSensor(
        sensor_id,
        read_only(np.array([record.timestamp_ns for record in chosen], np.int64)),
        read_only(np.array([record.lla for record in chosen], np.float64).reshape(-1, 3)),
        read_only(level),
        read_only(deviations[:, 2]),
        **fields,
    )


def _imu_sensor(
    log: "_Log",
    sensor_id: str | int,
    records: Sequence[SampleRecord],
    location: str,
    ego_from_imu: RigidTransform | None = None,
) -> ImuSensor:
    """An inertial unit from its samples, in the axes of the ego where these are known."""
    survey = log.survey
    by_stream: dict[str, list[tuple[int, tuple[float, ...]]]] = {}
    for record in records:
        for name, values in record.values.items():
            by_stream.setdefault(name, []).append((record.timestamp_ns, values))
    rotation = None if ego_from_imu is None else ego_from_imu.rotation
    if rotation is not None and np.array_equal(rotation, np.eye(3)):
        rotation = None
    if rotation is not None:
        message = (
            "measurements were converted to the axes of the ego; that the unit sits elsewhere is not accounted for"
        )
        survey.ledger.note(WarningKind.ASSUMED, "imu-rotated", location, message)
    streams: Mapping[str, VectorSamples] = MappingProxyType(
        {name: _stream(name, rows, rotation, survey, location) for name, rows in by_stream.items()}
    )
    covariances = _covariances(records, rotation, survey, location)
    extras = MappingProxyType({"covariances": covariances}) if covariances else NO_FIELDS
    return ImuSensor(sensor_id, streams, extras=extras)


def _covariances(
    records: Sequence[SampleRecord], rotation: Float64Array | None, survey: Survey, location: str
) -> dict[str, list[list[float]]]:
    """The covariance of each stream, in the axes of the stream, where it is the same in all messages."""
    stated: dict[str, Counter[tuple[float, ...]]] = {}
    for record in records:
        for name, covariance in record.covariances.items():
            stated.setdefault(name, Counter())[covariance] += 1
    found: dict[str, list[list[float]]] = {}
    for name, counts in stated.items():
        spread = np.array(next(iter(counts)), np.float64)
        width = round(len(spread) ** 0.5)
        if len(counts) > 1 or width * width != len(spread) or not np.isfinite(spread).all():
            message = f"covariances of {name} that change, or are no numbers, are not read"
            survey.ledger.note(WarningKind.SKIPPED, "fields-not-read", location, message, count=counts.total())
            continue
        spread = spread.reshape(width, width)
        if rotation is not None and name in _VECTORS and width == 3:
            spread = rotation @ spread @ rotation.T
        found[name] = spread.tolist()
    return found


def _stream(
    name: str,
    rows: Sequence[tuple[int, tuple[float, ...]]],
    rotation: Float64Array | None,
    survey: Survey,
    location: str,
) -> VectorSamples:
    widths = {len(values) for _, values in rows}
    if len(widths) > 1:
        raise DataError(survey.log.name, location, f"{name} of {sorted(widths)} values; expected as many each time")
    order = in_order(np.array([time for time, _ in rows], np.int64), f"{location}.{name}", survey.ledger)
    values = np.array([rows[row][1] for row in order.tolist()], np.float64).reshape(len(order), -1)
    if rotation is not None and name in _VECTORS and values.shape[1] == 3:
        values = values @ rotation.T
    return VectorSamples(read_only(np.array([rows[row][0] for row in order.tolist()], np.int64)), read_only(values))


_Note = Mapping[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class _OwnMounts:
    """Makes the images of a camera with a mounting of its own for each."""

    frames: LazyFrames[Any]
    mounts: Sequence[RigidTransform | None]

    def __call__(self, k: int) -> Any:
        """Make image `k` without reading it."""
        return replace(self.frames[k], mount=self.mounts[k])


def _common(note: _Note) -> dict[str, Any]:
    """Fields of every sensor."""
    extras = {"extras": MappingProxyType(note["extras"])} if note.get("extras") else {}
    return {"parent_id": note.get("parent_id"), **extras}


def _posed(log: "_Log", note: _Note, times_ns: Int64Array) -> dict[str, Any]:
    """Fields of sensors that are somewhere."""
    locations = log.locations
    mount = locations.mount(note["frame"]) if note.get("mount") else None
    if "own_mount" in note:
        numbers = np.array(note["own_mount"], np.float64)
        mount = RigidTransform.from_quaternion(numbers[:3], normalise_quaternion(numbers[3:7]))
    fields = _common(note) | {"mount": mount, "coordinates": Coordinates(note.get("coordinates", "world"))}
    reported = note.get("poses")
    if reported == "derived" and note.get("mounts") == "each":
        fields["poses"] = placed_along(locations.trajectory, locations.mounts_at(note["frame"], times_ns), times_ns)
    elif reported == "derived":
        fields["poses"] = locations.poses(note["frame"], mount, times_ns)
    elif reported is not None:
        rows = log.pose_rows(reported)
        fields["poses"] = None if rows is None else _path_of(rows, static=bool(note.get("static")))
    return fields


def _noted_cloud(log: "_Log", note: _Note) -> Sensor:
    radar, frame = note["type"] == "radar", {"points_frame": PointsFrame(note["points_frame"])}
    fields = frame if radar else {**frame, "model": note.get("model")}
    draft = log.clouds.get(note["topic"])
    if draft is not None:
        return draft.sensor(note["id"], radar=radar, **_posed(log, note, draft.reader.starts_ns), **fields)
    nothing: LazyFrames[Any] = LazyFrames.of([], [])
    posed = _posed(log, note, nothing.timestamps_ns)
    made: Sensor = (RadarSensor if radar else LidarSensor)(note["id"], nothing, **posed, **fields)
    return made


def _noted_map(log: "_Log", note: _Note) -> Sensor:
    return log.clouds[note["topic"]].points(note["id"], **_common(note))


def _noted_camera(log: "_Log", note: _Note) -> Sensor:
    draft, fps = log.cameras.get(note["topic"]), note.get("fps")
    if draft is None:
        kind: type[Any] = CameraSensor if note["type"] == "camera" else DepthCameraSensor
        nothing: LazyFrames[Any] = LazyFrames.of([], [])
        posed = _posed(log, note, nothing.timestamps_ns)
        made: Sensor = kind(note["id"], _camera_model_from_text(note["camera_model"]), nothing, fps=fps, **posed)
        return made
    times = draft.frames.timestamps_ns
    if note.get("mounts") == "each":
        own = _OwnMounts(draft.frames, log.locations.mounts_at(note["frame"], times))
        draft = replace(draft, frames=LazyFrames(times, own))
    return draft.sensor(note["id"], fps=fps, **_posed(log, note, times))


def _noted_gnss(log: "_Log", note: _Note) -> Sensor:
    mount = log.locations.mount(note["frame"]) if note.get("mount") else None
    fixes = log.records(note["topic"], Kind.FIX, FixRecord)
    return _gnss_sensor(log, note["id"], fixes, log.at(note["topic"]), mount=mount, **_common(note))


def _noted_imu(log: "_Log", note: _Note) -> Sensor:
    found: dict[str, Any] = {}
    for topic in note["topics"]:
        samples = log.records(topic, Kind.SAMPLE, SampleRecord)
        found |= _imu_sensor(log, note["id"], samples, log.at(topic)).streams
    order = [name for name in note.get("streams", ()) if name in found]
    streams = {name: found[name] for name in dict.fromkeys([*order, *found])}
    return ImuSensor(note["id"], MappingProxyType(streams), **_common(note))


def _noted_odometry(log: "_Log", note: _Note) -> Sensor:
    rows = log.pose_rows(note["topic"])
    if rows is None:
        raise DataError(log.survey.log.name, note["topic"], "no poses; expected those of the odometry")
    return OdometrySensor(note["id"], _path_of(rows, static=bool(note.get("static"))), **_common(note))


_NOTED: Mapping[str, Callable[["_Log", _Note], Sensor]] = MappingProxyType({
    "lidar": _noted_cloud, "radar": _noted_cloud, "points": _noted_map, "camera": _noted_camera,
    "depth_camera": _noted_camera, "gnss": _noted_gnss, "imu": _noted_imu, "odometry": _noted_odometry,
})  # fmt: skip
"""What makes the sensors of notes, by their types."""


def _noted_sensors(log: "_Log") -> list[Sensor]:
    """The sensors that notes speak of, in their order."""
    survey, sensors = log.survey, []
    for note in survey.notes.sensors:
        try:
            sensors.append(_NOTED[note["type"]](log, note))
        except (KeyError, ValueError, TypeError) as error:
            problem = f"note of sensor {note.get('id')!r} does not fit the messages: {error!r}"
            survey.ledger.fault("notes-at-fault", DataError(survey.log.name, "sceneloom.scene", problem))
        except DataError as error:
            survey.ledger.fault("topics-at-fault", error)
    return sensors


def _path_of(rows: _PoseRows, *, static: bool) -> Poses:
    """The path that rows report; without orientations nothing rotates."""
    quaternions = rows.quaternions_xyzw
    if quaternions is None:
        quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (len(rows.timestamps_ns), 1))
    return Poses(rows.timestamps_ns, rows.positions, quaternions, static=static)


def _noted_trajectories(survey: Survey) -> dict[str, Trajectory]:
    """The trajectories that notes describe, in their order."""
    found = {}
    topics = {topic.name: topic for topic in survey.topics(Kind.POSE)}
    for note in survey.notes.trajectories:
        topic = topics.get(note.get("topic", ""))
        rows = None if topic is None else _pose_rows(survey, topic.name, survey.of(topic, PoseRecord))
        if rows is not None:
            name = str(note["name"])
            poses = rows.timestamps_ns, rows.positions, rows.quaternions_xyzw
            found[name] = Trajectory(name, *poses, covariances=rows.covariances)
    return found


def _noted_scene_fields(survey: Survey, metadata: Mapping[str, Any], form: str) -> dict[str, Any]:
    """Fields of the scene itself."""
    notes = survey.notes
    if not notes.ours:
        euler = {"euler_unit": "degrees", "euler_order": "xyz"}
        return {"metadata": MappingProxyType({"sceneloom": euler, form: dict(metadata)})}
    return {
        "metadata": MappingProxyType(notes.root.get("metadata", {})),
        "extras": MappingProxyType(notes.root.get("extras", {})),
        "attributes": _attributes_from(notes.root.get("attributes", ())),
        "time_offset_ns": int(notes.root.get("time_offset_ns", 0)),
    }


def fixed_transforms(log: TopicLog) -> tuple[list[tuple[str, str, RigidTransform]], list[str]]:
    """Read the transforms of a log that are stated to stay.

    Returns:
        fixed: parent, child and `parent_from_child` of each, of topics that end with tf_static.
        others: children of transforms on other topics, which move or may.

    Raises:
        DataError: a message is wrong, or the frames are no tree.
    """
    records: dict[bool, list[TransformRecord]] = {True: [], False: []}
    for topic in log.topics:
        for k in range(topic.count if topic.kind is Kind.TRANSFORM else 0):
            found = [record for record in log.read(topic, k) if isinstance(record, TransformRecord)]
            records[topic.name.endswith("tf_static")] += [replace(record, fixed=True) for record in found]
    edges = _FrameTree(records[True], log.name).edges
    fixed = [(edge.parent, child, edge.fixed) for child, edge in edges.items() if edge.fixed is not None]
    return fixed, sorted({record.child for record in records[False]} - edges.keys())


_IMAGE_KINDS = (Kind.IMAGE, Kind.COMPRESSED_IMAGE, Kind.VIDEO)
_FROM_FRAMES = "tf"  # name of the ego trajectory that the transforms report


@dataclass(frozen=True, slots=True, eq=False)
class _Closing:
    """Closes what a scene is read from: the videos of cameras, then the log."""

    log: TopicLog
    cameras: list[CameraDraft]

    def __call__(self) -> None:
        for camera in self.cameras:
            if camera.video is not None:
                camera.video.close()
        self.log.close()


class _Log:
    """A log while a scene is made of it; `clouds` and `cameras` by the names of their topics."""

    def __init__(
        self, found: Survey, cameras: list[CameraDraft], rig: Rig | None, packets: PacketReading | None
    ) -> None:
        """Look at the first message of each topic of large ones; drafts of cameras are added to `cameras`, too."""
        self.survey, self.rig, self.ids = found, rig, _ids_of_topics(found)
        known = [
            RigSensor(self.ids[one.name], one.kind in _IMAGE_KINDS, topic=one.name) for one in _sensor_topics(found)
        ]
        self.rig_cameras = {} if rig is None else match_cameras(rig, known)
        clouds = _draft_all(self, cameras)
        self.clouds = {draft.reader.topic.name: draft for draft in clouds}
        self.cameras = {draft.topic.name: draft for draft in cameras}
        self.packets = [] if packets is None else draft_packets(found, packets)
        self.drafts: list[CloudDraft | CameraDraft | PacketDraft] = [*clouds, *cameras, *self.packets]
        _note_twice(found, clouds, self.packets)
        self.locations: _Locations  # of all frames, once they are known

    def at(self, topic: str) -> str:
        """Where a topic is, for warnings."""
        return f"{self.survey.log.name}: {topic}"

    def sensors(self) -> list[RigSensor]:
        """The sensors of all topics whose messages have a frame."""
        frames = {draft.topic.name: draft.frame_id for draft in self.drafts if isinstance(draft, CameraDraft)}
        frames |= {name: draft.frame_id for name, draft in self.clouds.items()}
        frames |= {draft.topic.name: draft.frame_id for draft in self.packets}
        for kind, record_type in ((Kind.SAMPLE, SampleRecord), (Kind.POSE, SampleRecord), (Kind.FIX, FixRecord)):
            small: type[Any] = record_type
            for topic in self.survey.topics(kind):
                for record in self.survey.of(topic, small)[:1] if topic.name in self.ids else ():
                    frames[topic.name] = record.frame_id
        return [RigSensor(self.ids[name], name in self.cameras, frame, name) for name, frame in frames.items()]

    def records(self, topic: str, kind: Kind, record_type: type[_R]) -> list[_R]:
        """The records of a topic by its name."""
        topics = [found for found in self.survey.topics(kind) if found.name == topic]
        return [record for found in topics for record in self.survey.of(found, record_type)]

    def pose_rows(self, topic: str) -> _PoseRows | None:
        """The poses of a topic by its name."""
        return _pose_rows(self.survey, topic, self.records(topic, Kind.POSE, PoseRecord))


def scene_from_topics(
    log: TopicLog,
    ledger: Ledger,
    *,
    form: str,
    metadata: Mapping[str, Any],
    timestamps: str | None = None,
    ego: str | None = None,
    world: str | None = None,
    rig: Rig | None = None,
    packets: PacketReading | None = None,
) -> Scene:
    """Make a scene of a log.

    Args:
        log: the messages; closed with the scene, or here if it cannot be made.
        ledger: takes warnings and faults.
        form: name of the format.
        metadata: what the file says of itself.
        timestamps: which times of messages count, "header" or "receive".
        ego, world: frames that are to be these.
        rig: mountings and camera models that the log does not state, or not rightly.
        packets: how packets are read; None where the format has none.

    Raises:
        DataError: a message is wrong.
        OptionError: a frame that was chosen is not there, or nothing of the rig is.
    """
    closing = _Closing(log, [])
    try:
        found = _survey(log, ledger, timestamps=timestamps)
        context = _Log(found, closing.cameras, rig, packets)
        ego = ego or (rig.stated.get("ego") if rig is not None else None)
        trajectories = _locate(context, ego=ego, world=world)
        sensors = _noted_sensors(context)
        cameras = {
            note["topic"]: note["id"]
            for note in found.notes.sensors
            if note.get("type") == "camera" and {"topic", "id"} <= note.keys()
        }
        sensors += _foreign_sensors(context, cameras)
        annotations = _read_annotations(found, context.locations, cameras)
        fields = _noted_scene_fields(found, metadata, form)
    except BaseException:
        closing()
        raise
    return Scene(
        sensors=tuple(sensors),
        annotations=tuple(annotations),
        trajectories=MappingProxyType(trajectories),
        source=log.name,
        format=form,
        warnings=(*(() if rig is None else rig.ledger.warnings), *ledger.warnings),
        on_close=closing,
        **fields,
    )


def _draft_all(context: "_Log", cameras: list[CameraDraft]) -> list[CloudDraft]:
    """Look at the first message of each topic of large ones; drafts of cameras are added to `cameras`."""
    found = context.survey
    camera_models = {topic.name: topic for topic in found.topics(Kind.CAMERA_MODEL)}
    noted = {note["topic"]: note.get("camera_model_topic") for note in found.notes.sensors if "topic" in note}
    clouds = []
    for topic in found.topics(Kind.CLOUD, *_IMAGE_KINDS):
        try:
            if topic.kind is Kind.CLOUD:
                clouds.append(CloudDraft.of(found, topic))
                continue
            name = noted[topic.name] if topic.name in noted else _calibration_of(found, topic, camera_models)
            chosen = context.rig_cameras.get(context.ids[topic.name])
            if context.rig is not None and chosen is not None:
                rigged = partial(_rig_camera, context.rig, context.ids[topic.name], chosen)
                cameras.append(CameraDraft.of(found, topic, None, rigged))
                continue
            cameras.append(CameraDraft.of(found, topic, camera_models.get(name or "")))
        except UnknownFormatError as error:
            location = f"{found.log.name}: {topic.name}"
            message = f"images that are not read: {error.problem}"
            found.ledger.note(WarningKind.SKIPPED, "unknown-images", location, message, count=topic.count)
        except (DataError, MissingExtraError) as error:
            found.ledger.fault("topics-at-fault", error, count=topic.count)
    return clouds


def _note_twice(found: Survey, clouds: Sequence[CloudDraft], packets: Sequence[PacketDraft]) -> None:
    """Warn of a lidar that is there as points and as packets: sweeps would count twice."""
    topics = {draft.frame_id: draft.reader.topic.name for draft in clouds if draft.frame_id}
    for draft in packets:
        if draft.frame_id in topics and draft.model:
            other, frame = topics[draft.frame_id], draft.frame_id
            message = f"packets and points on {other} have one frame, {frame!r}: both are read"
            location = f"{found.log.name}: {draft.topic.name}"
            found.ledger.note(WarningKind.ASSUMED, "packets-and-points", location, message)


def _calibration_of(found: Survey, topic: Topic, camera_models: Mapping[str, Topic]) -> str | None:
    """The topic of a camera's calibrations: beside that of its images, else the only one of its frame that is known."""
    name = _nearest(topic.name, camera_models)
    if name is not None or found.notes.ours:
        return name
    frame = getattr(found.log.read(topic, 0)[0], "frame_id", "")
    near = [
        name
        for name, one in camera_models.items()
        if frame
        and any(record.frame_id == frame and is_known_model(record) for record in found.of(one, CameraModelRecord)[:1])
    ]
    if len(near) != 1:
        return None
    message = f"{near[0]} is taken for the calibration of these images: it states the same frame {frame!r}"
    found.ledger.note(WarningKind.ASSUMED, "calibration-by-frame", f"{found.log.name}: {topic.name}", message)
    return near[0]


def _rig_camera(rig: Rig, camera_id: Any, found: RigCamera, size: tuple[int, int]) -> Camera:
    try:
        return fitted_camera(rig, camera_id, found, size)
    except CalibrationError as error:
        raise DataError(found.location, "", str(error)) from None


def _locate(context: _Log, *, ego: str | None, world: str | None) -> dict[str, Trajectory]:
    """Find the frames of the log, and the trajectories of the ego."""
    found = context.survey
    log, ledger, noted = found.log, found.ledger, found.notes.root.get("frames", {})
    tree = _FrameTree(found.all_of(Kind.TRANSFORM, TransformRecord), log.name)
    for code, count, message in (
        (
            "repeated-transforms",
            tree.repeated,
            "transforms with the time of another one of their frame; the first counts",
        ),
        ("other-parents", tree.other_parents, "transforms of a frame that another parent was named for before"),
    ):
        if count:
            ledger.note(WarningKind.SKIPPED, code, log.name, message, count=count)
    frames = set(tree.frames)
    rig, sensors = context.rig, context.sensors()
    if rig is not None and rig.transforms:
        tree.add(rig, match_frames(rig, sensors, context.rig_cameras, tree.edges), log.name)
        frames = set(tree.frames)
    elif rig is not None and not context.rig_cameras:
        match_frames(rig, sensors, {})
    chosen = {
        role: stated or (noted.get(role) if noted.get(role) in frames else None)
        for role, stated in (("ego", ego), ("world", world))
    }
    quiet = Ledger(lenient=True) if found.notes.ours else ledger
    large = [draft.frame_id for draft in context.drafts]
    small = dict.fromkeys(record.frame_id for record in found.all_of(Kind.FIX, FixRecord))
    small |= dict.fromkeys(record.frame_id for record in found.all_of(Kind.SAMPLE, SampleRecord))
    roles = _choose_roles(tree, [*large, *small], **chosen, location=log.name, ledger=quiet)
    context.locations = _Locations(tree, roles, None)
    trajectories = _noted_trajectories(found)
    if not found.notes.ours:
        trajectories = _foreign_trajectories(found, context.locations)
    if rig is not None or not found.notes.ours:
        known, seen = context.locations, {draft.frame_id for draft in context.packets if draft.mount is not None}
        for sensor in sensors:
            if sensor.frame in large and sensor.frame not in seen and not known.is_placed(sensor.frame):
                seen.add(sensor.frame)
                message = lacking(sensor, known.roles.ego or "base_link")
                (ledger if rig is None else rig.ledger).note(WarningKind.SKIPPED, "frames-missing", log.name, message)
    trajectory = next(iter(trajectories.values()), None)
    if trajectory is not None and trajectory.quaternions_xyzw is None:
        message = f"trajectory {trajectory.name!r} holds positions without orientations, so the sensors have no poses"
        ledger.note(WarningKind.SKIPPED, "orientations-missing", log.name, message)
    elif trajectory is not None:
        context.locations = _Locations(tree, roles, trajectory.poses)
    return trajectories


def _foreign_trajectories(found: Survey, locations: _Locations) -> dict[str, Trajectory]:
    """The trajectory that the transforms report, then those of topics of poses."""
    trajectories = {}
    ego, world = locations.roles.ego, locations.roles.world
    if ego is not None and world is not None:
        path = locations.tree.path(world, ego)
        if path is not None:
            trajectories[_FROM_FRAMES] = Trajectory(
                _FROM_FRAMES, path.timestamps_ns, path.positions, path.quaternions_xyzw
            )
    topics = found.topics(Kind.POSE)
    for topic, name in zip(topics, _sensor_names([topic.name for topic in topics]), strict=True):
        rows = _pose_rows(found, topic.name, found.of(topic, PoseRecord))
        if rows is not None:
            called = f"{name}~" if name in _RESERVED_NAMES or name in trajectories else name
            trajectories[called] = _trajectory(called, rows, locations, found)
    return trajectories


_RESERVED_NAMES = frozenset({"gnss", "lidar", "identity"})  # names of trajectories that are computed


def _noted_topics(found: Survey) -> set[Any]:
    return {name for note in found.notes.sensors for name in (note.get("topic"), *note.get("topics", ()))}


def _sensor_topics(found: Survey) -> list[Topic]:
    return [
        *found.topics(Kind.CLOUD, *_IMAGE_KINDS, Kind.PACKETS, Kind.SAMPLE, Kind.FIX, Kind.GRID),
        *_velocity_topics(found),
    ]


def _velocity_topics(found: Survey) -> list[Topic]:
    """Topics of poses that state velocities, too: of others they are 0 throughout."""
    topics = [] if found.notes.ours else found.topics(Kind.POSE)
    return [
        topic
        for topic in topics
        if any(any(map(any, record.values.values())) for record in found.of(topic, SampleRecord))
    ]


def _ids_of_topics(found: Survey) -> dict[str, Any]:
    """The id of the sensor of each topic: that of a note of ours, else after the topic's name."""
    noted = {
        topic: note.get("id")
        for note in found.notes.sensors
        for topic in (note.get("topic"), *note.get("topics", ()))
        if topic is not None
    }
    taken = {note.get("id") for note in found.notes.sensors}
    velocities = {topic.name: f"{'/'.join(_parts_of(topic.name))}/twist" for topic in _velocity_topics(found)}
    names = [topic.name for topic in _sensor_topics(found) if topic.name not in noted | velocities]
    made = [*zip(names, _sensor_names(names), strict=True), *velocities.items()]
    return noted | {topic: f"{name}~" if name in taken else name for topic, name in made}


def _foreign_sensors(context: _Log, camera_ids: dict[str, Any]) -> list[Sensor]:
    """The sensors that no note of ours speaks of; the ids of cameras are noted down by their topics."""
    found, locations = context.survey, context.locations
    noted = _noted_topics(found)
    topics = [topic for topic in _sensor_topics(found) if topic.name not in noted]
    drafts = {
        (draft.reader.topic if isinstance(draft, CloudDraft) else draft.topic).number: draft
        for draft in context.drafts
        if not isinstance(draft, PacketDraft)
    }
    sensors: list[Sensor] = []
    for topic in topics:
        identifier, draft = context.ids[topic.name], drafts.get(topic.number)
        sensors += [
            _packet_sensor(context, identifier, one) for one in context.packets if one.topic.number == topic.number
        ]
        if isinstance(draft, CloudDraft):
            mount, points_frame = locations.mount(draft.frame_id), locations.points_frame(draft.frame_id)
            poses = locations.poses(draft.frame_id, mount, draft.reader.starts_ns)
            sensors.append(draft.sensor(identifier, mount=mount, poses=poses, points_frame=points_frame))
        elif draft is not None:
            mount = locations.mount(draft.frame_id)
            poses = locations.poses(draft.frame_id, mount, draft.frames.timestamps_ns)
            sensors.append(draft.sensor(identifier, mount=mount, poses=poses))
            if not draft.is_depth:
                camera_ids[topic.name] = identifier
        elif topic.kind is Kind.GRID:
            sensors += _map_sensors(context, identifier, topic)
        elif topic.kind is Kind.FIX:
            fixes = found.of(topic, FixRecord)
            mount = locations.mount(fixes[0].frame_id) if fixes else None
            sensors.append(_gnss_sensor(context, identifier, fixes, context.at(topic.name), mount=mount))
        elif topic.kind in {Kind.SAMPLE, Kind.POSE}:
            samples = found.of(topic, SampleRecord)
            rotation = locations.mount(samples[0].frame_id) if samples else None
            sensors.append(_imu_sensor(context, identifier, samples, context.at(topic.name), rotation))
    # what looks for an IMU takes the first
    return sorted(sensors, key=lambda one: isinstance(one, ImuSensor) and set(one.streams) <= set(VELOCITIES))


def _map_sensors(context: _Log, identifier: str, topic: Topic) -> list[PointsSensor]:
    """The map that the last grid of a topic is, if its frame does not move in the world."""
    ledger, location = context.survey.ledger, context.at(topic.name)
    try:
        (record,) = context.survey.log.read(topic, topic.count - 1)
    except DataError as error:
        ledger.fault("topics-at-fault", error, count=topic.count)
        return []
    if not isinstance(record, GridRecord):
        return []
    _, world_from_grid = context.locations.world_from(record.frame_id, np.array([record.timestamp_ns]))
    if world_from_grid is None:
        message = f"frame {record.frame_id!r} is not fixed in the world, which maps are in; its grids are left out"
        ledger.note(WarningKind.SKIPPED, "grids-moving", location, message, count=topic.count)
        return []
    if topic.count > 1:
        ledger.note(WarningKind.SKIPPED, "grids-replaced", location, "the last grid counts", count=topic.count - 1)
    positions = world_from_grid.apply(record.positions)
    finite = (np.abs(positions) <= np.finfo(np.float32).max).all(axis=1)
    colors = None if record.colors is None else read_only(record.colors[finite])
    return [PointsSensor(identifier, read_only(positions[finite], np.float32), colors)]


def _packet_sensor(context: _Log, identifier: str, draft: PacketDraft) -> Sensor:
    """A sensor of packets where its frame is; else where it says itself to be."""
    locations = context.locations
    mount = RigidTransform.identity() if draft.on_ego else locations.mount(draft.frame_id)
    if mount is None and draft.mount is not None:
        mount = draft.mount
        message = "no frame tells where the radar is on the ego; where it says itself to be counts"
        context.survey.ledger.note(WarningKind.ASSUMED, "extrinsics-of-radar", context.at(draft.topic.name), message)
    if not len(draft.times_ns):
        return draft.sensor(identifier, mount=mount)
    poses = locations.poses(draft.frame_id, mount, draft.times_ns)
    points_frame = locations.points_frame(draft.frame_id)
    return draft.sensor(identifier, mount=mount, poses=poses, points_frame=points_frame)


def _camera_model_from_text(text: str) -> Camera:
    """The camera model of the writer's `_camera_model_text`."""
    model, width, height, (fx, fy, cx, cy), coefficients = json.loads(text)
    return Camera(model, width, height, fx, fy, cx, cy, tuple(coefficients))


_TAILS = frozenset(
    {
        "points", "points_raw", "point_cloud", "pointcloud", "pointcloud2", "cloud", "points2", "image", "image_raw",
        "image_rect", "image_color", "image_rect_color", "image_mono", "image_rect_raw", "raw", "compressed",
        "compressed_image", "compressed_video", "video", "data", "data_raw", "fix", "imu", "h264", "navsatfix",
        "location", "odometry", "pose", "mag", "temperature", "compressedDepth", "packets", "lidar_packets",
        "imu_packets", "velodyne_packets", "pandar_packets", "robosense_packets", "rslidar_packets", "nebula_packets",
        "ffmpeg", "draco", "zstd", "zlib", "cloudini", "scan",
    }
)  # fmt: skip
"""Last parts of topics that state what messages are, and not of which sensor."""


_CAMERA_MODEL_TAILS = frozenset({"camera_info", "calibration", "camera_calibration", "info", "intrinsics"})


_SAYING = (
    _TAILS | _CAMERA_MODEL_TAILS | {"annotations", "detections", "detections_2d", "boxes", "bounding_boxes", "objects"}
)


def _parts_of(topic: str, *, without: frozenset[str] = frozenset()) -> list[str]:
    """The parts of a topic's name, without those at the end that state what messages are; one at least stays."""
    parts = [part for part in topic.split("/") if part]
    while len(parts) > 1 and parts[-1] in without:
        parts.pop()
    return parts


def _sensor_names(topics: Sequence[str]) -> list[str]:
    """Name the sensors of topics: short where that is unique, else the whole topic, with a number if need be."""
    bases = ["/".join(_parts_of(topic, without=_TAILS)) or topic or "topic" for topic in topics]
    counts, pairs = Counter(bases), zip(topics, bases, strict=True)
    return unique_names(base if counts[base] == 1 else "/".join(_parts_of(topic)) or base for topic, base in pairs)


def _nearest(topic: str, others: Iterable[str]) -> str | None:
    """The topic of the same sensor, as /front/camera_info and /front/image_raw: equal but for the last parts."""
    base = _parts_of(topic, without=_SAYING)
    found = []
    for other in others:
        bare = _parts_of(other, without=_SAYING)
        shared = min(len(base), len(bare))
        if shared and base[:shared] == bare[:shared]:
            found.append((shared, -len(bare), other))
    return max(found)[2] if found else None


def _attributes_from(notes: Iterable[Mapping[str, Any]]) -> tuple[AttributePath, ...]:
    """The attributes of notes."""
    return tuple(
        AttributePath(
            note["name"],
            tuple(tuple(value) if isinstance(value, list) else value for value in note["values"]),
            np.asarray(note["timestamps_ns"], np.int64) if "timestamps_ns" in note else None,
            extras=MappingProxyType(note["extras"]) if "extras" in note else NO_FIELDS,
            **{name: note[name] for name in ATTRIBUTE_PARTS if name in note},
        )
        for note in notes
    )
