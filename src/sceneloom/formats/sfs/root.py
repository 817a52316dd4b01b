"""What the root of a file says: its version, its clock, its metadata and ours among it."""

from typing import Any

import msgspec

from sceneloom.formats.faults import MALFORMED
from sceneloom.formats.sfs.camera_model_readings import note_tangential
from sceneloom.formats.sfs.records import Faults, Location, RecordReader
from sceneloom.formats.sfs.source import Source
from sceneloom.formats.sfs.times import (
    EARLIEST_OFFSET_NS,
    INT64_MAX,
    READABLE_TICKS_NS,
    FileClock,
    TimeRangeError,
    scaled,
)
from sceneloom.scene.warnings import DataWarning

VERSIONS = ("1.0", "5.1")
"""Beginnings of the versions that we read."""

DEFAULT_TICK_NS = READABLE_TICKS_NS["microseconds"]
"""Length of a tick where the file does not state its unit [ns]."""

OURS = "sceneloom"
"""Our entry of the scene's metadata."""


def check_version(source: Source) -> None:
    """Note a version that is none of those that we read."""
    version = source.container.header.get("version")
    if not isinstance(version, str) or not version.startswith(VERSIONS):
        expected = " or ".join(f"{known}*" for known in VERSIONS)
        root_fault(source, ("version",), f"{version!r}; expected {expected}", code="version")


def root_fault(source: Source, location: Location, problem: str, *, code: str = MALFORMED) -> None:
    """Note what is wrong at the root, without which no scene means anything."""
    faults = Faults()
    faults.add(location, problem, code=code)
    source.collect(faults, ())


def part_metadata(source: Source) -> tuple[dict[str, Any], Any]:
    """Part the free metadata from ours."""
    metadata = source.container.header.get("metadata")
    if metadata is None:
        return {}, {}
    if not isinstance(metadata, dict):
        root_fault(source, ("metadata",), f"a {type(metadata).__name__}; expected an object")
        return {}, {}
    ours = metadata.get(OURS)
    return {name: value for name, value in metadata.items() if name != OURS}, {} if ours is None else ours


def read_clock(source: Source, ours: Any) -> FileClock:
    """The clock that the root reports; what it reports wrongly is taken as if it stated nothing."""
    header = source.container.header
    unit = header.get("time_unit")
    if unit is not None and not (isinstance(unit, str) and unit in READABLE_TICKS_NS):
        root_fault(source, ("time_unit",), f"{unit!r}; expected one of {', '.join(READABLE_TICKS_NS)}")
        unit = None
    tick_ns = READABLE_TICKS_NS[unit] if unit else DEFAULT_TICK_NS
    offset = header.get("time_offset")
    if offset is not None and type(offset) not in (int, float):
        root_fault(source, ("time_offset",), f"{offset!r}; expected an integer")
        offset = None
    shift_ns = ours.get("time_shift_ns") if isinstance(ours, dict) else None
    if shift_ns is not None and type(shift_ns) is not int:
        root_fault(source, ("metadata", OURS, "time_shift_ns"), f"{shift_ns!r}; expected an integer")
        shift_ns = None
    return FileClock(tick_ns, _offset_ns(source, offset or 0, tick_ns, shift_ns or 0))


def _offset_ns(source: Source, offset: float, tick_ns: int, shift_ns: int) -> int:
    try:
        offset_ns = scaled(offset, tick_ns) - shift_ns
    except TimeRangeError as error:
        root_fault(source, ("time_offset",), str(error))
        return 0
    if not EARLIEST_OFFSET_NS <= offset_ns <= INT64_MAX:
        root_fault(source, ("time_offset",), f"{offset}; expected a time of at most 292 years")
        return 0
    return offset_ns


def read_ours(source: Source, raw: Any) -> dict[str, Any]:
    """Read our metadata; a fault in it is a fault of the file."""
    faults = Faults()
    ours = RecordReader(source.clock).read(raw, OURS, faults)
    source.collect(faults, ("metadata", OURS))
    ours = without_faulty(ours, faults)
    note_tangential(source, ours)
    for note in ours.get("sensor_notes") or []:
        source.notes[type(note["id"]), note["id"]] = note
    for record in ours.get("warnings") or []:
        try:
            source.remember(msgspec.convert(record, DataWarning))
        except msgspec.ValidationError as error:
            root_fault(source, ("metadata", OURS, "warnings"), str(error))
    return ours


def without_faulty(ours: dict[str, Any], faults: Faults) -> dict[str, Any]:
    """A record without the entries of its lists that are at fault."""
    wrong = {fault.location[:2] for fault in faults}
    return {
        name: [item for k, item in enumerate(value) if (name, k) not in wrong]
        if isinstance(value, list)
        else value
        for name, value in ours.items()
    }
