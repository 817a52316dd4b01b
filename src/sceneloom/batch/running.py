"""One verb over many drives: worker processes, one try at a drive, where outputs go, which drives are due, resuming."""

import heapq
import multiprocessing
import os
import secrets
import shutil
import signal
import socket
import sys
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from hashlib import blake2b
from importlib import import_module
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess
from multiprocessing.util import get_temp_dir
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any, Protocol
from urllib.parse import unquote

import msgspec

from sceneloom.batch.jobs import Further, Input, Job, Outcome, State, Task
from sceneloom.batch.record import Record, Row
from sceneloom.errors import OptionError, OutputError, SceneloomError, ignore_warnings_of_extreme_numbers, redacted
from sceneloom.formats.base.files import fingerprint, is_url
from sceneloom.formats.base.output import exchange
from sceneloom.kernels.cache import find_kernel_cache
from sceneloom.stages import stage, timed
from sceneloom.version import __version__

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
        peak_bytes=_peak_bytes(),
        worker=f"{socket.gethostname()}:{os.getpid()}",
        **reported,
    )


def _done(task: Task) -> dict[str, Any]:
    """Do the verb, and send what it wrote to where it belongs if that is a store; gives what is reported of it."""
    seen = _with_files(_late_fingerprint(task.location), task.files)
    draft = _draft_of(task)
    draft.parent.mkdir(parents=True, exist_ok=True)
    further = _drafts_of(task)
    for location in further.values():
        location.parent.mkdir(parents=True, exist_ok=True)
    module, _, name = task.call.partition(":")
    values = {**task.options, **task.files, **further}
    report = getattr(import_module(module), name)(task.location, draft, values)
    if not draft.exists():
        return {"error": f"{redacted(task.location)}: ended without its output {draft.name}", "kind": "Missing"}
    if task.target:
        with stage("sending"):
            _bring(task)
            _send(draft, task.target)
    if isinstance(report, dict) and any(location.exists() for location in further.values()):
        report["further"] = {option: task.further[option] for option, location in further.items() if location.exists()}
    return {"report": _without_secrets(report), "fingerprint": seen}


def _with_files(drive: str, files: Mapping[str, Any]) -> str:
    """Report a drive (its fingerprint) and the files beside it, as of `Job`, from what they were at another time."""
    named = [value if isinstance(value, tuple) else (value,) for _, value in sorted(files.items())]
    seen = [drive, *(fingerprint(str(path)) for paths in named for path in paths if isinstance(path, Path))]
    if len(seen) == 1 or not all(seen):
        return seen[0] if all(seen) else ""
    return blake2b("\n".join(seen).encode(), digest_size=16).hexdigest()


def _draft_of(task: Task) -> Path:
    """Where the output of a task is written on this machine."""
    return Path(gettempdir()) / task.draft if task.target else task.draft


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


def _drafts_of(task: Task) -> dict[str, Path]:
    """Where a verb writes further outputs, by option, beside the draft of its own."""
    folder = _draft_of(task).parent / _FURTHER
    return {option: folder / option / name for option, name in task.further_names.items()}


def _bring(task: Task) -> None:
    """Put further outputs that were written into their locations: each appears whole or not at all."""
    for option, made in _drafts_of(task).items():
        location = task.further[option]
        if not made.exists():
            continue
        if is_url(location):
            from sceneloom.formats.remote.uploads import upload

            upload(made, location)
        else:
            _move(made, Path(location))


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


def _peak_bytes() -> int:
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


_COMPILING_SECONDS = 10.0
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
        stuck = time.monotonic() - self.grown > _COMPILING_SECONDS
        self.over = cache.is_warm or not cache.writable or stuck
        return not self.over

    def end(self) -> None:
        """The first drive has ended."""
        self.over = True


CLAIM = ".sceneloom-run"
"""Name of the object in a store that says whose outputs lie there."""


@dataclass(frozen=True, slots=True)
class _Outputs:
    """Where outputs are put: a folder on disk, or a location in a store."""

    location: str = field(repr=False)  # its path or address
    there: frozenset[str] | None = None  # what a store held when the run began; None for a folder on disk

    @property
    def name(self) -> str:
        """Its path, or its address without secrets."""
        return redacted(self.location)

    @property
    def target(self) -> str:
        """The address that workers send outputs to; "" where the run moves them."""
        return "" if self.there is None else self.location

    def has(self, name: str) -> bool:
        """Whether an output is there; in a store, whether it was when the run began."""
        return Path(self.location, name).exists() if self.there is None else name in self.there

    def accept(self, task: Task) -> None:
        """Move an output to its folder, after what else the verb wrote beside it; to a store the worker has sent it."""
        if self.there is None:
            for made in _made(task.draft):
                _move_in_place(made, Path(self.location, made.name))


class _Claim(msgspec.Struct, frozen=True, kw_only=True):
    """What says in a store whose outputs lie there."""

    run: str  # its name, which its record knows, too
    record: str  # where that is
    host: str  # on which machine
    begun: str


def claimed(url: str, *, run: str, record: Path) -> _Outputs:
    """Claim a location in a store for the run of one record, unless the outputs of another run lie there."""
    # two runs that begin within the same moment are distinguished where the store refuses to put an object twice, as
    # S3, Cloud Storage and Azure do; else the later one may take the claim while the other one goes on
    from sceneloom.formats.remote.mirror import names_below
    from sceneloom.formats.remote.uploads import check_remote_output, put_first

    location = f"{url.rstrip('/')}/{CLAIM}"
    check_remote_output(location, overwrite=True)
    begun = datetime.now(UTC).isoformat(timespec="seconds")
    ours = _Claim(run=run, record=str(record.absolute()), host=socket.gethostname(), begun=begun)
    there = _claim(put_first(location, msgspec.json.encode(ours)), location)
    if there.run != run:
        raise OutputError(
            f"{redacted(url)}: holds the outputs of a run whose record is {there.record} on {there.host}, begun "
            f"{there.begun}; `--resume --record` goes on with it, or choose another location. If that record is lost, "
            f"remove {CLAIM} there"
        )
    return _Outputs(url, frozenset(names_below(url)))


def _claim(content: bytes, location: str) -> _Claim:
    try:
        return msgspec.json.decode(content, type=_Claim)
    except msgspec.MsgspecError as error:
        raise OutputError(
            f"{redacted(location)}: is not the claim of a run: {error}; choose another location"
        ) from error


def _check_further(wanted: Iterable[Further], store: str) -> None:
    """Refuse locations that are not where the outputs go, on disk or in a store, or that cannot be folders."""
    for one in wanted:
        if is_url(one.location) != bool(store):
            asked, others = ("on disk", "into a store") if store else ("in a store", "on disk")
            raise OptionError(
                f"--{one.option}: {redacted(one.location)} is {asked}, and outputs go {others}; expected both in one"
            )
        if not store and Path(one.folder).exists() and not Path(one.folder).is_dir():
            raise OutputError(f"{one.folder}: is a file; expected a folder or a new name")


def _check_locations(locations: Sequence[str]) -> None:
    """Refuse locations of which two are one."""
    seen: set[str] = set()
    for location in locations:
        known = location if is_url(location) else str(Path(location).absolute())
        if known in seen:
            raise OptionError(f"{redacted(location)}: two outputs of one drive would go there; name other locations")
        seen.add(known)


class _Locations:
    """What is there already, in folders each of which is looked at once."""

    def __init__(self) -> None:
        self._names: dict[str, frozenset[str]] = {}

    def has(self, location: str) -> bool:
        """Whether there is a file or folder."""
        if not is_url(location):
            return Path(location).exists()
        folder, _, name = location.rstrip("/").rpartition("/")
        if folder not in self._names:
            from sceneloom.formats.remote.mirror import names_below

            self._names[folder] = frozenset(names_below(folder))
        return unquote(name) in self._names[folder]


_DriveKey = tuple[str, tuple[tuple[str, Any], ...]]
"""What reports drives apart: where they are, and what counts for them alone."""

_SIDE_BY_SIDE = 16  # how many drives are looked at together


def _open_outputs(store: str, record: Record, *, resume: bool) -> _Outputs:
    """Give where outputs go ("": the folder of the record); a record belongs to one location for good."""
    # `resume`: whether the record may have drives already
    known, drives = record.reported(), len(record.rows())
    before, now = known.get("store", ""), redacted(store)
    if before != now and drives:
        location = before or "it"
        raise OutputError(f"{record.folder}: holds the record of a run with outputs in {location}; name another one")
    if drives and not resume:
        raise OutputError(
            f"{record.folder}: holds a run over {drives} drives already; `--resume` goes on with it, "
            "or choose another folder"
        )
    record.keep("store", now)
    if not store:
        return _Outputs(str(record.folder))
    name = known.get("run") or secrets.token_hex(8)
    record.keep("run", name)
    return claimed(store, run=name, record=record.folder)


def _prepare(job: Job, record: Record, outputs: _Outputs) -> None:
    """Enter the drives, and let those be done anew that changed."""
    locations = _Locations()
    known = {_drive_key(row.input, row.part): row for row in record.rows()}
    asked = _asked_drives(job)
    taken = {row.output for row in known.values()}
    new = []
    for drive, name in zip(job.inputs, job.output_names, strict=True):
        if _drive_key(drive.name, drive.options) in known:
            continue
        free = next(own for own in _numbered(name, job.suffix) if own not in taken)
        if outputs.has(free):
            raise OutputError(f"{outputs.name.rstrip('/')}/{free}: exists already; choose another folder")
        further = _further_locations(job, free)
        _check_locations([f"{outputs.location.rstrip('/')}/{free}", *further.values()])
        for location in filter(locations.has, further.values()):
            raise OutputError(f"{redacted(location)}: exists already; choose another folder")
        taken.add(free)
        new.append((drive.name, drive.options, free))
    record.add(new)
    record.keep("verb", job.verb)
    record.keep("sceneloom", __version__)
    reported = {**job.options, **job.files}
    record.keep("options", {name: redacted(repr(value)) for name, value in reported.items()})
    meant = {row.number: asked[key] for key, row in known.items() if key in asked}
    done = _done_rows(job, outputs, record, {row.number: row for row in known.values() if row.number in meant}, meant)
    record.wait_again([number for number in meant if number not in done])


def _drive_key(location: str, part: Mapping[str, Any]) -> _DriveKey:
    """What reports a drive apart in the record."""
    return location, tuple(sorted(part.items()))


def _asked_drives(job: Job) -> dict[_DriveKey, Input]:
    """The drives by what the record reports them apart by."""
    found: dict[_DriveKey, Input] = {}
    for drive in job.inputs:
        if found.setdefault(_drive_key(drive.name, drive.options), drive).location != drive.location:
            raise OptionError(f"{drive.name}: two drives differ in secrets only, which no record keeps; do them apart")
    return found


def _numbered(name: str, suffix: str) -> Iterator[str]:
    stem, number = name.removesuffix(suffix), 1
    while True:
        yield name if number == 1 else f"{stem}~{number}{suffix}"
        number += 1


def _further_locations(job: Job, output: str) -> dict[str, str]:
    """Where the further outputs of a drive belong, by option."""
    return {one.option: one.of(output.removesuffix(job.suffix)) for one in job.further}


def _files_of(job: Job, drive: Input) -> dict[str, Any]:
    """What the verb reads beside a drive, by option."""
    return {**job.files, **drive.files}


def _done_rows(
    job: Job, outputs: _Outputs, record: Record, rows: Mapping[int, Row], meant: Mapping[int, Input]
) -> set[int]:
    """Drives that are done as the job wants them, where neither they nor their outputs changed since."""
    locations = _Locations()

    def has_further(number: int) -> bool:
        report = record.report(number) if job.further else None
        made = report.get("further", {}) if isinstance(report, dict) else {}
        wanted = _further_locations(job, rows[number].output)
        return all(locations.has(location) for option, location in wanted.items() if option in made)

    perhaps = [
        number
        for number, row in rows.items()
        if row.state is State.DONE
        and row.fingerprint
        and row.configuration == _configuration(job, meant[number], row.part)
        and outputs.has(row.output)
        and has_further(number)
    ]
    with ThreadPoolExecutor(_SIDE_BY_SIDE) as thread_pool:  # servers take their time to answer
        asked = [meant[number] for number in perhaps]
        once = list(dict.fromkeys(drive.location for drive in asked))  # drives of a data set lie in one location
        seen = dict(zip(once, thread_pool.map(fingerprint, once), strict=True))
        now = thread_pool.map(lambda drive: _with_files(seen[drive.location], _files_of(job, drive)), asked)
        return {number for number, found in zip(perhaps, now, strict=True) if found == rows[number].fingerprint}


def _configuration(job: Job, drive: Input, part: Mapping[str, Any]) -> str:
    """Report what is done with a drive from anything else: the verb, its options, our version."""
    stated = {**job.options, **_files_of(job, drive), **part}
    options = sorted((name, redacted(repr(value))) for name, value in stated.items())
    reported = repr((__version__, job.verb, job.call, options))
    return blake2b(reported.encode("utf-8", "surrogateescape"), digest_size=16).hexdigest()


Reported = Callable[["RunSummary", Outcome], None]
"""Is reported how far a run is, and what came of the last try."""

_LOOK_SECONDS = 0.5
_PATIENCE_SECONDS = (1.0, 5.0, 20.0)
"""How long a drive is left alone before its second try, its third, and all further ones."""

_QUICK = frozenset({"Lost"})  # after these a drive is tried again at once


class RunSummary(msgspec.Struct, frozen=True, kw_only=True):
    """How a run stands.

    Attributes:
        output: its folder, or the location in a store without secrets.
        record: the folder that the record is in.
        verb: what was done.
        total: drives.
        done: those that are done, before or now.
        skipped: of these, those that were done before and have not changed.
        failed: those that failed.
        retried: tries beyond the first ones.
        seconds: how long this run took by the clock [s].
        processor_seconds: of all workers together [s].
    """

    output: str
    record: str
    verb: str
    total: int
    done: int = 0
    skipped: int = 0
    failed: int = 0
    retried: int = 0
    seconds: float = 0.0
    processor_seconds: float = 0.0

    @property
    def left(self) -> int:
        """Drives that are neither done nor failed."""
        return self.total - self.done - self.failed


def run(
    job: Job,
    output: str | Path,
    *,
    record: Path | None = None,
    workers: int = 1,
    executor: Executor | None = None,
    resume: bool = False,
    reported: Reported | None = None,
) -> RunSummary:
    """Do a job.

    Args:
        job: the verb and the drives.
        output: the folder of the outputs and the record, made if it is not there; or the URL of a location in a store.
        record: the folder of the record where outputs go into a store; None for one in the user's state.
        workers: processes on this machine.
        executor: what runs the tasks instead; it is stopped in the end.
        resume: go on with what an earlier run left; drives that are done and unchanged are skipped.
        reported: reported after each try.

    Raises:
        OutputError: the location holds an earlier run or files of the same names, or another run has it.
        OptionError: there is a record for outputs on disk, drives differ in secrets of their addresses only, or further
            outputs cannot go where they are to.
        DataError: the record is damaged, or a store does not answer.
    """
    pool = ProcessPool(workers, job.modules) if executor is None else executor
    store = str(output) if is_url(output) else ""
    if record is not None and not store:
        raise OptionError(f"{output}: outputs on disk have their record beside them; name none")
    _check_further(job.further, store)
    folder = (record or Record.folder_for(store)) if store else Path(output)
    with ExitStack() as ending:
        ending.callback(pool.stop)
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder}: is a file; expected a folder or a new name")
        folder.mkdir(parents=True, exist_ok=True)
        held = ending.enter_context(Record.held(folder))
        outputs = _open_outputs(store, held, resume=resume)
        _prepare(job, held, outputs)
        going = _Run(job, held, outputs, pool, reported)
        ending.callback(shutil.rmtree, going.drafts, ignore_errors=True)
        ending.callback(pool.stop)  # before its drafts go
        return going.go()


@dataclass(slots=True)
class _Run:
    """One going through the drives."""

    job: Job
    record: Record
    outputs: _Outputs
    executor: Executor
    reported: Reported | None
    summary: RunSummary = field(init=False)
    due: list[tuple[float, int, int]] = field(default_factory=list)
    """When [s of the clock], which drive, for the how many-th time."""
    rows: dict[int, Row] = field(default_factory=dict)
    meant: dict[int, Input] = field(default_factory=dict)
    """The drives by their numbers, with secrets where their addresses have some."""
    name: str = field(default_factory=lambda: secrets.token_hex(4))
    """Reports drafts of this run from those that a worker of an earlier one may still be writing."""
    warming: Warming = field(default_factory=Warming)
    running: int = 0

    def __post_init__(self) -> None:
        asked = _asked_drives(self.job)
        rows = [row for row in self.record.rows() if _drive_key(row.input, row.part) in asked]
        self.rows = {row.number: row for row in rows}
        self.meant = {row.number: asked[_drive_key(row.input, row.part)] for row in rows}
        counts = Counter(row.state for row in rows)
        done = counts[State.DONE]
        output, record = self.outputs.name, str(self.record.folder)
        self.summary = RunSummary(
            output=output, record=record, verb=self.job.verb, total=len(rows), done=done, skipped=done
        )
        self.due = [(0.0, row.number, 1) for row in rows if row.state is not State.DONE]
        heapq.heapify(self.due)

    @property
    def drafts(self) -> Path:
        """The folder of all drafts on this machine."""
        return Path(gettempdir(), self._drafts) if self.outputs.target else self._drafts

    @property
    def _drafts(self) -> Path:
        # each worker has a temporary folder of its own machine
        return Path(f"sceneloom-batch-{self.name}") if self.outputs.target else self.record.drafts

    def go(self) -> RunSummary:
        """Do what is due until nothing is left."""
        begun = time.monotonic()
        while self.due or self.running:
            self._hand_out()
            if not self.running:
                patience = self.due[0][0] - time.monotonic() if self.executor.free else _LOOK_SECONDS
                time.sleep(max(min(patience, _LOOK_SECONDS), 0.0))
                continue
            ended = self.executor.finished(_LOOK_SECONDS)
            if ended:
                self.running -= len(ended)
                self.warming.end()
                self._hand_out()  # workers need not wait until what they did is put in its location
            for task, outcome in ended:
                self._end(task, outcome)
                self.summary = msgspec.structs.replace(
                    self.summary,
                    seconds=time.monotonic() - begun,
                    processor_seconds=self.summary.processor_seconds + outcome.processor_seconds,
                )
                if self.reported is not None:
                    self.reported(self.summary, outcome)
        return self.summary

    def _hand_out(self) -> None:
        """Begin as much as workers take."""
        while self._may_begin():
            _, number, attempt = heapq.heappop(self.due)
            self._begin(number, attempt)
            self.running += 1

    def _may_begin(self) -> bool:
        if not self.due or not self.executor.free or self.due[0][0] > time.monotonic():
            return False
        return not self.running or not self.warming.goes_on()

    def _begin(self, number: int, attempt: int) -> None:
        row = self.rows[number]
        self.record.begin(number, attempt)
        draft = self._drafts / f"{self.name}-{number}-{attempt}" / Path(row.output).name
        self.executor.submit(
            Task(
                number=number,
                attempt=attempt,
                call=self.job.call,
                location=self.meant[number].location,
                draft=draft,
                options={**self.job.options, **row.part},
                target=self.outputs.target,
                further=_further_locations(self.job, row.output),
                files=_files_of(self.job, self.meant[number]),
            )
        )

    def _end(self, task: Task, outcome: Outcome) -> None:
        if not outcome.error:
            outcome = self._accepted(task, outcome)
        shutil.rmtree(_draft_of(task).parent, ignore_errors=True)
        now = time.time_ns()
        if not outcome.error:
            self.record.end(
                outcome,
                State.DONE,
                finished_ns=now,
                fingerprint=outcome.fingerprint,
                configuration=_configuration(self.job, self.meant[task.number], self.rows[task.number].part),
            )
            self._count(done=1)
        elif outcome.passing and task.attempt <= self.job.retries:
            wait = _PATIENCE_SECONDS[min(task.attempt, len(_PATIENCE_SECONDS)) - 1]
            later = 0.0 if outcome.kind in _QUICK else time.monotonic() + wait
            heapq.heappush(self.due, (later, task.number, task.attempt + 1))
            self.record.end(outcome, State.WAITING, finished_ns=now)
            self._count(retried=1)
        else:
            self.record.end(outcome, State.FAILED, finished_ns=now)
            self._count(failed=1)

    def _accepted(self, task: Task, outcome: Outcome) -> Outcome:
        """Put an output in its location, with what else the verb wrote beside it."""
        try:
            if not task.target:
                _bring(task)
            self.outputs.accept(task)
        except OSError as error:
            reported = f"{error.filename}: cannot be moved to its location: {error.strerror}"
            return msgspec.structs.replace(outcome, error=reported, kind=type(error).__name__)
        return outcome

    def _count(self, **more: int) -> None:
        changed = {name: getattr(self.summary, name) + count for name, count in more.items()}
        self.summary = msgspec.structs.replace(self.summary, **changed)


_LONG_SECONDS, _LASTING = 0.2, 20
_LATE: dict[str, tuple[str, float]] = {}
_FINGERPRINTS_LOCK = threading.Lock()


def _late_fingerprint(location: str) -> str:
    """Do as `fingerprint`, but give for a while what was found before of files that take long to look at.

    For twenty times as long as it took, so that the drives of a data set, each read for itself, wait little; a print
    that is older than the reading of a drive lets the drive count as changed at worst.
    """
    with _FINGERPRINTS_LOCK:
        found, until = _LATE.get(location, ("", 0.0))
        begun = time.monotonic()
        if begun < until:
            return found
        found = fingerprint(location)
        spent = time.monotonic() - begun
        _LATE.clear()
        if spent > _LONG_SECONDS:
            _LATE[location] = found, begun + _LASTING * spent
        return found
