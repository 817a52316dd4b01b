"""The property `calibration`: the records of table 3 of several cameras and lidars as one JSON text."""

from dataclasses import asdict, dataclass
from typing import Any

import msgspec

from sceneloom.errors import DataError
from sceneloom.fusion.calibration.declared import check_calibration
from sceneloom.fusion.json_property import read_json, sensor_id_of
from sceneloom.fusion.messages.calibration_data import CalibrationData
from sceneloom.fusion.messages.tables import CALIBRATION

MOST_PAIRS = 1024
"""Cameras and lidars that one system may relate: every change of a calibration looks at all of them."""

_OWNER = "calibration"
_IDS = ("camera_id", "lidar_id")
_FIELDS = {row.name: row.attribute for row in CALIBRATION.rows}


@dataclass(frozen=True, slots=True)
class CalibrationEntry:
    """A record of table 3 and the sensors that it is of.

    Attributes:
        camera_id, lidar_id: 0 to 255.
        data: the record.
    """

    camera_id: int
    lidar_id: int
    data: CalibrationData


def parse_calibrations(text: str) -> tuple[CalibrationEntry, ...]:
    """Read the property; an empty text holds none.

    Raises:
        DataError: it is no JSON list of records of table 3 with `camera_id` and `lidar_id`, or two are of one pair.
        CalibrationError: the numbers of one are no camera model or no transform.
    """
    found = read_json(text, _OWNER)
    if found is None:
        return ()
    if isinstance(found, dict):
        found = [found]
    if not isinstance(found, list):
        raise DataError(_OWNER, "", "neither a JSON list nor an object; expected records of table 3")
    if len(found) > MOST_PAIRS:
        raise DataError(_OWNER, "", f"{len(found)} records; expected at most {MOST_PAIRS}")
    entries = tuple(entry_of(item, f"[{k}]") for k, item in enumerate(found))
    pairs = [(entry.camera_id, entry.lidar_id) for entry in entries]
    for k, pair in enumerate(pairs):
        if pair in pairs[:k]:
            raise DataError(
                _OWNER, f"[{k}]", f"camera {pair[0]} and lidar {pair[1]} again; expected each pair once"
            )
    return entries


def entry_of(item: Any, location: str) -> CalibrationEntry:
    """Read one record of table 3 with its `camera_id` and `lidar_id`, 0 where they are left out.

    Raises:
        DataError: it is no such record.
        CalibrationError: its numbers are no camera model or no transform.
    """
    if not isinstance(item, dict):
        raise DataError(_OWNER, location, f"{item!r}; expected an object")
    unknown = sorted(set(item) - set(_FIELDS) - set(_IDS))
    if unknown:
        known = ", ".join((*_IDS, *_FIELDS))
        raise DataError(_OWNER, f"{location}.{unknown[0]}", f"not a field of table 3; there are {known}")
    camera_id, lidar_id = (sensor_id_of(item.get(name, 0), _OWNER, f"{location}.{name}") for name in _IDS)
    missing = [row.name for row in CALIBRATION.rows if row.required and row.name not in item]
    if missing:
        raise DataError(_OWNER, f"{location}.{missing[0]}", "missing; expected as table 3 has it")
    try:
        data = CalibrationData(**{_FIELDS[name]: value for name, value in item.items() if name not in _IDS})
    except DataError as error:
        raise DataError(_OWNER, f"{location}.{error.location}", error.problem) from error
    check_calibration(data)
    return CalibrationEntry(camera_id, lidar_id, data)


def format_calibrations(entries: tuple[CalibrationEntry, ...]) -> str:
    """Write the property's text, which `parse_calibrations` reads back."""
    items = [{"camera_id": e.camera_id, "lidar_id": e.lidar_id, **asdict(e.data)} for e in entries]
    return msgspec.json.encode(items).decode()
