"""KITTI: lines of 12 numbers, the rows of [R t] one after another; no times.

Source: the development kit of KITTI's odometry benchmark. There, the poses are those of the left camera (x right, y
down, z forward) in the frame of its first image.
"""

from collections.abc import Iterable
from decimal import Decimal
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.loss import Loss
from sceneloom.formats.poses import PoseRows
from sceneloom.formats.recording.written_times import seconds_text
from sceneloom.formats.rig.csv_files import Table, read_table
from sceneloom.formats.rig.times import line_timestamps
from sceneloom.formats.rig.timestamps import FARTHEST_NS
from sceneloom.formats.trajectories.content import Reading, TrajectoryFile, TrajectoryForm
from sceneloom.formats.trajectories.first_lines import first_values
from sceneloom.formats.trajectories.rows import further_losses, numbers_text, ordered, oriented
from sceneloom.formats.trajectories.supported_fields import MATRICES
from sceneloom.geometry.rotations import (
    GREATEST_ERROR,
    matrix_from_quaternion,
    quaternion_from_matrix,
)
from sceneloom.scene.warnings import WarningKind


def times_beside(path: Path) -> Path:
    """Where the times of a file of poses are written: `trajectory.kitti` has its in `trajectory.times.txt`."""
    return path.with_name(f"{path.stem}.times.txt")


def _recognises(text: str) -> bool:
    values = first_values(text, None)
    return values is not None and len(values) == 12


def _read(path: Path, reading: Reading, ledger: Ledger) -> TrajectoryFile:
    table = read_table(path, named=False)
    if len(table.rows[0]) != 12:
        problem = f"{len(table.rows[0])} values; expected 12: three rows of [R t]"
        raise DataError(path, f"line {table.lines[0]}", problem)
    timestamps = _timestamps(path, len(table.rows), reading, ledger)
    matrices = table.numbers(range(12)).reshape(-1, 3, 4)
    quaternions = _quaternions(table, matrices[:, :, :3])
    rows = PoseRows(timestamps, matrices[:, :, 3].copy(), quaternions, table.lines)
    return TrajectoryFile(ordered(path, reading.name or path.stem, rows, ledger)[0], FORM.name)


def _quaternions(table: Table, matrices: Float64Array) -> Float64Array:
    """The rotations nearest to (N, 3, 3) matrices, which are rounded, as (N, 4) quaternions.

    Source: as `nearest_rotation`, all at once.
    """
    # elements beyond 2 would overflow in the products of the test
    small = np.abs(matrices).max(axis=(1, 2)) <= 2
    clipped = np.where(small[:, None, None], matrices, 0.0)
    errors = np.abs(clipped @ clipped.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = np.flatnonzero(~((errors <= GREATEST_ERROR) & (np.linalg.det(clipped) > 0)))
    if len(wrong):
        row = int(wrong[0])
        problem = f"{matrices[row].tolist()}; expected an orthonormal right-handed rotation within {GREATEST_ERROR:g}"
        raise DataError(table.path, f"line {table.lines[row]}", problem)
    # of all rotations U Vᵀ is nearest, and right-handed like the matrix
    u, _, vt = np.linalg.svd(clipped)
    return quaternion_from_matrix(u @ vt)


def _timestamps(path: Path, count: int, reading: Reading, ledger: Ledger) -> Int64Array:
    """The times of the poses: of a file that was named, by a rate, or of a file of times beside the poses."""
    if reading.times is not None and reading.rate_hz is not None:
        raise OptionError("times and a rate; expected one of both")
    if reading.rate_hz is not None:
        return _evenly(count, reading.rate_hz)
    found = reading.times or _found_beside(path)
    if found is None:
        problem = (
            "a file of this form has no times; name a text file with one time per line (`--from-times FILE`, of "
            "`sceneloom eval trajectory` `--est-times`, `--ref-times`), or the poses per second (`--from-rate HZ`, "
            f"`--est-rate`, `--ref-rate`), or put {times_beside(path).name} or times.txt beside it"
        )
        raise DataError(path, "", problem)
    if reading.times is None:
        ledger.note(WarningKind.ASSUMED, "times-beside", str(path), f"its times were taken from {found.name}")
    timestamps = line_timestamps(found, reading.unit)
    if len(timestamps) != count:
        raise DataError(
            found, "", f"{len(timestamps)} times for the {count} poses of {path.name}; expected as many"
        )
    return timestamps


def _found_beside(path: Path) -> Path | None:
    locations = (times_beside(path), path.with_name(f"{path.stem}_times.txt"), path.with_name("times.txt"))
    return next((location for location in locations if location.is_file() and location != path), None)


def _evenly(count: int, rate_hz: float) -> Int64Array:
    """Times of numbered poses, rounded once each, so that no error adds up."""
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        raise OptionError(f"rate {rate_hz:g} Hz; expected poses per second above 0")
    period_ns = Decimal(10**9) / Decimal(repr(float(rate_hz)))
    if period_ns * count > FARTHEST_NS:
        raise OptionError(f"rate {rate_hz:g} Hz; {count} poses would end beyond the year 2261")
    return np.array([int((k * period_ns).to_integral_value()) for k in range(count)], np.int64)


def _write(content: TrajectoryFile, path: Path, target: Path) -> Iterable[Loss]:
    trajectory, quaternions = oriented(content, target, FORM.name)
    matrices = np.concatenate([matrix_from_quaternion(quaternions), trajectory.positions[:, :, None]], axis=2)
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"{numbers_text(matrix, ' ')}\n" for matrix in matrices.reshape(-1, 12).tolist())
    with times_beside(path).open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"{seconds_text(time_ns)}\n" for time_ns in trajectory.timestamps_ns.tolist())
    return further_losses(content)


FORM = TrajectoryForm(
    "kitti",
    (".kitti",),
    "lines of 12 numbers: three rows of [R t]",
    _recognises,
    _read,
    _write,
    times_beside,
    MATRICES,
)
