"""Lines of many streams in the order of their times; of one time, in the order of their numbers, then of the streams.

The order is found from the times alone, before any line is made. Then the lines are made block by block: those of
numbers many at once, those of frames one by one, in order, each when its rotation comes.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.formats.recording.number_texts import exact_seconds

BEFORE_ALL_NS = -(2**63)
"""Stands for the time of lines without one that no line with one comes before."""

FRAMES = "frames"
"""Name of the stream of images."""

_BLOCK = 2048
"""Lines that are in memory together, or as many more as have one time."""


class LineStream(Protocol):
    """Lines in the order of their times.

    Attributes:
        timestamps_ns: (N,) int64 [ns], ascending.
        seconds: (N,) float64 [s], the numbers that stand in the lines, or what is known of them.
        name: of the stream.
    """

    @property
    def name(self) -> str:
        """As above."""
        ...

    @property
    def timestamps_ns(self) -> Int64Array:
        """As above."""
        ...

    @property
    def seconds(self) -> Float64Array:
        """As above."""
        ...

    def lines(self, start: int, stop: int) -> Iterator[str]:
        """Make the lines of some rows; called for all rows, in order."""
        ...


class WrittenLine(NamedTuple):
    """A line, and by what it is put among the others."""

    timestamp_ns: int
    seconds: float
    text: str


class OneByOne:
    """A stream of lines that are made one after the other, whose numbers are known then only."""

    def __init__(self, timestamps_ns: Int64Array, lines: Iterable[WrittenLine], name: str = "") -> None:
        """Begin.

        Args:
            timestamps_ns: (N,) int64 [ns], ascending.
            lines: as many, with these times.
            name: of the stream.
        """
        self.name = name
        self.timestamps_ns = timestamps_ns
        self.seconds = exact_seconds(timestamps_ns)
        self._lines = iter(lines)

    def lines(self, start: int, stop: int) -> Iterator[str]:
        """Make lines, and note down the numbers that stand in them."""
        for row in range(start, stop):
            line = next(self._lines)
            self.seconds[row] = line.seconds
            yield line.text


def merged_lines(streams: Sequence[LineStream]) -> Iterator[list[str]]:
    """Give the lines of all streams, which are in the order of lines of one time, block after block."""
    timestamps = np.concatenate([stream.timestamps_ns for stream in streams] or [np.zeros(0, np.int64)])
    known = np.concatenate([stream.seconds for stream in streams] or [np.zeros(0)])
    ranks = np.repeat(np.arange(len(streams)), [len(stream.timestamps_ns) for stream in streams])
    order = np.lexsort((ranks, known, timestamps))
    timestamps, ranks, known = timestamps[order], ranks[order], known[order]
    done = np.zeros(len(streams), np.int64)
    start = 0
    while start < len(timestamps):
        stop = _end_of_block(timestamps, start)
        counts = np.bincount(ranks[start:stop], minlength=len(streams))
        span = slice(start, stop)
        yield _block(streams, done, counts, timestamps[span], ranks[span], known[span])
        done += counts
        start = stop


def _end_of_block(timestamps: Int64Array, start: int) -> int:
    """The end of a block, which parts no lines of one time."""
    last = min(start + _BLOCK, len(timestamps)) - 1
    return int(np.searchsorted(timestamps, timestamps[last], side="right"))


def _block(
    streams: Sequence[LineStream],
    done: Int64Array,
    counts: Int64Array,
    timestamps: Int64Array,
    ranks: Int64Array,
    known: Float64Array,
) -> list[str]:
    spans = [slice(begin, begin + count) for begin, count in zip(done.tolist(), counts.tolist(), strict=True)]
    makers = [stream.lines(span.start, span.stop) for stream, span in zip(streams, spans, strict=True)]
    lines = [next(makers[rank]) for rank in ranks.tolist()]
    reported = np.empty(len(lines))
    for rank, (stream, span) in enumerate(zip(streams, spans, strict=True)):
        reported[ranks == rank] = stream.seconds[span]
    if np.array_equal(reported, known):
        return lines
    return [lines[k] for k in np.lexsort((ranks, reported, timestamps)).tolist()]
