"""The timestamps of the standard: seconds and nanoseconds, two whole numbers."""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.errors import DataError
from sceneloom.fusion.messages.basic_types import BasicType, check_basic, shown

NANOSECONDS = 1_000_000_000
"""In a second."""

LATEST_NS = 2**32 * NANOSECONDS - 1
"""The latest time that a time timestamp can state [ns]."""

_TEXT = re.compile(r"([0-9]{1,10})\.([0-9]{9})")


@dataclass(frozen=True, slots=True, order=True)
class Timestamp:
    """A time from 0 to 2^32 seconds.

    Attributes:
        s: whole seconds, a uint32.
        ns: nanoseconds beside them, below 1000000000.

    Raises:
        DataError: one of them is out of range.

    Source: DB34/T 4101-2022, tables 4 to 10, "uint32. uint32"; the unit is "s. ns".
    """

    s: int
    ns: int = 0

    def __post_init__(self) -> None:
        if (
            type(self.s) is int
            and type(self.ns) is int
            and 0 <= self.s < 2**32
            and 0 <= self.ns < NANOSECONDS
        ):
            return
        for name in ("s", "ns"):
            value = check_basic(BasicType.UINT32, getattr(self, name), owner="timestamp", location=name)
            object.__setattr__(self, name, value)
        if self.ns >= NANOSECONDS:
            raise DataError("timestamp", "ns", f"{self.ns}; expected 0 to {NANOSECONDS - 1}")

    @classmethod
    def of(cls, timestamp_ns: int) -> "Timestamp":
        """The timestamp of a time in nanoseconds.

        Raises:
            DataError: it is before 0 or beyond 2^32 seconds.
        """
        whole = isinstance(timestamp_ns, int | np.integer)
        if not (whole and 0 <= timestamp_ns <= LATEST_NS):
            raise DataError("timestamp", "", f"{shown(timestamp_ns)} ns; expected 0 to {LATEST_NS}")
        return cls(*divmod(int(timestamp_ns), NANOSECONDS))

    @classmethod
    def parse(cls, text: Any) -> "Timestamp":
        """Read a text of seconds, a point, and all nine digits of the nanoseconds.

        Raises:
            DataError: it is written otherwise: a fraction with fewer digits could mean two times.
        """
        found = _TEXT.fullmatch(text) if isinstance(text, str) else None
        if found is None:
            raise DataError("timestamp", "", f'{shown(text)}; expected a text as "1595682678.715705367"')
        return cls(int(found[1]), int(found[2]))

    @property
    def nanoseconds(self) -> int:
        """The time [ns]."""
        return self.s * NANOSECONDS + self.ns

    def __str__(self) -> str:
        return f"{self.s}.{self.ns:09d}"
