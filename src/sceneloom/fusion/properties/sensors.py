"""The property `sensors`: what each sensor_id is, and what its raw data hold."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from sceneloom.errors import DataError
from sceneloom.fusion.calibration.axes import SensorKind
from sceneloom.fusion.json_property import read_by_sensor
from sceneloom.fusion.mounting import parse_mounting
from sceneloom.geometry.rigid import RigidTransform

_PLACE, _MOUNTING = "sensors", "body_from_lidar"


class RawForm(StrEnum):
    """What the bytes of a raw record (table 4) are."""

    RECORDS = "records"
    """Lidar: 23-byte records, as of the recording format: x y z float32, intensity uint8, ring uint16, time float64."""
    JPEG = "jpeg"
    """Camera: a JPEG file."""
    PNG = "png"
    """Camera: a PNG file."""
    RGB8 = "rgb8"
    """Camera: height x width x 3 bytes; the size is that of the camera's calibration."""


RAW_FORMS = {
    SensorKind.LIDAR: (RawForm.RECORDS,),
    SensorKind.CAMERA: (RawForm.JPEG, RawForm.PNG, RawForm.RGB8),
}
"""What raw data a sensor of each kind can send."""


@dataclass(frozen=True, slots=True)
class DeclaredSensor:
    """A sensor as the property `sensors` declares it.

    Attributes:
        sensor_id: 0 to 255.
        kind: camera or lidar.
        raw: what its raw data hold, or None where it sends none.
        body_from_lidar: of a lidar, how it is mounted on the body whose way is told; None: the way is its own.
    """

    sensor_id: int
    kind: SensorKind
    raw: RawForm | None = None
    body_from_lidar: RigidTransform | None = None


def parse_sensors(text: str) -> Mapping[int, DeclaredSensor]:
    """Read the property; an empty text declares nothing.

    Raises:
        DataError: it is no JSON object of sensors.
    """
    found = read_by_sensor(text, _PLACE, '{"0": {"kind": "lidar"}}')
    return {sensor_id: _declared(sensor_id, entry) for sensor_id, entry in found.items()}


def _declared(sensor_id: int, entry: Any) -> DeclaredSensor:
    name = str(sensor_id)
    if not isinstance(entry, dict) or not {"kind"} <= set(entry) <= {"kind", "raw", _MOUNTING}:
        raise DataError(
            _PLACE, name, f"{entry!r}; expected an object with kind and perhaps raw and {_MOUNTING}"
        )
    if entry["kind"] not in list(SensorKind):
        raise DataError(_PLACE, f"{name}.kind", f"{entry['kind']!r}; expected {' or '.join(SensorKind)}")
    kind = SensorKind(entry["kind"])
    raw = entry.get("raw")
    if raw is not None and raw not in RAW_FORMS[kind]:
        raise DataError(_PLACE, f"{name}.raw", f"{raw!r}; expected one of {', '.join(RAW_FORMS[kind])}")
    place = f"{name}.{_MOUNTING}"
    mounting = parse_mounting(entry[_MOUNTING], _PLACE, place) if _MOUNTING in entry else None
    if mounting is not None and kind is not SensorKind.LIDAR:
        raise DataError(_PLACE, place, "of a camera; expected of lidars: cameras are where calibrations say")
    return DeclaredSensor(sensor_id, kind, None if raw is None else RawForm(raw), mounting)
