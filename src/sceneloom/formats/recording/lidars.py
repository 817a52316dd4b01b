"""The lidars of a recording: binaries of packed 23-byte records, one file a sweep, with extrinsics and poses."""

import mmap
import sys
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.base.files import open_file, why_no_file
from sceneloom.formats.recording.calibration import RecordingContents
from sceneloom.formats.recording.json_faults import FARTHEST_TIME
from sceneloom.formats.recording.lines import LIDAR_MODELS, Columns, by_time
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import poses_along
from sceneloom.warnings import WarningKind

XYZIRT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("ring", "<u2"), ("timestamp", "<f8")]
)
"""One return: position [m], intensity, laser, time [s, the recording's clock]; 23 bytes, packed.

Source: "Model: RoboSense M1 XYZIRT" of the recording format's description.
"""

_CERTAIN = 0x42
"""Times whose highest byte is below this are in order: from 0 to 2^33 s, by the sign and the exponent in it."""


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
        count = _record_count(path)
        records = _mapped(path, count)
    except (OSError, ValueError) as error:
        raise DataError(path, "", f"cannot be read: {error}") from error
    _check_times(records, path)
    return LidarPoints.of_packed(_Records(records))


def _record_count(path: Path) -> int:
    count, remainder = divmod(path.stat().st_size, XYZIRT.itemsize)
    if remainder:
        size = f"{path.stat().st_size} bytes are {count} records of {XYZIRT.itemsize} bytes"
        problem = f"{size} and a remainder of {remainder}; expected whole records"
        raise DataError(path, f"byte {count * XYZIRT.itemsize}", problem)
    return count


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
        from sceneloom.kernels.packed import unpack

        count = len(self.records)
        positions, intensities, rings = (np.empty((count, 3), "f4"), np.empty(count, "u1"), np.empty(count, "u2"))
        seconds, timestamps_ns = np.empty(count, np.float64), np.empty(count, np.int64)
        arrays = positions, intensities, rings, seconds, timestamps_ns
        unpack(read_only(self.records), *arrays)
        for array in arrays:
            array.setflags(write=False)
        return LidarPoints(
            positions=positions,
            intensities=intensities,
            timestamps_ns=timestamps_ns,
            rings=rings,
            extras=MappingProxyType({"file_seconds": seconds}),
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


@dataclass(frozen=True, slots=True, eq=False)
class _SweepTable:
    """The sweeps of one lidar in time order: (N,) times [ns] and [s], `dataFile` and number of each line."""

    folder: Path
    data_path: Path
    timestamps_ns: Int64Array
    seconds: Float64Array
    files: list[str]
    lines: Int64Array

    def __len__(self) -> int:
        return len(self.files)

    def file(self, k: int) -> Path:
        """Find the file of sweep `k`."""
        name, location = self.files[k], f"line {self.lines[k]}"
        try:
            path = (self.folder / name).resolve()
            inside, there = path.is_relative_to(self.folder.resolve()), path.is_file()
        except (OSError, RuntimeError, ValueError) as error:
            problem = f"lidar.dataFile: {name!r} cannot be read: {error}"
            raise DataError(self.data_path, location, problem) from error
        if not inside:
            problem = f"lidar.dataFile: {name!r} leads out of the recording's folder by a link"
        elif not there:
            problem = f"lidar.dataFile: {name!r}: {why_no_file(path)}"
        else:
            return path
        raise DataError(self.data_path, location, problem)

    def frame(self, k: int) -> LidarFrame:
        """Read sweep `k`."""
        extras = {"file_seconds": float(self.seconds[k]), "dataFile": self.files[k]}
        return LidarFrame(int(self.timestamps_ns[k]), read_points(self.file(k)), MappingProxyType(extras))


def build_lidars(contents: RecordingContents) -> list[LidarSensor]:
    """Build every lidar that a line names; a lenient reading looks for all their files at once."""
    sensors = []
    for index, columns in sorted(contents.columns.lidars.items()):
        table = _sweeps(contents, columns)
        name = f"lidar{index}" if len(contents.columns.lidars) > 1 else "lidar"
        entry = contents.calibration.lidars.get(index)
        if entry is not None and entry.lidar_from_imu is not None:
            mount = entry.lidar_from_imu.inverse()
        else:
            location = str(contents.calibration.path) if entry is None else entry.location
            message = f"no imuToLidar for {name!r}; it is taken to be where the IMU is, with the same axes"
            contents.ledger.note(WarningKind.ASSUMED, "lidar-mount-identity", location, message)
            mount = RigidTransform.identity()
        extras = {"lidarInd": index} if entry is None else {"lidarInd": index, "calibration": entry.entry}
        sensors.append(
            LidarSensor(
                id=name,
                frames=LazyFrames(table.timestamps_ns, table.frame),
                poses=poses_along(contents.ego_path, {0: mount}, np.zeros(len(table), np.int64), table.timestamps_ns),
                mount=mount,
                model=LIDAR_MODELS[0],
                extras=MappingProxyType(extras),
            )
        )
    return sensors


def _sweeps(contents: RecordingContents, columns: Columns) -> _SweepTable:
    """Sweeps in time order; a lenient reading leaves out those whose file is missing or not whole."""
    sweeps = by_time(columns)
    files = [columns.texts[row] for row in sweeps.order]
    table = _SweepTable(contents.folder, contents.data_path, sweeps.timestamps_ns, sweeps.seconds, files, sweeps.lines)
    if not contents.ledger.lenient:
        return table
    rows = []
    for k in range(len(table)):
        try:
            _record_count(table.file(k))
            rows.append(k)
        except DataError as error:
            contents.ledger.fault("unusable-lidar-files", error)
    arrays = (table.timestamps_ns[rows], table.seconds[rows], [files[row] for row in rows], table.lines[rows])
    return _SweepTable(contents.folder, contents.data_path, *arrays)
