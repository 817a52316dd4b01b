"""`sceneloom catalog build`."""

from pathlib import Path
from typing import Any

import click

from sceneloom.cli import options
from sceneloom.cli.catalog.telling import checks, lists, named_drives, print_report, workers
from sceneloom.cli.printing import progress_bar


@click.command()
@click.argument("drives", nargs=-1, metavar="DRIVES...")
@click.option(
    "-o", "--output", type=options.target, required=True, metavar="OUT", help="Folder of the catalogue."
)
@lists
@click.option("--overwrite", is_flag=True, help="Replace a catalogue that exists.")
@checks
@workers
@options.reading
@options.printing
def build(
    drives: tuple[str, ...],
    output: Path,
    lists: tuple[Path, ...],
    overwrite: bool,
    checks: str,
    workers: int | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **reading: Any,
) -> int:
    """Make a catalogue of drives: scenes, sensors, frames, annotations, tracks, attributes and findings as tables.

    Drives are paths, patterns in quotes, URLs, or the lines of a list. One that cannot be read is reported, and the
    others go on; exit 1 then.
    """
    from sceneloom.catalog.building import build as build_catalogue

    named = named_drives(drives, lists, reading, quiet=quiet)
    with progress_bar("reading drives", quiet=quiet) as progress:
        report = build_catalogue(
            named,
            output,
            overwrite=overwrite,
            checks=checks,
            workers=workers,
            progress=progress,
        )
    return print_report(report, as_json=as_json, verbose=verbose)
