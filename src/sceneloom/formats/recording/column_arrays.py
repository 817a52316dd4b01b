"""Columns of lines as arrays: on the scene's clock, in the order of time, and by line of the file."""

from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, UInt16Array, read_only
from sceneloom.formats.recording.columns import TEXT, Columns, LineLog, RecordingColumns


@dataclass(frozen=True, slots=True, eq=False)
class SortedColumns:
    """A stream in the order of its times, read-only.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        seconds: (N,) float64 [s], as the file has them.
        values: (N, K) float64.
        order: (N,) int64, row of the file's order that each row was.
    """

    timestamps_ns: Int64Array
    seconds: Float64Array
    values: Float64Array
    order: Int64Array


def nanoseconds(seconds: Float64Array) -> Int64Array:
    """Bring seconds to the scene's clock: round(t · 1e9), halves to even, cut to 64 bits."""
    scaled = seconds * 1e9
    np.rint(scaled, out=scaled)
    return np.clip(scaled, -(2.0**63), 2.0**63 - 1024, out=scaled).astype(np.int64)


def view(numbers: "array[float]") -> Float64Array:
    """Give the numbers as an array without copying them; the column cannot grow while it is in use."""
    return np.frombuffer(numbers, np.float64) if numbers else np.zeros(0)


def is_sorted(seconds: Float64Array) -> bool:
    """Whether no time is less than the one before."""
    return bool((seconds[1:] >= seconds[:-1]).all())


def time_order(seconds: Float64Array) -> Int64Array:
    """Give the order that sorts by time and keeps the order of equal times, (N,) int64."""
    if is_sorted(seconds):
        return np.arange(len(seconds), dtype=np.int64)
    return np.argsort(seconds, kind="stable").astype(np.int64)


def by_time(stream: Columns) -> SortedColumns:
    """Give a stream sorted by time, samples of one time in the order of the file."""
    seconds = view(stream.seconds)
    values = view(stream.values).reshape(len(seconds), stream.width)
    order = time_order(seconds)
    if not is_sorted(seconds):
        seconds, values = seconds[order], values[order]
    return SortedColumns(
        read_only(nanoseconds(seconds)), read_only(seconds), read_only(values), read_only(order)
    )


def row_keys(stream: Columns, rows: Sequence[int]) -> list[str]:
    """Name rows by their time [ns], as text; of several samples of one time, the second is `TIME#1`."""
    if not rows:
        return []
    timestamps = by_time(stream).timestamps_ns
    locations = np.empty(len(timestamps), np.int64)
    locations[time_order(view(stream.seconds))] = np.arange(len(timestamps))
    chosen = locations[np.asarray(rows, np.int64)]
    counts = chosen - np.searchsorted(timestamps, timestamps[chosen], "left")
    return [row_key(*pair) for pair in zip(timestamps[chosen].tolist(), counts.tolist(), strict=True)]


def row_key(timestamp_ns: int, count: int) -> str:
    """Name a sample: its time [ns], and how many samples of that time come before it, if any do."""
    return f"{timestamp_ns}#{count}" if count else str(timestamp_ns)


def further_by_time(stream: Columns) -> dict[str, str]:
    """Give the texts of lines that state more than a stream holds, by the key of their row."""
    rows = sorted(stream.further)
    return {key: stream.further[row] for key, row in zip(row_keys(stream, rows), rows, strict=True)}


def lines_of(log: LineLog, code: int) -> Int64Array:
    """Give the number of the line that each row of a stream was read from, (N,) int64, counted from 1."""
    lines: Int64Array = np.flatnonzero(_codes(log) == code)
    lines += 1
    beside = [(row, line) for line, shared in log.shared.items() for own, row in shared.rows if own == code]
    if not beside:
        return lines
    rows = sorted(beside)
    return np.insert(lines, [row - k for k, (row, _) in enumerate(rows)], [line for _, line in rows])


def line_seconds(columns: RecordingColumns) -> Float64Array:
    """Give the time of each line in the order of the file, (N,) float64 [s], NaN for lines without one."""
    codes, frames = _codes(columns.log), columns.frames
    seconds = np.full(len(codes), np.nan)
    in_several = {code for shared in columns.log.shared.values() for code, _ in shared.rows}
    for stream in columns.streams().values():
        if stream.code in in_several:
            seconds[lines_of(columns.log, stream.code) - 1] = view(stream.seconds)
        elif len(stream):
            seconds[codes == stream.code] = view(stream.seconds)
    if len(frames.seconds):
        seconds[np.frombuffer(frames.lines, np.int64) - 1] = view(frames.seconds)
    if columns.other_lines:
        seconds[codes == TEXT] = view(columns.other_seconds)
    return seconds


def _codes(log: LineLog) -> UInt16Array:
    return np.frombuffer(log.codes, np.uint16) if log.codes else np.zeros(0, np.uint16)
