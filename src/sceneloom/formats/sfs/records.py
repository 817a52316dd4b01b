"""Reading records by the table of fields: kinds are checked, times become nanoseconds, unknown fields are kept.

Poses and mountings of records.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import ArrayError, DataError
from sceneloom.formats.base.diagnostics import MALFORMED, PlacedFault
from sceneloom.formats.sfs.clock import INT64_MAX, INT64_MIN, FileClock, TimeRangeError, point_times_dtype
from sceneloom.formats.sfs.container import ITEMS, Container, ItemFault, RawBytes, format_keys
from sceneloom.formats.sfs.schema import COEFFICIENT_COUNTS, RECORDS, Field, Kind
from sceneloom.formats.sfs.spec import BROWN, ReadingOptions
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import Identifier
from sceneloom.warnings import DataWarning, WarningKind

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
    if type(value) is int or type(value) is float:
        return clock.absolute_ns(value)
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


def _of_raw_bytes(value: RawBytes, dtype: np.dtype[Any]) -> AnyArray:
    raw = value.plain()
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


def read_camera_model(
    source: "Source", intrinsics: Mapping[str, Any], note: Mapping[str, Any], location: Location
) -> Camera:
    """Make a camera model of an `intrinsics` record, or of our note where the record stands in for that.

    A record that was changed since it was written counts, not the note. Old files have no camera model as written in
    the note: there the focal lengths and the centre show whether it was.

    Raises:
        FieldError: the distortion is not what its model has.
        CalibrationError: the numbers are those of no camera model.
    """
    distortion = intrinsics.get("distortion") or {}
    model = distortion.get("model") or "pinhole"
    written = _make_camera(intrinsics, model, _coefficients(source, model, distortion.get("params"), location))
    if note.get("camera") is not None:
        exact = camera_of(note["camera"])
        if note.get("written_camera") is not None:
            same = camera_of(note["written_camera"]) == written
        else:
            same = (exact.fx, exact.fy, exact.cx, exact.cy) == (written.fx, written.fy, written.cx, written.cy)
        if same:
            return exact
    if written.model != "brown_conrady" or (source.tangential or source.options.tangential) != BROWN:
        return written
    # the file has p1 and p2 the other way round
    k1, k2, p2, p1, *others = (*written.coefficients, *[0.0] * (4 - len(written.coefficients)))
    return replace(written, coefficients=(k1, k2, p1, p2, *others))


def _coefficients(source: "Source", model: str, params: Any, location: Location) -> tuple[float, ...]:
    coefficients = _numbers_of([] if params is None else params)
    if model == "pinhole":
        if any(coefficients):
            raise FieldError(f"distortion.params: {list(coefficients)} without a model")
        return ()
    expected, where = COEFFICIENT_COUNTS.get(model), (*location, "distortion")
    if expected is None:
        message = f"distortion model {model!r} is none of the format's; it is kept, but cannot be computed with"
        source.warning(WarningKind.SKIPPED, "unknown-distortion", where, message)
    elif len(coefficients) > expected:
        raise FieldError(f"distortion.params: {len(coefficients)} numbers; {model} has {expected}")
    elif len(coefficients) < expected:
        message = f"{len(coefficients)} of the {expected} numbers of {model}; the others are taken as 0"
        source.warning(WarningKind.REPAIRED, "short-distortion", where, message)
    return coefficients


def _numbers_of(values: Any) -> tuple[float, ...]:
    numbers = values.tolist() if isinstance(values, np.ndarray) else values
    if not isinstance(numbers, list) or any(type(number) not in (int, float) for number in numbers):
        raise FieldError(f"{str(numbers)[:60]}; expected a list of numbers")
    try:
        return tuple(float(number) for number in numbers)
    except OverflowError:
        raise FieldError("a number is beyond what a float can hold") from None


def camera_of(record: Mapping[str, Any]) -> Camera:
    """Make the camera model of a `camera` record of ours."""
    return _make_camera(record, record["model"], _numbers_of(record["coefficients"]))


def _make_camera(record: Mapping[str, Any], model: str, coefficients: tuple[float, ...]) -> Camera:
    fx, fy, cx, cy = (float(record[name]) for name in ("fx", "fy", "cx", "cy"))
    return Camera(model, record["width"], record["height"], fx, fy, cx, cy, coefficients)


def extras_of_intrinsics(intrinsics: Mapping[str, Any]) -> dict[str, Any]:
    """Give the unknown fields of an `intrinsics` record and of its `distortion`."""
    unknown = {name: value for name, value in intrinsics.items() if name not in RECORDS["intrinsics"]}
    distortion = intrinsics.get("distortion") or {}
    of_distortion = {name: value for name, value in distortion.items() if name not in RECORDS["distortion"]}
    return {**unknown, **({"distortion": of_distortion} if of_distortion else {})}


def with_extras(record: dict[str, Any], extras: Mapping[str, Any]) -> dict[str, Any]:
    """Add unknown fields that the model carries along to a record, whose own fields win."""
    return {**record, **{name: value for name, value in extras.items() if record.get(name) is None}}


class _Indexed(Protocol):
    """A video of the file, whose list of images is worth taking along."""

    index: Any


class FileParts:
    """The functions of an open file by name.

    Where it was pickled, it opens the file again when the first of them is called, makes the same functions from it,
    and takes the lists of images of the videos along, for which they would have to be read from end to end.
    Closing it closes nothing in other processes; what is pickled after closing stays closed.

    Attributes:
        videos: the videos of the file by the position of their bytes.
    """

    def __init__(self, container: Container, reopen: "Callable[[Path | str], FileParts]") -> None:
        """Hold an open file.

        Args:
            container: the file.
            reopen: opens it again in another process and keeps the same parts; a function that can be pickled.
        """
        self._container: Container | None = container
        self._identity = container.identity
        self._reopen = reopen
        self._functions: dict[str, Callable[..., Any]] = {}
        self._indices: dict[str, Any] = {}
        self._closed = False
        self._again: FileParts | None = None
        self.videos: dict[str, _Indexed] = {}

    def keep(self, name: str, function: Callable[..., Any]) -> "FilePart":
        """Keep a function of the file under a name, and give what stands for it in a scene."""
        self._functions[name] = function
        return FilePart(self, name)

    def function(self, name: str) -> Callable[..., Any]:
        """Find a function by its name; opens the file if this process has not done so.

        Raises:
            DataError: the file cannot be opened again, is another one now, or the scene was closed.
        """
        if self._container is None:
            return self._opened_again(name).function(name)
        return self._functions[name]

    def close(self) -> None:
        """Close the file in this process."""
        self._closed = True
        if self._container is not None:
            self._container.close()
        if self._again is not None:
            self._again.close()

    def __getstate__(self) -> dict[str, Any]:
        known = {location: video.index for location, video in self.videos.items() if video.index is not None}
        return {
            "_identity": self._identity,
            "_reopen": self._reopen,
            "_indices": {**self._indices, **known},
            "_closed": self._closed,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._container, self._again, self._functions, self.videos = None, None, {}, {}

    def _opened_again(self, name: str) -> "FileParts":
        if self._closed:
            raise DataError(self._identity.name, name, "the scene is closed; read its frames before that")
        if self._again is None:
            self._identity.check()
            again = self._reopen(self._identity.path)
            for location, index in self._indices.items():
                again.videos[location].index = index
            self.videos, self._again = again.videos, again
        return self._again


@dataclass(frozen=True, slots=True, eq=False)
class FilePart:
    """A function of a file, that finds the file again wherever it is called."""

    parts: FileParts
    name: str

    def __call__(self, *arguments: Any) -> Any:
        """Call it."""
        return self.parts.function(self.name)(*arguments)


@dataclass(slots=True)
class Source:
    """A file that is being read.

    Attributes:
        container: the open file.
        parts: what the scene keeps of it.
        clock: of the file.
        options: of the caller.
        warnings: collected on the way, and those that the file had kept.
        noticed_now: those of this reading, in their order.
        notes: what our metadata says about sensors, by id.
        faults: collected on the way.
        left_out: the locations of sensors and annotations that are at fault.
        tangential: what p1 and p2 of `brown_conrady` mean as our metadata state, None where they state nothing.
    """

    container: Container
    parts: FileParts
    clock: FileClock
    options: ReadingOptions
    warnings: list[DataWarning] = field(default_factory=list)
    noticed_now: dict[DataWarning, None] = field(default_factory=dict)
    notes: dict[tuple[type, Identifier], Mapping[str, Any]] = field(default_factory=dict)
    faults: list[PlacedFault] = field(default_factory=list)
    left_out: set[Location] = field(default_factory=set)
    _noticed: set[DataWarning] = field(default_factory=set)
    tangential: str | None = None

    @property
    def file(self) -> str:
        """Name of the file."""
        return self.container.file

    def reader(self, *, forgiving: bool = False) -> RecordReader:
        """Give a reader of records."""
        return RecordReader(self.clock, forgiving)

    def note(self, sensor_id: Identifier) -> Mapping[str, Any]:
        """What our metadata says about a sensor."""
        return self.notes.get((type(sensor_id), sensor_id), {})

    def warning(self, kind: WarningKind, code: str, location: Location, message: str, *, count: int = 1) -> None:
        """Note something, unless the file's own warnings state it already."""
        warning = DataWarning(kind=kind, code=code, location=format_keys(location), message=message, count=count)
        self.noticed_now[warning] = None
        if warning not in self._noticed:
            self.remember(warning)

    def remember(self, warning: DataWarning) -> None:
        """Take a warning as it is."""
        self.warnings.append(warning)
        self._noticed.add(warning)

    def collect(self, faults: Faults, location: Location) -> None:
        """Note faults of what no scene can do without; whoever is lenient is refused for them, too."""
        self.faults.extend(self._placed(fault, location, vital=True) for fault in faults)

    def collect_items(self, items: Sequence[ItemFault]) -> None:
        """Note faults of arrays; nothing stands in their locations."""
        for item in items:
            fault = PlacedFault(item.path or f"{ITEMS}[{item.number}]", item.problem, "item", item=item.number)
            self.faults.append(fault)
            if self.options.lenient:
                message = f"left out: {fault.where}: {item.problem}"
                self.warning(WarningKind.SKIPPED, "item-at-fault", item.keys or (ITEMS, item.number), message)

    def found_faults(self) -> tuple[PlacedFault, ...]:
        """All faults, but not that a value is missing whose array is at fault."""
        arrays = {fault.path for fault in self.faults if fault.code == "item"}
        return tuple(f for f in self.faults if f.code == "item" or f.path not in arrays)

    def settle(self, faults: Faults, location: Location) -> bool:
        """Note the faults of a part, and report whether the scene can have it: it is sound.

        Or was brought into order.
        """
        self.faults.extend(self._placed(fault, location, vital=False) for fault in faults)
        if not faults:
            return True
        kept = not faults.unrepaired
        if not kept:
            self.left_out.add(location)
        if self.options.lenient:
            kind = WarningKind.REPAIRED if kept else WarningKind.SKIPPED
            first = self.faults[-len(faults)]
            message = f"{'repaired' if kept else 'left out'}: {first.where}: {first.problem}"
            self.warning(kind, "repaired" if kept else "at-fault", location, message, count=len(faults))
        return kept

    def _placed(self, fault: Fault, location: Location, *, vital: bool) -> PlacedFault:
        path = format_keys((*location, *fault.location))
        number = self.container.item_number(path)
        return PlacedFault(path, fault.problem, fault.code, repaired=fault.repaired, vital=vital, item=number)


OURS = "sceneloom"
"""Our entry of the scene's metadata."""


def root_fault(source: Source, location: Location, problem: str, *, code: str = MALFORMED) -> None:
    """Note what is wrong at the root, without which no scene means anything."""
    faults = Faults()
    faults.add(location, problem, code=code)
    source.collect(faults, ())
