"""Records on their trajectory into a log: streams with known times, merged in their order without reading ahead."""

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from sceneloom.arrays import Int64Array
from sceneloom.formats.topics.records import AnyRecord

Stated = tuple[str, AnyRecord]
"""A topic, and what is stated on it."""


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """Records whose times are known before they are made.

    Attributes:
        times_ns: (N,) int64 [ns], ascending.
        make: makes what is stated at row `k`; called once for each row, in their order.
    """

    times_ns: Int64Array
    make: Callable[[int], Iterable[Stated]]


def merged(streams: Sequence[Stream]) -> Iterator[tuple[int, str, AnyRecord]]:
    """Give time, topic and record of all streams in the order of time; one is made at a time."""
    rows = [_rows(number, stream.times_ns) for number, stream in enumerate(streams)]
    for time_ns, number, k in heapq.merge(*rows):
        for topic, record in streams[number].make(k):
            yield time_ns, topic, record


def _rows(number: int, times_ns: Int64Array) -> Iterator[tuple[int, int, int]]:
    return ((int(time_ns), number, k) for k, time_ns in enumerate(times_ns))


class RecordWriter(Protocol):
    """What writes records as the messages of a format."""

    def add(self, time_ns: int, topic: str, record: AnyRecord) -> None:
        """Write a record as a message of a topic at a time."""
        ...
