"""`calibration.json`, the calibration of single frames, and what recordings from before that file state instead."""

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
from sceneloom.formats.base.files import FileIdentity, open_file, read_bytes
from sceneloom.formats.recording.json_faults import BYTE_ORDER_MARK, DECODER_FAULTS, json_fault, json_problem, note_mark
from sceneloom.formats.recording.lines import FrameColumns, Origin, Point, RecordingColumns, SensorIndex
from sceneloom.geometry.rigid import GREATEST_ERROR, SILENT_ERROR, RigidTransform, nearest_rotation
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.warnings import WarningKind

CALIBRATION_FILE = "calibration.json"
PARAMETERS_FILE = "parameters.txt"

_MatrixNumbers = list[float | list[float]]
"""A matrix as JSON has it: rows of four (or three) numbers, or sixteen (or nine) numbers column by column."""

_SIZES: Mapping[int, int] = {16: 4, 9: 3}
"""Rows of a flat matrix by how many numbers it has, column by column. Nine are a rotation alone.
Source: `imuToCameraMatrix` in `codegen/parameter_definitions.c` of HybVIO."""

_LAST_ROW_ERROR = 1e-6
_LARGEST_ELEMENT = 2.0
_FARTHEST = 1e6


def rigid_transform(numbers: _MatrixNumbers, location: str, ledger: Ledger) -> RigidTransform:
    """Read a 4x4 matrix, rows of four or sixteen numbers column by column, or a 3x3 one, which is a rotation alone.

    Args:
        location: file and path of the matrix, for messages.
        ledger: takes the warning of a rotation that had to be normalised.

    Raises:
        CalibrationError: it is no such matrix, or not rigid.
    """
    rows = [row for row in numbers if isinstance(row, list)]
    size = len(rows) or _SIZES.get(len(numbers), 0)
    if size not in _SIZES.values() or (rows and [len(row) for row in rows] != [size] * len(numbers)):
        shape = f"{len(numbers)} rows" if rows else f"{len(numbers)} numbers"
        raise CalibrationError(f"{location}: {shape}; expected 4 rows of 4 numbers, or 16 numbers column by column")
    matrix = np.eye(4)
    matrix[:size, :size] = rows or np.array(numbers, np.float64).reshape(size, size).T
    if not np.isfinite(matrix).all():
        raise CalibrationError(f"{location}: a number is not finite; expected 4x4 finite numbers")
    if not (np.abs(matrix[3] - [0, 0, 0, 1]) <= _LAST_ROW_ERROR).all():
        hint = "; is it transposed?" if (matrix[:3, 3] == 0).all() else ""
        raise CalibrationError(f"{location}: last row {matrix[3].tolist()}; expected 0, 0, 0, 1{hint}")
    # the arithmetic of the checks to come must not overflow
    largest, farthest = np.abs(matrix[:3, :3]).max(), np.abs(matrix[:3, 3]).max()
    if largest > _LARGEST_ELEMENT:
        raise CalibrationError(f"{location}: rotation holds {largest:g}; expected numbers from -1 to 1")
    if farthest > _FARTHEST:
        raise CalibrationError(f"{location}: translation holds {farthest:g}; expected metres within {_FARTHEST:g}")
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
    def model_name(self) -> str | None:
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
        if self.model_name is not None:
            same = base.model_name is not None and _plain(base.model_name) == _plain(self.model_name)
            kept = base.distortionCoefficients if same else None
            base = structs.replace(base, model=None, distortionModel=None, distortionCoefficients=kept)
        return structs.replace(base, **stated)


class _Reading(NamedTuple):
    """Our model, and which of the format's coefficients it takes in order; -1 for one that is 0."""

    model: str
    taken: tuple[int, ...] | None = None


_RADIAL = _Reading("brown_conrady", (0, 1, -1, -1, 2))  # k1 k2 k3 become k1 k2 p1 p2 k3

_PRISM_AND_TILT = _Reading("brown_conrady", (*range(8), -1, -1, *range(8, 14)))
"""After the eight of the rational model come lx ly of ours, which the format does not have."""

CAMERA_MODEL_READINGS: Mapping[str, Mapping[int, _Reading]] = {
    "pinhole": {0: _Reading("pinhole"), 3: _RADIAL},
    "brown-conrady": {5: _Reading("brown_conrady"), 8: _Reading("brown_conrady"), 14: _PRISM_AND_TILT},
    "kannala-brandt4": dict.fromkeys((0, 4), _Reading("fisheye")),
    "kannala-brandt18": dict.fromkeys((0, 4, 18), _Reading("kannala_brandt18")),
    "omnidir": {6: _Reading("omnidir")},
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
    name, known = parameters.model_name, ", ".join(CAMERA_MODEL_READINGS)
    readings = None if name is None else CAMERA_MODEL_READINGS.get(_SPELLINGS.get(_plain(name), ""))
    if readings is None:
        raise CalibrationError(
            f"{location}.model: {'missing' if name is None else repr(name)}; expected one of: {known}"
        )
    given = tuple(map(float, parameters.distortionCoefficients or ()))
    if len(given) not in readings:
        counts = " or ".join(map(str, readings))
        problem = f"{len(given)} numbers; expected {counts} for {name!r}"
        raise CalibrationError(f"{location}.distortionCoefficients: {problem}")
    reading = readings[len(given)]
    coefficients = given if reading.taken is None else tuple(0.0 if k < 0 else given[k] for k in reading.taken)
    size: Any = image_size
    if parameters.has_size:
        size = (parameters.imageWidth, parameters.imageHeight)
        if any(number != int(number) or number <= 0 for number in size):
            problem = f"imageWidth, imageHeight {size}; expected positive whole numbers of pixels"
            raise CalibrationError(f"{location}: {problem}")
    if size is None:
        raise CalibrationError(f"{location}: no imageWidth and imageHeight, and no image to take them from")
    p, numbers = parameters, ("focalLengthX", "focalLengthY", "principalPointX", "principalPointY")
    missing = next((number for number in numbers if getattr(p, number) is None), None)
    if missing is not None:
        raise CalibrationError(f"{location}.{missing}: missing; expected a number of pixels")
    fx, fy, cx, cy = (float(getattr(p, number)) for number in numbers)
    try:
        return Camera(reading.model, int(size[0]), int(size[1]), fx, fy, cx, cy, coefficients)
    except CalibrationError as error:
        raise CalibrationError(f"{location}: {error}") from error


_SHORTEST = 1e-6

_SAME_MATRIX = 1e-6  # elements of two matrices that are closer are the same number, written with other digits

_Duration = Annotated[float, Meta(ge=0, le=10)]  # how long an image takes [s]

_Shift = Annotated[float, Meta(ge=-1e6, le=1e6)]
_Value = TypeVar("_Value")


class CameraEntry(CameraParameters, frozen=True):
    """One of `cameras`, as far as it is used here; the text of the format calls the matrix `imuToCameraMatrix`."""

    imuToCamera: _MatrixNumbers | None = None  # noqa: N815 - the format's own word
    imuToCameraMatrix: _MatrixNumbers | None = None  # noqa: N815 - the format's own word
    imuToCameraShiftSeconds: _Shift | None = None  # noqa: N815 - the format's own word
    shutterRollTimeSeconds: _Duration | None = None  # noqa: N815 - the format's own word
    rollingShutterLeftToRight: bool | None = None  # noqa: N815 - the format's own word
    exposureTimeSeconds: _Duration | None = None  # noqa: N815 - the format's own word


class LidarEntry(Struct, frozen=True):
    """One of `lidars`, as far as it is used here."""

    lidarInd: SensorIndex = 0  # noqa: N815 - as `cameraInd`; our extension for several lidars
    imuToLidar: _MatrixNumbers | None = None  # noqa: N815 - the format's own word
    imuToLidarMatrix: _MatrixNumbers | None = None  # noqa: N815 - as the cameras' word


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
class _RigCalibration:
    """The fields at the root of a `calibration.json`; None for what is not stated."""

    output_from_imu: RigidTransform | None = None  # `imuToOutput`, to the frame of the vendor's poses
    gnss_from_imu: RigidTransform | None = None  # `imuToGnss`, to the receiver's antenna
    magnetometer_from_imu: RigidTransform | None = None  # `imuToMagnetometer`
    forward_imu: Float64Array | None = None  # `imuForward`, (3,), unit: the driving direction in the IMU's frame


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A whole calibration; empty where the recording has none.

    Attributes:
        path: where the file is, or would be.
        cameras: by `cameraInd`, which is the index in the list.
        lidars: by `lidarInd`.
        rig: what it says of the device as a whole.
        content: all of the file.
    """

    path: Path
    cameras: Mapping[int, CameraCalibration] = field(default_factory=dict)
    lidars: Mapping[int, LidarCalibration] = field(default_factory=dict)
    rig: _RigCalibration = field(default_factory=_RigCalibration)
    content: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class RecordingContents:
    """What was read of a recording before its sensors are built.

    Attributes:
        folder: where its files are.
        data_path: its lines, `data.jsonl`.
        data_file: the same, as it was when its lines were read.
        alone: whether that file is all there is, and nothing beside it belongs to it.
        columns: its lines.
        calibration: its `calibration.json`.
        trajectories: by root key and name of their lines.
        ego_path: `world_from_ego` of the default trajectory, or None.
        ledger: takes warnings and faults.
        camera_shift: what becomes of `imuToCameraShiftSeconds`, an option of reading.
        image_index: which image a `frames` line means, an option of reading.
    """

    folder: Path
    data_path: Path
    data_file: FileIdentity
    alone: bool
    columns: RecordingColumns
    calibration: Calibration
    trajectories: Mapping[Origin, Trajectory]
    ego_path: Poses | None
    ledger: Ledger
    camera_shift: str
    image_index: str

    @property
    def data_name(self) -> str:
        """Name of the file of the lines."""
        return self.data_path.name


def read_calibration(folder: Path, ledger: Ledger, *, data_path: Path, other_lines: Iterable[str]) -> Calibration:
    """Read the calibration of a recording; one without the file has what older forms state, or an empty one.

    Args:
        folder: the recording.
        ledger: takes warnings and faults.
        data_path: its lines.
        other_lines: those of them that hold no record; old recordings state there how cameras are mounted.

    Raises:
        DataError: the file cannot be read, is no JSON object, or an entry has a value of the wrong type.
        CalibrationError: a mounting is not rigid.
    """
    path, doubts = folder / CALIBRATION_FILE, list[str]()
    is_old = not path.exists()
    try:
        content = _old_content(folder, other_lines, doubts) if is_old else _read_object(path, ledger)
    except DataError as error:
        ledger.refuse("unreadable-calibration", error)
        return Calibration(path)
    if not content:
        return Calibration(path)
    if is_old:
        path = folder / PARAMETERS_FILE if (folder / PARAMETERS_FILE).is_file() else data_path
        first = f"no {CALIBRATION_FILE}; camera models and mountings were taken from an older form"
        for message in (first, *doubts):
            ledger.note(WarningKind.ASSUMED, "old-calibration", str(path), message)
    reader = _Reader(path, ledger)
    cameras, lidars = dict[int, CameraCalibration](), dict[int, LidarCalibration]()
    for k, location, item, camera, mount in reader.entries(content, "cameras", CameraEntry, "imuToCamera"):
        cameras[k] = CameraCalibration(location, camera, mount, camera.imuToCameraShiftSeconds or 0.0, item)
    for k, location, item, lidar, mount in reader.entries(content, "lidars", LidarEntry, "imuToLidar"):
        if lidar.lidarInd in lidars:
            problem = f"lidarInd {lidar.lidarInd} is used twice; expected each once (absent means 0)"
            ledger.fault("repeated-lidars", DataError(path, f"lidars[{k}]", problem))
        else:
            lidars[lidar.lidarInd] = LidarCalibration(location, mount, item)
    return Calibration(path, cameras, lidars, reader.rig(content), content)


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
    for name in ("cameras", "lidars"):
        if not isinstance(content.get(name), list | None):
            raise DataError(path, name, f"{type(content[name]).__name__}; expected a list of objects")
    return content


@dataclass(frozen=True, slots=True)
class _Reader:
    """Reads the parts of one file; faults go to the ledger."""

    path: Path
    ledger: Ledger

    def entries(
        self, content: Mapping[str, Any], name: str, shape: type[_Value], matrix_key: str
    ) -> Iterator[tuple[int, str, Any, _Value, RigidTransform | None]]:
        """Index, location, text, values and mounting of the usable entries of a list."""
        for k, item in enumerate(content.get(name) or ()):
            location = f"{name}[{k}]"
            try:
                entry = self.converted(location, item, shape)
                mount = self._mount(location, {key: getattr(entry, key) for key in (matrix_key, f"{matrix_key}Matrix")})
            except (DataError, CalibrationError) as error:
                self.ledger.fault("unusable-calibrations", error)
            else:
                yield k, f"{self.path}: {location}", item, entry, mount

    def _mount(self, entry: str, matrices: Mapping[str, _MatrixNumbers | None]) -> RigidTransform | None:
        """The matrix under one of two keys; where they differ, that is a fault, and the first counts."""
        found = {
            key: rigid_transform(matrix, f"{self.path}: {entry}.{key}", self.ledger)
            for key, matrix in matrices.items()
            if matrix is not None
        }
        if not found:
            return None
        (key, first), *others = found.items()
        for other, second in others:
            apart = float(np.abs(first.matrix - second.matrix).max())
            if apart > _SAME_MATRIX:
                problem = (
                    f"differs from {key} by up to {apart:.3g}; expected one of the two, or the same numbers in both"
                )
                self.ledger.fault("contradicting-mounts", DataError(self.path, f"{entry}.{other}", problem))
        return first

    def rig(self, content: Mapping[str, Any]) -> _RigCalibration:
        """What a calibration says of the whole device; its poses are taken as those of the IMU."""
        readings: Mapping[str, Callable[[str, object], Any]] = {
            "imuToOutput": self._transform,
            "imuToGnss": self._transform_or_position,
            "imuToMagnetometer": self._transform,
            "imuForward": self._direction,
        }
        found: dict[str, Any] = dict.fromkeys(readings)
        for name, read in readings.items():
            if content.get(name) is not None:
                try:
                    found[name] = read(name, content[name])
                except (DataError, CalibrationError) as error:
                    self.ledger.fault("unusable-calibrations", error)
        output = found["imuToOutput"]
        if output is not None and not np.allclose(output.matrix, np.eye(4)):
            message = "imuToOutput is not the identity; the poses of all lines are taken as those of the IMU"
            self.ledger.note(WarningKind.ASSUMED, "poses-of-imu", f"{self.path}: imuToOutput", message)
        return _RigCalibration(*found.values())

    def _transform(self, name: str, value: object) -> RigidTransform:
        return rigid_transform(self.converted(name, value, _MatrixNumbers), f"{self.path}: {name}", self.ledger)

    def _transform_or_position(self, name: str, value: object) -> RigidTransform:
        """A matrix, or the antenna's position in the IMU's frame as the vendor's recorders take it."""
        if isinstance(value, list) and (len(value) != 3 or any(isinstance(number, list) for number in value)):
            return self._transform(name, value)
        position_imu = self._vector(name, value)
        message = f"{name} is a vector: taken to be where the antenna is, in the IMU's frame"
        self.ledger.note(WarningKind.ASSUMED, "antenna-location", f"{self.path}: {name}", message)
        return RigidTransform(np.eye(3), -position_imu)

    def _direction(self, name: str, value: object) -> Float64Array:
        vector = self._vector(name, value)
        length = float(np.linalg.norm(vector))
        if length < _SHORTEST:
            raise CalibrationError(f"{self.path}: {name}: {vector.tolist()}; expected a direction")
        return read_only(vector / length)

    def _vector(self, name: str, value: object) -> Float64Array:
        if isinstance(value, dict):
            numbers = list(structs.astuple(self.converted(name, value, Point)))
        else:
            numbers = self.converted(name, value, list[float])
        if len(numbers) != 3 or not all(abs(number) <= _FARTHEST for number in numbers):
            raise CalibrationError(f"{self.path}: {name}: {numbers}; expected three numbers within {_FARTHEST:g}")
        return np.array(numbers, np.float64)

    def converted(self, location: str, value: object, shape: type[_Value]) -> _Value:
        try:
            return msgspec.convert(value, shape)
        except DECODER_FAULTS as error:
            raise DataError(self.path, *json_fault(error, msgspec.json.encode(value), prefix=location)) from error


def read_texts(
    frames: FrameColumns, rows: "array[int]", chosen: "array[int]", read: Callable[[bytes, int], _Value], ledger: Ledger
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


def _decoded(text: bytes, line: int, path: Path, key: str, shape: type[_Value]) -> _Value:
    try:
        return msgspec.json.decode(text, type=shape)
    except DECODER_FAULTS as error:
        raise DataError(path, f"line {line}", json_problem(error, text, prefix=f"frames[].{key}")) from error


def read_parameters(text: bytes, line: int, *, path: Path) -> CameraParameters:
    """Read a `cameraParameters`.

    Raises:
        DataError: it is no object, or a value has the wrong type.
    """
    return _decoded(text, line, path, "cameraParameters", CameraParameters).with_both_focal_lengths()


def read_mount(text: bytes, line: int, *, path: Path, ledger: Ledger) -> RigidTransform:
    """Read an `imuToCamera` of a line; gives `ego_from_camera`.

    Raises:
        DataError: it is no matrix.
        CalibrationError: it is not rigid.
    """
    numbers = _decoded(text, line, path, "imuToCamera", _MatrixNumbers)
    return rigid_transform(numbers, f"{path}: line {line}: frames[].imuToCamera", ledger).inverse()


_FISHEYE = "kannala-brandt4"
_FISHEYE_IN_LINES = "KANNALA_BRANDT4"
_FISHEYE_COUNT = 4
_MOST_CAMERAS = 2
_LONGEST = 1 << 22


def _old_content(folder: Path, other_lines: Iterable[str], doubts: list[str]) -> Mapping[str, Any]:
    """What stands in for a `calibration.json`, in its words; `parameters.txt` counts before the lines."""
    entries = _entries_of_lines(other_lines)
    path = folder / PARAMETERS_FILE
    if path.is_file():
        for index, entry in _entries_of_parameters(path, doubts).items():
            entries.setdefault(index, {}).update(entry)
    for index, entry in entries.items():
        if "model" not in entry:
            entry["model"] = "pinhole"
            doubts.append(f"camera {index} is taken for a pinhole: no model is stated")
    return {"cameras": [entries.get(index, {}) for index in range(max(entries) + 1)]} if entries else {}


def _entries_of_lines(other_lines: Iterable[str]) -> dict[int, dict[str, Any]]:
    """By camera, what lines like `{"cameraInd": 0, "imuToCamera": [...]}` state."""
    entries: dict[int, dict[str, Any]] = {}
    for text in other_lines:
        try:
            line = msgspec.json.decode(text) if '"cameraInd"' in text else {}
        except DECODER_FAULTS:
            continue
        index = line.get("cameraInd") if isinstance(line, dict) else None
        if not isinstance(index, int) or not 0 <= index < _MOST_CAMERAS:
            continue
        stated = {"imuToCamera": line["imuToCamera"]} if "imuToCamera" in line else {}
        coefficients = line.get("coeffs")
        if _FISHEYE_IN_LINES in str(line.get("model")) and isinstance(coefficients, list):
            # some recorders wrote a fifth coefficient that is zero
            count = _FISHEYE_COUNT if coefficients[_FISHEYE_COUNT:] == [0] else None
            stated |= {"model": _FISHEYE, "distortionCoefficients": coefficients[:count]}
        if stated:
            entries.setdefault(index, {}).update(stated)
    return entries


def _entries_of_parameters(path: Path, doubts: list[str]) -> dict[int, dict[str, Any]]:
    """By camera, what `parameters.txt` (lines of `name value;`) states; names of the second begin with `second`."""
    try:
        with open_file(path) as file:
            text = file.read(_LONGEST).decode()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(path, "", f"cannot be read as text: {error}") from error
    values: dict[str, str] = {}
    for part in text.split(";"):
        words = part.split()
        if words and (len(words) != 2 or words[0] in values):
            problem = "expected a name and a value, each name once, with `;` behind them"
            raise DataError(path, " ".join(words)[:60], problem)
        if words:
            values[words[0]] = words[1]
    entries = {index: _entry_of_parameters(values, path, index) for index in range(_MOST_CAMERAS)}
    entries = {index: entry for index, entry in entries.items() if entry}
    if values.get("videoRotation", "NONE") != "NONE":
        for entry in entries.values():
            entry.pop("imuToCamera", None)
        doubts.append("videoRotation rotates the mountings in a way that is not known here; they are left out")
    return entries


def _entry_of_parameters(values: Mapping[str, str], path: Path, index: int) -> dict[str, Any]:
    def read(name: str, convert: Callable[[str], Any]) -> Any:
        key = f"second{name[0].upper()}{name[1:]}" if index else name
        try:
            return convert(values[key]) if key in values else None
        except ValueError as error:
            raise DataError(path, key, f"{values[key][:60]!r}; expected numbers") from error

    def numbers(text: str) -> list[float]:
        return [float(number) for number in text.split(",")]

    def pixels(text: str) -> float | None:
        """-1 stands for a length that is not stated."""
        return None if float(text) < 0 else float(text)

    focal, matrix = read("focalLength", pixels), read("imuToCameraMatrix", numbers) or ()
    stated = {
        "focalLengthX": read("focalLengthX", pixels) or focal,
        "focalLengthY": read("focalLengthY", pixels) or focal,
        "principalPointX": read("principalPointX", pixels),
        "principalPointY": read("principalPointY", pixels),
        # nine or sixteen numbers column by column; fewer stand for a mounting that is not stated
        "imuToCamera": matrix if len(matrix) > 1 else None,
        "imuToCameraShiftSeconds": read("imuToCameraShiftSeconds", float),
    }
    entry: dict[str, Any] = {name: value for name, value in stated.items() if value is not None}
    coefficients = read("distortionCoeffs", numbers) or []
    is_fisheye = values.get("fisheyeCamera") == "true"
    if coefficients or (entry and is_fisheye):
        # a single zero stands for no distortion
        entry["distortionCoefficients"] = [] if coefficients == [0.0] else coefficients
        entry["model"] = _FISHEYE if is_fisheye else "pinhole"
    return entry
