"""All annotations of a scene as a few long arrays, made once for all rules."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array
from sceneloom.checks.rule import Hit, Subject
from sceneloom.scene.annotations import Box2DAnnotation, CuboidAnnotation, PointsAnnotation, ShapeAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.types import key_of


@dataclass(frozen=True, slots=True, eq=False)
class PartTable:
    """Parts of annotations of one kind, such as all paths of cuboids, their rows one after another.

    Attributes:
        parts: P objects with timestamps (`CuboidPath`, `Projection`, …).
        numbers: (P,) int64, number of the annotation of each.
        suffixes: where each stands inside its annotation (`.path`, `.projections[1]`).
        starts: (P + 1,) int64, first row of each part.
        timestamps_ns: (R,) int64 [ns], those of all parts.
    """

    parts: Sequence[Any]
    numbers: Int64Array
    suffixes: Sequence[str]
    starts: Int64Array
    timestamps_ns: Int64Array

    @classmethod
    def of(cls, entries: Sequence[tuple[int, str, Any]]) -> "PartTable":
        """Line up parts, each with the number of its annotation and its location in there."""
        parts = [part for _, _, part in entries]
        times = [part.timestamps_ns for part in parts]
        starts = np.fromiter(accumulate(map(len, times), initial=0), np.int64, len(times) + 1)
        return cls(
            parts,
            np.array([number for number, _, _ in entries], np.int64),
            [suffix for _, suffix, _ in entries],
            starts,
            np.concatenate(times) if times else np.zeros(0, np.int64),
        )

    @property
    def owners(self) -> Int64Array:
        """(R,) int64: the part that each row belongs to."""
        return np.repeat(np.arange(len(self.parts)), np.diff(self.starts))

    @property
    def inner(self) -> BoolArray:
        """(R - 1,) bool: whether a row and the next one belong to one part."""
        inner = np.ones(max(len(self.timestamps_ns) - 1, 0), bool)
        ends = self.starts[1:-1]
        inner[ends[(ends > 0) & (ends < len(self.timestamps_ns))] - 1] = False
        return inner

    def rows(self, values: Callable[[Any], AnyArray], columns: int) -> Float64Array:
        """Join what the parts hold, (R, columns) float64."""
        arrays = [values(part) for part in self.parts]
        return np.concatenate(arrays) if arrays else np.zeros((0, columns))

    def location(self, subject: Subject, part: int) -> str:
        """Where a part stands in the file."""
        return subject.annotation_paths[int(self.numbers[part])] + self.suffixes[part]

    def hits(self, subject: Subject, bad: BoolArray, state: Callable[[int], str], *, within: str = "") -> Iterator[Hit]:
        """Give one hit for each part that has rows at fault.

        Args:
            bad: (R,) bool, which rows are.
            state: gives the message for a row.
            within: what of the part is at fault (`.values`); the position of its first row at fault is named.
        """
        rows = np.flatnonzero(bad)
        if len(rows) == 0:
            return
        parts = np.searchsorted(self.starts, rows, side="right") - 1
        firsts = np.flatnonzero(np.diff(parts, prepend=-1))
        counts = np.diff(firsts, append=len(rows))
        for first, count in zip(firsts.tolist(), counts.tolist(), strict=True):
            row, part = int(rows[first]), int(parts[first])
            inside = f"{within}[{row - int(self.starts[part])}]" if within else ""
            yield Hit(self.location(subject, part) + inside, state(row), count=count)


def annotation_parts(subject: Subject, kind: str) -> PartTable:
    """All paths of "cuboids", "boxes", "shapes" or named "points", or all of another kind of `PART_KINDS`."""
    return subject.table("parts of annotations", _made_tables)[kind]


_Entries = list[tuple[int, str, Any]]
PART_KINDS = ("cuboids", "activations", "projections", "point_projections", "boxes", "shapes", "points")


def _made_tables(subject: Subject) -> dict[str, PartTable]:
    entries: dict[str, _Entries] = {name: [] for name in PART_KINDS}
    for number, annotation in enumerate(subject.scene.annotations):
        if isinstance(annotation, CuboidAnnotation):
            entries["cuboids"].append((number, ".path", annotation.path))
            if annotation.activations:
                _add(entries["activations"], number, ".activations", annotation.activations)
            if annotation.projections:
                _add(entries["projections"], number, ".projections", annotation.projections)
        elif isinstance(annotation, Box2DAnnotation):
            entries["boxes"].append((number, ".path", annotation.path))
        elif isinstance(annotation, ShapeAnnotation):
            entries["shapes"].append((number, ".path", annotation.path))
        elif isinstance(annotation, PointsAnnotation):
            _add(entries["points"], number, ".paths", annotation.paths)
            for k, of_point in enumerate(annotation.projections):
                _add(entries["point_projections"], number, f".projections[{k}]", of_point)
    return {name: PartTable.of(found) for name, found in entries.items()}


def _add(entries: _Entries, number: int, name: str, parts: Sequence[Any]) -> None:
    entries.extend((number, f"{name}[{k}]", part) for k, part in enumerate(parts))


def camera_rows(subject: Subject, table: PartTable) -> Iterator[tuple[CameraSensor, Int64Array]]:
    """Give each camera with the rows of a table that are about it, (K,) int64; cameras without rows are left out."""
    numbers = {key_of(camera.id): n for n, camera in enumerate(subject.scene.cameras)}
    annotations = subject.scene.annotations
    owners = [
        part if hasattr(part, "sensor_id") else annotations[number]
        for part, number in zip(table.parts, table.numbers.tolist(), strict=True)
    ]
    of_parts = [numbers.get((type(owner.sensor_id), owner.sensor_id), -1) for owner in owners]
    of_rows = np.repeat(np.array(of_parts, np.int64), np.diff(table.starts))
    for number, camera in enumerate(subject.scene.cameras):
        rows = np.flatnonzero(of_rows == number)
        if len(rows):
            yield camera, rows
