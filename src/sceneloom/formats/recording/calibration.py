"""`calibration.json`: the entries of cameras and lidars, checked one by one, their text kept."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np
from msgspec import Meta

from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.files import read_bytes
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.recording.camera_models import CameraParameters
from sceneloom.formats.recording.json_faults import BYTE_ORDER_MARK, DECODER_FAULTS, json_fault, json_problem
from sceneloom.formats.recording.line_shapes import SensorIndex
from sceneloom.formats.recording.lines import note_mark
from sceneloom.formats.recording.mounts import MatrixNumbers, rigid_transform
from sceneloom.formats.recording.old_forms import read_old_calibration
from sceneloom.formats.recording.rig_calibration import RigCalibration, read_rig
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.warnings import WarningKind

CALIBRATION_FILE = "calibration.json"


Duration = Annotated[float, Meta(ge=0, le=10)]
"""How long a image takes [s]."""

_SAME_MATRIX = 1e-6
"""Elements of two matrices that are closer are the same number, written with other digits."""

Shift = Annotated[float, Meta(ge=-1e6, le=1e6)]


class CameraEntry(CameraParameters, frozen=True):
    """One of `cameras`, as far as it is used here; the text of the format calls the matrix `imuToCameraMatrix`."""

    imuToCamera: MatrixNumbers | None = None  # noqa: N815 - the format's own word
    imuToCameraMatrix: MatrixNumbers | None = None  # noqa: N815 - the format's own word
    imuToCameraShiftSeconds: Shift | None = None  # noqa: N815 - the format's own word
    shutterRollTimeSeconds: Duration | None = None  # noqa: N815 - the format's own word
    rollingShutterLeftToRight: bool | None = None  # noqa: N815 - the format's own word
    exposureTimeSeconds: Duration | None = None  # noqa: N815 - the format's own word


class LidarEntry(msgspec.Struct, frozen=True):
    """One of `lidars`, as far as it is used here."""

    lidarInd: SensorIndex = 0  # noqa: N815 - as `cameraInd`; our extension for several lidars
    imuToLidar: MatrixNumbers | None = None  # noqa: N815 - the format's own word
    imuToLidarMatrix: MatrixNumbers | None = None  # noqa: N815 - as the cameras' word


Entry = TypeVar("Entry", CameraEntry, LidarEntry)


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
    rig: RigCalibration = field(default_factory=RigCalibration)
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
    return Calibration(path, cameras, lidars, read_rig(path, content, ledger), content)


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
    path: Path, entry: str, matrices: Mapping[str, MatrixNumbers | None], ledger: Ledger
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


def _convert(path: Path, location: str, item: object, shape: type[Entry]) -> Entry:
    try:
        return msgspec.convert(item, shape)
    except DECODER_FAULTS as error:
        raise DataError(path, *json_fault(error, msgspec.json.encode(item), prefix=location)) from error
