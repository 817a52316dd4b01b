"""A file to start a fusion system from: properties, sensors and calibrations as TOML.

```toml
[properties]                  # clause 5.4, any of table 2 and the extensions
lidar_frequency = 20
lidar_coordinate = [1, 0, 2]

[algorithms]                  # fusion_algorithm of each fusion type
detections = "projection"

[added.weather]               # clause 5.3
description = "what it is like: dry=0, rain=1"
type = "enum"
value = "rain"

[sensors.0]                   # the property `sensors`
kind = "lidar"

[[calibrations]]              # table 3, for each camera and lidar
camera_id = 1
lidar_id = 0
image_size = [640, 480]
intrinsic_matrix = [500.0, 0.0, 319.5, 0.0, 500.0, 239.5, 0.0, 0.0, 1.0]
reference_frame = 0
extrinsic_matrix = [0.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
```
"""

import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec

from sceneloom.errors import DataError

_LARGEST_FILE = 10_000_000
_TYPES = MappingProxyType({"sensor_data": 0, "detections": 1})


@dataclass(frozen=True, slots=True)
class Step:
    """One call of the fusion interface.

    Attributes:
        call: name of its method.
        arguments: what it is called with.
        place: which part of the file says so.
    """

    call: str
    arguments: tuple[Any, ...]
    place: str


@dataclass(frozen=True, slots=True)
class Config:
    """What a file says.

    Attributes:
        source: the file.
        steps: the calls that make a new fusion system what it says, in order.
    """

    source: str
    steps: tuple[Step, ...] = field(default=())


def read_config(path: str | Path) -> Config:
    """Read a file.

    Raises:
        DataError: it cannot be read, is no TOML, or has parts that are not known.
    """
    source = str(path)
    try:
        with Path(path).open("rb") as file:
            content = file.read(_LARGEST_FILE + 1)
        if len(content) > _LARGEST_FILE:
            raise DataError(source, "", f"larger than {_LARGEST_FILE} bytes; expected a configuration")
        found = tomllib.loads(content.decode("utf-8"))
    except OSError as error:
        raise DataError(source, "", f"cannot be read: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DataError(source, "", f"no TOML: {error}") from error
    unknown = sorted(set(found) - set(_PARTS))
    if unknown:
        raise DataError(source, unknown[0], f"not known; there are {', '.join(_PARTS)}")
    steps: list[Step] = []
    for name, (form, steps_of) in _PARTS.items():
        part = found.get(name, form())
        if not isinstance(part, form):
            raise DataError(
                source, name, f"{part!r}; expected a {'table' if form is dict else 'list of tables'}"
            )
        steps.extend(steps_of(part, source))
    return Config(source, tuple(steps))


def _added(part: Mapping[str, Any], source: str) -> Iterator[Step]:
    for name, entry in part.items():
        place = f"added.{name}"
        if not isinstance(entry, dict) or not {"type"} <= set(entry) <= {"description", "type", "value"}:
            raise DataError(source, place, f"{entry!r}; expected description, type and perhaps value")
        yield Step("add_property", (name, entry.get("description", ""), entry["type"]), place)
        if "value" in entry:
            yield Step("set_property", (name, entry["value"]), f"{place}.value")


def _properties(part: Mapping[str, Any], source: str) -> Iterator[Step]:
    del source
    for name, value in part.items():
        yield Step("set_property", (name, value), f"properties.{name}")


def _algorithms(part: Mapping[str, Any], source: str) -> Iterator[Step]:
    unknown = sorted(set(part) - set(_TYPES))
    if unknown:
        raise DataError(source, f"algorithms.{unknown[0]}", f"no fusion type; there are {', '.join(_TYPES)}")
    for name, value in part.items():
        place = f"algorithms.{name}"
        yield Step("set_algorithm", (_TYPES[name], value), place)


def _sensors(part: Mapping[str, Any], source: str) -> Iterator[Step]:
    del source
    if part:
        yield Step("set_property", ("sensors", _json(part)), "sensors")


def _calibrations(part: list[Any], source: str) -> Iterator[Step]:
    del source
    if part:
        yield Step("set_property", ("calibration", _json(part)), "calibrations")


def _json(value: Any) -> str:
    return msgspec.json.encode(value).decode()


_PARTS: Mapping[str, tuple[type, Callable[[Any, str], Iterator[Step]]]] = MappingProxyType(
    {
        "added": (dict, _added),
        "properties": (dict, _properties),
        "algorithms": (dict, _algorithms),
        "sensors": (dict, _sensors),
        "calibrations": (list, _calibrations),
    }
)
"""The parts of a file, in the order in which they count, what each is, and what it asks for."""
