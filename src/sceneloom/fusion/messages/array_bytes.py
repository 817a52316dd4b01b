"""Arrays as bytes, little-endian, without copies where there need be none."""

from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError


def bytes_of(array: AnyArray) -> bytes:
    """Give the bytes of an array in C order: those that it is a view of, where it shows all of them, else a copy."""
    base = array.base
    while isinstance(base, np.ndarray):
        base = base.base
    whole = isinstance(base, bytes) and len(base) == array.nbytes and array.flags.c_contiguous
    if whole and array.dtype.newbyteorder("<") == array.dtype:
        return base  # type: ignore[return-value]
    return array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()


def bytes_view(array: AnyArray) -> memoryview:
    """Give the bytes of an array in C order, without a copy where it has this order and is little-endian."""
    plain = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    return plain.reshape(-1).view(np.uint8).data


def array_of(content: bytes, dtype: np.dtype[Any], owner: str, location: str) -> AnyArray:
    """Give the flat array that bytes hold, a read-only view of them.

    Args:
        owner: what they belong to, for the message.
        location: the field, for the message.

    Raises:
        DataError: they are no whole number of values.
    """
    if len(content) % dtype.itemsize:
        problem = f"{len(content)} bytes; expected a multiple of {dtype.itemsize}"
        raise DataError(owner, location, problem)
    return np.frombuffer(content, dtype.newbyteorder("<")).astype(dtype, copy=False)


def array_within(
    content: bytes, span: tuple[int, int], dtype: np.dtype[Any], owner: str, location: str
) -> AnyArray:
    """Give the flat array that a part of bytes holds: a read-only view of it, a copy where numbers are not aligned.

    Args:
        span: where the part begins and ends.
        owner: what it belongs to, for the message.
        location: the field, for the message.

    Raises:
        DataError: it is no whole number of values.
    """
    start, stop = span
    length = stop - start
    if length % dtype.itemsize or not length:
        return array_of(content[start:stop], dtype, owner, location)
    flat = np.frombuffer(content, dtype.newbyteorder("<"), length // dtype.itemsize, start)
    if not flat.flags.aligned:
        return array_of(content[start:stop], dtype, owner, location)
    return flat.astype(dtype, copy=False)
