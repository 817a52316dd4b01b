"""What `calibration.json` says of the device as a whole: where its output, its antenna and its magnetometer are."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, read_only
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.recording.json_faults import DECODER_FAULTS, json_fault
from sceneloom.formats.recording.mounts import MatrixNumbers, rigid_transform
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.warnings import WarningKind

_FARTHEST = 1e6
_SHORTEST = 1e-6


class Vector(msgspec.Struct, frozen=True):
    """Three numbers by name."""

    x: float
    y: float
    z: float


@dataclass(frozen=True, slots=True, eq=False)
class RigCalibration:
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


def read_rig(path: Path, content: Mapping[str, Any], ledger: Ledger) -> RigCalibration:
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
    return RigCalibration(*found.values())


def _transform(path: Path, name: str, value: object, ledger: Ledger) -> RigidTransform:
    return rigid_transform(_converted(path, name, value, MatrixNumbers), f"{path}: {name}", ledger)


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
