"""What the record of a run says as a whole: throughput, what was slow, why drives failed, who worked."""

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.batch.jobs import State
from sceneloom.batch.record import Record, Row

_MOST_BINS = 60
_MOST_SHOWN = 20
_REST = "everything else"
"""Starting, importing, compiling, and what no stage is told of."""
_NUMBERS = re.compile(r"\d+(?:\.\d+)?")


class Span(msgspec.Struct, frozen=True, kw_only=True):
    """Drives that ended between two times of a run.

    Attributes:
        start, stop: since the run began [s].
        done, failed: how many.
    """

    start: float
    stop: float
    done: int
    failed: int


class Cause(msgspec.Struct, frozen=True, kw_only=True):
    """One reason of which drives failed.

    Attributes:
        kind: name of the error's class.
        error: what it said of the first drive.
        drives: all that failed of it.
    """

    kind: str
    error: str
    drives: tuple[str, ...]


class WorkerFigures(msgspec.Struct, frozen=True, kw_only=True):
    """What one worker did.

    Attributes:
        name: host and process.
        drives: whose last try was with it.
        seconds, processor_seconds: that these took [s].
        peak_bytes: the most memory it had.
    """

    name: str
    drives: int
    seconds: float
    processor_seconds: float
    peak_bytes: int


class RunFigures(msgspec.Struct, frozen=True, kw_only=True):
    """A run as a whole; drives that an earlier run did are in it, with when they ended.

    Attributes:
        folder, verb, version: of the run.
        states: how many drives are in each.
        tries: of all drives together.
        begun_ns, ended_ns: when the first try began and the last one ended [ns since 1970]; None before.
        spans: drives that ended, over time.
        slowest: the drives that took longest, and their seconds by the clock.
        causes: why drives failed, the most frequent first.
        stages: seconds of each stage over all drives, and of the rest.
        workers: who worked, by name.
        drive_seconds: of all ended drives, in order [s].
    """

    folder: str
    verb: str
    version: str
    states: Mapping[str, int]
    tries: int
    begun_ns: int | None
    ended_ns: int | None
    spans: tuple[Span, ...]
    slowest: tuple[tuple[str, float], ...]
    causes: tuple[Cause, ...]
    stages: Mapping[str, float]
    workers: tuple[WorkerFigures, ...]
    drive_seconds: tuple[float, ...]

    @property
    def seconds(self) -> float:
        """From the first try's begin to the last one's end [s]."""
        return (
            0.0 if self.begun_ns is None or self.ended_ns is None else (self.ended_ns - self.begun_ns) / 1e9
        )

    @property
    def total(self) -> int:
        """Drives of the run."""
        return sum(self.states.values())


def read_figures(folder: Path) -> RunFigures:
    """Read what the record in a folder says, while the run goes on, too.

    Raises:
        DataError: there is no record of a run.
    """
    with Record.opened(folder) as record:
        told, rows = record.told(), record.rows()
        reports = {row.number: record.report(row.number) for row in rows if row.state is State.DONE}
    ended = [row for row in rows if row.finished_ns is not None]
    begun = min((_begun_ns(row) for row in ended), default=None)
    return RunFigures(
        folder=str(folder),
        verb=str(told.get("verb", "")),
        version=str(told.get("sceneloom", "")),
        states={str(state): sum(row.state is state for row in rows) for state in State},
        tries=sum(row.attempts for row in rows),
        begun_ns=begun,
        ended_ns=max((row.finished_ns or 0 for row in ended), default=None),
        spans=_spans(ended, begun or 0),
        slowest=_slowest(ended),
        causes=_causes(row for row in rows if row.state is State.FAILED),
        stages=_stages(rows, reports),
        workers=_workers(ended),
        drive_seconds=tuple(sorted(row.seconds or 0.0 for row in ended)),
    )


def _begun_ns(row: Row) -> int:
    return (row.finished_ns or 0) - round((row.seconds or 0.0) * 1e9)


def _spans(ended: Sequence[Row], begun_ns: int) -> tuple[Span, ...]:
    """Cut the run into equal spans, of which there are fewer than drives."""
    times = [((row.finished_ns or 0) - begun_ns) / 1e9 for row in ended]
    if not times:
        return ()
    count = max(min(_MOST_BINS, len(times) // 3), 1)
    width = max(*times, 1e-3) / count
    found: list[Counter[State]] = [Counter() for _ in range(count)]
    for row, when in zip(ended, times, strict=True):
        found[min(int(when / width), count - 1)][row.state] += 1
    return tuple(
        Span(start=k * width, stop=(k + 1) * width, done=one[State.DONE], failed=one[State.FAILED])
        for k, one in enumerate(found)
    )


def _slowest(ended: Iterable[Row]) -> tuple[tuple[str, float], ...]:
    slow = sorted(ended, key=lambda row: -(row.seconds or 0.0))
    return tuple((row.name, row.seconds or 0.0) for row in slow[:_MOST_SHOWN])


def _causes(failed: Iterable[Row]) -> tuple[Cause, ...]:
    """Put those together whose errors differ in names of drives and in numbers only."""
    alike: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row in failed:
        alike[row.kind or "", _NUMBERS.sub("#", _last_line(row).replace(row.input, "…"))].append(row)
    most = sorted(alike.items(), key=lambda item: -len(item[1]))
    return tuple(
        Cause(kind=kind, error=_last_line(rows[0]), drives=tuple(row.name for row in rows))
        for (kind, _), rows in most
    )


def _last_line(row: Row) -> str:
    lines = (row.error or "").strip().splitlines()
    return lines[-1] if lines else ""


def _stages(rows: Iterable[Row], reports: Mapping[int, Any]) -> dict[str, float]:
    found: dict[str, float] = defaultdict(float)
    for row in rows:
        told = reports.get(row.number)
        if not isinstance(told, dict) or row.seconds is None:
            continue
        stages, own = told.get("stages"), told.get("seconds")
        if isinstance(stages, dict):
            for name, value in stages.items():
                found[str(name)] += _seconds(value)
            found[_REST] += max(row.seconds - sum(map(_seconds, stages.values())), 0.0)
        elif own is not None:
            found["the verb at work"] += _seconds(own)
            found[_REST] += max(row.seconds - _seconds(own), 0.0)
    return dict(found)


def _seconds(value: Any) -> float:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else 0.0


def _workers(ended: Iterable[Row]) -> tuple[WorkerFigures, ...]:
    theirs: dict[str, list[Row]] = defaultdict(list)
    for row in ended:
        if row.worker:
            theirs[row.worker].append(row)
    return tuple(
        WorkerFigures(
            name=name,
            drives=len(rows),
            seconds=sum(row.seconds or 0.0 for row in rows),
            processor_seconds=sum(row.processor_seconds or 0.0 for row in rows),
            peak_bytes=max(row.peak_bytes or 0 for row in rows),
        )
        for name, rows in sorted(theirs.items())
    )
