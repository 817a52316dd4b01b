"""Parquet files of a catalogue, by pyarrow: rows, and in the footer which scenes they belong to."""

import json
from pathlib import Path
from typing import Any

from sceneloom.catalog.tables import Kind
from sceneloom.errors import DataError, MissingExtraError, how_to_install
from sceneloom.formats.files import check_regular, check_unpacked

_ROWS_OF_GROUP = 131_072
_SCENES = b"sceneloom.scenes"
"""Under which name a footer reports the scenes."""


def write_part(table: Any, scenes: Any, path: Path) -> None:
    """Write a file.

    Args:
        table: rows, as a table of pyarrow.
        scenes: what its footer reports them, as values that JSON has.
        path: of the file.
    """
    _, parquet = pyarrow()
    reported = {_SCENES: json.dumps(scenes).encode()}
    texts = [column.name for column in table.schema if str(column.type) == "string"]
    parquet.write_table(
        table.replace_schema_metadata(reported),
        path,
        compression="zstd",
        row_group_size=_ROWS_OF_GROUP,
        use_dictionary=[*texts, *(name for name in _TIMES if name in table.schema.names)],
    )


_TIMES = ("timestamp_ns", "seconds", "track")
"""Numbers that many rows share, and all other numbers few."""


def read_part(path: Path) -> Any:
    """Read the rows of a file, as a table of pyarrow.

    Raises:
        DataError: it is not there, or damaged.
    """
    pa, parquet = pyarrow()
    try:
        check_regular(path)
        # one file, not a data set: the folder's name is no column here
        file = parquet.ParquetFile(path)
        _check_unpacked(path, file.metadata)
        return file.read().replace_schema_metadata(None)
    except (pa.ArrowException, OSError) as error:
        raise DataError(path, "", _problem(error)) from error


def read_footer(path: Path) -> tuple[int, Any]:
    """Read how many rows a file has, and what it reports its scenes.

    Raises:
        DataError: it is not there, is no Parquet file, ends before its end, or states nothing of scenes.
        MissingExtraError: pyarrow is not installed.
    """
    pa, parquet = pyarrow()
    try:
        check_regular(path)
        footer = parquet.read_metadata(path)
        _check_unpacked(path, footer)
        return footer.num_rows, json.loads((footer.metadata or {})[_SCENES])
    except (pa.ArrowException, OSError) as error:
        raise DataError(path, "", _problem(error)) from error
    except (KeyError, ValueError, RecursionError) as error:
        raise DataError(
            path, "", "does not report which scenes it holds; expected a file of a catalogue"
        ) from error


def _check_unpacked(path: Path, footer: Any) -> None:
    """Refuse a file whose rows would take far more memory than its bytes: by what it declares, and 8 bytes a number."""
    groups = sum(max(footer.row_group(k).total_byte_size, 0) for k in range(footer.num_row_groups))
    check_unpacked(path, "", path.stat().st_size, max(groups, 8 * footer.num_rows * footer.num_columns))


def arrow_type(kind: Kind) -> Any:
    """What values of a kind are to pyarrow."""
    pa, _ = pyarrow()
    return {
        Kind.TEXT: pa.string(), Kind.TIME: pa.int64(), Kind.COUNT: pa.int32(), Kind.NUMBER: pa.float64(),
        Kind.FLAG: pa.bool_(),
    }[kind]  # fmt: skip


def _problem(error: Exception) -> str:
    return f"is no whole Parquet file ({' '.join(str(error).split())})"


def pyarrow() -> tuple[Any, Any]:
    """The modules `pyarrow` and `pyarrow.parquet`.

    Raises:
        MissingExtraError: pyarrow is not installed.
    """
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise MissingExtraError(
            f"catalogues need pyarrow: install it with {how_to_install('catalog')}"
        ) from error
    return pa, parquet
