"""Reading records by the table of fields: kinds are checked, times become nanoseconds, unknown fields are kept.

Poses and mountings of records.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array, read_only
from sceneloom.errors import ArrayError
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
        problem: the value and what was expected.
        code: the kind of fault, kebab case.
        repaired: whether it was repaired on reading, so that nothing has to be left out for it.
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
    def unrepaired(self) -> bool:
        """Whether one of them was not repaired."""
        return any(not fault.repaired for fault in self)


@dataclass(frozen=True, slots=True)
class RecordReader:
    """Reads records of a file whose clock is known.

    Attributes:
        clock: turns timestamps into nanoseconds.
        forgiving: keep what does not fit its field as it is, without a fault.
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
                values[name] = self._value(value, field, inner)
            except (FieldError, TimeRangeError) as error:
                if field.ours or self.forgiving:
                    values[name] = value
                else:
                    faults.add((name,), str(error))
            if inner and self.forgiving:
                values[name] = value
            elif inner:
                faults.take(inner, (name,))
        for field in _REQUIRED[record]:
            if raw.get(field.name) is None:
                faults.add((field.name,), f"missing; expected {field.kind.value}")
        return values

    def _value(self, value: Any, field: Field, faults: Faults) -> Any:
        is_plain = _PLAIN.get(field.kind)
        if is_plain is None:
            return _READERS[field.kind](self, value, field, faults)
        if not is_plain(value):
            raise _wrong(value, field)
        return value

    def records(self, raw: Any, record: str, faults: Faults, *, lists: bool = False) -> list[Any]:
        """Read a list of records; with `lists`, entries may be lists of records themselves."""
        if not isinstance(raw, list):
            raise FieldError(f"{_found(raw)}; expected a list of objects")
        return [self.part(item, record, faults, index, lists=lists) for index, item in enumerate(raw)]

    def part(self, raw: Any, record: str, faults: Faults, key: str | int, *, lists: bool = False) -> Any:
        """Read a record that stands at a key of what is being read."""
        inner = Faults()
        as_list = lists and isinstance(raw, list)
        values = self.records(raw, record, inner) if as_list else self.read(raw, record, inner)
        if inner:
            faults.take(inner, (key,))
        return values


_REQUIRED = {name: tuple(field for field in record.values() if field.required) for name, record in RECORDS.items()}


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


def _integer(value: Any, field: Field) -> int:
    """Take an integer, or a float that stands for one."""
    if type(value) is int and INT64_MIN <= value <= INT64_MAX:
        return value
    if type(value) is float and value.is_integer() and abs(value) < INT64_MAX:
        return int(value)
    raise _wrong(value, field)


def _time(clock: FileClock, value: Any, field: Field) -> int:
    if type(value) is int:
        return clock.absolute_ns(value)
    if type(value) is float:
        return checked_ns(scaled(value, clock.tick_ns) + clock.offset_ns)
    raise _wrong(value, field)


def _times(clock: FileClock, value: Any, field: Field) -> Any:
    if isinstance(value, np.ndarray):
        if value.ndim != 1 or value.dtype.kind not in "iu":
            raise _wrong(value, field)
        return read_only(clock.absolute_array(value))
    if not isinstance(value, list):
        raise _wrong(value, field)
    if set(map(type, value)) <= {int}:
        times = [timestamp * clock.tick_ns + clock.offset_ns for timestamp in value]
        if times:
            clock.absolute_ns(max(value))
            clock.absolute_ns(min(value))
        return times
    return _each(value, lambda item: _time(clock, item, _TIME))


def _duration(clock: FileClock, value: Any, field: Field) -> int | float:
    if type(value) is int or type(value) is float:
        return clock.duration_ns(value)
    raise _wrong(value, field)


def _durations(clock: FileClock, value: Any, field: Field) -> list[Any]:
    values = value.tolist() if isinstance(value, np.ndarray) else value
    if not isinstance(values, list):
        raise _wrong(value, field)
    return _each(values, lambda item: _duration(clock, item, _DURATION))


def _each(values: Iterable[Any], read: Callable[[Any], Any]) -> list[Any]:
    times: list[Any] = []
    for index, item in enumerate(values):
        try:
            times.append(read(item))
        except (FieldError, TimeRangeError) as error:
            raise FieldError(f"[{index}]: {error}") from None
    return times


_TIME, _DURATION = Field("", Kind.TIME), Field("", Kind.DURATION)


def _array(value: Any, field: Field) -> AnyArray:
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


def _point_times(clock: FileClock, value: Any) -> AnyArray:
    """Check times of points, which become nanoseconds when their frame is read. Source of the width: "Lidar Sensor"."""
    if isinstance(value, RawBytes):
        return _of_raw_bytes(value, point_times_dtype(clock))
    array = _of_list(value, np.dtype(np.int64)) if isinstance(value, list) else value
    if not isinstance(array, np.ndarray):
        raise FieldError(f"{_found(value)}; expected an array of uint32 or uint64 that an item fills")
    if array.dtype.kind not in "iu" or array.dtype.itemsize < 4:
        raise FieldError(f"an array of {array.dtype.name}; expected uint32 or uint64")
    return _in_columns(array, 0)


def _record_lists(reader: RecordReader, value: Any, field: Field, faults: Faults) -> Any:
    if not isinstance(value, list):
        raise _wrong(value, field)
    return reader.records(value, field.record, faults, lists=True)


def _record_map(reader: RecordReader, value: Any, field: Field, faults: Faults) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise _wrong(value, field)
    return {name: reader.part(item, field.record, faults, name) for name, item in value.items()}


_PLAIN: Mapping[Kind, Callable[[Any], bool]] = {
    Kind.ANYTHING: lambda _: True,
    Kind.IDENTIFIER: lambda value: type(value) is str or type(value) is int,
    Kind.TEXT: lambda value: isinstance(value, str),
    Kind.FLAG: lambda value: isinstance(value, bool),
    Kind.NUMBER: lambda value: type(value) is float or type(value) is int,
    Kind.LIST: lambda value: isinstance(value, list | np.ndarray),
}
"""The kinds whose values pass as they are, and whether a value is one."""

_READERS: Mapping[Kind, Callable[[RecordReader, Any, Field, Faults], Any]] = {
    Kind.INTEGER: lambda _, value, field, __: _integer(value, field),
    Kind.TIME: lambda reader, value, field, _: _time(reader.clock, value, field),
    Kind.TIMES: lambda reader, value, field, _: _times(reader.clock, value, field),
    Kind.DURATION: lambda reader, value, field, _: _duration(reader.clock, value, field),
    Kind.DURATIONS: lambda reader, value, field, _: _durations(reader.clock, value, field),
    Kind.ARRAY: lambda _, value, field, __: _array(value, field),
    Kind.POINT_TIMES: lambda reader, value, _, __: _point_times(reader.clock, value),
    Kind.RECORD: lambda reader, value, field, faults: reader.read(value, field.record, faults),
    Kind.RECORDS: lambda reader, value, field, faults: reader.records(value, field.record, faults),
    Kind.RECORD_OR_RECORDS: lambda reader, value, field, faults: (
        reader.read if isinstance(value, dict) else reader.records
    )(value, field.record, faults),
    Kind.RECORD_LISTS: _record_lists,
    Kind.RECORD_MAP: _record_map,
}

_NORM_TOLERANCE = 0.01
"""How far from 1 the norm of a quaternion may be. Source: our reading of "Poses", in docs/CONVENTIONS.md."""

_LEAST_NORM = 1e-3  # a quaternion shorter than this has no direction that could be trusted


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


def repaired_poses(record: Mapping[str, Any], faults: Faults) -> Poses | None:
    """Make the Poses of a `poses` record, repaired where that leaves nothing to choose.

    Quaternions of another length than 1 are normalised, poses out of order are sorted, and poses that stand there
    twice are taken once; each is a repaired fault. None where the record is empty, or has other faults: poses with
    numbers that are not finite, without a direction, or that differ at one time, each at its row.
    """
    try:
        timestamps_ns, rows = times_of(record["timestamps"]), rows_of(record["values"], 7)
        if not np.isfinite(rows).all():
            for k in np.flatnonzero(~np.isfinite(rows).all(axis=1)).tolist():
                problem = f"{rows[k].tolist()}; expected finite numbers"
                faults.add(("poses", "values", k), problem, code="not-finite")
            return None
        if len(timestamps_ns) != len(rows):
            problem = f"{len(timestamps_ns)} timestamps and {len(rows)} values; expected as many of both"
            faults.add(("poses",), problem)
        if len(timestamps_ns) != len(rows) or len(rows) == 0:
            return None
        before = len(faults)
        _note_useless_rows(timestamps_ns, rows, faults)
        if len(faults) > before:
            return None
        timestamps_ns, rows = _in_order(timestamps_ns, rows, faults)
        rows = _normalised(rows, faults)
        with np.errstate(over="ignore"):
            return Poses(timestamps_ns, rows[:, :3], rows[:, 3:])
    except FieldError as error:
        faults.add(("poses",), str(error), code=error.code)
    except ArrayError as error:
        faults.add(("poses",), str(error).removeprefix("poses").lstrip(".: "))
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
    for k in backwards.tolist():
        problem = f"{timestamps_ns[k + 1]} ns after {timestamps_ns[k]} ns; expected strictly increasing times"
        faults.add(("poses", "timestamps", k + 1), problem, code="pose-times-increasing", repaired=True)
    times_ns, first = np.unique(timestamps_ns, return_index=True)
    return times_ns, rows[first]


def _normalised(rows: Float64Array, faults: Faults) -> Float64Array:
    """Bring quaternions to length 1 where they are off by more than rounding."""
    norms = np.linalg.norm(rows[:, 3:], axis=1)
    off = np.abs(norms - 1.0) > _NORM_TOLERANCE
    for k in np.flatnonzero(off).tolist():
        problem = f"a quaternion of norm {norms[k]:.6g}; expected 1 within {_NORM_TOLERANCE}"
        faults.add(("poses", "values", k), problem, code="quaternion-norm", repaired=True)
    if not off.any():
        return rows
    repaired = rows.copy()
    repaired[off, 3:] /= norms[off, None]
    return repaired


def extras_of_poses(record: Mapping[str, Any]) -> dict[str, Any]:
    """Give the unknown fields of a `poses` record."""
    return {name: value for name, value in record.items() if name not in {"timestamps", "values"}}


def with_extras(record: dict[str, Any], extras: Mapping[str, Any]) -> dict[str, Any]:
    """Add unknown fields that the model carries along to a record, whose own fields win."""
    return {**record, **{name: value for name, value in extras.items() if record.get(name) is None}}


def mount_rows(mount: RigidTransform) -> list[list[float]]:
    """Write a mounting as the three rows of R and t, digit for digit."""
    rows: list[list[float]] = mount.matrix[:3].tolist()
    return rows
