"""The file that a fusion system starts from: properties, sensors and calibrations, as TOML."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec

from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.files import read_settings
from sceneloom.fusion.calibration.entries import CalibrationEntry, entry_of
from sceneloom.fusion.interface import FusionInterface
from sceneloom.fusion.outcome import Outcome
from sceneloom.fusion.properties.sensors import parse_sensors

_TABLES = ("properties", "added", "sensors", "calibrations")
_ADDED = ("name", "description", "type", "value")
_IN_TABLES_OF_THEIR_OWN = ("sensors", "calibration")


@dataclass(frozen=True, slots=True, kw_only=True)
class ConfigurationFile:
    """What a file says; read and tried by `read_configuration_file`.

    Attributes:
        path: of the file.
        properties: values of predefined properties, in the file's order.
        added: properties of clause 5.3: name, description, type and perhaps value.
        sensors: the text of the property `sensors`, "" for none.
        calibrations: the records of table 3.
        further: tables that are not of the fusion system.
    """

    path: Path
    properties: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    added: tuple[Mapping[str, Any], ...] = ()
    sensors: str = ""
    calibrations: tuple[CalibrationEntry, ...] = ()
    further: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: MappingProxyType({}))

    def apply(self, fusion: FusionInterface) -> None:
        """Set what the file says.

        Raises:
            DataError: something is refused.
        """
        for k, row in enumerate(self.added):
            location = f"added[{k}]"
            self._check(location, fusion.add_property(row["name"], row.get("description", ""), row["type"]))
            if "value" in row:
                self._check(f"{location}.value", fusion.set_property(row["name"], row["value"]))
        for name, value in self.properties.items():
            self._check(f"properties.{name}", fusion.set_property(name, value))
        if self.sensors:
            self._check("sensors", fusion.set_property("sensors", self.sensors))
        for k, entry in enumerate(self.calibrations):
            outcome = fusion.set_calibration(entry.data, camera_id=entry.camera_id, lidar_id=entry.lidar_id)
            self._check(f"calibrations[{k}]", outcome)

    def _check(self, location: str, outcome: Outcome) -> None:
        if not outcome:
            raise DataError(self.path, location, outcome.reason)


def read_configuration_file(path: Path | str, *, further: tuple[str, ...] = ()) -> ConfigurationFile:
    """Read a file and try whether a fusion system takes what it says.

    Args:
        path: of the TOML file.
        further: names of tables that others read.

    Raises:
        DataError: it is no TOML, has something unknown in it, or a value is refused.
        OSError: it cannot be read.

    Source: DB34/T 4101-2022, clause 5.2, tables 2 and 3.
    """
    path = Path(path)
    content = _tables(path)
    for name, table in content.items():
        if name not in (*_TABLES, *further):
            raise DataError(path, name, f"unknown; expected one of {', '.join((*_TABLES, *further))}")
        if not isinstance(table, list if name in ("added", "calibrations") else dict):
            wanted = f"[[{name}]]" if name in ("added", "calibrations") else f"[{name}]"
            raise DataError(path, name, f"{table!r}; expected a table {wanted}")
    found = ConfigurationFile(
        path=path,
        properties=MappingProxyType(_properties(path, content.get("properties", {}))),
        added=tuple(_added(path, k, row) for k, row in enumerate(content.get("added", ()))),
        sensors=_sensors(path, content.get("sensors", {})),
        calibrations=_calibrations(path, content.get("calibrations", ())),
        further=MappingProxyType({name: content[name] for name in further if name in content}),
    )
    with FusionInterface(inline=True) as tried:
        found.apply(tried)
    return found


def _tables(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(read_settings(path).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise DataError(path, "", f"no TOML: {error}") from error


def _properties(path: Path, table: dict[str, Any]) -> dict[str, Any]:
    for name in _IN_TABLES_OF_THEIR_OWN:
        if name in table:
            own = "[sensors.ID]" if name == "sensors" else "[[calibrations]]"
            raise DataError(path, f"properties.{name}", f"a property with tables of its own; expected {own}")
    return table


def _added(path: Path, k: int, row: Any) -> Mapping[str, Any]:
    location = f"added[{k}]"
    if not isinstance(row, dict):
        raise DataError(path, location, f"{row!r}; expected a table")
    for name in row:
        if name not in _ADDED:
            raise DataError(path, f"{location}.{name}", f"unknown; expected one of {', '.join(_ADDED)}")
    for name in ("name", "type"):
        if name not in row:
            raise DataError(path, f"{location}.{name}", "missing; expected as clause 5.3 has it")
    for name in ("name", "description", "type"):
        if not isinstance(row.get(name, ""), str):
            raise DataError(path, f"{location}.{name}", f"{row[name]!r}; expected a string")
    return MappingProxyType(row)


def _sensors(path: Path, table: dict[str, Any]) -> str:
    text = msgspec.json.encode(table, enc_hook=str).decode() if table else ""
    try:
        parse_sensors(text)
    except DataError as error:
        raise DataError(path, ".".join(filter(None, ("sensors", error.location))), error.problem) from error
    return text


def _calibrations(path: Path, rows: Any) -> tuple[CalibrationEntry, ...]:
    entries: list[CalibrationEntry] = []
    for k, row in enumerate(rows):
        try:
            entry = entry_of(row, f"[{k}]")
        except DataError as error:
            raise DataError(path, f"calibrations{error.location}", error.problem) from error
        except CalibrationError as error:
            raise DataError(path, f"calibrations[{k}]", str(error)) from error
        if any((entry.camera_id, entry.lidar_id) == (known.camera_id, known.lidar_id) for known in entries):
            pair = f"camera {entry.camera_id} and lidar {entry.lidar_id}"
            raise DataError(path, f"calibrations[{k}]", f"{pair} again; expected each pair once")
        entries.append(entry)
    return tuple(entries)
