"""What kernels share: the types of arrays that they only read, and the functions that they consist of."""

from collections.abc import Callable
from typing import Any

import numba
from numba import boolean, float32, float64, int32, int64, types, uint8, uint16

from sceneloom.kernels.cache import PART_OPTIONS


def read_only(dtype: Any, dimensions: int) -> Any:
    """Make the type of a C-contiguous array that a kernel does not write."""
    return types.Array(dtype, dimensions, "C", readonly=True)


def tuple_of(*kinds: Any) -> Any:
    """Make the type of a tuple that a kernel returns."""
    return types.Tuple(kinds)  # type: ignore[no-untyped-call]


IN_BOOL_1D = read_only(boolean, 1)
IN_U8_1D, IN_U8_2D, IN_U8_3D = (read_only(uint8, n) for n in (1, 2, 3))
IN_U16_1D, IN_U16_2D = (read_only(uint16, n) for n in (1, 2))
IN_I32_1D, IN_I32_2D = (read_only(int32, n) for n in (1, 2))
IN_I64_1D, IN_I64_2D = (read_only(int64, n) for n in (1, 2))
IN_F32_1D, IN_F32_2D, IN_F32_3D = (read_only(float32, n) for n in (1, 2, 3))
IN_F64_1D, IN_F64_2D, IN_F64_3D = (read_only(float64, n) for n in (1, 2, 3))


def part(function: Callable[..., Any]) -> Any:
    """Declare a function of which kernels consist: compiled, and kept, as a part of them."""
    return numba.njit(**PART_OPTIONS)(function)


def inlined(function: Callable[..., Any]) -> Any:
    """Declare a function that is put into each kernel that calls it before the compiler looks at it."""
    return numba.njit(**PART_OPTIONS, inline="always")(function)
