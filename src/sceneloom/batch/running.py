"""Run one verb over many drives, resume a run, and report its statistics."""

import heapq
import re
import secrets
import shutil
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import UTC, datetime
from hashlib import blake2b
from html import escape
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import msgspec

from sceneloom.batch.jobs import Input, Job, Outcome, State, Task, output_names, with_files
from sceneloom.batch.outputs import (
    Locations,
    Outputs,
    bring,
    check_further,
    check_locations,
    claimed,
    record_folder,
)
from sceneloom.batch.record import Record, Row
from sceneloom.batch.workers import Executor, ProcessPool, Warming, draft_of
from sceneloom.errors import OptionError, OutputError, redacted
from sceneloom.formats.base.files import fingerprint, is_url
from sceneloom.formats.base.output import replacing
from sceneloom.version import __version__

_DriveKey = tuple[str, tuple[tuple[str, Any], ...]]
"""What reports drives apart: where they are, and what counts for them alone."""

_SIDE_BY_SIDE = 16
"""How many drives are looked at together."""


def _open_outputs(store: str, record: Record, *, resume: bool) -> Outputs:
    """Give where outputs go; a record belongs to one location for good.

    Args:
        store: a location in a store; "" for the folder of the record.
        record: of the run.
        resume: whether it may have drives already.

    Raises:
        OutputError: it has, or the location is that of another run.
    """
    known, drives = record.reported(), len(record.rows())
    before, now = known.get("store", ""), redacted(store)
    if before != now and drives:
        location = before or "it"
        raise OutputError(
            f"{record.folder}: holds the record of a run with outputs in {location}; name another one"
        )
    if drives and not resume:
        raise OutputError(
            f"{record.folder}: holds a run over {drives} drives already; `--resume` goes on with it, "
            "or choose another folder"
        )
    record.notify("store", now)
    if not store:
        return Outputs(str(record.folder))
    name = known.get("run") or secrets.token_hex(8)
    record.notify("run", name)
    return claimed(store, run=name, record=record.folder)


def _prepare(job: Job, record: Record, outputs: Outputs) -> None:
    """Enter the drives, and let those be done anew that changed.

    Raises:
        OutputError: a file that is no output of the run has the name of one.
        OptionError: drives differ in secrets of their addresses only, or two outputs of one in nothing.
        DataError: the server of a drive does not answer.
    """
    locations = Locations()
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
        check_locations([f"{outputs.location.rstrip('/')}/{free}", *further.values()])
        for location in filter(locations.has, further.values()):
            raise OutputError(f"{redacted(location)}: exists already; choose another folder")
        taken.add(free)
        new.append((drive.name, drive.options, free))
    record.add(new)
    record.notify("verb", job.verb)
    record.notify("sceneloom", __version__)
    reported = {**job.options, **job.files}
    record.notify("options", {name: redacted(repr(value)) for name, value in reported.items()})
    meant = {row.number: asked[key] for key, row in known.items() if key in asked}
    done = _done_rows(
        job, outputs, record, {row.number: row for row in known.values() if row.number in meant}, meant
    )
    record.wait_again([number for number in meant if number not in done])


def _drive_key(location: str, part: Mapping[str, Any]) -> _DriveKey:
    """What reports a drive apart in the record."""
    return location, tuple(sorted(part.items()))


def _asked_drives(job: Job) -> dict[_DriveKey, Input]:
    """The drives by what the record reports them apart by."""
    found: dict[_DriveKey, Input] = {}
    for drive in job.inputs:
        if found.setdefault(_drive_key(drive.name, drive.options), drive).location != drive.location:
            raise OptionError(
                f"{drive.name}: two drives differ in secrets only, which no record keeps; do them apart"
            )
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
    job: Job, outputs: Outputs, record: Record, rows: Mapping[int, Row], meant: Mapping[int, Input]
) -> set[int]:
    """Drives that are done as the job wants them, where neither they nor their outputs changed since."""
    locations = Locations()

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
        once = list(
            dict.fromkeys(drive.location for drive in asked)
        )  # drives of a data set lie in one location
        seen = dict(zip(once, thread_pool.map(fingerprint, once), strict=True))
        now = thread_pool.map(lambda drive: with_files(seen[drive.location], _files_of(job, drive)), asked)
        return {
            number for number, found in zip(perhaps, now, strict=True) if found == rows[number].fingerprint
        }


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


_MOST_SHOWN = 20

_WRITE_EVERY_SECONDS = 5.0

_NUMBERS = re.compile(r"\d+(?:\.\d+)?")

_ESCAPES = str.maketrans({"\\": "\\\\", '"': '\\"', "\n": "\\n"})

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<meta name="viewport" content="width=device-width, initial-scale=1"><style>
:root {{ color-scheme: light dark; }}
body {{ margin: auto; max-width: 64rem; padding: 1rem; font: 16px/1.5 system-ui, sans-serif; overflow-wrap: anywhere; }}
table {{ border-collapse: collapse; width: 100%; }}
th, td {{ text-align: left; padding: .2rem .7rem .2rem 0; border-bottom: 1px solid #8886; vertical-align: top; }}
</style></head><body><h1>{title}</h1>
{body}
</body></html>
"""


class RunFigures(msgspec.Struct, frozen=True, kw_only=True):
    """A run as a whole, with the drives that an earlier run did.

    Attributes:
        folder, verb, version: of the run.
        states: number of drives in each state.
        tries: of all drives together.
        begun_ns, ended_ns: when the first try began and the last one ended [ns since 1970]; None before.
        slowest: the drives that took longest, and their seconds.
        causes: why drives failed, the most frequent first: class of the error, its text of the first drive, the drives.
        stages: seconds of each stage over all drives, and of the rest.
        workers: name, drives, seconds, seconds of its processor, most memory [byte].
        drive_seconds: of all drives that ended, in order [s].
    """

    folder: str
    verb: str
    version: str
    states: Mapping[str, int]
    tries: int
    begun_ns: int | None
    ended_ns: int | None
    slowest: tuple[tuple[str, float], ...]
    causes: tuple[tuple[str, str, tuple[str, ...]], ...]
    stages: Mapping[str, float]
    workers: tuple[tuple[str, int, float, float, int], ...]
    drive_seconds: tuple[float, ...]

    @property
    def seconds(self) -> float:
        """From the first begin to the last end [s]."""
        return ((self.ended_ns or 0) - (self.begun_ns or 0)) * 1e-9


def read_figures(folder: Path) -> RunFigures:
    """Read the record in a folder, also while the run goes on.

    Raises:
        DataError: there is no record of a run.
    """
    with Record.opened(folder) as record:
        run, rows = record.reported(), record.rows()
        reports = {row.number: record.report(row.number) for row in rows if row.state is State.DONE}
    ended = [row for row in rows if row.finished_ns is not None]
    begun_ns = min((_ended_ns(row) - round(_seconds(row.seconds) * 1e9) for row in ended), default=None)
    slowest = sorted(((row.name, _seconds(row.seconds)) for row in ended), key=lambda one: -one[1])
    return RunFigures(
        folder=str(folder),
        verb=str(run.get("verb", "")),
        version=str(run.get("sceneloom", "")),
        states={str(state): sum(row.state is state for row in rows) for state in State},
        tries=sum(row.attempts for row in rows),
        begun_ns=begun_ns,
        ended_ns=max(map(_ended_ns, ended), default=None),
        slowest=tuple(slowest[:_MOST_SHOWN]),
        causes=_causes(row for row in rows if row.state is State.FAILED),
        stages=_stages(rows, reports),
        workers=_workers(ended),
        drive_seconds=tuple(sorted(_seconds(row.seconds) for row in ended)),
    )


def write_page(figures: RunFigures, target: Path, *, overwrite: bool = False) -> None:
    """Write a page of HTML that needs nothing from elsewhere.

    Raises:
        OutputError: it exists, or cannot be written.
    """
    counts = ", ".join(f"{count} {state}" for state, count in figures.states.items() if count)
    facts = [f"{counts}; {figures.tries} tries", f"{figures.folder}, by sceneloom {figures.version}"]
    if figures.begun_ns is not None and figures.seconds > 0:
        begun, times = datetime.fromtimestamp(figures.begun_ns // 10**9, UTC), figures.drive_seconds
        rate = 60.0 * len(times) / figures.seconds
        facts.append(
            f"begun {begun:%Y-%m-%d %H:%M:%S} UTC; {figures.seconds:.0f} s; {rate:.1f} drives a minute"
        )
        facts.append(f"a drive: median {times[len(times) // 2]:.1f} s, at most {times[-1]:.1f} s")
    stages = sorted(figures.stages.items(), key=lambda stage: -stage[1])
    causes = [(len(drives), f"{kind}: {error}", drives[0]) for kind, error, drives in figures.causes]
    workers = [
        (n, f"{a:.1f}", f"{b:.1f}", f"{most / 1e6:.0f}", name) for name, n, a, b, most in figures.workers
    ]
    body = [f"<p>{escape(fact)}</p>" for fact in facts]
    body += _table("Why drives failed", ("drives", "cause", "first"), causes)
    body += _table("Time by stage", ("stage", "seconds"), [(name, f"{taken:.1f}") for name, taken in stages])
    body += _table(
        "Slowest drives", ("drive", "seconds"), [(name, f"{taken:.1f}") for name, taken in figures.slowest]
    )
    body += _table("Workers", ("drives", "seconds", "of processor", "most memory [MB]", "worker"), workers)
    title = escape(f"{figures.verb} over {sum(figures.states.values())} drives")
    with replacing(target, overwrite=overwrite) as draft:
        draft.write_text(_PAGE.format(title=title, body="\n".join(body)), encoding="utf-8")


def format_metrics(
    summary: RunSummary,
    *,
    peak_bytes: int = 0,
    stages: Mapping[str, float] | None = None,
    now: float | None = None,
) -> str:
    """Give the state of a run as text for Prometheus.

    Args:
        summary: of the run.
        peak_bytes: the most memory that any of its workers had.
        stages: seconds of each stage over all drives [s].
        now: when that was so [s since 1970]; by default, now.

    Source: Prometheus, "Exposition formats", text format 0.0.4.
    """
    run = {"verb": summary.verb, "output": summary.output}
    states = {"done": summary.done, "failed": summary.failed, "left": summary.left}
    updated = time.time() if now is None else now
    none: dict[str, str] = {}
    metrics: list[tuple[str, str, str, list[tuple[dict[str, str], float]]]] = [
        ("drives", "gauge", "Drives of the run.", [({"state": name}, n) for name, n in states.items()]),
        ("skipped", "gauge", "Drives that an earlier run had done.", [(none, summary.skipped)]),
        ("retries_total", "counter", "Tries beyond the first ones.", [(none, summary.retried)]),
        ("run_seconds", "gauge", "How long the run has taken.", [(none, summary.seconds)]),
        ("processor_seconds_total", "counter", "Of all workers' processors.", [(none, summary.processor_seconds)]),
        ("worker_peak_bytes", "gauge", "The most memory that any worker had.", [(none, peak_bytes)]),
        ("updated_timestamp_seconds", "gauge", "When this was written.", [(none, updated)]),
        ("stage_seconds_total", "counter", "Wall time of each stage of the work.",
         [({"stage": name}, taken) for name, taken in (stages or {}).items()]),
    ]  # fmt: skip
    lines = []
    for name, kind, reported, samples in metrics:
        full = f"sceneloom_batch_{name}"
        lines += [f"# HELP {full} {reported}", f"# TYPE {full} {kind}"] if samples else []
        for own, value in samples:
            labels = ",".join(f'{key}="{text.translate(_ESCAPES)}"' for key, text in {**run, **own}.items())
            lines.append(f"{full}{{{labels}}} {value}")
    return "\n".join(lines) + "\n"


@dataclass(slots=True)
class MetricsFile:
    """A file of metrics for node exporter's textfile collector, written anew at most every few seconds.

    Attributes:
        path: of the file; one that is there is replaced.
    """

    path: Path
    _peak_bytes: int = 0
    _stages: Counter[str] = field(default_factory=Counter)
    _due: float = 0.0

    def reported(self, summary: RunSummary, outcome: Outcome) -> None:
        """Count the outcome of a try, and write the file when it is due.

        Raises:
            OutputError: the file cannot be written.
        """
        self._peak_bytes = max(self._peak_bytes, outcome.peak_bytes)
        stages = outcome.report.get("stages") if isinstance(outcome.report, dict) else None
        self._stages.update(stages if isinstance(stages, dict) else {})
        if time.monotonic() < self._due and summary.left:
            return
        with replacing(self.path, overwrite=True) as draft:
            text = format_metrics(summary, peak_bytes=self._peak_bytes, stages=self._stages)
            draft.write_text(text, encoding="utf-8")
        self._due = time.monotonic() + _WRITE_EVERY_SECONDS


def _ended_ns(row: Row) -> int:
    return row.finished_ns or 0


def _seconds(value: Any) -> float:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else 0.0


def _causes(failed: Iterable[Row]) -> tuple[tuple[str, str, tuple[str, ...]], ...]:
    """Group errors that differ in names of drives and in numbers only."""
    alike: dict[tuple[str, str], list[tuple[str, str]]] = defaultdict(list)
    for row in failed:
        text = ((row.error or "").strip().splitlines() or [""])[-1]
        alike[row.kind or "", _NUMBERS.sub("#", text.replace(row.input, "…"))].append((text, row.name))
    most = sorted(alike.items(), key=lambda item: -len(item[1]))
    return tuple((kind, rows[0][0], tuple(name for _, name in rows)) for (kind, _), rows in most)


def _stages(rows: Iterable[Row], reports: Mapping[int, Any]) -> dict[str, float]:
    """Add up the stages of all drives; the rest is starting, importing, compiling and what has no stage."""
    found: dict[str, float] = defaultdict(float)
    for row in rows:
        report = reports.get(row.number)
        if not isinstance(report, dict) or row.seconds is None:
            continue
        stages = report.get("stages")
        if not isinstance(stages, dict):
            if report.get("seconds") is None:
                continue
            stages = {"the verb at work": report["seconds"]}
        for name, value in stages.items():
            found[str(name)] += _seconds(value)
        found["everything else"] += max(row.seconds - sum(map(_seconds, stages.values())), 0.0)
    return dict(found)


def _workers(ended: Iterable[Row]) -> tuple[tuple[str, int, float, float, int], ...]:
    rows: dict[str, list[Row]] = defaultdict(list)
    for row in ended:
        if row.worker:
            rows[row.worker].append(row)
    return tuple(
        (
            name,
            len(own),
            sum(_seconds(row.seconds) for row in own),
            sum(_seconds(row.processor_seconds) for row in own),
            max(row.peak_bytes or 0 for row in own),
        )
        for name, own in sorted(rows.items())
    )


def _table(title: str, heads: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    """A table with its title; nothing without rows."""
    head = "".join(f'<th scope="col">{escape(one)}</th>' for one in heads)
    body = "".join(f"<tr>{''.join(f'<td>{escape(str(cell))}</td>' for cell in row)}</tr>\n" for row in rows)
    return [f"<h2>{escape(title)}</h2>\n<table>\n<tr>{head}</tr>\n{body}</table>"] if rows else []
