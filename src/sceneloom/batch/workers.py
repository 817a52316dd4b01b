"""Worker processes on this machine, and one attempt at one drive."""

import multiprocessing
import os
import shutil
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib import import_module
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess
from multiprocessing.util import get_temp_dir
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any, Protocol

from sceneloom.batch.jobs import Outcome, Task, name_of, with_files
from sceneloom.errors import SceneloomError, ignore_warnings_of_extreme_numbers, redacted
from sceneloom.formats.base.files import is_url, late_fingerprint
from sceneloom.formats.base.output import exchange
from sceneloom.kernels.cache import find_kernel_cache
from sceneloom.stages import stage, timed

OUTCOME = ".outcome"
"""Name of the file beside a draft that says what came of the try."""

_FURTHER = ".further"
"""Name of the folder beside a draft in which a verb writes its further outputs, which go to locations of their own."""

NUMBA = "NUMBA_NUM_THREADS"

THREADS = (
    *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS"),
    *("VECLIB_MAXIMUM_THREADS", "NUMEXPR_NUM_THREADS", NUMBA),
)
"""What says to libraries how many threads they may start, before they are imported: as many processes as processors,
each with one thread, is the fastest that many drives are done."""

_PASSING = (ConnectionError, TimeoutError, InterruptedError, BlockingIOError)


def run_task(task: Task) -> Outcome:
    """Do one drive; whatever goes wrong with it is reported, not raised, and without secrets of addresses."""
    begun, busy = time.perf_counter(), time.process_time()
    reported: dict[str, Any] = {}
    ignore_warnings_of_extreme_numbers()
    try:
        with timed() as stages:
            reported = _done(task)
        if stages and isinstance(reported.get("report"), dict):
            reported["report"]["stages"] = {name: round(seconds, 6) for name, seconds in stages.items()}
    except (SceneloomError, OSError, MemoryError) as error:
        kind, text = type(error).__name__, error.with_sources() if isinstance(error, SceneloomError) else str(error)
        reported = {"error": redacted(text) or kind, "kind": kind, "passing": may_pass(error)}
    except Exception as error:  # noqa: BLE001 - a fault in one drive must not end the others
        reported = {"error": redacted("".join(traceback.format_exception(error))), "kind": type(error).__name__}
    return Outcome(
        number=task.number,
        seconds=time.perf_counter() - begun,
        processor_seconds=time.process_time() - busy,
        peak_bytes=peak_bytes(),
        worker=f"{socket.gethostname()}:{os.getpid()}",
        **reported,
    )


def _done(task: Task) -> dict[str, Any]:
    """Do the verb, and send what it wrote to where it belongs if that is a store; gives what is reported of it."""
    seen = with_files(late_fingerprint(task.location), task.files)
    draft = draft_of(task)
    draft.parent.mkdir(parents=True, exist_ok=True)
    further = _drafts_of(draft, task.further)
    for location in further.values():
        location.parent.mkdir(parents=True, exist_ok=True)
    module, _, name = task.call.partition(":")
    values = {**task.options, **task.files, **further}
    report = getattr(import_module(module), name)(task.location, draft, values)
    if not draft.exists():
        return {"error": f"{redacted(task.location)}: ended without its output {draft.name}", "kind": "Missing"}
    if task.target:
        with stage("sending"):
            bring(draft, task.further)
            _send(draft, task.target)
    if isinstance(report, dict) and any(location.exists() for location in further.values()):
        report["further"] = {option: task.further[option] for option, location in further.items() if location.exists()}
    return {"report": _without_secrets(report), "fingerprint": seen}


def draft_of(task: Task) -> Path:
    """Where the output of a task is written on this machine."""
    return Path(gettempdir()) / task.draft if task.target else task.draft


def put(draft: Path, folder: Path) -> None:
    """Move an output to its folder, after what else the verb wrote beside it.

    Raises:
        OSError: it cannot be moved.
    """
    for made in _made(draft):
        _move_in_place(made, folder / made.name)


def _send(draft: Path, target: str) -> None:
    """Send an output to a store, after what else the verb wrote beside it; each object appears whole or not at all."""
    from sceneloom.formats.remote.uploads import upload

    for made in _made(draft):
        upload(made, f"{target.rstrip('/')}/{made.name}")


def _made(draft: Path) -> list[Path]:
    made = [path for path in draft.parent.iterdir() if path.name not in {_FURTHER, OUTCOME}]
    return sorted(made, key=lambda path: path == draft)


def _move_in_place(made: Path, location: Path) -> None:
    """Put something in its location in one step; a folder that is there steps aside first."""
    if location.is_dir() and not location.is_symlink():
        if not made.is_dir():
            shutil.rmtree(location)
        elif exchange(made, location):
            return
        else:
            location.rename(made.with_name(f"{made.name}.before"))
    made.replace(location)


def _drafts_of(draft: Path, locations: Mapping[str, str]) -> dict[str, Path]:
    """Where a verb writes further outputs, by option, beside the draft of its own; `locations`: where they belong."""
    return {option: draft.parent / _FURTHER / option / name_of(location) for option, location in locations.items()}


def bring(draft: Path, locations: Mapping[str, str]) -> None:
    """Put what was written into its locations: each appears whole or not at all.

    Raises:
        OSError: it cannot be moved.
        OutputError: a store cannot be written to.
    """
    for option, made in _drafts_of(draft, locations).items():
        if not made.exists():
            continue
        if is_url(locations[option]):
            from sceneloom.formats.remote.uploads import upload

            upload(made, locations[option])
        else:
            _move(made, Path(locations[option]))


def _move(made: Path, location: Path) -> None:
    """Move something in one step, onto another disk, too."""
    location.parent.mkdir(parents=True, exist_ok=True)
    if made.stat().st_dev == location.parent.stat().st_dev:
        _move_in_place(made, location)
        return
    with TemporaryDirectory(prefix=f".{location.name}-", dir=location.parent) as workplace:
        copy = Path(workplace, location.name)
        shutil.copytree(made, copy) if made.is_dir() else shutil.copy2(made, copy)
        _move_in_place(copy, location)


def _without_secrets(reported: Any) -> Any:
    if isinstance(reported, str):
        return redacted(reported)
    if isinstance(reported, dict):
        return {name: _without_secrets(value) for name, value in reported.items()}
    return [_without_secrets(value) for value in reported] if isinstance(reported, list | tuple) else reported


def may_pass(error: BaseException | None) -> bool:
    """Whether the cause of an error may be gone another time: of a network, not of data."""
    while error is not None:
        if isinstance(error, _PASSING) or getattr(error, "passing", False):
            return True
        error = error.__cause__ or error.__context__
    return False


def peak_bytes() -> int:
    """The most memory that this process ever had; 0 where the system does not report."""
    try:
        import resource
    except ImportError:
        return 0
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024


LOST = "Lost"
"""Kind of the error of a worker that is gone."""

_STARTS = 5  # how often a worker is tried to be started: what forks them may be killed at any moment

_LONGEST_FOLDER = 80  # longest name of the temporary folder: that of a fork server's socket in it may have 107 bytes


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
                except (BrokenProcessPool, EOFError, OSError) as fault:  # it died idle, or what forks it is gone
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
    """Let processes that are started now have one thread in each library, unless the user set other numbers."""
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


_PATIENCE_SECONDS = 10.0
"""After so long without a newly compiled module, what is left to the first drive is no compiling."""


@dataclass(slots=True)
class Warming:
    """Whether other drives should wait for the first one, which compiles what all of them need.

    Else each worker would compile the same; not all modules are needed by each verb, so what counts is whether more
    and more of them are there.
    """

    compiled: int = -1
    grown: float = field(default_factory=time.monotonic)
    over: bool = False

    def goes_on(self) -> bool:
        """Look once more."""
        if self.over:
            return False
        cache = find_kernel_cache()
        if cache.compiled > self.compiled:
            self.compiled, self.grown = cache.compiled, time.monotonic()
        stuck = time.monotonic() - self.grown > _PATIENCE_SECONDS
        self.over = cache.is_warm or not cache.writable or stuck
        return not self.over

    def end(self) -> None:
        """The first drive has ended."""
        self.over = True
