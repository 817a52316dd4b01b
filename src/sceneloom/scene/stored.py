"""Arrays whose bytes are those of a file, on their way to other processes: the file is named, the bytes stay in it."""

from collections.abc import Callable
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray

Parcel = AnyArray | Callable[[], AnyArray] | None
"""An array, or what gives it, or nothing."""


def packed(array: AnyArray | None) -> Parcel:
    """Give what to pickle in an array's location.

    That is what its memory says with a method `reference(array)`, a function that can be pickled and gives the
    array again; else the array itself.
    """
    memory: Any = array
    while isinstance(memory, np.ndarray):
        memory = memory.base
    if isinstance(memory, memoryview):
        memory = memory.obj
    reference = getattr(memory, "reference", None)
    if array is None or reference is None or array.size == 0 or not array.flags.c_contiguous:
        return array
    parcel: Parcel = reference(array)
    return parcel


def unpacked(parcel: Parcel) -> AnyArray | None:
    """Give the array back.

    Raises:
        DataError: its file was changed, replaced or removed.
    """
    return parcel() if callable(parcel) else parcel
