"""What the readers of sensors and annotations share: the file, its clock, what was asked for, what was noticed."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sceneloom.errors import DataError, OptionError
from sceneloom.formats.sfs.container import Container, format_keys
from sceneloom.formats.sfs.file_parts import FileParts
from sceneloom.formats.sfs.records import Fault, Faults, Place, RecordReader
from sceneloom.formats.sfs.times import FileClock
from sceneloom.geometry.euler import ORDERS, AngleUnit
from sceneloom.scene import Identifier, Notice, NoticeKind, PointsFrame


@dataclass(frozen=True, slots=True)
class ReadingOptions:
    """What the caller says about a file that the file does not say itself.

    Attributes:
        points_frame: the frame of lidar and radar points; None: as recorded, else the one that `coordinates` names.
        euler_unit: unit of the angles of cuboids; None: as recorded, else degrees.
        euler_order: order of the rotations of cuboids; None: as recorded, else xyz.
        lenient: leave out sensors and annotations that are at fault, with a notice each.

    Raises:
        OptionError: a value is not one of those that there are.
    """

    points_frame: PointsFrame | None = None
    euler_unit: str | None = None
    euler_order: str | None = None
    lenient: bool = False

    def __post_init__(self) -> None:
        for name, known in (("euler_unit", tuple(AngleUnit)), ("euler_order", ORDERS)):
            if getattr(self, name) not in (None, *known):
                raise OptionError(f"{name} {getattr(self, name)!r}; expected one of {', '.join(known)}")
        frames = [frame.value for frame in PointsFrame]
        if self.points_frame is not None and self.points_frame not in frames:
            raise OptionError(f"points_frame {self.points_frame!r}; expected one of {', '.join(frames)}")


@dataclass(slots=True)
class Source:
    """A file that is being read.

    Attributes:
        container: the open file.
        parts: what the scene keeps of it.
        clock: of the file.
        options: of the caller.
        notices: collected on the way.
        notes: what our metadata says about sensors, by id.
    """

    container: Container
    parts: FileParts
    clock: FileClock
    options: ReadingOptions
    notices: list[Notice] = field(default_factory=list)
    notes: dict[tuple[type, Identifier], Mapping[str, Any]] = field(default_factory=dict)

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

    def notice(self, kind: NoticeKind, code: str, place: Place, message: str, *, count: int = 1) -> None:
        """Remark something, unless the file's own notices say it already."""
        notice = Notice(kind=kind, code=code, place=format_keys(place), message=message, count=count)
        if notice not in self.notices:
            self.notices.append(notice)

    def raise_faults(self, faults: Faults, place: Place) -> None:
        """Raise the first fault, if there is one, and say how many more there are.

        Raises:
            DataError: naming the place, and the item where an array is at fault.
        """
        if faults:
            others = len(faults) - 1
            more = f"; and {others} more fault{'s' * (others > 1)}" if others else ""
            raise DataError(self.file, self._where(place, faults[0]), faults[0].problem + more)

    def settle(self, faults: Faults, place: Place) -> bool:
        """Say whether a part is sound; one that is not is left out if the caller is lenient.

        Raises:
            DataError: the part is at fault and the caller is not lenient.
        """
        if not faults:
            return True
        if not self.options.lenient:
            self.raise_faults(faults, place)
        message = f"left out: {self._where(place, faults[0])}: {faults[0].problem}"
        self.notice(NoticeKind.SKIPPED, "at-fault", place, message, count=len(faults))
        return False

    def _where(self, place: Place, fault: Fault) -> str:
        where = format_keys((*place, *fault.place))
        number = self.container.item_number(where)
        return where if number is None else f"{where} ($items[{number}])"
