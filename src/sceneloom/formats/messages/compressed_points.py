"""Compressed points of messages: zstd, zlib, Cloudini and Draco, as what they were before."""

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array
from sceneloom.errors import MissingExtraError, how_to_install
from sceneloom.formats.base.files import most_unpacked
from sceneloom.formats.base.wire_formats import read_varint
from sceneloom.formats.messages.file_bytes import decompress
from sceneloom.formats.messages.records import CloudRecord, PackedCloudRecord, PackedField
from sceneloom.formats.points.cloud import MOST_POINTS

_CLOUDINI, _DRACO = b"CLOUDINI_V", b"DRACO"
_MARKS: Mapping[bytes, str] = MappingProxyType(
    {_CLOUDINI: "cloudini", _DRACO: "draco", b"\x28\xb5\x2f\xfd": "zstd", b"\x1f\x8b": "zlib", b"\x78": "zlib"}
)
"""How compressed bytes begin. Source: Cloudini; Draco bitstream specification; RFC 8878, 1952 and 1950."""


def unpacked(record: PackedCloudRecord) -> CloudRecord:
    """Decompress the points of a message. What its bytes are is found by how they begin, not by what is stated.

    Raises:
        ValueError: the bytes are damaged, would take far more memory than points do, or are of another compression.
        MissingExtraError: the library of the compression is not installed.

    Source: packages draco_, zstd_ and zlib_point_cloud_transport of ROS 2; schema CompressedPointCloud of Foxglove.
    """
    content = bytes(record.data)
    form = next((form for mark, form in _MARKS.items() if content.startswith(mark)), None)
    if not content and record.layout is not None and not record.layout.count:
        return record.layout
    if form == "cloudini":
        return _placed(record, _Cloudini.of(content).points())
    if form == "draco":
        return _placed(record, _from_draco(content, record.layout))
    if form is None or record.layout is None:
        stated = "draco or cloudini" if record.layout is None else "draco, cloudini, zstd or zlib"
        raise ValueError(f"points of format {record.form!r} that begin with {content[:4].hex(' ')}; expected {stated}")
    size = _size_of(record.layout)
    _check_size(record.layout.count or 0, size, len(content))
    if form == "zstd":
        found = decompress("zstd", content, size + 1)
    else:
        try:
            found = zlib.decompressobj(wbits=zlib.MAX_WBITS + 32).decompress(content, size + 1)
        except zlib.error as error:
            raise ValueError(f"cannot be decompressed as zlib: {error}") from error
    if len(found) != size:
        more = "more than " if len(found) > size else ""
        raise ValueError(f"unpacks to {more}{min(len(found), size)} bytes; expected {size} by width, height and steps")
    return replace(record.layout, data=memoryview(found))


def _placed(record: PackedCloudRecord, found: CloudRecord) -> CloudRecord:
    return replace(
        found, timestamp_ns=record.timestamp_ns, frame_id=record.frame_id, frame_from_points=record.frame_from_points
    )


def _size_of(layout: CloudRecord) -> int:
    """How many bytes the points of a message are."""
    count = layout.count or 0
    if layout.row_bytes is None or layout.row_bytes[1] == 0:
        return count * layout.stride
    return count // layout.row_bytes[1] * layout.row_bytes[0]


def _check_size(count: int, size: int, packed: int) -> None:
    if not 0 <= count <= MOST_POINTS:
        raise ValueError(f"{count} points; expected 0 to {MOST_POINTS}")
    if size > most_unpacked(packed):
        raise ValueError(f"{packed} bytes that unpack to {size}; expected {most_unpacked(packed)} at most")


def _packed(columns: Sequence[tuple[str, AnyArray]], count: int) -> CloudRecord:
    """A record of columns, each (N,) of a simple dtype or (N, K) of it."""
    fields, offset = [], 0
    for name, column in columns:
        width = 1 if column.ndim == 1 else column.shape[1]
        fields.append(PackedField(name, offset, column.dtype.newbyteorder("<"), width))
        offset += width * column.dtype.itemsize
    rows = np.empty((count, offset), np.uint8)
    for field, (_, column) in zip(fields, columns, strict=True):
        content = np.ascontiguousarray(column, field.dtype).reshape(count, field.count)
        rows[:, field.offset : field.offset + field.count * field.dtype.itemsize] = content.view(np.uint8)
    return CloudRecord(0, "", tuple(fields), offset, rows.data.cast("B"), count)


_VERSIONS = range(2, 6)
_CHUNKED, _EXACT_IN_BITS, _BY_COLUMN = 3, 4, 5  # versions since which there are these
_CHUNK = 32 * 1024  # points
_MOST_BYTES = 11  # that a value takes before the second stage at most
_STAGES = ("NONE", "LOSSY", "LOSSLESS")
_COMPRESSIONS = ("NONE", "LZ4", "ZSTD")
_CLOUDINI_TYPES: Mapping[str, str] = MappingProxyType({
    "INT8": "i1", "UINT8": "u1", "INT16": "i2", "UINT16": "u2", "INT32": "i4", "UINT32": "u4", "FLOAT32": "f4",
    "FLOAT64": "f8", "INT64": "i8", "UINT64": "u8",
})  # fmt: skip
_MOST_FIELDS = 256


class _CloudiniField(NamedTuple):
    name: str
    offset: int
    dtype: np.dtype[Any]
    resolution: float | None


@dataclass(frozen=True, slots=True)
class _Cloudini:
    """What the head of Cloudini's bytes states, and what follows it.

    Source: cloudini.cpp, v4_codec.cpp, v5_codec.cpp and field_decoder.hpp of Cloudini 1.x. A head is text (YAML) or
    numbers; chunks of 32,768 points each begin with their length; each is LZ4 (a block), zstd, or neither.
    """

    version: int
    count: int
    stride: int
    stage: str
    compression: str
    fields: tuple[_CloudiniField, ...]
    chunks: memoryview

    @classmethod
    def of(cls, content: bytes) -> "_Cloudini":
        """Read the head; ValueError where it is none."""
        digits, start = content[len(_CLOUDINI) : len(_CLOUDINI) + 2], len(_CLOUDINI) + 2
        version = int(digits) if digits.isdigit() else -1
        if version not in _VERSIONS:
            expected = f"{_VERSIONS.start} to {_VERSIONS.stop - 1}"
            raise ValueError(f"Cloudini of version {digits.decode('ascii', 'replace')!r}; expected {expected}")
        if content[start : start + 1] == b"\n":
            stop = content.find(b"\0", start)
            if stop < 0:
                raise ValueError("the head of Cloudini is cut off")
            values, fields = _text_head(content[start:stop].decode("utf-8", "replace"))
            start = stop + 1
        else:
            values, fields, start = _binary_head(content, start)
        width, height, stride, stage, compression = values
        count = width * height
        _check_size(count, count * stride, len(content))
        for field in fields:
            end = field.offset + field.dtype.itemsize
            if end > stride:
                problem = f"field {field.name!r} takes bytes {field.offset} to {end} of each point, which has {stride}"
                raise ValueError(f"{problem}; expected fields inside the point")
        return cls(version, count, stride, stage, compression, fields, memoryview(content)[start:])

    def points(self) -> CloudRecord:
        """Decode all points; ValueError where chunks are damaged or missing."""
        values = np.empty((len(self.fields), self.count), np.int64)
        done, rest = 0, self.chunks
        if self.version < _CHUNKED:
            self._decode(bytes(rest), values)
            done, rest = self.count, rest[:0]
        while len(rest) and done < self.count:
            size = int.from_bytes(rest[:4], "little")
            if len(rest) < 4 + size:
                raise ValueError(f"a chunk of {size} bytes, of which {max(0, len(rest) - 4)} are there")
            stop = min(done + _CHUNK, self.count)
            part = np.empty((len(self.fields), stop - done), np.int64)
            self._decode(bytes(rest[4 : 4 + size]), part)
            values[:, done:stop] = part
            done, rest = stop, rest[4 + size :]
        if done < self.count or len(rest):
            raise ValueError(f"chunks of {done} points and {len(rest)} bytes more; expected {self.count} points")
        leading = self._leading()
        columns = [
            (field.name, self._column(field, row, narrow=k < leading))
            for k, (field, row) in enumerate(zip(self.fields, values, strict=True))
        ]
        return _packed(columns, self.count)

    def _column(self, field: _CloudiniField, values: Int64Array, *, narrow: bool) -> AnyArray:
        """The values of a field, (N,) of its dtype; `narrow`: sums of steps have 32 bits."""
        from sceneloom.kernels.packed import NO_NUMBER, STEPPED

        if field.dtype.kind != "f" or self._way(field) != STEPPED:
            bits: AnyArray = values.astype(f"<u{field.dtype.itemsize}").view(field.dtype)
            return bits
        steps = values.astype(np.int32) if narrow else values
        column: AnyArray = steps.astype(field.dtype) * field.dtype.type(np.float32(field.resolution))
        column[values == NO_NUMBER] = np.nan
        return column

    def _decode(self, chunk: bytes, values: Int64Array) -> None:
        """Decode a chunk into `values` (F, N)."""
        from sceneloom.kernels.packed import read_column, read_points

        points = values.shape[1]
        content = np.frombuffer(self._plain(chunk, points), np.uint8)
        lossy, leading = self.stage == "LOSSY", self._leading()
        integers = [field.dtype.kind in "iu" and field.dtype.itemsize > 1 for field in self.fields]
        by_column = self.version >= _BY_COLUMN and lossy and any(integers[leading:])
        apart = [by_column and one and k >= leading for k, one in enumerate(integers)]
        regular = [k for k, one in enumerate(apart) if not one]
        rows = [(self._way(f), f.dtype.itemsize, f.dtype.kind == "f") for f in (self.fields[k] for k in regular)]
        found = np.empty((len(rows), points), np.int64)
        stop = read_points(content, 0, np.array(rows, np.int64).reshape(-1, 3), found)
        values[regular] = found
        column = np.empty(points, np.int64)
        for k, one in enumerate(apart):
            if one and stop >= 0:
                stop = read_column(content, stop, self.fields[k].dtype.itemsize, column)
                values[k] = column
        if stop != len(content):
            problem = "breaks off, or holds what no point has" if stop < 0 else f"has {len(content) - stop} bytes more"
            raise ValueError(f"a chunk of {points} points {problem}")

    def _way(self, field: _CloudiniField) -> int:
        """How the values of a field follow from those of the point before."""
        from sceneloom.kernels.packed import COPIED, GORILLA, MIXED, STEPPED

        size, is_float = field.dtype.itemsize, field.dtype.kind == "f"
        if self.stage == "NONE" or size == 1:
            return COPIED
        if not is_float or (self.stage == "LOSSY" and field.resolution is not None):
            return STEPPED
        if size == 4:
            return MIXED if self.stage == "LOSSLESS" else COPIED
        return GORILLA if field.resolution is None and self.version >= _EXACT_IN_BITS else MIXED

    def _leading(self) -> int:
        """How many fields are read as one vector: the first three or four, where so many floats come first."""
        count = 0
        for field in self.fields:
            if field.dtype.str[1:] != "f4" or field.resolution is None:
                break
            count += 1
        return count if self.stage == "LOSSY" and count in {3, 4} else 0

    def _plain(self, chunk: bytes, points: int) -> bytes:
        most = points * max(self.stride, _MOST_BYTES * len(self.fields)) + 32 * len(self.fields) + 1024
        if self.compression == "NONE":
            return chunk
        if self.compression == "ZSTD":
            return decompress("zstd", chunk, min(most, most_unpacked(len(chunk))))
        try:
            import lz4.block
        except ImportError as missing:
            raise MissingExtraError(f"{missing}; install the extra: {how_to_install('mcap')}") from missing
        try:
            found: bytes = lz4.block.decompress(chunk, uncompressed_size=min(most, most_unpacked(len(chunk))))
        except (lz4.block.LZ4BlockError, MemoryError, OverflowError) as error:
            raise ValueError(f"cannot be decompressed as lz4: {error}") from error
        return found


_Head = tuple[int, int, int, str, str]  # width, height, bytes from point to point, first and second stage


def _text_head(text: str) -> tuple[_Head, tuple[_CloudiniField, ...]]:
    """The head as YAML, of which Cloudini writes lines of `name: value` and a list of such for `fields`."""
    entries: list[dict[str, str]] = [{}]
    for line in text.splitlines():
        bare = line.strip()
        if bare.startswith("- "):
            entries.append({})
        name, _, value = bare.removeprefix("- ").partition(":")
        entries[-1][name.strip()] = value.strip()
    root, rows = entries[0], entries[1:]
    try:
        fields = tuple(
            _CloudiniField(
                row["name"],
                _count(row["offset"]),
                _dtype(row["type"]),
                None if row.get("resolution", "null") == "null" else float(row["resolution"]),
            )
            for row in rows
        )
        sizes = _count(root["width"]), _count(root["height"]), _count(root["point_step"])
        return _head(*sizes, root["encoding_opt"], root["compression_opt"], fields), fields
    except KeyError as error:
        raise ValueError(f"the head of Cloudini does not state {error}") from error


def _binary_head(content: bytes, start: int) -> tuple[_Head, tuple[_CloudiniField, ...], int]:
    try:
        width, height, stride, stage, compression, count = struct.unpack_from("<IIIBBH", content, start)
        start += 16
        fields = []
        for _ in range(min(count, _MOST_FIELDS + 1)):
            (length,) = struct.unpack_from("<H", content, start)
            offset, kind, resolution = struct.unpack_from("<IBf", content, start + 2 + length)
            name = content[start + 2 : start + 2 + length].decode("utf-8", "replace")
            fields.append(_CloudiniField(name, offset, _dtype(kind), resolution if resolution > 0 else None))
            start += 11 + length
    except struct.error as error:
        raise ValueError(f"the head of Cloudini is cut off: {error}") from error
    return _head(width, height, stride, stage, compression, tuple(fields)), tuple(fields), start


def _head(
    width: int, height: int, stride: int, stage: Any, compression: Any, fields: tuple[_CloudiniField, ...]
) -> _Head:
    if len(fields) > _MOST_FIELDS:
        raise ValueError(f"more than {_MOST_FIELDS} fields")
    for field in fields:
        if field.resolution is not None and not 0 < field.resolution < np.inf:
            raise ValueError(f"resolution {field.resolution} of field {field.name!r}; expected a positive number")
    return width, height, stride, _word(stage, _STAGES), _word(compression, _COMPRESSIONS)


def _word(value: Any, words: Sequence[str]) -> str:
    """One of some words, by itself or by its number."""
    number = int(value) if isinstance(value, int) or str(value).isdecimal() else -1
    word = words[number] if 0 <= number < len(words) else value
    if word not in words:
        raise ValueError(f"{value!r} in the head of Cloudini; expected one of {', '.join(words)}")
    return str(word)


def _count(text: str) -> int:
    if not text.isdecimal() or len(text) > 10:
        raise ValueError(f"{text[:40]!r} in the head of Cloudini; expected a number of 32 bits")
    return int(text)


def _dtype(kind: Any) -> np.dtype[Any]:
    """A type by name, or by the number that `sensor_msgs/PointField` has for it, and 9 and 10 for 64 bits."""
    named = _CLOUDINI_TYPES.get(kind) if isinstance(kind, str) and not kind.isdecimal() else None
    if named is None:
        names = ("", *_CLOUDINI_TYPES)
        named = _CLOUDINI_TYPES.get(_word(kind, names)) if kind else None
    if named is None:
        raise ValueError(f"a field of type {kind!r}; expected one of {', '.join(_CLOUDINI_TYPES)}")
    return np.dtype("<" + named)


_DRACO_HEAD = struct.Struct("<5sBBBBH")
_DRACO_POINTS, _DRACO_METADATA, _DRACO_VERSION, _SEQUENTIAL = 0, 0x8000, 2, 0
_DRACO_SIZES: Mapping[int, int] = MappingProxyType({1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 8, 8: 8, 9: 4, 10: 8, 11: 1})
"""Bytes of a number of each type: whole numbers of 8 to 64 bits with and without sign, floats, and truth values."""

_EXACT = 1 << 24
_ROUNDED = frozenset({5, 7, 8, 10})
"""Types that DracoPy gives as floats of 32 bits: exact below `_EXACT`, where they are whole numbers."""

_DRACO_TYPES: Mapping[int, str] = MappingProxyType({1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 11: "u1"})
_DRACO_NAMES: Mapping[int, tuple[str, ...]] = MappingProxyType(
    {0: ("x", "y", "z"), 1: ("nx", "ny", "nz"), 2: ("red", "green", "blue", "alpha")}
)
"""Names of the numbers of positions, normals and colours."""


def _from_draco(content: bytes, layout: CloudRecord | None) -> CloudRecord:
    """Decode Draco: its attributes are the fields of `layout`, one by one, else have names of their own.

    Source: Draco bitstream specification; draco_point_cloud_transport, which makes each field an attribute.
    """
    count = _check_draco(content)
    try:
        import DracoPy
    except ImportError as missing:
        raise MissingExtraError(f"{missing}; install the extra: {how_to_install('draco')}") from missing
    try:
        attributes: list[dict[str, Any]] = DracoPy.decode(content).attributes
    except Exception as error:
        raise ValueError(f"cannot be decoded as draco: {error}") from error
    columns: list[tuple[str, AnyArray]] = []
    left_out: list[str] = []
    if layout is not None and len(layout.fields) != len(attributes):
        raise ValueError(f"{len(attributes)} attributes of Draco; expected {len(layout.fields)} as the message states")
    seen: dict[int, int] = {}
    for k, attribute in enumerate(attributes):
        values = np.asarray(attribute["data"])
        values = values.reshape(len(values), -1)
        if len(values) != count:
            raise ValueError(f"an attribute of {len(values)} values; expected {count} as there are points")
        kind, number = int(attribute["attribute_type"]), int(attribute["data_type"])
        field = None if layout is None else layout.fields[k]
        first = seen.get(kind, 0)
        seen[kind] = first + values.shape[1]
        name = attribute["name"] or f"attribute_{attribute['unique_id']}"
        if number in _ROUNDED and (number == 10 or (np.abs(values) >= _EXACT).any()) and kind != 0:
            left_out.append(name if field is None else field.name)
            continue
        dtype = _DRACO_TYPES.get(number, "f4")
        values = values.astype(dtype)
        if field is not None:
            whole = np.ascontiguousarray(values).view(np.uint8).reshape(count, -1)
            if whole.shape[1] == field.count * field.dtype.itemsize:
                # also of a colour, whose four bytes are one number
                columns.append((field.name, whole.view(field.dtype)))
            elif values.shape[1] == field.count:
                columns.append((field.name, values.astype(field.dtype)))
            else:
                raise ValueError(f"{values.shape[1]} numbers for field {field.name!r}; expected {field.count}")
            continue
        names = _DRACO_NAMES.get(kind, ())[first : first + values.shape[1]]
        if len(names) == values.shape[1] and not (attribute["name"] and values.shape[1] == 1):
            columns += [(one, values[:, j]) for j, one in enumerate(names)]
        else:
            columns.append((name, values[:, 0] if values.shape[1] == 1 else values))
    found = [(name, column[:, 0] if column.ndim == 2 and column.shape[1] == 1 else column) for name, column in columns]
    return replace(_packed(found, count), left_out=tuple(left_out))


def _check_draco(content: bytes) -> int:
    """How many points Draco's head states; ValueError where they would take far more memory than their bytes."""
    try:
        _, version, _, kind, method, flags = _DRACO_HEAD.unpack_from(content)
        if kind != _DRACO_POINTS or version != _DRACO_VERSION:
            raise ValueError(f"Draco of kind {kind}, version {version}; expected points (0), version {_DRACO_VERSION}")
        position = _DRACO_HEAD.size
        if flags & _DRACO_METADATA:
            owners, position = read_varint(content, position, len(content))
            for _ in range(owners):
                position = _skip_metadata(content, read_varint(content, position, len(content))[1])
            position = _skip_metadata(content, position)
        count, decoders = struct.unpack_from("<iB", content, position)
        position += 5
        size = 0
        for _ in range(decoders):
            attributes, position = read_varint(content, position, len(content))
            for _ in range(attributes):
                size += content[position + 2] * _DRACO_SIZES.get(content[position + 1], 8)
                position = read_varint(content, position + 4, len(content))[1]
            position += attributes if method == _SEQUENTIAL else 0  # how each attribute is decoded
    except (IndexError, struct.error, RecursionError) as error:
        raise ValueError(f"the head of Draco is cut off: {error}") from error
    _check_size(count, count * max(1, size), len(content))
    return int(count)


def _skip_metadata(content: bytes, position: int) -> int:
    """Where metadata end: entries of names and values, then parts of names and metadata."""
    entries, position = read_varint(content, position, len(content))
    for _ in range(entries):
        position += 1 + content[position]
        size, position = read_varint(content, position, len(content))
        position += size
    parts, position = read_varint(content, position, len(content))
    for _ in range(parts):
        position = _skip_metadata(content, position + 1 + content[position])
    return position
