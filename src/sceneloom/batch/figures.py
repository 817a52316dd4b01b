"""Statistics of a run: a page of HTML from its record, and metrics for Prometheus while it goes on."""

import re
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import Any, Self

import msgspec

from sceneloom.batch.jobs import Outcome, State
from sceneloom.batch.record import Record, Row
from sceneloom.batch.running import RunSummary
from sceneloom.formats.base.output import replacing

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

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read the record in a folder, also while the run goes on.

        Raises:
            DataError: there is no record of a run.
        """
        with Record.opened(folder) as record:
            run, rows = record.reported(), record.rows()
            reports = {row.number: record.report(row.number) for row in rows if row.state is State.DONE}
        ended = [row for row in rows if row.finished_ns is not None]
        seconds = {row.number: row.seconds or 0.0 for row in ended}
        ends_ns = {row.number: row.finished_ns or 0 for row in ended}
        slowest = sorted(((row.name, seconds[row.number]) for row in ended), key=lambda one: -one[1])
        return cls(
            folder=str(folder),
            verb=str(run.get("verb", "")),
            version=str(run.get("sceneloom", "")),
            states={str(state): sum(row.state is state for row in rows) for state in State},
            tries=sum(row.attempts for row in rows),
            begun_ns=min((ends_ns[number] - round(taken * 1e9) for number, taken in seconds.items()), default=None),
            ended_ns=max(ends_ns.values(), default=None),
            slowest=tuple(slowest[:_MOST_SHOWN]),
            causes=_causes(row for row in rows if row.state is State.FAILED),
            stages=_stages(rows, reports),
            workers=_workers(ended),
            drive_seconds=tuple(sorted(seconds.values())),
        )

    def write_page(self, target: Path, *, overwrite: bool = False) -> None:
        """Write a page of HTML that needs nothing from elsewhere.

        Raises:
            OutputError: it exists, or cannot be written.
        """
        counts = ", ".join(f"{count} {state}" for state, count in self.states.items() if count)
        facts = [f"{counts}; {self.tries} tries", f"{self.folder}, by sceneloom {self.version}"]
        if self.begun_ns is not None and self.seconds > 0:
            begun, times = datetime.fromtimestamp(self.begun_ns // 10**9, UTC), self.drive_seconds
            rate = 60.0 * len(times) / self.seconds
            facts.append(f"begun {begun:%Y-%m-%d %H:%M:%S} UTC; {self.seconds:.0f} s; {rate:.1f} drives a minute")
            facts.append(f"a drive: median {times[len(times) // 2]:.1f} s, at most {times[-1]:.1f} s")
        stages = sorted(self.stages.items(), key=lambda stage: -stage[1])
        tables: Mapping[str, tuple[tuple[str, ...], Sequence[Sequence[object]]]] = {
            "Why drives failed": (
                ("drives", "cause", "first"),
                [(len(drives), f"{kind}: {error}", drives[0]) for kind, error, drives in self.causes],
            ),
            "Time by stage": (("stage", "seconds"), [(name, f"{taken:.1f}") for name, taken in stages]),
            "Slowest drives": (("drive", "seconds"), [(name, f"{taken:.1f}") for name, taken in self.slowest]),
            "Workers": (
                ("drives", "seconds", "of processor", "most memory [MB]", "worker"),
                [(n, f"{a:.1f}", f"{b:.1f}", f"{most / 1e6:.0f}", name) for name, n, a, b, most in self.workers],
            ),
        }
        body = [f"<p>{escape(fact)}</p>" for fact in facts]
        for heading, (heads, rows) in tables.items():
            head = "".join(f'<th scope="col">{escape(one)}</th>' for one in heads)
            cells = ("".join(f"<td>{escape(str(cell))}</td>" for cell in row) for row in rows)
            lines = "".join(f"<tr>{one}</tr>\n" for one in cells)
            body += [f"<h2>{escape(heading)}</h2>\n<table>\n<tr>{head}</tr>\n{lines}</table>"] if rows else []
        title = escape(f"{self.verb} over {sum(self.states.values())} drives")
        with replacing(target, overwrite=overwrite) as draft:
            draft.write_text(_PAGE.format(title=title, body="\n".join(body)), encoding="utf-8")


def format_metrics(
    summary: RunSummary, *, peak_bytes: int = 0, stages: Mapping[str, float] | None = None, now: float | None = None
) -> str:
    """The state of a run as text for Prometheus.

    Args:
        summary: of the run.
        peak_bytes: the most memory that any of its workers had.
        stages: seconds of each stage over all drives [s].
        now: when that was so [s since 1970]; by default, now.

    Source: Prometheus, "Exposition formats", text format 0.0.4.
    """
    metrics: list[tuple[str, str, str, Mapping[str, float] | float]] = [
        ("drives", "gauge", "Drives of the run.",
         {"done": summary.done, "failed": summary.failed, "left": summary.left}),
        ("skipped", "gauge", "Drives that an earlier run had done.", summary.skipped),
        ("retries_total", "counter", "Tries beyond the first ones.", summary.retried),
        ("run_seconds", "gauge", "How long the run has taken.", summary.seconds),
        ("processor_seconds_total", "counter", "Of all workers' processors.", summary.processor_seconds),
        ("worker_peak_bytes", "gauge", "The most memory that any worker had.", peak_bytes),
        ("updated_timestamp_seconds", "gauge", "When this was written.", time.time() if now is None else now),
        ("stage_seconds_total", "counter", "Wall time of each stage of the work.", stages or {}),
    ]  # fmt: skip
    key, lines = {"drives": "state", "stage_seconds_total": "stage"}, []
    for name, kind, reported, value in metrics:
        full = f"sceneloom_batch_{name}"
        samples = list(value.items()) if isinstance(value, Mapping) else [("", value)]
        lines += [f"# HELP {full} {reported}", f"# TYPE {full} {kind}"] if samples else []
        for word, number in samples:
            own = {key[name]: word} if word else {}
            texts = {"verb": summary.verb, "output": summary.output, **own}
            labels = ",".join(f'{label}="{text.translate(_ESCAPES)}"' for label, text in texts.items())
            lines.append(f"{full}{{{labels}}} {number}")
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
            stages = {"the verb at work": report.get("seconds")}
        numbers = {str(name): float(one) for name, one in stages.items() if type(one) in (int, float)}
        if numbers or isinstance(report.get("stages"), dict):
            for name, value in numbers.items():
                found[name] += value
            found["everything else"] += max(row.seconds - sum(numbers.values()), 0.0)
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
            sum(row.seconds or 0.0 for row in own),
            sum(row.processor_seconds or 0.0 for row in own),
            max(row.peak_bytes or 0 for row in own),
        )
        for name, own in sorted(rows.items())
    )
