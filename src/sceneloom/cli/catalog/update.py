"""`sceneloom catalog update`."""

from pathlib import Path
from typing import Any

import click

from sceneloom.cli import options
from sceneloom.cli.catalog.telling import checks, lists, named_drives, print_report, workers
from sceneloom.cli.printing import progress_bar


@click.command()
@click.argument("catalogue", type=click.Path(path_type=Path))
@click.argument("drives", nargs=-1, metavar="[DRIVES...]")
@lists
@click.option("--prune", is_flag=True, help="Take out drives that are not there any more.")
@checks
@workers
@options.reading
@options.printing
def update(
    catalogue: Path,
    drives: tuple[str, ...],
    lists: tuple[Path, ...],
    prune: bool,
    checks: str,
    workers: int | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **reading: Any,
) -> int:
    """Bring a catalogue up to date: drives that are new or have changed are read, no other is touched.

    Without drives, all that stand in the catalogue are looked at, and read as they were before. One that cannot be
    read is reported, and what stood of it stays; exit 1 then.
    """
    from sceneloom.catalog.building import update as update_catalogue

    named = named_drives(drives, lists, reading, quiet=quiet) if drives or lists else []
    with progress_bar("looking at drives", quiet=quiet) as progress:
        report = update_catalogue(
            catalogue,
            named,
            prune=prune,
            checks=checks,
            workers=workers,
            progress=progress,
        )
    return print_report(report, as_json=as_json, verbose=verbose)
