"""Thread pool for per-cloud kernels, which release the GIL."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import count as count_up
from typing import Any, NamedTuple, TypeVar, cast

_Result = TypeVar("_Result")
_FEWEST_POINTS = 20_000


class Phase(NamedTuple):
    """Work that a pool shares: `work(part, start, stop)` for all of 0 to `length`, each part in a thread of its own.

    A part takes `rounds` chunks, spread over the whole: what is uneven there evens out.
    """

    length: int
    work: Callable[[int, int, int], None]
    rounds: int = 1


@dataclass(frozen=True, slots=True)
class ThreadPool:
    """The calling thread and its helpers, which wait for work between calls.

    Several threads may call one thread pool. What is called must not call it again.

    Attributes:
        size: number of threads.
    """

    size: int = 1

    @classmethod
    def of(cls, threads: int, count: int) -> "ThreadPool":
        """A pool of so many threads for so many points; the calling thread alone where waking others takes longer."""
        return cls(threads) if count >= _FEWEST_POINTS else ALONE

    def share(self, *phases: Phase) -> None:
        """Do one phase after another, the parts of each side by side."""
        for length, work, rounds in phases:
            if self.size == 1:
                work(0, 0, length)
                continue
            chunks = self.size * rounds
            ends = [length * chunk // chunks for chunk in range(chunks + 1)]
            self.gather([partial(_take, work, ends, part, self.size) for part in range(self.size)])

    def gather(self, tasks: Sequence[Callable[[], _Result]]) -> list[_Result]:
        """Call all tasks side by side, each in the next free thread, and return their results.

        An exception of one of them is raised once no thread is at work on them.
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


def _take(work: Callable[[int, int, int], None], ends: Sequence[int], part: int, size: int) -> None:
    for chunk in range(part, len(ends) - 1, size):
        work(part, ends[chunk], ends[chunk + 1])


@lru_cache(maxsize=4)
def _helpers(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="sceneloom-cloud")


ALONE = ThreadPool()
"""The calling thread only."""

if hasattr(os, "register_at_fork"):
    # A child has none of its parent's threads.
    os.register_at_fork(after_in_child=_helpers.cache_clear)
