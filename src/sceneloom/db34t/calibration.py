"""Calibrations of DB34/T 4101-2022: from table 3 and the declared axes to camera models and extrinsics, and back."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
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
class CalibratedPair:
    """A camera and a lidar in the frames used inside.

    Attributes:
        camera: the camera model.
        camera_from_lidar: takes points of the lidar (x forward, y left, z up) into the optical frame.
        notes: what looks wrong, for people.
    """

    camera: Camera
    camera_from_lidar: RigidTransform
    notes: tuple[str, ...] = ()

    @cached_property
    def lidar_from_camera(self) -> RigidTransform:
        """The inverse; always the same object."""
        return self.camera_from_lidar.inverse()


_SUSPECT_DEG = 45.0
_CAMERA_FROM_LIDAR_FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Of a camera that looks forward: optical axes from x forward, y left, z up."""


def calibrated_pair(
    data: CalibrationData, camera_axes: DeclaredAxes, lidar_axes: DeclaredAxes, *, camera_model: Camera | None = None
) -> CalibratedPair:
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
    return CalibratedPair(camera_model or _camera_of(data), transform, (note,) if off_deg > _SUSPECT_DEG else ())


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


def read_by_sensor(text: str, owner: str, example: str) -> dict[int, Any]:
    """Read a property that describes sensors: a JSON object by sensor number, as `example`; {} for an empty text.

    Raises:
        DataError: it is none, or a name is no number from 0 to 255.
    """
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
