"""PLY, Stanford's polygon files: the element `vertex` read, and points written chunk by chunk."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.points.cloud import (
    Cloud,
    WrittenPoints,
    axis_columns,
    check_count,
    check_end,
    color_columns,
    columns_of,
    measured_columns,
    parse_rows,
    unique_names,
)

_TYPES: Mapping[str, str] = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip

_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 1 << 20


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


def read_ply(path: Path) -> Cloud:
    """Read the vertices of a PLY file; lists and other elements are passed over.

    Raises:
        DataError: the head is wrong, or the file breaks off before its last vertex.
    """
    file = _PlyFile(path, read_bytes(path))
    rows = file.read_binary() if file.order else file.read_text()
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
        stop = content.find(b"\nend_header", 0, _LONGEST_HEADER)
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
            elif words[0] == "format" and len(words) > 1 and words[1] in _ORDERS:
                order = _ORDERS[words[1]]
            elif words[0] == "element" and len(words) == 3 and words[2].isascii() and words[2].isdigit():
                self.elements.append(_Element(words[1], int(words[2][:20]), []))
            elif words[0] == "property" and self.elements:
                self.elements[-1].properties.append(self._property(f"line {number}", words))
            else:
                problem = f"{line.strip()[:60]!r}; expected format, element or property"
                raise DataError(path, f"line {number}", problem)
        if order is None:
            raise DataError(path, "", f"the head names no format; expected one of {', '.join(_ORDERS)}")
        names = [element.name for element in self.elements]
        if names.count("vertex") != 1:
            raise DataError(path, "", f"elements: {', '.join(names) or 'none'}; expected one that is called vertex")
        for element in self.elements:
            check_count(path, f"element {element.name}", element.count)
        self.order, self.start, self.lines = order, end + 1, len(lines)
        self._number = names.index("vertex")
        self._vertex = self.elements[self._number]

    def _property(self, location: str, words: list[str]) -> _Property:
        if len(words) == 3 and words[1] in _TYPES:
            return _Property(words[2], _TYPES[words[1]])
        is_list = len(words) == 5 and words[1] == "list" and {words[2], words[3]} <= set(_TYPES)
        if is_list and _TYPES[words[2]][0] != "f":
            return _Property(words[4], _TYPES[words[3]], _TYPES[words[2]])
        problem = f"{' '.join(words)[:60]!r}; expected `property TYPE NAME` or `property list TYPE TYPE NAME`"
        raise DataError(self.path, location, f"{problem} with types out of {', '.join(_TYPES)}")

    def read_binary(self) -> AnyArray:
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

    def read_text(self) -> AnyArray:
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


class PlyLayout:
    """PLY files of clouds: positions in the world as float64."""

    def columns(self, points: WrittenPoints) -> dict[str, AnyArray]:
        """All columns in their own types."""
        return {**axis_columns(points.positions_world), **color_columns(points.colors), **measured_columns(points)}

    def head(self, dtype: np.dtype[np.void], count: str) -> bytes:
        """A head that says what the numbers are."""
        return ply_head(dtype, count, "comment world coordinates in metres, times in seconds")


def ply_head(dtype: np.dtype[np.void], count: str, *comments: str) -> bytes:
    """The head of a binary PLY file of `count` vertices."""
    # of several names for a type the first is the one that every program knows
    types = {kind: name for name, kind in reversed([*_TYPES.items()])}
    lines = ["ply", "format binary_little_endian 1.0", *comments, f"element vertex {count}"]
    lines += [f"property {types[dtype[name].str[1:]]} {name}" for name in dtype.names or ()]
    return "\n".join([*lines, "end_header", ""]).encode()
