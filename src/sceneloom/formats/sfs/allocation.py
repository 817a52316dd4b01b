"""Asking the file system for space: ahead of writing, and in front of what is written already.

Where the system or the file system cannot do it, nothing happens, and the caller goes the long way.
"""

import ctypes
import sys
from functools import lru_cache
from typing import Any

BLOCK = 4096
"""Space can be put into a file in multiples of the block of its file system, which is nearly always this [bytes]."""

_EXTEND, _INSERT_RANGE = 0x00, 0x20


def allocate(descriptor: int, start: int, length: int) -> bool:
    """Have space for bytes that will be written; pages of it are then cheaper to fill. The file grows.

    Source: fallocate(2) of Linux, mode 0.
    """
    return _fallocate(descriptor, _EXTEND, start, length)


def insert(descriptor: int, length: int) -> bool:
    """Put space before the first byte of a file without copying what follows.

    Args:
        length: a multiple of `BLOCK`.

    Source: fallocate(2) of Linux, mode FALLOC_FL_INSERT_RANGE, which ext4 and XFS know.
    """
    return _fallocate(descriptor, _INSERT_RANGE, 0, length)


def _fallocate(descriptor: int, mode: int, start: int, length: int) -> bool:
    call = _system_call()
    return call is not None and call(descriptor, mode, start, length) == 0


@lru_cache(maxsize=1)
def _system_call() -> Any:
    """Find the function in the C library; unlike `os.posix_fallocate` it does not write zeros where it cannot."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        call = ctypes.CDLL(None, use_errno=True).fallocate64
    except (OSError, AttributeError):
        return None
    call.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.c_int64, ctypes.c_int64]
    call.restype = ctypes.c_int
    return call
