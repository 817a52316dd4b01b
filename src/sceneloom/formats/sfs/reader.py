"""Reading a file into a scene, with all faults of the file."""

import io
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec
import numpy as np

from sceneloom.errors import ArrayError, DataError, OptionError
from sceneloom.formats.base.diagnostics import PlacedFault
from sceneloom.formats.base.files import is_url
from sceneloom.formats.sfs.annotations import read_annotations, read_attributes
from sceneloom.formats.sfs.clock import (
    EARLIEST_OFFSET_NS,
    INT64_MAX,
    READABLE_TICKS_NS,
    FileClock,
    TimeRangeError,
    scaled,
)
from sceneloom.formats.sfs.container import Container, ItemFault, collector_paused, format_keys
from sceneloom.formats.sfs.profiles import restore_exact_attributes
from sceneloom.formats.sfs.records import OURS, Faults, FileParts, Location, Source, root_fault
from sceneloom.formats.sfs.schema import RECORDS, Field, Kind, annotation_record, sensor_record
from sceneloom.formats.sfs.sensors import declared_length, is_mp4, read_sensors
from sceneloom.formats.sfs.spec import BROWN, OPENCV, TANGENTIALS, ReadingOptions
from sceneloom.scene.annotations import Annotation, AttributePath, CuboidAnnotation
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor, with_assumed_models
from sceneloom.scene.types import Identifier, key_of
from sceneloom.warnings import DataWarning, WarningKind

if TYPE_CHECKING:
    from av.video.stream import VideoStream

    from sceneloom.formats.video.reader import OpenVideo

_OURS_AT = ("metadata", OURS)
_REPORTED = 4  # so many locations of further faults stand in an error


@dataclass(frozen=True, slots=True)
class _Loss:
    """A part of a file that is at fault and not in the scene."""

    keys: Location  # where it is in the file
    words: str  # what it is, for people (`frame 12 of lidar 'top'`)
    problem: str  # what is wrong
    lost_bytes: int | None = None  # how much of an array is not there, where it is known


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
        """The locations of the sensors as text."""
        return tuple(map(format_keys, self.sensor_positions))

    @property
    def annotation_paths(self) -> tuple[str, ...]:
        """The locations of the annotations as text."""
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

_ABSORBED = frozenset({
    "layout", "time_shift_ns", "sensor_notes", "sensors", "annotations", "trajectories", "exact_attributes", "warnings",
})  # fmt: skip

_ROOT = frozenset({"version", "sensors", "annotations", "attributes", "time_offset", "metadata"})


def read_scene(path: Path | str, options: ReadingOptions) -> Scene:
    """Open a file as a scene; only its header is read.

    Raises:
        DataError: the file is at fault; the error reports the first locations.
    """
    # the header goes while the collector is still paused, which would otherwise walk through all of it
    with collector_paused():
        examination = _read_all(path, options, whole=options.lenient)
        refused = [fault for fault in examination.faults if fault.vital or not options.lenient]
        scene = examination.scene
        if refused or scene is None:
            raise _error_of(str(path), refused)
        if examination.header is not None:
            examination.header.pop("annotations", None)
        del examination
        return scene


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


def _read_all(path: Path | str, options: ReadingOptions, *, whole: bool) -> Examination:
    """Read a file, or a URL, and note every fault, as `read_container` does."""
    items: list[ItemFault] = []
    try:
        with collector_paused():
            container = Container(path, faults=items, storage_options=options.storage_options)
    except RecursionError:
        raise DataError(path, "header", "nested too deeply") from None
    return read_container(container, items, options, whole=whole)


def read_container(
    container: Container, items: list[ItemFault], options: ReadingOptions, *, whole: bool, vital: bool = False
) -> Examination:
    """Read an open file, and note every fault.

    Args:
        container: the file; what is at fault is not in its header afterwards.
        items: what is wrong with its arrays.
        options: what the file does not state itself.
        whole: take what is at fault out of sensors and annotations, so that the rest of them is in the scene; else a
            sensor or annotation with a fault is left out.
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
    """What was taken out of a header, so that another process can do the same."""

    videos: bool = False  # videos that were cut got what is left of them
    rounds: tuple[tuple[Location, ...], ...] = ()  # locations that were taken out together, one round after the other


_ROUNDS = 4  # what is taken out can bring to light what else is at fault, but not often


def _whole_parts(
    container: Container, items: list[ItemFault], options: ReadingOptions, first: Examination, *, vital: bool
) -> Examination:
    """Take what is at fault out of the header, the least that has to go, and read the rest."""
    is_local = not is_url(container.file)
    if not (any(not fault.repaired for fault in first.faults) or (is_local and _damaged_videos(container))):
        return first
    original, numbering = container.header, _Numbering()
    container.header = copied(original)
    videos = _rescue_videos(container, items) if is_local else {}
    cut = {keys: video for keys, video in videos.items() if video.kept}
    removed, examination = _Removed(videos=bool(cut)), first
    faults = {(fault.path, fault.problem): fault for fault in first.faults}
    losses: dict[Location, _Loss] = {
        keys: _Loss(keys, _in_words(original, keys), video.problem, video.lost_bytes) for keys, video in cut.items()
    }
    named = {fault.path for fault in first.faults}
    of_videos = [
        PlacedFault(path, video.problem, item=container.item_number(path, original))
        for keys, video in videos.items()
        if (path := format_keys(keys)) not in named
    ]
    for _ in range(_ROUNDS):
        reported = [fault for fault in examination.faults if not fault.repaired and (vital or not fault.vital)]
        reported += of_videos
        of_videos = []
        locations = {fault: parse_path(fault.path) for fault in reported}
        goes = _what_goes_with(container.header, [keys for keys in locations.values() if keys not in cut])
        wanted = dict.fromkeys(goes.values())
        # those that are not inside another, in their order
        victims = [keys for keys in wanted if not any(keys[:depth] in wanted for depth in range(1, len(keys)))]
        for fault, keys in locations.items():
            lost = next((victim for victim in victims if victim == goes.get(keys, ())[: len(victim)]), None)
            location = numbering.before(keys)
            path = format_keys(location)
            placed = replace(fault, path=path, item=container.item_number(path, original))
            if lost is not None:
                words = _in_words(original, numbering.before(lost))
                inner = format_keys(keys[len(lost) :])
                problem = f"{inner}: {fault.problem}" if inner else fault.problem
                loss = _Loss(numbering.before(lost), words, problem)
                losses.setdefault(loss.keys, loss)
                placed = replace(placed, costs=words)
            elif keys in cut:
                placed = replace(placed, costs=f"part of {losses[keys].words}")
            elif vital:
                losses.setdefault(location, _Loss(location, fault.path, fault.problem))
            faults[placed.path, placed.problem] = placed
        parts = tuple(victim for victim in victims if not _is_listed_thing(victim))
        if not parts and not (cut and examination is first):
            break
        numbering.follow(take_out(container.header, parts))
        removed = replace(removed, rounds=(*removed.rounds, parts))
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
        if not _is_listed_thing(loss.keys)
    )


@dataclass(frozen=True, slots=True)
class _DamagedVideo:
    """A video that was cut, or cannot be read."""

    problem: str  # what is wrong, and how many images are whole
    lost_bytes: int  # how many bytes are not there; 0 where that is not known
    kept: Sequence[int] = ()  # which of its images are whole and are in the header in its location
    count: int = 0  # how many images it had


def _damaged_videos(container: Container) -> dict[Location, tuple[Any, int, str]]:
    """Content, declared length and problem of each video that is cut or no video, by the position of its content."""
    found: dict[Location, tuple[Any, int, str]] = {}
    sensors = container.header.get("sensors")
    for number, sensor in enumerate(sensors if isinstance(sensors, list) else []):
        video = sensor.get("video") if isinstance(sensor, dict) else None
        content = video.get("content") if isinstance(video, dict) else None
        if isinstance(content, np.ndarray) and content.dtype == np.uint8 and content.size:
            there = np.ascontiguousarray(content).reshape(-1).data.cast("B")
            length = declared_length(there) if is_mp4(there) else len(there)
            if (problem := _video_problem(there, length)) is not None:
                found["sensors", number, "video", "content"] = there, length, problem
    return found


def _video_problem(there: memoryview, length: int) -> str | None:
    from sceneloom.formats.video.reader import read_index, read_table_index

    if length > len(there):
        return f"{len(there)} bytes of a video of {length}: it was cut"
    try:
        index = read_table_index(there, "video") if is_mp4(there) else read_index(there, "video")
    except DataError as error:
        return error.problem
    return None if len(index) else "a video without images"


def _videos_rescued(container: Container, items: Sequence[ItemFault]) -> dict[Location, _DamagedVideo]:
    """Put what is left of cut videos into the header; give all damaged ones, by the position of their content."""
    damaged = _damaged_videos(container)
    for fault in items:
        keys = container.item_keys(fault.number) or ()
        if keys[-2:] == ("video", "content"):
            item = container.item(fault.number)
            offset, length = item.get("offset"), item.get("length")
            if type(offset) is int and type(length) is int and offset >= 0:
                there = container.bytes_between(offset, offset + length)
                if 0 < len(there) < length:
                    damaged[keys] = there, length, _video_problem(there, length) or ""
    return {keys: _rescued(container.header, keys, *content) for keys, content in damaged.items()}


def _rescued(header: dict[str, Any], keys: Location, there: memoryview, length: int, why: str) -> _DamagedVideo:
    sensor: Any = header
    for key in keys[:-2]:
        sensor = sensor[key]
    video = sensor["video"]
    timestamps = video.get("timestamps")
    missing = length - len(there)
    lost = _DamagedVideo(why, missing)
    if not isinstance(timestamps, list) or not missing:
        return lost
    try:
        content, kept, count = _rescue_video(there, length)
    except DataError:
        return lost
    if count != len(timestamps):
        return lost
    video["content"] = np.frombuffer(content, np.uint8)
    video["timestamps"] = [timestamps[k] for k in kept]
    problem = f"the video was cut: {len(kept)} of its {count} images are whole"
    return _DamagedVideo(problem, missing, kept, count)


class _CutBytes:
    """Bytes of which only the first ones are there; the others are NULs."""

    def __init__(self, there: memoryview, length: int) -> None:
        self._there, self._length = there, length

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, part: slice) -> bytes:
        start, stop, _ = part.indices(self._length)
        piece = bytes(self._there[start:stop])
        return piece + bytes(max(0, stop - start) - len(piece))


def _rescue_video(there: memoryview, length: int) -> tuple[bytes, list[int], int]:
    """A video of the packets before the first damaged one; which images of the original it has, of how many."""
    from sceneloom.formats.video.reader import (
        BY_TABLES,
        OpenVideo,
        decoder_faults,
        open_hollow,
        read_index,
        read_table_index,
    )

    name = "video"
    whole = _CutBytes(there, length)
    index = read_table_index(whole, name)
    if not index.timed:
        raise DataError(name, "", "does not state when its images are shown")
    opened = OpenVideo(lambda: open_hollow(whole), name, options=BY_TABLES)
    try:
        with decoder_faults(name, ""):
            shown = _whole_packets(opened, len(there))
    finally:
        opened.close()
    kept = sorted(k for k in (index.find(pts) for pts in shown) if k is not None)
    if not kept or len(kept) != len(shown):
        raise DataError(name, "", "no image of it is whole")
    with decoder_faults(name, ""):
        content = _copied_packets(there, len(shown))
    if len(read_index(content, name)) != len(kept):
        raise DataError(name, "", "its whole images cannot be distinguished from the others")
    return content, kept, len(index)


def _whole_packets(opened: "OpenVideo", available: int) -> list[int | None]:
    """When the images of the first packets are shown, up to the first packet that is not whole [ticks]."""
    shown: list[int | None] = []
    for packet in opened.container.demux(opened.stream):
        if packet.size and not packet.is_discard:
            if packet.pos is None or packet.pos < 0 or packet.pos + packet.size > available:
                break
            shown.append(packet.pts)
    return shown


def _copied_packets(there: memoryview, count: int) -> bytes:
    """Copy the first packets of a video into one of its own."""
    import av

    from sceneloom.formats.video.reader import BY_TABLES, OpenVideo

    target = io.BytesIO()
    opened = OpenVideo(there, "video", options=BY_TABLES)
    try:
        with av.open(target, "w", format="mp4") as output:
            stream: VideoStream = output.add_stream_from_template(opened.stream)
            stream.time_base = opened.stream.time_base
            packets: Any = (p for p in opened.container.demux(opened.stream) if p.size)
            for _, packet in zip(range(count), packets, strict=False):
                packet.stream = stream
                output.mux(packet)
    finally:
        opened.close()
    return target.getvalue()


def _rescue_videos(container: Container, items: list[ItemFault]) -> Mapping[Location, _DamagedVideo]:
    """Put what is left of videos that were cut into the header, and bring what counts their images into step."""
    videos = _videos_rescued(container, items)
    for keys, video in videos.items():
        if video.kept:
            sensor = _at(container.header, keys[:-2])
            _keep_in_step(container.header, sensor.get("id"), "images", video.kept, video.count)
    return videos


def _parts_again(options: ReadingOptions, removed: _Removed, path: Path | str) -> FileParts:
    """Open a file again for what a scene of it reads; annotations and the like are in the scene already."""
    with collector_paused():
        items: list[ItemFault] = []
        container = Container(path, faults=items, storage_options=options.storage_options)
        if removed.videos:
            _rescue_videos(container, items)
        for victims in removed.rounds:
            take_out(container.header, victims)
        source, ours, _ = _source(container, options, removed)
        _all_of(source, ours, "sensors", read_sensors)
    return source.parts


def _source(
    container: Container, options: ReadingOptions, removed: _Removed
) -> tuple[Source, dict[str, Any], dict[str, Any]]:
    """Begin with a file: what its readers share, our metadata and the free ones."""
    parts = FileParts(container, partial(_parts_again, options, removed))
    source = Source(container, parts, FileClock(_DEFAULT_TICK_NS, 0), options)
    version = container.header.get("version")
    if not isinstance(version, str) or not version.startswith(_VERSIONS):
        expected = " or ".join(f"{known}*" for known in _VERSIONS)
        root_fault(source, ("version",), f"{version!r}; expected {expected}", code="version")
    metadata, raw = _part_metadata(source)
    source.clock = _read_clock(source, raw)
    return source, _read_ours(source, raw), metadata


def _all_of(
    source: Source, ours: dict[str, Any], kind: str, read: Callable[[Source, Any, Location], tuple[_Thing, ...]]
) -> tuple[_Thing, ...]:
    """The sensors or annotations of the file, and those of our metadata."""
    return read(source, source.container.header.get(kind), (kind,)) + read(source, ours.get(kind), (*_OURS_AT, kind))


def _examination(
    container: Container, items: list[ItemFault], options: ReadingOptions, removed: _Removed = _Removed()
) -> Examination:
    header = container.header
    source, ours, metadata = _source(container, options, removed)
    source.collect_items(items)
    sensors, sensor_positions = _unique(source, ours, "sensors", read_sensors)
    annotations, annotation_positions = _unique(source, ours, "annotations", read_annotations)
    attributes = _attributes(source, header.get("attributes"))
    faults = Faults()
    aside = read_attributes(source, ours.get("attributes"), faults)
    trajectories = _read_trajectories(ours.get("trajectories"), sensors, (*_OURS_AT, "trajectories"), faults)
    source.collect(faults, ())
    annotations, attributes = restore_exact_attributes(
        ours.get("exact_attributes") or [], annotations, (*attributes, *aside)
    )
    kept = {name: value for name, value in ours.items() if name not in _ABSORBED}
    kept |= _euler(source, ours, annotations)
    stated = source.tangential or options.tangential
    if stated is not None:  # what p1 and p2 mean from now on
        kept |= {"tangential": OPENCV, **({"tangential_before": BROWN} if stated == BROWN else {})}
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
    if options.assume_model:
        scene = with_assumed_models(scene)
    noticed = tuple(source.noticed_now)
    return Examination(
        scene, source.found_faults(), header, sensor_positions, annotation_positions, noticed, container.fetch
    )


def _unique(
    source: Source, ours: dict[str, Any], kind: str, read: Callable[[Source, Any, Location], tuple[_Thing, ...]]
) -> tuple[tuple[_Thing, ...], tuple[Location, ...]]:
    """Read sensors or annotations, and leave out those whose id another had before; give them with their locations."""
    things = _all_of(source, ours, kind, read)
    locations = (
        *_kept_locations(source, source.container.header.get(kind), (kind,)),
        *_kept_locations(source, ours.get(kind), (*_OURS_AT, kind)),
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
    return [location for location in locations if location not in source.left_out] if source.left_out else locations


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


_VERSIONS = ("1.0", "5.1")  # beginnings of the versions that we read
_DEFAULT_TICK_NS = READABLE_TICKS_NS["microseconds"]  # length of a tick where the file does not state its unit [ns]


def _part_metadata(source: Source) -> tuple[dict[str, Any], Any]:
    """Part the free metadata from ours."""
    metadata = source.container.header.get("metadata")
    if metadata is None:
        return {}, {}
    if not isinstance(metadata, dict):
        root_fault(source, ("metadata",), f"a {type(metadata).__name__}; expected an object")
        return {}, {}
    ours = metadata.get(OURS)
    return {name: value for name, value in metadata.items() if name != OURS}, {} if ours is None else ours


def _read_clock(source: Source, ours: Any) -> FileClock:
    """The clock that the root reports; what it reports wrongly is taken as if it stated nothing."""
    header = source.container.header
    unit = header.get("time_unit")
    if unit is not None and not (isinstance(unit, str) and unit in READABLE_TICKS_NS):
        root_fault(source, ("time_unit",), f"{unit!r}; expected one of {', '.join(READABLE_TICKS_NS)}")
        unit = None
    tick_ns = READABLE_TICKS_NS[unit] if unit else _DEFAULT_TICK_NS
    offset = header.get("time_offset")
    if offset is not None and type(offset) not in (int, float):
        root_fault(source, ("time_offset",), f"{offset!r}; expected an integer")
        offset = None
    shift_ns = ours.get("time_shift_ns") if isinstance(ours, dict) else None
    if shift_ns is not None and type(shift_ns) is not int:
        root_fault(source, (*_OURS_AT, "time_shift_ns"), f"{shift_ns!r}; expected an integer")
        shift_ns = None
    try:
        offset_ns = scaled(offset or 0, tick_ns) - (shift_ns or 0)
    except TimeRangeError as error:
        root_fault(source, ("time_offset",), str(error))
        return FileClock(tick_ns, 0)
    if not EARLIEST_OFFSET_NS <= offset_ns <= INT64_MAX:
        root_fault(source, ("time_offset",), f"{offset or 0}; expected a time of at most 292 years")
        return FileClock(tick_ns, 0)
    return FileClock(tick_ns, offset_ns)


def _read_ours(source: Source, raw: Any) -> dict[str, Any]:
    """Read our metadata; a fault in it is a fault of the file."""
    faults = Faults()
    ours = source.reader().read(raw, OURS, faults)
    source.collect(faults, _OURS_AT)
    wrong = {fault.location[:2] for fault in faults}
    for name, value in ours.items():
        if isinstance(value, list):
            ours[name] = [item for k, item in enumerate(value) if (name, k) not in wrong]
    recorded = ours.get("tangential")
    source.tangential = recorded if recorded in TANGENTIALS else None
    if source.tangential is not None and source.options.tangential not in (None, source.tangential):
        message = f"p1 and p2 are recorded to be as in {source.tangential}; they are not exchanged again"
        source.warning(WarningKind.ASSUMED, "tangential-recorded", (*_OURS_AT, "tangential"), message)
    for note in ours.get("sensor_notes") or []:
        source.notes[type(note["id"]), note["id"]] = note
    for record in ours.get("warnings") or []:
        try:
            source.remember(msgspec.convert(record, DataWarning))
        except msgspec.ValidationError as error:
            root_fault(source, (*_OURS_AT, "warnings"), str(error))
    return ours


_RECORD_KINDS = {Kind.RECORD, Kind.RECORDS, Kind.RECORD_OR_RECORDS, Kind.RECORD_LISTS, Kind.RECORD_MAP}
_TYPED_LISTS = {"sensors": sensor_record, "annotations": annotation_record}
_OF_FRAMES = {"frames": ("lengths",), "images": ("camera_of_image", "mounts", "extras")}
_ANY, _MAP = "any of ", "map of "
_STEP = re.compile(r"\.?([^.\[\]]+)|\[(\d+)\]")
_TIMED_ROWS = frozenset({"poses", "path", "point_path"})

_NEEDED_ALL_THE_SAME = {
    "attribute": {"timestamps", "values", "static", "sensor_id", "point_index"},
    "activation": {"durations"},
    "labeled_points_of_frame": {"sensor_frame"},
    "intrinsics": {"distortion"},
    "distortion": {"model", "params"},
    **{f"sensor {name}": {"coordinates", "parent_id"} for name in ("lidar", "radar", "camera")},
    **{f"annotation {name}": {"sensor_id"} for name in ("polygon", "polygon_topdown", "polyline", "points")},
    "annotation camera_calibration": {"poses", "intrinsics", "time_offset"},
}
"""Fields that a record can be read without, but would mean something else then."""


def parse_path(path: str) -> Location:
    """Take a path such as `sensors[3].frames[12].points` apart."""
    return tuple(int(index) if index else name for name, index in _STEP.findall(path))


def what_goes(header: Mapping[str, Any], keys: Location) -> Location | None:
    """Report what has to be taken out where the value at `keys` is lost: it, or the record that needs it.

    Returns:
        The path of a field that may be absent, of an entry of a list of records, or of a row of `values` that goes with
        its timestamp; None where there is no such location, or the scene cannot be without it.
    """
    removable: Location | None = None
    node: Any = header
    record: str | None = "scene"
    for depth, key in enumerate(keys):
        if isinstance(node, dict):
            if key not in node:
                needed = RECORDS.get(record or "", {}).get(str(key))
                return removable if needed is not None and needed.required else None
            if record is not None and record.startswith(_MAP):
                record, removable, node = record.removeprefix(_MAP), keys[: depth + 1], node[key]
                continue
            field = RECORDS.get(record or "", {}).get(str(key))
            if field is None or not (field.required or key in _NEEDED_ALL_THE_SAME.get(record or "", ())):
                removable = keys[: depth + 1]
            if record in _TIMED_ROWS and _is_timed_row(node, keys[depth:]):
                return keys[: depth + 2]
            record = _record_below(record, str(key), field, keys[:depth])
        elif isinstance(node, list) and isinstance(key, int) and key < len(node):
            if record is not None:
                removable = keys[: depth + 1]
                record = _record_of_entry(record, node[key])
        elif isinstance(node, list):
            return None
        else:
            break
        node = node[key]
    return removable


def _record_below(record: str | None, name: str, field: Field | None, above: Location) -> str | None:
    if record in {"scene", "sceneloom"} and name in _TYPED_LISTS:
        return f"{_ANY}{name}"
    if record == "scene" and name == "metadata":
        return None
    if (*above, name) == _OURS_AT:
        return "sceneloom"
    if field is None or field.kind not in _RECORD_KINDS:
        return None
    return f"{_MAP}{field.record}" if field.kind == Kind.RECORD_MAP else str(field.record)


def _record_of_entry(record: str, entry: Any) -> str | None:
    """The record of an entry of a list, which for sensors and annotations depends on its type."""
    if not record.startswith(_ANY):
        return record
    type_name = entry.get("type") if isinstance(entry, dict) else None
    return _TYPED_LISTS[record.removeprefix(_ANY)](type_name if isinstance(type_name, str) else "")


def _is_timed_row(record: Mapping[str, Any], keys: Location) -> bool:
    """Whether keys lead to one of several rows of `values`, each of which has its timestamp."""
    times, rows = record.get("timestamps"), record.get("values")
    return (
        len(keys) > 1
        and keys[0] == "values"
        and isinstance(times, list | np.ndarray)
        and isinstance(rows, list | np.ndarray)
        and len(times) == len(rows) > 1
        and isinstance(keys[1], int)
        and keys[1] < len(rows)
    )


def _what_goes_with(header: Mapping[str, Any], locations: Iterable[Location]) -> dict[Location, Location]:
    """What goes for locations of lost values, if anything: for a path without rows, what needs it in its location."""
    goes = {keys: victim for keys in locations if (victim := what_goes(header, keys)) is not None}
    rows: dict[Location, set[Location]] = defaultdict(set)
    for victim in goes.values():
        if len(victim) > 2 and victim[-2] == "values" and isinstance(victim[-1], int):
            rows[victim[:-1]].add(victim)
    for parent, lost in rows.items():
        if len(lost) == len(_at(header, parent)):
            instead = what_goes(header, parent)
            for keys, victim in list(goes.items()):
                if victim in lost and instead is not None:
                    goes[keys] = instead
    return goes


def copied(node: Any) -> Any:
    """Copy the objects and lists of a header; arrays stay the same."""
    if isinstance(node, dict):
        return {name: copied(value) for name, value in node.items()}
    return [copied(value) for value in node] if isinstance(node, list) else node


def _is_listed_thing(keys: Location) -> bool:
    """Whether keys lead to a whole sensor or annotation."""
    return len(keys) > 1 and keys[:-2] in ((), _OURS_AT) and keys[-2] in _TYPED_LISTS


_SINGULAR = {"frames": "frame", "images": "image"}


def _in_words(header: Mapping[str, Any], keys: Location) -> str:
    """Name a part of a header for people: "colors of frame 12 of lidar 'top'"."""
    depth = 4 if keys[:2] == _OURS_AT else 2
    if not _is_listed_thing(keys[:depth]):
        return format_keys(keys)
    thing = _at(header, keys[:depth])
    named = isinstance(thing, dict) and isinstance(thing.get("type"), str)
    owner = f"{thing['type']} {thing.get('id')!r}" if named else format_keys(keys[:depth])
    inner = keys[depth:]
    if len(inner) > 1 and inner[0] in _SINGULAR:
        owner, inner = f"{_SINGULAR[str(inner[0])]} {inner[1]} of {owner}", inner[2:]
    inner = inner[1:] if len(inner) > 1 and inner[0] == "points" else inner
    return f"{format_keys(inner)} of {owner}" if inner else owner


class _Numbering:
    """Where the entries of a header's lists were before some were taken out."""

    def __init__(self) -> None:
        """Begin with a whole header."""
        self._before: dict[Location, Sequence[int]] = {}

    def before(self, keys: Location) -> Location:
        """Where something was that is now at `keys`."""
        found: Location = ()
        for key in keys:
            numbers = self._before.get(found)
            known = numbers is not None and isinstance(key, int) and key < len(numbers)
            found = (*found, numbers[int(key)] if numbers is not None and known else key)
        return found

    def frames(self) -> Mapping[Location, Sequence[int]]:
        """The numbers that the frames and images that stay had, by the keys of their list."""
        return {keys: numbers for keys, numbers in self._before.items() if keys[-1] in _OF_FRAMES}

    def follow(self, kept: Mapping[Location, Sequence[int]]) -> None:
        """Follow a removal: which entries stay, by the keys of their list as it was when they were taken out."""
        found = {self.before(keys): (keys, numbers) for keys, numbers in kept.items()}
        for before, (_, numbers) in found.items():
            known = self._before.get(before)
            self._before[before] = [known[k] for k in numbers] if known is not None else numbers


def take_out(header: dict[str, Any], victims: Iterable[Location]) -> Mapping[Location, Sequence[int]]:
    """Remove fields and entries; what counts the frames or images of a sensor is brought into step.

    Returns:
        Which entries stay, by the keys of each list that some were taken out of.
    """
    parents: dict[Location, list[str | int]] = defaultdict(list)
    stay: dict[Location, Sequence[int]] = {}
    for keys in victims:
        parents[keys[:-1]].append(keys[-1])
    counted: list[tuple[Any, str, list[int], int]] = []
    for parent, names in sorted(parents.items(), key=lambda item: len(item[0]), reverse=True):
        node = _at(header, parent)
        if isinstance(node, dict):
            for name in names:
                gone_with = node.pop(str(name), None)
                if name == "video" and isinstance(gone_with, dict):
                    times = gone_with.get("timestamps")
                    counted.append((node.get("id"), "images", [], len(times) if isinstance(times, list) else 0))
            continue
        gone = set(names)
        kept = [k for k in range(len(node)) if k not in gone]
        stay[parent] = kept
        holder = _at(header, parent[:-1])
        if parent[-1] in _OF_FRAMES:
            counted.append((holder.get("id"), str(parent[-1]), kept, len(node)))
        elif parent[-1] == "values":
            times = holder["timestamps"]
            holder["timestamps"] = times[kept] if isinstance(times, np.ndarray) else [times[k] for k in kept]
        elif parent[-1] == "paths":
            _choose(holder, ("labels", "projections"), kept, len(node))
            _renumber(holder, "attributes", "point_index", kept, {})
        holder_of_list: Any = holder
        holder_of_list[parent[-1]] = node[kept] if isinstance(node, np.ndarray) else [node[k] for k in kept]
    for sensor_id, name, kept, count in counted:
        _keep_in_step(header, sensor_id, name, kept, count)
    return stay


def _keep_in_step(header: dict[str, Any], sensor_id: Any, name: str, kept: Sequence[int], count: int) -> None:
    """Follow frames or images that were taken out in our notes, and in labelled points."""
    for note in _records(header, (*_OURS_AT, "sensor_notes")):
        if note.get("id") == sensor_id:
            for holder in (note, note.get("images")):
                _choose(holder, _OF_FRAMES[name], kept, count)
    if name == "frames":
        for root in ((), _OURS_AT):
            for annotation in _records(header, (*root, "annotations")):
                _renumber(annotation, "labeled_points", "sensor_frame", kept, {"sensor_id": sensor_id})


def _at(header: Mapping[str, Any], keys: Location) -> Any:
    node: Any = header
    for key in keys:
        node = node[key]
    return node


def _choose(holder: Any, names: tuple[str, ...], kept: Sequence[int], count: int) -> None:
    for name in names:
        values = holder.get(name) if isinstance(holder, dict) else None
        if isinstance(values, list) and len(values) == count:
            holder[name] = [values[k] for k in kept]


def _renumber(
    annotation: dict[str, Any], name: str, field: str, kept: Sequence[int], wanted: Mapping[str, Any]
) -> None:
    """Give the entries of a list that count something by a field new numbers; those of what is gone go, too."""
    entries = annotation.get(name)
    if not isinstance(entries, list):
        return
    new_numbers = {old: new for new, old in enumerate(kept)}
    renumbered = []
    for entry in entries:
        counts = isinstance(entry, dict) and type(entry.get(field)) is int
        if not counts or any(entry.get(key) != value for key, value in wanted.items()):
            renumbered.append(entry)
        elif entry[field] in new_numbers:
            renumbered.append({**entry, field: new_numbers[entry[field]]})
    annotation[name] = renumbered


def _records(header: Mapping[str, Any], keys: Location) -> list[dict[str, Any]]:
    node: Any = header
    for key in keys:
        node = node.get(key) if isinstance(node, dict) else None
    return [entry for entry in node if isinstance(entry, dict)] if isinstance(node, list) else []


def _read_trajectories(
    records: Any, sensors: tuple[Sensor, ...], location: Location, faults: Faults
) -> Mapping[str, Trajectory]:
    """Collect the trajectories of the ego: those of our metadata in their order, then one per odometry sensor."""
    odometry = {
        str(sensor.id): Trajectory(
            str(sensor.id), sensor.poses.timestamps_ns, sensor.poses.positions, sensor.poses.quaternions_xyzw
        )
        for sensor in sensors
        if isinstance(sensor, OdometrySensor)
    }
    trajectories: dict[str, Trajectory] = {}
    for index, record in enumerate(records if isinstance(records, list) else []):
        of_sensor = odometry.get(str(record.get("sensor_id")))
        rows = record.get("covariances")
        try:
            name, covariances = record["name"], None if rows is None else rows.reshape(-1, 6, 6)
            if record.get("timestamps_ns") is None and of_sensor is not None:
                trajectories[name] = replace(of_sensor, name=name, covariances=covariances)
                continue
            trajectories[name] = Trajectory(
                name,
                record["timestamps_ns"],
                record["positions"],
                record.get("quaternions_xyzw"),
                record.get("file_seconds"),
                covariances,
            )
        except (ArrayError, KeyError) as error:
            faults.add((*location, index), f"no trajectory: {error}")
    for name, trajectory in odometry.items():
        trajectories.setdefault(name, trajectory)
    return trajectories
