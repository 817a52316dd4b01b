"""Names for the arrays that cross module borders, and the check that each is what its name says."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from sceneloom.errors import ArrayError

AnyArray = NDArray[Any]
BoolArray = NDArray[np.bool_]
UInt8Array = NDArray[np.uint8]
UInt16Array = NDArray[np.uint16]
UInt32Array = NDArray[np.uint32]
Int32Array = NDArray[np.int32]
Int64Array = NDArray[np.int64]
Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
FloatArray = NDArray[np.floating[Any]]


def check_array(
    name: str,
    array: AnyArray | None,
    shape: Sequence[int | None],
    dtype: DTypeLike,
    *,
    optional: bool = False,
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


def check_count(name: str, values: Sequence[Any] | None, count: int) -> None:
    """Check that a sequence, where there is one, has as many values as there are time stamps.

    Raises:
        ArrayError: it has more or fewer.
    """
    if values is not None and len(values) != count:
        raise ArrayError(f"{name}: {len(values)} values for {count} timestamps; expected as many of both")


def _expected(shape: Sequence[int | None], dtype: DTypeLike) -> str:
    lengths = ", ".join("N" if n is None else str(n) for n in shape)
    return f"expected ({lengths}) {np.dtype(dtype).name}"


def finite_rows(values: FloatArray) -> BoolArray:
    """Tell which rows are finite throughout.

    Args:
        values: (N, M) float.

    Returns:
        (N,) bool.
    """
    return np.asarray(np.isfinite(values).all(axis=1), np.bool_)


def read_only(array: ArrayLike, dtype: DTypeLike | None = None) -> AnyArray:
    """Return the array as a contiguous view that refuses writing."""
    view = np.ascontiguousarray(array, dtype=dtype).view()
    view.setflags(write=False)
    return view
