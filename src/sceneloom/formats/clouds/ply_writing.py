"""PLY files written piece by piece: binary, positions in double precision.

Source: Greg Turk, "The PLY Polygon File Format", 1994.
"""

from pathlib import Path
from typing import BinaryIO

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.formats.clouds.written import COLORS, MEASURED, Column, WrittenPoints, records_of

_TYPES = {
    "u1": "uchar", "i1": "char", "u2": "ushort", "i2": "short", "u4": "uint", "i4": "int",
    "f4": "float", "f8": "double",
}  # fmt: skip
_COLUMNS: tuple[Column, ...] = (
    ("x", "f8", lambda points: points.positions_world[:, 0]),
    ("y", "f8", lambda points: points.positions_world[:, 1]),
    ("z", "f8", lambda points: points.positions_world[:, 2]),
    *COLORS,
    *MEASURED,
)
_DIGITS = 12


class PlyWriter:
    """An open PLY file. The number of its points is written into the room that its head has for it at the end."""

    def __init__(self, path: Path) -> None:
        """Begin a file, which must not be there."""
        self._file: BinaryIO = path.open("xb")
        self._count, self._location = 0, 0

    def add(self, points: WrittenPoints) -> None:
        """Write some more points."""
        records = records_of(points, _COLUMNS)
        if not self._location:
            self._begin(records)
        self._file.write(records.tobytes())
        self._count += len(points)

    def _begin(self, records: AnyArray) -> None:
        head = (
            b"ply\nformat binary_little_endian 1.0\ncomment world coordinates in metres, times in seconds\n"
        )
        self._file.write(head + b"element vertex ")
        self._location = self._file.tell()
        names = records.dtype.names or ()
        lines = [f"property {_TYPES[records.dtype[name].str[1:]]} {name}" for name in names]
        self._file.write(b"0" * _DIGITS + "\n".join(["", *lines, "end_header", ""]).encode())

    def close(self) -> None:
        """Complete the file."""
        if not self._location:
            self.add(WrittenPoints(np.zeros((0, 3))))
        self._file.seek(self._location)
        # blanks behind the number would be words to strict readers, zeros before it are not
        self._file.write(f"{self._count:0{_DIGITS}d}".encode())
        self._file.close()
