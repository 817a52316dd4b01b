"""Pose paths of the file, rows of x y z qx qy qz qw, and mountings, three rows of R and t."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import ArrayError, CalibrationError
from sceneloom.formats.sfs.records import Faults, FieldError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.poses import Poses

NORM_TOLERANCE = 0.01
"""How far from 1 the norm of a quaternion may be. Source: our reading of "Poses", in docs/CONVENTIONS.md."""

_LEAST_NORM = 1e-3
"""A quaternion shorter than this reports no direction that could be trusted."""


def rows_of(values: Any, columns: int) -> Float64Array:
    """Take a list or an array of rows of numbers, (N, columns) float64.

    Raises:
        FieldError: the rows are not all of that length, or not all of numbers.
    """
    try:
        found = np.asarray(values)
    except ValueError:
        raise FieldError(f"rows of different lengths; expected {columns} numbers in each") from None
    if found.size == 0 and len(found) == 0:
        return np.zeros((0, columns))
    if found.dtype.kind not in "iuf" or found.ndim != 2 or found.shape[1] != columns:
        what = "something else" if found.dtype.kind not in "iuf" else f"shape {found.shape}"
        raise FieldError(f"{what}; expected rows of {columns} numbers")
    return found.astype(np.float64)


def times_of(timestamps_ns: Any) -> Int64Array:
    """Take times that are already in nanoseconds, (N,) int64."""
    return np.asarray(timestamps_ns, np.int64).reshape(-1)


def path_of(record: Mapping[str, Any]) -> Poses | None:
    """Make the Poses of a `poses` record; None where it is empty.

    Raises:
        FieldError: it is not what a Poses must be.
    """
    timestamps_ns, rows = times_of(record["timestamps"]), rows_of(record["values"], 7)
    if len(timestamps_ns) != len(rows):
        raise FieldError(f"{len(timestamps_ns)} timestamps and {len(rows)} values; expected as many of both")
    if len(rows) == 0:
        return None
    try:
        with np.errstate(over="ignore"):
            return Poses(timestamps_ns, rows[:, :3], rows[:, 3:])
    except ArrayError as error:
        raise FieldError(str(error).removeprefix("poses").lstrip(".: ")) from None


def repaired_path_of(record: Mapping[str, Any], faults: Faults) -> Poses | None:
    """Make the Poses of a `poses` record, brought into order where that leaves nothing to choose.

    Quaternions of another length than 1 are normalised, poses out of order are sorted, and poses that stand there
    twice are taken once; each is a repaired fault. None where the record is empty, or has further faults: poses with
    numbers that are none, without a direction, or that differ at one time, each at its row.
    """
    try:
        timestamps_ns, rows = times_of(record["timestamps"]), rows_of(record["values"], 7)
        if not np.isfinite(rows).all():
            for k in np.flatnonzero(~np.isfinite(rows).all(axis=1)).tolist():
                problem = f"{rows[k].tolist()}; expected finite numbers"
                faults.add(("poses", "values", k), problem, code="not-finite")
            return None
        if len(timestamps_ns) == len(rows) > 0:
            before = len(faults)
            _note_useless_rows(timestamps_ns, rows, faults)
            if len(faults) > before:
                return None
            timestamps_ns, rows = _in_order(timestamps_ns, rows, faults)
            rows = _normalised(rows, faults)
        return path_of({"timestamps": timestamps_ns, "values": rows})
    except FieldError as error:
        faults.add(("poses",), str(error), code=error.code)
        return None


def _note_useless_rows(timestamps_ns: Int64Array, rows: Float64Array, faults: Faults) -> None:
    """Note each pose that must be left out: without a direction, or of one time with another pose that differs."""
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(rows[:, 3:], axis=1)
    for k in np.flatnonzero(~((norms > _LEAST_NORM) & np.isfinite(norms))).tolist():
        problem = f"a quaternion of norm {norms[k]:.6g}; expected 1 within {NORM_TOLERANCE}"
        faults.add(("poses", "values", k), problem)
    order = np.argsort(timestamps_ns, kind="stable")
    twice = np.flatnonzero(np.diff(timestamps_ns[order]) == 0)
    differ = [k for k in twice.tolist() if (rows[order[k]] != rows[order[k + 1]]).any()]
    for k in sorted({int(order[n]) for first in differ for n in (first, first + 1)}):
        problem = f"another pose than the other one at {timestamps_ns[k]} ns; expected one pose for each time"
        faults.add(("poses", "values", k), problem)


def _in_order(
    timestamps_ns: Int64Array, rows: Float64Array, faults: Faults
) -> tuple[Int64Array, Float64Array]:
    """Sort poses by time and drop those that are there twice; no two of one time differ."""
    backwards = np.flatnonzero(timestamps_ns[1:] <= timestamps_ns[:-1])
    if not len(backwards):
        return timestamps_ns, rows
    order = np.argsort(timestamps_ns, kind="stable")
    times_ns, sorted_rows = timestamps_ns[order], rows[order]
    twice = np.diff(times_ns) == 0
    for k in backwards.tolist():
        problem = f"{timestamps_ns[k + 1]} ns after {timestamps_ns[k]} ns; expected strictly increasing times"
        faults.add(("poses", "timestamps", k + 1), problem, code="pose-times-increasing", repaired=True)
    kept = np.concatenate(([True], ~twice))
    return times_ns[kept], sorted_rows[kept]


def _normalised(rows: Float64Array, faults: Faults) -> Float64Array:
    """Bring quaternions to length 1 where they are off by more than rounding."""
    norms = np.linalg.norm(rows[:, 3:], axis=1)
    off = np.abs(norms - 1.0) > NORM_TOLERANCE
    if not off.any():
        return rows
    for k in np.flatnonzero(off).tolist():
        problem = f"a quaternion of norm {norms[k]:.6g}; expected 1 within {NORM_TOLERANCE}"
        faults.add(("poses", "values", k), problem, code="quaternion-norm", repaired=True)
    repaired = rows.copy()
    repaired[off, 3:] /= norms[off, None]
    return repaired


def further_of_poses(values: Mapping[str, Any]) -> dict[str, Any]:
    """Give the unknown fields of a sensor's `poses`, as an entry of its further fields."""
    record = values.get("poses") or {}
    further = {name: value for name, value in record.items() if name not in {"timestamps", "values"}}
    return {"poses": further} if further else {}


def mount_of(rows: Any) -> RigidTransform:
    """Make a mounting of the three rows of R and t.

    Raises:
        FieldError: they are no rigid transform.
    """
    matrix = rows_of(rows, 4)
    if len(matrix) != 3:
        raise FieldError(f"{len(matrix)} rows; expected three of R and t")
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            return RigidTransform(matrix[:, :3], matrix[:, 3])
    except (ArrayError, CalibrationError) as error:
        raise FieldError(str(error)) from None


def mount_rows(mount: RigidTransform) -> list[list[float]]:
    """Write a mounting as the three rows of R and t, digit for digit."""
    rows: list[list[float]] = mount.matrix[:3].tolist()
    return rows
