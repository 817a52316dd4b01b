"""Reading the sweeps of a lidar from files of points, each when it is asked for."""

from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array, read_only
from sceneloom.formats.clouds.cloud import Cloud
from sceneloom.formats.clouds.layout import FieldLayout
from sceneloom.formats.clouds.points import PointMapping, ReadPoints, SweepClock, points_of
from sceneloom.formats.clouds.table import read_cloud
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarFrame, LidarPoints


@dataclass(frozen=True, slots=True, eq=False)
class SweepReader:
    """Reads the sweeps of one lidar, each when it is asked for.

    Attributes:
        files: of each sweep.
        names: of the files, seen from their root.
        clocks_ns: (N, 2) int64 [ns]: the file's timestamp and the sweep's start.
        timestamps_ns: (N,) int64 [ns], of the frames.
        zero_ns: what the sensor's own clock is ahead by [ns].
        layout: columns of files that do not state them.
        mapping: what the columns mean.
        rotation: takes points of the files into the frame that they are given in, None where they are in it.
        deskewed: whether the points are placed as at the timestamp, which then is the time of all of them.
    """

    files: tuple[Path, ...]
    names: tuple[str, ...]
    clocks_ns: Int64Array
    timestamps_ns: Int64Array
    zero_ns: int
    layout: FieldLayout | None
    mapping: PointMapping
    rotation: RigidTransform | None = None
    deskewed: bool = False

    def __call__(self, k: int) -> LidarFrame:
        """Read sweep `k`.

        Raises:
            DataError: its file is missing or wrong.
        """
        read = self.read(k)
        points = read.points if self.rotation is None else _rotated(read.points, self.rotation)
        if self.deskewed:
            times_ns = np.full(len(points), self.timestamps_ns[k], np.int64)
            points = replace(points, timestamps_ns=read_only(times_ns))
        extras: dict[str, Any] = {"file": self.names[k]}
        counts = {"dropped_points": read.dropped, "clipped_intensities": read.clipped}
        extras.update({name: count for name, count in counts.items() if count})
        return LidarFrame(int(self.timestamps_ns[k]), points, MappingProxyType(extras))

    def read(self, k: int) -> ReadPoints:
        """Read the points of sweep `k` in the frame of the file."""
        timestamp_ns, start_ns = self.clocks_ns[k].tolist()
        return points_of(self.cloud(k), self.mapping, SweepClock(timestamp_ns, start_ns, self.zero_ns))

    def cloud(self, k: int) -> Cloud:
        """Read the columns of sweep `k`."""
        return read_cloud(self.files[k], layout=self.layout)


def _rotated(points: LidarPoints, rotation: RigidTransform) -> LidarPoints:
    return replace(points, positions=read_only(rotation.apply(points.positions), np.float32))
