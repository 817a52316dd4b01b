"""Sweeps of KITTI's lidar: files of four float32 a point, and when each point was measured in one rotation."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Int64Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.clouds.bin import read_bin
from sceneloom.formats.clouds.layout import KITTI
from sceneloom.formats.clouds.points import IntensityScale, detect_scale
from sceneloom.formats.clouds.text_rows import parse_rows
from sceneloom.formats.files import read_bytes
from sceneloom.formats.ledger import Ledger
from sceneloom.scene.clouds import LidarFrame, LidarPoints
from sceneloom.scene.warnings import WarningKind

REFLECTANCE = IntensityScale(1.0)
"""KITTI's reflectance goes from 0 to 1. Source: the readme of the raw data's development kit."""

POINT_BYTES = KITTI.dtype.itemsize
"""How long a point is in a file of sweeps [bytes]."""


@dataclass(frozen=True, slots=True, eq=False)
class RotationTimes:
    """When the scanner began each rotation, looked ahead and ended it, (N,) int64 [ns] each."""

    starts_ns: Int64Array
    middles_ns: Int64Array
    ends_ns: Int64Array


@dataclass(frozen=True, slots=True, eq=False)
class SweepFiles:
    """Reads sweeps, each when it is asked for; all points stay in their order, so that labels fit.

    Attributes:
        files: of each sweep.
        names: of the files, seen from the folder above theirs.
        timestamps_ns: (N,) int64 [ns].
        scale: of the reflectance.
        rotations: by which points get times; None where the source does not report when sweeps began and ended.
    """

    files: tuple[Path, ...]
    names: tuple[str, ...]
    timestamps_ns: Int64Array
    scale: IntensityScale = REFLECTANCE
    rotations: RotationTimes | None = None

    def __call__(self, k: int) -> LidarFrame:
        """Read sweep `k`.

        Raises:
            DataError: its file is missing or wrong.
        """
        columns = read_columns(self.files[k])
        positions = _positions(self.files[k], columns)
        intensities, clipped = self.scale.apply(columns["intensity"])
        extras: dict[str, Any] = {"file": self.names[k]}
        if clipped:
            extras["clipped_intensities"] = clipped
        times = None
        if self.rotations is not None:
            start_ns, middle_ns, end_ns = (
                int(timestamps[k])
                for timestamps in (
                    self.rotations.starts_ns,
                    self.rotations.middles_ns,
                    self.rotations.ends_ns,
                )
            )
            times = read_only(times_in_rotation(positions, start_ns, middle_ns, end_ns))
            extras |= {"forward_ns": middle_ns, "end_ns": end_ns}
        points = LidarPoints(read_only(positions), read_only(intensities), timestamps_ns=times)
        return LidarFrame(int(self.timestamps_ns[k]), points, MappingProxyType(extras))


def read_columns(path: Path) -> Mapping[str, AnyArray]:
    """The columns x, y, z and intensity of a sweep: packed float32, or text where the name ends in `.txt`.

    Raises:
        DataError: it is missing, cut off, or holds something else.
    """
    if path.suffix.lower() != ".txt":
        return read_bin(path, layout=KITTI).columns
    lines = [line for line in read_bytes(path).decode("utf-8", "replace").splitlines() if line.strip()]
    rows = parse_rows(path, lines, KITTI.dtype, 1)
    return {name: np.ascontiguousarray(rows[name]) for name in KITTI.names}


def _positions(path: Path, columns: Mapping[str, AnyArray]) -> Float32Array:
    positions: Float32Array = np.stack([columns[axis] for axis in "xyz"], axis=1)
    finite = np.isfinite(positions).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        problem = f"{positions[row].tolist()}; expected finite metres: is it a file of packed float32?"
        raise DataError(path, f"point {row}", problem)
    return positions


def times_in_rotation(positions: Float32Array, start_ns: int, middle_ns: int, end_ns: int) -> Int64Array:
    """When points were measured, by the direction in which they lie, (N,) int64 [ns].

    The scanner rotates counter-clockwise seen from above; it begins behind, looks ahead in the middle and ends behind.

    Args:
        positions: (N, 3) float32 [m], lidar frame: x forward, y left.
        start_ns, middle_ns, end_ns: of the rotation [ns].

    Source: the development kit of KITTI's raw data: cameras are triggered when the lasers look forward.
    """
    rotations = np.arctan2(positions[:, 1].astype(np.float64), positions[:, 0].astype(np.float64)) / np.pi
    spans = np.where(rotations < 0, middle_ns - start_ns, end_ns - middle_ns)
    return middle_ns + np.rint(rotations * spans).astype(np.int64)


def scale_of(path: Path, ledger: Ledger) -> IntensityScale:
    """The scale of the reflectance, by a sensor's first sweep: 0 to 1, else that of other programs, with a warning.

    Raises:
        DataError: the sweep is missing or wrong.
    """
    values = read_columns(path)["intensity"]
    found = detect_scale(values) or IntensityScale(255.0)
    if found.maximum != REFLECTANCE.maximum:
        message = f"reflectance beyond 1, where KITTI's ends: taken as 0 to {found.maximum:g}"
        ledger.note(WarningKind.ASSUMED, "reflectance-scale", str(path), message)
    return found
