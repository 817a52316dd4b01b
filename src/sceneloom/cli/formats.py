"""`sceneloom formats`."""

import click

from sceneloom.cli.printing import print_json, print_table


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def formats(as_json: bool) -> None:
    """List the formats that can be read and written."""
    from sceneloom.formats.table import format_named, format_names

    known = {name: list(format_named(name).suffixes) for name in format_names()}
    if as_json:
        print_json(known)
    else:
        print_table(
            (name, " ".join(suffix or "a folder" for suffix in suffixes)) for name, suffixes in known.items()
        )
