"""What a drive shows in the order of time: each sensor, or kind of result, is a feed of its own."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from heapq import merge
from typing import Any

from sceneloom.arrays import Int64Array

Report = Callable[[str, str, str], None]
"""Is reported what could not be shown: a code, a location, a message; the same code and location are counted."""

_MOST_THREADS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Feed:
    """Moments to be logged one after another.

    Attributes:
        times_ns: (N,) int64 [ns], ascending.
        log: logs moment `k`, with what was prepared for it.
        prepare: does the work on moment `k` that may be done before its rotation, while other feeds are logged; one
            moment of a feed at a time, in their order.
    """

    times_ns: Int64Array
    log: Callable[[int, Any], None]
    prepare: Callable[[int], Any] | None = None

    def __len__(self) -> int:
        return len(self.times_ns)


@dataclass(slots=True)
class _Ahead:
    """Prepares the next moment of a feed while others have their rotation."""

    feed: Feed
    pool: ThreadPoolExecutor
    coming: "Future[Any] | None" = None

    def begin(self, k: int) -> None:
        """Set about moment `k`, if there is one."""
        if self.feed.prepare is not None and k < len(self.feed):
            self.coming = self.pool.submit(self.feed.prepare, k)

    def log(self, k: int) -> None:
        """Log moment `k`, and set about the next one."""
        coming, self.coming = self.coming, None
        try:
            prepared = None if coming is None else coming.result()
        finally:
            self.begin(k + 1)
        self.feed.log(k, prepared)


def play(feeds: Sequence[Feed], on_fault: Callable[[Exception], bool]) -> Iterator[None]:
    """Log the moments of all feeds in the order of time, yielding after each.

    Args:
        feeds: the feeds.
        on_fault: is given what went wrong with a moment; whether to go on with the next.
    """
    threads = min(_MOST_THREADS, os.cpu_count() or 1)
    with ThreadPoolExecutor(threads, thread_name_prefix="sceneloom-view") as pool:
        ahead = [_Ahead(feed, pool) for feed in feeds]
        for one in ahead:
            one.begin(0)
        try:
            for _, order, k in merge(*(_keyed(order, feed) for order, feed in enumerate(feeds))):
                try:
                    ahead[order].log(k)
                except Exception as error:
                    if not on_fault(error):
                        raise
                yield
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _keyed(order: int, feed: Feed) -> Iterator[tuple[int, int, int]]:
    return ((time_ns, order, k) for k, time_ns in enumerate(feed.times_ns.tolist()))
