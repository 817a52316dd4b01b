"""What a drive shows in the order of time: each sensor, or kind of annotation, is a feed of its own."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from heapq import merge

from sceneloom.arrays import Int64Array

Tell = Callable[[str, str, str], None]
"""Is told of what could not be shown: a code, a place, a message; the same code and place are counted."""


@dataclass(frozen=True, slots=True, eq=False)
class Feed:
    """Moments to be logged one after another.

    Attributes:
        times_ns: (N,) int64 [ns], ascending.
        log: logs moment `k`.
    """

    times_ns: Int64Array
    log: Callable[[int], None]

    def __len__(self) -> int:
        return len(self.times_ns)


def play(feeds: Sequence[Feed]) -> Iterator[None]:
    """Log the moments of all feeds in the order of time, yielding after each."""
    streams = [_keyed(order, feed) for order, feed in enumerate(feeds)]
    for _, order, k in merge(*streams):
        feeds[order].log(k)
        yield


def _keyed(order: int, feed: Feed) -> Iterator[tuple[int, int, int]]:
    return ((time_ns, order, k) for k, time_ns in enumerate(feed.times_ns.tolist()))
