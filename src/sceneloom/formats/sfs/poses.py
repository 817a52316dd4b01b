"""Pose paths of the file, rows of x y z qx qy qz qw, and mountings, three rows of R and t."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import ArrayError, CalibrationError
from sceneloom.formats.sfs.records import FieldError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import PosePath


def rows_of(values: Any, columns: int) -> Float64Array:
    """Take a list or an array of rows of numbers, (N, columns) float64.

    Raises:
        FieldError: the rows are not all of that length, or not all of numbers.
    """
    try:
        found = np.asarray(values)
    except ValueError:
        raise FieldError(f"rows of different lengths; expected {columns} numbers in each") from None
    if found.size == 0:
        return np.zeros((0, columns))
    if found.dtype.kind not in "iuf" or found.ndim != 2 or found.shape[1] != columns:
        what = "something else" if found.dtype.kind not in "iuf" else f"shape {found.shape}"
        raise FieldError(f"{what}; expected rows of {columns} numbers")
    return found.astype(np.float64)


def times_of(timestamps_ns: Any) -> Int64Array:
    """Take times that are already in nanoseconds, (N,) int64."""
    return np.asarray(timestamps_ns, np.int64).reshape(-1)


def path_of(record: Mapping[str, Any]) -> PosePath | None:
    """Make the PosePath of a `poses` record; None where it is empty.

    Raises:
        FieldError: it is not what a PosePath must be.
    """
    timestamps_ns, rows = times_of(record["timestamps"]), rows_of(record["values"], 7)
    if len(timestamps_ns) != len(rows):
        raise FieldError(f"{len(timestamps_ns)} timestamps and {len(rows)} values; expected as many of both")
    if len(rows) == 0:
        return None
    try:
        with np.errstate(over="ignore"):
            return PosePath(timestamps_ns, rows[:, :3], rows[:, 3:])
    except ArrayError as error:
        raise FieldError(str(error).removeprefix("poses").lstrip(".: ")) from None


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
