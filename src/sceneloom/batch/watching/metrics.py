"""A run as text for Prometheus: a file that is written anew every few seconds, for node exporter's text collector.

Source: Prometheus, "Exposition formats", text format 0.0.4.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sceneloom.batch.jobs import Outcome
from sceneloom.batch.running import RunSummary
from sceneloom.formats.output import replacing

_EVERY_SECONDS = 5.0
_ESCAPES = str.maketrans({"\\": "\\\\", '"': '\\"', "\n": "\\n"})


def format_metrics(
    summary: RunSummary,
    *,
    peak_bytes: int = 0,
    stages: Mapping[str, float] | None = None,
    now: float | None = None,
) -> str:
    """Say how a run stands.

    Args:
        summary: how it stands.
        peak_bytes: the most memory that any of its workers had.
        stages: seconds of each stage over all drives [s].
        now: when that was so [s since 1970]; by default, now.
    """
    run = f'verb="{summary.verb.translate(_ESCAPES)}",output="{summary.output.translate(_ESCAPES)}"'
    states = {"done": summary.done, "failed": summary.failed, "left": summary.left}
    lines = ["# HELP sceneloom_batch_drives Drives of the run.", "# TYPE sceneloom_batch_drives gauge"]
    lines += [f'sceneloom_batch_drives{{{run},state="{state}"}} {count}' for state, count in states.items()]
    for name, kind, told, value in (
        ("skipped", "gauge", "Drives that an earlier run had done.", summary.skipped),
        ("retries_total", "counter", "Tries beyond the first ones.", summary.retried),
        ("run_seconds", "gauge", "How long the run has taken.", summary.seconds),
        ("processor_seconds_total", "counter", "Of all workers' processors.", summary.processor_seconds),
        ("worker_peak_bytes", "gauge", "The most memory that any worker had.", peak_bytes),
        ("updated_timestamp_seconds", "gauge", "When this was written.", time.time() if now is None else now),
    ):
        full = f"sceneloom_batch_{name}"
        lines += [f"# HELP {full} {told}", f"# TYPE {full} {kind}", f"{full}{{{run}}} {value}"]
    if stages:
        full = "sceneloom_batch_stage_seconds_total"
        lines += [f"# HELP {full} By the clock, in each stage of the work.", f"# TYPE {full} counter"]
        lines += [
            f'{full}{{{run},stage="{name.translate(_ESCAPES)}"}} {taken}' for name, taken in stages.items()
        ]
    return "\n".join(lines) + "\n"


@dataclass(slots=True)
class MetricsFile:
    """The file, which is told of each try and is written anew at most every few seconds.

    Attributes:
        path: of the file; one that is there is replaced.
    """

    path: Path
    _peak_bytes: int = 0
    _stages: dict[str, float] = field(default_factory=dict)
    _due: float = field(default=0.0)

    def told(self, summary: RunSummary, outcome: Outcome) -> None:
        """Take in what came of a try."""
        self._peak_bytes = max(self._peak_bytes, outcome.peak_bytes)
        told = outcome.report.get("stages") if isinstance(outcome.report, dict) else None
        for name, taken in told.items() if isinstance(told, dict) else ():
            self._stages[name] = self._stages.get(name, 0.0) + taken
        if time.monotonic() >= self._due or not summary.left:
            self.write(summary)

    def write(self, summary: RunSummary) -> None:
        """Write how the run stands, in one step.

        Raises:
            OutputError: the file cannot be written.
        """
        with replacing(self.path, overwrite=True) as draft:
            draft.write_text(
                format_metrics(summary, peak_bytes=self._peak_bytes, stages=self._stages), encoding="utf-8"
            )
        self._due = time.monotonic() + _EVERY_SECONDS
