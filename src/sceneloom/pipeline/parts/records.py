"""A file of records that one worker leaves for another: each some plain values and some arrays, read one by one.

Layout of a record: length of the head (8 bytes, little endian); the head, MessagePack of {"values": …, "arrays":
[[name, dtype, shape], …]}; then the bytes of the arrays, one after another.
"""

import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError
from sceneloom.formats.files import file_faults, open_file
from sceneloom.formats.output import replacing

_LENGTH_BYTES = 8
_ARRAY = 1
"""Our code of arrays among the values."""


class _Head(msgspec.Struct, frozen=True):
    values: dict[str, Any]
    arrays: list[tuple[str, str, tuple[int, ...]]]


@dataclass(frozen=True, slots=True)
class RecordWriter:
    """Writes records."""

    file: IO[bytes]

    def add(self, values: Mapping[str, Any], arrays: Mapping[str, AnyArray]) -> None:
        """Write one: values that MessagePack holds, which may have arrays in them, and arrays of numbers by name."""
        whole = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        listed = [(name, array.dtype.str, array.shape) for name, array in whole.items()]
        head = msgspec.msgpack.encode(_Head(dict(values), listed), enc_hook=_packed)
        self.file.write(len(head).to_bytes(_LENGTH_BYTES, "little"))
        self.file.write(head)
        for array in whole.values():
            self.file.write(array.tobytes())


@contextmanager
def writing_records(path: Path) -> Iterator[RecordWriter]:
    """Open a file of records, which is there, whole, when the block ends without an error."""
    with replacing(path, overwrite=False) as draft, draft.open("wb") as file:
        yield RecordWriter(file)


def read_records(path: Path) -> Iterator[tuple[dict[str, Any], dict[str, AnyArray]]]:
    """Read records one after another, of which there is one at least.

    Yields:
        values, and arrays by name.

    Raises:
        DataError: the file is not there, or not what `writing_records` left.
    """
    with file_faults(path), open_file(path) as file:
        if path.stat().st_size == 0:
            raise DataError(path, "", "is empty; expected records of a part of a drive")
        while start := file.read(_LENGTH_BYTES):
            place = f"byte {file.tell() - len(start)}"
            try:
                packed = file.read(int.from_bytes(start, "little"))
                head = msgspec.msgpack.decode(packed, type=_Head, ext_hook=_unpacked)
                arrays = {name: _read(file, dtype, shape) for name, dtype, shape in head.arrays}
            except (msgspec.MsgspecError, ValueError, TypeError, OverflowError) as error:
                raise DataError(path, place, f"{error}; expected a record of a part of a drive") from error
            yield head.values, arrays


def _read(file: IO[bytes], dtype: str, shape: tuple[int, ...]) -> AnyArray:
    kind = np.dtype(dtype)
    raw = file.read(int(np.prod(shape, dtype=np.int64)) * kind.itemsize)
    return np.frombuffer(raw, kind).reshape(shape)


def _packed(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = np.asarray(value)
    if not isinstance(value, np.ndarray):
        raise TypeError(f"a {type(value).__name__} cannot be kept for the task that joins the parts")
    buffer = io.BytesIO()
    np.save(buffer, value, allow_pickle=False)
    return msgspec.msgpack.Ext(_ARRAY, buffer.getvalue())


def _unpacked(code: int, data: memoryview) -> Any:
    if code != _ARRAY:
        raise ValueError(f"extension {code}")
    found = np.load(io.BytesIO(data), allow_pickle=False)
    return found if found.ndim else found[()]
