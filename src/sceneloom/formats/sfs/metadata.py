"""What the readers of sensors and annotations share: the file, reading options, version, clock and metadata.

And how camera intrinsics are to be understood.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import msgspec

from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import MALFORMED, PlacedFault
from sceneloom.formats.sfs.clock import (
    EARLIEST_OFFSET_NS,
    INT64_MAX,
    READABLE_TICKS_NS,
    FileClock,
    TimeRangeError,
    scaled,
)
from sceneloom.formats.sfs.container import ITEMS, Container, ItemFault, format_keys
from sceneloom.formats.sfs.records import Fault, Faults, Location, RecordReader
from sceneloom.formats.sfs.spec import BROWN, OPENCV, TANGENTIALS, ReadingOptions
from sceneloom.scene.scene import Scene, with_assumed_models
from sceneloom.scene.types import Identifier
from sceneloom.warnings import DataWarning, WarningKind


class Indexed(Protocol):
    """A video of the file, whose list of images is worth taking along."""

    index: Any


class FileParts:
    """The functions of an open file by name.

    Where it was pickled, it opens the file again when the first of them is called, makes the same functions from it,
    and takes the lists of images of the videos along, for which they would have to be read from end to end.
    Closing it closes nothing in other processes; what is pickled after closing stays closed.

    Attributes:
        videos: the videos of the file by the position of their bytes.
    """

    def __init__(self, container: Container, reopen: "Callable[[Path | str], FileParts]") -> None:
        """Hold an open file.

        Args:
            container: the file.
            reopen: opens it again in another process and keeps the same parts; a function that can be pickled.
        """
        self._container: Container | None = container
        self._identity = container.identity
        self._reopen = reopen
        self._functions: dict[str, Callable[..., Any]] = {}
        self._indices: dict[str, Any] = {}
        self._closed = False
        self._again: FileParts | None = None
        self.videos: dict[str, Indexed] = {}

    def keep(self, name: str, function: Callable[..., Any]) -> "FilePart":
        """Keep a function of the file under a name, and give what stands for it in a scene."""
        self._functions[name] = function
        return FilePart(self, name)

    def function(self, name: str) -> Callable[..., Any]:
        """Find a function by its name; opens the file if this process has not done so.

        Raises:
            DataError: the file cannot be opened again, is another one now, or the scene was closed.
        """
        if self._container is None:
            return self._opened_again(name).function(name)
        return self._functions[name]

    def close(self) -> None:
        """Close the file in this process."""
        self._closed = True
        if self._container is not None:
            self._container.close()
        if self._again is not None:
            self._again.close()

    def __getstate__(self) -> dict[str, Any]:
        known = {location: video.index for location, video in self.videos.items() if video.index is not None}
        return {
            "_identity": self._identity,
            "_reopen": self._reopen,
            "_indices": {**self._indices, **known},
            "_closed": self._closed,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._container, self._again, self._functions, self.videos = None, None, {}, {}

    def _opened_again(self, name: str) -> "FileParts":
        if self._closed:
            raise DataError(self._identity.name, name, "the scene is closed; read its frames before that")
        if self._again is None:
            self._identity.check()
            again = self._reopen(self._identity.path)
            for location, index in self._indices.items():
                again.videos[location].index = index
            self.videos, self._again = again.videos, again
        return self._again


@dataclass(frozen=True, slots=True, eq=False)
class FilePart:
    """A function of a file, that finds the file again wherever it is called."""

    parts: FileParts
    name: str

    def __call__(self, *arguments: Any) -> Any:
        """Call it."""
        return self.parts.function(self.name)(*arguments)


@dataclass(slots=True)
class Source:
    """A file that is being read.

    Attributes:
        container: the open file.
        parts: what the scene keeps of it.
        clock: of the file.
        options: of the caller.
        warnings: collected on the way, and those that the file had kept.
        noticed_now: those of this reading, in their order.
        notes: what our metadata says about sensors, by id.
        faults: collected on the way.
        left_out: the locations of sensors and annotations that are at fault.
        tangential: what p1 and p2 of `brown_conrady` mean as our metadata state, None where they state nothing.
    """

    container: Container
    parts: FileParts
    clock: FileClock
    options: ReadingOptions
    warnings: list[DataWarning] = field(default_factory=list)
    noticed_now: dict[DataWarning, None] = field(default_factory=dict)
    notes: dict[tuple[type, Identifier], Mapping[str, Any]] = field(default_factory=dict)
    faults: list[PlacedFault] = field(default_factory=list)
    left_out: set[Location] = field(default_factory=set)
    _noticed: set[DataWarning] = field(default_factory=set)
    tangential: str | None = None

    @property
    def file(self) -> str:
        """Name of the file."""
        return self.container.file

    def reader(self, *, forgiving: bool = False) -> RecordReader:
        """Give a reader of records."""
        return RecordReader(self.clock, forgiving)

    def note(self, sensor_id: Identifier) -> Mapping[str, Any]:
        """What our metadata says about a sensor."""
        return self.notes.get((type(sensor_id), sensor_id), {})

    def warning(
        self, kind: WarningKind, code: str, location: Location, message: str, *, count: int = 1
    ) -> None:
        """Note something, unless the file's own warnings state it already."""
        warning = DataWarning(
            kind=kind, code=code, location=format_keys(location), message=message, count=count
        )
        self.noticed_now[warning] = None
        if warning not in self._noticed:
            self.remember(warning)

    def remember(self, warning: DataWarning) -> None:
        """Take a warning as it is."""
        self.warnings.append(warning)
        self._noticed.add(warning)

    def collect(self, faults: Faults, location: Location) -> None:
        """Note faults of what no scene can do without; whoever is lenient is refused for them, too."""
        self.faults.extend(self._placed(fault, location, vital=True) for fault in faults)

    def collect_items(self, items: Sequence[ItemFault]) -> None:
        """Note faults of arrays; nothing stands in their locations."""
        for item in items:
            fault = PlacedFault(
                item.path or f"{ITEMS}[{item.number}]", item.problem, "item", item=item.number
            )
            self.faults.append(fault)
            if self.options.lenient:
                message = f"left out: {fault.where}: {item.problem}"
                self.warning(WarningKind.SKIPPED, "item-at-fault", item.keys or (ITEMS, item.number), message)

    def found_faults(self) -> tuple[PlacedFault, ...]:
        """All faults, but not that a value is missing whose array is at fault."""
        arrays = {fault.path for fault in self.faults if fault.code == "item"}
        return tuple(f for f in self.faults if f.code == "item" or f.path not in arrays)

    def settle(self, faults: Faults, location: Location) -> bool:
        """Note the faults of a part, and report whether the scene can have it: it is sound.

        Or was brought into order.
        """
        self.faults.extend(self._placed(fault, location, vital=False) for fault in faults)
        if not faults:
            return True
        kept = not faults.unmended
        if not kept:
            self.left_out.add(location)
        if self.options.lenient:
            kind = WarningKind.REPAIRED if kept else WarningKind.SKIPPED
            first = self.faults[-len(faults)]
            message = f"{'repaired' if kept else 'left out'}: {first.where}: {first.problem}"
            self.warning(kind, "repaired" if kept else "at-fault", location, message, count=len(faults))
        return kept

    def _placed(self, fault: Fault, location: Location, *, vital: bool) -> PlacedFault:
        path = format_keys((*location, *fault.location))
        number = self.container.item_number(path)
        return PlacedFault(path, fault.problem, fault.code, repaired=fault.repaired, vital=vital, item=number)


_P1, _P2 = 2, 3


def _note_tangential(source: Source, ours: Mapping[str, Any]) -> None:
    """Take what our metadata state of p1 and p2, and report a caller who says otherwise that it counts."""
    recorded = ours.get("tangential")
    source.tangential = recorded if recorded in TANGENTIALS else None
    if source.tangential is not None and source.options.tangential not in (None, source.tangential):
        message = f"p1 and p2 are recorded to be as in {source.tangential}; they are not exchanged again"
        source.warning(
            WarningKind.ASSUMED, "tangential-recorded", ("metadata", "sceneloom", "tangential"), message
        )


def in_opencvs_sense(camera: Camera, source: Source) -> Camera:
    """Exchange p1 and p2 where the file has them the other way round."""
    if camera.model != "brown_conrady" or (source.tangential or source.options.tangential) != BROWN:
        return camera
    padded = (*camera.coefficients, 0.0, 0.0, 0.0, 0.0)[: max(len(camera.coefficients), _P2 + 1)]
    return replace(camera, coefficients=(*padded[:_P1], padded[_P2], padded[_P1], *padded[_P2 + 1 :]))


def camera_model_records(source: Source) -> dict[str, str]:
    """What our metadata are to state of p1 and p2 from now on."""
    stated = source.tangential or source.options.tangential
    if stated is None:
        return {}
    return {"tangential": OPENCV, **({"tangential_before": BROWN} if stated == BROWN else {})}


def with_camera_model_readings(scene: Scene, source: Source) -> Scene:
    """The scene that may be computed with as the caller stated."""
    return with_assumed_models(scene) if source.options.assume_model else scene


_VERSIONS = ("1.0", "5.1")
"""Beginnings of the versions that we read."""

DEFAULT_TICK_NS = READABLE_TICKS_NS["microseconds"]
"""Length of a tick where the file does not state its unit [ns]."""

OURS = "sceneloom"
"""Our entry of the scene's metadata."""


def check_version(source: Source) -> None:
    """Note a version that is none of those that we read."""
    version = source.container.header.get("version")
    if not isinstance(version, str) or not version.startswith(_VERSIONS):
        expected = " or ".join(f"{known}*" for known in _VERSIONS)
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
    ours = _without_faulty(ours, faults)
    _note_tangential(source, ours)
    for note in ours.get("sensor_notes") or []:
        source.notes[type(note["id"]), note["id"]] = note
    for record in ours.get("warnings") or []:
        try:
            source.remember(msgspec.convert(record, DataWarning))
        except msgspec.ValidationError as error:
            root_fault(source, ("metadata", OURS, "warnings"), str(error))
    return ours


def _without_faulty(ours: dict[str, Any], faults: Faults) -> dict[str, Any]:
    """A record without the entries of its lists that are at fault."""
    wrong = {fault.location[:2] for fault in faults}
    return {
        name: [item for k, item in enumerate(value) if (name, k) not in wrong]
        if isinstance(value, list)
        else value
        for name, value in ours.items()
    }
