"""PCD files written piece by piece: binary, positions as float32 from an origin near them.

Source: "The PCD (Point Cloud Data) file format" of the Point Cloud Library's documentation, version 0.7; its types
PointXYZRGB (colour packed into one float) and PointXYZL (label, uint32).
"""

from pathlib import Path
from typing import BinaryIO

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array
from sceneloom.formats.clouds.written import Column, WrittenPoints, records_of, seconds

FARTHEST_EXACT = 4000.0
"""Farther from 0 than this [m], float32 is coarser than a quarter of a millimetre: positions count from an origin."""

_LETTERS = {"u": "U", "i": "I", "f": "F"}
_DIGITS = 12


def _packed(points: WrittenPoints) -> AnyArray | None:
    """Colours as the bytes of a float: blue, green, red, and one that is 0."""
    if points.colors is None:
        return None
    whole = points.colors.astype(np.uint32)
    return ((whole[:, 0] << 16) | (whole[:, 1] << 8) | whole[:, 2]).view(np.float32)


class PcdWriter:
    """An open PCD file. The number of its points is written into the room that its head has for it at the end.

    Attributes:
        origin_world: (3,) float64 [m], what positions count from: 0, unless the first points lie far from it; whole
            metres. It stands in a comment of the head.
    """

    def __init__(self, path: Path) -> None:
        """Begin a file, which must not be there."""
        self._file: BinaryIO = path.open("xb")
        self._count = 0
        self._locations: tuple[int, ...] = ()
        self.origin_world: Float64Array = np.zeros(3)

    def add(self, points: WrittenPoints) -> None:
        """Write some more points."""
        if not self._locations:
            self._choose_origin(points)
        records = records_of(points, self._columns)
        if not self._locations:
            self._begin(records)
        self._file.write(records.tobytes())
        self._count += len(points)

    @property
    def _columns(self) -> tuple[Column, ...]:
        def position(axis: int) -> Column:
            return (
                "xyz"[axis],
                "f4",
                lambda points: points.positions_world[:, axis] - self.origin_world[axis],
            )

        return (
            position(0),
            position(1),
            position(2),
            ("rgb", "f4", _packed),
            ("intensity", "f4", lambda points: points.intensities),
            ("time", "f8", seconds),
            ("label", "u4", lambda points: points.labels),
        )

    def _choose_origin(self, points: WrittenPoints) -> None:
        finite = points.positions_world[np.isfinite(points.positions_world).all(axis=1)]
        if len(finite) and np.abs(finite).max() > FARTHEST_EXACT:
            self.origin_world = np.rint(finite.mean(axis=0))

    def _begin(self, records: AnyArray) -> None:
        names = records.dtype.names or ()
        kinds = [records.dtype[name] for name in names]
        x, y, z = self.origin_world.tolist()
        lines = [
            "# .PCD v0.7 - Point Cloud Data file format",
            f"# world coordinates in metres from {x:.0f} {y:.0f} {z:.0f}, times in seconds",
            "VERSION 0.7",
            f"FIELDS {' '.join(names)}",
            f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}",
            f"TYPE {' '.join(_LETTERS[kind.kind] for kind in kinds)}",
            f"COUNT {' '.join('1' for _ in names)}",
        ]
        self._file.write("\n".join([*lines, "WIDTH "]).encode())
        width = self._file.tell()
        self._file.write(b"0" * _DIGITS + b"\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS ")
        self._locations = (width, self._file.tell())
        self._file.write(b"0" * _DIGITS + b"\nDATA binary\n")

    def close(self) -> None:
        """Complete the file."""
        if not self._locations:
            self.add(WrittenPoints(np.zeros((0, 3))))
        for location in self._locations:
            self._file.seek(location)
            self._file.write(f"{self._count:0{_DIGITS}d}".encode())
        self._file.close()
