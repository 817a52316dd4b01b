"""`sceneloom batch status`, and how a run is told when it ends."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from sceneloom.cli import options
from sceneloom.cli.printing import print_json, print_table, several

if TYPE_CHECKING:
    from sceneloom.batch import RunSummary

_SHOWN = 5


@click.command()
@click.argument("output", type=click.Path(path_type=Path))
@click.option("--html", type=options.target, metavar="FILE", help="Write a page about the run as well.")
@click.option("--overwrite", is_flag=True, help="Replace outputs that exist.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
@click.option("-q", "--quiet", is_flag=True, help="Only how many, no failures.")
@click.option("-v", "--verbose", is_flag=True, help="Every drive, not only the failures.")
def status(
    output: Path, html: Path | None, overwrite: bool, as_json: bool, quiet: bool, verbose: bool
) -> None:
    """Say how the run in the folder OUTPUT stands, while it goes on, too."""
    from dataclasses import asdict

    from sceneloom.batch.jobs import State
    from sceneloom.batch.record import Record

    with Record.opened(output) as record:
        told, rows = record.told(), record.rows()
    if html is not None:
        from sceneloom.batch.watching import read_figures, write_page

        write_page(read_figures(output), html, overwrite=overwrite)
    if as_json:
        print_json({"run": told, "drives": [asdict(row) for row in rows]})
        return
    counts = {state: sum(row.state is state for row in rows) for state in State}
    parts = ", ".join(f"{count} {state}" for state, count in counts.items() if count)
    click.echo(f"{output}: {told.get('verb', '')} over {several(len(rows), 'drive')}: {parts or 'none'}")
    if quiet:
        return
    shown = rows if verbose else [row for row in rows if row.state is State.FAILED]
    print_table(
        [
            (
                row.state,
                row.input,
                "" if row.seconds is None else f"{row.seconds:.1f} s",
                _last_line(row.error),
            )
            for row in shown
        ]
    )


def print_summary(summary: "RunSummary", output: Path, *, verbose: bool) -> None:
    """Say how a run ended, and what to do about failures."""
    from sceneloom.batch.jobs import State
    from sceneloom.batch.record import Record

    parts = [f"{summary.done} done"]
    parts += [f"{summary.skipped} of them before and unchanged"] if summary.skipped else []
    parts += [f"{summary.failed} failed"] if summary.failed else []
    parts += (
        [f"{several(summary.retried, 'further try').replace('trys', 'tries')}"] if summary.retried else []
    )
    click.echo(
        f"{summary.verb}: {several(summary.total, 'drive')} in {summary.seconds:.1f} s: {', '.join(parts)}"
    )
    click.echo(f"outputs and record: {output}")
    if not summary.failed:
        return
    with Record.opened(output) as record:
        failed = record.rows(State.FAILED)
    for row in failed if verbose else failed[:_SHOWN]:
        click.echo(f"failed: {row.input}: {_last_line(row.error)}", err=True)
    if not verbose and len(failed) > _SHOWN:
        click.echo(f"… and {len(failed) - _SHOWN} more: `sceneloom batch status {output}`", err=True)
    click.echo("next: mend what failed, then say the same with `--resume`", err=True)


def _last_line(error: str | None) -> str:
    lines = (error or "").strip().splitlines()
    return lines[-1] if lines else ""
