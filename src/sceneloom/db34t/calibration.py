"""Calibration data of DB34/T 4101-2022: from table 3 and the declared sensor axes to camera models and extrinsics.

And back, for several cameras and lidars.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.db34t.records import CalibrationData
from sceneloom.db34t.tables import CALIBRATION
from sceneloom.errors import CalibrationError, DataError
from sceneloom.geometry.rigid import RigidTransform


def _read_json(text: str, owner: str) -> Any:
    """Read the text of a property; None for an empty one.

    Raises:
        DataError: it is no JSON.
    """
    if not text.strip():
        return None
    try:
        return msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError) as error:
        raise DataError(owner, "", f"no JSON: {error}") from error


def read_by_sensor(text: str, owner: str, example: str) -> dict[int, Any]:
    """Read the text of a property that says something of each sensor: an object whose names are numbers of sensors.

    Args:
        example: what such an object looks like.

    Raises:
        DataError: it is none, or a name is no number from 0 to 255.
    """
    found = _read_json(text, owner)
    if found is None:
        return {}
    if not isinstance(found, dict):
        raise DataError(owner, "", f"{text[:40]!r}; expected an object as {example}")
    return {_sensor_id_of(int(name) if _is_number(name) else name, owner, name): found[name] for name in found}


def _sensor_id_of(value: Any, owner: str, location: str) -> int:
    """Give the number of a sensor.

    Raises:
        DataError: it is no whole number from 0 to 255.
    """
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 255:
        raise DataError(owner, location, f"{value!r}; expected a number of a sensor, 0 to 255")
    return value


def _is_number(name: str) -> bool:
    return name.isascii() and name.isdigit() and len(name) <= 3


_AXIS = re.compile(r"\s*([+-]?)\s*([xyz])\s*", re.IGNORECASE)


class SensorKind(StrEnum):
    """Whose frame is declared."""

    CAMERA = "camera"
    LIDAR = "lidar"


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
        if not np.array_equal(axes.sum(axis=0), np.ones(3)) or not np.array_equal(axes.sum(axis=1), np.ones(3)):
            raise CalibrationError("axes for forward, right, up; expected x, y and z, each of them once")
        object.__setattr__(self, "forward_right_up", read_only(self.forward_right_up))

    @classmethod
    def of_triple(cls, triple: Sequence[int], *, left_handed: bool) -> "DeclaredAxes":
        """Read a triple of table 2: axis numbers of forward, right and up, negative for the opposite direction.

        There is no -0, so axis 0 carries no sign: it points to where it makes the frame as handed as declared.

        Args:
            triple: `camera_coordinate` or `lidar_coordinate`.
            left_handed: `chirality` 1.

        Raises:
            CalibrationError: the magnitudes are no permutation of 0, 1, 2.

        Source: table 2 of DB34/T 4101-2022, rows 2 to 4; READING of axis triples in docs/CONVENTIONS.md.
        """
        if len(triple) != 3 or sorted(abs(axis) for axis in triple) != [0, 1, 2]:
            raise CalibrationError(f"axes {tuple(triple)}; expected 0, 1 and 2 in any order, 1 and 2 with a sign")
        columns = np.zeros((3, 3))
        for location, axis in enumerate(triple):
            columns[abs(axis), location] = -1.0 if axis < 0 else 1.0
        wanted = 1.0 if left_handed else -1.0
        if np.linalg.det(columns) * wanted < 0:
            columns[:, list(map(abs, triple)).index(0)] *= -1.0
        return cls(columns)

    @classmethod
    def of_words(cls, words: str) -> "DeclaredAxes":
        """Read the axes of forward, right and up in plain words, as "+z,+x,-y"; a sign left out is a plus.

        Raises:
            CalibrationError: it is no list of three different axes.
        """
        found = [_AXIS.fullmatch(word) for word in words.split(",")]
        if len(found) != 3 or any(match is None for match in found):
            raise CalibrationError(f"axes {words!r}; expected three of x, y, z with a sign, as in '+z,+x,-y'")
        columns = np.zeros((3, 3))
        for location, match in enumerate(found):
            if match is not None:
                columns["xyz".index(match[2].lower()), location] = -1.0 if match[1] == "-" else 1.0
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
        """Give the (3, 3) float64 matrix that takes declared coordinates into the frame used inside.

        Its determinant is +1, or -1 where the declared frame is left-handed; its transpose takes them back.
        """
        forward, right, up = self.forward_right_up.T
        rows = (right, -up, forward) if kind is SensorKind.CAMERA else (forward, -right, up)
        return read_only(np.array(rows))


_TOLERANCE = 1e-6
_END = np.array([0.0, 0.0, 0.0, 1.0])


class MatrixLayout(StrEnum):
    """In which order the numbers of a matrix stand."""

    ROW_MAJOR = "row-major"
    COLUMN_MAJOR = "column-major"


def possible_layouts(numbers: Sequence[float]) -> tuple[MatrixLayout, ...]:
    """Report in which layouts 16 numbers are a transform; both where its translation is zero.

    A transform ends with the row 0 0 0 1, which stands last in row-major order and is every fourth number in
    column-major order.

    Raises:
        CalibrationError: they are not 16 finite numbers, or a transform in neither layout.

    Source: table 3 of DB34/T 4101-2022, whose example has its translation in the last row.
    """
    given = np.asarray(numbers, np.float64).reshape(-1)
    if given.shape != (16,) or not np.isfinite(given).all():
        raise CalibrationError(f"extrinsic_matrix of {given.size} numbers; expected 16 finite ones")
    square = given.reshape(4, 4)
    ends = {MatrixLayout.ROW_MAJOR: square[3], MatrixLayout.COLUMN_MAJOR: square[:, 3]}
    found = tuple(layout for layout, end in ends.items() if np.abs(end - _END).max() <= _TOLERANCE)
    if not found:
        raise CalibrationError(
            f"extrinsic_matrix with the last row {square[3].tolist()} and the last column {square[:, 3].tolist()}; "
            "expected one of them to be 0 0 0 1"
        )
    return found


def matrix_of(numbers: Sequence[float], layout: MatrixLayout) -> Float64Array:
    """Arrange 16 numbers of a layout as a (4, 4) float64 matrix with the translation in its last column."""
    square = np.asarray(numbers, np.float64).reshape(4, 4)
    return square.copy() if layout is MatrixLayout.ROW_MAJOR else square.T.copy()


def numbers_of(matrix: Float64Array, layout: MatrixLayout = MatrixLayout.COLUMN_MAJOR) -> tuple[float, ...]:
    """Give the 16 numbers of a (4, 4) transform, in the standard's own layout unless stated otherwise."""
    ordered = matrix if layout is MatrixLayout.ROW_MAJOR else matrix.T
    return tuple(ordered.reshape(-1).tolist())


_NO_ROTATION = 2.0
"""Numbers beyond it stand in no rotation."""

SLOPPIEST = 0.02
"""How far a rotation may be from one: matrices are printed with three digits or more."""


def camera_of(data: CalibrationData) -> Camera:
    """Give the camera model of a record: a pinhole, or with coefficients that of Brown and Conrady.

    Raises:
        CalibrationError: the matrix is none of a pinhole without skew, or a focal length is not positive.

    Source: DB34/T 4101-2022, table 3; the coefficients are in the order of OpenCV.
    """
    k = np.array(data.intrinsic_matrix).reshape(3, 3)
    others = np.abs([k[0, 1], k[1, 0], k[2, 0], k[2, 1], k[2, 2] - 1.0])
    if others.max() > 1e-6 * max(1.0, abs(k[0, 0])):
        raise CalibrationError(f"intrinsic_matrix {k.tolist()}; expected fx 0 cx, 0 fy cy, 0 0 1, row after row")
    width, height = data.image_size
    coefficients = tuple(data.distortion_coeffs)
    model, all_of_it = ("brown_conrady", (*coefficients, *[0.0] * 11)) if any(coefficients) else ("pinhole", ())
    fx, fy, cx, cy = k[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return Camera(model, width, height, fx, fy, cx, cy, all_of_it)


def check_calibration(data: CalibrationData) -> None:
    """Refuse what no axes could make a calibration: properties are set one by one, so axes may still change.

    Raises:
        CalibrationError: the numbers are no camera model, or no rotation with a translation in any layout.
    """
    camera_of(data)
    for layout in possible_layouts(data.extrinsic_matrix):
        r = matrix_of(data.extrinsic_matrix, layout)[:3, :3]
        largest = float(np.abs(r).max())  # numbers whose squares overflow are no rotation either
        error = largest if largest > _NO_ROTATION else float(np.abs(r @ r.T - np.eye(3)).max())
        if error > SLOPPIEST:
            raise CalibrationError(
                f"extrinsic_matrix whose rotation is off by {error:.2g}; expected an orthonormal one"
            )


def calibration_data(
    camera: Camera, camera_from_lidar: RigidTransform, camera_axes: DeclaredAxes, lidar_axes: DeclaredAxes
) -> CalibrationData:
    """Write a camera model and a mounting as a record of table 3, in the standard's own layout.

    Raises:
        CalibrationError: table 3 cannot hold the camera model.
    """
    optical = camera_axes.standard_from_declared(SensorKind.CAMERA)
    standard = lidar_axes.standard_from_declared(SensorKind.LIDAR)
    declared = np.eye(4)
    declared[:3, :3] = optical.T @ camera_from_lidar.rotation @ standard
    declared[:3, 3] = optical.T @ camera_from_lidar.translation
    return CalibrationData(
        image_size=(camera.width, camera.height),
        intrinsic_matrix=tuple(camera.matrix.reshape(-1).tolist()),
        reference_frame=0,
        extrinsic_matrix=numbers_of(declared),
        distortion_coeffs=_five_coefficients(camera),
    )


def _five_coefficients(camera: Camera) -> tuple[float, float, float, float, float]:
    if camera.model == "pinhole":
        return (0.0, 0.0, 0.0, 0.0, 0.0)
    held, more = camera.coefficients[:5], camera.coefficients[5:]
    if camera.model != "brown_conrady" or any(more):
        raise CalibrationError(
            f"a {camera.model} camera model with {len(camera.coefficients)} coefficients; table 3 holds k1 k2 p1 p2 "
            f"k3 of a "
            "brown_conrady camera model: fit one to it, or send the camera model by the property `camera_models`"
        )
    k1, k2, p1, p2, k3 = (*held, *[0.0] * (5 - len(held)))
    return (k1, k2, p1, p2, k3)


MOST_PAIRS = 1024
"""Cameras and lidars that one system may relate: every change of a calibration looks at all of them."""

_OWNER = "calibration"
_IDS = ("camera_id", "lidar_id")
_FIELDS = {row.name: row.attribute for row in CALIBRATION.rows}


@dataclass(frozen=True, slots=True)
class CalibrationEntry:
    """A record of table 3 and the sensors that it is of.

    Attributes:
        camera_id, lidar_id: 0 to 255.
        data: the record.
    """

    camera_id: int
    lidar_id: int
    data: CalibrationData


def parse_calibrations(text: str) -> tuple[CalibrationEntry, ...]:
    """Read the property; an empty text holds none.

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
    check_calibration(data)
    return CalibrationEntry(camera_id, lidar_id, data)


def format_calibrations(entries: tuple[CalibrationEntry, ...]) -> str:
    """Write the property's text, which `parse_calibrations` reads back."""
    items = [{"camera_id": e.camera_id, "lidar_id": e.lidar_id, **asdict(e.data)} for e in entries]
    return msgspec.json.encode(items).decode()


CAMERA_MODELS = "camera_models"
"""Name of the property, a string that a session adds where it needs it."""


@dataclass(frozen=True, slots=True)
class CalibrationTable:
    """Calibrations by camera and lidar; never edited, so that a frame keeps those in force when it came.

    Attributes:
        entries: by (camera_id, lidar_id).
    """

    entries: Mapping[tuple[int, int], CalibrationEntry] = field(default_factory=lambda: MappingProxyType({}))

    def having(self, entries: Iterable[CalibrationEntry]) -> "CalibrationTable":
        """The table with further entries, which replace those of the same sensors."""
        added = {(entry.camera_id, entry.lidar_id): entry for entry in entries}
        return replace(self, entries=MappingProxyType({**self.entries, **added}))

    @property
    def camera_ids(self) -> tuple[int, ...]:
        """All cameras, ascending."""
        return tuple(sorted({camera_id for camera_id, _ in self.entries}))

    @property
    def lidar_ids(self) -> tuple[int, ...]:
        """All lidars, ascending."""
        return tuple(sorted({lidar_id for _, lidar_id in self.entries}))
