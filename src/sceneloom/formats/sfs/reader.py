"""Reading a file into a scene, with all faults of the file."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.diagnostics import PlacedFault
from sceneloom.formats.base.files import is_url
from sceneloom.formats.sfs.annotations import read_annotations, read_attributes
from sceneloom.formats.sfs.clock import FileClock
from sceneloom.formats.sfs.container import Container, ItemFault, collector_paused, format_keys
from sceneloom.formats.sfs.images import damaged_videos, rescue_videos
from sceneloom.formats.sfs.metadata import (
    DEFAULT_TICK_NS,
    OURS,
    FileParts,
    Source,
    camera_model_records,
    check_version,
    part_metadata,
    read_clock,
    read_ours,
    with_camera_model_readings,
)
from sceneloom.formats.sfs.profiles import restore_exact_attributes
from sceneloom.formats.sfs.records import Faults, Location
from sceneloom.formats.sfs.schema import (
    Numbering,
    copied,
    in_words,
    is_listed_thing,
    outermost,
    parse_path,
    take_out,
    what_goes_with,
)
from sceneloom.formats.sfs.sensors import read_sensors, read_trajectories
from sceneloom.formats.sfs.spec import ReadingOptions
from sceneloom.scene.annotations import Annotation, AttributePath, CuboidAnnotation
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Identifier, key_of
from sceneloom.warnings import DataWarning, WarningKind

_REPORTED = 4
"""So many locations of further faults stand in an error."""


@dataclass(frozen=True, slots=True)
class _Loss:
    """A part of a file that is at fault and not in the scene.

    Attributes:
        keys: where it is in the file.
        words: what it is, for people (`frame 12 of lidar 'top'`).
        problem: what is wrong.
        lost_bytes: how much of an array is not there, where it is known.
    """

    keys: Location
    words: str
    problem: str
    lost_bytes: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Examination:
    """A file with all that is wrong in it.

    Attributes:
        scene: what is sound, and what could be brought into order; None where nothing can be read.
        faults: part by part in the order of the file.
        header: the file's header without `$items`, arrays in their locations; None where it cannot be decoded.
        sensor_positions: where each sensor of the scene stands in the file.
        annotation_positions: where each annotation of the scene stands in the file.
        warnings: what was assumed, repaired or left out this time; the scene has those that the file had kept, too.
        fetch: gives arrays of the header with their values, which those of a file behind a URL may lack.
        losses: what is not in the scene; only where what is whole was asked for.
        frame_numbers: the numbers in the file of the frames and images that stay, by the path of their list, where some
            of a list were left out.
    """

    scene: Scene | None
    faults: tuple[PlacedFault, ...]
    header: dict[str, Any] | None = None
    sensor_positions: tuple[Location, ...] = ()
    annotation_positions: tuple[Location, ...] = ()
    warnings: tuple[DataWarning, ...] = ()
    fetch: Callable[[Any], Any] | None = None
    losses: tuple[_Loss, ...] = ()
    frame_numbers: Mapping[str, Sequence[int]] = field(default_factory=dict)

    @property
    def sensor_paths(self) -> tuple[str, ...]:
        """The locations of the sensors in words."""
        return tuple(map(format_keys, self.sensor_positions))

    @property
    def annotation_paths(self) -> tuple[str, ...]:
        """The locations of the annotations in words."""
        return tuple(map(format_keys, self.annotation_positions))


def _error_of(file: str, faults: Sequence[PlacedFault]) -> DataError:
    """The error of a file with at least one fault: the first with its problem, the locations of the next ones."""
    first, others = faults[0], faults[1:]
    problem = first.problem
    if others:
        problem += "; also at fault: " + ", ".join(fault.where for fault in others[:_REPORTED])
    if len(others) > _REPORTED:
        problem += f" and {len(others) - _REPORTED} more; `sceneloom validate FILE` lists all"
    return DataError(file, first.where, problem)


DEFAULT_EULER = {"euler_unit": "degrees", "euler_order": "xyz"}
"""How the angles of cuboids are read where nothing says it. Source: `CuboidPath.from_matrix` of Scale's library."""

_Thing = TypeVar("_Thing", Sensor, Annotation)

_ABSORBED = frozenset(
    {
        "layout",
        "time_shift_ns",
        "sensor_notes",
        "sensors",
        "annotations",
        "trajectories",
        "exact_attributes",
        "warnings",
    }
)

_ROOT = frozenset({"version", "sensors", "annotations", "attributes", "time_offset", "metadata"})


def read_scene(path: Path | str, options: ReadingOptions) -> Scene:
    """Open a file as a scene; only its header is read.

    Raises:
        DataError: the file is at fault; the error reports the first locations.
    """
    # the header goes while the collector is still paused, which would otherwise walk through all of it
    with collector_paused():
        return _sound_scene(path, options)


def _sound_scene(path: Path | str, options: ReadingOptions) -> Scene:
    examination = _read_all(path, options, whole=options.lenient)
    refused = [fault for fault in examination.faults if fault.vital or not options.lenient]
    if refused or examination.scene is None:
        raise _error_of(str(path), refused)
    if examination.header is not None:
        examination.header.pop("annotations", None)
    return examination.scene


def _read_all(path: Path | str, options: ReadingOptions, *, whole: bool) -> Examination:
    """Read a file, or a URL, and note every fault.

    Args:
        path: the file.
        options: what the file does not state itself.
        whole: take what is at fault out of sensors and annotations, so that the rest of them is in the scene; without,
            a sensor or annotation with a fault is left out.

    Raises:
        DataError: not even the header can be read.
    """
    try:
        with collector_paused():
            items: list[ItemFault] = []
            container = _opened(path, options, items)
    except RecursionError:
        raise DataError(path, "header", "nested too deeply") from None
    return read_container(container, items, options, whole=whole)


def read_container(
    container: Container,
    items: list[ItemFault],
    options: ReadingOptions,
    *,
    whole: bool,
    vital: bool = False,
) -> Examination:
    """Read an open file, and note every fault.

    Args:
        container: the file; what is at fault is not in its header afterwards.
        items: what is wrong with its arrays.
        options: what the file does not state itself.
        whole: take what is at fault out of sensors and annotations, as in `_read_all`.
        vital: take out what no scene can do without, too, and read the rest as if the file had never stated it.

    Raises:
        DataError: it nests too deeply.
    """
    try:
        with collector_paused():
            examination = _examination(container, items, options)
            return _whole_parts(container, items, options, examination, vital=vital) if whole else examination
    except RecursionError:
        raise DataError(container.file, "header", "nested too deeply") from None
    except OptionError as error:
        problem = str(error).removeprefix(f"{container.file}: ")
        raise DataError(container.file, "", problem) from None


@dataclass(frozen=True, slots=True)
class _Removed:
    """What was taken out of a header, so that another process can do the same.

    Attributes:
        videos: whether videos that were cut got what is left of them.
        rounds: the locations that were taken out together, one round after the other.
    """

    videos: bool = False
    rounds: tuple[tuple[Location, ...], ...] = ()


_ROUNDS = 4
"""What is taken out can bring to light what else is at fault, but not often."""


def _whole_parts(
    container: Container,
    items: list[ItemFault],
    options: ReadingOptions,
    first: Examination,
    *,
    vital: bool,
) -> Examination:
    """Take what is at fault out of the header, the least that has to go, and read the rest."""
    is_local = not is_url(container.file)
    if not (any(not fault.repaired for fault in first.faults) or (is_local and damaged_videos(container))):
        return first
    original, numbering = container.header, Numbering()
    container.header = copied(original)
    videos = rescue_videos(container, items) if is_local else {}
    cut = {keys: video for keys, video in videos.items() if video.is_rescued}
    removed, examination = _Removed(videos=bool(cut)), first
    faults = {(fault.path, fault.problem): fault for fault in first.faults}
    losses: dict[Location, _Loss] = {
        keys: _Loss(keys, in_words(original, keys), video.problem, video.lost_bytes)
        for keys, video in cut.items()
    }
    named = {fault.path for fault in first.faults}
    of_videos = [
        PlacedFault(path, video.problem, item=container.item_number(path, original))
        for keys, video in videos.items()
        if (path := format_keys(keys)) not in named
    ]
    for _ in range(_ROUNDS):
        reported = [
            fault for fault in examination.faults if not fault.repaired and (vital or not fault.vital)
        ]
        reported += of_videos
        of_videos = []
        locations = {fault: parse_path(fault.path) for fault in reported}
        goes = what_goes_with(container.header, [keys for keys in locations.values() if keys not in cut])
        victims = outermost(goes.values())
        for fault, keys in locations.items():
            lost = next((victim for victim in victims if victim == goes.get(keys, ())[: len(victim)]), None)
            location = numbering.before(keys)
            path = format_keys(location)
            placed = replace(fault, path=path, item=container.item_number(path, original))
            if lost is not None:
                words = in_words(original, numbering.before(lost))
                loss = _Loss(numbering.before(lost), words, _problem(lost, keys, fault))
                losses.setdefault(loss.keys, loss)
                placed = replace(placed, costs=words)
            elif keys in cut:
                placed = replace(placed, costs=f"part of {losses[keys].words}")
            elif vital:
                losses.setdefault(location, _Loss(location, fault.path, fault.problem))
            faults[placed.path, placed.problem] = placed
        inner = tuple(victim for victim in victims if not is_listed_thing(victim))
        if not inner and not (cut and examination is first):
            break
        numbering.follow(take_out(container.header, inner))
        removed = replace(removed, rounds=(*removed.rounds, inner))
        examination = _examination(container, [], options, removed)
    scene = examination.scene
    warnings = _loss_warnings(losses.values(), faults.values()) if options.lenient else ()
    if scene is not None and warnings:
        scene = replace(scene, warnings=(*scene.warnings, *warnings))
    return replace(
        examination,
        scene=scene,
        faults=tuple(faults.values()),
        header=original,
        warnings=(*examination.warnings, *warnings),
        losses=tuple(losses.values()),
        frame_numbers={format_keys(keys): numbers for keys, numbers in numbering.frames().items()},
    )


def _problem(lost: Location, keys: Location, fault: PlacedFault) -> str:
    inner = format_keys(keys[len(lost) :])
    return f"{inner}: {fault.problem}" if inner else fault.problem


def _loss_warnings(losses: Iterable[_Loss], faults: Iterable[PlacedFault]) -> tuple[DataWarning, ...]:
    """One warning for each part that was taken out of a sensor or annotation; whole ones have theirs already."""
    counts = Counter(fault.costs for fault in faults)
    return tuple(
        DataWarning(
            kind=WarningKind.SKIPPED,
            code="at-fault",
            location=format_keys(loss.keys),
            message=f"left out: {loss.words}: {loss.problem}",
            count=max(1, counts[loss.words]),
        )
        for loss in losses
        if not is_listed_thing(loss.keys)
    )


def _opened(path: Path | str, options: ReadingOptions, items: list[ItemFault]) -> Container:
    return Container(path, faults=items, storage_options=options.storage_options)


def _parts_again(options: ReadingOptions, removed: _Removed, path: Path | str) -> FileParts:
    """Open a file again for what a scene of it reads; annotations and the like are in the scene already."""
    with collector_paused():
        items: list[ItemFault] = []
        container = _opened(path, options, items)
        if removed.videos:
            rescue_videos(container, items)
        for victims in removed.rounds:
            take_out(container.header, victims)
        source, ours, _ = _source(container, options, removed)
        _all_sensors(source, ours)
    return source.parts


def _source(
    container: Container, options: ReadingOptions, removed: _Removed
) -> tuple[Source, dict[str, Any], dict[str, Any]]:
    """Begin with a file: what its readers share, our metadata and the free ones."""
    parts = FileParts(container, partial(_parts_again, options, removed))
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


def _examination(
    container: Container, items: list[ItemFault], options: ReadingOptions, removed: _Removed = _Removed()
) -> Examination:
    header = container.header
    source, ours, metadata = _source(container, options, removed)
    source.collect_items(items)
    sensors, sensor_positions = _unique(source, _all_sensors(source, ours), "sensors", ours)
    annotations, annotation_positions = _unique(source, _all_annotations(source, ours), "annotations", ours)
    attributes = _attributes(source, header.get("attributes"))
    faults = Faults()
    aside = read_attributes(source, ours.get("attributes"), faults)
    trajectories = read_trajectories(
        ours.get("trajectories"), sensors, ("metadata", OURS, "trajectories"), faults
    )
    source.collect(faults, ())
    annotations, attributes = restore_exact_attributes(
        ours.get("exact_attributes") or [], annotations, (*attributes, *aside)
    )
    kept = {name: value for name, value in ours.items() if name not in _ABSORBED}
    kept |= _euler(source, ours, annotations) | camera_model_records(source)
    scene = Scene(
        sensors,
        annotations,
        trajectories=trajectories,
        attributes=attributes,
        metadata={**metadata, **({OURS: kept} if kept else {})},
        time_offset_ns=source.clock.offset_ns,
        source=container.file,
        format="sfs",
        warnings=tuple(source.warnings),
        extras={name: value for name, value in header.items() if name not in _ROOT},
        on_close=source.parts.close,
    )
    scene = with_camera_model_readings(scene, source)
    noticed = tuple(source.noticed_now)
    return Examination(
        scene, source.found_faults(), header, sensor_positions, annotation_positions, noticed, container.fetch
    )


def _unique(
    source: Source, things: tuple[_Thing, ...], kind: str, ours: Any
) -> tuple[tuple[_Thing, ...], tuple[Location, ...]]:
    """Leave out those whose id another had before; give the others with their locations in the file."""
    locations = (
        *_kept_locations(source, source.container.header.get(kind), (kind,)),
        *_kept_locations(source, ours.get(kind), ("metadata", OURS, kind)),
    )
    first: dict[tuple[type, Identifier], Location] = {}
    kept: list[_Thing] = []
    for thing, location in zip(things, locations, strict=True):
        before = first.setdefault(key_of(thing.id), location)
        if before is location:
            kept.append(thing)
            continue
        faults = Faults()
        problem = f"{thing.id!r} is used twice, first by {format_keys(before)}"
        faults.add(("id",), problem, code="duplicate-id")
        source.settle(faults, location)
    return tuple(kept), tuple(first.values())


def _kept_locations(source: Source, raw: Any, root: Location) -> list[Location]:
    """The locations of all entries of a list but those that were left out."""
    locations = [(*root, k) for k in range(len(raw) if isinstance(raw, list) else 0)]
    return (
        [location for location in locations if location not in source.left_out]
        if source.left_out
        else locations
    )


def _attributes(source: Source, raw: Any) -> tuple[AttributePath, ...]:
    """Make the attributes of the scene and its sensors."""
    faults = Faults()
    records = source.reader().read({"version": "", "attributes": raw}, "scene", faults).get("attributes")
    attributes = () if faults else read_attributes(source, records, faults)
    source.settle(faults, ())
    return attributes


def _euler(source: Source, ours: Mapping[str, Any], annotations: tuple[Annotation, ...]) -> dict[str, str]:
    """Report how the angles of cuboids are meant: as the caller says, as recorded, else the default, with a warning."""
    asked = {name: getattr(source.options, name) for name in DEFAULT_EULER}
    stated = {name: asked[name] or ours.get(name) for name in DEFAULT_EULER}
    if not any(isinstance(annotation, CuboidAnnotation) for annotation in annotations):
        return {name: value for name, value in stated.items() if value is not None}
    for name, default in DEFAULT_EULER.items():
        if stated[name] is None:
            message = f"{name.replace('_', ' ')} of the cuboids' angles is not stated; taken to be {default}"
            source.warning(WarningKind.ASSUMED, name.replace("_", "-"), ("annotations",), message)
    return {name: value or DEFAULT_EULER[name] for name, value in stated.items()}


def examine(path: Path | str, options: ReadingOptions | None = None) -> Examination:
    """Read a file as far as it is sound, and give every fault of it with its location; nothing is raised for them.

    Args:
        path: the file, or the URL of one; only its header is read.
        options: what the file does not state itself; `lenient` plays no part.
    """
    try:
        return _read_all(path, replace(options or ReadingOptions(), lenient=False), whole=True)
    except DataError as error:
        return Examination(None, (PlacedFault(error.location, error.problem, "unreadable", vital=True),))
