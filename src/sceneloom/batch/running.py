"""One verb over many drives: what is due is handed to workers, what they made is put in its place and recorded.

A try writes into a folder of its own. Once it has ended well the output is moved to its place, in one step, and then
the record says that the drive is done: whatever is killed in between, an output is there whole or not at all, and a run
that is taken up again makes anew what the record does not know as done.
"""

import heapq
import secrets
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.batch.fingerprints import configuration, fingerprint
from sceneloom.batch.jobs import Job, Outcome, State, Task
from sceneloom.batch.naming import output_names
from sceneloom.batch.pool import Executor, ProcessPool
from sceneloom.batch.record import Record, Row
from sceneloom.batch.warming import Warming
from sceneloom.errors import OutputError
from sceneloom.version import __version__

Told = Callable[["RunSummary", Outcome], None]
"""Is told how far a run is, and what came of the last try."""

_LOOK_SECONDS = 0.5
_PATIENCE_SECONDS = (1.0, 5.0, 20.0)
"""How long a drive is left alone before its second try, its third, and all further ones."""
_QUICK = frozenset({"Lost"})
"""After these a drive is tried again at once."""
_Key = tuple[str, tuple[tuple[str, Any], ...]]
"""What tells drives apart: where they are, and what counts for them alone."""


class RunSummary(msgspec.Struct, frozen=True, kw_only=True):
    """How a run stands.

    Attributes:
        output: its folder.
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
    workers: int = 1,
    executor: Executor | None = None,
    resume: bool = False,
    told: Told | None = None,
) -> RunSummary:
    """Do a job.

    Args:
        job: the verb and the drives.
        output: the folder of the outputs and the record; made if it is not there.
        workers: processes on this machine.
        executor: what runs the tasks instead; it is stopped in the end.
        resume: go on with what an earlier run left; drives that are done and unchanged are skipped.
        told: told after each try.

    Raises:
        OutputError: the folder holds an earlier run or files of the same names, or another run has it.
        DataError: its record is damaged.
    """
    pool = ProcessPool(workers) if executor is None else executor
    folder = Path(output)
    with ExitStack() as ending:
        ending.callback(pool.stop)
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder}: is a file; expected a folder or a new name")
        folder.mkdir(parents=True, exist_ok=True)
        record = ending.enter_context(Record.held(folder))
        _prepare(job, record, resume=resume)
        ending.callback(shutil.rmtree, record.drafts, ignore_errors=True)
        ending.callback(pool.stop)  # before its drafts go
        return _Run(job, record, pool, told).go()


def _prepare(job: Job, record: Record, *, resume: bool) -> None:
    """Enter the drives, and let those be done anew that changed."""
    known = {_key(row.input, row.part): row for row in record.rows()}
    if known and not resume:
        raise OutputError(
            f"{record.folder}: holds a run over {len(known)} drives already; `--resume` goes on with it, "
            "or choose another folder"
        )
    taken = {row.output for row in known.values()}
    new = []
    for drive, name in zip(job.inputs, output_names(job.inputs, job.suffix), strict=True):
        if _key(drive.place, drive.options) in known:
            continue
        free = next(own for own in _numbered(name, job.suffix) if own not in taken)
        if (record.folder / free).exists():
            raise OutputError(f"{record.folder / free}: exists already; choose another folder")
        taken.add(free)
        new.append((drive.place, drive.options, free))
    record.add(new)
    record.tell("verb", job.verb)
    record.tell("sceneloom", __version__)
    record.tell("options", {name: repr(value) for name, value in job.options.items()})
    asked = _asked(job)
    record.wait_again(
        [row.number for key, row in known.items() if key in asked and not _is_done(job, record, row)]
    )


def _key(place: str, part: Mapping[str, Any]) -> _Key:
    return place, tuple(sorted(part.items()))


def _asked(job: Job) -> set[_Key]:
    return {_key(drive.place, drive.options) for drive in job.inputs}


def _numbered(name: str, suffix: str) -> Iterator[str]:
    stem, number = name.removesuffix(suffix), 1
    while True:
        yield name if number == 1 else f"{stem}~{number}{suffix}"
        number += 1


def _is_done(job: Job, record: Record, row: Row) -> bool:
    """Whether a drive is done as the job wants it, and neither it nor its output changed since."""
    return (
        row.state is State.DONE
        and row.configuration == _configuration(job, row.part)
        and row.fingerprint == fingerprint(row.input)
        and (record.folder / row.output).exists()
    )


def _configuration(job: Job, part: Mapping[str, Any]) -> str:
    return configuration(job.verb, job.call, {**job.options, **part})


@dataclass(slots=True)
class _Run:
    """One going through the drives."""

    job: Job
    record: Record
    executor: Executor
    told: Told | None
    summary: RunSummary = field(init=False)
    due: list[tuple[float, int, int]] = field(default_factory=list)
    """When [s of the clock], which drive, for the how many-th time."""
    rows: dict[int, Row] = field(default_factory=dict)
    prints: dict[int, str] = field(default_factory=dict)
    name: str = field(default_factory=lambda: secrets.token_hex(4))
    """Tells drafts of this run from those that a worker of an earlier one may still be writing."""
    warming: Warming = field(default_factory=Warming)

    def __post_init__(self) -> None:
        asked = _asked(self.job)
        rows = [row for row in self.record.rows() if _key(row.input, row.part) in asked]
        self.rows = {row.number: row for row in rows}
        counts = Counter(row.state for row in rows)
        done = counts[State.DONE]
        self.summary = RunSummary(
            output=str(self.record.folder), verb=self.job.verb, total=len(rows), done=done, skipped=done
        )
        self.due = [(0.0, row.number, 1) for row in rows if row.state is not State.DONE]
        heapq.heapify(self.due)

    def go(self) -> RunSummary:
        """Do what is due until nothing is left."""
        begun = time.monotonic()
        running = 0
        while self.due or running:
            while self._may_begin(running):
                _, number, attempt = heapq.heappop(self.due)
                self._begin(number, attempt)
                running += 1
            if not running:
                patience = self.due[0][0] - time.monotonic() if self.executor.free else _LOOK_SECONDS
                time.sleep(max(min(patience, _LOOK_SECONDS), 0.0))
                continue
            for task, outcome in self.executor.finished(_LOOK_SECONDS):
                running -= 1
                self.warming.end()
                self._end(task, outcome)
                self.summary = msgspec.structs.replace(
                    self.summary,
                    seconds=time.monotonic() - begun,
                    processor_seconds=self.summary.processor_seconds + outcome.processor_seconds,
                )
                if self.told is not None:
                    self.told(self.summary, outcome)
        return self.summary

    def _may_begin(self, running: int) -> bool:
        if not self.due or not self.executor.free or self.due[0][0] > time.monotonic():
            return False
        return not running or not self.warming.goes_on()

    def _begin(self, number: int, attempt: int) -> None:
        row = self.rows[number]
        self.record.begin(number, attempt)
        self.prints[number] = fingerprint(row.input)
        draft = self.record.drafts / f"{self.name}-{number}-{attempt}" / row.output
        options = {**self.job.options, **row.part}
        self.executor.submit(
            Task(
                number=number,
                attempt=attempt,
                call=self.job.call,
                place=row.input,
                draft=draft,
                options=options,
            )
        )

    def _end(self, task: Task, outcome: Outcome) -> None:
        if not outcome.error:
            outcome = self._accepted(task, outcome)
        shutil.rmtree(task.draft.parent, ignore_errors=True)
        now = time.time_ns()
        if not outcome.error:
            self.record.end(
                outcome,
                State.DONE,
                finished_ns=now,
                fingerprint=self.prints[task.number],
                configuration=_configuration(self.job, self.rows[task.number].part),
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
        """Move an output to its place, with what else the verb wrote beside it."""
        row = self.rows[task.number]
        if not task.draft.exists():
            told = f"{row.input}: {self.job.verb} ended without its output {row.output}"
            return msgspec.structs.replace(outcome, error=told, kind="Missing")
        try:
            for made in sorted(task.draft.parent.iterdir(), key=lambda path: path == task.draft):
                _move(made, self.record.folder / made.name)
        except OSError as error:
            told = f"{error.filename}: cannot be moved to its place: {error.strerror}"
            return msgspec.structs.replace(outcome, error=told, kind=type(error).__name__)
        return outcome

    def _count(self, **more: int) -> None:
        changed = {name: getattr(self.summary, name) + count for name, count in more.items()}
        self.summary = msgspec.structs.replace(self.summary, **changed)


def _move(made: Path, place: Path) -> None:
    """Put something in its place in one step; a folder that is there steps aside first."""
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place) if not made.is_dir() else place.rename(made.with_name(f"{made.name}.before"))
    made.replace(place)
