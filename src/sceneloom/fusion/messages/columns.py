"""Lists of boxes as columns: one array for each field, or for fields that belong together."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike

from sceneloom.arrays import AnyArray, read_only
from sceneloom.errors import DataError
from sceneloom.fusion.messages.basic_types import INTEGER_RANGES, BasicType, shown
from sceneloom.fusion.messages.rows import Row
from sceneloom.fusion.messages.tables import Table

List = TypeVar("List")
"""A class of lists of boxes or of detections."""


@dataclass(frozen=True, slots=True)
class Column:
    """An array of a list of records.

    Attributes:
        attribute: of the list.
        names: the rows of the table that it holds, one number of a row of the array each, or one that holds them all.
        dtype: of the array.
        shape: of one row of the array.
        optional: it may be None, for all boxes at once.
    """

    attribute: str
    names: tuple[str, ...]
    dtype: DTypeLike = np.float32
    shape: tuple[int, ...] = ()
    optional: bool = False


class ColumnChecks:
    """The checks of the columns of one kind of lists."""

    def __init__(self, table: Table, columns: Sequence[Column], *, group: str) -> None:
        """Look up the rows of the columns.

        Args:
            table: of one record of the list.
            columns: of the list; the first reports how many records there are.
            group: how messages call the list.
        """
        self._table = table
        self._group = group
        self._columns = tuple(
            (column, np.dtype(column.dtype), tuple(map(table.row, column.names))) for column in columns
        )
        # of those whose rows have the same bounds the row that stands for all
        self._bounds = tuple(
            rows[0] if all(row.bounds == rows[0].bounds for row in rows) else None
            for _, _, rows in self._columns
        )

    def settle(self, record: Any) -> int:
        """Check all columns of a list that is being made, and make them read-only.

        Returns:
            How many records there are.

        Raises:
            DataError: a column has another shape or dtype, or a number in it is not finite or out of range.
        """
        count: int | None = None
        for (column, dtype, rows), bounds in zip(self._columns, self._bounds, strict=True):
            values = getattr(record, column.attribute)
            if column.optional and (values is None or count == 0):
                object.__setattr__(record, column.attribute, None)
                continue
            _check_shape(values, column, dtype, self._table, count)
            count = len(values)
            if bounds is None or not bounds.admits(values):
                _check_values(values, column, rows, self._table, self._group)
            object.__setattr__(record, column.attribute, read_only(values))
        return count or 0


def settled(record_type: type[List], columns: Sequence[Column], values: Mapping[str, Any]) -> List:
    """Make a list of fields that are what its checks would make of them; its columns become read-only."""
    record = object.__new__(record_type)
    for name, value in values.items():
        object.__setattr__(record, name, value)
    for column in columns:
        value = values[column.attribute]
        if value is not None:
            value.flags.writeable = False
    return record


def settle_classes(record: Any, table: Table, count: int, *, group: str) -> None:
    """Check the classes of a list that is being made.

    Raises:
        DataError: there are more or fewer than records, or one is no name.
    """
    names = record.class_names
    if not isinstance(names, tuple | list) or len(names) != count:
        raise table.fault("class", f"{shown(names)}; expected a tuple of {count}")
    row = table.row("class")
    for name in set(names) if set(map(type, names)) == {str} else names:
        try:
            row.check_class(name, table.owner)
        except DataError as error:
            raise table.fault(f"{group}[{names.index(name)}].class", error.problem) from error
    object.__setattr__(record, "class_names", tuple(names))


def settle_ids(record: Any, attribute: str, row: Row, table: Table, count: int) -> None:
    """Check ids that some records of a list have and others have not.

    Raises:
        DataError: there are more or fewer than records, or one is neither None nor an int32.
    """
    ids = getattr(record, attribute)
    if ids is None:
        ids = (None,) * count
    if not isinstance(ids, tuple | list) or len(ids) != count:
        raise table.fault(row.name, f"{shown(ids)}; expected a tuple of {count}")
    low, high = INTEGER_RANGES[BasicType.INT32]
    known = [k for k in ids if k is not None]
    if known and not (set(map(type, known)) == {int} and low <= min(known) and max(known) <= high):
        ids = tuple(row.check(k, table.owner) for k in ids)
    object.__setattr__(record, attribute, tuple(ids))


def _check_shape(
    values: Any, column: Column, expected: np.dtype[Any], table: Table, count: int | None
) -> None:
    if isinstance(values, np.ndarray) and values.dtype == expected:
        rows = len(values) if values.ndim else -1
        if values.shape == (rows if count is None else count, *column.shape):
            return
    shape = ("N" if count is None else count, *column.shape)
    words = f"({', '.join(str(n) for n in shape)}) {expected.name}"
    raise DataError(table.owner, column.attribute, f"{shown(values)}; expected an array {words}")


def _check_values(values: AnyArray, column: Column, rows: tuple[Row, ...], table: Table, group: str) -> None:
    flat = values.reshape(len(values), math.prod(values.shape[1:]))
    for j in range(flat.shape[1]):
        row = rows[j if len(rows) > 1 else 0]
        if not row.admits(flat[:, j]):
            k = row.first_refused(flat[:, j])
            location = f"{group}[{k}].{row.name}" + (f"[{j}]" if len(rows) == 1 and column.shape else "")
            raise DataError(table.owner, location, f"{flat[k, j]}; {row.wanted}")
