"""The rows of one scene on their trajectory into a catalogue.

A folder with a file in Arrow's own form for each table.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.catalog.parquet import arrow_type, pyarrow
from sceneloom.catalog.tables import TABLES, Column, Kind
from sceneloom.catalog.values import Repeated, Rows, Values
from sceneloom.errors import DataError, OutputError


def write_draft(scene: str, tables: Mapping[str, Rows], folder: Path) -> int:
    """Write the rows of all tables of a scene.

    Returns:
        the number of rows of the longest table.

    Raises:
        DataError: a value is one that a table cannot hold.
        OutputError: the files cannot be written.
        MissingExtraError: pyarrow is not installed.
    """
    pa, _ = pyarrow()
    made = {name: _table(pa, scene, name, tables[name]) for name in TABLES}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, table in made.items():
            with pa.OSFile(str(folder / name), "wb") as file, pa.ipc.new_file(file, table.schema) as writer:
                writer.write_table(table)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror or error}") from error
    return max(int(table.num_rows) for table in made.values())


def read_draft(folder: Path, table: str) -> Any:
    """Read the rows of a table, as a table of pyarrow."""
    pa, _ = pyarrow()
    with pa.OSFile(str(folder / table), "rb") as file:
        return pa.ipc.open_file(file).read_all()


def _table(pa: Any, scene: str, name: str, rows: Rows) -> Any:
    columns = TABLES[name]
    try:
        arrays = [_array(pa, column, rows[column.name]) for column in columns]
    except (pa.ArrowException, OverflowError) as error:
        raise DataError(name, "", f"holds what Parquet cannot ({' '.join(str(error).split())})") from error
    scenes = pa.repeat(pa.scalar(scene, pa.string()), len(arrays[0]))
    return pa.table([scenes, *arrays], names=["scene", *(column.name for column in columns)])


def _array(pa: Any, column: Column, values: Values) -> Any:
    kind = arrow_type(column.kind)
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
