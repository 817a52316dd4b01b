"""Times as the decimal seconds of a recording's lines."""

from math import isfinite

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.formats.recording.column_arrays import nanoseconds
from sceneloom.formats.recording.number_texts import decimal_text, seconds_texts, written_seconds


def seconds_text(timestamp_ns: int, file_seconds: float | None = None) -> str:
    """Write a time as seconds.

    Args:
        timestamp_ns: the time [ns].
        file_seconds: the number that the time was read from, written back where it still means the same time.

    Returns:
        The shortest decimal that means exactly this time.
    """
    if file_seconds is not None and means(file_seconds, timestamp_ns):
        return repr(float(file_seconds))
    return decimal_text(timestamp_ns)


def means(seconds: float, timestamp_ns: int) -> bool:
    """Whether a number of seconds is read as this time."""
    return isfinite(seconds) and round(seconds * 1e9) == timestamp_ns


class TimeWriter:
    """Writes times and notes which of them a 64-bit number of seconds cannot hold.

    Attributes:
        inexact: how many times are read back as another nanosecond.
        worst_ns: by how much at most [ns].
    """

    def __init__(self) -> None:
        """Begin with no time written."""
        self.inexact = 0
        self.worst_ns = 0

    def text(self, timestamp_ns: int, file_seconds: float | None = None) -> str:
        """Write a time as `seconds_text` does."""
        text = seconds_text(timestamp_ns, file_seconds)
        error = abs(round(float(text) * 1e9) - timestamp_ns)
        if error:
            self.inexact += 1
            self.worst_ns = max(self.worst_ns, error)
        return text

    def texts(self, timestamps_ns: Int64Array, file_seconds: Float64Array | None) -> list[str]:
        """Write many times, (N,) int64 [ns], with the numbers that they were read from, (N,) float64 [s]."""
        errors = np.abs(nanoseconds(written_seconds(timestamps_ns, file_seconds)) - timestamps_ns)
        self.inexact += int(np.count_nonzero(errors))
        self.worst_ns = max(self.worst_ns, int(errors.max(initial=0)))
        return seconds_texts(timestamps_ns, file_seconds)

    def raw(self, timestamp_ns: int, file_seconds: float | None = None) -> msgspec.Raw:
        """The same, ready to be put into JSON."""
        return msgspec.Raw(self.text(timestamp_ns, file_seconds).encode())


def writing_order(timestamps_ns: Int64Array, file_seconds: Float64Array | None) -> Int64Array:
    """The order in which samples are written: by time, those of one nanosecond by the numbers that they came from.

    Args:
        timestamps_ns: (N,) int64 [ns].
        file_seconds: (N,) float64 [s], the numbers, or None where there are none.

    Returns:
        (N,) int64, row that stands at each location.
    """
    if file_seconds is None:
        return np.argsort(timestamps_ns, kind="stable").astype(np.int64)
    return np.lexsort((file_seconds, timestamps_ns)).astype(np.int64)
