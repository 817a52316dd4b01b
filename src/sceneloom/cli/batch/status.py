"""`sceneloom batch status`, and how a run is reported when it ends."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from sceneloom.cli import options
from sceneloom.cli.printing import print_json, print_table, several

if TYPE_CHECKING:
    from sceneloom.batch.record import Row
    from sceneloom.batch.running import RunSummary

_SHOWN = 5


@click.command()
@click.argument("output", type=options.location)
@click.option(
    "--record",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Folder of the record of a run into a store, if it is not where it is by default.",
)
@click.option("--html", type=options.target, metavar="FILE", help="Write a page about the run as well.")
@click.option("--overwrite", is_flag=True, help="Replace outputs that exist.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
@click.option("-q", "--quiet", is_flag=True, help="Only how many, no failures.")
@click.option("-v", "--verbose", is_flag=True, help="Every drive, not only the failures.")
def status(
    output: Path | str,
    record: Path | None,
    html: Path | None,
    overwrite: bool,
    as_json: bool,
    quiet: bool,
    verbose: bool,
) -> None:
    """Report how the run into OUTPUT, a folder or a URL, stands, while it goes on, too."""
    from dataclasses import asdict

    from sceneloom.batch.jobs import State
    from sceneloom.batch.outputs import record_folder
    from sceneloom.batch.record import Record
    from sceneloom.batch.running import read_figures, write_page
    from sceneloom.errors import redacted

    folder = record or (record_folder(output) if isinstance(output, str) else output)
    with Record.opened(folder) as opened:
        reported, rows = opened.reported(), opened.rows()
    figures = read_figures(folder)
    if html is not None:
        write_page(figures, html, overwrite=overwrite)
    if as_json:
        print_json({"run": reported, "stages": figures.stages, "drives": [asdict(row) for row in rows]})
        return
    counts = {state: sum(row.state is state for row in rows) for state in State}
    parts = ", ".join(f"{count} {state}" for state, count in counts.items() if count)
    click.echo(
        f"{redacted(output)}: {reported.get('verb', '')} over {several(len(rows), 'drive')}: {parts or 'none'}"
    )
    if quiet:
        return
    stages = sorted(figures.stages.items(), key=lambda stage: -stage[1])
    if stages:
        click.echo("  " + ", ".join(f"{name} {seconds:.1f} s" for name, seconds in stages))
    shown = rows if verbose else [row for row in rows if row.state is State.FAILED]
    print_table(
        [
            (
                row.state,
                row.name,
                "" if row.seconds is None else f"{row.seconds:.1f} s",
                _why(row),
            )
            for row in shown
        ]
    )
    if html is not None:
        click.echo(f"page: {html}")


def print_summary(summary: "RunSummary", *, verbose: bool) -> None:
    """Report how a run ended, and what to do about failures."""
    from sceneloom.batch.jobs import State
    from sceneloom.batch.record import Record

    parts = [f"{summary.done} done"]
    parts += [f"{summary.skipped} of them before and unchanged"] if summary.skipped else []
    parts += [f"{summary.failed} failed"] if summary.failed else []
    parts += [several(summary.retried, "further try", "further tries")] if summary.retried else []
    click.echo(
        f"{summary.verb}: {several(summary.total, 'drive')} in {summary.seconds:.1f} s: {', '.join(parts)}"
    )
    together = summary.record == summary.output
    click.echo(f"outputs{' and record' if together else ''}: {summary.output}")
    if not together:
        click.echo(f"record: {summary.record}")
    if not summary.failed:
        return
    with Record.opened(Path(summary.record)) as record:
        failed = record.rows(State.FAILED)
    for row in failed if verbose else failed[:_SHOWN]:
        click.echo(f"failed: {row.name}: {_why(row)}", err=True)
    if not verbose and len(failed) > _SHOWN:
        click.echo(f"… and {len(failed) - _SHOWN} more: `sceneloom batch status {summary.record}`", err=True)
    click.echo("next: repair what failed, then state the same with `--resume`", err=True)


def _why(row: "Row") -> str:
    """The last line of an error, without the drive that it begins with."""
    lines = (row.error or "").strip().splitlines()
    return lines[-1].removeprefix(f"{row.input}: ") if lines else ""
