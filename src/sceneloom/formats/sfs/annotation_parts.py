"""What annotations are made of: attributes, rows that may be null, corners of shapes.

All with the locations of faults.
"""

from collections.abc import Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array, read_only
from sceneloom.errors import ArrayError
from sceneloom.formats.sfs.poses import repaired_path_of, rows_of, times_of
from sceneloom.formats.sfs.records import Faults, FieldError, Location
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.poses import Poses

Record = Mapping[str, Any]

_ATTRIBUTE = frozenset({"name", "sensor_id", "static", "point_index", "timestamps", "values"})


@contextmanager
def noting(faults: Faults, location: Location) -> Iterator[None]:
    """Rotate what a part refuses into a fault at its location."""
    try:
        yield
    except FieldError as error:
        faults.add(location, str(error), code=error.code)
    except ArrayError as error:
        faults.add(location, str(error))


def further(record: Record, *taken: str) -> dict[str, Any]:
    """The fields of a record that are not taken."""
    return {name: value for name, value in record.items() if name not in taken}


def read_attributes(records: Any, faults: Faults) -> tuple[AttributePath, ...]:
    """Make the attributes of their records."""
    attributes = []
    for index, record in enumerate(records or ()):
        with noting(faults, ("attributes", index)):
            attributes.append(_attribute(record))
    return tuple(attributes)


def _attribute(record: Record) -> AttributePath:
    times, values = record.get("timestamps"), attribute_values(record.get("values"))
    return AttributePath(
        record["name"],
        values,
        timestamps_ns=None if times is None else read_only(times_of(times)),
        sensor_id=record.get("sensor_id"),
        static=record.get("static"),
        point_index=record.get("point_index"),
        extras=further(record, *_ATTRIBUTE),
    )


def attribute_values(values: Any) -> tuple[Any, ...]:
    """Take the values of an attribute: lists of texts become tuples, all else stays what it is."""
    listed = values.tolist() if isinstance(values, np.ndarray) else values or ()
    return tuple(
        tuple(value) if isinstance(value, list) and all(isinstance(text, str) for text in value) else value
        for value in listed
    )


def check_counts(times: Sized, values: Sized, *, name: str = "values") -> None:
    """Refuse a path with more or fewer values than timestamps.

    Raises:
        FieldError: there are.
    """
    if len(times) != len(values):
        raise FieldError(f"{len(times)} timestamps and {len(values)} {name}; expected as many of both")


def row_path(
    record: Record, columns: int, faults: Faults, location: Location
) -> tuple[Int64Array, Float64Array] | None:
    """Take the timestamps [ns] and rows of numbers of a path; None where it is at fault."""
    rows = rows_at(record["values"], columns, faults, (*location, "values"))
    if rows is None:
        return None
    times = times_of(record["timestamps"])
    with noting(faults, location):
        check_counts(times, rows)
        return read_only(times), read_only(rows)
    return None


def rows_at(values: Any, columns: int, faults: Faults, location: Location) -> Float64Array | None:
    """Take rows of numbers, (N, columns) float64; each row that is none becomes a fault with its number."""
    try:
        return rows_of(values, columns)
    except FieldError as error:
        before = len(faults)
        for index, row in enumerate(values if isinstance(values, list) else ()):
            note_bad_row(row, columns, faults, (*location, index))
        if len(faults) == before:
            faults.add(location, str(error))
    return None


def note_bad_row(row: Any, columns: int, faults: Faults, location: Location) -> bool:
    """Note a row that is not that many numbers; report whether it is sound."""
    numbers = isinstance(row, list | np.ndarray) and all(
        isinstance(value, int | float | np.number) and not isinstance(value, bool) for value in row
    )
    if numbers and len(row) == columns:
        return True
    found = f"{len(row)} numbers" if numbers else _described(row)
    faults.add(location, f"{found}; expected {columns} numbers")
    return False


def _described(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def nullable_rows(
    record: Record, name: str, columns: int, faults: Faults, location: Location
) -> Float64Array | None:
    """Take the rows of a field in which null stands for none, (N, columns) float64 with rows of NaN for null.

    None where there is no such field, or it is at fault.
    """
    values = record.get(name)
    if values is None:
        return None
    listed: Sequence[Any] = values.tolist() if isinstance(values, np.ndarray) else values
    kept = [index for index, row in enumerate(listed) if row is not None]
    before = len(faults)
    with noting(faults, (*location, name)):
        check_counts(record["timestamps"], listed, name=name)
    try:
        rows = rows_of([listed[index] for index in kept], columns)
    except FieldError as error:
        for index in kept:
            note_bad_row(listed[index], columns, faults, (*location, name, index))
        if len(faults) == before:
            faults.add((*location, name), str(error))
    if len(faults) > before:
        return None
    array = np.full((len(listed), columns), np.nan)
    array[kept] = rows
    return read_only(array)


def confirmations(record: Record, faults: Faults, location: Location) -> tuple[bool | None, ...] | None:
    """Take `confirmed`: true, false or null for each timestamp."""
    values = record.get("confirmed")
    if values is None:
        return None
    listed = values.tolist() if isinstance(values, np.ndarray) else values
    for index, value in enumerate(listed):
        if value is not None and not isinstance(value, bool):
            faults.add((*location, "confirmed", index), f"{_described(value)}; expected true, false or null")
    with noting(faults, (*location, "confirmed")):
        check_counts(record["timestamps"], listed, name="values")
    return tuple(listed)


def read_poses(values: Record, faults: Faults) -> Poses | None:
    """Make the poses of a correction."""
    record = values.get("poses")
    if record is None:
        return None
    before = len(faults)
    path = repaired_path_of(record, faults)
    if path is None and len(faults) == before:
        faults.add(("poses",), "empty; expected at least one pose")
    return path


def vertices_of(
    rows: Any, dimensions: int, faults: Faults, location: Location, *, are_pairs: bool | None = None
) -> tuple[tuple[Float64Array, ...], bool]:
    """Cut rows of numbers into vertices, (V, D) float64 each.

    Args:
        rows: the numbers of each keyframe.
        dimensions: 2 or 3.
        faults: takes what is wrong.
        location: where the rows are.
        are_pairs: whether rows that should hold triples hold pairs; None: where they fit pairs only.

    Returns:
        vertices: one array per row; nothing where one is at fault.
        flat: whether rows that should hold triples fit pairs only; their z is 0.
    """
    listed: Sequence[Any] = list(rows)
    arrays = [_numbers(row, faults, (*location, index)) for index, row in enumerate(listed)]
    found = [array for array in arrays if array is not None]
    if len(found) != len(listed):
        return (), False
    fits = fits_pairs_only([array.size for array in found])
    flat = dimensions == 3 and (fits if are_pairs is None else are_pairs)
    size = 2 if flat else dimensions
    for index, array in enumerate(found):
        if array.size % size:
            faults.add(
                (*location, index), f"{array.size} numbers; expected a multiple of {size}, {size} per vertex"
            )
    if faults.unmended:
        return (), False
    cut = [array.reshape(-1, size) for array in found]
    return tuple(read_only(with_height(array) if flat else array) for array in cut), flat


def fits_pairs_only(sizes: Sequence[int]) -> bool:
    """Whether rows are pairs and cannot be triples: all of even length, one of them no multiple of three."""
    return all(size % 2 == 0 for size in sizes) and any(size % 3 for size in sizes)


def with_height(pairs: Float64Array) -> Float64Array:
    """Add z = 0 to (V, 2) locations."""
    return np.column_stack([pairs, np.zeros(len(pairs))])


def _numbers(row: Any, faults: Faults, location: Location) -> Float64Array | None:
    array: AnyArray | None = None
    if isinstance(row, list | np.ndarray):
        with noting(faults, location):
            array = _flat_array(row)
    if array is None or array.ndim != 1 or (array.size and array.dtype.kind not in "iuf"):
        faults.add(location, f"{_described(row)}; expected a list of numbers")
        return None
    return array.astype(np.float64)


def _flat_array(row: Any) -> AnyArray:
    try:
        return np.asarray(row)
    except (ValueError, OverflowError):
        raise FieldError(f"{_described(row)}; expected a list of numbers") from None
