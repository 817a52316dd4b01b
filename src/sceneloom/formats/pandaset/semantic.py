"""Classes of points as labelled points, read when the first of them is asked for."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, overload

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.pandaset.cuboids import timestamps_of
from sceneloom.formats.pandaset.pickled_frames import PickledFrame, read_pickled_frame
from sceneloom.formats.pandaset.sensors import LIDARS, Sweeps, rows_of_lidar
from sceneloom.formats.pandaset.text_files import read_json
from sceneloom.scene.annotations.labelled_points import LabeledPoints, LabeledPointsAnnotation

ID_PREFIX = "semseg:"
"""What ids of the annotations begin with, before the name of the class."""


class LabelFiles:
    """The classes of all points of a drive: a table for each sweep, in memory from the first use on.

    Classes of one drive are a byte a point, while finding them takes seconds, and each class asks for all.
    """

    def __init__(self, files: Mapping[int, tuple[Path, Path]], classes: Mapping[int, str]) -> None:
        """Take the files of classes and of points by number of the sweep; nothing is read."""
        self.files, self.classes = files, classes
        self._found: dict[int, list[LabeledPoints]] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_found": None}

    def of(self, number: int) -> list[LabeledPoints]:
        """The points of a class.

        Raises:
            DataError: a file is wrong, or has another number of rows than its sweep.
        """
        if self._found is None:
            self._found = self._read()
        return self._found.get(number, [])

    def _read(self) -> dict[int, list[LabeledPoints]]:
        found: dict[int, list[LabeledPoints]] = {}
        for k, (labels, points) in self.files.items():
            table, cloud = read_pickled_frame(labels), read_pickled_frame(points)
            numbers = self._numbers(table, cloud)
            for lidar, name in enumerate(LIDARS):
                own = numbers[rows_of_lidar(cloud, lidar)]
                order = np.argsort(own, kind="stable").astype(np.uint32)
                kinds, starts = np.unique(own[order], return_index=True)
                for kind, rows in zip(kinds.tolist(), np.split(order, starts[1:]), strict=True):
                    found.setdefault(kind, []).append(LabeledPoints(name, rows, k))
        return found

    def _numbers(self, table: PickledFrame, cloud: PickledFrame) -> Int64Array:
        """(N,) int64, the class of each point; files have them as numbers or as texts of numbers."""
        column = table.column("class")
        try:
            numbers = column.astype(np.int64)
        except (ValueError, TypeError, OverflowError) as error:
            raise DataError(table.file, "class", f"expected numbers of classes: {error}") from error
        if len(numbers) != cloud.count:
            problem = f"{len(numbers)} rows; expected {cloud.count}, one for each point of {cloud.file.name}"
            raise DataError(table.file, "", problem)
        unknown = set(np.unique(numbers).tolist()) - set(self.classes)
        if unknown:
            raise DataError(table.file, "class", f"{min(unknown)}; expected a number out of classes.json")
        return numbers


@dataclass(frozen=True, slots=True, eq=False)
class ClassPoints(Sequence[LabeledPoints]):
    """The points of one class, sweep by sweep."""

    labels: LabelFiles
    number: int

    def __len__(self) -> int:
        return len(self.labels.of(self.number))

    def __iter__(self) -> Iterator[LabeledPoints]:
        return iter(self.labels.of(self.number))

    @overload
    def __getitem__(self, index: int) -> LabeledPoints: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[LabeledPoints]: ...
    def __getitem__(self, index: int | slice) -> LabeledPoints | Sequence[LabeledPoints]:
        return self.labels.of(self.number)[index]


def build_labelled_points(drive: Path, sweeps: Sweeps) -> tuple[LabeledPointsAnnotation, ...]:
    """Build an annotation for each class that classes.json names; () where the drive has no such labels.

    Raises:
        DataError: classes.json is missing or wrong, or a file has no sweep.
    """
    folder = drive / "annotations" / "semseg"
    timestamps = timestamps_of(folder, sweeps)
    if not timestamps:
        return ()
    names = read_json(folder / "classes.json", dict[int, str])
    rows = {int(t): k for k, t in enumerate(sweeps.timestamps_ns)}
    files = {rows[t]: (file, sweeps.files[rows[t]]) for file, t in timestamps.items()}
    labels = LabelFiles(files, names)
    return tuple(
        LabeledPointsAnnotation(
            id=f"{ID_PREFIX}{name}",
            labeled_points=cast("tuple[LabeledPoints, ...]", ClassPoints(labels, number)),
            label=name,
            is_instance=False,
        )
        for number, name in sorted(names.items())
    )
