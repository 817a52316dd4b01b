"""Reading a file into a scene, with all that is wrong in it."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from sceneloom.errors import DataError, OptionError
from sceneloom.formats.sfs.annotation_parts import read_attributes
from sceneloom.formats.sfs.container import Container, ItemFault, format_keys
from sceneloom.formats.sfs.exactness import restore_exact_attributes
from sceneloom.formats.sfs.faults import Examination, error_of
from sceneloom.formats.sfs.file_parts import FileParts
from sceneloom.formats.sfs.garbage import collector_paused
from sceneloom.formats.sfs.lens_readings import lens_records, with_lens_readings
from sceneloom.formats.sfs.read_annotations import read_annotations
from sceneloom.formats.sfs.read_motion import read_trajectories
from sceneloom.formats.sfs.read_sensors import read_sensors
from sceneloom.formats.sfs.records import Faults, Place
from sceneloom.formats.sfs.root import (
    DEFAULT_TICK_NS,
    OURS,
    check_version,
    part_metadata,
    read_clock,
    read_ours,
)
from sceneloom.formats.sfs.source import ReadingOptions, Source
from sceneloom.formats.sfs.times import FileClock
from sceneloom.scene import Annotation, AttributePath, CuboidAnnotation, Identifier, NoticeKind, Scene, Sensor
from sceneloom.scene.types import key_of

DEFAULT_EULER = {"euler_unit": "degrees", "euler_order": "xyz"}
"""How the angles of cuboids are read where nothing says it. Source: `CuboidPath.from_matrix` of Scale's library."""

Thing = TypeVar("Thing", Sensor, Annotation)

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


def read_scene(path: Path | str, options: ReadingOptions) -> Scene:
    """Open a file as a scene; only its header is read.

    Raises:
        DataError: the file is at fault; the error tells the first places.
    """
    # the header goes while the collector is still paused, which would otherwise walk through all of it
    with collector_paused():
        return _sound_scene(path, options)


def _sound_scene(path: Path | str, options: ReadingOptions) -> Scene:
    examination = read_all(path, options)
    refused = [fault for fault in examination.faults if fault.vital or not options.lenient]
    if refused or examination.scene is None:
        raise error_of(str(path), refused)
    if examination.header is not None:
        examination.header.pop("annotations", None)
    return examination.scene


def read_all(path: Path | str, options: ReadingOptions) -> Examination:
    """Read all of a file, or of a URL, that is sound, and note every fault.

    Raises:
        DataError: not even the header can be read.
    """
    try:
        with collector_paused():
            items: list[ItemFault] = []
            container = _opened(path, options, items)
    except RecursionError:
        raise DataError(path, "header", "nested too deeply") from None
    return read_container(container, items, options)


def read_container(container: Container, items: list[ItemFault], options: ReadingOptions) -> Examination:
    """Read all of an open file that is sound, and note every fault.

    Args:
        container: the file.
        items: what is wrong with its arrays.
        options: what the file does not say itself.

    Raises:
        DataError: it nests too deeply.
    """
    try:
        with collector_paused():
            return _examination(container, items, options)
    except RecursionError:
        raise DataError(container.file, "header", "nested too deeply") from None
    except OptionError as error:
        problem = str(error).removeprefix(f"{container.file}: ")
        raise DataError(container.file, "", problem) from None


def _opened(path: Path | str, options: ReadingOptions, items: list[ItemFault]) -> Container:
    return Container(path, faults=items, storage_options=options.storage_options)


def _parts_again(options: ReadingOptions, path: Path | str) -> FileParts:
    """Open a file again for what a scene of it reads; annotations and the like are in the scene already."""
    with collector_paused():
        source, ours, _ = _source(_opened(path, options, []), options)
        _all_sensors(source, ours)
    return source.parts


def _source(container: Container, options: ReadingOptions) -> tuple[Source, dict[str, Any], dict[str, Any]]:
    """Begin with a file: what its readers share, our metadata and the free ones."""
    parts = FileParts(container, partial(_parts_again, options))
    source = Source(container, parts, FileClock(DEFAULT_TICK_NS, 0), options)
    check_version(source)
    metadata, raw = part_metadata(source)
    source.clock = read_clock(source, raw)
    return source, read_ours(source, raw), metadata


def _all_annotations(source: Source, ours: dict[str, Any]) -> tuple[Annotation, ...]:
    return (
        *read_annotations(source, source.container.header.get("annotations"), ("annotations",)),
        *read_annotations(source, ours.get("annotations"), ("metadata", OURS, "annotations")),
    )


def _all_sensors(source: Source, ours: dict[str, Any]) -> tuple[Sensor, ...]:
    return (
        *read_sensors(source, source.container.header.get("sensors"), ("sensors",)),
        *read_sensors(source, ours.get("sensors"), ("metadata", OURS, "sensors")),
    )


def _examination(container: Container, items: list[ItemFault], options: ReadingOptions) -> Examination:
    header = container.header
    source, ours, metadata = _source(container, options)
    source.collect_items(items)
    sensors, sensor_places = _unique(source, _all_sensors(source, ours), "sensors", ours)
    annotations, annotation_places = _unique(source, _all_annotations(source, ours), "annotations", ours)
    attributes = _attributes(source, header.get("attributes"))
    faults = Faults()
    aside = read_attributes(ours.get("attributes"), faults)
    trajectories = read_trajectories(
        ours.get("trajectories"), sensors, ("metadata", OURS, "trajectories"), faults
    )
    source.collect(faults, ())
    annotations, attributes = restore_exact_attributes(
        ours.get("exact_attributes") or [], annotations, (*attributes, *aside)
    )
    kept = {name: value for name, value in ours.items() if name not in _ABSORBED}
    kept |= _euler(source, ours, annotations) | lens_records(source)
    scene = Scene(
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
    scene = with_lens_readings(scene, source)
    noticed = tuple(source.noticed_now)
    return Examination(
        scene, source.found_faults(), header, sensor_places, annotation_places, noticed, container.fetch
    )


def _unique(
    source: Source, things: tuple[Thing, ...], kind: str, ours: Any
) -> tuple[tuple[Thing, ...], tuple[Place, ...]]:
    """Leave out those whose id another had before; give the others with their places in the file."""
    places = (
        *_kept_places(source, source.container.header.get(kind), (kind,)),
        *_kept_places(source, ours.get(kind), ("metadata", OURS, kind)),
    )
    first: dict[tuple[type, Identifier], Place] = {}
    kept: list[Thing] = []
    for thing, place in zip(things, places, strict=True):
        before = first.setdefault(key_of(thing.id), place)
        if before is place:
            kept.append(thing)
            continue
        faults = Faults()
        problem = f"{thing.id!r} is used twice, first by {format_keys(before)}"
        faults.add(("id",), problem, code="duplicate-id")
        source.settle(faults, place)
    return tuple(kept), tuple(first.values())


def _kept_places(source: Source, raw: Any, root: Place) -> list[Place]:
    """The places of all entries of a list but those that were left out."""
    places = [(*root, k) for k in range(len(raw) if isinstance(raw, list) else 0)]
    return [place for place in places if place not in source.left_out] if source.left_out else places


def _attributes(source: Source, raw: Any) -> tuple[AttributePath, ...]:
    """Make the attributes of the scene and its sensors."""
    faults = Faults()
    records = source.reader().read({"version": "", "attributes": raw}, "scene", faults).get("attributes")
    attributes = () if faults else read_attributes(records, faults)
    source.collect(faults, ())
    return attributes


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
