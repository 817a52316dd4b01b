"""What the readers of sensors and annotations share: the open file, its clock, options, warnings and faults."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import MALFORMED, PlacedFault
from sceneloom.formats.sfs.clock import FileClock
from sceneloom.formats.sfs.container import ITEMS, Container, ItemFault, format_keys
from sceneloom.formats.sfs.records import Fault, Faults, Location, RecordReader
from sceneloom.formats.sfs.spec import ReadingOptions
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

    def warning(self, kind: WarningKind, code: str, location: Location, message: str, *, count: int = 1) -> None:
        """Note something, unless the file's own warnings state it already."""
        warning = DataWarning(kind=kind, code=code, location=format_keys(location), message=message, count=count)
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
            fault = PlacedFault(item.path or f"{ITEMS}[{item.number}]", item.problem, "item", item=item.number)
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
        kept = not faults.unrepaired
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


OURS = "sceneloom"
"""Our entry of the scene's metadata."""


def root_fault(source: Source, location: Location, problem: str, *, code: str = MALFORMED) -> None:
    """Note what is wrong at the root, without which no scene means anything."""
    faults = Faults()
    faults.add(location, problem, code=code)
    source.collect(faults, ())
