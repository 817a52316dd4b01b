"""Lidar binaries: files of packed 23-byte records, one file per sweep, read when the sweep is asked for."""

import mmap
import sys
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import AnyArray, read_only
from sceneloom.errors import DataError
from sceneloom.formats.files import open_file, why_no_file
from sceneloom.formats.recording.columns import FARTHEST_TIME
from sceneloom.scene.clouds import LidarPoints

XYZIRT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("ring", "<u2"), ("timestamp", "<f8")]
)
"""One return: position [m], intensity, laser, time [s, the recording's clock]; 23 bytes, packed.

Source: "Model: RoboSense M1 XYZIRT" of the recording format's description.
"""

_CERTAIN = 0x42
"""Times whose highest byte is below this are in order: from 0 to 2^33 s, by the sign and the exponent in it."""


def find_file(folder: Path, name: str, file: object, location: str) -> Path:
    """Find the file that a `dataFile` names.

    Args:
        folder: the recording.
        name: the `dataFile`, in which `problem_of_name` found nothing wrong.
        file: what messages call the file that names it.
        location: the line that names it, for messages.

    Raises:
        DataError: there is no such file, or a link leads it out of the folder.
    """
    try:
        path = (folder / name).resolve()
        inside, there = path.is_relative_to(folder.resolve()), path.is_file()
    except (OSError, RuntimeError, ValueError) as error:
        raise DataError(file, location, f"lidar.dataFile: {name!r} cannot be read: {error}") from error
    if not inside:
        raise DataError(
            file, location, f"lidar.dataFile: {name!r} leads out of the recording's folder by a link"
        )
    if not there:
        raise DataError(file, location, f"lidar.dataFile: {name!r}: {why_no_file(path)}")
    return path


def check_size(path: Path) -> int:
    """Count the records of a file by its size.

    Raises:
        DataError: the size is no multiple of the record's 23 bytes.
    """
    size = path.stat().st_size
    count, remainder = divmod(size, XYZIRT.itemsize)
    if remainder:
        raise DataError(
            path,
            f"byte {count * XYZIRT.itemsize}",
            f"{size} bytes are {count} records of {XYZIRT.itemsize} bytes and a remainder of {remainder}; "
            "expected whole records",
        )
    return count


def read_points(path: Path) -> LidarPoints:
    """Read one sweep; points whose position is not a number stay in it.

    The file is mapped and the time of every record checked; the records are taken apart in one pass when the first
    of their fields is asked for, and the file is let go. Until then it must stay as long as it is.

    Returns:
        The points in the lidar's frame, read-only; `extras["file_seconds"]` holds the times as the file has them,
        float64 [s].

    Raises:
        DataError: the file cannot be read, is no whole number of records, or holds a time that is no time.
    """
    try:
        count = check_size(path)
        records = _mapped(path, count)
    except (OSError, ValueError) as error:
        raise DataError(path, "", f"cannot be read: {error}") from error
    _check_times(records, path)
    return LidarPoints.of_packed(_Records(records))


def _mapped(path: Path, count: int) -> AnyArray:
    # an empty file cannot be mapped
    if count == 0:
        return np.empty(0, XYZIRT)
    size = count * XYZIRT.itemsize
    with open_file(path, buffering=0) as file:
        if sys.platform == "linux":
            # all pages at once: one by one takes twice as long
            flags = mmap.MAP_SHARED | mmap.MAP_POPULATE
            content = mmap.mmap(file.fileno(), size, flags=flags, prot=mmap.PROT_READ)
        else:
            content = mmap.mmap(file.fileno(), size, access=mmap.ACCESS_READ)
    return np.frombuffer(content, XYZIRT)


@dataclass(frozen=True, slots=True, eq=False)
class _Records:
    """The records of a sweep, as a file has them."""

    records: AnyArray

    def __len__(self) -> int:
        return len(self.records)

    def unpacked(self) -> LidarPoints:
        """Take them apart."""
        # the compiler is loaded only where points are used
        from sceneloom.kernels.lidar_records import unpack

        count = len(self.records)
        positions, intensities, rings = (
            np.empty((count, 3), "f4"),
            np.empty(count, "u1"),
            np.empty(count, "u2"),
        )
        seconds, timestamps_ns = np.empty(count, np.float64), np.empty(count, np.int64)
        unpack(read_only(self.records), positions, intensities, rings, seconds, timestamps_ns)
        return LidarPoints(
            positions=read_only(positions),
            intensities=read_only(intensities),
            timestamps_ns=read_only(timestamps_ns),
            rings=read_only(rings),
            extras=MappingProxyType({"file_seconds": read_only(seconds)}),
        )


def _check_times(records: AnyArray, path: Path) -> None:
    highest_bytes = records.view(np.uint8).reshape(-1, XYZIRT.itemsize)[:, -1]
    if len(records) == 0 or highest_bytes.max() < _CERTAIN:
        return
    seconds = np.array(records["timestamp"])
    if max(-float(seconds.min()), float(seconds.max())) <= FARTHEST_TIME:
        return
    wrong = int(np.flatnonzero(~(np.abs(seconds) <= FARTHEST_TIME))[0])
    raise DataError(
        path,
        f"record {wrong} (byte {wrong * XYZIRT.itemsize})",
        f"timestamp {seconds[wrong]}; expected seconds on the recording's clock, within ±{FARTHEST_TIME:g}",
    )
