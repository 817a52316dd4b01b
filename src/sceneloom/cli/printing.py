"""Results on standard output, progress and warnings on standard error."""

import json
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import click
import msgspec

if TYPE_CHECKING:  # a verb that reads no drive starts quickly without them
    from sceneloom.formats.base.losses import Loss
    from sceneloom.warnings import DataWarning

SHOWN = 5
"""Warnings and losses shown unless `--verbose` is stated."""
_LOSSES = {"dropped": "lost", "approximated": "approximated", "converted": "converted", "kept": "note"}
"""What a line about a loss begins with; what matters most comes first, and what is kept aside before converted."""


@dataclass(frozen=True, slots=True)
class Printer:
    """Prints what a verb found, as `--json`, `--quiet` and `--verbose` state."""

    as_json: bool = False
    quiet: bool = False
    verbose: bool = False

    def show(
        self, result: Any, to_people: Callable[..., None], *arguments: Any, stages: Mapping[str, float] | None = None
    ) -> None:
        """Print a result as JSON, or by a function that takes it, `arguments` and this printer."""
        if self.as_json:
            print_json(result, stages=stages)
        else:
            to_people(result, *arguments, self)

    @contextmanager
    def progress(self, title: str) -> Iterator[Callable[[int, int], None] | None]:
        """Show a bar on standard error while work goes on; nothing where that is not a terminal."""
        if self.quiet or not sys.stderr.isatty():
            yield None
            return
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(title, total=None)
            yield lambda done, total: bar.update(task, completed=done, total=total)

    def warnings(self, warnings: "Sequence[DataWarning]") -> None:
        """Print what was assumed, repaired or left out; what was made of corrections first."""
        self.notes(
            [
                ": ".join(filter(None, (warning.kind, warning.location, warning.message))) + times(warning.count)
                for warning in sorted(warnings, key=lambda warning: not _is_correction(warning))
            ]
        )

    def corrections(self, warnings: "Sequence[DataWarning]") -> None:
        """Print only what was made of a drive's corrections, for verbs whose results hold the other warnings."""
        Printer(quiet=self.quiet, verbose=True).warnings(list(filter(_is_correction, warnings)))

    def losses(self, losses: "Iterable[Loss]") -> None:
        """Print what the target format has no field for: lost, or kept where only we look for it."""
        self.notes(
            [
                f"{'kept aside' if loss.kept else _LOSSES[loss.support]}: {loss.field}: {loss.what}"
                + times(loss.count)
                + (f"; it is in {loss.kept}" if loss.kept else "")
                for loss in sorted(losses, key=_rank)
            ]
        )

    def remarks(self, report: Any) -> None:
        """Print what a lenient reading skipped, warnings and losses, as far as a report has them."""
        self.notes([f"skipped: {reason}" for reason in getattr(report, "skipped", ())])
        self.warnings(report.warnings)
        self.losses(getattr(report, "losses", ()))

    def blind(self, cameras: Iterable[str]) -> None:
        """Print which cameras see nothing of what the lidars see, as with most wrong extrinsics."""
        if names := ", ".join(cameras):
            where = "where they look is in `sceneloom info`: is the mounting right?"
            self.notes([f"assumed: no point falls into the images of {names}; {where}"])

    def notes(self, lines: Sequence[str]) -> None:
        """Print lines on standard error; unless `--verbose` is stated, like ones as one, and only the first ones."""
        if self.quiet:
            return
        lines = lines if self.verbose else _folded(lines)
        shown = lines if self.verbose else lines[:SHOWN]
        for line in shown:
            word, colon, rest = line.partition(":")
            click.echo(f"{marked(word)}{colon}{rest}", err=True)
        if len(lines) > len(shown):
            click.echo(f"… and {len(lines) - len(shown)} more: `--verbose` lists them", err=True)


def _rank(loss: "Loss") -> float:
    return 1.5 if loss.kept else list(_LOSSES).index(loss.support)


def _folded(lines: Sequence[str]) -> list[str]:
    """Lines in a row that differ in numbers only, as one: "000013.png is missing (and 82 like it, to 000095)"."""
    folded = []
    for _, group in groupby(lines, key=lambda line: re.sub(r"\d+", "0", line)):
        first, *others = group
        if len(others) < 2:
            folded += [first, *others]
            continue
        numbers = zip(re.findall(r"\d+", first), re.findall(r"\d+", others[-1]), strict=True)
        last = [end for start, end in numbers if start != end][-1:]
        folded.append(f"{first} (and {len(others)} like it{''.join(f', to {end}' for end in last)})")
    return folded


def _is_correction(warning: "DataWarning") -> bool:
    return warning.code.startswith("correction-")


def print_json(result: Any, *, stages: Mapping[str, float] | None = None) -> None:
    """Print a result for machines; with the seconds of its stages, where these were taken (`sceneloom.stages`)."""
    if stages is not None:
        result = {**msgspec.to_builtins(result), "stages": dict(stages)}
    try:
        text = msgspec.json.format(msgspec.json.encode(result), indent=2).decode()
    except UnicodeEncodeError:
        # a path may hold bytes that are not Unicode; this encoder escapes them
        text = json.dumps(msgspec.to_builtins(result), indent=2)
    click.echo(text)


def print_table(rows: Iterable[Sequence[str]], *, indent: str = "  ", err: bool = False) -> None:
    """Print rows in columns; `err`: on standard error."""
    table = [list(row) for row in rows]
    if not table:
        return
    widths = [max(len(row[k]) for row in table if k < len(row)) for k in range(max(map(len, table)))]
    for row in table:
        cells = [cell.ljust(widths[k]) for k, cell in enumerate(row)]
        click.echo((indent + "  ".join(cells)).rstrip(), err=err)


def print_outputs(outputs: Mapping[str, Any], files: Mapping[str, int]) -> None:
    """Print what each kind of output is written to, and of how many files it is."""
    for kind, location in outputs.items():
        if location is not None:
            wrote(location, {kind.removesuffix("s"): files[kind]} if kind in files else {})


def several(count: int, noun: str, plural: str | None = None) -> str:
    """A count with its noun: "1 sweep", "3 sweeps"; `plural` where that is more than an s."""
    return f"{count} {noun}" if count == 1 else f"{count} {plural or f'{noun}s'}"


def times(count: int) -> str:
    """How often something was found, in brackets; nothing of what was found once."""
    return f" ({count} times)" if count > 1 else ""


def seconds(timestamp_ns: int) -> str:
    """A time in seconds with all its nanoseconds."""
    whole, part = divmod(abs(timestamp_ns), 1_000_000_000)
    return f"{'-' if timestamp_ns < 0 else ''}{whole}.{part:09d} s"


def wrote(output: Path | str, counts: Mapping[str, int] = MappingProxyType({}), *, remark: str = "") -> None:
    """Say what a verb wrote, and how large it is: "wrote 12 sweeps and 12 images to drive.mcap, 24.1 MB"."""
    path = Path(output)
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    size = f", {amount(sum(file.stat().st_size for file in files))}" if files else ""
    several_files = f", {several(len(files), 'file')}" if path.is_dir() else ""
    names = [several(count, noun, _PLURALS.get(noun)) for noun, count in counts.items() if count]
    listed = " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))
    what = f"{listed} to {output}" if listed else str(output)
    click.echo(f"wrote {what}{several_files}{size}{remark and f'; {remark}'}")


_PLURALS = {"trajectory": "trajectories"}

_COLOURS = {
    **dict.fromkeys(("passed", "good"), "green"),
    **dict.fromkeys(
        ("assumed", "skipped", "repaired", "approximated", "kept aside", "warning", "drifting", "next"), "yellow"
    ),
    **dict.fromkeys(("lost", "not passed", "wrong", "error", "sceneloom"), "red"),
}  # what marks lines and verdicts on a terminal


def marked(word: str) -> str:
    """A verdict, or the word that a line begins with, in its colour on a terminal; as it is where NO_COLOR is set.

    Source: no-color.org.
    """
    colour = None if os.environ.get("NO_COLOR") else _COLOURS.get(word)
    return word if colour is None else click.style(word, fg=colour, bold=colour == "red")


def amount(size_bytes: int) -> str:
    """Bytes in a unit that reads well."""
    size = float(size_bytes)
    for unit in ("bytes", "kB", "MB", "GB"):
        if size < 1000 or unit == "GB":
            return f"{size:.0f} {unit}" if unit == "bytes" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} TB"
