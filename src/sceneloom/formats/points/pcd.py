"""PCD, the files of the Point Cloud Library: read, and written chunk by chunk."""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array
from sceneloom.errors import DataError
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.points.cloud import (
    Cloud,
    WrittenPoints,
    axis_columns,
    check_count,
    check_end,
    columns_of,
    measured_columns,
    packed_colors,
    parse_rows,
    unique_names,
)

_LONGEST_HEADER = 1 << 16
_LETTERS = {"F": "f", "I": "i", "U": "u"}
_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_MOST_VALUES = 1 << 16
_NO_VIEWPOINT = ["0", "0", "0", "1", "0", "0", "0"]


def read_pcd(path: Path) -> Cloud:
    """Read a PCD file; points that are not finite stay in it, `VIEWPOINT` is not applied.

    Raises:
        DataError: the head is wrong, or the points are not as many bytes or lines as it says.
    """
    file = _PcdFile(path, read_bytes(path))
    if file.count == 0 or file.dtype.itemsize == 0:
        # a compressed file of no points still says that it is 0 bytes
        check_end(path, file.content[file.start :], file.start, f"{file.count} points")
        return Cloud(path, file.count, columns_of(np.zeros(file.count, file.dtype)), file.further)
    return Cloud(path, file.count, _READERS[file.data](file), file.further)


class _PcdFile:
    """A PCD file in memory, its head parsed.

    Attributes:
        dtype: one point, packed, little-endian.
        count: number of points.
        data: "ascii", "binary" or "binary_compressed".
        start: byte at which the points begin.
        lines: lines of the head.
        further: the viewpoint, and the width of rows where there are several, in the words of the head.
    """

    def __init__(self, path: Path, content: bytes) -> None:
        self.path, self.content = path, content
        self.start, self.lines, self._entries = 0, 0, dict[str, list[str]]()
        self._read_entries()
        names = self._entries["FIELDS"]
        sizes = [self._integer("SIZE", word) for word in self._words("SIZE")]
        counts = [1] * len(names)
        if "COUNT" in self._entries:
            counts = [self._integer("COUNT", word) for word in self._words("COUNT")]
        fields = []
        for name, size, kind, count in zip(unique_names(names), sizes, self._words("TYPE"), counts, strict=True):
            if kind not in _LETTERS or size not in _SIZES[kind]:
                problem = f"{kind}{size} for {name!r}; expected F4 F8 I1 I2 I4 I8 U1 U2 U4 U8"
                raise DataError(path, "TYPE, SIZE", problem)
            if not 1 <= count <= _MOST_VALUES:
                raise DataError(path, "COUNT", f"{count} for {name!r}; expected 1 to {_MOST_VALUES}")
            fields.append((name, f"<{_LETTERS[kind]}{size}", () if count == 1 else (count,)))
        self.dtype = np.dtype(fields)
        self.data = " ".join(self._entries["DATA"]).lower()
        if self.data not in _READERS:
            raise DataError(path, "DATA", f"{self.data!r}; expected {', '.join(_READERS)}")
        self.count, self.further = self._count(), self._further()

    def _read_entries(self) -> None:
        """Cut the head into its lines, up to and with `DATA`."""
        while "DATA" not in self._entries:
            stop = self.content.find(b"\n", self.start, _LONGEST_HEADER)
            if stop < 0:
                broken = "the head breaks off without a line `DATA`"
                problem = broken if self._entries else "does not begin as a PCD file does"
                raise DataError(self.path, f"byte {self.start}", f"{problem}; expected lines {' '.join(_KEYS)}")
            words = self.content[self.start : stop].decode("latin-1").split()
            self.start, self.lines = stop + 1, self.lines + 1
            if not words or words[0].startswith("#"):
                continue
            if words[0] not in (*_KEYS, "COLUMNS"):
                problem = f"{words[0][:40]!r}; expected one of {' '.join(_KEYS)}"
                raise DataError(self.path, f"line {self.lines}", problem)
            self._entries["FIELDS" if words[0] == "COLUMNS" else words[0]] = words[1:]
        for key in ("FIELDS", "SIZE", "TYPE"):
            if key not in self._entries:
                raise DataError(self.path, key, "missing in the head")

    def _words(self, key: str) -> list[str]:
        found, count = self._entries[key], len(self._entries["FIELDS"])
        if len(found) != count:
            raise DataError(self.path, key, f"{len(found)} entries; expected {count}, one for each of FIELDS")
        return found

    def _integer(self, key: str, word: str) -> int:
        if not (word.isascii() and word.isdigit() and len(word) < 20):
            raise DataError(self.path, key, f"{word[:40]!r}; expected a whole number")
        return int(word)

    def _count(self) -> int:
        """The number of points: `POINTS`, else width times height; both where they are given must agree."""
        keys = [key for key in ("WIDTH", "HEIGHT", "POINTS") if key in self._entries]
        numbers = {key: self._integer(key, " ".join(self._entries[key])) for key in keys}
        area = numbers["WIDTH"] * numbers.get("HEIGHT", 1) if "WIDTH" in numbers else None
        count = numbers.get("POINTS", area)
        if count is None:
            raise DataError(self.path, "POINTS", "missing in the head, as is WIDTH")
        if area is not None and area != count:
            raise DataError(self.path, "POINTS", f"{count}; WIDTH times HEIGHT is {area}")
        check_count(self.path, "POINTS", count)
        return count

    def _further(self) -> Mapping[str, Any]:
        """The pose of the sensor that is not the identity, and the order of the points."""
        further: dict[str, Any] = {}
        viewpoint = self._entries.get("VIEWPOINT", _NO_VIEWPOINT)
        try:
            numbers = [float(word) for word in viewpoint]
        except ValueError:
            numbers = []
        if len(numbers) != len(_NO_VIEWPOINT):
            problem = f"{' '.join(viewpoint)[:60]!r}; expected 7 numbers: x y z and a quaternion w x y z"
            raise DataError(self.path, "VIEWPOINT", problem)
        if numbers != [float(word) for word in _NO_VIEWPOINT]:
            further["viewpoint"] = numbers
        if self._integer("HEIGHT", " ".join(self._entries.get("HEIGHT", ["1"]))) > 1:
            further["width"] = self._integer("WIDTH", " ".join(self._entries.get("WIDTH", ["0"])))
        return MappingProxyType(further)

    def read_text(self) -> dict[str, AnyArray]:
        """Read one line per point."""
        numbered = enumerate(self.content[self.start :].decode("latin-1").split("\n"), self.lines + 1)
        lines = [(number, line) for number, line in numbered if line.strip()]
        if len(lines) != self.count:
            raise DataError(self.path, "", f"{len(lines)} lines of points; the head says {self.count}")
        # latin-1 knows spaces that are none in ASCII; what is left of them does not parse
        return columns_of(parse_rows(self.path, [line for _, line in lines], self.dtype, lines[0][0]))

    def read_binary(self) -> dict[str, AnyArray]:
        """Read packed points."""
        points = f"{self.count} points of {self.dtype.itemsize} bytes"
        expected, found = self.count * self.dtype.itemsize, len(self.content) - self.start
        if found < expected:
            problem = f"{found} bytes of points; expected {expected}: {points}; the file breaks off"
            raise DataError(self.path, f"byte {self.start}", problem)
        stop = self.start + expected
        check_end(self.path, self.content[stop:], stop, points)
        return columns_of(np.frombuffer(self.content, self.dtype, self.count, self.start))

    def read_compressed(self) -> dict[str, AnyArray]:
        """Unfold the columns, which stand one after another where they are compressed."""
        from sceneloom.kernels.packed import LARGEST_RATIO, unfold

        path, content, location, body = self.path, self.content, f"byte {self.start}", self.start + 8
        if len(content) < body:
            raise DataError(path, location, f"{len(content) - self.start} bytes of points; the file breaks off")
        packed_size, size = np.frombuffer(content, "<u4", 2, self.start).tolist()
        if len(content) - body < packed_size:
            problem = f"{len(content) - body} compressed bytes; expected {packed_size}; the file breaks off"
            raise DataError(path, location, problem)
        expected = self.count * self.dtype.itemsize
        if size != expected or size > packed_size * LARGEST_RATIO:
            problem = f"{packed_size} bytes that unfold to {size}; expected {expected} from {self.count} points"
            raise DataError(path, location, problem)
        check_end(path, content[body + packed_size :], body + packed_size, f"{self.count} points")
        unpacked = np.empty(size, np.uint8)
        if unfold(np.frombuffer(content, np.uint8, packed_size, body), unpacked) != size:
            problem = "the compressed points are damaged: they do not unfold to what the head says"
            raise DataError(path, location, problem)
        columns, start = {}, 0
        for name in self.dtype.names or ():
            kind = self.dtype[name]
            stop = start + self.count * kind.itemsize
            column = unpacked[start:stop].view(kind.base).reshape(self.count, *kind.shape)
            if not name.startswith("_"):
                columns[name] = column.astype(kind.base.newbyteorder("="))
            start = stop
        return columns


_READERS: Mapping[str, Callable[[_PcdFile], dict[str, AnyArray]]] = {
    "ascii": _PcdFile.read_text,
    "binary": _PcdFile.read_binary,
    "binary_compressed": _PcdFile.read_compressed,
}

_FARTHEST_EXACT = 4000.0
"""Farther from 0 than this [m], float32 is coarser than a quarter of a millimetre: positions count from an origin."""


class PcdLayout:
    """PCD files of clouds.

    Attributes:
        origin_world: (3,) float64 [m], what positions count from: 0, unless the first points lie far from it; whole
            metres. The head names it in a comment.
    """

    def __init__(self) -> None:
        """Begin without an origin."""
        self.origin_world: Float64Array | None = None

    def columns(self, points: WrittenPoints) -> dict[str, AnyArray]:
        """Positions and intensities as float32, packed colours, labels as uint32."""
        if self.origin_world is None:
            finite = points.positions_world[np.isfinite(points.positions_world).all(axis=1)]
            far = len(finite) and np.abs(finite).max() > _FARTHEST_EXACT
            self.origin_world = np.rint(finite.mean(axis=0)) if far else np.zeros(3)
        measured = measured_columns(points)
        for name, kind in (("intensity", np.float32), ("label", np.uint32)):
            if name in measured:
                measured[name] = measured[name].astype(kind)
        positions = (points.positions_world - self.origin_world).astype(np.float32)
        return {**axis_columns(positions), **packed_colors(points.colors), **measured}

    def head(self, dtype: np.dtype[np.void], count: str) -> bytes:
        """A head with the origin."""
        x, y, z = np.zeros(3) if self.origin_world is None else self.origin_world.tolist()
        comment = f"# world coordinates in metres from {x:.0f} {y:.0f} {z:.0f}, times in seconds"
        return pcd_head(dtype, count, "binary", comment)


def pcd_head(dtype: np.dtype[np.void], count: str, data: str, *comments: str) -> bytes:
    """The head of a PCD file of `count` records."""
    kinds = [dtype[name] for name in dtype.names or ()]
    letters = {letter: name for name, letter in _LETTERS.items()}
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        *comments,
        "VERSION 0.7",
        f"FIELDS {' '.join(dtype.names or ())}",
        f"SIZE {' '.join(str(kind.base.itemsize) for kind in kinds)}",
        f"TYPE {' '.join(letters[kind.base.kind] for kind in kinds)}",
        f"COUNT {' '.join(str(kind.shape[0] if kind.shape else 1) for kind in kinds)}",
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        f"DATA {data}",
        "",
    ]
    return "\n".join(lines).encode()


def pcd_body(records: AnyArray, encoding: str) -> bytes:
    """Records as the bytes behind a head: "binary", "ascii" or "binary_compressed"."""
    if encoding == "binary":
        return bytes(records.tobytes())
    if encoding == "ascii":
        # numbers with all their digits; packed colours as their float, which is what readers of text expect
        columns: list[list[str]] = []
        for name in records.dtype.names or ():
            values = records[name].reshape(len(records), -1)
            columns += [[str(value) for value in values[:, k]] for k in range(values.shape[1])]
        return "".join(" ".join(row) + "\n" for row in zip(*columns, strict=True)).encode()
    from sceneloom.kernels.packed import fold, longest_fold

    plain = b"".join(np.ascontiguousarray(records[name]).tobytes() for name in records.dtype.names or ())
    if not plain:
        return np.zeros(2, "<u4").tobytes()
    packed = np.empty(longest_fold(len(plain)), np.uint8)
    size = fold(np.frombuffer(plain, np.uint8), packed)
    return np.array([size, len(plain)], "<u4").tobytes() + packed[:size].tobytes()
