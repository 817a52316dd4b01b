"""Configuration data of DB34/T 4101-2022: predefined properties (table 2 and extensions), added ones, and `sensors`."""

import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from importlib.resources import files
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.db34t.calibration import DeclaredAxes, SensorKind, parse_calibrations, read_by_sensor
from sceneloom.db34t.types import ValueType
from sceneloom.detections.detectors import detector_names
from sceneloom.errors import ArrayError, CalibrationError, DataError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import GLOBAL, LONGEST_ROLL_S, Shutter

_MOUNTING_PARTS = {"position": 3, "quaternion_xyzw": 4}
_MOST_M = 1e9  # beyond this a number is none of an extrinsic position [m]

_OF_KIND = {SensorKind.LIDAR: ("body_from_lidar",), SensorKind.CAMERA: ("shutter_roll_s", "shutter_left_to_right")}
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


_RAW_FORMS = {SensorKind.LIDAR: (RawForm.RECORDS,), SensorKind.CAMERA: (RawForm.JPEG, RawForm.PNG, RawForm.RGB8)}
"""What raw data a sensor of each kind can send."""


@dataclass(frozen=True, slots=True)
class DeclaredSensor:
    """A sensor as the property `sensors` declares it.

    Attributes:
        sensor_id: 0 to 255.
        kind: camera or lidar.
        raw: what its raw data hold, or None where it sends none.
        body_from_lidar: of a lidar, its extrinsics on the body whose trajectory is sent; None: its own.
        shutter: of a camera, when the lines of its images are taken.
    """

    sensor_id: int
    kind: SensorKind
    raw: RawForm | None = None
    body_from_lidar: RigidTransform | None = None
    shutter: Shutter = GLOBAL


def parse_sensors(text: str) -> Mapping[int, DeclaredSensor]:
    """Read the property `sensors`; an empty text declares nothing.

    Raises:
        DataError: it is no JSON object of sensors.
    """
    found = read_by_sensor(text, "sensors", '{"0": {"kind": "lidar"}}')
    return {sensor_id: _declared(sensor_id, entry) for sensor_id, entry in found.items()}


def _declared(sensor_id: int, entry: Any) -> DeclaredSensor:
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
    return DeclaredSensor(
        sensor_id,
        kind,
        None if raw is None else RawForm(raw),
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
class PredefinedProperty:
    """A property that is there from the start.

    Attributes:
        name, description, unit: of the property; `unit` "" for none.
        type: as in table 1, or a tuple of such.
        default: its value at the start.
        check: what else the value has to fulfil, or None.
        source: the row of table 2, or "extension".
    """

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


def _read_predefined() -> Iterator[PredefinedProperty]:
    content = tomllib.loads(files(__package__).joinpath("properties.toml").read_text("utf-8"))
    for name, row in content.items():
        default = tuple(row["default"]) if isinstance(row["default"], list) else row["default"]
        check = _PROPERTY_CHECKS.get(name)
        yield PredefinedProperty(name=name, **(row | {"default": default, "check": check}))


PREDEFINED: Mapping[str, PredefinedProperty] = MappingProxyType({row.name: row for row in _read_predefined()})
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
