"""Sensors of a file, each by the reader of its type."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from sceneloom.formats.sfs.fields import RECORDS, SENSOR_ALIASES, SENSOR_RECORDS, sensor_record
from sceneloom.formats.sfs.read_cameras import read_camera
from sceneloom.formats.sfs.read_clouds import note_further_faults, read_lidar, read_points, read_radar
from sceneloom.formats.sfs.read_motion import read_gnss, read_imu, read_odometry, read_plain_sensor
from sceneloom.formats.sfs.records import Faults, Location
from sceneloom.formats.sfs.root import root_fault
from sceneloom.formats.sfs.source import Source
from sceneloom.scene.scene import Sensor
from sceneloom.scene.warnings import WarningKind

_SENSOR_READERS: Mapping[str, Callable[[Source, dict[str, Any], Location, Faults], Sensor | None]] = (
    MappingProxyType(
        {
            "lidar": read_lidar,
            "radar": read_radar,
            "points": read_points,
            "camera": read_camera,
            "odometry": read_odometry,
            "imu": read_imu,
            "gnss": read_gnss,
        }
    )
)


def read_sensors(source: Source, raw: Any, location: Location) -> tuple[Sensor, ...]:
    """Read a list of sensors; those at fault are left out."""
    if raw is None:
        return ()
    if not isinstance(raw, list):
        root_fault(source, location, "expected a list of sensors")
        return ()
    sensors = []
    for index, item in enumerate(raw):
        faults = Faults()
        sensor = _sensor(source, item, (*location, index), faults)
        if source.settle(faults, (*location, index)) and sensor is not None:
            sensors.append(sensor)
    return tuple(sensors)


def _sensor(source: Source, raw: Any, location: Location, faults: Faults) -> Sensor | None:
    type_name = raw.get("type") if isinstance(raw, dict) else None
    if not isinstance(type_name, str):
        faults.add(("type",), f"{type_name!r}; expected one of {', '.join(SENSOR_RECORDS)}")
        return None
    known = SENSOR_ALIASES.get(type_name, type_name)
    if known != type_name:
        source.warning(
            WarningKind.ASSUMED, "sensor-alias", location, f"type {type_name!r}; read as {known!r}"
        )
    is_known = known in _SENSOR_READERS
    values = source.reader(forgiving=not is_known).read(raw, sensor_record(type_name), faults)
    if not is_known and not isinstance(values.get("id"), str | int):
        faults.add(("id",), f"{values.get('id')!r}; expected text or an integer")
    if faults:
        if is_known:
            fields = RECORDS[sensor_record(type_name)]
            note_further_faults({name: v for name, v in values.items() if name in fields}, faults)
        return None
    return _SENSOR_READERS.get(known, read_plain_sensor)(source, values, location, faults)
