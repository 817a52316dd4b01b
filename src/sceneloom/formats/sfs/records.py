"""Reading records by the table of fields: kinds are checked, times become nanoseconds, unknown fields are kept.

Poses and extrinsics.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array, read_only
from sceneloom.errors import ArrayError, CalibrationError
from sceneloom.formats.base.diagnostics import MALFORMED
from sceneloom.formats.sfs.clock import (
    INT64_MAX,
    INT64_MIN,
    FileClock,
    TimeRangeError,
    checked_ns,
    point_times_dtype,
    scaled,
)
from sceneloom.formats.sfs.container import RawBytes, Unfetched
from sceneloom.formats.sfs.schema import RECORDS, Field, Kind
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.poses import Poses

Location = tuple[str | int, ...]
"""Where something stands inside the header, as keys."""


class FieldError(ValueError):
    """A value is not what its field holds; `code` as in `Fault`."""

    def __init__(self, problem: str, code: str = MALFORMED) -> None:
        super().__init__(problem)
        self.code = code


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that is wrong in a header.

    Attributes:
        location: where.
        problem: what, with the value and what was expected.
        code: the kind of fault, kebab case.
        repaired: whether it was brought into order on reading, so that nothing has to be left out for it.
    """

    location: Location
    problem: str
    code: str = MALFORMED
    repaired: bool = False


class Faults(list[Fault]):
    """All faults found so far."""

    def add(self, location: Location, problem: str, *, code: str = MALFORMED, repaired: bool = False) -> None:
        """Note one more."""
        self.append(Fault(location, problem, code, repaired))

    def take(self, other: "Faults", location: Location) -> None:
        """Note the faults of a part that stands at `location`."""
        self.extend(replace(fault, location=(*location, *fault.location)) for fault in other)

    @property
    def unmended(self) -> bool:
        """Whether one of them was not brought into order."""
        return any(not fault.repaired for fault in self)


@dataclass(frozen=True, slots=True)
class RecordReader:
    """Reads records of a file whose clock is known.

    Attributes:
        clock: turns timestamps into nanoseconds.
        forgiving: keep what does not fit its field as it is found, without a fault.
    """

    clock: FileClock
    forgiving: bool = False

    def read(self, raw: Any, record: str, faults: Faults) -> dict[str, Any]:
        """Read one record; fields that are at fault are left out of what is returned."""
        if not isinstance(raw, dict):
            faults.add((), f"{_found(raw)}; expected an object")
            return {}
        fields = RECORDS[record]
        values: dict[str, Any] = {}
        for name, value in raw.items():
            field = fields.get(name)
            if field is None or value is None:
                values[name] = value
                continue
            inner = Faults()
            try:
                values[name] = _READERS[field.kind](self, value, field, inner)
            except (FieldError, TimeRangeError) as error:
                if field.ours or self.forgiving:
                    values[name] = value
                else:
                    faults.add((name,), str(error))
            if inner and self.forgiving:
                values[name] = value
            elif inner:
                faults.take(inner, (name,))
        for field in _required(record):
            if raw.get(field.name) is None:
                faults.add((field.name,), f"missing; expected {field.kind.value}")
        return values

    def read_list(self, raw: Any, record: str, faults: Faults) -> list[dict[str, Any]]:
        """Read a list of records."""
        if not isinstance(raw, list):
            raise FieldError(f"{_found(raw)}; expected a list of objects")
        records = []
        for index, item in enumerate(raw):
            inner = Faults()
            records.append(self.read(item, record, inner))
            if inner:
                faults.take(inner, (index,))
        return records


_REQUIRED = {name: tuple(f for f in record.values() if f.required) for name, record in RECORDS.items()}


def _required(record: str) -> tuple[Field, ...]:
    return _REQUIRED[record]


def _found(value: Any) -> str:
    """Describe a value in a message."""
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype.name} {value.shape}"
    if isinstance(value, list | dict):
        return f"a {'list' if isinstance(value, list) else 'JSON object'} of {len(value)}"
    return described(value)


def described(value: Any) -> str:
    """Show a value in a message, cut where it is long."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _wrong(value: Any, field: Field) -> FieldError:
    return FieldError(f"{_found(value)}; expected {field.kind.value}")


def _is_integer(value: Any) -> bool:
    """Whether a value is an integer, and not a truth value."""
    return type(value) is int


def _as_integer(value: Any, field: Field) -> int:
    """Take an integer, or a float that stands for one."""
    if type(value) is int and INT64_MIN <= value <= INT64_MAX:
        return value
    if type(value) is float and value.is_integer() and abs(value) < INT64_MAX:
        return int(value)
    raise _wrong(value, field)


def _read_anything(_: RecordReader, value: Any, field: Field, faults: Faults) -> Any:
    del field, faults
    return value


def _read_identifier(_: RecordReader, value: Any, field: Field, faults: Faults) -> str | int:
    del faults
    if type(value) is str or type(value) is int:
        return value
    raise _wrong(value, field)


def _read_text(_: RecordReader, value: Any, field: Field, faults: Faults) -> str:
    del faults
    if isinstance(value, str):
        return value
    raise _wrong(value, field)


def _read_flag(_: RecordReader, value: Any, field: Field, faults: Faults) -> bool:
    del faults
    if isinstance(value, bool):
        return value
    raise _wrong(value, field)


def _read_integer(_: RecordReader, value: Any, field: Field, faults: Faults) -> int:
    del faults
    return _as_integer(value, field)


def _read_number(_: RecordReader, value: Any, field: Field, faults: Faults) -> int | float:
    del faults
    if type(value) is float or type(value) is int:
        return value
    raise _wrong(value, field)


def _read_time(reader: RecordReader, value: Any, field: Field, faults: Faults) -> int:
    del faults
    if type(value) is int:
        return reader.clock.absolute_ns(value)
    if type(value) is float:
        return checked_ns(scaled(value, reader.clock.tick_ns) + reader.clock.offset_ns)
    raise _wrong(value, field)


def _read_times(reader: RecordReader, value: Any, field: Field, faults: Faults) -> Any:
    if isinstance(value, np.ndarray):
        if value.ndim != 1 or value.dtype.kind not in "iu":
            raise _wrong(value, field)
        return read_only(reader.clock.absolute_array(value))
    if not isinstance(value, list):
        raise _wrong(value, field)
    if set(map(type, value)) <= {int}:
        tick_ns, offset_ns = reader.clock.tick_ns, reader.clock.offset_ns
        times = [timestamp * tick_ns + offset_ns for timestamp in value]
        if times:
            reader.clock.absolute_ns(max(value))
            reader.clock.absolute_ns(min(value))
        return times
    return _each(value, lambda item: _read_time(reader, item, _TIME, faults))


def _read_duration(reader: RecordReader, value: Any, field: Field, faults: Faults) -> int | float:
    del faults
    if type(value) is int or type(value) is float:
        return reader.clock.duration_ns(value)
    raise _wrong(value, field)


def _read_durations(reader: RecordReader, value: Any, field: Field, faults: Faults) -> list[Any]:
    values = value.tolist() if isinstance(value, np.ndarray) else value
    if not isinstance(values, list):
        raise _wrong(value, field)
    return _each(values, lambda item: _read_duration(reader, item, _DURATION, faults))


def _each(values: list[Any], read: Callable[[Any], Any]) -> list[Any]:
    times: list[Any] = []
    for index, item in enumerate(values):
        try:
            times.append(read(item))
        except (FieldError, TimeRangeError) as error:
            raise FieldError(f"[{index}]: {error}") from None
    return times


_TIME, _DURATION = Field("", Kind.TIME), Field("", Kind.DURATION)


def _read_list(_: RecordReader, value: Any, field: Field, faults: Faults) -> Any:
    del faults
    if isinstance(value, list | np.ndarray):
        return value
    raise _wrong(value, field)


def _read_array(_: RecordReader, value: Any, field: Field, faults: Faults) -> AnyArray:
    del faults
    dtype = np.dtype(field.dtype)
    if isinstance(value, RawBytes):
        array = _of_raw_bytes(value, dtype)
    elif isinstance(value, np.ndarray):
        array = value
    elif isinstance(value, list):
        array = _of_list(value, dtype)
    else:
        raise FieldError(f"{_found(value)}; expected an array of {dtype.name} that an item fills")
    if array.dtype.newbyteorder("=") != dtype:
        raise FieldError(f"an array of {array.dtype.name}; expected {dtype.name}")
    return _in_columns(array.astype(dtype, copy=False), field.columns)


def _of_raw_bytes(value: AnyArray, dtype: np.dtype[Any]) -> AnyArray:
    raw = value.view(Unfetched if isinstance(value, Unfetched) else np.ndarray)
    if raw.size % dtype.itemsize:
        raise FieldError(f"{raw.size} bytes are no whole number of {dtype.name}")
    return raw.view(dtype)


def _of_list(value: list[Any], dtype: np.dtype[Any]) -> AnyArray:
    try:
        found = np.array(value)
        if found.size and (found.dtype.kind not in "iuf" or (dtype.kind != "f" and found.dtype.kind == "f")):
            raise FieldError(f"a list that is no array of {dtype.name}")
        array = found.astype(dtype)
    except (ValueError, TypeError, OverflowError):
        raise FieldError(f"a list that is no array of {dtype.name}") from None
    if dtype.kind != "f" and found.size and not np.array_equal(array, found):
        raise FieldError(f"a list with numbers beyond {dtype.name}")
    return read_only(array)


def _in_columns(array: AnyArray, columns: int) -> AnyArray:
    """Bring an array into rows: flat lists of numbers are cut into rows, single columns are made flat."""
    if columns == 0 and array.ndim == 2 and array.shape[1] == 1:
        return array.reshape(-1)
    if columns > 0 and array.ndim == 1 and array.size % columns == 0:
        return array.reshape(-1, columns)
    if array.ndim != (1 if columns == 0 else 2) or (columns > 0 and array.shape[1] != columns):
        expected = "(N,)" if columns == 0 else f"(N, {'K' if columns < 0 else columns})"
        raise FieldError(f"an array of shape {array.shape}; expected {expected}")
    return array


def _read_point_times(reader: RecordReader, value: Any, field: Field, faults: Faults) -> AnyArray:
    """Check the times of points, which become nanoseconds only when their frame is asked for.

    Source of the width where no dtype says it: `timestamps` in "Lidar Sensor" of the description.
    """
    del faults
    if isinstance(value, RawBytes):
        return _of_raw_bytes(value, point_times_dtype(reader.clock))
    array = _of_list(value, np.dtype(np.int64)) if isinstance(value, list) else value
    if not isinstance(array, np.ndarray):
        raise FieldError(f"{_found(value)}; expected an array of uint32 or uint64 that an item fills")
    if array.dtype.kind not in "iu" or array.dtype.itemsize < 4:
        raise FieldError(f"an array of {array.dtype.name}; expected uint32 or uint64")
    del field
    return _in_columns(array, 0)


def _read_record(reader: RecordReader, value: Any, field: Field, faults: Faults) -> dict[str, Any]:
    return reader.read(value, field.record, faults)


def _read_records(reader: RecordReader, value: Any, field: Field, faults: Faults) -> Any:
    return reader.read_list(value, field.record, faults)


def _read_record_or_records(reader: RecordReader, value: Any, field: Field, faults: Faults) -> Any:
    return (reader.read if isinstance(value, dict) else reader.read_list)(value, field.record, faults)


def _read_record_lists(reader: RecordReader, value: Any, field: Field, faults: Faults) -> Any:
    """Read a list of lists; a plain list of records is taken, too."""
    if not isinstance(value, list):
        raise _wrong(value, field)
    lists = []
    for index, item in enumerate(value):
        inner = Faults()
        lists.append((reader.read_list if isinstance(item, list) else reader.read)(item, field.record, inner))
        if inner:
            faults.take(inner, (index,))
    return lists


def _read_record_map(reader: RecordReader, value: Any, field: Field, faults: Faults) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise _wrong(value, field)
    records = {}
    for name, item in value.items():
        inner = Faults()
        records[name] = reader.read(item, field.record, inner)
        if inner:
            faults.take(inner, (name,))
    return records


_READERS: Mapping[Kind, Callable[[RecordReader, Any, Field, Faults], Any]] = {
    Kind.ANYTHING: _read_anything,
    Kind.IDENTIFIER: _read_identifier,
    Kind.TEXT: _read_text,
    Kind.FLAG: _read_flag,
    Kind.INTEGER: _read_integer,
    Kind.NUMBER: _read_number,
    Kind.TIME: _read_time,
    Kind.TIMES: _read_times,
    Kind.DURATION: _read_duration,
    Kind.DURATIONS: _read_durations,
    Kind.LIST: _read_list,
    Kind.ARRAY: _read_array,
    Kind.POINT_TIMES: _read_point_times,
    Kind.RECORD: _read_record,
    Kind.RECORDS: _read_records,
    Kind.RECORD_OR_RECORDS: _read_record_or_records,
    Kind.RECORD_LISTS: _read_record_lists,
    Kind.RECORD_MAP: _read_record_map,
}

_NORM_TOLERANCE = 0.01
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


def _path_of(record: Mapping[str, Any]) -> Poses | None:
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
        return _path_of({"timestamps": timestamps_ns, "values": rows})
    except FieldError as error:
        faults.add(("poses",), str(error), code=error.code)
        return None


def _note_useless_rows(timestamps_ns: Int64Array, rows: Float64Array, faults: Faults) -> None:
    """Note each pose that must be left out: without a direction, or of one time with another pose that differs."""
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(rows[:, 3:], axis=1)
    for k in np.flatnonzero(~((norms > _LEAST_NORM) & np.isfinite(norms))).tolist():
        problem = f"a quaternion of norm {norms[k]:.6g}; expected 1 within {_NORM_TOLERANCE}"
        faults.add(("poses", "values", k), problem)
    order = np.argsort(timestamps_ns, kind="stable")
    twice = np.flatnonzero(np.diff(timestamps_ns[order]) == 0)
    differ = [k for k in twice.tolist() if (rows[order[k]] != rows[order[k + 1]]).any()]
    for k in sorted({int(order[n]) for first in differ for n in (first, first + 1)}):
        problem = f"another pose than the other one at {timestamps_ns[k]} ns; expected one pose for each time"
        faults.add(("poses", "values", k), problem)


def _in_order(timestamps_ns: Int64Array, rows: Float64Array, faults: Faults) -> tuple[Int64Array, Float64Array]:
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
    off = np.abs(norms - 1.0) > _NORM_TOLERANCE
    if not off.any():
        return rows
    for k in np.flatnonzero(off).tolist():
        problem = f"a quaternion of norm {norms[k]:.6g}; expected 1 within {_NORM_TOLERANCE}"
        faults.add(("poses", "values", k), problem, code="quaternion-norm", repaired=True)
    repaired = rows.copy()
    repaired[off, 3:] /= norms[off, None]
    return repaired


def extras_of_poses(record: Mapping[str, Any]) -> dict[str, Any]:
    """Give the unknown fields of a `poses` record."""
    return {name: value for name, value in record.items() if name not in {"timestamps", "values"}}


def with_extras(record: dict[str, Any], extras: Mapping[str, Any]) -> dict[str, Any]:
    """Add unknown fields that the model carries along to a record, whose own fields win."""
    return {**record, **{name: value for name, value in extras.items() if record.get(name) is None}}


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
