"""The faults of a whole file, each with its place, and the error that tells of them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sceneloom.errors import DataError
from sceneloom.formats.faults import PlacedFault
from sceneloom.formats.sfs.container import format_keys
from sceneloom.formats.sfs.records import Place
from sceneloom.scene.notices import Notice
from sceneloom.scene.scene import Scene

_TOLD = 4
"""So many places of further faults stand in an error."""


@dataclass(frozen=True, slots=True)
class Loss:
    """A part of a file that is at fault and not in the scene.

    Attributes:
        keys: where it is in the file.
        words: what it is, for people (`frame 12 of lidar 'top'`).
        problem: what is wrong.
        lost_bytes: how much of an array is not there, where it is known.
    """

    keys: Place
    words: str
    problem: str
    lost_bytes: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Examination:
    """A file with all that is wrong in it.

    Attributes:
        scene: what is sound, and what could be brought into order; None where nothing can be read.
        faults: part by part in the order of the file.
        header: the file's header without `$items`, arrays in their places; None where it cannot be decoded.
        sensor_places: where each sensor of the scene stands in the file.
        annotation_places: where each annotation of the scene stands in the file.
        notices: what was assumed, repaired or left out this time; the scene has those that the file had kept, too.
        fetch: gives arrays of the header with their values, which those of a file behind a URL may lack.
        losses: what is not in the scene; only where what is whole was asked for.
        frame_numbers: the numbers in the file of the frames and images that stay, by the path of their list, where some
            of a list were left out.
    """

    scene: Scene | None
    faults: tuple[PlacedFault, ...]
    header: dict[str, Any] | None = None
    sensor_places: tuple[Place, ...] = ()
    annotation_places: tuple[Place, ...] = ()
    notices: tuple[Notice, ...] = ()
    fetch: Callable[[Any], Any] | None = None
    losses: tuple[Loss, ...] = ()
    frame_numbers: Mapping[str, Sequence[int]] = field(default_factory=dict)

    @property
    def sensor_paths(self) -> tuple[str, ...]:
        """The places of the sensors in words."""
        return tuple(map(format_keys, self.sensor_places))

    @property
    def annotation_paths(self) -> tuple[str, ...]:
        """The places of the annotations in words."""
        return tuple(map(format_keys, self.annotation_places))


def error_of(file: str, faults: Sequence[PlacedFault]) -> DataError:
    """The error of a file with at least one fault: the first with its problem, the places of the next ones."""
    first, others = faults[0], faults[1:]
    problem = first.problem
    if others:
        problem += "; also at fault: " + ", ".join(fault.where for fault in others[:_TOLD])
    if len(others) > _TOLD:
        problem += f" and {len(others) - _TOLD} more; `sceneloom validate FILE` lists all"
    return DataError(file, first.where, problem)
