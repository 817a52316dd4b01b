"""Thread pool for per-cloud kernels, which release the GIL."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import count as count_up
from typing import Any, TypeVar, cast

_Result = TypeVar("_Result")
_FEWEST_POINTS = 20_000


@dataclass(frozen=True, slots=True)
class ThreadPool:
    """The calling thread and its helpers, which wait for work between calls.

    Several threads may call one thread pool. What is called must not call it again.

    Attributes:
        size: how many they are.
    """

    size: int = 1

    @classmethod
    def of(cls, threads: int, count: int) -> "ThreadPool":
        """Give so many threads for so many points, or the calling one where waking others would take longer."""
        return cls(threads) if count >= _FEWEST_POINTS else ALONE

    def share(self, count: int, work: Callable[[int, int, int], None], *, rounds: int = 1) -> None:
        """Call `work(part, start, stop)` for all of 0 to `count`, each part by a thread of its own, side by side.

        A part takes as many chunks as there are rounds, spread over the whole: what is unlike here and there evens out.
        """
        if self.size == 1:
            work(0, 0, count)
            return
        chunks = self.size * rounds
        ends = [count * piece // chunks for piece in range(chunks + 1)]

        def take(part: int) -> None:
            for piece in range(part, chunks, self.size):
                work(part, ends[piece], ends[piece + 1])

        self.gather([partial(take, part) for part in range(self.size)])

    def gather(self, tasks: Sequence[Callable[[], _Result]]) -> list[_Result]:
        """Call all of these side by side, each by the next thread that is free, and give what each gives.

        What one of them raises is raised once no thread is at work on them.
        """
        if self.size == 1 or len(tasks) < 2:
            return [task() for task in tasks]
        results: list[Any] = [None] * len(tasks)
        numbers = count_up()

        def work() -> None:
            while (number := next(numbers)) < len(tasks):
                results[number] = tasks[number]()

        helpers = [_helpers(self.size - 1).submit(work) for _ in range(min(self.size, len(tasks)) - 1)]
        try:
            work()
        finally:
            # A helper that has not begun by now is not needed: all tasks are taken.
            faults = [helper.exception() for helper in helpers if not helper.cancel()]
        for fault in faults:
            if fault is not None:
                raise fault
        return cast("list[_Result]", results)


@lru_cache(maxsize=4)
def _helpers(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="sceneloom-cloud")


ALONE = ThreadPool()
"""The calling thread only."""

if hasattr(os, "register_at_fork"):
    # A child has none of its parent's threads.
    os.register_at_fork(after_in_child=_helpers.cache_clear)
