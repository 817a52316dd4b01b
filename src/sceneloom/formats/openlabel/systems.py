"""The frames of an OpenLABEL file: the time of each frame, the tree of coordinate systems, and transforms."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.poses import lengths_of
from sceneloom.formats.base.text_tables import FARTHEST_NS, UNITS_NS, TimestampError, parse_timestamp
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
_GREATEST_MATRIX_ERROR = 0.01
_DEFAULT_SEQUENCE = "ZYX"

_EPOCHS = (("nanoseconds", 1e17), ("microseconds", 1e14), ("milliseconds", 1e11))
"""Numbers from here on are times of our day in that unit; smaller ones are seconds."""


@dataclass(frozen=True, slots=True)
class FrameTimes:
    """The times of the frames [ns], by number."""

    by_number: dict[int, int]

    @property
    def first_ns(self) -> int:
        """The earliest time; 0 where there are no frames."""
        return min(self.by_number.values(), default=0)

    def at(self, number: int, rate_hz: float = _DEFAULT_RATE_HZ) -> int:
        """The time of a frame [ns]; of one that is not in the file, from the nearest one that is."""
        if number in self.by_number:
            return self.by_number[number]
        if not self.by_number:
            return round(number * 1e9 / rate_hz)
        nearest = min(self.by_number, key=lambda known: (abs(known - number), known))
        return self.by_number[nearest] + round((number - nearest) * 1e9 / _DEFAULT_RATE_HZ)


def read_frame_times(document: Part, ledger: Ledger, rate_hz: float | None) -> FrameTimes:
    """Read the times of all frames; those without one are timed by their number, or by their distance from others.

    Raises:
        DataError: a frame's key is no number, or its timestamp is none.
    """
    known: dict[int, int] = {}
    missing: list[int] = []
    for key, frame in document.each("frames"):
        if not (key.isascii() and key.isdigit() and len(key) < 16):
            fault = DataError(document.file, frame.location, "expected a whole number as its key")
            ledger.fault("frame-numbers", fault)
        elif (timestamp := frame.below("frame_properties").get("timestamp")) is None:
            missing.append(int(key))
        else:
            known[int(key)] = _timestamp_ns(timestamp)
    if missing:
        rate = rate_hz or _DEFAULT_RATE_HZ
        times = FrameTimes(dict(known))
        known |= {number: times.at(number, rate) for number in missing}
        message = f"frames have no timestamp; taken at {rate:g} Hz by number, `--input-option rate_hz=HZ` sets the rate"
        document.below("frames").note(ledger, WarningKind.ASSUMED, "frame-times-assumed", message, count=len(missing))
    return FrameTimes(known)


def _timestamp_ns(timestamp: Part) -> int:
    """Read a time [ns]: a number or its text, in seconds or another unit that makes it a time of our day; or a date."""
    value = timestamp.value
    if isinstance(value, int | float) and not isinstance(value, bool):
        unit = next((name for name, least in _EPOCHS if abs(value) >= least), "seconds")
        time_ns = value * UNITS_NS[unit] if isinstance(value, int) else round(value * UNITS_NS[unit])
        if abs(time_ns) <= FARTHEST_NS:
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


def _read_transform(part: Part) -> RigidTransform:
    """Read a matrix of 4 times 4 by rows, or a translation with a quaternion x y z w or Euler angles."""
    matrix = part.get("matrix4x4")
    if matrix is not None:
        return _of_matrix(matrix)
    translation = np.array(part.need("translation").numbers(3))
    quaternion, angles, sequence = part.get("quaternion"), part.get("euler_angles"), part.get("sequence")
    if quaternion is not None:
        rotation = unit_quaternions([quaternion], [quaternion.numbers(4)])[0]
    elif angles is not None:
        order = _DEFAULT_SEQUENCE if sequence is None else sequence.text()
        rotation = quaternion_from_euler(part, angles.numbers(3), order)
    else:
        raise part.fault("matrix4x4, or quaternion or euler_angles with a translation")
    return RigidTransform.from_quaternion(translation, rotation)


def _of_matrix(part: Part) -> RigidTransform:
    matrix = np.array(part.numbers(16)).reshape(4, 4)
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


def quaternion_from_euler(part: Part, angles: list[float], sequence: str = _DEFAULT_SEQUENCE) -> Float64Array:
    """The product of three rotations about named axes, x y z w: of "ZYX" and (a, b, c) it is Rz(a) Ry(b) Rx(c).

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
    return quaternion_from_matrix(rotation)


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


def read_systems(document: Part, times: FrameTimes, ledger: Ledger) -> Systems:
    """Read the coordinate systems and the transforms of all frames.

    Raises:
        DataError: one is wrong.
    """
    parents: dict[str, str] = {}
    edges: dict[str, tuple[str, Poses]] = {}
    for name, system in document.each("coordinate_systems"):
        parent, pose = system.get("parent"), system.get("pose_wrt_parent")
        parents[name] = "" if parent is None else parent.text()
        if parents[name] and pose is not None:
            edges[name] = (parents[name], _poses({0: _read_transform(pose)}, static=True))
    moving: dict[tuple[str, str], dict[int, RigidTransform]] = {}
    for key, frame in document.each("frames"):
        if key.isdigit():
            for _, part in frame.below("frame_properties").each("transforms"):
                pair = (part.need("src").text(), part.need("dst").text())
                found = _read_transform(part.need("transform_src_to_dst"))
                moving.setdefault(pair, {})[times.at(int(key))] = found
    for (source, goal), poses in moving.items():
        if source != goal and parents.get(goal) == source:
            edges[goal] = (source, _poses({time_ns: pose.inverse() for time_ns, pose in poses.items()}))
        elif source != goal:
            edges[source] = (goal, _poses(poses))
    for name, parent_name in parents.items():
        if parent_name and name not in edges:
            message = f"its position in {parent_name!r} is not stated; it is taken as a root of its own"
            part = document.need("coordinate_systems").need(name)
            part.note(ledger, WarningKind.ASSUMED, "coordinate-system-unplaced", message)
    names = frozenset({*parents, *(goal for goal, _ in edges.values())})
    return Systems(edges, names, frozenset(name for name, _ in document.each("streams")))


def _poses(by_time: dict[int, RigidTransform], *, static: bool = False) -> Poses:
    times = sorted(by_time)
    return Poses(
        np.array(times, np.int64),
        np.stack([by_time[time_ns].translation for time_ns in times]),
        np.stack([by_time[time_ns].quaternion_xyzw for time_ns in times]),
        static=static,
    )
