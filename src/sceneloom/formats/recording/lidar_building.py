"""The lidars of a recording: their sweeps, mounting and poses brought together."""

from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.recording.calibration import Calibration, LidarCalibration
from sceneloom.formats.recording.column_arrays import by_time
from sceneloom.formats.recording.columns import LidarColumns
from sceneloom.formats.recording.lidar_files import check_size, find_file, read_points
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.pose_source import poses_along
from sceneloom.scene.poses import Poses
from sceneloom.scene.warnings import WarningKind


@dataclass(frozen=True, slots=True, eq=False)
class SweepTable:
    """The sweeps of one lidar in time order.

    Attributes:
        folder: the recording.
        data_path: `data.jsonl`.
        timestamps_ns: (N,) int64 [ns].
        seconds: (N,) float64 [s], as the file has them.
        files: `dataFile` of each.
        lines: (N,) int64, number of each line.
    """

    folder: Path
    data_path: Path
    timestamps_ns: Int64Array
    seconds: Float64Array
    files: list[str]
    lines: Int64Array

    def __len__(self) -> int:
        return len(self.files)

    def file(self, k: int) -> Path:
        """Find the file of sweep `k`.

        Raises:
            DataError: there is none, or a link leads it out of the folder.
        """
        return find_file(self.folder, self.files[k], self.data_path, f"line {self.lines[k]}")

    def frame(self, k: int) -> LidarFrame:
        """Read sweep `k`.

        Raises:
            DataError: its file is missing or wrong.
        """
        extras = {"file_seconds": float(self.seconds[k]), "dataFile": self.files[k]}
        return LidarFrame(int(self.timestamps_ns[k]), read_points(self.file(k)), MappingProxyType(extras))

    def select(self, rows: Int64Array) -> "SweepTable":
        """Keep some of the sweeps."""
        files = [self.files[row] for row in rows]
        return SweepTable(
            self.folder, self.data_path, self.timestamps_ns[rows], self.seconds[rows], files, self.lines[rows]
        )


def build_lidars(
    folder: Path,
    data_path: Path,
    columns: dict[int, LidarColumns],
    calibration: Calibration,
    ego_path: Poses | None,
    ledger: Ledger,
) -> list[LidarSensor]:
    """Build every lidar that a line names; a lenient reading looks for all their files at once.

    Args:
        columns: the lidars' lines by `lidarInd`.
        ego_path: `world_from_ego` of the default trajectory, or None.
    """
    sensors = []
    for index in sorted(columns):
        table = _usable(_table(folder, data_path, columns[index]), ledger)
        name = f"lidar{index}" if len(columns) > 1 else "lidar"
        entry = calibration.lidars.get(index)
        mount = _mount(entry, name, calibration.path, ledger)
        sensors.append(
            LidarSensor(
                id=name,
                frames=LazyFrames(table.timestamps_ns, table.frame),
                poses=poses_along(ego_path, {0: mount}, np.zeros(len(table), np.int64), table.timestamps_ns),
                mount=mount,
                model=columns[index].model,
                extras=MappingProxyType(_extras(index, entry)),
            )
        )
    return sensors


def _table(folder: Path, data_path: Path, columns: LidarColumns) -> SweepTable:
    sweeps = by_time(columns.sweeps)
    files = [columns.files[row] for row in sweeps.order]
    lines = np.asarray(columns.lines, np.int64)[sweeps.order]
    return SweepTable(folder, data_path, sweeps.timestamps_ns, sweeps.seconds, files, lines)


def _usable(table: SweepTable, ledger: Ledger) -> SweepTable:
    """Leave out sweeps whose file is missing or not whole; a strict reading finds out when it reads them."""
    if not ledger.lenient:
        return table
    rows = []
    for k in range(len(table)):
        try:
            check_size(table.file(k))
            rows.append(k)
        except DataError as error:
            ledger.fault("unusable-lidar-files", error)
    return table.select(np.asarray(rows, np.int64))


def _mount(entry: LidarCalibration | None, name: str, path: Path, ledger: Ledger) -> RigidTransform:
    if entry is not None and entry.lidar_from_imu is not None:
        return entry.lidar_from_imu.inverse()
    location = str(path) if entry is None else entry.location
    message = f"no imuToLidar for {name!r}; it is taken to be where the IMU is, with the same axes"
    ledger.note(WarningKind.ASSUMED, "lidar-mount-identity", location, message)
    return RigidTransform.identity()


def _extras(index: int, entry: LidarCalibration | None) -> dict[str, Any]:
    extras: dict[str, Any] = {"lidarInd": index}
    if entry is not None:
        extras["calibration"] = entry.entry
    return extras
