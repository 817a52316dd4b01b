"""Names for the arrays that cross module borders, and the check that each is what its name says."""

from collections.abc import Mapping, Sequence
from operator import index
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from sceneloom.errors import ArrayError

AnyArray = NDArray[Any]
BoolArray = NDArray[np.bool_]
UInt8Array = NDArray[np.uint8]
UInt16Array = NDArray[np.uint16]
Int16Array = NDArray[np.int16]
UInt32Array = NDArray[np.uint32]
Int32Array = NDArray[np.int32]
Int64Array = NDArray[np.int64]
Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
FloatArray = NDArray[np.floating[Any]]


def check_array(
    name: str, array: AnyArray | None, shape: Sequence[int | None], dtype: DTypeLike, *, optional: bool = False
) -> int:
    """Check that an array has the shape and dtype that its field promises.

    Args:
        name: the field's path, for the message.
        shape: one entry per axis; None stands for any length.
        dtype: the exact dtype.
        optional: accept None.

    Returns:
        The length of the first axis, 0 for an absent array.

    Raises:
        ArrayError: the array is absent, or differs in shape or dtype.
    """
    if array is None:
        if optional:
            return 0
        raise ArrayError(f"{name}: missing; expected an array of {np.dtype(dtype).name}")
    if not isinstance(array, np.ndarray):
        raise ArrayError(f"{name}: a {type(array).__name__}; {_expected(shape, dtype)}")
    found: tuple[int, ...] = array.shape
    if array.dtype == dtype and len(found) == len(shape):
        if found[1:] == shape[1:] and (shape[0] is None or shape[0] == found[0]):
            return found[0]
        # a plain loop, since scenes make hundreds of thousands of small arrays
        for length, expected in zip(found, shape, strict=True):
            if expected is not None and length != expected:
                break
        else:
            return found[0]
    raise ArrayError(f"{name}: {found} {array.dtype.name}; {_expected(shape, dtype)}")


_MOST_ROUNDED = 5e-4
"""How much a number may change when an array of float64 or a list is kept as float32, in the unit of the field: up to
8,192 m a position keeps half a millimetre."""


def hold_arrays(owner: object, path: str, fields: Mapping[str, tuple[Any, ...]], *, frozen: bool = False) -> int:
    """Check the array fields of a frozen object that is being made; lists and other dtypes are converted losslessly.

    Integers must fit, and are not made of floats. Floats may be rounded to float32 where no number changes by more
    than 0.0005.

    Args:
        owner: the object.
        path: of the object, for messages; empty where the names say enough.
        fields: dtype and lengths of the axes of each field: a number, "N" for the length that all such axes share, None
            for any length. A name that ends in "?" may be absent; a dtype `int` alone is a time [ns].
        frozen: keep contiguous views that refuse writing.

    Returns:
        The length of the axes "N".

    Raises:
        ArrayError: an array is absent, has another shape, or cannot be converted without loss.
    """
    count: int | None = None
    for key, (dtype, *axes) in fields.items():
        name = key.removesuffix("?")
        value: Any = getattr(owner, name)
        if value is None and name != key:
            continue
        held = value
        if dtype is int:
            held = as_timestamp(f"{path}.{name}" if path else name, value)
        else:
            for k, length in enumerate(axes):
                if length == "N":
                    axes[k] = count
            # a short way for what is right already, since scenes make hundreds of thousands of small arrays
            if type(value) is not np.ndarray or value.dtype.type is not dtype or value.shape != tuple(axes):
                where = f"{path}.{name}" if path else name
                held = as_array(where, value, axes, dtype)
                check_array(where, held, axes, dtype)
            if count is None and fields[key][1] == "N":
                count = len(held)
            if frozen and (held.flags.writeable or not held.flags.c_contiguous):
                held = read_only(held)
        if held is not value:
            object.__setattr__(owner, name, held)
    return count or 0


def as_array(name: str, value: Any, shape: Sequence[int | None], dtype: DTypeLike) -> AnyArray:
    """Give a list, or an array of another dtype, as an array of `dtype`, if nothing is lost.

    Raises:
        ArrayError: it holds no numbers, they differ in their lengths, or do not fit; see `hold_arrays`.
    """
    if isinstance(value, np.ndarray) and value.dtype == dtype:
        return value
    wanted, expected = np.dtype(dtype), _expected(shape, dtype)
    if not isinstance(value, np.ndarray | list | tuple | range):
        raise ArrayError(f"{name}: a {type(value).__name__}; {expected}")
    try:
        found = np.asarray(value)
    except (ValueError, OverflowError) as error:
        raise ArrayError(f"{name}: {error}; {expected}") from None
    if found.size == 0 and not isinstance(value, np.ndarray):
        empty = (0, *(length or 0 for length in shape[1:])) if found.ndim == 1 else found.shape
        return np.zeros(empty, wanted)
    kinds = "iu" if wanted.kind in "iu" else "iuf"
    if found.dtype.kind not in kinds:
        hint = ": floats cannot hold them exactly" if found.dtype.kind == "f" and wanted.itemsize == 8 else ""
        raise ArrayError(f"{name}: {found.shape} {found.dtype.name}; {expected}{hint}")
    with np.errstate(over="ignore", invalid="ignore"):
        converted = found.astype(wanted)
        if wanted.kind in "iu":
            same = (converted == found) & ((converted < 0) == (found < 0))
        elif found.dtype.kind in "iu":
            same = converted.astype(np.longdouble) == found.astype(np.longdouble)
        else:
            same = np.abs(converted - found) <= _MOST_ROUNDED
            same |= (converted == found) | (np.isnan(converted) & np.isnan(found))
    if not np.all(same):
        worst = found[~np.asarray(same)].flat[0]
        raise ArrayError(
            f"{name}: {found.shape} {found.dtype.name} with {worst}, which {wanted.name} cannot hold; {expected}"
        )
    return converted


def as_timestamp(name: str, value: Any) -> int:
    """Give a time in nanoseconds as an int; NumPy's integers are such, floats and bools are not.

    Raises:
        ArrayError: it is no integer, or none of 64 bits.
    """
    if type(value) is int and _LEAST_NS <= value <= _MOST_NS:
        return value
    if isinstance(value, int | np.integer) and not isinstance(value, bool):
        whole = index(value)
        if _LEAST_NS <= whole <= _MOST_NS:
            return whole
    hint = "; seconds are `round(seconds * 1e9)`" if isinstance(value, float | np.floating) else ""
    raise ArrayError(f"{name}: {value!r}; expected an integer of nanoseconds, of 64 bits{hint}")


def hold_timestamp(owner: object, name: str) -> None:
    """Check a time field of a frozen object that is being made; it is an int then. `name` ends in the field.

    Raises:
        ArrayError: it is no integer, or none of 64 bits.
    """
    field = name.rpartition(".")[2]
    value = getattr(owner, field)
    held = as_timestamp(name, value)
    if held is not value:
        object.__setattr__(owner, field, held)


_LEAST_NS, _MOST_NS = -(2**63), 2**63 - 1


def check_count(name: str, values: Sequence[Any] | None, count: int) -> None:
    """Check that a sequence, where there is one, has as many values as there are timestamps.

    Raises:
        ArrayError: it has more or fewer.
    """
    if values is not None and len(values) != count:
        raise ArrayError(f"{name}: {len(values)} values for {count} timestamps; expected as many of both")


def _expected(shape: Sequence[int | None], dtype: DTypeLike) -> str:
    lengths = ", ".join("N" if n is None else str(n) for n in shape)
    return f"expected ({lengths}) {np.dtype(dtype).name}"


def finite_rows(values: FloatArray) -> BoolArray:
    """Report which rows are finite throughout.

    Args:
        values: (N, M) float.

    Returns:
        (N,) bool.
    """
    return np.asarray(np.isfinite(values).all(axis=1), np.bool_)


def spread_rows(count: int, most: int, *, nearest: bool = True) -> Int64Array:
    """Choose at most so many rows out of `count`, evenly spread, the first and the last among them; of one the first.

    Args:
        nearest: take the row that is nearest to an even step, else the one before it.

    Returns:
        (M,) int64, ascending.
    """
    steps = np.linspace(0, count - 1, min(most, count)) if count > 0 else np.zeros(0)
    return np.unique((steps.round() if nearest else steps).astype(np.int64))


def read_only(array: ArrayLike, dtype: DTypeLike | None = None) -> AnyArray:
    """Return the array as a contiguous view that refuses writing."""
    view = np.ascontiguousarray(array, dtype=dtype).view()
    view.setflags(write=False)
    return view
