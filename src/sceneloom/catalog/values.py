"""The rows of a table before they are written."""

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True)
class Repeated:
    """A column of text in which few words stand in many rows.

    Attributes:
        codes: (N,) integers, which word stands in each row.
        words: the words; None for null.
    """

    codes: np.ndarray[Any, Any]
    words: tuple[str | None, ...]


Values = np.ndarray[Any, Any] | list[Any] | Repeated
"""The rows of a column: NaN, None and counts below 0 are null."""

Rows = dict[str, Values]
"""The rows of a table, by columns."""


def text_of(identifier: object) -> str | None:
    """An id as text; None where there is none."""
    return None if identifier is None else str(identifier)
