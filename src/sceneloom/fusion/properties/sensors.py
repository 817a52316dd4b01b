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
from sceneloom.scene.shutter import GLOBAL, LONGEST_ROLL_S, Shutter

_LOCATION, _MOUNTING = "sensors", "body_from_lidar"
_ROLL, _ROLLS_OVER_COLUMNS = "shutter_roll_s", "shutter_left_to_right"
_OF_KIND = {SensorKind.LIDAR: (_MOUNTING,), SensorKind.CAMERA: (_ROLL, _ROLLS_OVER_COLUMNS)}
"""What is stated for sensors of one kind alone."""


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
        body_from_lidar: of a lidar, how it is mounted on the body whose trajectory is reported; None: the trajectory is
            its own.
        shutter: of a camera, when the lines of its images are taken.
    """

    sensor_id: int
    kind: SensorKind
    raw: RawForm | None = None
    body_from_lidar: RigidTransform | None = None
    shutter: Shutter = GLOBAL


def parse_sensors(text: str) -> Mapping[int, DeclaredSensor]:
    """Read the property; an empty text declares nothing.

    Raises:
        DataError: it is no JSON object of sensors.
    """
    found = read_by_sensor(text, _LOCATION, '{"0": {"kind": "lidar"}}')
    return {sensor_id: _declared(sensor_id, entry) for sensor_id, entry in found.items()}


def _declared(sensor_id: int, entry: Any) -> DeclaredSensor:
    name = str(sensor_id)
    if not isinstance(entry, dict) or "kind" not in entry:
        raise DataError(_LOCATION, name, f"{entry!r}; expected an object with kind")
    if entry["kind"] not in list(SensorKind):
        raise DataError(_LOCATION, f"{name}.kind", f"{entry['kind']!r}; expected {' or '.join(SensorKind)}")
    kind = SensorKind(entry["kind"])
    for word in entry:
        _check_word(word, kind, f"{name}.{word}")
    raw = entry.get("raw")
    if raw is not None and raw not in RAW_FORMS[kind]:
        raise DataError(_LOCATION, f"{name}.raw", f"{raw!r}; expected one of {', '.join(RAW_FORMS[kind])}")
    mounting = (
        parse_mounting(entry[_MOUNTING], _LOCATION, f"{name}.{_MOUNTING}") if _MOUNTING in entry else None
    )
    return DeclaredSensor(
        sensor_id, kind, None if raw is None else RawForm(raw), mounting, _shutter(entry, name)
    )


def _check_word(word: str, kind: SensorKind, location: str) -> None:
    """Refuse what is stated for no sensor of this kind."""
    if word in ("kind", "raw", *_OF_KIND[kind]):
        return
    others = {other.value for other, words in _OF_KIND.items() if word in words}
    if others:
        raise DataError(_LOCATION, location, f"of a {kind}; expected of {' and '.join(others)}s")
    expected = ", ".join(("raw", *_OF_KIND[kind]))
    raise DataError(_LOCATION, location, f"no word of a {kind}; expected kind and perhaps {expected}")


def _shutter(entry: Mapping[str, Any], name: str) -> Shutter:
    """What a camera's entry says of its shutter; all at once where it says nothing."""
    seconds, over_columns = entry.get(_ROLL, 0.0), entry.get(_ROLLS_OVER_COLUMNS, False)
    if (
        isinstance(seconds, bool)
        or not isinstance(seconds, int | float)
        or not 0 <= seconds <= LONGEST_ROLL_S
    ):
        problem = f"{seconds!r}; expected seconds, 0 to {LONGEST_ROLL_S:g}"
        raise DataError(_LOCATION, f"{name}.{_ROLL}", problem)
    if not isinstance(over_columns, bool):
        raise DataError(
            _LOCATION, f"{name}.{_ROLLS_OVER_COLUMNS}", f"{over_columns!r}; expected true or false"
        )
    return Shutter(float(seconds), over_columns)
