"""The configuration in force: properties and calibrations of one moment, read once until they change."""

import re
import threading
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from importlib.resources import files
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, read_only
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.db34t.records import CalibrationData
from sceneloom.db34t.tables import CALIBRATION
from sceneloom.db34t.types import DONE, BasicType, Cause, Outcome, ValueForm, ValueType, refused, shown
from sceneloom.detections.detectors import detector_names
from sceneloom.errors import ArrayError, CalibrationError, DataError, OptionError
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import GLOBAL, LONGEST_ROLL_S, Shutter


class SensorKind(StrEnum):
    """Whose frame is declared."""

    CAMERA = "camera"
    LIDAR = "lidar"


_AXIS = re.compile(r"\s*([+-]?)\s*([xyz])\s*", re.IGNORECASE)


@dataclass(frozen=True, slots=True, eq=False)
class DeclaredAxes:
    """Where forward, right and up of the vehicle point in a declared frame.

    Attributes:
        forward_right_up: (3, 3) float64, the three directions as columns, each a signed axis of the declared frame.

    Raises:
        CalibrationError: the columns are no three different axes.
    """

    forward_right_up: Float64Array

    def __post_init__(self) -> None:
        axes = np.abs(self.forward_right_up)
        if not (axes.sum(axis=0) == 1).all() or not (axes.sum(axis=1) == 1).all():
            raise CalibrationError("axes for forward, right, up; expected x, y and z, each of them once")
        object.__setattr__(self, "forward_right_up", read_only(self.forward_right_up))

    @classmethod
    def of_triple(cls, triple: Sequence[int], *, left_handed: bool) -> "DeclaredAxes":
        """Read `camera_coordinate` or `lidar_coordinate`: axis numbers of forward, right and up, negative if opposite.

        There is no -0, so axis 0 carries no sign: it points to where it makes the frame as handed as declared
        (`left_handed` is `chirality` 1).

        Raises:
            CalibrationError: the magnitudes are no permutation of 0, 1, 2.

        Source: table 2 of DB34/T 4101-2022, rows 2 to 4; READING of axis triples in docs/db34t-4101.md.
        """
        order = [abs(axis) for axis in triple]
        if sorted(order) != [0, 1, 2]:
            raise CalibrationError(f"axes {tuple(triple)}; expected 0, 1 and 2 in any order, 1 and 2 with a sign")
        columns = np.zeros((3, 3))
        columns[order, range(3)] = [-1.0 if axis < 0 else 1.0 for axis in triple]
        if (np.linalg.det(columns) > 0) != left_handed:
            columns[:, order.index(0)] *= -1.0
        return cls(columns)

    @classmethod
    def of_words(cls, words: str) -> "DeclaredAxes":
        """Read the axes of forward, right and up in plain words, as "+z,+x,-y"; a sign left out is a plus.

        Raises:
            CalibrationError: it is no list of three different axes.
        """
        found = [match for match in map(_AXIS.fullmatch, words.split(",")) if match is not None]
        if len(found) != 3 or words.count(",") != 2:
            raise CalibrationError(f"axes {words!r}; expected three of x, y, z with a sign, as in '+z,+x,-y'")
        columns = np.zeros((3, 3))
        for k, match in enumerate(found):
            columns["xyz".index(match[2].lower()), k] = -1.0 if match[1] == "-" else 1.0
        return cls(columns)

    @property
    def words(self) -> str:
        """The axes in plain words, as "+z,+x,-y"."""
        rows = np.abs(self.forward_right_up).argmax(axis=0)
        signs = self.forward_right_up[rows, range(3)]
        return ",".join(("+" if sign > 0 else "-") + "xyz"[row] for row, sign in zip(rows, signs, strict=True))

    @property
    def left_handed(self) -> bool:
        """Whether the declared frame is a left-handed one."""
        return bool(np.linalg.det(self.forward_right_up) > 0)

    def standard_from_declared(self, kind: SensorKind) -> Float64Array:
        """The (3, 3) float64 matrix that takes declared coordinates into the frame used inside.

        Its determinant is +1, or -1 where the declared frame is left-handed; its transpose takes them back.
        """
        forward, right, up = self.forward_right_up.T
        rows = (right, -up, forward) if kind is SensorKind.CAMERA else (forward, -right, up)
        return read_only(np.array(rows))


_LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])
_MOST_ENTRY = 2.0  # numbers beyond it stand in no rotation: their squares may overflow
_MOST_ROTATION_ERROR = 0.02
"""How far a rotation may be from orthonormal: matrices are printed with three digits or more."""


def _possible_matrices(numbers: Sequence[float]) -> list[Float64Array]:
    """The (4, 4) transforms that 16 numbers can be: by rows, by columns, or both where the translation is zero."""
    # Source: table 3 of DB34/T 4101-2022, whose example has its translation in the last row
    given = np.asarray(numbers, np.float64).reshape(-1)
    if given.shape != (16,) or not np.isfinite(given).all():
        raise CalibrationError(f"extrinsic_matrix of {given.size} numbers; expected 16 finite ones")
    square = given.reshape(4, 4)
    found = [matrix for matrix in (square, square.T) if np.abs(matrix[3] - _LAST_ROW).max() <= 1e-6]
    if not found:
        raise CalibrationError(
            f"extrinsic_matrix with the last row {square[3].tolist()} and the last column {square[:, 3].tolist()}; "
            "expected one of them to be 0 0 0 1"
        )
    return found


def _camera_of(data: CalibrationData) -> Camera:
    """A record's camera model (table 3): a pinhole, or with coefficients (in OpenCV's order) Brown and Conrady's."""
    k = np.array(data.intrinsic_matrix).reshape(3, 3)
    others = np.abs([k[0, 1], k[1, 0], k[2, 0], k[2, 1], k[2, 2] - 1.0])
    if others.max() > 1e-6 * max(1.0, abs(k[0, 0])):
        raise CalibrationError(f"intrinsic_matrix {k.tolist()}; expected fx 0 cx, 0 fy cy, 0 0 1, row after row")
    coefficients = tuple(data.distortion_coeffs)
    model, padded = ("brown_conrady", (*coefficients, *[0.0] * 11)) if any(coefficients) else ("pinhole", ())
    width, height = data.image_size
    fx, fy, cx, cy = k[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return Camera(model, width, height, fx, fy, cx, cy, padded)


def calibration_data(
    camera: Camera, camera_from_lidar: RigidTransform, camera_axes: DeclaredAxes, lidar_axes: DeclaredAxes
) -> CalibrationData:
    """Write a camera model and extrinsics as a record of table 3, in the standard's own layout (by columns).

    Raises:
        CalibrationError: table 3 cannot hold the camera model.
    """
    optical = camera_axes.standard_from_declared(SensorKind.CAMERA)
    standard = lidar_axes.standard_from_declared(SensorKind.LIDAR)
    declared = np.eye(4)
    declared[:3, :3] = optical.T @ camera_from_lidar.rotation @ standard
    declared[:3, 3] = optical.T @ camera_from_lidar.translation
    held = camera.coefficients[:5]
    if camera.model not in ("pinhole", "brown_conrady") or any(camera.coefficients[5:]):
        raise CalibrationError(
            f"a {camera.model} camera model with {len(camera.coefficients)} coefficients; table 3 holds k1 k2 p1 p2 "
            "k3 of a brown_conrady camera model: fit one to it, or send the camera model by the property "
            "`camera_models`"
        )
    return CalibrationData(
        image_size=(camera.width, camera.height),
        intrinsic_matrix=tuple(camera.matrix.reshape(-1).tolist()),
        reference_frame=0,
        extrinsic_matrix=tuple(declared.T.reshape(-1).tolist()),
        distortion_coeffs=(*held, *[0.0] * (5 - len(held))),
    )


@dataclass(frozen=True, eq=False)
class _CalibratedPair:
    """A camera and a lidar in the frames used inside: x forward, y left, z up, and the optical frame."""

    camera: Camera
    camera_from_lidar: RigidTransform
    notes: tuple[str, ...] = ()  # what looks wrong, for people

    @cached_property
    def lidar_from_camera(self) -> RigidTransform:
        """The inverse; always the same object."""
        return self.camera_from_lidar.inverse()


_SUSPECT_DEG = 45.0
_CAMERA_FROM_LIDAR_FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Of a camera that looks forward: optical axes from x forward, y left, z up."""


def calibrated_pair(
    data: CalibrationData, camera_axes: DeclaredAxes, lidar_axes: DeclaredAxes, *, camera_model: Camera | None = None
) -> _CalibratedPair:
    """Bring a record into the frames used inside.

    `extrinsic_matrix` relates the declared frames. Where its layout is open, the one counts that lets the camera look
    more nearly forward. `camera_model` replaces the record's own.

    Raises:
        CalibrationError: the matrix mirrors where the axes do not, or they do and it does not.

    Source: DB34/T 4101-2022, table 3; READINGS of extrinsic_matrix and of declared frames in docs/CONVENTIONS.md.
    """
    optical = camera_axes.standard_from_declared(SensorKind.CAMERA)
    standard = lidar_axes.standard_from_declared(SensorKind.LIDAR)
    found = []
    for given in _possible_matrices(data.extrinsic_matrix):
        declared = np.linalg.inv(given) if data.reference_frame == 1 else given
        inside = np.eye(4)
        inside[:3, :3] = optical @ declared[:3, :3] @ standard.T
        inside[:3, 3] = optical @ declared[:3, 3]
        found.append(inside)
    nearest = min(found, key=lambda matrix: _off_forward_deg(matrix[:3, :3]))
    transform, error = RigidTransform.nearest(nearest)
    if error > _MOST_ROTATION_ERROR:
        mirrored = np.linalg.det(nearest[:3, :3]) < 0
        problem = "mirrors" if mirrored else f"has a rotation off by {error:.2g}"
        raise CalibrationError(
            f"extrinsic_matrix {problem} with axes {camera_axes.words} of the camera and {lidar_axes.words} of the "
            "lidar; expected a rotation, of determinant +1, between frames that are both right- or both left-handed"
        )
    off_deg = _off_forward_deg(transform.rotation)
    note = (
        f"by its calibration the camera looks {off_deg:.0f}° off forward; mirrored or transposed? "
        "check extrinsic_matrix, reference_frame and the declared axes, unless it is mounted so"
    )
    return _CalibratedPair(camera_model or _camera_of(data), transform, (note,) if off_deg > _SUSPECT_DEG else ())


def _off_forward_deg(rotation: Float64Array) -> float:
    """Angle [deg] between a rotation and that of a camera that looks straight forward."""
    cosine = (np.trace(rotation @ _CAMERA_FROM_LIDAR_FORWARD.T) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


@dataclass(frozen=True, slots=True)
class CalibrationEntry:
    """A record of table 3, and the camera and the lidar (0 to 255) that it is of.

    Refused is what no axes could make a calibration: properties are set one by one, so axes may still change.

    Raises:
        CalibrationError: the numbers are no camera model, or no rotation with a translation in any layout.
    """

    camera_id: int
    lidar_id: int
    data: CalibrationData

    def __post_init__(self) -> None:
        _camera_of(self.data)
        for matrix in _possible_matrices(self.data.extrinsic_matrix):
            r = matrix[:3, :3]
            largest = float(np.abs(r).max())
            error = largest if largest > _MOST_ENTRY else float(np.abs(r @ r.T - np.eye(3)).max())
            if error > _MOST_ROTATION_ERROR:
                problem = f"extrinsic_matrix whose rotation is off by {error:.2g}; expected an orthonormal one"
                raise CalibrationError(problem)


CalibrationTable = Mapping[tuple[int, int], CalibrationEntry]
"""Calibrations by camera_id and lidar_id; never edited, so that a frame keeps those in force when it came."""

MOST_PAIRS = 1024
"""Cameras and lidars that one system may relate: every change of a calibration looks at all of them."""


def calibration_table(entries: Iterable[CalibrationEntry], before: CalibrationTable | None = None) -> CalibrationTable:
    """A table of calibrations, which replace those of the same sensors in the one before."""
    added = {(entry.camera_id, entry.lidar_id): entry for entry in entries}
    return MappingProxyType({**(before or {}), **added})


_OWNER = "calibration"
_IDS = ("camera_id", "lidar_id")
_FIELDS = {row.name: row.attribute for row in CALIBRATION.rows}


def parse_calibrations(text: str) -> tuple[CalibrationEntry, ...]:
    """Read the property `calibration`; an empty text holds none.

    Raises:
        DataError: it is no JSON list of records of table 3 with `camera_id` and `lidar_id`, or two are of one pair.
        CalibrationError: the numbers of one are no camera model or no transform.
    """
    found = _read_json(text, _OWNER)
    if found is None:
        return ()
    if isinstance(found, dict):
        found = [found]
    if not isinstance(found, list):
        raise DataError(_OWNER, "", "neither a JSON list nor an object; expected records of table 3")
    if len(found) > MOST_PAIRS:
        raise DataError(_OWNER, "", f"{len(found)} records; expected at most {MOST_PAIRS}")
    entries = tuple(entry_of(item, f"[{k}]") for k, item in enumerate(found))
    pairs = [(entry.camera_id, entry.lidar_id) for entry in entries]
    for k, pair in enumerate(pairs):
        if pair in pairs[:k]:
            raise DataError(_OWNER, f"[{k}]", f"camera {pair[0]} and lidar {pair[1]} again; expected each pair once")
    return entries


def entry_of(item: Any, location: str) -> CalibrationEntry:
    """Read one record of table 3 with its `camera_id` and `lidar_id`, 0 where they are left out.

    Raises:
        DataError: it is no such record.
        CalibrationError: its numbers are no camera model or no transform.
    """
    if not isinstance(item, dict):
        raise DataError(_OWNER, location, f"{item!r}; expected an object")
    unknown = sorted(set(item) - set(_FIELDS) - set(_IDS))
    if unknown:
        known = ", ".join((*_IDS, *_FIELDS))
        raise DataError(_OWNER, f"{location}.{unknown[0]}", f"not a field of table 3; there are {known}")
    camera_id, lidar_id = (_sensor_id_of(item.get(name, 0), _OWNER, f"{location}.{name}") for name in _IDS)
    missing = [row.name for row in CALIBRATION.rows if row.required and row.name not in item]
    if missing:
        raise DataError(_OWNER, f"{location}.{missing[0]}", "missing; expected as table 3 has it")
    try:
        data = CalibrationData(**{_FIELDS[name]: value for name, value in item.items() if name not in _IDS})
    except DataError as error:
        raise DataError(_OWNER, f"{location}.{error.location}", error.problem) from error
    return CalibrationEntry(camera_id, lidar_id, data)


CAMERA_MODELS = "camera_models"
"""A property that a session adds where it needs it: camera models that table 3 cannot state."""


def _read_by_sensor(text: str, owner: str, example: str) -> dict[int, Any]:
    """Read a property that describes sensors: a JSON object by sensor number, as `example`; {} for an empty text."""
    found = _read_json(text, owner)
    if found is None:
        return {}
    if not isinstance(found, dict):
        raise DataError(owner, "", f"{text[:40]!r}; expected an object as {example}")
    numbers = (int(name) if name.isascii() and name.isdigit() and len(name) <= 3 else name for name in found)
    return {_sensor_id_of(number, owner, name): found[name] for number, name in zip(numbers, found, strict=True)}


def _read_json(text: str, owner: str) -> Any:
    """Read the text of a property; None for an empty one."""
    if not text.strip():
        return None
    try:
        return msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError) as error:
        raise DataError(owner, "", f"no JSON: {error}") from error


def _sensor_id_of(value: Any, owner: str, location: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 255:
        raise DataError(owner, location, f"{value!r}; expected a number of a sensor, 0 to 255")
    return value


_MOUNTING_PARTS = {"position": 3, "quaternion_xyzw": 4}
_MOST_M = 1e9  # beyond this a number is none of an extrinsic position [m]
_OF_KIND = {SensorKind.LIDAR: ("body_from_lidar",), SensorKind.CAMERA: ("shutter_roll_s", "shutter_left_to_right")}
"""What is stated for sensors of one kind alone."""


class _RawForm(StrEnum):
    """What the bytes of a raw record (table 4) are."""

    RECORDS = "records"
    """Lidar: 23-byte records, as of the recording format: x y z float32, intensity uint8, ring uint16, time float64."""
    JPEG = "jpeg"
    """Camera: a JPEG file."""
    PNG = "png"
    """Camera: a PNG file."""
    RGB8 = "rgb8"
    """Camera: height x width x 3 bytes; the size is that of the camera's calibration."""


_RAW_FORMS = {SensorKind.LIDAR: (_RawForm.RECORDS,), SensorKind.CAMERA: (_RawForm.JPEG, _RawForm.PNG, _RawForm.RGB8)}
"""What raw data a sensor of each kind can send."""


@dataclass(frozen=True, slots=True)
class _DeclaredSensor:
    """A sensor as the property `sensors` declares it."""

    sensor_id: int
    kind: SensorKind
    raw: _RawForm | None = None  # what its raw data hold; None where it sends none
    body_from_lidar: RigidTransform | None = None  # on the body whose trajectory is sent; None: its own
    shutter: Shutter = GLOBAL


def parse_sensors(text: str) -> Mapping[int, _DeclaredSensor]:
    """Read the property `sensors`; an empty text declares nothing.

    Raises:
        DataError: it is no JSON object of sensors.
    """
    found = _read_by_sensor(text, "sensors", '{"0": {"kind": "lidar"}}')
    return {sensor_id: _declared(sensor_id, entry) for sensor_id, entry in found.items()}


def _declared(sensor_id: int, entry: Any) -> _DeclaredSensor:
    if not isinstance(entry, dict) or "kind" not in entry:
        raise DataError("sensors", str(sensor_id), f"{entry!r}; expected an object with kind")

    def fault(field: str, problem: str) -> DataError:
        return DataError("sensors", f"{sensor_id}.{field}", problem)

    if entry["kind"] not in list(SensorKind):
        raise fault("kind", f"{entry['kind']!r}; expected {' or '.join(SensorKind)}")
    kind = SensorKind(entry["kind"])
    for name in entry:
        if name in ("kind", "raw", *_OF_KIND[kind]):
            continue
        others = {other.value for other, names in _OF_KIND.items() if name in names}
        if others:
            raise fault(name, f"of a {kind}; expected of {' and '.join(others)}s")
        raise fault(name, f"no field of a {kind}; expected kind and perhaps {', '.join(('raw', *_OF_KIND[kind]))}")
    raw = entry.get("raw")
    if raw is not None and raw not in _RAW_FORMS[kind]:
        raise fault("raw", f"{raw!r}; expected one of {', '.join(_RAW_FORMS[kind])}")
    seconds, over_columns = entry.get("shutter_roll_s", 0.0), entry.get("shutter_left_to_right", False)
    if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not 0 <= seconds <= LONGEST_ROLL_S:
        raise fault("shutter_roll_s", f"{seconds!r}; expected seconds, 0 to {LONGEST_ROLL_S:g}")
    if not isinstance(over_columns, bool):
        raise fault("shutter_left_to_right", f"{over_columns!r}; expected true or false")
    return _DeclaredSensor(
        sensor_id,
        kind,
        None if raw is None else _RawForm(raw),
        _mounting(entry["body_from_lidar"], fault) if "body_from_lidar" in entry else None,
        Shutter(float(seconds), over_columns),
    )


def _mounting(found: Any, fault: Callable[[str, str], DataError]) -> RigidTransform:
    """Read `{"position": [x, y, z], "quaternion_xyzw": [x, y, z, w]}` [m]; without a rotation the identity."""
    owner = "body_from_lidar"
    if not isinstance(found, dict) or not {"position"} <= set(found) <= set(_MOUNTING_PARTS):
        raise fault(owner, f"{found!r}; expected an object with position and perhaps quaternion_xyzw")
    values = {"quaternion_xyzw": (0.0, 0.0, 0.0, 1.0), **found}
    for name, count in _MOUNTING_PARTS.items():
        numbers = values[name]
        listed = isinstance(numbers, list | tuple) and len(numbers) == count
        if not listed or not all(type(number) in (int, float) and abs(number) <= _MOST_M for number in numbers):
            raise fault(f"{owner}.{name}", f"{numbers!r}; expected {count} finite numbers")
    quaternion = np.array(values["quaternion_xyzw"], np.float64)
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > 0.01:
        raise fault(f"{owner}.quaternion_xyzw", f"norm {norm:.4f}; expected a unit quaternion")
    try:
        return RigidTransform.from_quaternion(np.array(values["position"], np.float64), quaternion)
    except (ArrayError, CalibrationError) as error:
        raise fault(owner, str(error)) from error


_Check = Callable[[Any], object]
"""Raises DataError or CalibrationError for a value of the right type that the property cannot take."""


@dataclass(frozen=True, slots=True)
class _PredefinedProperty:
    """A property that is there from the start; `source` is the row of table 2, or "extension"."""

    name: str
    description: str
    type: str
    default: Any
    unit: str = ""
    check: _Check | None = None
    source: str = "extension"


def _expect(holds: Callable[[Any], bool], expected: str) -> _Check:
    """A check that a value holds; the message states the value and what was expected."""

    def check(value: Any) -> None:
        if not holds(value):
            text = f"{value:g}" if isinstance(value, float) else repr(value)
            raise DataError("", "", f"{text}; expected {expected}")

    return check


def _one_of(*names: str) -> _Check:
    return _expect(lambda value: value in names, f"one of {', '.join(names)}")


def _detectors(value: str) -> None:
    _one_of(*detector_names())(value)  # looked up late: detectors of other packages take time to import


_PROPERTY_CHECKS: Mapping[str, _Check] = {
    **dict.fromkeys(
        ("camera_coordinate", "lidar_coordinate"), lambda value: DeclaredAxes.of_triple(value, left_handed=False)
    ),
    **dict.fromkeys(("camera_axes", "lidar_axes"), lambda value: value and DeclaredAxes.of_words(value)),
    **dict.fromkeys(
        ("camera_frequency", "lidar_frequency", "queue_length", "result_queue_length"),
        _expect(lambda value: value >= 1, "1 or more"),
    ),
    "fusion_algorithm": _expect(lambda value: bool(value.strip()), "the name of an algorithm"),
    "sensors": parse_sensors,
    "calibration": parse_calibrations,
    "depth_kind": _one_of("z", "range"),
    "pairing_tolerance_ms": _expect(lambda value: value >= 0, "0 or more"),
    "queue_policy": _one_of("drop-oldest", "refuse"),
    "detectors": _detectors,
}


def _read_predefined() -> Iterator[_PredefinedProperty]:
    content = tomllib.loads(files(__package__).joinpath("properties.toml").read_text("utf-8"))
    for name, row in content.items():
        default = tuple(row["default"]) if isinstance(row["default"], list) else row["default"]
        check = _PROPERTY_CHECKS.get(name)
        yield _PredefinedProperty(name=name, **(row | {"default": default, "check": check}))


PREDEFINED: Mapping[str, _PredefinedProperty] = MappingProxyType({row.name: row for row in _read_predefined()})
"""By name, those of table 2 first, in its order.

Source: DB34/T 4101-2022, table 2; defaults are its examples, but for the algorithm, which names one that is built in.
"""

_ENUM_PAIR = re.compile(r"(\w+)\s*=\s*(-?\d+)")
MOST_PROPERTIES = 1_000
"""Properties that one system may have: a caller that adds for ever is stopped."""


@dataclass(frozen=True, slots=True)
class Property:
    """One property with its value.

    Attributes:
        name, unit: of the property; `unit` "" for none.
        description: for people; of an `enum` also its `name=number` pairs.
        type: what its values have to be.
        value: as `ValueType.check` gives it; None where it was added and not set yet.
        predefined: whether it is there from the start.
    """

    name: str
    description: str
    type: ValueType
    value: Any = None
    unit: str = ""
    predefined: bool = False

    @property
    def enumeration(self) -> Mapping[str, int]:
        """The names of an `enum` and their numbers, from the description."""
        return {name: int(number) for name, number in _ENUM_PAIR.findall(self.description)}


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The properties as they were at one moment; kept with every result.

    Attributes:
        revision: counts the changes; equal numbers mean equal properties.
        properties: by name, those of table 2 first, in their order.
        algorithms: `fusion_algorithm` of sensor data and of detections.
    """

    revision: int
    properties: Mapping[str, Property]
    algorithms: tuple[str, str]

    def __getitem__(self, name: str) -> Any:
        return self.properties[name].value

    @property
    def calibrations(self) -> CalibrationTable:
        """The table of calibrations that the property `calibration` states."""
        return calibration_table(parse_calibrations(self["calibration"]))


_LONGEST_NAME = 256
_LONGEST_DESCRIPTION = 65_536
_LARGEST_VALUES = 1 << 25
"""How large the values of all properties may be together: their characters, and 8 for each number."""


@dataclass(slots=True)
class PropertyStore:
    """Holds the properties; each call is whole before the next one is, whoever calls.

    Attributes:
        check_algorithm: called with a fusion type and a name before it is set; raises OptionError if there is no
            such algorithm.

    Source: DB34/T 4101-2022, clauses 5.2 to 5.5.
    """

    check_algorithm: Callable[[int, str], object] | None = None
    _properties: dict[str, Property] = field(
        default_factory=lambda: {
            row.name: Property(
                row.name, row.description, ValueType.parse(row.type), row.default, row.unit, predefined=True
            )
            for row in PREDEFINED.values()
        }
    )
    _algorithms: list[str] = field(default_factory=lambda: [PREDEFINED["fusion_algorithm"].default] * 2)
    _revision: int = 0
    _size: int = 0
    _snapshot: Snapshot | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, name: str, description: str, type: str) -> Outcome:
        """Add a property without a value.

        Args:
            name: up to 256 characters, none of them blank or a control character.
            description: for people; of an `enum` it lists its `name=number` pairs.
            type: of table 1, or a tuple or an array of such.

        Returns:
            0 where the name is taken or not usable, or the type is none.

        Source: DB34/T 4101-2022, clause 5.3.
        """
        try:
            _check_words(name, description)
            kind = ValueType.parse(type)
        except DataError as error:
            return refused(Cause.ILL_TYPED, error)
        added = Property(name, description, kind)
        if BasicType.ENUM in kind.elements and not added.enumeration:
            return refused(Cause.ILL_TYPED, "an enum without values; expected name=number pairs in its description")
        with self._lock:
            if name in self._properties:
                return refused(Cause.KNOWN_NAME, f"property {name!r} is there already")
            if len(self._properties) >= MOST_PROPERTIES:
                return refused(Cause.TOO_MANY, f"there are {MOST_PROPERTIES} properties, as many as there may be")
            self._keep(added)
        return DONE

    def set(self, name: str, value: Any) -> Outcome:
        """Set a property; what is refused leaves it as it was.

        Source: DB34/T 4101-2022, clause 5.4.
        """
        with self._lock:
            known = self._properties.get(name)
            if known is None:
                return refused(Cause.UNKNOWN_NAME, self._unknown(name))
            try:
                checked = _checked(known, value)
            except DataError as error:
                return refused(Cause.ILL_TYPED, error)
            try:
                self._check_further(name, checked)
            except OptionError as error:
                return refused(Cause.UNKNOWN_ALGORITHM, error)
            except (DataError, CalibrationError) as error:
                return refused(Cause.OUT_OF_RANGE, f"{name}: {error}")
            size = self._size - _size_of(known.value) + _size_of(checked)
            if size > _LARGEST_VALUES:
                problem = f"all values have {size} characters and numbers then; expected at most {_LARGEST_VALUES}"
                return refused(Cause.TOO_MANY, f"{name}: {problem}")
            self._size = size
            if name == "fusion_algorithm":
                self._algorithms[self._properties["fusion_type"].value] = checked
            self._keep(replace(known, value=checked))
            # fusion_algorithm states the algorithm of the fusion that fusion_type names
            algorithm = self._properties["fusion_algorithm"]
            current = self._algorithms[self._properties["fusion_type"].value]
            if algorithm.value != current:
                self._properties["fusion_algorithm"] = replace(algorithm, value=current)
        return DONE

    def get(self, name: str) -> Property:
        """Give a property.

        Raises:
            OptionError: there is none of that name.

        Source: DB34/T 4101-2022, clause 5.5.
        """
        with self._lock:
            if name not in self._properties:
                raise OptionError(self._unknown(name))
            return self._properties[name]

    def snapshot(self) -> Snapshot:
        """Give all properties as they are now."""
        with self._lock:
            if self._snapshot is None:
                kept = MappingProxyType(dict(self._properties))
                self._snapshot = Snapshot(self._revision, kept, (self._algorithms[0], self._algorithms[1]))
            return self._snapshot

    def _keep(self, changed: Property) -> None:
        self._properties[changed.name] = changed
        self._revision += 1
        self._snapshot = None

    def _check_further(self, name: str, value: Any) -> None:
        row = PREDEFINED.get(name)
        if row is not None and row.check is not None:
            row.check(value)
        if name == "fusion_algorithm" and self.check_algorithm is not None:
            self.check_algorithm(self._properties["fusion_type"].value, value)

    def _unknown(self, name: str) -> str:
        names = list(self._properties)
        listed = f"{', '.join(names[:40])}{'' if len(names) <= 40 else ', …'}"
        return f"property {shown(name)} is not there; there are {listed}"


def _check_words(name: str, description: str) -> None:
    """Check name and description of a property that is added."""
    usable = isinstance(name, str) and 0 < len(name) <= _LONGEST_NAME and name.isprintable() and " " not in name
    if not usable:
        raise DataError("property", "name", f"{shown(name)}; expected 1 to {_LONGEST_NAME} visible characters")
    if not isinstance(description, str):
        raise DataError(f"property {name}", "description", f"{shown(description)}; expected a text")
    if len(description) > _LONGEST_DESCRIPTION:
        problem = f"{len(description)} characters; expected at most {_LONGEST_DESCRIPTION}"
        raise DataError(f"property {name}", "description", problem)


def _size_of(value: Any) -> int:
    if isinstance(value, tuple):
        return sum(map(_size_of, value))
    return len(value) if isinstance(value, str) else 8


def _checked(known: Property, value: Any) -> Any:
    checked = known.type.check(value, owner=known.name)
    if BasicType.ENUM not in known.type.elements:
        return checked
    if known.type.form is ValueForm.SCALAR:
        return _enumerated(known, checked)
    return tuple(
        _enumerated(known, item) if kind is BasicType.ENUM else item
        for kind, item in zip(known.type.elements_of(len(checked)), checked, strict=True)
    )


def _enumerated(known: Property, value: str | int) -> int:
    pairs = known.enumeration
    if isinstance(value, str) and value in pairs:
        return pairs[value]
    if value in pairs.values():
        return int(value)
    expected = ", ".join(f"{name}={number}" for name, number in pairs.items())
    raise DataError(known.name, "", f"{shown(value)}; expected one of {expected}")


_MILLISECOND = 1_000_000
_SECOND = 1_000_000_000
_SHORTEST_WAIT_S = 0.01

_GEOMETRY = (
    *("chirality", "camera_coordinate", "lidar_coordinate", "camera_axes", "lidar_axes", "sensors"),
    CAMERA_MODELS,
)  # the properties that pairs and sensors depend on


@dataclass(frozen=True, eq=False)
class Setting:
    """The configuration by which a record is received and fused.

    Attributes:
        properties: as they were.
        table: the calibrations as they were.
        axes: the declared axes of cameras and of lidars.
        sensors: what the property `sensors` declares, by sensor_id.
        pairs: camera model and extrinsics of each camera and lidar that are calibrated, by (camera_id, lidar_id).
        faults: why a calibration cannot be used with the declared axes, by the same.
    """

    properties: Snapshot
    table: CalibrationTable
    axes: Mapping[SensorKind, DeclaredAxes]
    sensors: Mapping[int, _DeclaredSensor]
    pairs: Mapping[tuple[int, int], _CalibratedPair]
    faults: Mapping[tuple[int, int], str] = field(default_factory=dict)

    @classmethod
    def of(cls, properties: Snapshot, table: CalibrationTable, *, before: "Setting | None" = None) -> "Setting":
        """Read properties and calibrations; what did not change since `before` is taken from there.

        Raises:
            DataError: the added property `camera_models` cannot be read.
            CalibrationError: a camera model in it cannot be.
        """
        if before is not None and before.table is table and _geometry(before.properties) == _geometry(properties):
            return replace(before, properties=properties)
        axes = {kind: _declared_axes(properties, kind) for kind in SensorKind}
        added = properties.properties.get(CAMERA_MODELS)
        models = _parse_camera_models(added.value) if added is not None and isinstance(added.value, str) else {}
        pairs: dict[tuple[int, int], _CalibratedPair] = {}
        faults: dict[tuple[int, int], str] = {}
        for (camera_id, lidar_id), entry in table.items():
            try:
                pairs[camera_id, lidar_id] = calibrated_pair(
                    entry.data, axes[SensorKind.CAMERA], axes[SensorKind.LIDAR], camera_model=models.get(camera_id)
                )
            except CalibrationError as error:
                faults[camera_id, lidar_id] = str(error)
        return cls(properties, table, axes, parse_sensors(properties["sensors"]), pairs, faults)

    @cached_property
    def sweep_period_ns(self) -> int:
        """By `lidar_frequency` [ns]."""
        return int(_SECOND // self.properties["lidar_frequency"])

    @cached_property
    def image_period_ns(self) -> int:
        """By `camera_frequency` [ns]."""
        return int(_SECOND // self.properties["camera_frequency"])

    @cached_property
    def tolerance_ns(self) -> int:
        """How far an image may be from a sweep [ns], by `pairing_tolerance_ms`.

        Where the property is 0: as far as both are apart at the worst if both sensors keep their frequencies, half of
        each period.
        """
        stated_ns = round(self.properties["pairing_tolerance_ms"] * _MILLISECOND)
        return stated_ns or (self.sweep_period_ns + self.image_period_ns) // 2

    @cached_property
    def timeout_ns(self) -> int:
        """By `pairing_timeout_ms` [ns]."""
        return int(self.properties["pairing_timeout_ms"]) * _MILLISECOND

    @cached_property
    def lateness_ns(self) -> int:
        """How much older than the newest of its sensor a record may be [ns]: the timeout, or a period of the sensor."""
        return max(self.timeout_ns, self.sweep_period_ns, self.image_period_ns)

    @cached_property
    def timeout_s(self) -> float:
        """By `pairing_timeout_ms` [s], but no shorter than what a thread can wait for others."""
        return max(self.timeout_ns / _SECOND, _SHORTEST_WAIT_S)

    @cached_property
    def idle_s(self) -> float:
        """After how much time without any record nothing is waited for any more [s]."""
        return max((self.timeout_ns + self.tolerance_ns) / _SECOND, _SHORTEST_WAIT_S)

    @cached_property
    def configuration(self) -> FusionConfiguration:
        """The configuration of the fusion system itself."""
        sensor_data, detections = self.properties.algorithms
        return FusionConfiguration(
            fusion_algorithm=sensor_data,
            detection_algorithm=detections,
            detectors=self.properties["detectors"],
            pairing_tolerance_ns=self.tolerance_ns,
            lateness_ns=self.timeout_ns,
            most_waiting=self.properties["queue_length"],
            stand_beyond_trajectory=True,
            motion_compensation=self.properties["motion_compensation"] == 1,
            image_period_ns=self.image_period_ns,
            disorder_ns=self.lateness_ns,
        )

    @cached_property
    def pixels(self) -> int:
        """Of the images of all calibrated cameras together."""
        sizes = {camera_id: pair.camera for (camera_id, _), pair in self.pairs.items()}
        return sum(camera.width * camera.height for camera in sizes.values())

    @cached_property
    def standard_from_lidar(self) -> Float64Array:
        """Takes coordinates of the declared lidar frame into x forward, y left, z up, (3, 3) float64."""
        return self.axes[SensorKind.LIDAR].standard_from_declared(SensorKind.LIDAR)

    @cached_property
    def declared_from_standard(self) -> Float64Array:
        """The other way round, (3, 3) float64."""
        return read_only(self.standard_from_lidar.T)

    @cached_property
    def calibrated(self) -> Mapping[SensorKind, tuple[int, ...]]:
        """The numbers of the sensors with a usable calibration, by kind."""
        return {kind: tuple(sorted({pair[k] for pair in self.pairs})) for k, kind in enumerate(SensorKind)}

    def pairs_of(self, kind: SensorKind, sensor_id: int) -> tuple[tuple[int, int], ...]:
        """The pairs with a usable calibration that a sensor is in."""
        return tuple(pair for pair in self.pairs if pair[kind is SensorKind.LIDAR] == sensor_id)

    def fault_of(self, kind: SensorKind, sensor_id: int) -> str | None:
        """Why a calibration of a sensor cannot be used; None where there is no such."""
        return next((f for pair, f in self.faults.items() if pair[kind is SensorKind.LIDAR] == sensor_id), None)

    def camera(self, camera_id: int) -> Camera:
        """The camera model of a camera that is calibrated; a camera has one size with all lidars.

        Raises:
            CalibrationError: its calibrations are of images of several sizes.
        """
        models = [pair.camera for (camera, _), pair in self.pairs.items() if camera == camera_id]
        sizes = {(model.width, model.height) for model in models}
        if len(sizes) > 1:
            raise CalibrationError(f"image_size of camera {camera_id}: {sorted(sizes)}; expected one size")
        return models[0]


def _geometry(properties: Snapshot) -> tuple[object, ...]:
    known = properties.properties
    return tuple(known[name].value if name in known else None for name in _GEOMETRY)


def _declared_axes(properties: Snapshot, kind: SensorKind) -> DeclaredAxes:
    """The declared axes of a kind of sensor: those in plain words where they are stated, else those of the triple."""
    if properties[f"{kind}_axes"]:
        return DeclaredAxes.of_words(properties[f"{kind}_axes"])
    return DeclaredAxes.of_triple(properties[f"{kind}_coordinate"], left_handed=properties["chirality"] == 1)


def _parse_camera_models(text: str) -> Mapping[int, Camera]:
    """Read `{"1": {"model": "fisheye", "image_size": [w, h], "fx": …, "coefficients": […]}}`; an empty text: none."""
    found = _read_by_sensor(text, CAMERA_MODELS, '{"1": {"model": "fisheye", …}}')
    return {camera_id: _camera_model(entry, str(camera_id)) for camera_id, entry in found.items()}


def _camera_model(entry: Any, location: str) -> Camera:
    try:
        model, (width, height) = entry["model"], entry["image_size"]
        fx, fy, cx, cy = (float(entry[name]) for name in ("fx", "fy", "cx", "cy"))
        coefficients = tuple(float(value) for value in entry.get("coefficients", ()))
        if model not in MODELS or not all(isinstance(size, int) for size in (width, height)):
            problem = f"{entry!r}; expected a model out of {', '.join(MODELS)} and whole sizes"
            raise DataError(CAMERA_MODELS, location, problem)
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        problem = f"{entry!r}; expected model, image_size, fx, fy, cx, cy, coefficients"
        raise DataError(CAMERA_MODELS, location, problem) from error
    wanted = len(MODELS[model].coefficient_names)
    if len(coefficients) > wanted:
        raise CalibrationError(f"{CAMERA_MODELS}.{location}: {len(coefficients)} coefficients; {model} has {wanted}")
    padded = (*coefficients, *[0.0] * (wanted - len(coefficients)))
    return Camera(model, width, height, fx, fy, cx, cy, padded)
