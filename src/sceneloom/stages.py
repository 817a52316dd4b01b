"""Where the time of a long job goes: whoever is at work says which stage that is, and who asks is given their seconds.

Each moment counts for the innermost stage only, in the thread that asks. Where nobody asks, next to nothing is done.
"""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from types import TracebackType
from typing import Any, TypeVar

_Result = TypeVar("_Result")


class _Clock:
    """Seconds of stages, and which ones are open."""

    __slots__ = ("open", "seconds", "since")

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.open: list[str] = []
        self.since = 0.0

    def lap(self) -> None:
        now = time.perf_counter()
        if self.open:
            self.seconds[self.open[-1]] += now - self.since
        self.since = now


_CLOCK: ContextVar[_Clock | None] = ContextVar("stages", default=None)


class stage:  # noqa: N801 - reads as the statement that it is: `with stage("fusing"):`
    """What is done inside a `with` is this stage."""

    __slots__ = ("name",)

    def __init__(self, name: str) -> None:
        self.name = name

    def __enter__(self) -> None:
        clock = _CLOCK.get()
        if clock is not None:
            clock.lap()
            clock.open.append(self.name)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        clock = _CLOCK.get()
        if clock is not None and clock.open:
            clock.lap()
            clock.open.pop()


def in_stage(name: str, work: Callable[..., _Result], *arguments: Any) -> _Result:
    """Call a function as this stage."""
    with stage(name):
        return work(*arguments)


@contextmanager
def timed() -> Iterator[Mapping[str, float]]:
    """Ask for the stages of what is done inside.

    Yields:
        Seconds by stage; whole once it is left. Who asked around it is reported them, too.
    """
    clock, around = _Clock(), _CLOCK.get()
    token = _CLOCK.set(clock)
    try:
        yield clock.seconds
    finally:
        _CLOCK.reset(token)
        if around is not None:
            around.lap()
            for name, seconds in clock.seconds.items():
                around.seconds[name] += seconds
            if around.open:  # what was reported just now is no time of the stage that is open
                around.seconds[around.open[-1]] -= sum(clock.seconds.values())
