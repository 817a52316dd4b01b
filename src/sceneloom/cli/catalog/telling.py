"""What the verbs that write catalogues share: options, and how the result is reported."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.printing import print_json, print_lines, several

if TYPE_CHECKING:
    from sceneloom.catalog.building import CatalogReport, Drive, Failure

checks = click.option(
    "--checks",
    type=click.Choice(["none", "quick", "full"]),
    default="quick",
    show_default=True,
    help="How drives are checked for the table of findings; `full` reads every frame.",
)
workers = click.option(
    "--workers",
    type=click.IntRange(1, 1024),
    metavar="N",
    help="Processes that read drives, each with one thread. [default: one for each processor, if drives are many]",
)
lists = options.lists('a path, or {"path": …, "reading": {"sequence": …}}')


def named_drives(
    locations: Sequence[str], lists: Sequence[Path], reading: Mapping[str, Any], *, quiet: bool
) -> "list[Drive]":
    """The drives that a command names, and how each is opened, which lists may state; whole ones only."""
    from sceneloom.batch.jobs import READING
    from sceneloom.catalog.building import Drive
    from sceneloom.cli.batch.listed import find_listed

    found = find_listed("catalog", locations, lists, reading=reading, quiet=quiet)
    stated = options.stated(**reading)
    return [
        Drive(
            drive.location,
            stated
            | {
                name.removeprefix(READING): value
                for name, value in drive.options.items()
                if name.startswith(READING)
            },
        )
        for drive in found
    ]


def print_report(report: "CatalogReport", *, as_json: bool, verbose: bool) -> int:
    """Report what building or updating did; gives the exit code."""
    if as_json:
        print_json(report)
        return int(bool(report.failed))
    parts = [
        f"{count} {word}"
        for word, count in (
            ("new", len(report.added)),
            ("read again", len(report.changed)),
            ("unchanged", report.unchanged),
            ("taken out", len(report.removed)),
            ("failed", len(report.failed)),
        )
        if count
    ]
    click.echo(
        f"{report.catalogue}: {several(report.scenes, 'scene')}: {', '.join(parts) or 'nothing to do'}"
    )
    print_lines([f"failed: {_reported(failure)}" for failure in report.failed], verbose=verbose)
    print_lines(
        [f"not there any more: {path}; `--prune` takes it out" for path in report.gone], verbose=verbose
    )
    return int(bool(report.failed))


def _reported(failure: "Failure") -> str:
    """Errors of files begin with their path already; of a fault of ours the last line says what it is."""
    text = (failure.error.strip().splitlines() or [""])[-1]
    return text if text.startswith(failure.path) else f"{failure.path}: {text}"
