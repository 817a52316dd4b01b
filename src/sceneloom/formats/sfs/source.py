"""What the readers of sensors and annotations share: the file, its clock, what was asked for, what was noticed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sceneloom.formats.faults import PlacedFault
from sceneloom.formats.sfs.container import ITEMS, Container, ItemFault, format_keys
from sceneloom.formats.sfs.file_parts import FileParts
from sceneloom.formats.sfs.records import Fault, Faults, Location, RecordReader
from sceneloom.formats.sfs.spec import ReadingOptions
from sceneloom.formats.sfs.times import FileClock
from sceneloom.scene.types import Identifier
from sceneloom.scene.warnings import DataWarning, WarningKind


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
