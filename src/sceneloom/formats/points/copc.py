"""Cloud-optimised point clouds (COPC 1.0): a LAS file whose points lie in an octree, which viewers read in parts.

Source: "COPC, Cloud Optimized Point Cloud", version 1.0, copc.io: the records and the hierarchy. How points are spread
over the levels is free: a cube keeps the first point of each of its 128³ cells and hands the others down.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import Any, BinaryIO

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array
from sceneloom.formats.base.files import open_file

_CELLS_BITS = 7  # a cube has 128 cells along each axis
_LEAF = 50_000  # points of a cube that is not split further, at most
_CHUNK = 1_000_000  # points in memory at a time
_SPOOLED = 1 << 22  # bytes of a cube's points that wait in memory, then on disk
_INFO = struct.Struct("<5d2Q2d88x")  # centre, half a side, spacing of the root, where its page is, first and last time
_ENTRY = struct.Struct("<4iQ2i")  # level, x, y, z, first byte, bytes, points
_HEAD = struct.Struct("<H16sHQ32s")  # of the record behind the points
_INFO_RECORD, _PAGE_RECORD = 1, 1000

Key = tuple[int, int, int, int]  # level, x, y, z


def write_copc(source: Path, target: Path) -> None:
    """Write the points of a LAS 1.4 file of point format 6, 7 or 8, with equal steps on all axes, as COPC.

    Memory grows with the number of cubes, not of points; what waits is kept beside the target, twice over at most.
    """
    import laspy

    with open_file(source) as content, laspy.open(content, closefd=False) as file, target.open("x+b") as stream:
        header = file.header.copy()
        octree = _Octree.around(header, stream, target.parent)
        octree.place((0, 0, 0, 0), (chunk.array for chunk in file.chunk_iterator(_CHUNK)), header.point_count)
        octree.close()


@dataclass(slots=True, eq=False)
class _Octree:
    """A COPC file that is being written, cube by cube."""

    header: Any
    stream: BinaryIO
    folder: Path  # for points that wait
    corner: Int64Array  # (3,) of the root cube, in steps from the file's offset
    bits: int  # a side of the root cube is 2 ** bits steps
    packing: Any  # the record that tells how points are packed
    packer: Any
    times: tuple[float, float] = (0.0, 0.0)
    keys: list[tuple[Key, int]] = field(default_factory=list)  # with the number of points, as written

    @classmethod
    def around(cls, header: Any, stream: BinaryIO, folder: Path) -> "_Octree":
        """Begin a file like that of a header."""
        import laspy
        import lazrs

        ends = np.zeros((2, 3), np.int64)
        if header.point_count:
            ends = np.rint((np.stack([header.mins, header.maxs]) - header.offsets) / header.scales).astype(np.int64)
        bits = max(_CELLS_BITS, int((ends[1] - ends[0]).max()).bit_length())
        form = header.point_format
        packing = lazrs.LazVlr.new_for_compression(form.id, form.num_extra_bytes, use_variable_size_chunks=True)
        header.are_points_compressed = True
        header.global_encoding.wkt = True  # as point formats from 6 on ask for
        header.vlrs.insert(0, laspy.VLR("copc", _INFO_RECORD, "COPC info", bytes(_INFO.size)))
        header.vlrs.append(laspy.vlrs.known.LasZipVlr(packing.record_data()))
        header.write_to(stream)
        packer = lazrs.LasZipCompressor(stream, packing)
        return cls(header, stream, folder, ends[0], bits, packing, packer)

    def place(self, key: Key, parts: Iterator[AnyArray], count: int) -> None:
        """Write the points of a cube (records of the file, in parts): those that it keeps, then its eighths."""
        level = key[0]
        shift = self.bits - level - _CELLS_BITS  # from steps to cells
        if count <= _LEAF or shift <= 0:
            self._write(key, [*parts])
            return
        taken = np.zeros(1 << (3 * _CELLS_BITS), bool)
        first = np.zeros(len(taken), np.int32)  # point of the part that is the first in a cell
        kept: list[AnyArray] = []
        eighths = [_Waiting(self.folder) for _ in range(8)]
        for points in parts:
            cells = self._within(points, shift, _CELLS_BITS)
            numbers = np.arange(len(points), dtype=np.int32)
            first[cells[::-1]] = numbers[::-1]
            keeps = (first[cells] == numbers) & ~taken[cells]
            taken[cells] = True
            kept.append(points[keeps])
            rest = points[~keeps]
            octants = self._within(rest, shift + _CELLS_BITS - 1, 1)
            for octant, waiting in enumerate(eighths):
                waiting.add(rest[octants == octant])
        self._write(key, kept)
        del taken, first, kept
        for octant, waiting in enumerate(eighths):
            x, y, z = (2 * key[k + 1] + (octant >> k & 1) for k in range(3))
            self.place((level + 1, x, y, z), waiting.parts(), waiting.count)

    def _within(self, points: AnyArray, shift: int, bits: int) -> Int64Array:
        """Number of the cell of each point, (N,): `bits` of each axis, x lowest."""
        cells = np.zeros(len(points), np.int64)
        for axis, name in enumerate("XYZ"):
            steps = points[name].astype(np.int64) - self.corner[axis]
            cells |= (steps >> shift & (1 << bits) - 1) << bits * axis
        return cells

    def _write(self, key: Key, parts: list[AnyArray]) -> None:
        count = sum(len(points) for points in parts)
        if not count:
            return
        if self.keys:
            self.packer.finish_current_chunk()  # the last one is finished by the end of the points
        points = np.concatenate(parts)
        first, last = float(points["gps_time"].min()), float(points["gps_time"].max())
        self.times = (min(self.times[0], first), max(self.times[1], last)) if self.keys else (first, last)
        self.packer.compress_many(points.view(np.uint8))
        self.keys.append((key, count))

    def close(self) -> None:
        """Write what stands behind the points, and the header again."""
        import lazrs

        header, stream = self.header, self.stream
        self.packer.done()
        page_start = stream.seek(0, 2) + _HEAD.size
        stream.seek(header.offset_to_point_data)
        chunks = lazrs.read_chunk_table(stream, self.packing)[: len(self.keys)]
        first, page = header.offset_to_point_data + 8, b""
        for (key, count), (_, length) in zip(self.keys, chunks, strict=True):
            page += _ENTRY.pack(*key, first, length, count)
            first += length
        stream.seek(0, 2)
        stream.write(_HEAD.pack(0, b"copc", _PAGE_RECORD, len(page), b"COPC hierarchy") + page)
        side = header.scales[0] * 2.0**self.bits
        # half a step off, so that no point lies on a face
        centre: Float64Array = (self.corner - 0.5) * header.scales + header.offsets + side / 2
        spacing = side / 2**_CELLS_BITS
        header.vlrs[0].record_data = _INFO.pack(*centre, side / 2, spacing, page_start, len(page), *self.times)
        header.start_of_first_evlr, header.number_of_evlrs = page_start - _HEAD.size, 1
        stream.seek(0)
        header.write_to(stream, ensure_same_size=True)


class _Waiting:
    """Points of a cube that wait for their turn, in memory while they are few, else on the disk."""

    def __init__(self, folder: Path) -> None:
        self._file = SpooledTemporaryFile(_SPOOLED, dir=str(folder))  # noqa: SIM115
        self._dtype: np.dtype[np.void] | None = None
        self.count = 0

    def add(self, points: AnyArray) -> None:
        """Let some more points wait."""
        self._dtype = points.dtype
        self._file.write(points.tobytes())
        self.count += len(points)

    def parts(self) -> Iterator[AnyArray]:
        """All points, in parts; they wait no longer."""
        self._file.seek(0)
        size = 0 if self._dtype is None else self._dtype.itemsize
        while content := self._file.read(_CHUNK * size):
            yield np.frombuffer(content, self._dtype)
        self._file.close()
