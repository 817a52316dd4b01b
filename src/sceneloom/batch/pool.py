"""Workers on this machine: processes of their own, each of which may die without harm to the others."""

import os
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Protocol

from sceneloom.batch.jobs import Outcome, Task
from sceneloom.batch.nursery import Nursery
from sceneloom.batch.working import NUMBA, THREADS, run_task
from sceneloom.errors import SceneloomError

LOST = "Lost"
"""Kind of the error of a worker that is gone."""

_ENDING_SECONDS = 5.0
_STARTS = 5
"""How often a worker is tried to be started: what forks them may be killed at any moment."""


class Executor(Protocol):
    """What runs tasks."""

    @property
    def free(self) -> int:
        """How many more tasks it takes now."""
        ...

    def submit(self, task: Task) -> None:
        """Begin a task."""
        ...

    def finished(self, seconds: float) -> Sequence[tuple[Task, Outcome]]:
        """Wait, at most so long, for tasks that have ended."""
        ...

    def stop(self) -> None:
        """End all workers at once, whatever they do."""
        ...


@dataclass(slots=True)
class _Worker:
    process: BaseProcess
    pipe: Connection
    task: Task | None = None


class ProcessPool:
    """Processes of this machine, each with one thread; those that die are replaced."""

    def __init__(self, workers: int, modules: Sequence[str] = ()) -> None:
        """Have so many workers, which are started when they are needed.

        Args:
            workers: how many.
            modules: what they import, once for all of them.
        """
        self._nursery = Nursery(modules)
        self._most = workers
        self._workers: list[_Worker] = []

    @property
    def free(self) -> int:
        """How many more tasks it takes now."""
        return self._most - sum(worker.task is not None for worker in self._workers)

    def submit(self, task: Task) -> None:
        """Begin a task; there must be a free worker."""
        idle = [worker for worker in self._workers if worker.task is None]
        worker = idle[0] if idle else self._start()
        worker.task = task
        with suppress(OSError):  # it is gone, which `finished` finds
            worker.pipe.send(task)

    def finished(self, seconds: float) -> list[tuple[Task, Outcome]]:
        """Wait, at most so long, for tasks that have ended, well or with their worker."""
        busy = [worker for worker in self._workers if worker.task is not None]
        ready = set(wait([end for worker in busy for end in (worker.pipe, worker.process.sentinel)], seconds))
        return [done for worker in busy if (done := self._done(worker, ready)) is not None]

    def _done(self, worker: _Worker, ready: AbstractSet[object]) -> tuple[Task, Outcome] | None:
        task = worker.task
        if task is None or (worker.pipe not in ready and worker.process.sentinel not in ready):
            return None
        outcome = None
        with suppress(EOFError, OSError):
            if worker.pipe.poll():
                outcome = worker.pipe.recv()
        if outcome is None:
            outcome = self._buried(worker, task)
        worker.task = None
        return task, outcome

    def _buried(self, worker: _Worker, task: Task) -> Outcome:
        worker.process.kill()
        worker.process.join(_ENDING_SECONDS)
        worker.pipe.close()
        self._workers.remove(worker)
        code = worker.process.exitcode
        how = signal.Signals(-code).name if code is not None and code < 0 else f"exit code {code}"
        told = f"the worker is gone ({how}): ended from outside, out of memory, or crashed"
        return Outcome(number=task.number, error=told, kind=LOST, passing=True)

    def stop(self) -> None:
        """End all workers at once."""
        for worker in self._workers:
            worker.process.kill()
        for worker in self._workers:
            worker.process.join(_ENDING_SECONDS)
            worker.pipe.close()
        self._workers.clear()
        self._nursery.close()

    def _start(self) -> _Worker:
        for left in reversed(range(_STARTS)):
            context = self._nursery.open()
            ours, theirs = context.Pipe()
            process = context.Process(target=_work, args=(theirs,), name="sceneloom batch", daemon=True)
            try:
                with one_thread(), _without_main():
                    process.start()
            except (EOFError, ConnectionError) as error:  # what forks workers is gone: it is started anew
                ours.close()
                if not left:
                    raise SceneloomError(
                        f"no worker can be started: {error or type(error).__name__}"
                    ) from error
                continue
            finally:
                theirs.close()
            break
        worker = _Worker(process, ours)
        self._workers.append(worker)
        return worker


def _work(pipe: Connection) -> None:
    """Do tasks until there are no more; Ctrl-C is the parent's."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN if name == "SIGINT" else signal.SIG_DFL)
    os.environ.setdefault(NUMBA, "1")
    with suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            pipe.send(run_task(pipe.recv()))


@contextmanager
def one_thread() -> Iterator[None]:
    """Let processes that are started now have one thread in each library, unless the user said otherwise."""
    # Numba, which may be at work here, looks at its own again and again: workers set it themselves
    wanted = {name: "1" for name in THREADS if name not in os.environ and name != NUMBA}
    with _environment(wanted):
        yield


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    os.environ.update(values)
    try:
        yield
    finally:
        for name in values:
            os.environ.pop(name, None)


@contextmanager
def _without_main() -> Iterator[None]:
    """Keep new processes from importing the program that started us: they need none of it."""
    main = sys.modules["__main__"]
    known = {name: getattr(main, name) for name in ("__file__", "__spec__") if hasattr(main, name)}
    try:
        main.__spec__ = None
        if "__file__" in known:
            del main.__file__
        yield
    finally:
        for name, value in known.items():
            setattr(main, name, value)
