"""Rows of numbers written as text, which ASCII clouds are made of."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError


def parse_rows(path: Path, lines: Sequence[str], dtype: np.dtype[np.void], first_line: int) -> AnyArray:
    """Parse one row of numbers per line; integers are read as integers, so that no digit is lost.

    Args:
        path: for messages.
        lines: none of them empty.
        dtype: a structured dtype, one entry per number of a row.
        first_line: number of the first line in the file, for messages.

    Returns:
        (len(lines),) array of the dtype.

    Raises:
        DataError: a line holds something else.
    """
    if not lines:
        return np.empty(0, dtype)
    try:
        with warnings.catch_warnings():
            # an integer that is written as "1.0" is read with a warning
            warnings.simplefilter("ignore")
            rows = np.loadtxt(lines, dtype, comments=None, ndmin=1)
    except (ValueError, OverflowError) as error:
        row, problem = _first_fault(lines, dtype, str(error))
        raise DataError(path, f"line {first_line + row}", problem) from None
    return np.atleast_1d(rows)


def _first_fault(lines: Sequence[str], dtype: np.dtype[np.void], error: str) -> tuple[int, str]:
    """Find the first line that does not parse on its own."""
    width = sum(int(np.prod(dtype[name].shape)) for name in dtype.names or ())
    for row, line in enumerate(lines):
        found = len(line.split())
        if found != width:
            return row, f"{found} values; expected {width}: {' '.join(dtype.names or ())}"
    for row, line in enumerate(lines):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                np.loadtxt([line], dtype, comments=None, ndmin=1)
        except (ValueError, OverflowError) as fault:
            return row, str(fault).split(" at row")[0]
    return 0, error
