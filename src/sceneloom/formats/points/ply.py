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
class Property:
    """One property of an element.

    Attributes:
        name: as in the file.
        dtype: of its value, or of the values of a list.
        length_dtype: of the length of a list; "" for a single value.
    """

    name: str
    dtype: str
    length_dtype: str = ""


@dataclass(frozen=True, slots=True)
class Element:
    """One element of a PLY file: `count` rows of the same properties."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        """Whether its rows differ in length."""
        return any(prop.length_dtype for prop in self.properties)

    def dtype(self, order: str) -> np.dtype[np.void]:
        """One row without its lists, packed, in a byte order ("" for the machine's own)."""
        single = [prop for prop in self.properties if not prop.length_dtype]
        names = unique_names([prop.name for prop in single])
        return np.dtype([(n, order + prop.dtype) for n, prop in zip(names, single, strict=True)])


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """The head of a PLY file: byte order ("" for text), elements in order, where the rows begin, and the comments."""

    order: str
    elements: tuple[Element, ...]
    start: int
    lines: int
    comments: tuple[str, ...] = ()

    @property
    def further(self) -> dict[str, Any]:
        """What the file says besides its vertices: comments, and how many there are of each other element."""
        others = {one.name: one.count for one in self.elements if one.name != "vertex" and one.count}
        return {
            **({"comments": list(self.comments)} if self.comments else {}),
            **({"elements_left_out": others} if others else {}),
        }


def read_ply(path: Path) -> Cloud:
    """Read the vertices of a PLY file; lists and other elements are passed over.

    Raises:
        DataError: the head is wrong, or the file breaks off before its last vertex.
    """
    content = read_bytes(path)
    header = _parse_header(path, content)
    read = _read_binary if header.order else _read_text
    rows = read(path, content, header)
    return Cloud(path, len(rows), columns_of(rows), MappingProxyType(header.further))


def _parse_header(path: Path, content: bytes) -> PlyHeader:
    """Parse the head of a PLY file.

    Raises:
        DataError: a line is wrong, or there is no element `vertex`.
    """
    if not content.startswith(b"ply") or content[3:4] not in {b"\n", b"\r", b" "}:
        raise DataError(path, "byte 0", "does not begin with `ply`")
    stop = content.find(b"\nend_header", 0, _LONGEST_HEADER)
    end = content.find(b"\n", stop + 1) if stop >= 0 else -1
    if end < 0:
        raise DataError(path, "", "the head breaks off without `end_header`")
    lines = content[:end].decode("latin-1").split("\n")
    order: str | None = None
    drafts: list[tuple[str, int, list[Property]]] = []
    comments: list[str] = []
    for number, line in enumerate(lines[1:-1], 2):
        words, location = line.split(), f"line {number}"
        if not words or words[0] in {"comment", "obj_info"}:
            comments += [" ".join(words[1:])] if words[1:] else []
            continue
        if words[0] == "format" and len(words) > 1 and words[1] in _ORDERS:
            order = _ORDERS[words[1]]
        elif words[0] == "element" and len(words) == 3 and words[2].isascii() and words[2].isdigit():
            drafts.append((words[1], int(words[2][:20]), []))
        elif words[0] == "property" and drafts:
            drafts[-1][2].append(_property(path, location, words))
        else:
            raise DataError(path, location, f"{line.strip()[:60]!r}; expected format, element or property")
    if order is None:
        raise DataError(path, "", f"the head names no format; expected one of {', '.join(_ORDERS)}")
    elements = tuple(Element(name, count, tuple(properties)) for name, count, properties in drafts)
    _check_elements(path, elements)
    return PlyHeader(order, elements, end + 1, len(lines), tuple(comments))


def _property(path: Path, location: str, words: list[str]) -> Property:
    if len(words) == 3 and words[1] in _TYPES:
        return Property(words[2], _TYPES[words[1]])
    if len(words) == 5 and words[1] == "list" and {words[2], words[3]} <= set(_TYPES) and _TYPES[words[2]][0] != "f":
        return Property(words[4], _TYPES[words[3]], _TYPES[words[2]])
    problem = f"{' '.join(words)[:60]!r}; expected `property TYPE NAME` or `property list TYPE TYPE NAME`"
    raise DataError(path, location, f"{problem} with types out of {', '.join(_TYPES)}")


def _check_elements(path: Path, elements: tuple[Element, ...]) -> None:
    if [element.name for element in elements].count("vertex") != 1:
        names = ", ".join(element.name for element in elements) or "none"
        raise DataError(path, "", f"elements: {names}; expected one that is called vertex")
    for element in elements:
        check_count(path, f"element {element.name}", element.count)


def _read_binary(path: Path, content: bytes, header: PlyHeader) -> AnyArray:
    start, rows = header.start, np.zeros(0)
    for element in header.elements:
        if element.has_lists:
            start, rows = _walk(path, content, start, element, header.order)
        else:
            dtype = element.dtype(header.order)
            if element.name == "vertex":
                _check_bytes(path, content, start, element, dtype.itemsize)
                rows = np.frombuffer(content, dtype, element.count, start)
            start += element.count * dtype.itemsize
        if element.name == "vertex":
            break
    _check_rest(path, content, start, header)
    return rows


def _check_rest(path: Path, content: bytes, start: int, header: PlyHeader) -> None:
    """Refuse bytes behind the last element; rows of lists behind the vertices are not walked through."""
    vertex = [element.name for element in header.elements].index("vertex")
    others = header.elements[vertex + 1 :]
    if not any(element.has_lists for element in others):
        stop = start + sum(element.count * element.dtype(header.order).itemsize for element in others)
        reported = f"{header.elements[vertex].count} vertices"
        check_end(path, content[stop:], stop, reported if not others else f"{reported} and of what follows them")


def _check_bytes(path: Path, content: bytes, start: int, element: Element, size: int) -> None:
    found, expected = len(content) - start, element.count * size
    if found < expected:
        problem = (
            f"{max(found, 0)} bytes of {element.name}; expected {expected}: {element.count} of {size} bytes; "
            "the file breaks off"
        )
        raise DataError(path, f"byte {start}", problem)


def _walk(path: Path, content: bytes, start: int, element: Element, order: str) -> tuple[int, AnyArray]:
    """Go through rows that hold lists, one by one; give where they end, and the rows without their lists."""
    kinds = [
        (np.dtype(order + prop.dtype), np.dtype(order + prop.length_dtype) if prop.length_dtype else None)
        for prop in element.properties
    ]
    dtype = element.dtype(order)
    _check_bytes(path, content, start, element, sum((length or kind).itemsize for kind, length in kinds))
    singles: list[bytes] = []
    for row in range(element.count):
        parts = []
        for kind, length in kinds:
            size = kind.itemsize
            if length is not None:
                size = _list_size(path, content, start, f"{element.name} {row}", kind, length)
            if start + size > len(content):
                raise DataError(path, f"byte {start}", f"{element.name} {row}: the file breaks off")
            if length is None:
                parts.append(content[start : start + size])
            start += size
        singles.append(b"".join(parts))
    return start, np.frombuffer(b"".join(singles), dtype) if dtype.itemsize else np.zeros(element.count, dtype)


def _list_size(
    path: Path, content: bytes, start: int, row: str, kind: np.dtype[np.generic], length: np.dtype[np.generic]
) -> int:
    if start + length.itemsize > len(content):
        raise DataError(path, f"byte {start}", f"{row}: the file breaks off")
    count = int(np.frombuffer(content, length, 1, start)[0])
    if count < 0:
        raise DataError(path, f"byte {start}", f"{row}: a list of {count} values")
    return length.itemsize + count * kind.itemsize


def _read_text(path: Path, content: bytes, header: PlyHeader) -> AnyArray:
    numbered = enumerate(content[header.start :].decode("latin-1").split("\n"), header.lines + 1)
    lines = [(number, line) for number, line in numbered if line.strip()]
    first = 0
    for element in header.elements:
        if element.name == "vertex":
            break
        first += element.count if element.properties else 0
    rows = lines[first : first + element.count]
    if len(rows) < element.count:
        problem = f"{len(rows)} lines of vertex; expected {element.count}; the file breaks off"
        raise DataError(path, "", problem)
    known = sum(one.count for one in header.elements if one.properties)
    if len(lines) > known:
        problem = f"{len(lines)} lines; expected {known} by the counts of the head"
        raise DataError(path, f"line {lines[known][0]}", problem)
    return _parse_vertices(path, rows, element)


def _parse_vertices(path: Path, rows: list[tuple[int, str]], element: Element) -> AnyArray:
    texts = [line for _, line in rows]
    if element.has_lists:
        texts = [_without_lists(path, number, line, element) for number, line in rows]
    return parse_rows(path, texts, element.dtype("="), rows[0][0] if rows else 0)


def _without_lists(path: Path, number: int, line: str, element: Element) -> str:
    words, kept, k = line.split(), [], 0
    for prop in element.properties:
        if k >= len(words):
            raise DataError(path, f"line {number}", f"{len(words)} values; expected {prop.name!r}, too")
        if prop.length_dtype:
            if not (words[k].isascii() and words[k].isdigit()):
                raise DataError(path, f"line {number}", f"{words[k][:20]!r} for the length of list {prop.name!r}")
            k += int(words[k][:10])
        else:
            kept.append(words[k])
        k += 1
    if k != len(words):
        raise DataError(path, f"line {number}", f"{len(words)} values; expected {k}")
    return " ".join(kept)


class PlyLayout:
    """PLY files of clouds: positions in the world as float64."""

    def columns(self, points: WrittenPoints) -> dict[str, AnyArray]:
        """All columns in their own types."""
        return {
            **axis_columns(points.positions_world),
            **color_columns(points.colors),
            **measured_columns(points),
        }

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
