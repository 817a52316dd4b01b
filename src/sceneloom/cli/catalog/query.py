"""`sceneloom catalog query`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.printing import print_json, print_table

if TYPE_CHECKING:
    from sceneloom.catalog.database import Result, Selection

FORMS = ("table", "json", "csv", "list")


@click.command()
@click.argument("catalogue", type=click.Path(path_type=Path))
@click.option("--sql", metavar="TEXT", help="One statement that reads, instead of filters.")
@click.option(
    "--label",
    "labels",
    multiple=True,
    metavar="NAME",
    help="Boxes of this class, `*` allowed; may be stated again.",
)
@click.option(
    "--type", "types", type=click.Choice(["cuboid", "box_2d"]), multiple=True, help="Boxes of this type."
)
@click.option(
    "--after",
    "start",
    metavar="T",
    help="Not before T: seconds of the drive, or a date and time (UTC unless stated).",
)
@click.option("--before", "stop", metavar="T", help="Before T.")
@click.option(
    "--near",
    type=(options.finite, options.finite, options.not_negative),
    metavar="LAT LON METRES",
    help="The ego no farther from a location.",
)
@click.option(
    "--speed",
    type=(options.not_negative, options.not_negative),
    metavar="MIN MAX",
    help="The ego so fast, in m/s; `inf` for no bound.",
)
@click.option(
    "--distance",
    type=(options.not_negative, options.not_negative),
    metavar="MIN MAX",
    help="Boxes so far from the ego, in metres.",
)
@click.option("--count", type=click.IntRange(1), metavar="N", help="At least N such boxes at one time.")
@click.option(
    "--attribute",
    "attributes",
    multiple=True,
    metavar="NAME=VALUE",
    help="An attribute of the scene, a sensor or the box has this value then; may be stated again.",
)
@click.option(
    "--finding", "findings", multiple=True, metavar="RULE", help="`validate` found this; may be stated again."
)
@click.option(
    "--show",
    type=click.Choice(["spans", "drives", "rows"]),
    default="spans",
    show_default=True,
    help="Time spans in which all filters hold, drives that have such, or each box (or frame).",
)
@click.option(
    "--gap",
    type=options.not_negative,
    default=1.0,
    show_default=True,
    metavar="S",
    help="Join spans so near.",
)
@click.option(
    "--margin", type=options.not_negative, default=0.0, show_default=True, metavar="S", help="Widen spans."
)
@click.option("--limit", type=click.IntRange(1), metavar="N", help="At most N rows.")
@click.option(
    "--as",
    "form",
    type=click.Choice(FORMS),
    help="`list`: drives and spans as lines that the verbs of `sceneloom batch` take with --list. [default: table]",
)
@options.printing
def query(
    catalogue: Path,
    sql: str | None,
    show: str,
    gap: float,
    margin: float,
    limit: int | None,
    form: str | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **filters: Any,
) -> None:
    """Ask a catalogue: drives and time spans in which all filters hold, or what SQL says.

    SQL sees the tables `scenes`, `sensors`, `frames`, `annotations`, `tracks`, `attributes` and `findings`, joined by
    `scene`; it can read them and nothing else.
    """
    del quiet, verbose
    if sql is not None and any(value not in {None, ()} for value in filters.values()):
        raise click.UsageError("--sql takes the position of filters: state them in its WHERE")
    from sceneloom.catalog.database import query as query_catalogue

    wanted = sql if sql is not None else _selection(filters)
    result = query_catalogue(catalogue, wanted, show=show, gap=gap, margin=margin, limit=limit)
    _PRINTED[form or ("json" if as_json else "table")](result)


def _selection(filters: dict[str, Any]) -> "Selection":
    from sceneloom.catalog.database import Selection

    pairs = [pair.partition("=") for pair in filters.pop("attributes")]
    for name, sign, value in pairs:
        if not (name and sign):
            raise click.BadParameter(
                f"{name + sign + value!r}; expected NAME=VALUE", param_hint="--attribute"
            )
    return Selection(attributes=tuple((name, value) for name, _, value in pairs), **filters)


def _print_rows(result: "Result") -> None:
    from sceneloom.catalog.database import format_cell

    print_table([result.columns, *([format_cell(value) for value in row] for row in result.rows)], indent="")


def _print_json(result: "Result") -> None:
    from sceneloom.catalog.database import records

    print_json(records(result))


def _print_csv(result: "Result") -> None:
    from sceneloom.catalog.database import format_csv

    click.echo(format_csv(result), nl=False)


def _print_list(result: "Result") -> None:
    from sceneloom.catalog.database import iter_list

    for line in iter_list(result):
        click.echo(line)


_PRINTED = {"table": _print_rows, "json": _print_json, "csv": _print_csv, "list": _print_list}
