"""One verb over many drives: what is due is handed to workers, what they made is put in its location and recorded.

A try writes into a folder of its own. Once it has ended well the output is put in its location, in one step, and then
the record says that the drive is done: whatever is killed in between, an output is there whole or not at all, and a run
that is taken up again makes anew what the record does not know as done.
"""

import heapq
import secrets
import shutil
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import gettempdir

import msgspec

from sceneloom.batch.further import bring, check_further
from sceneloom.batch.jobs import Input, Job, Outcome, State, Task
from sceneloom.batch.outputs import Outputs, record_folder
from sceneloom.batch.pool import Executor, ProcessPool
from sceneloom.batch.preparing import (
    asked_drives,
    configuration,
    drive_key,
    files_of,
    further_locations,
    open_outputs,
    prepare,
)
from sceneloom.batch.record import Record, Row
from sceneloom.batch.warming import Warming
from sceneloom.batch.working import draft_of
from sceneloom.errors import OptionError, OutputError
from sceneloom.formats.urls import is_url

Reported = Callable[["RunSummary", Outcome], None]
"""Is reported how far a run is, and what came of the last try."""

_LOOK_SECONDS = 0.5
_PATIENCE_SECONDS = (1.0, 5.0, 20.0)
"""How long a drive is left alone before its second try, its third, and all further ones."""
_QUICK = frozenset({"Lost"})
"""After these a drive is tried again at once."""


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
    check_further(job.further, store)
    folder = (record or record_folder(store)) if store else Path(output)
    with ExitStack() as ending:
        ending.callback(pool.stop)
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder}: is a file; expected a folder or a new name")
        folder.mkdir(parents=True, exist_ok=True)
        held = ending.enter_context(Record.held(folder))
        outputs = open_outputs(store, held, resume=resume)
        prepare(job, held, outputs)
        going = _Run(job, held, outputs, pool, reported)
        ending.callback(shutil.rmtree, going.drafts, ignore_errors=True)
        ending.callback(pool.stop)  # before its drafts go
        return going.go()


@dataclass(slots=True)
class _Run:
    """One going through the drives."""

    job: Job
    record: Record
    outputs: Outputs
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
        asked = asked_drives(self.job)
        rows = [row for row in self.record.rows() if drive_key(row.input, row.part) in asked]
        self.rows = {row.number: row for row in rows}
        self.meant = {row.number: asked[drive_key(row.input, row.part)] for row in rows}
        counts = Counter(row.state for row in rows)
        done = counts[State.DONE]
        self.summary = RunSummary(
            output=self.outputs.name, record=str(self.record.folder), verb=self.job.verb, total=len(rows),
            done=done, skipped=done,
        )  # fmt: skip
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
                further=further_locations(self.job, row.output),
                files=files_of(self.job, self.meant[number]),
            )
        )

    def _end(self, task: Task, outcome: Outcome) -> None:
        if not outcome.error:
            outcome = self._accepted(task, outcome)
        shutil.rmtree(draft_of(task).parent, ignore_errors=True)
        now = time.time_ns()
        if not outcome.error:
            self.record.end(
                outcome,
                State.DONE,
                finished_ns=now,
                fingerprint=outcome.fingerprint,
                configuration=configuration(self.job, self.meant[task.number], self.rows[task.number].part),
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
                bring(task.draft, task.further)
            self.outputs.accept(task)
        except OSError as error:
            reported = f"{error.filename}: cannot be moved to its location: {error.strerror}"
            return msgspec.structs.replace(outcome, error=reported, kind=type(error).__name__)
        return outcome

    def _count(self, **more: int) -> None:
        changed = {name: getattr(self.summary, name) + count for name, count in more.items()}
        self.summary = msgspec.structs.replace(self.summary, **changed)
