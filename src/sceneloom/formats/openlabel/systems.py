"""The frames of an OpenLABEL file: when each frame is, the tree of coordinate systems, and transforms."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.poses import lengths_of
from sceneloom.formats.base.text_tables import UNITS_NS, TimestampError, parse_timestamp
from sceneloom.formats.openlabel.document import Part
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import (
    matrix_from_quaternion,
    multiply_quaternions,
    normalise_quaternion,
    quaternion_from_matrix,
    rotate_vectors,
)
from sceneloom.scene.poses import Poses
from sceneloom.warnings import WarningKind

_DEFAULT_RATE_HZ = 10.0
_FARTHEST_NS = 9_200_000_000_000_000_000

_EPOCHS = (("nanoseconds", 1e17), ("microseconds", 1e14), ("milliseconds", 1e11))
"""Numbers from here on are times of our day in that unit; smaller ones are seconds."""


@dataclass(frozen=True, slots=True)
class FrameTimes:
    """The times of the frames.

    Attributes:
        by_number: time of each frame [ns].
    """

    by_number: dict[int, int]

    @property
    def first_ns(self) -> int:
        """The earliest time; 0 where there are no frames."""
        return min(self.by_number.values(), default=0)

    def at(self, number: int) -> int:
        """The time of a frame [ns], from its neighbours where it is not in the file."""
        if number in self.by_number:
            return self.by_number[number]
        if not self.by_number:
            return round(number * 1e9 / _DEFAULT_RATE_HZ)
        numbers = np.array(sorted(self.by_number))
        nearest = int(numbers[np.argmin(np.abs(numbers - number))])
        return self.by_number[nearest] + round((number - nearest) * 1e9 / _DEFAULT_RATE_HZ)


def frame_times(document: Part, ledger: Ledger, rate_hz: float | None) -> FrameTimes:
    """Read the times of all frames; those without one are counted.

    Raises:
        DataError: a frame's key is no number, or its time is none.
    """
    known: dict[int, int] = {}
    missing: list[int] = []
    for key, frame in document.each("frames"):
        if not (key.isascii() and key.isdigit() and len(key) < 16):
            ledger.fault(
                "frame-numbers",
                DataError(document.file, frame.location, "expected a whole number as its key"),
            )
            continue
        properties = frame.get("frame_properties")
        timestamp = None if properties is None else properties.get("timestamp")
        if timestamp is None:
            missing.append(int(key))
            continue
        known[int(key)] = _timestamp_ns(timestamp)
    if missing:
        _count(missing, known, document, ledger, rate_hz)
    return FrameTimes(known)


def _count(missing: list[int], known: dict[int, int], document: Part, ledger: Ledger, rate_hz: float | None) -> None:
    """Give frames without a time one: by their number, or with the known ones by their distance from these."""
    times = FrameTimes(dict(known))
    rate = rate_hz or _DEFAULT_RATE_HZ
    for number in missing:
        known[number] = times.at(number) if times.by_number else round(number * 1e9 / rate)
    reported = (
        f"frames have no timestamp; taken at {rate:g} Hz by number, `--input-option rate_hz=HZ` says another rate"
    )
    ledger.note(
        WarningKind.ASSUMED,
        "frame-times-assumed",
        f"{document.file}: openlabel.frames",
        reported,
        count=len(missing),
    )


def _timestamp_ns(timestamp: Part) -> int:
    """Read a time [ns]: a number or its text, in seconds, or another unit that makes it one of our day; or a date.

    Raises:
        DataError: it is none.
    """
    value = timestamp.value
    if isinstance(value, int | float) and not isinstance(value, bool):
        unit = next((name for name, least in _EPOCHS if abs(value) >= least), "seconds")
        time_ns = value * UNITS_NS[unit] if isinstance(value, int) else round(value * UNITS_NS[unit])
        if abs(time_ns) <= _FARTHEST_NS:
            return int(time_ns)
    if isinstance(value, str):
        whole = value.strip().lstrip("-").partition(".")[0]
        digits = len(whole) if whole.isdigit() else 0
        unit = next((name for name, least in _EPOCHS if digits > len(f"{least:.0f}") - 1), "seconds")
        try:
            return parse_timestamp(value, unit if digits else None)
        except TimestampError:
            pass
    raise timestamp.fault("a time in seconds, or a date as 2011-09-26T13:02:25.594Z")


_GREATEST_MATRIX_ERROR = 0.01
_DEFAULT_SEQUENCE = "ZYX"


def _read_transform(part: Part) -> RigidTransform:
    """Read a matrix of 4 times 4 by rows, or a quaternion x y z w or Euler angles with a translation.

    Raises:
        DataError: it is none of these, or its rotation is none.
    """
    matrix = part.get("matrix4x4")
    if matrix is not None:
        return _of_matrix(matrix, np.array(matrix.numbers((16,))).reshape(4, 4))
    translation = np.array(part.need("translation").numbers((3,)))
    quaternion = part.get("quaternion")
    if quaternion is not None:
        return RigidTransform.from_quaternion(
            translation, unit_quaternions([quaternion], [quaternion.numbers((4,))])[0]
        )
    angles = part.get("euler_angles")
    if angles is None:
        raise part.fault("matrix4x4, or quaternion or euler_angles with a translation")
    sequence = part.get("sequence")
    order = _DEFAULT_SEQUENCE if sequence is None else sequence.text()
    rotation = rotation_from_euler(part, angles.numbers((3,)), order)
    return RigidTransform.from_quaternion(translation, quaternion_from_matrix(rotation))


def _of_matrix(part: Part, matrix: Float64Array) -> RigidTransform:
    if not np.allclose(matrix[3], (0, 0, 0, 1), rtol=0, atol=1e-9):
        raise part.fault("a matrix by rows, whose last row is 0 0 0 1")
    try:
        nearest, error = RigidTransform.nearest(matrix)
    except SceneloomError as fault:
        raise DataError(part.file, part.location, str(fault)) from fault
    if not error <= _GREATEST_MATRIX_ERROR:
        raise part.fault(f"a rotation; its rows are off by {error:.2g}")
    return nearest


def unit_quaternions(parts: Sequence[Part], values: list[list[float]]) -> Float64Array:
    """Quaternions x y z w, (N, 4), of length 1 within a hundredth; one part each, for messages.

    Raises:
        DataError: one has another length.
    """
    quaternions = np.array(values, np.float64)
    wrong = np.flatnonzero(lengths_of(quaternions)[1])
    if len(wrong):
        raise parts[int(wrong[0])].fault("a quaternion x y z w of length 1")
    return normalise_quaternion(quaternions)


def rotation_from_euler(part: Part, angles: list[float], sequence: str) -> Float64Array:
    """The product of three rotates about named axes, (3, 3): of "ZYX" and (a, b, c) it is Rz(a) Ry(b) Rx(c).

    Raises:
        DataError: the sequence is none.
    """
    if len(sequence) != 3 or not set(sequence.upper()) <= set("XYZ"):
        raise DataError(part.file, f"{part.location}.sequence", f"{sequence!r}; expected three of X, Y, Z")
    rotation = np.eye(3)
    for axis, angle in zip(sequence.upper(), angles, strict=True):
        half = np.zeros(4)
        half["XYZ".index(axis)], half[3] = np.sin(angle / 2), np.cos(angle / 2)
        rotation = rotation @ matrix_from_quaternion(half)
    return rotation


_Edges = dict[str, tuple[str, Poses]]


@dataclass(frozen=True, slots=True, eq=False)
class Systems:
    """Coordinate systems, each with the one that it is placed in.

    Attributes:
        edges: by name: the name of the next one towards the root, and `next_from_this` over time.
        names: of all systems.
        sensors: those that are sensors'.
    """

    edges: _Edges
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


def read_systems(document: Part, times: FrameTimes, ledger: Ledger) -> Systems:
    """Read the coordinate systems and the transforms of all frames.

    Raises:
        DataError: one is wrong.
    """
    parents: dict[str, str] = {}
    edges: _Edges = {}
    for name, system in document.each("coordinate_systems"):
        parent = system.get("parent")
        parents[name] = "" if parent is None else parent.text()
        pose = system.get("pose_wrt_parent")
        if parents[name] and pose is not None:
            edges[name] = (parents[name], _still(_read_transform(pose)))
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
    return Poses(np.zeros(1, np.int64), transform.translation[None], transform.quaternion_xyzw[None], static=True)


def _moving(document: Part, times: FrameTimes) -> dict[tuple[str, str], Poses]:
    """The transforms of the frames, by source and destination."""
    rows: dict[tuple[str, str], dict[int, RigidTransform]] = {}
    for number, part in _transforms(document):
        pair = (part.need("src").text(), part.need("dst").text())
        found = _read_transform(part.need("transform_src_to_dst"))
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
