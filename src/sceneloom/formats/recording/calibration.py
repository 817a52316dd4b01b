"""`calibration.json` and the calibration of single frames: intrinsics, extrinsics, entries of the device."""

from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import msgspec
import numpy as np
from msgspec import Meta, Struct, structs

from sceneloom.arrays import Float64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError, SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.recording.json_faults import BYTE_ORDER_MARK, DECODER_FAULTS, json_fault, json_problem
from sceneloom.formats.recording.legacy import read_old_calibration
from sceneloom.formats.recording.lines import FrameColumns, SensorIndex, note_mark
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import GREATEST_ERROR, SILENT_ERROR, nearest_rotation
from sceneloom.warnings import WarningKind

_MatrixNumbers = list[float | list[float]]
"""A matrix as JSON has it: rows of four (or three) numbers, or sixteen (or nine) numbers column by column."""

_SIZES: Mapping[int, int] = {16: 4, 9: 3}
"""By how many numbers a flat matrix has, its rows. Nine are a rotation alone.

Source: `imuToCameraMatrix` in `codegen/parameter_definitions.c` of HybVIO, which takes both column by column.
"""

_LAST_ROW_ERROR = 1e-6
_LARGEST_ELEMENT = 2.0
_FARTHEST = 1e6


def rigid_transform(numbers: _MatrixNumbers, location: str, ledger: Ledger) -> RigidTransform:
    """Read a 4x4 matrix, rows of four or sixteen numbers column by column, or a 3x3 one, which moves nothing.

    Args:
        location: file and path of the matrix, for messages.
        ledger: takes the warning of a rotation that had to be normalised.

    Raises:
        CalibrationError: it is no such matrix, or not rigid.
    """
    matrix = _square(numbers, location)
    if not (np.abs(matrix[3] - [0, 0, 0, 1]) <= _LAST_ROW_ERROR).all():
        hint = "; is it transposed?" if (matrix[:3, 3] == 0).all() else ""
        raise CalibrationError(f"{location}: last row {matrix[3].tolist()}; expected 0, 0, 0, 1{hint}")
    _check_sizes(matrix, location)
    rotation, error = nearest_rotation(matrix[:3, :3])
    if not error <= GREATEST_ERROR:
        problem = "mirrored or singular" if error == float("inf") else f"off by {error:.2g}"
        raise CalibrationError(
            f"{location}: rotation {problem}; expected an orthonormal right-handed one within {GREATEST_ERROR:g}"
        )
    if error > SILENT_ERROR:
        message = f"rotation off by {error:.2g} (max abs of R Rᵀ - I); the nearest rotation was taken"
        ledger.note(WarningKind.REPAIRED, "rotation-normalised", location, message)
    return RigidTransform(rotation, matrix[:3, 3].copy())


def _check_sizes(matrix: Float64Array, location: str) -> None:
    """Refuse numbers so large that the arithmetic of the checks to come would overflow."""
    largest, farthest = np.abs(matrix[:3, :3]).max(), np.abs(matrix[:3, 3]).max()
    if largest > _LARGEST_ELEMENT:
        raise CalibrationError(f"{location}: rotation holds {largest:g}; expected numbers from -1 to 1")
    if farthest > _FARTHEST:
        raise CalibrationError(f"{location}: translation holds {farthest:g}; expected metres within {_FARTHEST:g}")


def _square(numbers: _MatrixNumbers, location: str) -> Float64Array:
    rows = [row for row in numbers if isinstance(row, list)]
    size = len(rows) or _SIZES.get(len(numbers), 0)
    if size not in _SIZES.values() or (rows and [len(row) for row in rows] != [size] * len(numbers)):
        shape = f"{len(numbers)} rows" if rows else f"{len(numbers)} numbers"
        raise CalibrationError(f"{location}: {shape}; expected 4 rows of 4 numbers, or 16 numbers column by column")
    given = np.array(rows, np.float64) if rows else np.array(numbers, np.float64).reshape(size, size).T
    if not np.isfinite(given).all():
        raise CalibrationError(f"{location}: a number is not finite; expected 4x4 finite numbers")
    matrix = np.eye(4)
    matrix[:size, :size] = given
    return matrix


_Coefficients = tuple[float, ...]


class CameraParameters(Struct, frozen=True):
    """The camera model of an entry in `calibration.json` or of a `cameraParameters`; None for what is not stated.

    Source: "Calibration format" of the recording format's description; `distortionModel` is the word of its lines.
    """

    model: str | None = None
    distortionModel: str | None = None  # noqa: N815 - the format's own word
    distortionCoefficients: list[float] | None = None  # noqa: N815 - the format's own word
    focalLengthX: float | None = None  # noqa: N815 - the format's own word
    focalLengthY: float | None = None  # noqa: N815 - the format's own word
    focalLength: float | None = None  # noqa: N815 - the word of old recordings, for both
    principalPointX: float | None = None  # noqa: N815 - the format's own word
    principalPointY: float | None = None  # noqa: N815 - the format's own word
    imageWidth: int | float | None = None  # noqa: N815 - the format's own word
    imageHeight: int | float | None = None  # noqa: N815 - the format's own word

    @property
    def has_size(self) -> bool:
        """Whether the image size is stated."""
        return self.imageWidth is not None and self.imageHeight is not None

    @property
    def camera_model_model(self) -> str | None:
        """The model under either of its keys."""
        return self.distortionModel if self.model is None else self.model

    def with_both_focal_lengths(self) -> "CameraParameters":
        """The same camera model, one focal length for both axes reported as two."""
        if self.focalLength is None or (self.focalLengthX, self.focalLengthY) != (None, None):
            return self
        both = self.focalLength
        return structs.replace(self, focalLength=None, focalLengthX=both, focalLengthY=both)

    def over(self, base: "CameraParameters") -> "CameraParameters":
        """These parameters, and those of `base` where they state nothing.

        The coefficients of the base hold for a camera model of its own model only, and its image size for focal lengths
        and a principal point of its own only: whole parameters without a size are those of the images as they are.
        """
        own = (self.focalLengthX, self.focalLengthY, self.principalPointX, self.principalPointY)
        if all(value is not None for value in own):
            base = structs.replace(base, imageWidth=None, imageHeight=None)
        stated = {name: value for name, value in structs.asdict(self).items() if value is not None}
        if self.camera_model_model is not None:
            same = base.camera_model_model is not None and _plain(base.camera_model_model) == _plain(
                self.camera_model_model
            )
            kept = base.distortionCoefficients if same else None
            base = structs.replace(base, model=None, distortionModel=None, distortionCoefficients=kept)
        return structs.replace(base, **stated)


def _no_distortion(_: _Coefficients) -> _Coefficients:
    return ()


def _as_given(coefficients: _Coefficients) -> _Coefficients:
    return coefficients


def _radial(coefficients: _Coefficients) -> _Coefficients:
    """k1 k2 k3 become k1 k2 p1 p2 k3."""
    return (*coefficients[:2], 0.0, 0.0, *coefficients[2:])


def _with_prism_and_tilt(coefficients: _Coefficients) -> _Coefficients:
    """After the eight of the rational model come lx ly of ours, which the format does not have."""
    return (*coefficients[:8], 0.0, 0.0, *coefficients[8:])


class _Reading(NamedTuple):
    model: str
    coefficients: Callable[[_Coefficients], _Coefficients]


CAMERA_MODEL_READINGS: Mapping[str, Mapping[int, _Reading]] = {
    "pinhole": {0: _Reading("pinhole", _no_distortion), 3: _Reading("brown_conrady", _radial)},
    "brown-conrady": {
        5: _Reading("brown_conrady", _as_given),
        8: _Reading("brown_conrady", _as_given),
        14: _Reading("brown_conrady", _with_prism_and_tilt),
    },
    "kannala-brandt4": {0: _Reading("fisheye", _as_given), 4: _Reading("fisheye", _as_given)},
    "kannala-brandt18": {
        0: _Reading("kannala_brandt18", _as_given),
        4: _Reading("kannala_brandt18", _as_given),
        18: _Reading("kannala_brandt18", _as_given),
    },
    "omnidir": {6: _Reading("omnidir", _as_given)},
}
"""By the format's name of a model and its number of coefficients: our model, and our order of them. The orders of
`kannala_brandt18` (k0-k3 l1-l3 i1-i4 m1-m3 j1-j4) and `omnidir` (k1 k2 s xi p1 p2) are the format's own.

Source: the models that the vendor's software knows, as docs/CONVENTIONS.md lists them.
"""


@lru_cache(maxsize=64)
def _plain(name: str) -> str:
    return "".join(letter for letter in name.lower() if letter.isalnum())


_SPELLINGS = {_plain(name): name for name in CAMERA_MODEL_READINGS}


def camera_model(parameters: CameraParameters, image_size: tuple[int, int] | None, location: str) -> Camera:
    """Build the camera model, for the calibrated image size.

    Args:
        image_size: width and height of the images [px], which stand in where the calibration names none.
        location: file and path of the parameters, for messages.

    Raises:
        CalibrationError: a number is missing or impossible, or the model is unknown.
    """
    reading, coefficients = _reading(parameters, location)
    width, height = _calibrated_size(parameters, location) or image_size or (0, 0)
    if width == 0:
        raise CalibrationError(f"{location}: no imageWidth and imageHeight, and no image that would report them")
    fx, fy = _required(parameters, "focalLengthX", location), _required(parameters, "focalLengthY", location)
    cx, cy = (
        _required(parameters, "principalPointX", location),
        _required(parameters, "principalPointY", location),
    )
    try:
        return Camera(reading.model, width, height, fx, fy, cx, cy, reading.coefficients(coefficients))
    except CalibrationError as error:
        raise CalibrationError(f"{location}: {error}") from error


def _reading(parameters: CameraParameters, location: str) -> tuple[_Reading, _Coefficients]:
    name = parameters.camera_model_model
    if name is None:
        raise CalibrationError(f"{location}.model: missing; expected one of: {', '.join(CAMERA_MODEL_READINGS)}")
    known = _SPELLINGS.get(_plain(name))
    if known is None:
        raise CalibrationError(f"{location}.model: {name!r}; expected one of: {', '.join(CAMERA_MODEL_READINGS)}")
    readings = CAMERA_MODEL_READINGS[known]
    coefficients = tuple(map(float, parameters.distortionCoefficients or ()))
    if len(coefficients) not in readings:
        counts = " or ".join(map(str, readings))
        raise CalibrationError(
            f"{location}.distortionCoefficients: {len(coefficients)} numbers; expected {counts} for {name!r}"
        )
    return readings[len(coefficients)], coefficients


def _calibrated_size(parameters: CameraParameters, location: str) -> tuple[int, int] | None:
    if parameters.imageWidth is None or parameters.imageHeight is None:
        return None
    size = (parameters.imageWidth, parameters.imageHeight)
    if any(number != int(number) or number <= 0 for number in size):
        raise CalibrationError(f"{location}: imageWidth, imageHeight {size}; expected positive whole numbers of pixels")
    return int(size[0]), int(size[1])


def _required(parameters: CameraParameters, name: str, location: str) -> float:
    value = getattr(parameters, name)
    if value is None:
        raise CalibrationError(f"{location}.{name}: missing; expected a number of pixels")
    return float(value)


_SHORTEST = 1e-6


class Vector(msgspec.Struct, frozen=True):
    """Three numbers by name."""

    x: float
    y: float
    z: float


@dataclass(frozen=True, slots=True, eq=False)
class _RigCalibration:
    """The fields at the root of a `calibration.json`; None for what is not stated.

    Attributes:
        output_from_imu: `imuToOutput`, to the frame whose poses the vendor's software puts out.
        gnss_from_imu: `imuToGnss`, to the antenna of the satellite receiver.
        magnetometer_from_imu: `imuToMagnetometer`.
        forward_imu: `imuForward`, (3,) float64, unit: the trajectory that the vehicle drives, in the IMU's frame.
    """

    output_from_imu: RigidTransform | None = None
    gnss_from_imu: RigidTransform | None = None
    magnetometer_from_imu: RigidTransform | None = None
    forward_imu: Float64Array | None = None


def _read_rig(path: Path, content: Mapping[str, Any], ledger: Ledger) -> _RigCalibration:
    """Read what a calibration says of the whole device; its poses are taken as those of the IMU.

    Raises:
        DataError: a field has a value of the wrong type.
        CalibrationError: a transform is not rigid, or a vector has no direction.
    """
    read = {
        "imuToOutput": _transform,
        "imuToGnss": _transform_or_location,
        "imuToMagnetometer": _transform,
        "imuForward": _direction,
    }
    found: dict[str, Any] = dict.fromkeys(read)
    for name, reading in read.items():
        if content.get(name) is None:
            continue
        try:
            found[name] = reading(path, name, content[name], ledger)
        except (DataError, CalibrationError) as error:
            ledger.fault("unusable-calibrations", error)
    output = found["imuToOutput"]
    if output is not None and not np.allclose(output.matrix, np.eye(4)):
        message = "imuToOutput is not the identity; the poses of all lines are taken as those of the IMU"
        ledger.note(WarningKind.ASSUMED, "poses-of-imu", f"{path}: imuToOutput", message)
    return _RigCalibration(*found.values())


def _transform(path: Path, name: str, value: object, ledger: Ledger) -> RigidTransform:
    return rigid_transform(_converted(path, name, value, _MatrixNumbers), f"{path}: {name}", ledger)


def _transform_or_location(path: Path, name: str, value: object, ledger: Ledger) -> RigidTransform:
    """Read a matrix, or the antenna's location in the IMU's frame as the vendor's recorders take it."""
    if isinstance(value, list) and (len(value) != 3 or any(isinstance(number, list) for number in value)):
        return _transform(path, name, value, ledger)
    position_imu = _vector(path, name, value)
    message = f"{name} is a vector: taken to be where the antenna is, in the IMU's frame"
    ledger.note(WarningKind.ASSUMED, "antenna-location", f"{path}: {name}", message)
    return RigidTransform(np.eye(3), -position_imu)


def _direction(path: Path, name: str, value: object, ledger: Ledger) -> Float64Array:
    del ledger
    vector = _vector(path, name, value)
    length = float(np.linalg.norm(vector))
    if length < _SHORTEST:
        raise CalibrationError(f"{path}: {name}: {vector.tolist()}; expected a direction")
    return read_only(vector / length)


def _vector(path: Path, name: str, value: object) -> Float64Array:
    if isinstance(value, dict):
        named: Vector = _converted(path, name, value, Vector)
        numbers = [named.x, named.y, named.z]
    else:
        numbers = _converted(path, name, value, list[float])
    if len(numbers) != 3 or not all(abs(number) <= _FARTHEST for number in numbers):
        raise CalibrationError(f"{path}: {name}: {numbers}; expected three numbers within {_FARTHEST:g}")
    return np.array(numbers, np.float64)


def _converted(path: Path, name: str, value: object, shape: Any) -> Any:
    try:
        return msgspec.convert(value, shape)
    except DECODER_FAULTS as error:
        raise DataError(path, *json_fault(error, msgspec.json.encode(value), prefix=name)) from error


CALIBRATION_FILE = "calibration.json"

_Duration = Annotated[float, Meta(ge=0, le=10)]
"""How long an image takes [s]."""

_SAME_MATRIX = 1e-6
"""Elements of two matrices that are closer are the same number, written with other digits."""

_Shift = Annotated[float, Meta(ge=-1e6, le=1e6)]


class CameraEntry(CameraParameters, frozen=True):
    """One of `cameras`, as far as it is used here; the text of the format calls the matrix `imuToCameraMatrix`."""

    imuToCamera: _MatrixNumbers | None = None  # noqa: N815 - the format's own word
    imuToCameraMatrix: _MatrixNumbers | None = None  # noqa: N815 - the format's own word
    imuToCameraShiftSeconds: _Shift | None = None  # noqa: N815 - the format's own word
    shutterRollTimeSeconds: _Duration | None = None  # noqa: N815 - the format's own word
    rollingShutterLeftToRight: bool | None = None  # noqa: N815 - the format's own word
    exposureTimeSeconds: _Duration | None = None  # noqa: N815 - the format's own word


class LidarEntry(msgspec.Struct, frozen=True):
    """One of `lidars`, as far as it is used here."""

    lidarInd: SensorIndex = 0  # noqa: N815 - as `cameraInd`; our extension for several lidars
    imuToLidar: _MatrixNumbers | None = None  # noqa: N815 - the format's own word
    imuToLidarMatrix: _MatrixNumbers | None = None  # noqa: N815 - as the cameras' word


_Entry = TypeVar("_Entry", CameraEntry, LidarEntry)


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """A camera of the calibration.

    Attributes:
        location: file and path of the entry, for messages.
        parameters: the camera model.
        camera_from_imu: the mounting, or None where the entry has none.
        shift: `imuToCameraShiftSeconds` [s], 0 where the entry has none.
        entry: all of the entry, as the file has it.
    """

    location: str
    parameters: CameraParameters
    camera_from_imu: RigidTransform | None = None
    shift: float = 0.0
    entry: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class LidarCalibration:
    """A lidar of the calibration; `lidar_from_imu` is None where the entry has no mounting."""

    location: str
    lidar_from_imu: RigidTransform | None = None
    entry: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A whole calibration; empty where the recording has none.

    Attributes:
        path: where the file is, or would be.
        cameras: by `cameraInd`, which is the location in the list.
        lidars: by `lidarInd`.
        rig: what it says of the device as a whole.
        content: all of the file.
    """

    path: Path
    cameras: Mapping[int, CameraCalibration] = field(default_factory=dict)
    lidars: Mapping[int, LidarCalibration] = field(default_factory=dict)
    rig: _RigCalibration = field(default_factory=_RigCalibration)
    content: Mapping[str, Any] = field(default_factory=dict)


def read_calibration(
    folder: Path, ledger: Ledger, *, data_path: Path | None = None, other_lines: Iterable[str] = ()
) -> Calibration:
    """Read the calibration of a recording; one without the file has what older forms state, or an empty one.

    Args:
        folder: the recording.
        ledger: takes warnings and faults.
        data_path: its lines.
        other_lines: those of them that report no time; old recordings state there how cameras are mounted.

    Raises:
        DataError: the file cannot be read, is no JSON object, or an entry has a value of the wrong type.
        CalibrationError: a mounting is not rigid.
    """
    path = folder / CALIBRATION_FILE
    if not path.exists():
        return _read_old(folder, data_path or folder, other_lines, ledger)
    try:
        content = _read_object(path, ledger)
        listed = {name: _entries(path, content, name) for name in ("cameras", "lidars")}
    except DataError as error:
        ledger.refuse("unreadable-calibration", error)
        return Calibration(path)
    cameras = dict(_cameras(path, listed["cameras"], ledger))
    lidars: dict[int, LidarCalibration] = {}
    for index, lidar in _lidars(path, listed["lidars"], ledger):
        if index in lidars:
            location = lidar.location.removeprefix(f"{path}: ")
            problem = f"lidarInd {index} is used twice; expected each once (absent means 0)"
            ledger.fault("repeated-lidars", DataError(path, location, problem))
            continue
        lidars[index] = lidar
    return Calibration(path, cameras, lidars, _read_rig(path, content, ledger), content)


def _read_old(folder: Path, data_path: Path, other_lines: Iterable[str], ledger: Ledger) -> Calibration:
    path = folder / CALIBRATION_FILE
    try:
        old = read_old_calibration(folder, data_path, other_lines)
    except DataError as error:
        ledger.refuse("unreadable-calibration", error)
        return Calibration(path)
    if not old.content:
        return Calibration(path)
    reported = f"no {CALIBRATION_FILE}; camera models and mountings were taken from an older form"
    for message in (reported, *old.doubts):
        ledger.note(WarningKind.ASSUMED, "old-calibration", str(old.path), message)
    cameras = dict(_cameras(old.path, old.content["cameras"], ledger))
    return Calibration(path, cameras, content=old.content)


def _read_object(path: Path, ledger: Ledger) -> Mapping[str, Any]:
    try:
        text = read_bytes(path)
        note_mark(text, path, ledger)
        text = text.removeprefix(BYTE_ORDER_MARK)
        content = msgspec.json.decode(text)
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror}") from error
    except DECODER_FAULTS as error:
        raise DataError(path, "", json_problem(error, text)) from error
    if not isinstance(content, dict):
        raise DataError(path, "", f"a JSON {type(content).__name__}; expected an object with `cameras`")
    return content


def _cameras(path: Path, items: list[Any], ledger: Ledger) -> Iterator[tuple[int, CameraCalibration]]:
    for index, item in enumerate(items):
        name = f"cameras[{index}]"
        try:
            entry = _convert(path, name, item, CameraEntry)
            location = f"{path}: {name}"
            matrices = {"imuToCamera": entry.imuToCamera, "imuToCameraMatrix": entry.imuToCameraMatrix}
            camera_from_imu = _mount(path, name, matrices, ledger)
        except (DataError, CalibrationError) as error:
            ledger.fault("unusable-calibrations", error)
            continue
        shift = entry.imuToCameraShiftSeconds or 0.0
        yield index, CameraCalibration(location, entry, camera_from_imu, shift, item)


def _lidars(path: Path, items: list[Any], ledger: Ledger) -> Iterator[tuple[int, LidarCalibration]]:
    for index, item in enumerate(items):
        name = f"lidars[{index}]"
        try:
            entry = _convert(path, name, item, LidarEntry)
            location = f"{path}: {name}"
            matrices = {"imuToLidar": entry.imuToLidar, "imuToLidarMatrix": entry.imuToLidarMatrix}
            lidar_from_imu = _mount(path, name, matrices, ledger)
        except (DataError, CalibrationError) as error:
            ledger.fault("unusable-calibrations", error)
            continue
        yield entry.lidarInd, LidarCalibration(location, lidar_from_imu, item)


def _mount(
    path: Path, entry: str, matrices: Mapping[str, _MatrixNumbers | None], ledger: Ledger
) -> RigidTransform | None:
    """Read the matrix that an entry has under one of two keys; where both state different things, the first is taken.

    Raises:
        DataError: they differ, and the reading is not lenient.
        CalibrationError: a matrix is not rigid.
    """
    found = {
        key: rigid_transform(matrix, f"{path}: {entry}.{key}", ledger)
        for key, matrix in matrices.items()
        if matrix is not None
    }
    if not found:
        return None
    (key, first), *others = found.items()
    for other, second in others:
        apart = float(np.abs(first.matrix - second.matrix).max())
        if apart > _SAME_MATRIX:
            problem = f"differs from {key} by up to {apart:.3g}; expected one of the two, or the same numbers in both"
            ledger.fault("contradicting-mounts", DataError(path, f"{entry}.{other}", problem))
    return first


def _entries(path: Path, content: Mapping[str, Any], name: str) -> list[Any]:
    entries = content.get(name)
    if entries is None:
        return []
    if not isinstance(entries, list):
        raise DataError(path, name, f"{type(entries).__name__}; expected a list of objects")
    return entries


def _convert(path: Path, location: str, item: object, shape: type[_Entry]) -> _Entry:
    try:
        return msgspec.convert(item, shape)
    except DECODER_FAULTS as error:
        raise DataError(path, *json_fault(error, msgspec.json.encode(item), prefix=location)) from error


_Value = TypeVar("_Value")


def read_texts(
    frames: FrameColumns,
    rows: "array[int]",
    chosen: "array[int]",
    read: Callable[[bytes, int], _Value],
    ledger: Ledger,
) -> dict[int, _Value]:
    """Read every text that a camera's entries have.

    Args:
        frames: all frames lines, with all texts.
        rows: which frames line each entry is in.
        chosen: which text each entry has, -1 for none.
        read: reads a text, given the number of the first line that has it.
        ledger: takes faults.

    Returns:
        By index of the text; unusable ones are not in it.

    Raises:
        SceneloomError: a text is unusable and the reading is not lenient.
    """
    texts, numbers = list(frames.texts), np.asarray(chosen, np.int64)
    values: dict[int, _Value] = {}
    indices, first_rows = np.unique(numbers, return_index=True)
    for index, row in zip(indices.tolist(), first_rows.tolist(), strict=True):
        if index < 0:
            continue
        try:
            values[index] = read(texts[index], frames.lines[rows[row]])
        except SceneloomError as error:
            ledger.fault("unusable-frame-parameters", error, count=int((numbers == index).sum()))
    return values


def read_parameters(text: bytes, line: int, *, path: Path) -> CameraParameters:
    """Read a `cameraParameters`.

    Raises:
        DataError: it is no object, or a value has the wrong type.
    """
    try:
        return msgspec.json.decode(text, type=CameraParameters).with_both_focal_lengths()
    except DECODER_FAULTS as error:
        problem = json_problem(error, text, prefix="frames[].cameraParameters")
        raise DataError(path, f"line {line}", problem) from error


def read_mount(text: bytes, line: int, *, path: Path, ledger: Ledger) -> RigidTransform:
    """Read an `imuToCamera` of a line; gives `ego_from_camera`.

    Raises:
        DataError: it is no matrix.
        CalibrationError: it is not rigid.
    """
    try:
        numbers = msgspec.json.decode(text, type=_MatrixNumbers)
    except DECODER_FAULTS as error:
        problem = json_problem(error, text, prefix="frames[].imuToCamera")
        raise DataError(path, f"line {line}", problem) from error
    return rigid_transform(numbers, f"{path}: line {line}: frames[].imuToCamera", ledger).inverse()
