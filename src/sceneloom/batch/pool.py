"""Workers on this machine: processes of their own, each of which may die without harm to the others."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess
from multiprocessing.util import get_temp_dir
from typing import Protocol

from sceneloom.batch.jobs import Outcome, Task
from sceneloom.batch.working import NUMBA, THREADS, run_task
from sceneloom.errors import SceneloomError

LOST = "Lost"
"""Kind of the error of a worker that is gone."""

_STARTS = 5
"""How often a worker is tried to be started: what forks them may be killed at any moment."""
_LONGEST_FOLDER = 80
"""Longest name of the temporary folder: that of a fork server's socket in it may have 107 bytes."""


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


class ProcessPool:
    """Processes of this machine, each with one thread; those that die are replaced.

    Each has an executor of its own: one whose process dies takes no other task than its own.
    """

    def __init__(self, workers: int, modules: Sequence[str] = ()) -> None:
        """Have so many workers, which are started when they are needed.

        Args:
            workers: how many.
            modules: what they import, with a fork server once for all of them; they must start no threads.
        """
        self._most, self._modules = workers, list(modules)
        self._idle: list[ProcessPoolExecutor] = []
        self._busy: dict[Future[Outcome], tuple[Task, ProcessPoolExecutor, BaseProcess]] = {}

    @property
    def free(self) -> int:
        """How many more tasks it takes now."""
        return self._most - len(self._busy)

    def submit(self, task: Task) -> None:
        """Begin a task; there must be a free worker.

        Raises:
            SceneloomError: no worker can be started.
        """
        error: Exception | None = None
        for _ in range(_STARTS):
            with one_thread(), _without_main():
                worker = self._idle.pop() if self._idle else self._started()
                try:
                    future = worker.submit(run_task, task)
                except (
                    BrokenProcessPool,
                    EOFError,
                    OSError,
                ) as fault:  # it died idle, or what forks it is gone
                    error = fault
                    worker.shutdown(wait=False)
                    continue
            (process,) = _processes(worker)
            self._busy[future] = task, worker, process
            return
        raise SceneloomError(f"no worker can be started: {error or type(error).__name__}") from error

    def finished(self, seconds: float) -> list[tuple[Task, Outcome]]:
        """Wait, at most so long, for tasks that have ended, well or with their worker."""
        ended = []
        for future in wait(self._busy, seconds, FIRST_COMPLETED).done:
            task, worker, process = self._busy.pop(future)
            fault = future.exception()
            if fault is None:
                self._idle.append(worker)
                ended.append((task, future.result()))
                continue
            worker.shutdown()
            ended.append((task, _lost(task, process, fault)))
        return ended

    def stop(self) -> None:
        """End all workers at once."""
        workers = [*self._idle, *(worker for _, worker, _ in self._busy.values())]
        for process in [process for worker in workers for process in _processes(worker)]:
            process.kill()
        for worker in workers:
            worker.shutdown(cancel_futures=True)
        self._idle.clear()
        self._busy.clear()

    def _started(self) -> ProcessPoolExecutor:
        context = _context()
        if isinstance(context, ForkServerContext):
            context.set_forkserver_preload(self._modules)
        return ProcessPoolExecutor(1, context, initializer=_begin, initargs=(dict(os.environ),))


def _context() -> ForkServerContext | SpawnContext:
    """Fork workers from a process that has imported their modules, where that can be; else start them afresh."""
    if sys.platform == "linux" and len(os.fsencode(get_temp_dir())) < _LONGEST_FOLDER:
        return multiprocessing.get_context("forkserver")
    return multiprocessing.get_context("spawn")


def _processes(worker: ProcessPoolExecutor) -> list[BaseProcess]:
    # nothing public reports which process it is, to end it at once and to state how it ended
    return list((worker._processes or {}).values())  # noqa: SLF001


def _lost(task: Task, process: BaseProcess, fault: BaseException) -> Outcome:
    if not isinstance(fault, BrokenProcessPool):
        return Outcome(number=task.number, error=str(fault), kind=type(fault).__name__)
    process.join()
    code = process.exitcode
    how = signal.Signals(-code).name if code is not None and code < 0 else f"exit code {code}"
    reported = f"the worker is gone ({how}): ended from outside, out of memory, or crashed"
    return Outcome(number=task.number, error=reported, kind=LOST, passing=True)


def _begin(environment: Mapping[str, str]) -> None:
    """Make a process a worker: with the environment of the run, ended with it, and deaf to Ctrl-C, which it takes."""
    os.environ.clear()
    os.environ.update(environment)
    os.environ.setdefault(NUMBA, "1")
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN if name == "SIGINT" else signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let processes that are started now have one thread in each library, unless the user stated otherwise."""
    # Numba, which may be at work here, looks at its own again and again: workers set it themselves
    wanted = {name: "1" for name in THREADS if name not in os.environ and name != NUMBA}
    os.environ.update(wanted)
    try:
        yield
    finally:
        for name in wanted:
            os.environ.pop(name, None)


@contextmanager
def _without_main() -> Iterator[None]:
    """Keep new processes from importing the program that started us: they need none of it."""
    main = sys.modules["__main__"]
    known = {name: getattr(main, name) for name in ("__file__", "__spec__") if hasattr(main, name)}
    try:
        main.__spec__ = None
        with suppress(AttributeError):
            del main.__file__
        yield
    finally:
        for name, value in known.items():
            setattr(main, name, value)
