"""The faults of a whole file, each with its location, and the error that reports them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sceneloom.errors import DataError
from sceneloom.formats.faults import PlacedFault
from sceneloom.formats.sfs.container import format_keys
from sceneloom.formats.sfs.records import Location
from sceneloom.scene.scene import Scene
from sceneloom.scene.warnings import DataWarning

_REPORTED = 4
"""So many locations of further faults stand in an error."""


@dataclass(frozen=True, slots=True)
class Loss:
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
    losses: tuple[Loss, ...] = ()
    frame_numbers: Mapping[str, Sequence[int]] = field(default_factory=dict)

    @property
    def sensor_paths(self) -> tuple[str, ...]:
        """The locations of the sensors in words."""
        return tuple(map(format_keys, self.sensor_positions))

    @property
    def annotation_paths(self) -> tuple[str, ...]:
        """The locations of the annotations in words."""
        return tuple(map(format_keys, self.annotation_positions))


def error_of(file: str, faults: Sequence[PlacedFault]) -> DataError:
    """The error of a file with at least one fault: the first with its problem, the locations of the next ones."""
    first, others = faults[0], faults[1:]
    problem = first.problem
    if others:
        problem += "; also at fault: " + ", ".join(fault.where for fault in others[:_REPORTED])
    if len(others) > _REPORTED:
        problem += f" and {len(others) - _REPORTED} more; `sceneloom validate FILE` lists all"
    return DataError(file, first.where, problem)
