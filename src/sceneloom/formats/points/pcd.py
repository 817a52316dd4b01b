"""PCD, the files of the Point Cloud Library: read, and written chunk by chunk."""

from collections.abc import Mapping
from dataclasses import dataclass, field
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


@dataclass(frozen=True, slots=True)
class PcdHeader:
    """The head of a PCD file.

    Attributes:
        dtype: one point, packed, little-endian.
        count: number of points.
        data: "ascii", "binary" or "binary_compressed".
        start: byte at which the points begin.
        lines: lines of the head.
        further: the viewpoint, and the width of rows where there are several, in the words of the head.
    """

    dtype: np.dtype[np.void]
    count: int
    data: str
    start: int
    lines: int
    further: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


def read_pcd(path: Path) -> Cloud:
    """Read a PCD file; points that are not finite stay in it, `VIEWPOINT` is not applied.

    Raises:
        DataError: the head is wrong, or the points are not as many bytes or lines as it says.
    """
    content = read_bytes(path)
    header = _parse_header(path, content)
    if header.count == 0 or header.dtype.itemsize == 0:
        # a compressed file of no points still says that it is 0 bytes
        check_end(path, content[header.start :], header.start, f"{header.count} points")
        return Cloud(path, header.count, columns_of(np.zeros(header.count, header.dtype)), header.further)
    return Cloud(path, header.count, _READERS[header.data](path, content, header), header.further)


def _parse_header(path: Path, content: bytes) -> PcdHeader:
    """Parse the head of a PCD file.

    Raises:
        DataError: a line is missing or wrong.
    """
    entries, start, lines = _entries(path, content)
    names = entries["FIELDS"]
    sizes = _integers(path, entries, "SIZE", len(names))
    counts = _integers(path, entries, "COUNT", len(names)) if "COUNT" in entries else [1] * len(names)
    types = _sized(path, entries, "TYPE", len(names))
    fields = []
    for k, name in enumerate(unique_names(names)):
        if types[k] not in _LETTERS or sizes[k] not in _SIZES[types[k]]:
            problem = f"{types[k]}{sizes[k]} for {name!r}; expected F4 F8 I1 I2 I4 I8 U1 U2 U4 U8"
            raise DataError(path, "TYPE, SIZE", problem)
        if not 1 <= counts[k] <= _MOST_VALUES:
            raise DataError(path, "COUNT", f"{counts[k]} for {name!r}; expected 1 to {_MOST_VALUES}")
        shape = () if counts[k] == 1 else (counts[k],)
        fields.append((name, f"<{_LETTERS[types[k]]}{sizes[k]}", shape))
    data = " ".join(entries["DATA"]).lower()
    if data not in _READERS:
        raise DataError(path, "DATA", f"{data!r}; expected {', '.join(_READERS)}")
    return PcdHeader(np.dtype(fields), _count(path, entries), data, start, lines, _further(path, entries))


def _entries(path: Path, content: bytes) -> tuple[dict[str, list[str]], int, int]:
    """Cut the head into its lines, up to and with `DATA`."""
    entries: dict[str, list[str]] = {}
    start, number = 0, 0
    while "DATA" not in entries:
        stop = content.find(b"\n", start, _LONGEST_HEADER)
        if stop < 0:
            problem = "the head breaks off without a line `DATA`" if entries else "does not begin as a PCD file does"
            raise DataError(path, f"byte {start}", f"{problem}; expected lines {' '.join(_KEYS)}")
        number += 1
        words = content[start:stop].decode("latin-1").split()
        start = stop + 1
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in (*_KEYS, "COLUMNS"):
            raise DataError(path, f"line {number}", f"{words[0][:40]!r}; expected one of {' '.join(_KEYS)}")
        entries["FIELDS" if words[0] == "COLUMNS" else words[0]] = words[1:]
    for key in ("FIELDS", "SIZE", "TYPE"):
        if key not in entries:
            raise DataError(path, key, "missing in the head")
    return entries, start, number


def _sized(path: Path, entries: dict[str, list[str]], key: str, count: int) -> list[str]:
    if len(entries[key]) != count:
        raise DataError(path, key, f"{len(entries[key])} entries; expected {count}, one for each of FIELDS")
    return entries[key]


def _integers(path: Path, entries: dict[str, list[str]], key: str, count: int) -> list[int]:
    return [_integer(path, key, word) for word in _sized(path, entries, key, count)]


def _integer(path: Path, key: str, word: str) -> int:
    if not (word.isascii() and word.isdigit() and len(word) < 20):
        raise DataError(path, key, f"{word[:40]!r}; expected a whole number")
    return int(word)


def _count(path: Path, entries: dict[str, list[str]]) -> int:
    """The number of points: `POINTS`, else width times height; both where they are given must agree."""
    numbers = {
        key: _integer(path, key, " ".join(entries[key])) for key in ("WIDTH", "HEIGHT", "POINTS") if key in entries
    }
    area = numbers["WIDTH"] * numbers.get("HEIGHT", 1) if "WIDTH" in numbers else None
    count = numbers.get("POINTS", area)
    if count is None:
        raise DataError(path, "POINTS", "missing in the head, as is WIDTH")
    if area is not None and area != count:
        raise DataError(path, "POINTS", f"{count}; WIDTH times HEIGHT is {area}")
    check_count(path, "POINTS", count)
    return count


def _further(path: Path, entries: dict[str, list[str]]) -> Mapping[str, Any]:
    """What the head says besides: the pose of the sensor that is not the identity, and the order of the points."""
    further: dict[str, Any] = {}
    viewpoint = entries.get("VIEWPOINT", _NO_VIEWPOINT)
    try:
        numbers = [float(word) for word in viewpoint]
    except ValueError:
        numbers = []
    if len(numbers) != len(_NO_VIEWPOINT):
        problem = f"{' '.join(viewpoint)[:60]!r}; expected 7 numbers: x y z and a quaternion w x y z"
        raise DataError(path, "VIEWPOINT", problem)
    if numbers != [float(word) for word in _NO_VIEWPOINT]:
        further["viewpoint"] = numbers
    if "HEIGHT" in entries and _integer(path, "HEIGHT", " ".join(entries["HEIGHT"])) > 1:
        further["width"] = _integer(path, "WIDTH", " ".join(entries.get("WIDTH", ["0"])))
    return MappingProxyType(further)


def _read_text(path: Path, content: bytes, header: PcdHeader) -> dict[str, AnyArray]:
    numbered = enumerate(content[header.start :].decode("latin-1").split("\n"), header.lines + 1)
    lines = [(number, line) for number, line in numbered if line.strip()]
    if len(lines) != header.count:
        raise DataError(path, "", f"{len(lines)} lines of points; the head says {header.count}")
    # latin-1 knows spaces that are none in ASCII; what is left of them does not parse
    return columns_of(parse_rows(path, [line for _, line in lines], header.dtype, lines[0][0]))


def _read_binary(path: Path, content: bytes, header: PcdHeader) -> dict[str, AnyArray]:
    expected, found = header.count * header.dtype.itemsize, len(content) - header.start
    if found < expected:
        problem = (
            f"{found} bytes of points; expected {expected}: "
            f"{header.count} points of {header.dtype.itemsize} bytes; the file breaks off"
        )
        raise DataError(path, f"byte {header.start}", problem)
    stop = header.start + expected
    check_end(path, content[stop:], stop, f"{header.count} points of {header.dtype.itemsize} bytes")
    return columns_of(np.frombuffer(content, header.dtype, header.count, header.start))


def _read_compressed(path: Path, content: bytes, header: PcdHeader) -> dict[str, AnyArray]:
    """Unfold the columns, which stand one after another where they are compressed."""
    from sceneloom.kernels.packed import LARGEST_RATIO, unfold

    location, body = f"byte {header.start}", header.start + 8
    if len(content) < body:
        raise DataError(path, location, f"{len(content) - header.start} bytes of points; the file breaks off")
    packed_size, size = np.frombuffer(content, "<u4", 2, header.start).tolist()
    if len(content) - body < packed_size:
        problem = f"{len(content) - body} compressed bytes; expected {packed_size}; the file breaks off"
        raise DataError(path, location, problem)
    expected = header.count * header.dtype.itemsize
    if size != expected or size > packed_size * LARGEST_RATIO:
        problem = f"{packed_size} bytes that unfold to {size}; expected {expected} from {header.count} points"
        raise DataError(path, location, problem)
    check_end(path, content[body + packed_size :], body + packed_size, f"{header.count} points")
    unpacked = np.empty(size, np.uint8)
    done = unfold(np.frombuffer(content, np.uint8, packed_size, body), unpacked)
    if done != size:
        raise DataError(path, location, "the compressed points are damaged: they do not unfold to what the head says")
    return _cut_columns(unpacked, header)


def _cut_columns(unpacked: AnyArray, header: PcdHeader) -> dict[str, AnyArray]:
    columns, start = {}, 0
    for name in header.dtype.names or ():
        kind = header.dtype[name]
        stop = start + header.count * kind.itemsize
        column = unpacked[start:stop].view(kind.base).reshape(header.count, *kind.shape)
        if not name.startswith("_"):
            columns[name] = column.astype(kind.base.newbyteorder("="))
        start = stop
    return columns


_READERS = {"ascii": _read_text, "binary": _read_binary, "binary_compressed": _read_compressed}

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
    return _text(records) if encoding == "ascii" else _compressed(records)


def _text(records: AnyArray) -> bytes:
    """Numbers with all their digits; packed colours as their float, which is what readers of text expect."""
    names = records.dtype.names or ()
    columns: list[list[str]] = []
    for name in names:
        values = records[name].reshape(len(records), -1)
        columns += [[str(value) for value in values[:, k]] for k in range(values.shape[1])]
    return "".join(" ".join(row) + "\n" for row in zip(*columns, strict=True)).encode()


def _compressed(records: AnyArray) -> bytes:
    from sceneloom.kernels.packed import fold, longest_fold

    plain = b"".join(np.ascontiguousarray(records[name]).tobytes() for name in records.dtype.names or ())
    if not plain:
        return np.zeros(2, "<u4").tobytes()
    packed = np.empty(longest_fold(len(plain)), np.uint8)
    size = fold(np.frombuffer(plain, np.uint8), packed)
    return np.array([size, len(plain)], "<u4").tobytes() + packed[:size].tobytes()
