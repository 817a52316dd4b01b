"""The property `sensors`: what each sensor_id is, and what its raw data hold."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import msgspec

from sceneloom.errors import DataError
from sceneloom.fusion.calibration.axes import SensorKind

_PLACE = "sensors"


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
    """

    sensor_id: int
    kind: SensorKind
    raw: RawForm | None = None


def parse_sensors(text: str) -> Mapping[int, DeclaredSensor]:
    """Read the property; an empty text declares nothing.

    Raises:
        DataError: it is no JSON object of sensors.
    """
    if not text.strip():
        return {}
    try:
        found = msgspec.json.decode(text)
    except msgspec.DecodeError as error:
        raise DataError(_PLACE, "", f"no JSON: {error}") from error
    if not isinstance(found, dict):
        raise DataError(_PLACE, "", f'{text[:40]!r}; expected an object as {{"0": {{"kind": "lidar"}}}}')
    sensors = (_declared(name, entry) for name, entry in found.items())
    return {sensor.sensor_id: sensor for sensor in sensors}


def _declared(name: str, entry: Any) -> DeclaredSensor:
    if not (name.isascii() and name.isdigit() and int(name) <= 255):
        raise DataError(_PLACE, name, "a sensor_id; expected 0 to 255")
    if not isinstance(entry, dict) or not {"kind"} <= set(entry) <= {"kind", "raw"}:
        raise DataError(_PLACE, name, f"{entry!r}; expected an object with kind and perhaps raw")
    if entry["kind"] not in list(SensorKind):
        raise DataError(_PLACE, f"{name}.kind", f"{entry['kind']!r}; expected {' or '.join(SensorKind)}")
    kind = SensorKind(entry["kind"])
    raw = entry.get("raw")
    if raw is not None and raw not in RAW_FORMS[kind]:
        raise DataError(_PLACE, f"{name}.raw", f"{raw!r}; expected one of {', '.join(RAW_FORMS[kind])}")
    return DeclaredSensor(int(name), kind, None if raw is None else RawForm(raw))
