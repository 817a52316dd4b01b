"""LAS and LAZ, by laspy: read, and written chunk by chunk."""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO, Self

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array
from sceneloom.errors import DataError
from sceneloom.formats.base.files import check_length, check_unpacked, file_faults, open_file
from sceneloom.formats.points.cloud import (
    NO_LABEL,
    Cloud,
    WrittenPoints,
    check_count,
    check_end,
    color_columns,
    measured_columns,
)

_STEP = 0.001
"""Positions are whole multiples of this [m] from an offset: finer than any lidar measures."""

_PLAIN, _COLORED = 6, 7
"""Point formats: positions, intensity, classification and time; and with colours. Source: section 2.6."""

_FULL_SCALE = 257
"""From 8 to 16 bits: 255 becomes 65535. Source: "Red, Green, Blue" and "Intensity", to be normalised to 16 bits."""

_LARGEST_CLASS = 255

MOST_STEPS = 2**31 - 1
"""Steps between a position and the offset at most."""

_FARTHEST_M = 1e10
"""Limit of coordinates [m]; 70 times the distance to the sun."""

_SMALLEST_SCALE, _LARGEST_SCALE = 1e-12, 1e6
"""Steps of positions [m]."""

_LAYOUT = struct.Struct("<HIIBHI")
_RECORD_HEAD, _EXTENDED_HEAD = 54, 60

_HEADER_LENGTHS = (227, 227, 227, 235, 375)
"""Shortest headers of the versions 1.0 to 1.4 [bytes]."""

_LONGEST_HEADER = 375

_POINT_LENGTHS = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
"""Shortest points of the point formats 0 to 10 [bytes]. Source: section 2.6."""

_KNOWN_RECORDS = (4, 22204)
"""Numbers of the records that describe further dimensions and how LAZ is packed. Source: section 2.8, "Extra Bytes"."""


class LasFile:
    """A LAS file that is being written, or LAZ, by the ending of its name."""

    def __init__(
        self, path: Path, positions: Float64Array, step: float, further: Mapping[str, AnyArray], *, colored: bool
    ) -> None:
        """Begin a file.

        Args:
            path: of the file.
            positions: (N, 3) float64 [m], the first points; positions count from their mean.
            step: positions are whole multiples of it [m].
            further: columns that LAS has no dimensions for.
            colored: whether the points have colours.
        """
        import laspy

        header = laspy.LasHeader(version="1.4", point_format=_COLORED if colored else _PLAIN)
        header.generating_software = "sceneloom"
        header.scales, header.offsets = np.full(3, step), las_offsets(positions)
        header.add_extra_dims([laspy.ExtraBytesParams(name, values.dtype) for name, values in further.items()])
        self._path = path
        self._file = laspy.open(str(path), mode="w", header=header)

    def add(self, positions: Float64Array, dimensions: Mapping[str, AnyArray]) -> float:
        """Write some more points; give how far a coordinate was moved at most [m].

        Raises:
            DataError: they lie too far from the first ones for the steps of such a file.
        """
        import laspy

        header = self._file.header
        steps = (positions - header.offsets) / header.scales
        most = float(np.abs(steps).max(initial=0.0))
        if most >= MOST_STEPS:
            problem = f"points {most * header.scales[0] / 1000:.0f} km apart; expected 2147"
            raise DataError(self._path, "", problem)
        record = laspy.ScaleAwarePointRecord.zeros(len(positions), header=header)
        steps = np.rint(steps)
        for axis, name in enumerate(("X", "Y", "Z")):
            record[name] = steps[:, axis].astype(np.int32)
        for name, values in dimensions.items():
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


def las_offsets(positions: Float64Array) -> Float64Array:
    """What positions count from, (3,) float64 [m]: whole metres at the mean of the first points."""
    return np.floor(positions.mean(axis=0)) if len(positions) else np.zeros(3)


def las_dimensions(colors: AnyArray | None) -> frozenset[str]:
    """Names of LAS's own dimensions, which further columns cannot have."""
    import laspy

    known = laspy.PointFormat(_PLAIN if colors is None else _COLORED).dimension_names
    return frozenset({*known, "x", "y", "z"})


def colors_16(colors: AnyArray | None) -> dict[str, AnyArray]:
    """Colours of 16 bits by channel."""
    return {name: values.astype(np.uint16) * _FULL_SCALE for name, values in color_columns(colors).items()}


class LasWriter:
    """An open LAS file of a cloud.

    The numbers of labels become classifications, as far as these go, to 255; all stand in the further dimension
    `label`. Times are the seconds of the scene's clock.
    """

    def __init__(self, path: Path) -> None:
        """Begin a file, which must not be there."""
        self._path = path
        self._file: LasFile | None = None

    def add(self, points: WrittenPoints) -> None:
        """Write some more points; those that are not finite have no position in such a file and are left out.

        Raises:
            DataError: they lie too far from the first ones for the steps of such a file.
        """
        finite = np.isfinite(points.positions_world).all(axis=1)
        positions = points.positions_world[finite]
        measured = measured_columns(points)
        if self._file is None:
            further = {name: values for name, values in measured.items() if name not in {"intensity", "time"}}
            self._file = LasFile(self._path, positions, _STEP, further, colored=True)
        dimensions = {**measured, **colors_16(points.colors)}
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


def read_las(path: Path) -> Cloud:
    """Read all points of a LAS or LAZ file, of any point format; positions in metres, times as `gps_time`.

    What the header declares is held against the bytes of the file before anything is read: where the points begin, how
    many they are and how long each is, and how many records stand before and behind them. Points that reach
    elsewhere than the header's bounds state are read, and the head of the cloud says so.

    Raises:
        DataError: the file is damaged or of another kind, or its header and its content do not agree.
    """
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
                columns, head = _columns(points), _head(file.header)
        except (DataError, OSError, MemoryError):
            raise
        except Exception as error:
            # laspy and what unpacks LAZ for it raise what they met, of any kind
            reported = str(error) or type(error).__name__
            raise DataError(path, "", f"cannot be read: {reported}; expected a LAS file") from error
    _check_positions(path, columns, known.count)
    return Cloud(path, known.count, columns, MappingProxyType({**head, **_bounds(columns, known)}))


@dataclass(frozen=True, slots=True)
class _Header:
    """What a header declares of the file's layout; starts are bytes of the file, lengths are bytes.

    Source: section 2.4, "Public Header Block".

    Attributes:
        version: minor one.
        records: records of variable length before the points.
        compressed: whether the points are LAZ.
        legacy_count: of the points, as versions before 1.4 state it.
        scales, offsets: x, y, z [m].
        bounds: largest and smallest x, y, z, each axis for itself [m].
        waveforms_start: where packets of waveforms begin, 0 for none in this file.
        extended_start, extended: where records of variable length behind the points begin, and how many these are.
    """

    path: Path
    version: int
    length: int
    points_start: int
    records: int
    compressed: bool
    point_format: int
    point_length: int
    count: int
    legacy_count: int
    scales: tuple[float, ...]
    offsets: tuple[float, ...]
    bounds: tuple[float, ...]
    waveforms_start: int = 0
    extended_start: int = 0
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
        check_count(path, "header", self.count)
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
        check_end(path, left, stop, f"{header.count} points of {header.point_length} bytes")


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
    """Refuse a table of chunks that declares more than a file can hold: what unpacks LAZ ends the process over it.

    Source: "LASzip: lossless compression of LiDAR data", Isenburg 2013: point data begin with the position of the
    table, -1 where that stands in the last bytes of the file; the table with its version and the number of chunks, each
    of which begins with an uncompressed point. Chunks have as many points each, but for the last one, or state how many
    they have.
    """
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
    vlr = lazrs.LazVlr(header.vlrs.get("LasZipVlr")[0].record_data)
    chunks = lazrs.read_chunk_table(stream, vlr)
    reported = sum(length for _, length in chunks)
    if reported > size:
        raise DataError(path, f"byte {location}", f"chunks of {reported} bytes in all; the file has {size}")
    points, most_points = int(header.point_count), sum(number for number, _ in chunks)
    least_points = most_points if vlr.uses_variable_size_chunks() else most_points - vlr.chunk_size() + 1
    if not (least_points if chunks else 0) <= points <= most_points:
        problem = f"{points} points; its {len(chunks)} chunks hold {least_points} to {most_points}"
        raise DataError(path, "header", problem)
    stream.seek(before)


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
        if one.record_id not in _KNOWN_RECORDS and not hasattr(one, "string")
    ]
    head.update({"records_left_out": records} if records else {})
    return head


def _columns(points: Any) -> dict[str, AnyArray]:
    """Every dimension by its name, positions in metres; bits of one byte are columns of their own."""
    columns = {name: np.asarray(getattr(points, name), np.float64) for name in "xyz"}
    for name in points.point_format.dimension_names:
        if name not in {"X", "Y", "Z"}:
            columns["time" if name == "gps_time" else name] = np.ascontiguousarray(np.asarray(points[name]))
    return columns
