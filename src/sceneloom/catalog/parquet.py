"""Parquet files of tables, by pyarrow."""

from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.catalog.tables import TABLES, Column, Kind, Repeated, Rows, Values
from sceneloom.errors import DataError, MissingExtraError

_ROWS_OF_GROUP = 131_072


def write_table(name: str, rows: Rows, path: Path) -> None:
    """Write the rows of a table of that name.

    Raises:
        DataError: a value is one that the table cannot hold.
        MissingExtraError: pyarrow is not installed.
    """
    pa, parquet = _pyarrow()
    columns = TABLES[name]
    try:
        arrays = [_array(pa, column, rows[column.name]) for column in columns]
    except (pa.ArrowException, OverflowError) as error:
        raise DataError(name, "", f"holds what Parquet cannot ({' '.join(str(error).split())})") from error
    table = pa.table(arrays, names=[column.name for column in columns])
    parquet.write_table(table, path, compression="zstd", row_group_size=_ROWS_OF_GROUP)


def read_columns(path: Path, names: list[str]) -> list[dict[str, Any]]:
    """Read some columns of a file, a mapping for each row.

    Raises:
        DataError: it is not there, or damaged.
        MissingExtraError: pyarrow is not installed.
    """
    pa, parquet = _pyarrow()
    try:
        # one file, not a data set: the folder's name is no column here
        rows: list[dict[str, Any]] = parquet.ParquetFile(path).read(columns=names).to_pylist()
    except (pa.ArrowException, OSError, KeyError) as error:
        raise DataError(path, "", _problem(error)) from error
    if rows and len(rows[0]) != len(names):
        raise DataError(path, "", f"columns {', '.join(rows[0])}; expected {', '.join(names)}")
    return rows


def check_file(path: Path) -> None:
    """Refuse what is no Parquet file, or ends before its end.

    Raises:
        DataError: it is such.
        MissingExtraError: pyarrow is not installed.
    """
    pa, parquet = _pyarrow()
    try:
        parquet.read_metadata(path)
    except (pa.ArrowException, OSError) as error:
        raise DataError(path, "", _problem(error)) from error


def _problem(error: Exception) -> str:
    return f"is no whole Parquet file ({' '.join(str(error).split())})"


def _pyarrow() -> tuple[Any, Any]:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise MissingExtraError(
            "catalogues need pyarrow: install it with `pip install 'sceneloom[catalog]'`"
        ) from error
    return pa, parquet


def _array(pa: Any, column: Column, values: Values) -> Any:
    kind = {
        Kind.TEXT: pa.string(), Kind.TIME: pa.int64(), Kind.COUNT: pa.int32(), Kind.NUMBER: pa.float64(),
        Kind.FLAG: pa.bool_(),
    }[column.kind]  # fmt: skip
    if isinstance(values, Repeated):
        words = pa.array([_unicode(word) for word in values.words], pa.string())
        return pa.DictionaryArray.from_arrays(pa.array(values.codes, pa.int32()), words).cast(kind)
    if column.kind is Kind.TEXT:
        return pa.array([_unicode(value) for value in values], kind)
    if isinstance(values, np.ndarray) and column.kind is Kind.COUNT:
        return pa.array(values.astype(np.int32), kind, mask=values < 0)
    return pa.array(values, kind, from_pandas=True)


def _unicode(value: Any) -> str | None:
    """Names of files may be no Unicode, which Parquet cannot hold."""
    return None if value is None else str(value).encode("utf-8", "backslashreplace").decode()
