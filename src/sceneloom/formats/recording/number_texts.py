"""Many numbers as JSON text at once: one call of the encoder for a block, instead of one for each line."""

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.formats.recording.column_arrays import nanoseconds

_SECOND_NS = 1_000_000_000
_EXACT_BELOW_NS = 2**53
"""Below this, a 64-bit number holds every nanosecond, and dividing it rounds once."""
_SHORT_FROM_NS, _SHORT_BELOW_NS = 10**6, 10**15
"""Between these, a time has 15 digits at most: the shortest text that means its number is the time itself, with no
exponent."""

_encode = msgspec.json.Encoder().encode


def exact_seconds(timestamps_ns: Int64Array) -> Float64Array:
    """Give the 64-bit numbers that are nearest to times, (N,) float64 [s].

    Of times beyond 104 days the part below a second is divided alone: that is off by 2^-54 at most, while a decimal of
    nine digits keeps at least 2^-51 from every value halfway between two numbers there, or is one.
    """
    whole, rest = np.divmod(timestamps_ns, _SECOND_NS)
    small = np.abs(timestamps_ns) < _EXACT_BELOW_NS
    seconds: Float64Array = np.where(small, timestamps_ns / 1e9, whole + rest / 1e9)
    return seconds


def holds_time(timestamps_ns: Int64Array, file_seconds: Float64Array | None) -> BoolArray:
    """Report which numbers of a file still mean their times, (N,) bool."""
    if file_seconds is None:
        return np.zeros(len(timestamps_ns), np.bool_)
    within = np.abs(file_seconds) < 9.2e9
    found = nanoseconds(np.where(within, file_seconds, 0.0)) == timestamps_ns
    return np.asarray(within & found, np.bool_)


def written_seconds(timestamps_ns: Int64Array, file_seconds: Float64Array | None) -> Float64Array:
    """Give the numbers that readers make of written times, (N,) float64 [s]."""
    seconds = exact_seconds(timestamps_ns)
    if file_seconds is None:
        return seconds
    return np.where(holds_time(timestamps_ns, file_seconds), file_seconds, seconds)


def seconds_texts(timestamps_ns: Int64Array, file_seconds: Float64Array | None) -> list[str]:
    """Write times as seconds: the file's own numbers where they still mean the time, else its exact decimals.

    Args:
        timestamps_ns: (N,) int64 [ns].
        file_seconds: (N,) float64 [s], or None.
    """
    size = np.abs(timestamps_ns)
    short = (size >= _SHORT_FROM_NS) & (size < _SHORT_BELOW_NS)
    short |= holds_time(timestamps_ns, file_seconds)
    if short.all():
        return number_texts(written_seconds(timestamps_ns, file_seconds))
    texts = _decimal_texts(timestamps_ns)
    if short.any():
        numbers = number_texts(written_seconds(timestamps_ns, file_seconds)[short])
        for k, text in zip(np.flatnonzero(short).tolist(), numbers, strict=True):
            texts[k] = text
    return texts


def _decimal_texts(timestamps_ns: Int64Array) -> list[str]:
    """Write times as exact decimals: their nanoseconds with a point before the last nine digits."""
    texts = _encode(timestamps_ns.tolist()).decode()[1:-1].split(",")
    decimals = [f"{text[:-9]}.{text[-9:]}".rstrip("0") for text in texts]
    odd = (np.abs(timestamps_ns) < _SECOND_NS) | (timestamps_ns % _SECOND_NS == 0)
    for k in np.flatnonzero(odd).tolist():
        decimals[k] = decimal_text(int(timestamps_ns[k]))
    return decimals


def decimal_text(timestamp_ns: int) -> str:
    """Write a time as the shortest decimal that means exactly this time."""
    whole, rest = divmod(abs(timestamp_ns), _SECOND_NS)
    sign = "-" if timestamp_ns < 0 else ""
    return f"{sign}{whole}.{rest:09d}".rstrip("0") if rest else f"{sign}{whole}.0"


def number_texts(numbers: Float64Array) -> list[str]:
    """Write finite numbers, (N,) float64, each as the shortest text that is read as it."""
    return _encode(numbers.tolist()).decode()[1:-1].split(",") if len(numbers) else []


def row_texts(rows: Float64Array) -> list[str]:
    """Write rows of finite numbers, (N, K) float64, each as its numbers with commas between them."""
    return _encode(rows.tolist()).decode()[2:-2].split("],[") if len(rows) else []
