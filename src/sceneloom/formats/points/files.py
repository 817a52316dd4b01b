"""Files of points, PCD and PLY and others by their suffixes: read, and written in chunks or from a lidar frame."""

import ast
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO, Self

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, finite_rows
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.files import check_length, check_unpacked, file_faults, open_file, read_bytes
from sceneloom.formats.base.losses import Losses
from sceneloom.formats.base.output import replacing
from sceneloom.formats.points.cloud import (
    ALIASES,
    KITTI,
    MOST_POINTS,
    NO_LABEL,
    NUSCENES,
    ROW_ALIASES,
    Cloud,
    CloudWriter,
    FieldLayout,
    WrittenPoints,
    parse_rows,
    unique_names,
)
from sceneloom.formats.points.copc import write_copc
from sceneloom.formats.points.spec import POSITION_NAMES

_MAGIC = b"\x93NUMPY"
_LONGEST_HEAD = 20_000

_FAULTS = (
    ValueError, KeyError, EOFError, TypeError, SyntaxError, RuntimeError, NotImplementedError, OverflowError,
    IndexError, RecursionError, zipfile.BadZipFile, zlib.error, tokenize.TokenError, UserWarning,
)  # fmt: skip
"""What NumPy and the modules below it raise for files that are damaged, encrypted, or hold objects."""

_PLAIN_COLUMNS = ("x", "y", "z", "intensity")
_NAMES_OF_COLUMNS = {name for names in (*ALIASES.values(), *ROW_ALIASES.values()) for name in names}


def _read_npz(path: Path, *, layout: FieldLayout | None = None) -> Cloud:
    """Read arrays by name; rows of several numbers are cut into columns by `layout`, by default x y z intensity."""
    arrays = _arrays(path)
    columns: dict[str, AnyArray] = {}
    for name, array in arrays.items():
        found = _columns(path, name, array, layout)
        twice = [column for column in found if column in columns]
        if twice:
            # whichever came last would be taken in silence
            problem = f"gives {' '.join(twice)}, which another array gives, too; expected each column once"
            hint = "leave out one of rows by `_` in `fields`, or one of the arrays"
            raise DataError(path, name, f"{problem}: {hint}")
        columns.update(found)
    if not columns:
        held = ", ".join(f"{name} {getattr(array, 'shape', '')}".strip() for name, array in arrays.items()) or "nothing"
        expected = "arrays of numbers with a row per point, of 1 or 2 dimensions"
        raise DataError(path, "", f"holds {held}; expected {expected}")
    lengths = {name: len(column) for name, column in columns.items()}
    main = (lengths[name] for name in (*_PLAIN_COLUMNS, *POSITION_NAMES) if name in lengths)
    count = next(main, max(lengths.values()))
    _check_count(path, "", count)
    for name, length in lengths.items():
        # a column that is one of the points by its name; single numbers are none
        if length not in {1, count} and name.lower() in _NAMES_OF_COLUMNS:
            raise DataError(path, name, f"{length} numbers for {count} points; expected one per point")
    # other arrays of other lengths state something of the file, not of its points
    return Cloud(path, count, {name: column for name, column in columns.items() if len(column) == count})


def _arrays(path: Path) -> dict[str, AnyArray]:
    with file_faults(path), open_file(path) as file:
        size = check_length(path)
        if not size:
            raise DataError(path, "", "is empty; expected arrays of NumPy")
        try:
            head = file.read(_LONGEST_HEAD)
            file.seek(0)
            if head.startswith(_MAGIC):
                _check_size(path, "", head, size)
            loaded: Any = np.load(file, allow_pickle=False)
            if isinstance(loaded, np.ndarray):
                return {"points" if loaded.dtype.names is None else "": loaded}
            # what the entries declare is compared with the bytes of the file before any of them is unpacked
            check_unpacked(path, "", size, sum(entry.file_size for entry in loaded.zip.infolist()))
            for entry in loaded.zip.infolist():
                with loaded.zip.open(entry) as inner:
                    _check_size(path, entry.filename, inner.read(_LONGEST_HEAD), entry.file_size)
            return {name: loaded[name] for name in loaded.files}
        except _FAULTS as error:
            objects = "allow_pickle" in str(error) or "pickle" in str(error).lower()
            problem = "holds Python objects, which are never loaded" if objects else f"cannot be read: {error}"
            raise DataError(path, "", f"{problem}; expected arrays of numbers") from error


def _check_size(path: Path, location: str, head: bytes, size: int) -> None:
    """Refuse an array that is not as long as the bytes behind its head. Source: "NPY format", numpy.lib.format."""
    if not head.startswith(_MAGIC) or len(head) < 12:
        return
    start = 10 if head[6] == 1 else 12
    stop = start + int.from_bytes(head[8:start], "little")
    reported = ast.literal_eval(head[start:stop].decode("latin-1").strip())
    kind = np.lib.format.descr_to_dtype(reported["descr"])
    if kind.hasobject:
        return
    expected = math.prod(reported["shape"]) * kind.itemsize
    if min(reported["shape"], default=0) < 0 or expected != size - stop:
        problem = f"{size - stop} bytes; expected {expected} of shape {reported['shape']} and type {kind}"
        raise DataError(path, location, problem)


def _columns(path: Path, name: str, array: AnyArray, layout: FieldLayout | None) -> dict[str, AnyArray]:
    """Cut one array into columns; what is no array of numbers with a row per point is passed over."""
    if not isinstance(array, np.ndarray):
        raise DataError(path, name, "is no array; expected arrays of numbers")
    if array.dtype.names is not None and array.ndim == 1:
        return _columns_of(array)
    if array.dtype.kind not in "iufb" or array.ndim not in {1, 2}:
        return {}
    plain = np.ascontiguousarray(array, array.dtype.newbyteorder("="))
    if plain.ndim == 1 or name not in POSITION_NAMES:
        return {name: plain[:, 0] if plain.ndim == 2 and plain.shape[1] == 1 else plain}
    names = _PLAIN_COLUMNS[: plain.shape[1]] if layout is None else layout.names
    if plain.shape[1] != len(names) or plain.shape[1] < 3:
        expected = "3 or 4 (x y z intensity)" if layout is None else f"{len(names)}: {' '.join(names)}"
        problem = f"rows of {plain.shape[1]} numbers; expected {expected}; name them with `fields`"
        raise DataError(path, name, problem)
    return {column: np.ascontiguousarray(plain[:, k]) for k, column in enumerate(names) if column[0] != "_"}


def default_layout(path: Path) -> FieldLayout:
    """The layout of a file whose manifest names none: nuScenes' for `.pcd.bin`, else KITTI's."""
    return NUSCENES if path.name.lower().endswith(".pcd.bin") else KITTI


def read_bin(path: Path, *, layout: FieldLayout | None = None) -> Cloud:
    """Read a file of packed little-endian points.

    Raises:
        DataError: the file is no whole number of points.
    """
    chosen = layout or default_layout(path)
    content, record = read_bytes(path), chosen.dtype
    count, rest = divmod(len(content), record.itemsize)
    if rest:
        problem = (
            f"{len(content)} bytes are {count} points of {record.itemsize} bytes ({chosen}) and {rest} bytes more; "
            "expected whole points: is the file cut off, or has it other fields?"
        )
        raise DataError(path, f"byte {count * record.itemsize}", problem)
    _check_count(path, "", count)
    return Cloud(path, count, _columns_of(np.frombuffer(content, record, count)))


_MOST_STEPS = 2**31 - 1
"""Steps between a position and the offset at most."""

_STEP = 0.001  # positions are whole multiples of this [m] from an offset: finer than any lidar measures
_PLAIN, _COLORED = 6, 7
"""Point formats: positions, intensity, classification and time; and with colours. Source: section 2.6."""

_FULL_SCALE = 257
"""From 8 to 16 bits: 255 becomes 65535. Source: "Red, Green, Blue" and "Intensity", to be normalised to 16 bits."""

_LARGEST_CLASS = 255
_FARTHEST_M = 1e10  # limit of coordinates [m]; 70 times the distance to the sun
_SMALLEST_SCALE, _LARGEST_SCALE = 1e-12, 1e6  # steps of positions [m]
_LAYOUT = struct.Struct("<HIIBHI")
_RECORD_HEAD, _EXTENDED_HEAD = 54, 60
_HEADER_LENGTHS = (227, 227, 227, 235, 375)  # shortest headers of the versions 1.0 to 1.4 [bytes]
_LONGEST_HEADER = 375
_POINT_LENGTHS = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
"""Shortest points of the point formats 0 to 10 [bytes]. Source: section 2.6."""

_KNOWN_RECORDS = (4, 22204)
"""Numbers of the records that describe further dimensions and how LAZ is packed. Source: section 2.8, "Extra Bytes"."""


class _LasFile:
    """A LAS file that is being written, or LAZ, by the ending of its name."""

    def __init__(
        self, path: Path, positions: Float64Array, step: float, further: Mapping[str, AnyArray], *, colored: bool
    ) -> None:
        """Begin a file: positions count from the mean of these first (N, 3) [m], in whole multiples of `step` [m]."""
        import laspy

        header = laspy.LasHeader(version="1.4", point_format=_COLORED if colored else _PLAIN)
        header.generating_software = "sceneloom"
        header.scales, header.offsets = np.full(3, step), _las_offsets(positions)
        header.add_extra_dims([laspy.ExtraBytesParams(name, values.dtype) for name, values in further.items()])
        self._path = path
        self._file = laspy.open(str(path), mode="w", header=header)

    def add(self, positions: Float64Array, dimensions: Mapping[str, AnyArray]) -> float:
        """Write more points, not too far for the file's steps; give how far a coordinate was moved at most [m]."""
        import laspy

        header = self._file.header
        steps = (positions - header.offsets) / header.scales
        most = float(np.abs(steps).max(initial=0.0))
        if most >= _MOST_STEPS:
            problem = f"points {most * header.scales[0] / 1000:.0f} km apart; expected 2147"
            raise DataError(self._path, "", problem)
        record = laspy.ScaleAwarePointRecord.zeros(len(positions), header=header)
        steps = np.rint(steps)
        for axis, name in enumerate(("X", "Y", "Z")):
            record[name] = steps[:, axis].astype(np.int32)
        single = np.ones(len(positions), np.uint8)  # a count of 0 is none
        for name, values in {"return_number": single, "number_of_returns": single, **dimensions}.items():
            record[name] = values
        self._file.write_points(record)
        return float(np.abs(steps * header.scales + header.offsets - positions).max(initial=0.0))

    def close(self) -> None:
        """Complete the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _las_offsets(positions: Float64Array) -> Float64Array:
    """What positions count from, (3,) float64 [m]: whole metres at the mean of the first points."""
    return np.floor(positions.mean(axis=0)) if len(positions) else np.zeros(3)


def _colors_16(colors: AnyArray | None) -> dict[str, AnyArray]:
    """Colours of 16 bits by channel."""
    return {name: values.astype(np.uint16) * _FULL_SCALE for name, values in _color_columns(colors).items()}


class _LasWriter:
    """An open LAS file: labels are classifications up to 255, and all in `label`; times are the scene's [s]."""

    def __init__(self, path: Path) -> None:
        """Begin a file, which must not be there."""
        self._path = path
        self._file: _LasFile | None = None

    def add(self, points: WrittenPoints) -> None:
        """Write some more points; those that are not finite have no position in such a file and are left out."""
        finite = np.isfinite(points.positions_world).all(axis=1)
        positions = points.positions_world[finite]
        measured = _measured_columns(points)
        if self._file is None:
            further = {name: values for name, values in measured.items() if name not in {"intensity", "time"}}
            self._file = _LasFile(self._path, positions, _STEP, further, colored=True)
        dimensions = {**measured, **_colors_16(points.colors)}
        if points.intensities is not None:
            dimensions["intensity"] = points.intensities.astype(np.uint16) * _FULL_SCALE
        if points.timestamps_ns is not None:
            dimensions["gps_time"] = dimensions.pop("time")
        if points.labels is not None:
            known = (points.labels <= _LARGEST_CLASS) & (points.labels != NO_LABEL)
            dimensions["classification"] = np.where(known, points.labels, 0).astype(np.uint8)
        self._file.add(positions, {name: values[finite] for name, values in dimensions.items()})

    def close(self) -> None:
        """Complete the file."""
        if self._file is None:
            self.add(WrittenPoints(np.zeros((0, 3))))
        if self._file is not None:
            self._file.close()


def _read_las(path: Path) -> Cloud:
    """Read all points of a LAS or LAZ file, of any point format; positions in metres, times as `gps_time`."""
    # The header is held against the bytes of the file before anything is read: where points begin, their number and
    # length, records before and behind them. Points beyond its bounds are read, and the head of the cloud says so.
    import laspy

    with file_faults(path), open_file(path) as stream:
        size = check_length(path)
        if not size:
            raise DataError(path, "", "is empty; expected a LAS file")
        known = _Header.of(path, stream.read(_LONGEST_HEADER))
        known.check(size)
        _check_records(path, stream, known, size)
        stream.seek(0)
        try:
            with laspy.open(stream, closefd=False) as file:
                if file.header.are_points_compressed:
                    _check_chunks(path, stream, file.header)
                points = file.read()
                columns, head = _las_columns(points), _head(file.header)
        except (DataError, OSError, MemoryError, KeyboardInterrupt, SystemExit):
            raise
        except BaseException as error:
            # laspy and what unpacks LAZ for it raise what they met, of any kind, and panic, which is no Exception
            reported = str(error) or type(error).__name__
            raise DataError(path, "", f"cannot be read: {reported}; expected a LAS file") from error
    _check_positions(path, columns, known.count)
    return Cloud(path, known.count, columns, MappingProxyType({**head, **_bounds(columns, known)}))


@dataclass(frozen=True, slots=True)
class _Header:
    """What a header declares, starts and lengths in bytes. Source: section 2.4, "Public Header Block"."""

    path: Path
    version: int  # minor one
    length: int
    points_start: int
    records: int  # of variable length, before the points
    compressed: bool  # LAZ
    point_format: int
    point_length: int
    count: int
    legacy_count: int  # as versions before 1.4 state it
    scales: tuple[float, ...]  # x, y, z [m]
    offsets: tuple[float, ...]
    bounds: tuple[float, ...]  # largest and smallest x, y, z, each axis for itself [m]
    waveforms_start: int = 0  # of packets, 0 for none in this file
    extended_start: int = 0  # of the records of variable length behind the points
    extended: int = 0

    @classmethod
    def of(cls, path: Path, content: bytes) -> "_Header":
        """Take a header apart."""
        if not content.startswith(b"LASF"):
            raise DataError(path, "byte 0", f"{content[:4]!r}; expected b'LASF', a LAS file")
        if len(content) < _HEADER_LENGTHS[0]:
            raise DataError(path, "header", f"{len(content)} bytes; expected {_HEADER_LENGTHS[0]} or more")
        major, version = content[24:26]
        length, points_start, records, kind, point_length, legacy_count = _LAYOUT.unpack_from(content, 94)
        if major != 1 or version >= len(_HEADER_LENGTHS):
            raise DataError(path, "byte 24", f"version {major}.{version}; expected 1.0 to 1.4")
        if len(content) < _HEADER_LENGTHS[version] or length < _HEADER_LENGTHS[version]:
            problem = f"{min(length, len(content))} bytes; expected {_HEADER_LENGTHS[version]} or more in version"
            raise DataError(path, "header", f"{problem} 1.{version}")
        numbers = struct.unpack_from("<12d", content, 131)
        waveforms, extended_start, extended, count = 0, 0, 0, legacy_count
        if version >= 3 and content[6] & 2:
            (waveforms,) = struct.unpack_from("<Q", content, 227)
        if version >= 4:
            extended_start, extended, count = struct.unpack_from("<QIQ", content, 235)
        compressed = kind & 0xC0 == 0x80
        return cls(
            path, version, length, points_start, records, compressed,
            kind & 0x3F if compressed else kind, point_length, count, legacy_count,
            numbers[:3], numbers[3:6], numbers[6:], waveforms, extended_start, extended,
        )  # fmt: skip

    def points_end(self, size: int) -> int:
        """Where the points end at the latest: at what stands behind them, or at the end of the file."""
        return min([size, *filter(None, (self.waveforms_start, self.extended_start * bool(self.extended)))])

    def check(self, size: int) -> None:
        """Compare what is declared with the length of the file."""
        path, start, content = self.path, self.points_start, self.count * self.point_length
        if self.point_format >= len(_POINT_LENGTHS):
            raise DataError(path, "byte 104", f"point format {self.point_format}; expected 0 to 10")
        if self.point_length < _POINT_LENGTHS[self.point_format]:
            problem = f"points of {self.point_length} bytes; expected {_POINT_LENGTHS[self.point_format]} or more"
            raise DataError(path, "byte 105", f"{problem} in point format {self.point_format}")
        if not self.length <= start <= size:
            problem = f"points begin at byte {start}; expected {self.length} to {size}, in the file"
            raise DataError(path, "byte 96", problem)
        if self.records * _RECORD_HEAD > start - self.length:
            problem = f"{self.records} records of variable length in the {start - self.length} bytes"
            raise DataError(path, "byte 100", f"{problem} between header and points")
        too_many = self.extended * _EXTENDED_HEAD > size - self.extended_start
        if self.extended and (self.extended_start < start or too_many):
            problem = f"{self.extended} extended records from byte {self.extended_start} on"
            raise DataError(path, "byte 243", f"{problem}; the file has {size} bytes")
        _check_count(path, "header", self.count)
        if self.version >= 4 and self.legacy_count not in {0, self.count}:
            problem = f"{self.count} points, and {self.legacy_count} by the count of older versions"
            raise DataError(path, "byte 247", f"{problem}; expected the same, or 0")
        for name, values, least, most in (
            ("scale", self.scales, _SMALLEST_SCALE, _LARGEST_SCALE),
            ("offset", self.offsets, 0.0, _FARTHEST_M),
        ):
            for axis, value in zip("xyz", values, strict=True):
                if not least <= abs(value) <= most:
                    problem = f"{name} of {axis} is {value}; expected a number from {least:g} to {most:g}"
                    raise DataError(path, "header", problem)
        if self.compressed:
            check_unpacked(path, "points", size - start, content)
        elif content > self.points_end(size) - start:
            problem = f"{self.count} points of {self.point_length} bytes; expected {content} bytes"
            found = f"found {self.points_end(size) - start}: is the file cut off?"
            raise DataError(path, f"byte {start}", f"{problem}, {found}")


def _check_records(path: Path, stream: BinaryIO, header: _Header, size: int) -> None:
    """Walk over the records before and behind the points, and check what stands behind the last point."""
    location = header.length
    for number in range(header.records):
        location += _RECORD_HEAD + _number(stream, location + 20, "<H")
        if location > header.points_start:
            problem = f"ends at byte {location}; expected {header.points_start} at most, where the points begin"
            raise DataError(path, f"record {number}", problem)
    location = header.extended_start
    for number in range(header.extended):
        location += _EXTENDED_HEAD + _number(stream, location + 20, "<Q") if location + 28 <= size else size
        if location > size:
            raise DataError(path, f"extended record {number}", f"ends at byte {location}; the file has {size}")
    if not header.compressed:
        stop = header.points_start + header.count * header.point_length
        stream.seek(stop)
        left = stream.read(max(header.points_end(size) - stop, 0))
        _check_end(path, left, stop, f"{header.count} points of {header.point_length} bytes")


def _check_positions(path: Path, columns: dict[str, AnyArray], count: int) -> None:
    for axis in "xyz":
        if len(columns[axis]) != count:
            raise DataError(path, axis, f"{len(columns[axis])} points were read; the header declares {count}")
        far = np.flatnonzero(~(np.abs(columns[axis]) <= _FARTHEST_M))
        if len(far):
            problem = f"{columns[axis][far[0]]:g} m; expected at most {_FARTHEST_M:g}: is its scale or offset wrong?"
            raise DataError(path, f"point {int(far[0])}, {axis}", problem)


def _bounds(columns: dict[str, AnyArray], header: _Header) -> dict[str, Any]:
    """In which axes the points reach elsewhere than the bounds of the header state, and how far from these."""
    if not header.count:
        return {}
    reported = []
    for k, axis in enumerate("xyz"):
        found = float(columns[axis].max()), float(columns[axis].min())
        apart = max(abs(there - declared) for there, declared in zip(found, header.bounds[2 * k :], strict=False))
        if not apart <= 2 * abs(header.scales[k]) + 1e-9 * abs(header.offsets[k]):
            reported.append(f"{axis} by {apart:g} m")
    return {"other_bounds": ", ".join(reported)} if reported else {}


def _check_chunks(path: Path, stream: BinaryIO, header: Any) -> None:
    """Refuse a table of chunks that declares more than a file holds: what unpacks LAZ ends the process over it."""
    # Source: "LASzip: lossless compression of LiDAR data", Isenburg 2013: point data begin with the table's position,
    # -1 where that stands in the last bytes of the file; the table with its version and the number of chunks, which
    # begin with an uncompressed point. Chunks have as many points each, but for the last, or state how many they have.
    import lazrs

    size, before = path.stat().st_size, stream.tell()
    location = _number(stream, int(header.offset_to_point_data), "<q")
    if location == -1:
        location = _number(stream, size - 8, "<q")
    if not int(header.offset_to_point_data) <= location <= size - 8:
        problem = f"the table of chunks is at byte {location}; the file has {size}: is it cut off?"
        raise DataError(path, "points", problem)
    count = _number(stream, location + 4, "<I")
    most = size // int(header.point_format.size) + 1
    if count > most:
        raise DataError(path, f"byte {location + 4}", f"{count} chunks; expected {most} or fewer in {size} bytes")
    stream.seek(int(header.offset_to_point_data))
    record = header.vlrs.get("LasZipVlr")[0].record_data
    vlr = lazrs.LazVlr(record)
    chunks = lazrs.read_chunk_table(stream, vlr)
    reported = sum(length for _, length in chunks)
    if reported > size:
        raise DataError(path, f"byte {location}", f"chunks of {reported} bytes in all; the file has {size}")
    points, most_points = int(header.point_count), sum(number for number, _ in chunks)
    least_points = most_points if vlr.uses_variable_size_chunks() else most_points - vlr.chunk_size() + 1
    if not (least_points if chunks else 0) <= points <= most_points:
        problem = f"{points} points; its {len(chunks)} chunks hold {least_points} to {most_points}"
        raise DataError(path, "header", problem)
    # from point format 6 on, a chunk lists the lengths of its layers behind its first point and the number of points
    items = struct.iter_unpack("<HHH", record[34 : 34 + 6 * int.from_bytes(record[32:34], "little")])
    layers = sum(size if kind == _BYTES_14 else _LAYERS.get(kind, 0) for kind, size, _ in items)
    start = int(header.offset_to_point_data) + 8
    for held, length in chunks if layers else ():
        stream.seek(start + int(header.point_format.size) + 4)
        if held and sum(memoryview(stream.read(4 * layers).ljust(4 * layers, b"\0")).cast("I")) > length:
            raise DataError(path, f"byte {start}", f"layers of more bytes than their chunk, which has {length}")
        start += length
    stream.seek(before)


_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # of POINT14, RGB14, RGBNIR14 and WAVEPACKET14
_BYTES_14 = 14  # each of its bytes has a layer


def _number(stream: BinaryIO, location: int, form: str) -> int:
    stream.seek(location)
    found = stream.read(struct.calcsize(form))
    if len(found) < struct.calcsize(form):
        raise DataError(getattr(stream, "name", ""), f"byte {location}", "is beyond the end of the file")
    return int(struct.unpack(form, found)[0])


def _head(header: Any) -> dict[str, Any]:
    """What the head says besides how the points are stored."""
    head: dict[str, Any] = {"version": str(header.version), "point_format": int(header.point_format.id)}
    for name in ("system_identifier", "generating_software"):
        text = str(getattr(header, name) or "").strip("\0 ")
        head.update({name: text} if text else {})
    if header.creation_date is not None:
        head["creation_date"] = header.creation_date.isoformat()
    texts = [str(one.string) for one in header.vlrs if hasattr(one, "string")]
    head.update({"coordinate_system": texts[0]} if texts else {})
    records = [
        {"user_id": str(one.user_id), "record_id": int(one.record_id), "description": str(one.description)}
        for one in header.vlrs
        if one.record_id not in _KNOWN_RECORDS and one.user_id != "copc" and not hasattr(one, "string")
    ]
    head.update({"records_left_out": records} if records else {})
    return head


def _las_columns(points: Any) -> dict[str, AnyArray]:
    """Every dimension by its name, positions in metres; bits of one byte are columns of their own."""
    columns = {name: np.asarray(getattr(points, name), np.float64) for name in "xyz"}
    for name in points.point_format.dimension_names:
        if name not in {"X", "Y", "Z"}:
            columns["time" if name == "gps_time" else name] = np.ascontiguousarray(np.asarray(points[name]))
    return columns


_READERS: Mapping[str, Callable[[Path, FieldLayout | None], Cloud]] = MappingProxyType(
    {
        ".pcd": lambda path, _: _read_pcd(path),
        ".ply": lambda path, _: _read_ply(path),
        ".las": lambda path, _: _read_las(path),
        ".laz": lambda path, _: _read_las(path),
        ".bin": lambda path, layout: read_bin(path, layout=layout),
        ".npz": lambda path, layout: _read_npz(path, layout=layout),
        ".npy": lambda path, layout: _read_npz(path, layout=layout),
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


def _read_pcd(path: Path) -> Cloud:
    """Read a PCD file; points that are not finite stay in it, `VIEWPOINT` is not applied.

    Raises:
        DataError: the head is wrong, or the points are not as many bytes or lines as it says.
    """
    file = _PcdFile(path, read_bytes(path))
    if file.count == 0 or file.dtype.itemsize == 0:
        # a compressed file of no points still says that it is 0 bytes
        _check_end(path, file.content[file.start :], file.start, f"{file.count} points")
        return Cloud(path, file.count, _columns_of(np.zeros(file.count, file.dtype)), file.further)
    return Cloud(path, file.count, _PCD_READERS[file.data](file), file.further)


class _PcdFile:
    """A PCD file in memory, its head, of `lines`, parsed: `dtype` is one point, packed, little-endian."""

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
        self.count, self.further = self._count(), self._further()  # viewpoint and width of rows, as in the head

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
        _check_count(self.path, "POINTS", count)
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
        return _columns_of(parse_rows(self.path, [line for _, line in lines], self.dtype, lines[0][0]))

    def read_binary(self) -> dict[str, AnyArray]:
        """Read packed points."""
        points = f"{self.count} points of {self.dtype.itemsize} bytes"
        expected, found = self.count * self.dtype.itemsize, len(self.content) - self.start
        if found < expected:
            problem = f"{found} bytes of points; expected {expected}: {points}; the file breaks off"
            raise DataError(self.path, f"byte {self.start}", problem)
        stop = self.start + expected
        _check_end(self.path, self.content[stop:], stop, points)
        return _columns_of(np.frombuffer(self.content, self.dtype, self.count, self.start))

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
        _check_end(path, content[body + packed_size :], body + packed_size, f"{self.count} points")
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
    """Read the vertices of a PLY file; lists and other elements are passed over."""
    file = _PlyFile(path, read_bytes(path))
    rows = file.binary_rows() if file.order else file.text_rows()
    others = {one.name: one.count for one in file.elements if one.name != "vertex" and one.count}
    head: dict[str, Any] = {"comments": file.comments, "elements_left_out": others}
    return Cloud(path, len(rows), _columns_of(rows), MappingProxyType({k: v for k, v in head.items() if v}))


class _PlyFile:
    """A PLY file in memory, its head parsed: byte order ("" for text), where rows begin [byte], lines of the head."""

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
            _check_count(path, f"element {element.name}", element.count)
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
            _check_end(self.path, self.content[stop:], stop, reported)
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
        ".las": _LasWriter,
        ".laz": _LasWriter,
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

    A name in `.copc.laz` has the points in an octree: they are written plainly beside it first.

    Raises:
        OptionError: the suffix is none of `WRITTEN_SUFFIXES`.
        OutputError: the file exists, or cannot be written.
    """
    check_cloud_suffix(path)
    in_octree = path.name.lower().endswith(".copc.laz")
    with replacing(path, overwrite=overwrite) as draft:
        plain = draft.with_suffix(".las") if in_octree else draft
        writer = _WRITERS[plain.suffix.lower()](plain)
        try:
            yield writer
        except BaseException:
            with suppress(Exception):  # the draft goes with its folder; what went wrong first is reported
                writer.close()
            raise
        writer.close()
        if in_octree:
            write_copc(plain, draft)
            plain.unlink()


def _pack_records(columns: Mapping[str, AnyArray], count: int) -> AnyArray:
    """Lay columns side by side, packed, little-endian."""
    kinds = [(name, f"<{values.dtype.str[1:]}", values.shape[1:]) for name, values in columns.items()]
    records = np.empty(count, kinds)
    for name, values in columns.items():
        records[name] = values
    return records


_COUNT_DIGITS = 12  # room for the number of points, which is known at the end


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
    """PCD files of clouds; a comment in the head names the origin, whole metres, if the first points are far away."""

    def __init__(self) -> None:
        """Begin without an origin."""
        self.origin_world: Float64Array | None = None  # (3,) [m]

    def columns(self, points: WrittenPoints) -> dict[str, AnyArray]:
        """Positions and intensities as float32, packed colours, labels as uint32."""
        if self.origin_world is None:
            finite = points.positions_world[np.isfinite(points.positions_world).all(axis=1)]
            far = len(finite) and np.abs(finite).max() > _FARTHEST_EXACT
            self.origin_world = np.rint(finite.mean(axis=0)) if far else np.zeros(3)
        measured = _measured_columns(points)
        for name, kind in (("intensity", np.float32), ("label", np.uint32)):
            if name in measured:
                measured[name] = measured[name].astype(kind)
        positions = (points.positions_world - self.origin_world).astype(np.float32)
        return {**_axis_columns(positions), **_packed_colors(points.colors), **measured}

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
        return {**_axis_columns(points.positions_world), **_color_columns(points.colors), **_measured_columns(points)}

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
        {**_axis_columns(columns.positions), **_packed_colors(columns.colors), **further}, len(columns.positions)
    )
    with path.open("xb") as file:
        file.write(_pcd_head(records.dtype, str(len(records)), encoding))
        file.write(_pcd_body(records, encoding))


def _write_ply(path: Path, columns: FrameColumns, location: str, losses: Losses) -> None:
    """Write a binary PLY file."""
    further = _fitted(_single_columns(columns.named), _WHOLE, location, losses)
    records = _pack_records(
        {**_axis_columns(columns.positions), **_color_columns(columns.colors), **further}, len(columns.positions)
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
    distance = np.abs(positions - _las_offsets(positions)).max(initial=0.0)
    step = next((step for step in _STEPS_M if distance / step < _MOST_STEPS), None)
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
    import laspy

    # names that are short enough, and not those of LAS's own dimensions
    own = laspy.PointFormat(_PLAIN if columns.colors is None else _COLORED).dimension_names
    taken, named = {*own, "x", "y", "z"}, dict[str, AnyArray]()
    for name, values in _single_columns(columns.further).items():
        short = name.encode("ascii", "replace").decode()[:_LONGEST_LAS_NAME]
        if short in taken or short in named:
            short = f"{short[: _LONGEST_LAS_NAME - 8]}_further"[:_LONGEST_LAS_NAME]
        named[short] = values
    further = _fitted(named, _WHOLE | {"i8", "u8"}, location, losses)
    with _LasFile(path, positions, step, further, colored=columns.colors is not None) as file:
        dimensions = {**further, **_colors_16(columns.colors), **dimensions}
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
    found = _axis_columns(columns.positions)
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
        "ply": _write_ply,
        "las": _write_las,
        "laz": _write_las,
        "kitti-bin": partial(_write_bin, brightest=1.0, further=()),
        "nuscenes-bin": partial(_write_bin, brightest=255.0, further=("ring",)),
        "npz": _write_npz,
    }
)
"""What writes a frame, by the name of the kind; that of `pcd` takes an encoding."""


def _axis_columns(positions: AnyArray) -> dict[str, AnyArray]:
    """Positions (N, 3) as columns x, y, z."""
    return {axis: positions[:, k] for k, axis in enumerate("xyz")}


def _packed_colors(colors: AnyArray | None) -> dict[str, AnyArray]:
    """Colours as the bytes of a float, as PCL has them: blue, green, red, and one that is 0."""
    if colors is None:
        return {}
    whole = colors.astype(np.uint32)
    return {"rgb": ((whole[:, 0] << 16) | (whole[:, 1] << 8) | whole[:, 2]).view(np.float32)}


def _check_end(path: Path, left: bytes, location: int, reported: str) -> None:
    """Refuse bytes behind the last point that a head declares, but zeros and blanks: it may not have counted them."""
    if left.strip(b"\0\t\r\n "):
        problem = f"{len(left)} bytes behind the last of {reported}; expected none: is the count of the head wrong?"
        raise DataError(path, f"byte {location}", problem)


def _color_columns(colors: AnyArray | None) -> dict[str, AnyArray]:
    """Colours (N, 3) as columns red, green, blue; none where there are no colours."""
    return {} if colors is None else {name: colors[:, k] for k, name in enumerate(("red", "green", "blue"))}


def _measured_columns(points: WrittenPoints) -> dict[str, AnyArray]:
    """What points have besides positions and colours; times [s], which float64 holds to a quarter of a microsecond."""
    times = None if points.timestamps_ns is None else points.timestamps_ns.astype(np.float64) * 1e-9
    found = {"intensity": points.intensities, "time": times, "label": points.labels}
    return {name: values for name, values in found.items() if values is not None} | dict(points.extras)


def _columns_of(records: AnyArray) -> dict[str, AnyArray]:
    """Take a structured array apart into columns of native byte order; fields named `_` are padding."""
    names = records.dtype.names or ()
    return {
        name: np.ascontiguousarray(column, column.dtype.newbyteorder("="))
        for name in names
        if not name.startswith("_") and (column := records[name]).dtype.names is None
    }


def _check_count(path: Path, location: str, count: int) -> None:
    """Refuse a number of points that no sweep has."""
    if not 0 <= count <= MOST_POINTS:
        raise DataError(path, location, f"{count} points; expected 0 to {MOST_POINTS}")
