"""LAS and LAZ, the files of laser scanning: written piece by piece, and read, by laspy.

Source: "LAS Specification 1.4 - R15", American Society for Photogrammetry and Remote Sensing, 2019.
"""

import struct
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array
from sceneloom.errors import DataError
from sceneloom.formats.clouds.cloud import Cloud, check_count
from sceneloom.formats.clouds.written import NO_LABEL, WrittenPoints, seconds
from sceneloom.formats.files import file_faults, open_file

STEP = 0.001
"""Positions are whole multiples of this [m] from an offset: finer than any lidar measures."""

_POINT_FORMAT = 7
"""Positions, intensity, classification, time and colour. Source: section 2.6, "Point Data Record Format 7"."""
_FULL_SCALE = 257
"""From 8 to 16 bits: 255 becomes 65535. Source: "Red, Green, Blue" and "Intensity", to be normalised to 16 bits."""
_LARGEST_CLASS = 255
_REACH = 2**31 - 1
_PLACES = ("x", "y", "z")
_KNOWN_RECORDS = (4, 22204)
"""Numbers of the records that describe further dimensions and how LAZ is packed. Source: section 2.8, "Extra Bytes"."""


class LasWriter:
    """An open LAS file, or LAZ, by the ending of its name.

    The numbers of labels become classifications, as far as these go, to 255; all stand in the further dimension
    `label`. Times are the seconds of the scene's clock.
    """

    def __init__(self, path: Path) -> None:
        """Begin a file, which must not be there."""
        self._path = path
        self._file: Any = None

    def add(self, points: WrittenPoints) -> None:
        """Write some more points; those that are not finite have no place in such a file and are left out.

        Raises:
            DataError: they lie too far from the first ones for the steps of such a file.
        """
        import laspy

        finite = np.isfinite(points.positions_world).all(axis=1)
        if self._file is None:
            self._begin(points, points.positions_world[finite])
        header = self._file.header
        record = laspy.ScaleAwarePointRecord.zeros(int(finite.sum()), header=header)
        offsets = (points.positions_world[finite] - header.offsets) / STEP
        if len(offsets) and np.abs(offsets).max() >= _REACH:
            raise DataError(
                self._path, "", f"points {np.abs(offsets).max() * STEP / 1000:.0f} km apart; expected 2147"
            )
        for axis, name in enumerate(("X", "Y", "Z")):
            record[name] = np.rint(offsets[:, axis]).astype(np.int32)
        for name, values in _dimensions(points).items():
            record[name] = values[finite]
        self._file.write_points(record)

    def _begin(self, points: WrittenPoints, positions_world: Float64Array) -> None:
        import laspy

        header = laspy.LasHeader(version="1.4", point_format=_POINT_FORMAT)
        header.generating_software = "sceneloom"
        header.scales = np.full(3, STEP)
        header.offsets = np.floor(positions_world.mean(axis=0)) if len(positions_world) else np.zeros(3)
        header.add_extra_dims(
            [
                laspy.ExtraBytesParams(name, values.dtype)
                for name, values in (*_labels(points), *points.extras.items())
            ]
        )
        self._file = laspy.open(str(self._path), mode="w", header=header)

    def close(self) -> None:
        """Complete the file."""
        if self._file is None:
            self.add(WrittenPoints(np.zeros((0, 3))))
        self._file.close()


def _labels(points: WrittenPoints) -> list[tuple[str, AnyArray]]:
    return [] if points.labels is None else [("label", points.labels)]


def _dimensions(points: WrittenPoints) -> dict[str, AnyArray]:
    """What the points have, by the names of dimensions."""
    found: dict[str, AnyArray] = {**dict(_labels(points)), **points.extras}
    if points.colors is not None:
        for k, name in enumerate(("red", "green", "blue")):
            found[name] = points.colors[:, k].astype(np.uint16) * _FULL_SCALE
    if points.intensities is not None:
        found["intensity"] = points.intensities.astype(np.uint16) * _FULL_SCALE
    times = seconds(points)
    if times is not None:
        found["gps_time"] = times
    if points.labels is not None:
        known = (points.labels <= _LARGEST_CLASS) & (points.labels != NO_LABEL)
        found["classification"] = np.where(known, points.labels, 0).astype(np.uint8)
    return found


def read_las(path: Path) -> Cloud:
    """Read all points of a LAS or LAZ file, of any point format; positions in metres, times as `gps_time`.

    Raises:
        DataError: the file is damaged or of another kind.
    """
    import laspy

    with file_faults(path), open_file(path) as stream:
        if not path.stat().st_size:
            raise DataError(path, "", "is empty; expected a LAS file")
        try:
            with laspy.open(stream, closefd=False) as file:
                check_count(path, "header", int(file.header.point_count))
                if file.header.are_points_compressed:
                    _check_chunks(path, stream, file.header)
                points = file.read()
                columns, head = _columns(points), _head(file.header)
        except (DataError, OSError, MemoryError):
            raise
        except Exception as error:
            # laspy and what unpacks LAZ for it raise what they met, of any kind
            told = str(error) or type(error).__name__
            raise DataError(path, "", f"cannot be read: {told}; expected a LAS file") from error
    return Cloud(path, len(columns["x"]), columns, MappingProxyType(head))


def _check_chunks(path: Path, stream: BinaryIO, header: Any) -> None:
    """Refuse a table of chunks that says more than a file can hold: what unpacks LAZ ends the process over it.

    Source: "LASzip: lossless compression of LiDAR data", Isenburg 2013: point data begin with the place of the table,
    -1 where that stands in the last bytes of the file; the table with its version and the number of chunks, each of
    which begins with a point as it is.
    """
    import lazrs

    size, before = path.stat().st_size, stream.tell()
    place = _number(stream, int(header.offset_to_point_data), "<q")
    if place == -1:
        place = _number(stream, size - 8, "<q")
    count = _number(stream, place + 4, "<I")
    most = size // int(header.point_format.size) + 1
    if count > most:
        raise DataError(
            path, f"byte {place + 4}", f"{count} chunks; expected {most} or fewer in {size} bytes"
        )
    stream.seek(int(header.offset_to_point_data))
    chunks = lazrs.read_chunk_table(stream, lazrs.LazVlr(header.vlrs.get("LasZipVlr")[0].record_data))
    told = sum(length for _, length in chunks)
    if told > size:
        raise DataError(path, f"byte {place}", f"chunks of {told} bytes in all; the file has {size}")
    stream.seek(before)


def _number(stream: BinaryIO, place: int, form: str) -> int:
    stream.seek(place)
    found: tuple[int] = struct.unpack(form, stream.read(struct.calcsize(form)))
    return found[0]


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
    columns = {name: np.asarray(getattr(points, name), np.float64) for name in _PLACES}
    for name in points.point_format.dimension_names:
        if name not in {"X", "Y", "Z"}:
            columns["time" if name == "gps_time" else name] = np.ascontiguousarray(np.asarray(points[name]))
    return columns
