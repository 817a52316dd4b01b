"""A map as a scene file: one cloud without time, and its labels as annotations; its arrays rest on the disk."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.formats.clouds.written import WrittenPoints
from sceneloom.formats.sfs.writer import SceneWriter
from sceneloom.pipeline.colouring.sinks import label_annotation, rows_of_labels
from sceneloom.scene.annotations.labelled_points import LabeledPoints
from sceneloom.scene.clouds import PointsSensor
from sceneloom.scene.types import Identifier

MAP_ID = "map"

_KINDS = {"positions": ("f4", 3), "colors": ("u1", 3), "labels": ("u2", 1)}


@dataclass(slots=True)
class MapScene:
    """Writes points piece by piece to files, and at the end those as one sensor of a scene.

    Attributes:
        writer: the open scene file.
        folder: an empty folder for the files in between.
        names: what labels are called, as far as it is stated.
    """

    writer: SceneWriter
    folder: Path
    names: Mapping[int, str]
    _files: dict[str, BinaryIO] = field(default_factory=dict)

    def add(self, points: WrittenPoints) -> None:
        """Take some more points."""
        columns: dict[str, AnyArray | None] = {
            "positions": points.positions_world.astype(np.float32),
            "colors": points.colors,
            "labels": points.labels,
        }
        for name, values in columns.items():
            if values is not None:
                if name not in self._files:
                    self._files[name] = (self.folder / name).open("wb")
                self._files[name].write(np.ascontiguousarray(values).tobytes())

    def close(self) -> None:
        """Write the sensor and the labels; the scene file is completed by who opened it."""
        for file in self._files.values():
            file.close()
        positions = self._column("positions")
        colors = self._column("colors") if "colors" in self._files else None
        self.writer.add_sensor(PointsSensor(MAP_ID, positions, colors))
        if "labels" in self._files:
            taken: set[Identifier] = set()
            for label, rows in rows_of_labels(self._column("labels")[:, 0]):
                entries = (LabeledPoints(MAP_ID, rows),)
                self.writer.add_annotation(label_annotation(label, entries, self.names, taken))
        self.writer.finish()

    def _column(self, name: str) -> AnyArray:
        kind, width = _KINDS[name]
        path = self.folder / name
        if name not in self._files or not path.stat().st_size:
            return np.zeros((0, width), kind)
        column: AnyArray = np.memmap(path, kind, mode="r").reshape(-1, width)
        return column
