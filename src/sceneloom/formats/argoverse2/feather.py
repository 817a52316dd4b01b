"""Columns of feather files, by pyarrow."""

import os
import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array
from sceneloom.errors import DataError, MissingExtraError, how_to_install
from sceneloom.formats.files import check_length, check_unpacked, file_faults, open_file
from sceneloom.formats.quaternion_lengths import lengths_of
from sceneloom.geometry.rotations import normalise_quaternion

Columns = Mapping[str, type[Any]]
"""Names of columns and what their values become; `str` for texts."""


def read_columns(path: Path, columns: Columns) -> dict[str, AnyArray]:
    """Read columns of a feather file; those that are not asked for are passed over.

    Returns:
        (N,) arrays by name; texts as objects.

    Raises:
        DataError: the file is missing or no feather file, or a column is missing, of another kind, or has gaps.
        MissingExtraError: pyarrow is not installed.
    """
    try:
        import pyarrow as pa
        from pyarrow import feather
    except ImportError as error:
        raise MissingExtraError(
            f"feather files need pyarrow: install it with {how_to_install('argoverse')}"
        ) from error
    if not path.exists():
        raise DataError(path, "", "is not there; expected a feather file")
    try:
        with file_faults(path):
            _check_unpacked(path)
        table = feather.read_table(os.fspath(path), memory_map=False)
        # without it a damaged file would be read beyond its end
        table.validate(full=True)
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        raise DataError(path, "", f"is no whole feather file: {error}") from error
    missing = [name for name in columns if name not in table.column_names]
    if missing:
        problem = f"no column {', '.join(missing)}; it has {', '.join(table.column_names) or 'none'}"
        raise DataError(path, "", problem)
    return {name: _column(path, table[name], name, kind) for name, kind in columns.items()}


def _check_unpacked(path: Path) -> None:
    """Refuse a file whose compressed columns declare to become far more than its bytes.

    Source: Apache Arrow, columnar format, "Serialization and Interprocess Communication": messages follow eight bytes
    at the beginning, and a compressed buffer begins with its own length, int64, -1 for what is not compressed.

    Raises:
        DataError: they do.
        OSError: it is no regular file, or cannot be opened.
    """
    import pyarrow as pa

    size, declared = check_length(path), 0
    with open_file(path) as file:
        file.seek(_MAGIC)
        # what is no message is left to the reader of the whole file, which says so
        with suppress(pa.ArrowException, StopIteration, OSError, struct.error, IndexError):
            messages = pa.ipc.MessageReader.open_stream(pa.PythonFile(file, mode="r"))
            while True:
                message = messages.read_next_message()
                body = memoryview(message.body or b"")
                for start, length in _buffers(memoryview(message.metadata)):
                    if length >= _LENGTH.size:
                        declared += max(*_LENGTH.unpack_from(body, start), length)
                        check_unpacked(path, "", size, declared)


_MAGIC, _LENGTH = 8, struct.Struct("<q")
_RECORD_BATCH, _DICTIONARY = 3, 2


def _buffers(head: memoryview) -> Iterator[tuple[int, int]]:
    """Where the compressed buffers of a message lie in its body: byte and length; nothing of other messages.

    Source: Apache Arrow, Message.fbs; FlatBuffers internals: a table begins with the distance back to its vtable, which
    holds its own size, the table's, and where each field is, 0 for one that is not there.
    """

    def pointed(at: int) -> int:
        return at + int(struct.unpack_from("<I", head, at)[0])

    def field(table: int, number: int) -> int | None:
        vtable = table - struct.unpack_from("<i", head, table)[0]
        location = 4 + 2 * number
        if vtable < 0 or location >= struct.unpack_from("<H", head, vtable)[0]:
            return None
        offset = int(struct.unpack_from("<H", head, vtable + location)[0])
        return table + offset if offset else None

    root = pointed(0)
    kind, header = field(root, 1), field(root, 2)
    if kind is None or header is None or head[kind] not in {_RECORD_BATCH, _DICTIONARY}:
        return
    batch = pointed(header)
    if head[kind] == _DICTIONARY:
        data = field(batch, 1)
        if data is None:
            return
        batch = pointed(data)
    buffers, compression = field(batch, 2), field(batch, 3)
    if buffers is None or compression is None:
        return
    rows = pointed(buffers)
    for k in range(struct.unpack_from("<I", head, rows)[0]):
        start, length = struct.unpack_from("<qq", head, rows + 4 + 16 * k)
        if start < 0:
            return
        yield start, length


def _column(path: Path, column: Any, name: str, kind: type[Any]) -> AnyArray:
    if column.null_count:
        raise DataError(path, name, f"{column.null_count} values are missing; expected one in each row")
    values: AnyArray = column.to_numpy()
    fits = values.dtype.kind == "O" if kind is str else values.dtype.kind in _KINDS[np.dtype(kind).kind]
    if not fits:
        raise DataError(path, name, f"values of type {column.type}; expected {kind.__name__}")
    if kind is str:
        return values
    if np.dtype(kind).kind == "f" and not np.isfinite(values).all():
        raise DataError(path, name, f"row {int(np.argmin(np.isfinite(values)))} is not finite")
    return values.astype(kind)


_KINDS = {"f": "fiu", "i": "iu", "u": "iu"}
"""Kinds of columns that can be taken as floating point numbers, integers, and integers from 0 on."""

POSE_COLUMNS: Columns = dict.fromkeys(("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw"), np.float64)
"""The columns of a pose."""


def poses_of(path: Path, columns: Mapping[str, AnyArray]) -> tuple[Float64Array, Float64Array]:
    """Positions (N, 3) [m] and unit quaternions (N, 4), scalar last, of the columns of poses.

    Raises:
        DataError: a quaternion is far from length 1.
    """
    positions = np.stack([columns[f"t{axis}_m"] for axis in "xyz"], axis=1)
    quaternions = np.stack([columns[f"q{axis}"] for axis in "xyzw"], axis=1)
    norms, is_off = lengths_of(quaternions)
    wrong = np.flatnonzero(is_off)
    if len(wrong):
        k = int(wrong[0])
        problem = f"{quaternions[k].tolist()} has the length {norms[k]:.4f}; expected 1"
        raise DataError(path, f"row {k}: qx, qy, qz, qw", problem)
    return positions, normalise_quaternion(quaternions) if len(quaternions) else quaternions
