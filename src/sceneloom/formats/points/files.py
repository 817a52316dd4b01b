"""Files of points, PCD and PLY and others by their suffixes: read, and written in chunks or from a lidar frame."""

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, finite_rows
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.base.loss_list import Losses
from sceneloom.formats.base.output import replacing
from sceneloom.formats.points.cloud import (
    Cloud,
    CloudWriter,
    FieldLayout,
    WrittenPoints,
    axis_columns,
    check_count,
    check_end,
    color_columns,
    columns_of,
    measured_columns,
    packed_colors,
    parse_rows,
    unique_names,
)
from sceneloom.formats.points.las import (
    MOST_STEPS,
    LasFile,
    LasWriter,
    colors_16,
    las_dimensions,
    las_offsets,
    read_las,
)
from sceneloom.formats.points.npz import read_bin, read_npz
from sceneloom.scene.clouds import LidarFrame, grey_where_unseen

_READERS: Mapping[str, Callable[[Path, FieldLayout | None], Cloud]] = MappingProxyType(
    {
        ".pcd": lambda path, _: read_pcd(path),
        ".ply": lambda path, _: _read_ply(path),
        ".las": lambda path, _: read_las(path),
        ".laz": lambda path, _: read_las(path),
        ".bin": lambda path, layout: read_bin(path, layout=layout),
        ".npz": lambda path, layout: read_npz(path, layout=layout),
        ".npy": lambda path, layout: read_npz(path, layout=layout),
    }
)

CLOUD_SUFFIXES = tuple(_READERS)
"""Endings of files that hold points."""


def cloud_suffix(path: Path) -> str | None:
    """The ending by which a file is known to hold points, in lower case; None for other files."""
    suffix = path.suffix.lower()
    return suffix if suffix in _READERS else None


def read_cloud(path: Path, *, layout: FieldLayout | None = None) -> Cloud:
    """Read a file of points, column by column.

    Args:
        layout: the columns of files that do not state them (`.bin`, and rows of numbers in `.npz` and `.npy`).

    Raises:
        DataError: the file cannot be read, or its suffix is none of `CLOUD_SUFFIXES`.
    """
    suffix = cloud_suffix(path)
    if suffix is None:
        raise DataError(path, "", f"suffix {path.suffix!r}; expected one of {' '.join(CLOUD_SUFFIXES)}")
    return _READERS[suffix](path, layout)


_LONGEST_PCD_HEAD = 1 << 16
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
    return Cloud(path, file.count, _PCD_READERS[file.data](file), file.further)


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
        if self.data not in _PCD_READERS:
            raise DataError(path, "DATA", f"{self.data!r}; expected {', '.join(_PCD_READERS)}")
        self.count, self.further = self._count(), self._further()

    def _read_entries(self) -> None:
        """Cut the head into its lines, up to and with `DATA`."""
        while "DATA" not in self._entries:
            stop = self.content.find(b"\n", self.start, _LONGEST_PCD_HEAD)
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


_PCD_READERS: Mapping[str, Callable[[_PcdFile], dict[str, AnyArray]]] = {
    "ascii": _PcdFile.read_text,
    "binary": _PcdFile.read_binary,
    "binary_compressed": _PcdFile.read_compressed,
}

_PLY_TYPES: Mapping[str, str] = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip

_PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_PLY_HEAD = 1 << 20


@dataclass(frozen=True, slots=True)
class _Property:
    """One property of an element; `length_dtype` is that of the length of a list, "" for a single value."""

    name: str
    dtype: str
    length_dtype: str = ""


@dataclass(frozen=True, slots=True)
class _Element:
    """One element of a PLY file: `count` rows of the same properties."""

    name: str
    count: int
    properties: list[_Property]

    @property
    def has_lists(self) -> bool:
        """Whether its rows differ in length."""
        return any(prop.length_dtype for prop in self.properties)

    def dtype(self, order: str) -> np.dtype[np.void]:
        """One row without its lists, packed, in a byte order ("" for the machine's own)."""
        single = [prop for prop in self.properties if not prop.length_dtype]
        names = unique_names([prop.name for prop in single])
        return np.dtype([(n, order + prop.dtype) for n, prop in zip(names, single, strict=True)])


def _read_ply(path: Path) -> Cloud:
    """Read the vertices of a PLY file; lists and other elements are passed over.

    Raises:
        DataError: the head is wrong, or the file breaks off before its last vertex.
    """
    file = _PlyFile(path, read_bytes(path))
    rows = file.binary_rows() if file.order else file.text_rows()
    others = {one.name: one.count for one in file.elements if one.name != "vertex" and one.count}
    head: dict[str, Any] = {"comments": file.comments, "elements_left_out": others}
    return Cloud(path, len(rows), columns_of(rows), MappingProxyType({k: v for k, v in head.items() if v}))


class _PlyFile:
    """A PLY file in memory, its head parsed.

    Attributes:
        order: byte order; "" for text.
        elements: in their order; `vertex` is one of them.
        start: byte at which the rows begin.
        lines: lines of the head.
    """

    def __init__(self, path: Path, content: bytes) -> None:
        self.path, self.content = path, content
        if not content.startswith(b"ply") or content[3:4] not in {b"\n", b"\r", b" "}:
            raise DataError(path, "byte 0", "does not begin with `ply`")
        stop = content.find(b"\nend_header", 0, _LONGEST_PLY_HEAD)
        end = content.find(b"\n", stop + 1) if stop >= 0 else -1
        if end < 0:
            raise DataError(path, "", "the head breaks off without `end_header`")
        lines = content[:end].decode("latin-1").split("\n")
        order: str | None = None
        self.elements: list[_Element] = []
        self.comments: list[str] = []
        for number, line in enumerate(lines[1:-1], 2):
            words = line.split()
            if not words or words[0] in {"comment", "obj_info"}:
                self.comments += [" ".join(words[1:])] if words[1:] else []
            elif words[0] == "format" and len(words) > 1 and words[1] in _PLY_ORDERS:
                order = _PLY_ORDERS[words[1]]
            elif words[0] == "element" and len(words) == 3 and words[2].isascii() and words[2].isdigit():
                self.elements.append(_Element(words[1], int(words[2][:20]), []))
            elif words[0] == "property" and self.elements:
                self.elements[-1].properties.append(self._property(f"line {number}", words))
            else:
                problem = f"{line.strip()[:60]!r}; expected format, element or property"
                raise DataError(path, f"line {number}", problem)
        if order is None:
            raise DataError(path, "", f"the head names no format; expected one of {', '.join(_PLY_ORDERS)}")
        names = [element.name for element in self.elements]
        if names.count("vertex") != 1:
            raise DataError(path, "", f"elements: {', '.join(names) or 'none'}; expected one that is called vertex")
        for element in self.elements:
            check_count(path, f"element {element.name}", element.count)
        self.order, self.start, self.lines = order, end + 1, len(lines)
        self._number = names.index("vertex")
        self._vertex = self.elements[self._number]

    def _property(self, location: str, words: list[str]) -> _Property:
        if len(words) == 3 and words[1] in _PLY_TYPES:
            return _Property(words[2], _PLY_TYPES[words[1]])
        is_list = len(words) == 5 and words[1] == "list" and {words[2], words[3]} <= set(_PLY_TYPES)
        if is_list and _PLY_TYPES[words[2]][0] != "f":
            return _Property(words[4], _PLY_TYPES[words[3]], _PLY_TYPES[words[2]])
        problem = f"{' '.join(words)[:60]!r}; expected `property TYPE NAME` or `property list TYPE TYPE NAME`"
        raise DataError(self.path, location, f"{problem} with types out of {', '.join(_PLY_TYPES)}")

    def binary_rows(self) -> AnyArray:
        """Read the vertices; bytes behind the last element are refused, unless lists stand behind the vertices."""
        start, rows = self.start, np.zeros(0)
        for element in self.elements[: self._number + 1]:
            if element.has_lists:
                start, rows = self._walk(start, element)
                continue
            dtype = element.dtype(self.order)
            if element is self._vertex:
                self._check_bytes(start, element, dtype.itemsize)
                rows = np.frombuffer(self.content, dtype, element.count, start)
            start += element.count * dtype.itemsize
        others = self.elements[self._number + 1 :]
        if not any(element.has_lists for element in others):
            stop = start + sum(element.count * element.dtype(self.order).itemsize for element in others)
            reported = f"{self._vertex.count} vertices" + (" and of what follows them" if others else "")
            check_end(self.path, self.content[stop:], stop, reported)
        return rows

    def _check_bytes(self, start: int, element: _Element, size: int) -> None:
        found, expected = max(len(self.content) - start, 0), element.count * size
        if found < expected:
            problem = f"{found} bytes of {element.name}; expected {expected}: {element.count} of {size} bytes"
            raise DataError(self.path, f"byte {start}", f"{problem}; the file breaks off")

    def _walk(self, start: int, element: _Element) -> tuple[int, AnyArray]:
        """Go through rows that hold lists, one by one; give where they end, and the rows without their lists."""
        kinds = [
            (np.dtype(self.order + prop.dtype), np.dtype(self.order + prop.length_dtype) if prop.length_dtype else None)
            for prop in element.properties
        ]
        dtype = element.dtype(self.order)
        self._check_bytes(start, element, sum((length or kind).itemsize for kind, length in kinds))
        singles = bytearray()
        for row in range(element.count):
            for kind, length in kinds:
                size, location, name = kind.itemsize, f"byte {start}", f"{element.name} {row}"
                if length is not None:
                    if start + length.itemsize > len(self.content):
                        raise DataError(self.path, location, f"{name}: the file breaks off")
                    count = int(np.frombuffer(self.content, length, 1, start)[0])
                    if count < 0:
                        raise DataError(self.path, location, f"{name}: a list of {count} values")
                    size = length.itemsize + count * kind.itemsize
                if start + size > len(self.content):
                    raise DataError(self.path, location, f"{name}: the file breaks off")
                if length is None:
                    singles += self.content[start : start + size]
                start += size
        return start, np.frombuffer(bytes(singles), dtype) if dtype.itemsize else np.zeros(element.count, dtype)

    def text_rows(self) -> AnyArray:
        """Read the lines of the vertices; their number must be that of the head."""
        numbered = enumerate(self.content[self.start :].decode("latin-1").split("\n"), self.lines + 1)
        lines = [(number, line) for number, line in numbered if line.strip()]
        vertex = self._vertex
        first = sum(element.count for element in self.elements[: self._number] if element.properties)
        rows = lines[first : first + vertex.count]
        if len(rows) < vertex.count:
            problem = f"{len(rows)} lines of vertex; expected {vertex.count}; the file breaks off"
            raise DataError(self.path, "", problem)
        known = sum(one.count for one in self.elements if one.properties)
        if len(lines) > known:
            problem = f"{len(lines)} lines; expected {known} by the counts of the head"
            raise DataError(self.path, f"line {lines[known][0]}", problem)
        texts = [self._without_lists(number, line) if vertex.has_lists else line for number, line in rows]
        return parse_rows(self.path, texts, vertex.dtype("="), rows[0][0] if rows else 0)

    def _without_lists(self, number: int, line: str) -> str:
        words, kept, k = line.split(), [], 0
        for prop in self._vertex.properties:
            if k >= len(words):
                raise DataError(self.path, f"line {number}", f"{len(words)} values; expected {prop.name!r}, too")
            if not prop.length_dtype:
                kept.append(words[k])
            elif words[k].isascii() and words[k].isdigit():
                k += int(words[k][:10])
            else:
                problem = f"{words[k][:20]!r} for the length of list {prop.name!r}"
                raise DataError(self.path, f"line {number}", problem)
            k += 1
        if k != len(words):
            raise DataError(self.path, f"line {number}", f"{len(words)} values; expected {k}")
        return " ".join(kept)


_WRITERS: Mapping[str, Callable[[Path], CloudWriter]] = MappingProxyType(
    {
        ".las": LasWriter,
        ".laz": LasWriter,
        ".ply": lambda path: _RecordWriter(path, _PlyLayout()),
        ".pcd": lambda path: _RecordWriter(path, _PcdLayout()),
    }
)

WRITTEN_SUFFIXES = tuple(_WRITERS)
"""Endings of files that points can be written to."""


def check_cloud_suffix(path: Path) -> None:
    """Refuse a name of a file of points that says no kind of file.

    Raises:
        OptionError: naming those that can be written.
    """
    if path.suffix.lower() not in _WRITERS:
        raise OptionError(f"{path}: suffix {path.suffix!r}; expected one of {' '.join(WRITTEN_SUFFIXES)} for a cloud")


@contextmanager
def open_cloud_writer(path: Path, *, overwrite: bool = False) -> Iterator[CloudWriter]:
    """Give what writes points to a file; it is there, whole, when the block ends without an error.

    Raises:
        OptionError: the suffix is none of `WRITTEN_SUFFIXES`.
        OutputError: the file exists, or cannot be written.
    """
    check_cloud_suffix(path)
    with replacing(path, overwrite=overwrite) as draft:
        writer = _WRITERS[path.suffix.lower()](draft)
        try:
            yield writer
        except BaseException:
            with suppress(Exception):  # the draft goes with its folder; what went wrong first is reported
                writer.close()
            raise
        writer.close()


def _pack_records(columns: Mapping[str, AnyArray], count: int) -> AnyArray:
    """Lay columns side by side, packed, little-endian."""
    kinds = [(name, f"<{values.dtype.str[1:]}", values.shape[1:]) for name, values in columns.items()]
    records = np.empty(count, kinds)
    for name, values in columns.items():
        records[name] = values
    return records


_COUNT_DIGITS = 12
"""Room for the number of points, which is known at the end."""


class _RecordWriter:
    """An open file of packed records. The head is written again at the end, when the number of points is known."""

    def __init__(self, path: Path, layout: "_PcdLayout | _PlyLayout") -> None:
        """Begin a file, which must not be there."""
        self._file: BinaryIO = path.open("xb")
        self._layout = layout
        self._dtype: np.dtype[np.void] | None = None
        self._count = 0

    def add(self, points: WrittenPoints) -> None:
        """Write some more points."""
        records = _pack_records(self._layout.columns(points), len(points))
        if self._dtype is None:
            self._dtype = records.dtype
            self._write_head(records.dtype)
        self._file.write(records.tobytes())
        self._count += len(points)

    def close(self) -> None:
        """Complete the file."""
        if self._dtype is None:
            self.add(WrittenPoints(np.zeros((0, 3))))
        else:
            self._file.seek(0)
            self._write_head(self._dtype)
        self._file.close()

    def _write_head(self, dtype: np.dtype[np.void]) -> None:
        # zeros before a number: blanks behind it would be words to strict readers
        self._file.write(self._layout.head(dtype, f"{self._count:0{_COUNT_DIGITS}d}"))


_FARTHEST_EXACT = 4000.0
"""Farther from 0 than this [m], float32 is coarser than a quarter of a millimetre: positions count from an origin."""


class _PcdLayout:
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
        return _pcd_head(dtype, count, "binary", comment)


def _pcd_head(dtype: np.dtype[np.void], count: str, data: str, *comments: str) -> bytes:
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


def _pcd_body(records: AnyArray, encoding: str) -> bytes:
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


class _PlyLayout:
    """PLY files of clouds: positions in the world as float64."""

    def columns(self, points: WrittenPoints) -> dict[str, AnyArray]:
        """All columns in their own types."""
        return {**axis_columns(points.positions_world), **color_columns(points.colors), **measured_columns(points)}

    def head(self, dtype: np.dtype[np.void], count: str) -> bytes:
        """A head that says what the numbers are."""
        return _ply_head(dtype, count, "comment world coordinates in metres, times in seconds")


def _ply_head(dtype: np.dtype[np.void], count: str, *comments: str) -> bytes:
    """The head of a binary PLY file of `count` vertices."""
    # of several names for a type the first is the one that every program knows
    types = {kind: name for name, kind in reversed([*_PLY_TYPES.items()])}
    lines = ["ply", "format binary_little_endian 1.0", *comments, f"element vertex {count}"]
    lines += [f"property {types[dtype[name].str[1:]]} {name}" for name in dtype.names or ()]
    return "\n".join([*lines, "end_header", ""]).encode()


_OFFSET = "offset_ns"
"""Times of points from the frame's time on [ns]: 32 bits hold two seconds either way."""

_SPACES = re.compile(r"\s+")
_LONGEST_LAS_NAME = 32


@dataclass(frozen=True, slots=True, eq=False)
class FrameColumns:
    """The columns of one frame.

    Attributes:
        positions: (N, 3) float32 [m].
        colors: (N, 3) uint8, or None.
        intensities: (N,) of any dtype, on the scale of `brightest`; or None.
        brightest: the value of full intensity.
        further: (N,) or (N, K) each, by name.
    """

    positions: Float32Array
    colors: AnyArray | None
    intensities: AnyArray | None
    brightest: float
    further: Mapping[str, AnyArray] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def named(self) -> dict[str, AnyArray]:
        """Intensities, if any, and the further columns."""
        return {**({} if self.intensities is None else {"intensity": self.intensities}), **self.further}


def frame_columns(frame: LidarFrame, intensity_max: float | None) -> FrameColumns:
    """Lay out a frame; intensities as its source had them are preferred to those of 0 to 255.

    Args:
        frame: the frame.
        intensity_max: the full intensity in the source, where it is known.
    """
    points = frame.points
    extras = {name: values for name, values in points.extras.items() if _is_column(values, len(points))}
    intensities, brightest = points.intensities, 255.0
    if intensities is not None and intensity_max and extras.get("intensity", np.zeros((0, 0))).ndim == 1:
        intensities, brightest = extras.pop("intensity"), intensity_max
    further: dict[str, AnyArray] = {}
    if points.timestamps_ns is not None:
        offsets = points.timestamps_ns - frame.timestamp_ns
        small = not len(offsets) or bool(np.abs(offsets).max() < 2**31)
        further[_OFFSET] = offsets.astype(np.int32) if small else offsets
    known = {"ring": points.rings, "camera_index": points.camera_index}
    further |= {name: values for name, values in known.items() if values is not None}
    taken = {"x", "y", "z", "red", "green", "blue", "intensity", "rgb", *further}
    for name, values in extras.items():
        plain = _SPACES.sub("_", name) or "_"
        while plain in taken:
            plain += "_further"
        taken.add(plain)
        further[plain] = values
    colors = None if points.colors is None else grey_where_unseen(points.colors, points.camera_index)
    return FrameColumns(points.positions, colors, intensities, brightest, further)


def _is_column(values: AnyArray, count: int) -> bool:
    return values.ndim in {1, 2} and len(values) == count and values.dtype.kind in "iufb" and values.size > 0


def left_out(frame: LidarFrame, sensor: str, losses: Losses) -> None:
    """Report what of a frame no file of points has a field for."""
    count = len(frame.points)
    for name, values in frame.points.extras.items():
        field = f"sensors[{sensor}].frames.points.extras.{name}"
        if count and not _is_column(values, count):
            losses.dropped(field, "left out: no column of numbers with a row per point")
        elif _SPACES.search(name):
            losses.converted(field, "spaces in its name written as `_`")
    what = "left out: a file of points has no other fields"
    losses.dropped(f"sensors[{sensor}].frames.extras", what, count=len(frame.extras))


def _single_columns(columns: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """Columns, those of several values split into single ones."""
    found: dict[str, AnyArray] = {}
    for name, values in columns.items():
        if values.ndim == 1:
            found[name] = values
        else:
            found.update({f"{name}_{k}": values[:, k] for k in range(values.shape[1])})
    return found


_WHOLE = frozenset({"u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8"})
_WIDER: Mapping[str, str] = {"b1": "u1", "f2": "f4", "i8": "f8", "u8": "f8"}


def _fitted(
    columns: Mapping[str, AnyArray], held: frozenset[str], location: str, losses: Losses
) -> dict[str, AnyArray]:
    """Bring columns to the types that a kind of file holds, as "u1" or "f8"; what this changes is reported."""
    found: dict[str, AnyArray] = {}
    for name, values in columns.items():
        kind = values.dtype.str[1:]
        found[name] = values if kind in held else values.astype(_WIDER.get(kind, "f8"))
        if kind in held:
            continue
        error = 0.0
        if values.dtype.kind in "iu" and len(values):
            # what float64 makes of large integers, compared as integers
            inside = np.abs(found[name]) < 2.0**63
            error = float(np.abs(found[name][inside].astype(np.int64) - values[inside].astype(np.int64)).max(initial=0))
        report = losses.approximated if error else losses.converted
        what = f"{values.dtype.name} written as {found[name].dtype.name}"
        report(f"{location}.extras.{name}", what, error=error or None)
    return found


def _finite(columns: FrameColumns, location: str, losses: Losses) -> BoolArray:
    """Which points are finite, (N,) bool: the others are left out, which is reported."""
    finite = finite_rows(columns.positions)
    losses.dropped(f"{location}.positions", "points that are not finite are left out", count=int((~finite).sum()))
    return finite


def _write_pcd(path: Path, columns: FrameColumns, location: str, losses: Losses, *, encoding: str) -> None:
    """Write a PCD file; colours are packed into one float, as PCL's type PointXYZRGB has them."""
    further = _fitted(columns.named, _WHOLE | {"i8", "u8"}, location, losses)
    records = _pack_records(
        {**axis_columns(columns.positions), **packed_colors(columns.colors), **further}, len(columns.positions)
    )
    with path.open("xb") as file:
        file.write(_pcd_head(records.dtype, str(len(records)), encoding))
        file.write(_pcd_body(records, encoding))


def write_ply(path: Path, columns: FrameColumns, location: str, losses: Losses) -> None:
    """Write a binary PLY file."""
    further = _fitted(_single_columns(columns.named), _WHOLE, location, losses)
    records = _pack_records(
        {**axis_columns(columns.positions), **color_columns(columns.colors), **further}, len(columns.positions)
    )
    with path.open("xb") as file:
        file.write(_ply_head(records.dtype, str(len(records))))
        file.write(records.tobytes())


_STEPS_M = (1e-5, 1e-3)
"""Steps of the positions in LAS files: fine where the points lie within 20 km, else as fine as any lidar measures."""


def _write_las(path: Path, columns: FrameColumns, location: str, losses: Losses) -> None:
    """Write a LAS or LAZ file, by the ending of its name; positions are rounded to steps."""
    finite = _finite(columns, location, losses)
    positions = columns.positions[finite].astype(np.float64)
    distance = np.abs(positions - las_offsets(positions)).max(initial=0.0)
    step = next((step for step in _STEPS_M if distance / step < MOST_STEPS), None)
    if step is None:
        raise OptionError(f"{path.name}: points {distance / 1000:.0f} km apart; LAS holds 2147 km in steps of 1 mm")
    dimensions: dict[str, AnyArray] = {}
    if columns.intensities is not None:
        scaled = columns.intensities.astype(np.float64) * (65535.0 / columns.brightest)
        whole = np.clip(np.rint(np.nan_to_num(scaled)), 0, 65535)
        error = float(np.abs(whole - scaled).max(initial=0.0)) * columns.brightest / 65535.0
        if error > 1e-9 * columns.brightest:
            what = f"intensities of 0 to {columns.brightest:g} rounded to 65536 steps"
            losses.approximated(f"{location}.intensities", what, error=error)
        dimensions["intensity"] = whole.astype(np.uint16)
    # names that are short enough, and not those of LAS's own dimensions
    taken, named = las_dimensions(columns.colors), dict[str, AnyArray]()
    for name, values in _single_columns(columns.further).items():
        short = name.encode("ascii", "replace").decode()[:_LONGEST_LAS_NAME]
        if short in taken or short in named:
            short = f"{short[: _LONGEST_LAS_NAME - 8]}_further"[:_LONGEST_LAS_NAME]
        named[short] = values
    further = _fitted(named, _WHOLE | {"i8", "u8"}, location, losses)
    with LasFile(path, positions, step, further, colored=columns.colors is not None) as file:
        dimensions = {**further, **colors_16(columns.colors), **dimensions}
        error = file.add(positions, {name: values[finite] for name, values in dimensions.items()})
    losses.approximated(f"{location}.positions", f"rounded to steps of {step:g} m", error=error)


def _write_npz(path: Path, columns: FrameColumns, _: str, __: Losses) -> None:
    """Write an NPZ file, one array per column."""
    found: dict[str, Any] = {"positions": columns.positions, **columns.named}
    if columns.colors is not None:
        found["colors"] = columns.colors
    with path.open("xb") as file:
        np.savez(file, **found)


_MODEL_NAMES = {"offset_ns": "timestamps_ns", "ring": "rings", "camera_index": "camera_index"}


def _write_bin(
    path: Path, columns: FrameColumns, location: str, losses: Losses, *, brightest: float, further: tuple[str, ...]
) -> None:
    """Write packed float32: x, y, z, intensity on a scale, then some further columns, 0 where they are missing."""
    count = len(columns.positions)
    found = axis_columns(columns.positions)
    if columns.intensities is None:
        losses.converted(f"{location}.intensities", "there are none; written as 0")
    values = np.zeros(count, np.float32) if columns.intensities is None else columns.intensities
    found["intensity"] = (values * (brightest / columns.brightest)).astype(np.float32)
    for name in further:
        found[name] = columns.further.get(name, np.zeros(count)).astype(np.float32)
    for name in columns.further:
        if name not in further:
            what = f"left out: such files have x y z {' '.join(['intensity', *further])} only"
            losses.dropped(f"{location}.{_MODEL_NAMES.get(name, f'extras.{name}')}", what)
    if columns.colors is not None:
        losses.dropped(f"{location}.colors", "left out: such files have none")
    path.write_bytes(_pack_records(found, count)[_finite(columns, location, losses)].tobytes())


FRAME_WRITERS: Mapping[str, Callable[..., None]] = MappingProxyType(
    {
        "pcd": _write_pcd,
        "ply": write_ply,
        "las": _write_las,
        "laz": _write_las,
        "kitti-bin": partial(_write_bin, brightest=1.0, further=()),
        "nuscenes-bin": partial(_write_bin, brightest=255.0, further=("ring",)),
        "npz": _write_npz,
    }
)
"""What writes a frame, by the name of the kind; that of `pcd` takes an encoding."""
