"""Lidar binaries: files of packed 23-byte records, one file per sweep, read when the sweep is asked for."""

from collections.abc import Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import AnyArray, read_only
from sceneloom.errors import DataError
from sceneloom.formats.recording.columns import FARTHEST_TIME, nanoseconds
from sceneloom.scene import LidarPoints

XYZIRT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("ring", "<u2"), ("timestamp", "<f8")]
)
"""One return: position [m], intensity, laser, time [s, the recording's clock]; 23 bytes, packed.

Source: "Model: RoboSense M1 XYZIRT" of the recording format's description.
"""

_POSITIONS = np.dtype({"names": ["xyz"], "formats": ["V12"], "offsets": [0], "itemsize": XYZIRT.itemsize})

LIDAR_MODELS: Mapping[str, np.dtype[np.void]] = MappingProxyType({"RoboSense M1 XYZIRT": XYZIRT})
"""The record of each lidar model that the format describes."""


def problem_of_name(name: str) -> str | None:
    """Say what is wrong with a `dataFile`: empty, absolute, leading up, or no file name at all; None for nothing."""
    windows = PureWindowsPath(name)
    leads_out = PurePosixPath(name).is_absolute() or windows.drive or windows.root or ".." in windows.parts
    if leads_out or not name.strip() or "\0" in name:
        return f"lidar.dataFile: {name!r}; expected a path inside the recording's folder"
    return None


def find_file(folder: Path, name: str, file: object, place: str) -> Path:
    """Find the file that a `dataFile` names.

    Args:
        folder: the recording.
        name: the `dataFile`, in which `problem_of_name` found nothing wrong.
        file: what messages call the file that names it.
        place: the line that names it, for messages.

    Raises:
        DataError: there is no such file, or a link leads it out of the folder.
    """
    try:
        path = (folder / name).resolve()
        inside, there = path.is_relative_to(folder.resolve()), path.is_file()
    except (OSError, RuntimeError, ValueError) as error:
        raise DataError(file, place, f"lidar.dataFile: {name!r} cannot be read: {error}") from error
    if not inside:
        raise DataError(
            file, place, f"lidar.dataFile: {name!r} leads out of the recording's folder by a link"
        )
    if not there:
        raise DataError(file, place, f"lidar.dataFile: {name!r}: no such file")
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

    Returns:
        The points in the lidar's frame, read-only; `extras["file_seconds"]` holds the times as the file has them,
        float64 [s].

    Raises:
        DataError: the file cannot be read, is no whole number of records, or holds a time that is no time.
    """
    try:
        count = check_size(path)
        # an empty file cannot be mapped
        records = np.memmap(path, XYZIRT, "r", shape=(count,)) if count else np.empty(0, XYZIRT)
    except (OSError, ValueError) as error:
        raise DataError(path, "", f"cannot be read: {error}") from error
    return _points(records, path)


def _points(records: AnyArray, path: Path) -> LidarPoints:
    # 12 bytes at a time: three times as fast as axis by axis
    bytes_12 = np.array(records.view(_POSITIONS)["xyz"])
    positions = bytes_12.view("<f4").reshape(-1, 3).astype(np.float32, copy=False)
    seconds = np.array(records["timestamp"], np.float64)
    _check_times(seconds, path)
    return LidarPoints(
        positions=read_only(positions),
        intensities=read_only(np.array(records["intensity"], np.uint8)),
        timestamps_ns=read_only(nanoseconds(seconds)),
        rings=read_only(np.array(records["ring"], np.uint16)),
        extras=MappingProxyType({"file_seconds": read_only(seconds)}),
    )


def _check_times(seconds: AnyArray, path: Path) -> None:
    if len(seconds) == 0 or max(-float(seconds.min()), float(seconds.max())) <= FARTHEST_TIME:
        return
    wrong = int(np.flatnonzero(~(np.abs(seconds) <= FARTHEST_TIME))[0])
    raise DataError(
        path,
        f"record {wrong} (byte {wrong * XYZIRT.itemsize})",
        f"timestamp {seconds[wrong]}; expected seconds on the recording's clock, within ±{FARTHEST_TIME:g}",
    )
