"""PCD, the files of the Point Cloud Library: read, and written chunk by chunk."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array
from sceneloom.errors import DataError
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.points.cloud import (
    Cloud,
    Column,
    WrittenPoints,
    check_count,
    check_end,
    columns_of,
    parse_rows,
    records_of,
    seconds,
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
            problem = (
                "the head breaks off without a line `DATA`"
                if entries
                else "does not begin as a PCD file does"
            )
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
        key: _integer(path, key, " ".join(entries[key]))
        for key in ("WIDTH", "HEIGHT", "POINTS")
        if key in entries
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
        raise DataError(
            path, location, "the compressed points are damaged: they do not unfold to what the head says"
        )
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

_PCD_WRITING_LETTERS = {"u": "U", "i": "I", "f": "F"}

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
        if len(finite) and np.abs(finite).max() > _FARTHEST_EXACT:
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
            f"TYPE {' '.join(_PCD_WRITING_LETTERS[kind.kind] for kind in kinds)}",
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
