"""Reading a file into a scene: root fields, clock, sensors, annotations, our metadata."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec

from sceneloom.errors import DataError, OptionError
from sceneloom.formats.sfs.container import Container
from sceneloom.formats.sfs.exactness import restore_exact_attributes
from sceneloom.formats.sfs.fields import SENSOR_ALIASES, SENSOR_RECORDS, sensor_record
from sceneloom.formats.sfs.file_parts import FileParts
from sceneloom.formats.sfs.garbage import collector_paused
from sceneloom.formats.sfs.read_annotations import read_annotations
from sceneloom.formats.sfs.read_cameras import read_camera
from sceneloom.formats.sfs.read_clouds import read_lidar, read_points, read_radar
from sceneloom.formats.sfs.read_motion import (
    read_gnss,
    read_imu,
    read_odometry,
    read_plain_sensor,
    read_trajectories,
)
from sceneloom.formats.sfs.records import Faults, Place, RecordReader
from sceneloom.formats.sfs.source import ReadingOptions, Source
from sceneloom.formats.sfs.times import INT64_MAX, READABLE_TICKS_NS, FileClock, TimeRangeError, scaled
from sceneloom.scene import Annotation, CuboidAnnotation, Notice, NoticeKind, Scene, Sensor

VERSIONS = ("1.0", "5.1")
"""Beginnings of the versions that we read."""

DEFAULT_EULER = {"euler_unit": "degrees", "euler_order": "xyz"}
"""How the angles of cuboids are read where nothing says it. Source: `CuboidPath.from_matrix` of Scale's library."""

OURS = "sceneloom"
"""Our entry of the scene's metadata."""

_ABSORBED = frozenset(
    {
        "layout",
        "time_shift_ns",
        "sensor_notes",
        "sensors",
        "annotations",
        "trajectories",
        "exact_attributes",
        "notices",
    }
)
_ROOT = frozenset({"version", "sensors", "annotations", "attributes", "time_offset", "metadata"})

_SENSOR_READERS: Mapping[str, Callable[[Source, dict[str, Any], Place, Faults], Sensor | None]] = (
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


def read_scene(path: Path, options: ReadingOptions) -> Scene:
    """Open a file as a scene; only its header is read.

    Raises:
        DataError: the file is at fault.
    """
    try:
        with collector_paused():
            return _scene(Container(path), options)
    except RecursionError:
        raise DataError(path, "header", "nested too deeply") from None
    except OptionError as error:
        raise DataError(path, "", str(error).removeprefix(f"{path}: ")) from None


def _parts_again(options: ReadingOptions, path: Path) -> FileParts:
    """Open a file again for what a scene of it reads; annotations and the like are in the scene already."""
    with collector_paused():
        source, ours, _ = _source(Container(path), options)
        _all_sensors(source, ours)
    return source.parts


def _source(container: Container, options: ReadingOptions) -> tuple[Source, dict[str, Any], dict[str, Any]]:
    """Begin with a file: what its readers share, our metadata and the free ones."""
    _check_version(container)
    metadata, raw = _metadata(container)
    parts = FileParts(container, partial(_parts_again, options))
    source = Source(container, parts, _clock(container, raw), options)
    return source, _read_ours(source, raw), metadata


def _all_sensors(source: Source, ours: dict[str, Any]) -> tuple[Sensor, ...]:
    return (
        *_sensors(source, source.container.header.get("sensors"), ("sensors",)),
        *_sensors(source, ours.get("sensors"), ("metadata", OURS, "sensors")),
    )


def _scene(container: Container, options: ReadingOptions) -> Scene:
    header = container.header
    source, ours, metadata = _source(container, options)
    sensors = _all_sensors(source, ours)
    annotations = (
        *read_annotations(source, header.get("annotations"), ("annotations",)),
        *read_annotations(source, ours.get("annotations"), ("metadata", OURS, "annotations")),
    )
    attributes = (*_attributes(source), *(ours.get("attributes") or ()))
    faults = Faults()
    trajectories = read_trajectories(
        ours.get("trajectories"), sensors, ("metadata", OURS, "trajectories"), faults
    )
    source.raise_faults(faults, ())
    annotations, attributes = restore_exact_attributes(
        ours.get("exact_attributes") or [], annotations, attributes
    )
    kept = {name: value for name, value in ours.items() if name not in _ABSORBED}
    kept |= _euler(source, ours, annotations)
    return Scene(
        sensors,
        annotations,
        trajectories=trajectories,
        attributes=attributes,
        metadata={**metadata, **({OURS: kept} if kept else {})},
        time_offset_ns=source.clock.offset_ns,
        source=container.file,
        format="sfs",
        notices=tuple(source.notices),
        extras={name: value for name, value in header.items() if name not in _ROOT},
        on_close=source.parts.close,
    )


def _check_version(container: Container) -> None:
    version = container.header.get("version")
    if not isinstance(version, str) or not version.startswith(VERSIONS):
        expected = " or ".join(f"{known}*" for known in VERSIONS)
        raise DataError(container.file, "version", f"{version!r}; expected {expected}")


def _metadata(container: Container) -> tuple[dict[str, Any], Any]:
    """Part the free metadata from ours."""
    metadata = container.header.get("metadata")
    if metadata is None:
        return {}, {}
    if not isinstance(metadata, dict):
        raise DataError(container.file, "metadata", f"a {type(metadata).__name__}; expected an object")
    ours = metadata.get(OURS)
    return {name: value for name, value in metadata.items() if name != OURS}, {} if ours is None else ours


def _clock(container: Container, ours: Any) -> FileClock:
    unit = container.header.get("time_unit")
    if unit is not None and not (isinstance(unit, str) and unit in READABLE_TICKS_NS):
        raise DataError(
            container.file, "time_unit", f"{unit!r}; expected one of {', '.join(READABLE_TICKS_NS)}"
        )
    tick_ns = READABLE_TICKS_NS[unit or "microseconds"]
    offset = container.header.get("time_offset")
    if offset is not None and type(offset) not in (int, float):
        raise DataError(container.file, "time_offset", f"{offset!r}; expected an integer")
    shift_ns = ours.get("time_shift_ns") if isinstance(ours, dict) else None
    if shift_ns is not None and type(shift_ns) is not int:
        raise DataError(
            container.file, f"metadata.{OURS}.time_shift_ns", f"{shift_ns!r}; expected an integer"
        )
    try:
        offset_ns = scaled(offset or 0, tick_ns) - (shift_ns or 0)
    except TimeRangeError as error:
        raise DataError(container.file, "time_offset", str(error)) from None
    if abs(offset_ns) > INT64_MAX:
        raise DataError(container.file, "time_offset", f"{offset}; expected a time of at most 292 years")
    return FileClock(tick_ns, offset_ns)


def _read_ours(source: Source, raw: Any) -> dict[str, Any]:
    """Read our metadata; a fault in it is a fault of the file."""
    faults = Faults()
    ours = RecordReader(source.clock).read(raw, OURS, faults)
    source.raise_faults(faults, ("metadata", OURS))
    for note in ours.get("sensor_notes") or []:
        source.notes[type(note["id"]), note["id"]] = note
    for record in ours.get("notices") or []:
        source.notices.append(_notice(source, record))
    return ours


def _notice(source: Source, record: Mapping[str, Any]) -> Notice:
    try:
        return msgspec.convert(record, Notice)
    except msgspec.ValidationError as error:
        raise DataError(source.file, f"metadata.{OURS}.notices", str(error)) from None


def _sensors(source: Source, raw: Any, place: Place) -> list[Sensor]:
    if raw is None:
        return []
    faults = Faults()
    if not isinstance(raw, list):
        faults.add((), "expected a list of sensors")
    source.raise_faults(faults, place)
    sensors = []
    for index, item in enumerate(raw):
        faults = Faults()
        sensor = _sensor(source, item, (*place, index), faults)
        if source.settle(faults, (*place, index)) and sensor is not None:
            sensors.append(sensor)
    return sensors


def _sensor(source: Source, raw: Any, place: Place, faults: Faults) -> Sensor | None:
    type_name = raw.get("type") if isinstance(raw, dict) else None
    if not isinstance(type_name, str):
        faults.add(("type",), f"{type_name!r}; expected one of {', '.join(SENSOR_RECORDS)}")
        return None
    known = SENSOR_ALIASES.get(type_name, type_name)
    if known != type_name:
        source.notice(NoticeKind.ASSUMED, "sensor-alias", place, f"type {type_name!r}; read as {known!r}")
    is_known = known in _SENSOR_READERS
    values = source.reader(forgiving=not is_known).read(raw, sensor_record(type_name), faults)
    if not is_known and not isinstance(values.get("id"), str | int):
        faults.add(("id",), f"{values.get('id')!r}; expected text or an integer")
    if faults:
        return None
    return _SENSOR_READERS.get(known, read_plain_sensor)(source, values, place, faults)


def _attributes(source: Source) -> tuple[Mapping[str, Any], ...]:
    faults = Faults()
    part = {"version": "", "attributes": source.container.header.get("attributes")}
    attributes = source.reader().read(part, "scene", faults).get("attributes") or []
    source.raise_faults(faults, ())
    return tuple(attributes)


def _euler(source: Source, ours: Mapping[str, Any], annotations: tuple[Annotation, ...]) -> dict[str, str]:
    """Say how the angles of cuboids are meant: as the caller says, as recorded, else the default, with a notice."""
    asked = {name: getattr(source.options, name) for name in DEFAULT_EULER}
    said = {name: asked[name] or ours.get(name) for name in DEFAULT_EULER}
    if not any(isinstance(annotation, CuboidAnnotation) for annotation in annotations):
        return {name: value for name, value in said.items() if value is not None}
    for name, default in DEFAULT_EULER.items():
        if said[name] is None:
            message = f"{name.replace('_', ' ')} of the cuboids' angles is not said; taken to be {default}"
            source.notice(NoticeKind.ASSUMED, name.replace("_", "-"), ("annotations",), message)
    return {name: value or DEFAULT_EULER[name] for name, value in said.items()}
