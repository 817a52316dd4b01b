"""Writing records by the table of fields: nanoseconds become the file's times, arrays become items of the container."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import OptionError
from sceneloom.formats.sfs.container import DTYPES, ITEMS, format_keys
from sceneloom.formats.sfs.fields import RECORDS, Field, Kind
from sceneloom.formats.sfs.records import Location
from sceneloom.formats.sfs.spool import Blob
from sceneloom.formats.sfs.times import FileClock

Items = list[tuple[Location, Blob]]
"""The arrays below what is written first, each with its location there."""


class StationaryTime(int):
    """The time of something that holds at all times [ns]; it is written as one that the file can hold."""


class ArraySink(Protocol):
    """Takes the arrays of records."""

    def add(self, array: AnyArray) -> Blob:
        """Take one, and state where it stands."""
        ...


@dataclass(slots=True)
class RecordWriter:
    """Writes records of a file whose clock is known.

    Attributes:
        clock: rotates nanoseconds into timestamps.
        spool: takes the arrays.
        lowest: the lowest timestamp so far, 0 at most.
        rounded: how many times were not a whole number of the file's unit.
        not_numbers: how many numbers of the header were infinite or no number, which JSON cannot state.
    """

    clock: FileClock
    spool: ArraySink
    lowest: int = 0
    rounded: int = 0
    not_numbers: int = 0
    _location: list[str | int] = field(default_factory=list)

    def write(self, values: Mapping[str, Any], record: str, items: Items) -> dict[str, Any]:
        """Write one record; fields that are None where the table knows them are left out."""
        fields = RECORDS[record]
        written: dict[str, Any] = {}
        for name, value in values.items():
            if type(value) is Blob:
                written[name] = ""
                items.append(((*self._location, name), value))
                continue
            field = fields.get(name)
            if value is None:
                if field is None:
                    written[name] = None
                continue
            self._location.append(name)
            kind = Kind.ANYTHING if field is None else field.kind
            written[name] = _WRITERS[kind](self, value, field or _UNKNOWN, items)
            self._location.pop()
        return written

    def write_part(self, name: str, values: Mapping[str, Any], record: str, items: Items) -> dict[str, Any]:
        """Write one of several records that an object holds by name."""
        self._location.append(name)
        written = self.write(values, record, items)
        self._location.pop()
        return written

    def write_list(self, values: Any, record: str, items: Items) -> list[Any]:
        """Write a list of records, or, as in the projections of keypoints, a list of lists of them."""
        written = []
        for index, value in enumerate(values):
            self._location.append(index)
            is_record = type(value) is dict or isinstance(value, Mapping)
            written.append((self.write if is_record else self.write_list)(value, record, items))
            self._location.pop()
        return written

    def plain(self, value: Any, items: Items) -> Any:
        """Write any value that JSON and the container can hold.

        Raises:
            OptionError: it is something else.
        """
        if value is None or type(value) in _JSON_TYPES:
            return value
        if isinstance(value, Blob | np.ndarray):
            return self._array(value, items)
        if isinstance(value, np.generic):
            return self.plain(value.item(), items)
        for kind, write in _PLAIN_WRITERS.items():
            if isinstance(value, kind):
                return write(self, value, items)
        raise OptionError(f"{self.location}: a {type(value).__name__}; JSON and arrays cannot hold it")

    def _array(self, value: Blob | AnyArray, items: Items) -> str:
        """Leave the position of an array empty, as the container has it, and note its item."""
        if isinstance(value, np.ndarray) and value.dtype.name not in DTYPES:
            raise OptionError(f"{self.location}: an array of {value.dtype}; expected numbers")
        items.append((tuple(self._location), value if isinstance(value, Blob) else self.spool.add(value)))
        return ""

    @property
    def location(self) -> str:
        """Where the writer is, for messages."""
        return format_keys(self._location)

    def plain_object(self, value: Mapping[Any, Any], items: Items) -> dict[Any, Any]:
        """Write an object of anything."""
        return self._plain_parts({str(key): part for key, part in value.items()}, items)

    def plain_list(self, values: list[Any] | tuple[Any, ...], items: Items) -> list[Any]:
        """Write a list of anything; plain numbers and text need no look at each."""
        types = set(map(type, values))
        if types <= _JSON_TYPES or (types <= {int, float} and _all_finite(values)):
            return list(values)
        return list(self._plain_parts(dict(enumerate(values)), items).values())

    def _plain_parts(self, parts: dict[Any, Any], items: Items) -> dict[Any, Any]:
        written = {}
        for key, part in parts.items():
            self._location.append(key)
            written[key] = self.plain(part, items)
            self._location.pop()
        return written

    def plain_number(self, value: float) -> float | None:
        """Write a number that JSON can state; others become null and are counted."""
        if abs(value) < float("inf"):
            return value
        self.not_numbers += 1
        return None


def _all_finite(values: Iterable[float]) -> bool:
    """Whether all numbers are finite; their sum says so at once, unless it is beyond float64 itself."""
    try:
        return math.isfinite(math.fsum(values))
    except OverflowError:
        return all(value - value == 0 for value in values)
    except ValueError:  # infinity less infinity
        return False


_UNKNOWN = Field("", Kind.ANYTHING)
_JSON_TYPES = frozenset({bool, int, str})
_PLAIN_WRITERS: Mapping[Any, Callable[[RecordWriter, Any, Items], Any]] = {
    Mapping: RecordWriter.plain_object,
    list | tuple: RecordWriter.plain_list,
    float: lambda writer, value, _: writer.plain_number(float(value)),
    str: lambda _, value, __: str(value),
    int: lambda _, value, __: int(value),
}


def encode_header(header: dict[str, Any], items: Items) -> bytes:
    """Make the header's bytes; `$items` comes last.

    Raises:
        OptionError: the header nests too deeply, or text in it is no Unicode.
    """
    header[ITEMS] = [
        {"keys": list(keys), "length": b.length, "offset": b.offset, "dtype": b.dtype, "shape": list(b.shape)}
        for keys, b in items
    ]
    try:
        return msgspec.json.encode(header)
    except RecursionError:
        raise OptionError("the scene's fields nest too deeply for JSON") from None
    except UnicodeEncodeError as error:
        raise OptionError(f"the scene holds text that is no Unicode: {error}") from None


def _write_plain(writer: RecordWriter, value: Any, _: Field, items: Items) -> Any:
    return writer.plain(value, items)


def _write_time(writer: RecordWriter, value: Any, _: Field, items: Items) -> Any:
    if type(value) is not int:
        return writer.plain(value, items)
    clock = writer.clock
    writer.rounded += (value - clock.offset_ns) % clock.tick_ns != 0
    timestamp = clock.timestamp(value)
    writer.lowest = min(writer.lowest, timestamp)
    return timestamp


def _write_times(writer: RecordWriter, value: Any, field: Field, items: Items) -> Any:
    if isinstance(value, StationaryTime):
        return [max(writer.clock.timestamp(value), 0)]
    if isinstance(value, np.ndarray) and value.dtype.kind in "iu" and value.ndim == 1:
        timestamps, inexact = writer.clock.timestamp_array(value.astype(np.int64))
        writer.rounded += inexact
        written: list[int] = timestamps.tolist()
        writer.lowest = min(writer.lowest, *written) if written else writer.lowest
        return written
    if isinstance(value, list | tuple) and set(map(type, value)) <= {int}:
        tick_ns, offset_ns = writer.clock.tick_ns, writer.clock.offset_ns
        if not any((time - offset_ns) % tick_ns for time in value):
            writer.lowest = min(writer.lowest, (min(value, default=offset_ns) - offset_ns) // tick_ns)
            return [(time - offset_ns) // tick_ns for time in value]
        return [_write_time(writer, time, field, items) for time in value]
    return writer.plain(value, items)


def _write_duration(writer: RecordWriter, value: Any, _: Field, items: Items) -> Any:
    return writer.plain(writer.clock.duration(value) if type(value) in (int, float) else value, items)


def _write_durations(writer: RecordWriter, value: Any, field: Field, items: Items) -> Any:
    if isinstance(value, list | tuple):
        return [_write_duration(writer, duration, field, items) for duration in value]
    return writer.plain(value, items)


def _write_list(writer: RecordWriter, value: Any, _: Field, items: Items) -> Any:
    """Write rows of numbers as JSON: the description calls none of them binary."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        values = value.tolist()
        return values if np.isfinite(value).all() else writer.plain(values, items)
    return writer.plain(value, items)


def _write_array(writer: RecordWriter, value: Any, field: Field, items: Items) -> Any:
    if not isinstance(value, list | tuple):
        return writer.plain(value, items)
    try:
        return writer.plain(np.asarray(value, field.dtype), items)
    except (ValueError, TypeError, OverflowError):
        return writer.plain(value, items)


def _write_record(writer: RecordWriter, value: Any, field: Field, items: Items) -> Any:
    return (
        writer.write(value, field.record, items) if isinstance(value, Mapping) else writer.plain(value, items)
    )


def _write_records(writer: RecordWriter, value: Any, field: Field, items: Items) -> Any:
    if _are_records(value):
        return writer.write_list(value, field.record, items)
    return _write_record(writer, value, field, items)


def _are_records(value: Any) -> bool:
    """Whether a value is a list of records, or a list of such lists; fields of unknown types may be anything."""
    return isinstance(value, list | tuple) and all(
        type(item) is dict or isinstance(item, Mapping) or _are_records(item) for item in value
    )


def _write_record_map(writer: RecordWriter, value: Any, field: Field, items: Items) -> Any:
    written = {}
    for name, record in value.items():
        written[name] = writer.write_part(name, record, field.record, items)
    return written


_WRITERS: Mapping[Kind, Callable[[RecordWriter, Any, Field, Items], Any]] = {
    **dict.fromkeys(Kind, _write_plain),
    Kind.TIME: _write_time,
    Kind.TIMES: _write_times,
    Kind.DURATION: _write_duration,
    Kind.DURATIONS: _write_durations,
    Kind.LIST: _write_list,
    Kind.ARRAY: _write_array,
    Kind.RECORD: _write_record,
    Kind.RECORDS: _write_records,
    Kind.RECORD_OR_RECORDS: _write_records,
    Kind.RECORD_LISTS: _write_records,
    Kind.RECORD_MAP: _write_record_map,
}
