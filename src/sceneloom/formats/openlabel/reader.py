"""Read an OpenLABEL file: objects, actions, events, contexts and relations as annotations."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.cameras.camera import MODELS, OPENCV_LENGTHS, Camera, from_opencv
from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.json_files import read_json
from sceneloom.formats.base.poses import lengths_of
from sceneloom.formats.base.spec import as_positive
from sceneloom.formats.base.text_tables import FARTHEST_NS, UNITS_NS, TimestampError, parse_timestamp
from sceneloom.formats.openlabel.document import (
    ABSOLUTE,
    CONFIRMED,
    DOCUMENT,
    FISHEYE,
    INTERPOLATED,
    KEPT,
    KEPT_WHOLE,
    KIND,
    LENS_COEFFICIENTS,
    OF_OTHERS,
    OURS,
    OURS_CAMERA,
    PLAIN,
    RATE,
    RBBOX,
    RELATIVE,
    SCHEMA_VERSION,
    TYPE,
    SeenBoxes,
    restored,
)
from sceneloom.geometry.rigid import RigidTransform, multiply_quaternions, normalise_quaternion, rotate_vectors
from sceneloom.scene.annotations import (
    Annotation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CuboidAnnotation,
    CuboidPath,
    EventAnnotation,
    LinkAnnotation,
    ObjectAnnotation,
    ShapeAnnotation,
    ShapeType,
    VertexPath,
)
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, PlainSensor
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import NO_FIELDS, Identifier
from sceneloom.warnings import WarningKind

_SHOWN = 60
_LARGEST = 1e150


@dataclass(frozen=True, slots=True)
class _Part:
    """A part of a document."""

    file: Path
    location: str  # "openlabel.frames.3"
    value: Any

    def fault(self, expected: str) -> DataError:
        """The error of a part that is not what was expected."""
        text = repr(self.value)
        shown = text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"
        return DataError(self.file, self.location, f"{shown}; expected {expected}")

    def note(self, ledger: Ledger, kind: WarningKind, code: str, message: str, *, count: int = 1) -> None:
        """Add a warning about the part."""
        ledger.note(kind, code, f"{self.file}: {self.location}", message, count=count)

    def members(self) -> dict[str, Any]:
        """The members of a JSON object; DataError if it is none."""
        if not isinstance(self.value, dict):
            raise self.fault("a JSON object")
        return self.value

    def get(self, name: str) -> "_Part | None":
        """An optional member; null counts as missing."""
        value = self.members().get(name)
        return None if value is None else _Part(self.file, f"{self.location}.{name}", value)

    def need(self, name: str) -> "_Part":
        """A required member; DataError if it is missing."""
        found = self.get(name)
        if found is None:
            raise DataError(self.file, f"{self.location}.{name}", "missing")
        return found

    def below(self, name: str) -> "_Part":
        """A member; an empty object if it is missing."""
        return self.get(name) or _Part(self.file, f"{self.location}.{name}", {})

    def each(self, name: str) -> Iterator[tuple[str, "_Part"]]:
        """The members of an optional member, by name."""
        found = self.below(name)
        for key, value in found.members().items():
            yield key, _Part(self.file, f"{found.location}.{key}", value)

    def items(self, name: str) -> Iterator["_Part"]:
        """The elements of an optional list."""
        found = self.get(name)
        if found is not None:
            if not isinstance(found.value, list):
                raise found.fault("a list")
            for k, value in enumerate(found.value):
                yield _Part(self.file, f"{found.location}[{k}]", value)

    def text(self) -> str:
        """A text; DataError if it is none."""
        if not isinstance(self.value, str):
            raise self.fault("a text")
        return self.value

    def numbers(self, *counts: int) -> list[float]:
        """A list of finite numbers; DataError if it is none, or not of one of the lengths, if there are any."""
        values = self.value
        sound = (
            isinstance(values, list)
            and {*map(type, values)} <= {int, float}
            and all(-_LARGEST < end < _LARGEST for end in (min(values, default=0), max(values, default=0)))
        )
        if not sound or (counts and len(values) not in counts):
            raise self.fault(f"a list of {' or '.join(map(str, counts))}{' ' * bool(counts)}numbers")
        return [*map(float, values)]

    def number(self) -> float:
        """A finite number; DataError if it is none."""
        return _Part(self.file, self.location, [self.value]).numbers(1)[0]


_FAULTS = (SceneloomError, TypeError, ValueError, KeyError, OverflowError, AttributeError)


def _restored(own: _Part | None, annotation: Annotation, boxes: Mapping[str, SeenBoxes] = NO_FIELDS) -> Annotation:
    """The annotation with the fields that we wrote of it, if there are any; DataError if they do not fit."""
    if own is None:
        return annotation
    try:
        return restored(annotation, own.members(), boxes)
    except _FAULTS as error:
        raise own.fault(f"the fields of an annotation: {error}") from error


_DEFAULT_RATE_HZ = 10.0


_GREATEST_MATRIX_ERROR = 0.01


_DEFAULT_SEQUENCE = "ZYX"


_EPOCHS = (("nanoseconds", 1e17), ("microseconds", 1e14), ("milliseconds", 1e11))
"""Numbers from here on are times of our day in that unit; smaller ones are seconds."""


@dataclass(frozen=True, slots=True)
class _FrameTimes:
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


def _read_frame_times(document: _Part, ledger: Ledger, rate_hz: float | None) -> _FrameTimes:
    """Read the times of all frames; those without one are timed by their number, or by their distance from others."""
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
    if repeated := len(known) - len({*known.values()}):
        message = "frames have the time of another one; both are read, at that time"
        document.below("frames").note(ledger, WarningKind.ASSUMED, "frame-times-repeated", message, count=repeated)
    if missing:
        rate = rate_hz or _DEFAULT_RATE_HZ
        times = _FrameTimes(dict(known))
        known |= {number: times.at(number, rate) for number in missing}
        message = f"frames have no timestamp; taken at {rate:g} Hz by number, `--input-option rate_hz=HZ` sets the rate"
        document.below("frames").note(ledger, WarningKind.ASSUMED, "frame-times-assumed", message, count=len(missing))
    return _FrameTimes(known)


def _timestamp_ns(timestamp: _Part) -> int:
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


def _read_transform(part: _Part) -> RigidTransform:
    """Read a matrix of 4 times 4 by rows, or a translation with a quaternion x y z w or Euler angles."""
    matrix = part.get("matrix4x4")
    if matrix is not None:
        return _of_matrix(matrix)
    translation = np.array(part.need("translation").numbers(3))
    quaternion, angles, sequence = part.get("quaternion"), part.get("euler_angles"), part.get("sequence")
    if quaternion is not None:
        rotation = _unit_quaternions([quaternion], np.array([quaternion.numbers(4)]))[0]
    elif angles is not None:
        order = _DEFAULT_SEQUENCE if sequence is None else sequence.text()
        rotation = _quaternions_from_euler(part, np.array([angles.numbers(3)]), order)[0]
    else:
        raise part.fault("matrix4x4, or quaternion or euler_angles with a translation")
    return RigidTransform.from_quaternion(translation, rotation)


def _of_matrix(part: _Part) -> RigidTransform:
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


def _unit_quaternions(parts: Sequence[_Part], quaternions: Float64Array) -> Float64Array:
    """Quaternions x y z w, (N, 4), of length 1 within a hundredth; one part each, for messages."""
    wrong = np.flatnonzero(lengths_of(quaternions)[1])
    if len(wrong):
        raise parts[int(wrong[0])].fault("a quaternion x y z w of length 1")
    return normalise_quaternion(quaternions)


def _quaternions_from_euler(part: _Part, angles: Float64Array, sequence: str = _DEFAULT_SEQUENCE) -> Float64Array:
    """Products of three rotations about named axes, x y z w: of "ZYX" and a row (a, b, c) it is Rz(a) Ry(b) Rx(c).

    Args:
        part: for messages.
        angles: (N, 3) [rad].
        sequence: the three axes.
    """
    if len(sequence) != 3 or not set(sequence.upper()) <= set("XYZ"):
        raise DataError(part.file, f"{part.location}.sequence", f"{sequence!r}; expected three of X, Y, Z")
    found = np.tile([0.0, 0.0, 0.0, 1.0], (len(angles), 1))
    for axis, column in zip(sequence.upper(), angles.T, strict=True):
        one = np.zeros((len(angles), 4))
        one[:, "XYZ".index(axis)], one[:, 3] = np.sin(column / 2), np.cos(column / 2)
        found = multiply_quaternions(found, one)
    return normalise_quaternion(found)


@dataclass(frozen=True, slots=True, eq=False)
class _Systems:
    """Coordinate systems, each with the one that it is placed in."""

    edges: dict[str, tuple[str, Poses]]  # by name: the next one towards the root, and `next_from_this` over time
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


def _read_systems(document: _Part, times: _FrameTimes, ledger: Ledger) -> _Systems:
    """Read the coordinate systems and the transforms of all frames."""
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
    return _Systems(edges, names, frozenset(name for name, _ in document.each("streams")))


def _poses(by_time: dict[int, RigidTransform], *, static: bool = False) -> Poses:
    times = sorted(by_time)
    return Poses(
        np.array(times, np.int64),
        np.stack([by_time[time_ns].translation for time_ns in times]),
        np.stack([by_time[time_ns].quaternion_xyzw for time_ns in times]),
        static=static,
    )


_KNOWN_TYPES = ("camera", "lidar", "radar", "gps_imu", "other")


def _read_streams(document: _Part, systems: _Systems, ledger: Ledger) -> dict[str, Sensor]:
    """Read all streams by their names, placed by the coordinate systems of these names."""
    found = {name: _sensor(name, stream, systems, ledger) for name, stream in document.each("streams")}
    if found:
        message = "OpenLABEL names sensors and holds what is stated for their frames, but not the frames"
        document.need("streams").note(ledger, WarningKind.SKIPPED, "frames-elsewhere", message, count=len(found))
    return found


def _sensor(name: str, stream: _Part, systems: _Systems, ledger: Ledger) -> Sensor:
    kind = "other" if stream.get("type") is None else stream.need("type").text()
    if kind not in _KNOWN_TYPES:
        raise stream.need("type").fault(f"one of {', '.join(_KNOWN_TYPES)}")
    properties = stream.below("stream_properties")
    ours = properties.members().get(OURS)
    ours = ours if isinstance(ours, dict) else {}
    sensor_id: Identifier = ours["id"] if isinstance(ours.get("id"), int | str) else name
    extras = {key: value for key, value in stream.members().items() if key not in {"type", "stream_properties"}}
    rest = {key: value for key, value in properties.members().items() if key not in {OURS, "intrinsics_pinhole"}}
    if kind != "camera" and rest:
        extras["stream_properties"] = rest
    further, placed = MappingProxyType(extras), _placed(name, systems)
    frames = LazyFrames[Any].of([], [])
    stated = ours.get("type")
    if kind == "camera":
        camera, offset = _read_camera(properties)
        if camera is not None:
            placed = _moved(placed, offset, stream, ledger) if offset.any() else placed
            return CameraSensor(sensor_id, camera, frames, extras=further, **placed)
        message = "its camera model is missing or unknown; the stream is kept as it is"
        stream.note(ledger, WarningKind.SKIPPED, "camera-model-not-read", message)
    else:
        match stated if stated in ("lidar", "radar", "imu", "gnss") else kind:
            case "lidar":
                return LidarSensor(sensor_id, frames, extras=further, **placed)
            case "radar":
                return RadarSensor(sensor_id, frames, extras=further, **placed)
            case "imu":
                return ImuSensor(sensor_id, {}, extras=further)
            case "gnss" | "gps_imu":
                no_times, none, mount = np.zeros(0, np.int64), np.zeros(0), placed.get("mount")
                return GnssSensor(sensor_id, no_times, np.zeros((0, 3)), none, none, mount=mount, extras=further)
    fields = {key: value for key, value in stream.members().items() if key != "type"}
    return PlainSensor(sensor_id, f"openlabel_{kind}", MappingProxyType(fields))


def _placed(name: str, systems: _Systems) -> dict[str, Any]:
    """The poses of a sensor in the root, and its mounting on the ego where there is one."""
    if name not in systems.names:
        return {}
    chain, ego = systems.chain(name), systems.ego
    if ego is None and len(chain) > 1:
        # nothing moves: the root may be the vehicle as well as the world
        ego = chain[-1]
    found: dict[str, Any] = {} if len(chain) == 1 else {"poses": systems.path_to(name, chain[-1])}
    mount = None if ego is None or ego == name else systems.path_to(name, ego)
    if mount is not None and mount.static:
        found["mount"] = RigidTransform.from_quaternion(mount.positions[0], mount.quaternions_xyzw[0])
    return found


def _moved(placed: dict[str, Any], offset: Float64Array, stream: _Part, ledger: Ledger) -> dict[str, Any]:
    """Place a camera whose centre is not the origin of its coordinate system: at `offset` there [m], (3,)."""
    if not placed:
        message = "the fourth column of its camera matrix is left out: its coordinate system is not described"
        stream.note(ledger, WarningKind.SKIPPED, "camera-offset", message)
        return placed
    shift, found = RigidTransform(np.eye(3), offset), dict(placed)
    if (poses := placed.get("poses")) is not None:
        positions = rotate_vectors(poses.quaternions_xyzw, np.tile(offset, (len(poses.positions), 1)))
        found["poses"] = replace(poses, positions=poses.positions + positions)
    if (mount := placed.get("mount")) is not None:
        found["mount"] = mount @ shift
    return found


_CENTRED = np.zeros(3)


def _read_camera(properties: _Part) -> tuple[Camera | None, Float64Array]:
    """The camera model of a stream, ours, else that of the format, or None where it is missing or unknown.

    Besides, where its centre is in the coordinate system of its stream, (3,) [m].
    """
    ours = properties.get(OURS)
    camera = None if ours is None else ours.get("camera_model")
    if camera is not None:
        model = camera.need("model").text()
        if model not in MODELS:
            raise camera.need("model").fault(f"one of {', '.join(MODELS)}")
        size = [_pixels(camera, name) for name in ("width", "height")]
        numbers = [camera.need(name).number() for name in OURS_CAMERA[3:]]
        return _built(camera, model, *size, *numbers, tuple(camera.need("coefficients").numbers())), _CENTRED
    pinhole, fisheye = properties.get("intrinsics_pinhole"), properties.get("intrinsics_fisheye")
    if pinhole is not None:
        return _pinhole(pinhole)
    return None if fisheye is None else _fisheye(fisheye), _CENTRED


def _first(part: _Part, *names: str) -> _Part | None:
    """The first of some members that is there: programs and the schema call one thing by several names."""
    return next((found for name in names if (found := part.get(name)) is not None), None)


def _pinhole(part: _Part) -> tuple[Camera | None, Float64Array]:
    matrix = _first(part, "camera_matrix_3x4", "camera_matrix")
    if matrix is None or part.get("width_px") is None or part.get("height_px") is None:
        return None, _CENTRED
    stated = np.reshape(matrix.numbers(12, 9), (3, -1))
    (fx, skew, cx), (other, fy, cy), last = stated[:, :3].tolist()
    if abs(skew) > 1e-9 * abs(fx) or other or last != [0.0, 0.0, 1.0] or fx <= 0 or fy <= 0:
        return None, _CENTRED
    listed = _first(part, "distortion_coeffs_1xN", "distortion_coeffs")
    coefficients = [] if listed is None else listed.numbers()
    if len(coefficients) > OPENCV_LENGTHS[-1]:
        raise listed.fault(f"at most {OPENCV_LENGTHS[-1]} numbers")  # type: ignore[union-attr]
    offset = -np.linalg.solve(stated[:, :3], stated[:, 3]) if stated.shape[1] == 4 else _CENTRED
    values = (_pixels(part, "width_px"), _pixels(part, "height_px"), fx, fy, cx, cy)
    if not any(coefficients):
        return _built(part, "pinhole", *values), offset
    # the schema allows counts that OpenCV does not know
    length = next(length for length in OPENCV_LENGTHS if length >= len(coefficients))
    ordered = (*from_opencv([*coefficients, *[0.0] * (length - len(coefficients))]), 0.0)
    count = max([5, *(np.flatnonzero(ordered) + 1).tolist()])
    return _built(part, "brown_conrady", *values, ordered[:count]), offset


_KANNALA = "kannala"
"""VCD's model of fisheyes that scales the angle, too: the first of its five coefficients is a factor of the others."""


def _fisheye(part: _Part) -> Camera | None:
    numbers = {field: found for name, field in FISHEYE.items() if (found := part.get(name)) is not None}
    listed = _first(part, *LENS_COEFFICIENTS)
    model = part.get("model")
    kind = "opencv_fisheye" if model is None else model.text()
    sized = part.get("width_px") is not None and part.get("height_px") is not None
    if listed is None or len(numbers) < len(FISHEYE) or kind not in {"opencv_fisheye", _KANNALA} or not sized:
        return None
    size = [_pixels(part, "width_px"), _pixels(part, "height_px")]
    fx, fy, cx, cy = (numbers[name].number() for name in OURS_CAMERA[3:])
    if kind == "opencv_fisheye":
        return _built(part, "fisheye", *size, fx, fy, cx, cy, tuple(listed.numbers(4)))
    scale, *coefficients = listed.numbers(5)
    if not scale:
        raise listed.fault("a first number other than 0")
    relative = tuple(one / scale for one in coefficients)
    return _built(part, "fisheye", *size, fx * scale, fy * scale, cx, cy, relative)


def _pixels(part: _Part, name: str) -> int:
    found = part.need(name)
    if not isinstance(found.value, int) or not 0 < found.value < 1 << 20:
        raise found.fault("a number of pixels")
    return found.value


def _built(part: _Part, *values: Any) -> Camera:
    try:
        return Camera(*values)
    except (SceneloomError, TypeError) as error:
        raise DataError(part.file, part.location, str(error)) from error


_ELEMENTS = {"objects": "object", "actions": "action", "events": "event", "contexts": "context"}
"""What a file has lists of, and what one of each is called."""

_HEAD = {"type", "frame_intervals", *(f"{kind}_data{end}" for kind in _ELEMENTS.values() for end in ("", "_pointers"))}
_OF_ROWS = {"name", "val", "coordinate_system", "attributes", "closed", "mode"}
_LEFT_OUT = {"elements", "relations", "frame-numbers"}  # faults that a lenient reading passed over
_ANGLES = CuboidAngles()


@dataclass(frozen=True, slots=True)
class _Stated:
    """One element of data at the time of its frame [ns]; None where it holds for the whole object."""

    time_ns: int | None
    part: _Part


_Data = dict[tuple[str, str], list[_Stated]]  # what is stated, by the type and the name of the data


@dataclass(slots=True)
class _Element:
    """All that a file states about one object, action, event or context."""

    kind: str  # "object", "action", "event" or "context"
    uid: str
    id: str  # `uid`, with its kind where something else of the file has the same key
    head: _Part  # its entry in the root
    data: _Data = field(default_factory=dict)
    systems: dict[tuple[str, str], Any] = field(default_factory=dict)  # of shapes, by their type and name
    frames: list[int] = field(default_factory=list)  # numbers of the frames that name it

    @property
    def label(self) -> str | None:
        return self.head.need("type").text() or None

    @property
    def intervals(self) -> list[tuple[int, int]]:
        """First and last frame of each interval that its entry names."""
        found = []
        for interval in self.head.items("frame_intervals"):
            start, stop = (interval.need(name).value for name in ("frame_start", "frame_end"))
            if not all(isinstance(end, int) and 0 <= end < 1 << 53 for end in (start, stop)) or start > stop:
                raise interval.fault("frame_start and frame_end, two numbers of frames in order")
            found.append((start, stop))
        return found

    def take(self, data: _Part, time_ns: int | None) -> None:
        """Add the data of a frame, or of the head; of data of equal names the second is called `name#2`.

        Shapes of one name that change their coordinate system are several: `name`, `name@system`.
        """
        for kind, values in data.members().items():
            if kind not in (*_SHAPES, *PLAIN, *KEPT_WHOLE):
                known = ", ".join((*_SHAPES, *PLAIN, *KEPT_WHOLE))
                wrong = _Part(data.file, f"{data.location}.{kind}", values)
                raise wrong.fault(f"a type of data out of {known}")
            seen: dict[str, int] = {}
            for part in data.items(kind):
                name = part.members().get("name")
                name = name if isinstance(name, str) else kind
                if kind in _SHAPES:
                    system = part.members().get("coordinate_system")
                    name += "" if self.systems.setdefault((kind, name), system) == system else f"@{system}"
                seen[name] = seen.get(name, 0) + 1
                unique = name if seen[name] == 1 else f"{name}#{seen[name]}"
                self.data.setdefault((kind, unique), []).append(_Stated(time_ns, part))


def read_openlabel(path: Path, *, lenient: bool = False, rate_hz: float | str | None = None) -> Scene:
    """Read a file.

    Args:
        rate_hz: frames per second of a file whose frames have no timestamps.

    Raises:
        OptionError: the rate is no number above 0.
    """
    rate = None if rate_hz is None else as_positive("rate_hz", rate_hz)
    value = read_json(path, Any)
    if not isinstance(value, Mapping) or not isinstance(value.get("openlabel"), dict):
        raise DataError(path, "", "has no object `openlabel`; expected a file of ASAM OpenLABEL")
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        return DocumentReader(path, value["openlabel"], ledger, rate).scene()


class DocumentReader:
    """A document with what its elements refer to: frames, coordinate systems, sensors, and our own fields.

    Attributes:
        numbers: of its frames, by their times [ns]; of frames of one time the lowest.
        sensors: by the names of their streams.
    """

    def __init__(self, path: Path, openlabel: Mapping[str, Any], ledger: Ledger, rate_hz: float | None) -> None:
        """Read what elements refer to.

        Args:
            path: of the file, for messages.
            openlabel: the member `openlabel` of the file.
            ledger: where warnings and faults go.
            rate_hz: frames per second where frames have no timestamps; None for the default.

        Raises:
            DataError: a frame, coordinate system or stream is not as the standard states.
        """
        self.document, self.ledger, self.rate_hz = _Part(path, "openlabel", openlabel), ledger, rate_hz
        document = self.document
        metadata = document.below("metadata")
        version = metadata.get("schema_version")
        if version is None or version.value != SCHEMA_VERSION:
            message = f"schema version {None if version is None else version.value!r}; read as {SCHEMA_VERSION}"
            metadata.note(ledger, WarningKind.ASSUMED, "schema-version", message)
        ours = metadata.below(OURS)
        self.ours = ours if isinstance(ours.value, dict) else _Part(ours.file, ours.location, {})
        self.times: _FrameTimes = _read_frame_times(document, ledger, rate_hz)
        self.systems: _Systems = _read_systems(document, self.times, ledger)
        self.sensors: dict[str, Sensor] = _read_streams(document, self.systems, ledger)
        self.numbers = {time_ns: number for number, time_ns in sorted(self.times.by_number.items(), reverse=True)}

    def scene(self) -> Scene:
        """The document as a scene."""
        stated = self.by_element()
        return Scene(
            tuple(self.sensors.values()),
            annotations=tuple(annotation for annotations in stated.values() for annotation in annotations),
            trajectories=MappingProxyType(self.trajectories()),
            metadata=MappingProxyType(self._metadata()),
            source=str(self.document.file),
            format="openlabel",
            warnings=self.ledger.warnings,
        )

    def by_element(self) -> dict[tuple[str, str], list[Annotation]]:
        """The annotations by the kind and key of the element that states them; relations come last."""
        found: dict[tuple[str, str], list[Annotation]] = {}
        elements = self._elements()
        for element in elements:
            try:
                made = self._of_object(element) if element.kind == "object" else [self._of_event(element)]
            except DataError as error:
                self.ledger.fault("elements", error)
            else:
                found[element.kind, element.uid] = made
        known = {annotation.id for annotations in found.values() for annotation in annotations}
        return found | {("relation", uid): links for uid, links in self._links(elements, known).items()}

    def trajectories(self) -> dict[str, Trajectory]:
        """The trajectory of the ego, if it moves, by its name."""
        ego = self.systems.ego
        path = None if ego is None else self.systems.path_to(ego, self.systems.chain(ego)[-1])
        if ego is None or path is None:
            return {}
        stated = self.ours.members().get("trajectory")
        name = stated if isinstance(stated, str) else ego
        return {name: Trajectory(name, path.timestamps_ns, path.positions, path.quaternions_xyzw)}

    def _metadata(self) -> dict[str, Any]:
        """The members that the model has no field for, the document of others, and how angles of boxes are meant."""
        members = self.document.members()
        kept = {name: value for name in KEPT if (value := members.get(name))}
        if isinstance(kept.get("metadata"), dict):
            own = {name: value for name, value in kept.pop("metadata").items() if name not in {OURS, "schema_version"}}
            kept |= {"metadata": own} if own else {}
        is_whole = not {warning.code for warning in self.ledger.warnings} & _LEFT_OUT
        if is_whole and (not self.ours.members() or self.ours.members().get(OF_OTHERS) is True):
            kept[DOCUMENT] = msgspec.json.encode(members).decode()
            kept |= {} if self.rate_hz is None else {RATE: self.rate_hz}
        metadata: dict[str, Any] = {OURS: {"euler_unit": str(_ANGLES.unit), "euler_order": _ANGLES.order}}
        stated = self.ours.members().get("metadata")
        if isinstance(stated, dict):
            metadata = {**stated, OURS: {**stated.get(OURS, {}), **metadata[OURS]}}
        return {**metadata, **({"openlabel": kept} if kept else {})}

    def _elements(self) -> list[_Element]:
        """All elements with their data, in the order of the file."""
        found: dict[tuple[str, str], _Element] = {}
        taken: set[str] = set()
        for listed, kind in _ELEMENTS.items():
            for uid, head in self.document.each(listed):
                element = _Element(kind, uid, uid if uid not in taken else f"{kind}:{uid}", head)
                taken.add(uid)
                found[kind, uid] = element
                element.take(head.below(f"{kind}_data"), None)
        for key, frame in self.document.each("frames"):
            for listed, kind in _ELEMENTS.items() if key.isdigit() else ():
                for uid, entry in frame.each(listed):
                    if (kind, uid) not in found:
                        raise entry.fault(f"an entry openlabel.{listed}.{uid} of the {kind} that it describes")
                    found[kind, uid].frames.append(int(key))
                    if isinstance(entry.value, dict):
                        found[kind, uid].take(entry.below(f"{kind}_data"), self.times.at(int(key)))
        return list(found.values())

    def _own(self, kind: str, uid: str) -> _Part | None:
        """The fields that we wrote of an element besides, or None."""
        by_uid = self.ours.get(kind)
        part = by_uid.get(uid) if by_uid is not None and isinstance(by_uid.value, dict) else None
        return part if part is not None and isinstance(part.value, dict) else None

    def _of_object(self, element: _Element) -> list[Annotation]:
        """The annotations of an object: one where its data have one shape, else one for it and one for each shape."""
        label, own, stated = element.label, self._own(element.kind, element.uid), dict(element.data)
        members = {} if own is None else own.members()
        parts = [] if own is None else [self._part(element, one, stated) for one in own.items("parts")]
        drawn = {} if own is None else _drawn(own, stated)
        plain = tuple(_attribute(*key, rows) for key, rows in stated.items() if key[0] not in _SHAPES)
        shapes = {key: rows for key, rows in stated.items() if key[0] in _SHAPES and self._is_read(key, rows)}
        if members.get("class") == "points":
            shapes = {}
        extras = _extras(element)
        fields: dict[str, Any]
        if len(shapes) == 1 and members.get("is_whole") is not True:
            ((key, rows),) = shapes.items()
            fields = {"id": element.id, "label": label, "attributes": plain, "extras": extras}
            whole = _restored(own, self._shape(key, rows, element.head, members, fields), drawn)
            return [whole, *(one for one in parts if one is not None)]
        whole = _restored(own, ObjectAnnotation(element.id, label, attributes=plain, extras=extras))
        fields = {"label": label, "attributes": (), "extras": NO_FIELDS, "parent_id": whole.id}
        made = [
            self._shape(key, rows, element.head, members, {"id": f"{element.id}:{key[0]}:{key[1]}", **fields})
            for key, rows in shapes.items()
        ]
        return [whole, *(one for one in parts if one is not None), *made]

    def _part(self, element: _Element, own: _Part, stated: _Data) -> Annotation | None:
        """An annotation that we wrote as data of another's object, taken out of what is stated; None if it is gone."""
        members, drawn = own.members(), _drawn(own, stated)
        names = [name.text() for name in own.items("data")]
        keys = [key for key in stated if key[0] in _SHAPES and key[1] in names]
        shapes = {key: rows for key in keys if self._is_read(key, rows := stated.pop(key))}
        plain: list[AttributePath] = []
        for listed in own.items("own"):
            texts = listed.value
            if not isinstance(texts, list) or len(texts) != 3 or not all(isinstance(one, str) for one in texts):
                raise listed.fault("a list of 3 texts")
            rows = stated.pop((texts[0], texts[1]), [])
            plain += [_attribute(texts[0], texts[2], rows)] if rows else []
        if names and not shapes:
            return None
        fields: dict[str, Any] = {
            "id": element.id,
            "label": element.label,
            "attributes": tuple(plain),
            "extras": NO_FIELDS,
        }
        if "class" in members or not shapes:
            return _restored(own, ObjectAnnotation(**fields))
        key, rows = next(iter(shapes.items()))
        return _restored(own, self._shape(key, rows, element.head, members, fields), drawn)

    def _is_read(self, key: tuple[str, str], rows: list[_Stated]) -> bool:
        """Whether a shape is of a form that we know; cuboids without a value state that there is none."""
        rows[:] = [row for row in rows if row.part.members().get("val") is not None]
        if not rows:
            return False
        mode = rows[0].part.members().get("mode", ABSOLUTE)
        if key[0] != "poly2d" or mode in _MODES:
            return True
        message = f"polygons of the unknown mode {mode!r} are not read"
        rows[0].part.note(self.ledger, WarningKind.SKIPPED, "poly2d-mode", message, count=len(rows))
        return False

    def _shape(
        self, key: tuple[str, str], rows: list[_Stated], head: _Part, members: Mapping[str, Any], fields: dict[str, Any]
    ) -> Annotation:
        """Make an annotation of the rows of one type and name of data, and of `fields` found for all of them."""
        # `head` is the entry of the object, whose coordinate system holds for all that states none; `members` are our
        # own fields of the annotation, which state whether we interpolated some of the rows.
        kind, name = key
        further = {key: value for key, value in rows[0].part.members().items() if key not in _OF_ROWS}
        further |= {"name": name} if name != kind else {}
        extras = fields["extras"]
        if further:
            extras = {**extras, KIND: {**extras.get(KIND, {}), "data": further}}
        without: tuple[str, ...] = ()
        if members.get("interpolated") is True:
            rows = [row for row in rows if _flag(row, INTERPOLATED) is not True] or rows
            without = (INTERPOLATED,)
        attributes = (*_nested_attributes(rows, without=without), *fields["attributes"])
        fields = {**fields, "attributes": attributes, "extras": MappingProxyType(extras)}
        if any(row.time_ns is None for row in rows):
            # what holds for the whole object is stationary
            timed = sum(row.time_ns is not None for row in rows)
            if timed:
                message = "it holds for the whole object, too: what is stated for frames is left out"
                rows[0].part.note(self.ledger, WarningKind.SKIPPED, "always-and-in-frames", message, count=timed)
            rows = [row for row in rows if row.time_ns is None][:1]
            fields["stationary"] = True
        rows = sorted(rows, key=lambda row: row.time_ns or 0)
        first = rows[0].part
        times = [self.times.first_ns if row.time_ns is None else row.time_ns for row in rows]
        stated = first.get("coordinate_system")
        stated = stated or head.get("coordinate_system")
        system = None if stated is None else stated.text()
        if kind in _IN_IMAGES:
            fields["sensor_id"] = self._camera(system, first)
        elif system is not None and system not in self.systems.names:
            message = f"the coordinate system {system!r} is not described; it is taken as the world"
            first.note(self.ledger, WarningKind.ASSUMED, "coordinate-system-unknown", message)
        parts = tuple(row.part for row in rows)
        return _SHAPES[kind](_Rows(parts, np.array(times, np.int64), system, self.systems), fields)

    def _camera(self, system: str | None, part: _Part) -> Identifier:
        """The camera of what is drawn in images: that of the coordinate system, else the only or first one."""
        if system in self.sensors:
            return self.sensors[str(system)].id
        cameras = [sensor for sensor in self.sensors.values() if isinstance(sensor, CameraSensor)]
        if system is not None and not cameras:
            return system
        found: Identifier = cameras[0].id if cameras else "camera"
        if len(cameras) != 1 or system is not None:
            message = f"the camera that it is drawn in is not stated; {found!r} is assumed"
            part.note(self.ledger, WarningKind.ASSUMED, "camera-assumed", message)
        return found

    def _of_event(self, element: _Element) -> Annotation:
        """An action, event or context: something that lasts from one frame to another."""
        intervals = element.intervals or ([(min(element.frames), max(element.frames))] if element.frames else [])
        start_ns = self.times.at(intervals[0][0]) if intervals else self.times.first_ns
        extras = dict(_extras(element))
        if element.kind != "event":
            extras[KIND] = {**extras.get(KIND, {}), "kind": element.kind}
        event = EventAnnotation(
            element.id,
            start_ns,
            self.times.at(intervals[-1][1]) - start_ns if intervals else None,
            element.label,
            attributes=tuple(_attribute(*key, rows) for key, rows in element.data.items()),
            extras=MappingProxyType(extras),
        )
        return _restored(self._own(element.kind, element.uid), event)

    def _links(self, elements: list[_Element], known: set[Identifier]) -> dict[str, list[Annotation]]:
        """A link for each pair of subject and object of a relation, by the relation's key."""
        ids: dict[tuple[str, str], Identifier] = {}
        for element in elements:
            own = self._own(element.kind, element.uid)
            stated = element.id if own is None else own.members().get("id", element.id)
            if isinstance(stated, str | int) and stated in known:
                ids[element.kind, element.uid] = stated
        found: dict[str, list[Annotation]] = {}
        taken = {uid for _, uid in ids}
        for uid, relation in self.document.each("relations"):
            try:
                links = _pairs(uid if uid not in taken else f"relation:{uid}", relation, ids)
                found[uid] = [_restored(self._own("relation", uid), link) for link in links]
            except DataError as error:
                self.ledger.fault("relations", error)
            else:
                if not links:
                    message = "it has no subject or no object, and is no link"
                    relation.note(self.ledger, WarningKind.SKIPPED, "relation-without-ends", message)
        return found


def _pairs(relation_id: str, relation: _Part, ids: Mapping[tuple[str, str], Identifier]) -> list[LinkAnnotation]:
    ends: list[list[Identifier]] = []
    for name in ("rdf_subjects", "rdf_objects"):
        keys = [(part, part.need("type").text(), part.need("uid").text()) for part in relation.items(name)]
        for part, kind, uid in keys:
            if (kind, uid) not in ids:
                raise part.fault(f"the uid of one of the file's {kind}s")
        ends.append([ids[kind, uid] for _, kind, uid in keys])
    label, taken = relation.need("type").text() or None, {"type", "rdf_subjects", "rdf_objects"}
    further = {key: value for key, value in relation.members().items() if key not in taken and value != relation_id}
    extras = MappingProxyType({KIND: further} if further else {})
    pairs = [(one, other) for one in ends[0] for other in ends[1]]
    names = [relation_id] if len(pairs) == 1 else [f"{relation_id}:{k}" for k in range(len(pairs))]
    return [LinkAnnotation(name, *pair, label, extras=extras) for name, pair in zip(names, pairs, strict=True)]


def _extras(element: _Element) -> Mapping[str, Any]:
    """What the entry states besides: its name where that is not its key, and ontology and resource."""
    further = {key: value for key, value in element.head.members().items() if key not in _HEAD}
    if further.get("name") == element.uid:
        del further["name"]
    intervals = element.intervals
    if len(intervals) > 1 and element.kind != "object":
        further["frame_intervals"] = [list(one) for one in intervals]
    return MappingProxyType({KIND: further} if further else {})


def _drawn(own: _Part, stated: _Data) -> dict[str, SeenBoxes]:
    """Take the boxes that are projections of an annotation out of what is stated, by their names."""
    found: dict[str, SeenBoxes] = {}
    for listed in own.items("projections") if own.members().get("class") is None else ():
        name = listed.get("data")
        if name is not None:
            boxes = found[name.text()] = {}
            for row in stated.pop(("bbox", name.text()), []):
                if row.time_ns is not None:
                    x, y, width, height = row.part.need("val").numbers(4)
                    box = (x - width / 2, y - height / 2, width, height)
                    boxes[row.time_ns] = (box, _flag(row, CONFIRMED))
    return found


# attributes


def _attribute(kind: str, name: str, rows: Sequence[_Stated]) -> AttributePath:
    """What was stated under one name, over time; DataError if a value is none of its kind."""
    ordered = sorted(rows, key=lambda row: (row.time_ns is not None, row.time_ns or 0))
    values = tuple(_value(kind, row.part) for row in ordered)
    times = [row.time_ns for row in ordered if row.time_ns is not None]
    static = len(times) < len(values)
    first = ordered[0].part.members()
    seen_by, extras = None, {TYPE: kind}
    if kind in PLAIN:
        seen_by = first.get("coordinate_system")
        extras = {key: first[key] for key in first if key not in ("name", "val", "coordinate_system")}
    return AttributePath(
        name,
        values,
        None if static else np.array(times, np.int64),
        sensor_id=seen_by if isinstance(seen_by, str) else None,
        static=True if static else None,
        extras=MappingProxyType(extras),
    )


def _value(kind: str, part: _Part) -> Any:
    if kind not in PLAIN:
        return {key: value for key, value in part.members().items() if key != "name"}
    value = part.need("val").value
    if not PLAIN[kind](value):
        raise part.need("val").fault(f"the value of a {kind}")
    return tuple(value) if kind == "vec" else value


def _flag(row: _Stated, name: str) -> bool | None:
    """A boolean inside an element of data, or None."""
    for part in row.part.below("attributes").items("boolean"):
        value = part.members().get("val")
        if part.members().get("name") == name and isinstance(value, bool):
            return value
    return None


def _nested_attributes(rows: Iterable[_Stated], *, without: Sequence[str] = ()) -> Iterator[AttributePath]:
    """The attributes inside elements of data, but for some by their names."""
    found: _Data = {}
    for row in rows:
        for kind in PLAIN:
            for part in row.part.below("attributes").items(kind):
                name = part.members().get("name")
                if name not in without:
                    key = (kind, name if isinstance(name, str) else kind)
                    found.setdefault(key, []).append(_Stated(row.time_ns, part))
    return (_attribute(*key, parts) for key, parts in found.items())


# shapes


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """The rows of one element of data, in the order of their times."""

    parts: tuple[_Part, ...]  # at least one; of a shape that holds always, the only one
    timestamps_ns: Int64Array
    system: str | None  # the one that they name
    systems: _Systems

    def numbers(self, *counts: int) -> list[list[float]]:
        return [part.need("val").numbers(*counts) for part in self.parts]

    def vertices(self, dimensions: int, count: int | None = None) -> list[Float64Array]:
        """The vertices of each row, (V, dimensions), in the root of their coordinate system where they are 3D."""
        values = self.numbers(*(() if count is None else (count * dimensions,)))
        for part, row in zip(self.parts, values, strict=True):
            if len(row) % dimensions:
                expected = {2: "pairs", 3: "triples"}[dimensions]
                raise DataError(part.file, f"{part.location}.val", f"{len(row)} numbers; expected {expected}")
        points = [np.array(row).reshape(-1, dimensions) for row in values]
        return points if dimensions == 2 else self.in_root(points)

    def in_root(self, points: list[Float64Array]) -> list[Float64Array]:
        """Bring (V, 3) locations of each row into the root of their coordinate system."""
        if self.system is None or len(self.systems.chain(self.system)) == 1:
            return points
        counts = [len(one) for one in points]
        poses = self.systems.root_from(self.system, self.timestamps_ns)
        positions, quaternions = (np.repeat(one, counts, axis=0) for one in poses)
        moved = rotate_vectors(quaternions, np.concatenate(points)) + positions
        return np.split(moved, np.cumsum(counts)[:-1])


def _cuboid(rows: _Rows, fields: dict[str, Any]) -> Annotation:
    values, parts = rows.numbers(9, 10), [part.need("val") for part in rows.parts]
    by_angles = np.array([len(row) == 9 for row in values])
    angles = np.array([row[5:2:-1] for row in values if len(row) == 9]).reshape(-1, 3)
    rotations = np.array([row[3:7] if len(row) == 10 else [0.0, 0.0, 0.0, 1.0] for row in values])
    rotations[by_angles] = _quaternions_from_euler(rows.parts[0], angles)
    quaternions = _unit_quaternions(parts, rotations)
    if rows.system is not None and len(rows.systems.chain(rows.system)) > 1:
        quaternions = multiply_quaternions(rows.systems.root_from(rows.system, rows.timestamps_ns)[1], quaternions)
    sizes, centres = np.array([row[-3:] for row in values]), rows.in_root([np.array([row[:3]]) for row in values])
    stored = np.concatenate([sizes, np.concatenate(centres), _ANGLES.from_quaternions(quaternions)], axis=1)
    return CuboidAnnotation(path=CuboidPath(rows.timestamps_ns, stored), **fields)


def _bbox(rows: _Rows, fields: dict[str, Any]) -> Annotation:
    values = np.array(rows.numbers(4))
    boxes = np.concatenate([values[:, :2] - values[:, 2:] / 2, values[:, 2:]], axis=1)
    return Box2DAnnotation(path=BoxPath(rows.timestamps_ns, boxes), **fields)


def _rbbox(rows: _Rows, fields: dict[str, Any]) -> Annotation:
    values, corners = rows.numbers(5), []
    for x, y, width, height, angle in values:
        halves = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * (width / 2, height / 2)
        cosine, sine = np.cos(angle), np.sin(angle)
        corners.append(halves @ np.array([[cosine, sine], [-sine, cosine]]) + (x, y))
    path = VertexPath(rows.timestamps_ns, tuple(corners), extras=MappingProxyType({RBBOX: values}))
    return ShapeAnnotation(type=ShapeType.POLYGON_2D, path=path, **fields)


def _polygon(dimensions: int, closed: ShapeType, opened: ShapeType) -> "_Make":
    def make(rows: _Rows, fields: dict[str, Any]) -> Annotation:
        vertices = rows.vertices(3) if dimensions == 3 else [_outline(part) for part in rows.parts]
        kind = closed if rows.parts[0].members().get("closed") else opened
        return ShapeAnnotation(type=kind, path=VertexPath(rows.timestamps_ns, tuple(vertices)), **fields)

    return make


def _outline(part: _Part) -> Float64Array:
    """The vertices of a polygon in an image, (V, 2) [px]."""
    mode, stated = part.get("mode"), part.need("val")
    if mode is not None and mode.value not in _MODES:
        raise mode.fault(f"one of {', '.join(_MODES)}")
    if mode is not None and mode.value in _CHAIN_CODES:
        return _chain(stated, _CHAIN_CODES[mode.value])
    values = stated.numbers()
    if len(values) % 2:
        raise DataError(stated.file, stated.location, f"{len(values)} numbers; expected pairs")
    vertices = np.array(values).reshape(-1, 2)
    return np.cumsum(vertices, axis=0) if mode is not None and mode.value == RELATIVE else vertices


def _chain(stated: _Part, runs: tuple[int, int] | None) -> Float64Array:
    """Follow a chain code from pixel to neighbouring pixel; straight runs have no vertices between their ends.

    The texts are the first pixel's x and y, the lengths of runs that have a code of their own where the mode does not
    fix them, how many codes at the end are padding, and the codes, two in each base64 digit. Beginning downwards, codes
    0 to 4 are a step straight on, or after a rotation by 45, -45, 90 or -90 degrees clockwise in the image; 5 turns
    back without a step; 6 and 7 are short and long runs of steps straight on.

    Source: the modes SRF6DCC and RS6FCC of `poly2d` as VCD writes them.
    """
    texts, count = stated.value, 4 if runs else 6
    expected = f"{count} texts of a chain code"
    if not isinstance(texts, list) or len(texts) != count or not all(isinstance(one, str) for one in texts):
        raise stated.fault(expected)
    if not all(re.fullmatch(r"-?[0-9]{1,7}", one) for one in texts[:-1]) or set(texts[-1]) - _DIGITS.keys():
        raise stated.fault(expected)
    x, y, *lengths, padding = map(int, texts[:-1])
    codes = [code for digit in texts[-1] for code in divmod(_DIGITS[digit], 8)]
    if not 0 <= padding <= len(codes):
        raise stated.fault(expected)
    steps = {0: 1, **dict(zip((6, 7), runs or lengths, strict=True))}
    vertices, direction, is_straight = [(x, y)], _DOWN, False
    for code in codes[: len(codes) - padding]:
        if code == _BACK:
            direction, is_straight = (direction + 4) % 8, False
            continue
        direction = (direction + _ROTATIONS.get(code, 0)) % 8
        length = steps.get(code, 1)
        x, y = x + length * _STEPS[direction][0], y + length * _STEPS[direction][1]
        if code in steps and is_straight:
            vertices.pop()
        vertices.append((x, y))
        is_straight = code in steps
    return np.array(vertices, np.float64)


_CHAIN_CODES: Mapping[str, tuple[int, int] | None] = MappingProxyType(
    {"MODE_POLY2D_SRF6DCC": (3, 15), "MODE_POLY2D_RS6FCC": None}
)
"""Modes of chain codes, and the lengths of their runs; None where the values state them."""

_MODES = (ABSOLUTE, RELATIVE, *_CHAIN_CODES)
_DIGITS: Mapping[str, int] = MappingProxyType({digit: k for k, digit in enumerate(
    "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"
)})  # fmt: skip
_STEPS = (
    (1, 0),
    (1, 1),
    (0, 1),
    (-1, 1),
    (-1, 0),
    (-1, -1),
    (0, -1),
    (1, -1),
)  # clockwise in the image, from the right
_DOWN, _BACK = 2, 5
_ROTATIONS: Mapping[int, int] = MappingProxyType({1: 1, 2: -1, 3: 2, 4: -2})  # by code, in eighths of a full one


def _point(dimensions: int, kind: ShapeType) -> "_Make":
    def make(rows: _Rows, fields: dict[str, Any]) -> Annotation:
        path = VertexPath(rows.timestamps_ns, tuple(rows.vertices(dimensions, 1)))
        return ShapeAnnotation(type=kind, path=path, **fields)

    return make


_Make = Callable[[_Rows, dict[str, Any]], Annotation]
_SHAPES: Mapping[str, _Make] = MappingProxyType(
    {
        "cuboid": _cuboid,
        "bbox": _bbox,
        "rbbox": _rbbox,
        "poly2d": _polygon(2, ShapeType.POLYGON_2D, ShapeType.POLYLINE_2D),
        "poly3d": _polygon(3, ShapeType.POLYGON, ShapeType.POLYLINE),
        "point2d": _point(2, ShapeType.POINT_2D),
        "point3d": _point(3, ShapeType.POINT),
    }
)
"""Types of data that have a location, and what makes an annotation of the rows of each."""

_IN_IMAGES = ("bbox", "rbbox", "poly2d", "point2d")  # types of data that are drawn in the images of a camera
