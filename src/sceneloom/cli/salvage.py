"""`sceneloom salvage`."""

from pathlib import Path

import click

from sceneloom.cli import options
from sceneloom.cli.printing import amount, print_json, print_lines, print_table, several


@click.command()
@click.argument("path", type=options.location)
@click.option("-o", "--output", type=options.target, required=True, help="The .sfs file to write.")
@click.option("--overwrite", is_flag=True, help="Replace outputs that exist.")
@options.printing
def salvage(
    path: Path | str, output: Path, overwrite: bool, as_json: bool, quiet: bool, verbose: bool
) -> None:
    """Take out of a scene file that was cut off or damaged what is whole, and state what is not."""
    from sceneloom.formats.sfs.salvage import salvage as salvage_file

    report = salvage_file(path, output, overwrite=overwrite)
    if as_json:
        print_json(report)
        return
    click.echo(f"{report.source}, {amount(report.size_bytes)} → {report.output}")
    print_table(
        (str(sensor.id), sensor.type, f"{sensor.kept} of {sensor.count}" if sensor.count else "")
        for sensor in report.sensors
    )
    click.echo(several(report.annotations, "annotation"))
    if not report.lost:
        click.echo("nothing is lost")
        return
    click.echo(f"lost: {several(len(report.lost), 'part')}, {amount(report.lost_bytes)}")
    if not quiet:
        lines = [f"lost: {part.location}: {part.problem} ({amount(part.bytes)})" for part in report.lost]
        print_lines(lines, verbose=verbose)
