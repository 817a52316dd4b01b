"""Run one verb over many drives and resume a run: where outputs go, which drives are due, tries and their ends."""

import heapq
import os
import secrets
import shutil
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import UTC, datetime
from hashlib import blake2b
from pathlib import Path
from tempfile import gettempdir
from typing import Any
from urllib.parse import unquote

import msgspec

from sceneloom.batch.jobs import Further, Input, Job, Outcome, State, Task, output_names, with_files
from sceneloom.batch.record import Record, Row
from sceneloom.batch.workers import Executor, ProcessPool, Warming, bring, draft_of, put
from sceneloom.errors import OptionError, OutputError, redacted
from sceneloom.formats.base.files import fingerprint, is_url
from sceneloom.version import __version__

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
            put(task.draft, Path(self.location))


class _Claim(msgspec.Struct, frozen=True, kw_only=True):
    """What says in a store whose outputs lie there."""

    run: str  # its name, which its record knows, too
    record: str  # where that is
    host: str  # on which machine
    begun: str


def claimed(url: str, *, run: str, record: Path) -> _Outputs:
    """Claim a location in a store for the run of one record.

    Two runs that begin within the same moment are distinguished where the store refuses to put an object twice, as S3,
    Cloud Storage and Azure do; where it does not, the later one may take the claim while the other one goes on.

    Args:
        url: the location.
        run: name of the run.
        record: where its record is.

    Raises:
        OutputError: the outputs of another run lie there, or the store cannot be written to.
        MissingExtraError: what writes to such addresses is not installed.
    """
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


def record_folder(url: str) -> Path:
    """Where the record of a run is by default whose outputs lie in a store: in a folder of the user's own state.

    Source: XDG Base Directory Specification 0.8, `XDG_STATE_HOME`.
    """
    state = os.environ.get("XDG_STATE_HOME", "")
    base = Path(state) if Path(state).is_absolute() else Path.home() / ".local" / "state"
    shown = redacted(url).rstrip("/")
    name = shown.rpartition("/")[2]
    reported = "".join(sign if sign.isalnum() or sign in "-_." else "_" for sign in name).lstrip(".")[:60]
    return base / "sceneloom" / "runs" / f"{reported}-{blake2b(shown.encode(), digest_size=4).hexdigest()}"


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
    for drive, name in zip(job.inputs, output_names(job.inputs, job.suffix), strict=True):
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
        now = thread_pool.map(lambda drive: with_files(seen[drive.location], _files_of(job, drive)), asked)
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
    folder = (record or record_folder(store)) if store else Path(output)
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
        shutil.rmtree(draft_of(task).parent, ignore_errors=True)
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
                bring(task.draft, task.further)
            self.outputs.accept(task)
        except OSError as error:
            reported = f"{error.filename}: cannot be moved to its location: {error.strerror}"
            return msgspec.structs.replace(outcome, error=reported, kind=type(error).__name__)
        return outcome

    def _count(self, **more: int) -> None:
        changed = {name: getattr(self.summary, name) + count for name, count in more.items()}
        self.summary = msgspec.structs.replace(self.summary, **changed)
