"""Results for people on standard output, progress and warnings on standard error."""

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click
import msgspec

if TYPE_CHECKING:  # a verb that reads no drive starts quickly without them
    from sceneloom.formats.base.losses import LossReport
    from sceneloom.warnings import DataWarning

SHOWN = 5
"""Warnings and losses shown unless `--verbose` is stated."""


def print_json(result: Any, *, stages: Mapping[str, float] | None = None) -> None:
    """Print a result for machines; with the seconds of its stages, where these were taken (`sceneloom.stages`)."""
    if stages is not None:
        result = {**msgspec.to_builtins(result), "stages": dict(stages)}
    try:
        text = msgspec.json.format(msgspec.json.encode(result), indent=2).decode()
    except UnicodeEncodeError:
        # a path may hold bytes that are no Unicode; this encoder escapes them
        text = json.dumps(msgspec.to_builtins(result), indent=2)
    click.echo(text)


def print_warnings(warnings: "Sequence[DataWarning]", *, verbose: bool) -> None:
    """Print what was assumed, repaired or left out; what was made of corrections first."""
    warnings = sorted(warnings, key=lambda warning: not warning.code.startswith("correction-"))
    print_lines(
        [
            ": ".join(filter(None, (warning.kind, warning.location, warning.message)))
            + (f" ({warning.count} times)" if warning.count > 1 else "")
            for warning in warnings
        ],
        verbose=verbose,
    )


def print_corrections(warnings: "Sequence[DataWarning]") -> None:
    """Print only what was made of a drive's corrections, for verbs whose results hold the other warnings."""
    print_warnings([warning for warning in warnings if warning.code.startswith("correction-")], verbose=True)


_HAPPENED = {
    "kept": "note",
    "converted": "converted",
    "approximated": "approximated",
    "dropped": "lost",
}
"""What a line about a loss begins with."""


def print_losses(losses: "LossReport", *, verbose: bool) -> None:
    """Print what the target format has no field for: lost, or kept where only we look for it."""
    print_lines(
        [
            f"{'kept aside' if loss.kept else _HAPPENED[loss.support]}: {loss.field}: {loss.what}"
            + (f" ({loss.count} times)" if loss.count > 1 else "")
            + (f"; it is in {loss.kept}" if loss.kept else "")
            for loss in losses
        ],
        verbose=verbose,
    )


def print_lines(lines: Sequence[str], *, verbose: bool) -> None:
    """Print notes, only the first ones unless `verbose`."""
    shown = lines if verbose else lines[:SHOWN]
    for line in shown:
        click.echo(line, err=True)
    if len(lines) > len(shown):
        click.echo(f"… and {len(lines) - len(shown)} more: state --verbose", err=True)


def print_table(rows: Iterable[Sequence[str]], *, indent: str = "  ", err: bool = False) -> None:
    """Print rows in columns; `err`: as a note, not as a result."""
    table = [list(row) for row in rows]
    if not table:
        return
    widths = [max(len(row[k]) for row in table if k < len(row)) for k in range(max(map(len, table)))]
    for row in table:
        cells = [cell.ljust(widths[k]) for k, cell in enumerate(row)]
        click.echo((indent + "  ".join(cells)).rstrip(), err=err)


@contextmanager
def progress_bar(title: str, *, quiet: bool) -> Iterator[Callable[[int, int], None] | None]:
    """Show a bar on standard error while work goes on; nothing where that is not a terminal."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def several(count: int, noun: str, plural: str | None = None) -> str:
    """A count with its noun: "1 sweep", "3 sweeps"; `plural` where that is more than an s."""
    return f"{count} {noun}" if count == 1 else f"{count} {plural or f'{noun}s'}"


def seconds(timestamp_ns: int) -> str:
    """A time in seconds with all its nanoseconds."""
    whole, part = divmod(abs(timestamp_ns), 1_000_000_000)
    return f"{'-' if timestamp_ns < 0 else ''}{whole}.{part:09d} s"


def amount(size_bytes: int) -> str:
    """Bytes in a unit that reads well."""
    size = float(size_bytes)
    for unit in ("bytes", "kB", "MB", "GB"):
        if size < 1000 or unit == "GB":
            return f"{size:.0f} {unit}" if unit == "bytes" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} TB"
