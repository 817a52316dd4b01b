"""`sceneloom catalog`: many drives in tables, and what is found in them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.help import Verbs
from sceneloom.cli.options import option
from sceneloom.cli.printing import Printer, print_json, print_table, several
from sceneloom.cli.running import reading_verb, verb

if TYPE_CHECKING:
    from sceneloom.catalog.building import CatalogReport, Drive
    from sceneloom.catalog.database import Result, Selection


@click.group(cls=Verbs)
def catalog() -> None:
    """Put many drives into tables (Parquet), and find drives and moments in them."""


_building = options.stacked(
    option(
        "--checks=none|quick|full", "Which rules fill the table of findings; `full` reads every frame.", default="quick"
    ),
    option(
        "--workers=N",
        "Processes that read drives, each with one thread. [default: one per processor, if drives are many]",
        click.IntRange(1, 1024),
    ),
)
_lists = options.lists('a path, or {"path": …, "reading": {"sequence": …}}')


@catalog.command(examples=("'drives/*.sfs' -o catalogue", "--list drives.txt -o catalogue"))
@click.argument("drives", nargs=-1, metavar="DRIVES...")
@option("-o --output=OUT", "Folder of the catalogue.", options.target, required=True, group="output")
@_lists
@option("--overwrite", "Replace a catalogue that exists.")
@_building
@reading_verb
def build(
    drives: tuple[str, ...], lists: tuple[Path, ...], printer: Printer, reading: dict[str, Any], **given: Any
) -> int:
    """Make a catalogue of drives: scenes, sensors, frames, annotations, tracks, attributes and findings as tables.

    Drives are paths, patterns in quotes, URLs, or the lines of a list. One that cannot be read is reported, and the
    others go on; exit 1 then.
    """
    from sceneloom.catalog.building import build as build_catalogue

    named = _named_drives(drives, lists, reading, quiet=printer.quiet)
    with printer.progress("reading drives") as progress:
        report = build_catalogue(named, given.pop("output"), progress=progress, **given)
    printer.show(report, _print_report)
    return int(bool(report.failed))


@catalog.command(examples=("catalogue 'drives/*.sfs'", "catalogue --list drives.txt"))
@click.argument("catalogue", type=click.Path(path_type=Path))
@click.argument("drives", nargs=-1, metavar="[DRIVES...]")
@_lists
@option("--prune", "Remove drives that are not there any more.")
@_building
@reading_verb
def update(
    catalogue: Path,
    drives: tuple[str, ...],
    lists: tuple[Path, ...],
    printer: Printer,
    reading: dict[str, Any],
    **given: Any,
) -> int:
    """Bring a catalogue up to date: drives that are new or have changed are read, no other is touched.

    Without drives, all in the catalogue are looked at, and read as they were before. One that cannot be read is
    reported, and what the catalogue had of it stays; exit 1 then.
    """
    from sceneloom.catalog.building import update as update_catalogue

    named = _named_drives(drives, lists, reading, quiet=printer.quiet) if drives or lists else []
    with printer.progress("looking at drives") as progress:
        report = update_catalogue(catalogue, named, progress=progress, **given)
    printer.show(report, _print_report)
    return int(bool(report.failed))


def _named_drives(
    locations: Sequence[str], lists: Sequence[Path], reading: Mapping[str, Any], *, quiet: bool
) -> "list[Drive]":
    """The drives that a command names, and how each is opened, which lists may state; whole ones only."""
    from sceneloom.catalog.building import Drive
    from sceneloom.cli.batch import find_listed, options_of

    found = find_listed("catalog", locations, lists, reading=reading, quiet=quiet)
    return [Drive(drive.location, {**reading, **options_of(drive)}) for drive in found]


def _print_report(report: "CatalogReport", printer: Printer) -> None:
    counts = {
        "new": len(report.added),
        "read again": len(report.changed),
        "unchanged": report.unchanged,
        "taken out": len(report.removed),
        "failed": len(report.failed),
    }
    parts = ", ".join(f"{count} {word}" for word, count in counts.items() if count)
    click.echo(f"{report.catalogue}: {several(report.scenes, 'scene')}: {parts or 'nothing to do'}")
    failures = []
    for failure in report.failed:  # errors of files begin with their path; of a fault of ours the last line says it
        text = (failure.error.strip().splitlines() or [""])[-1]
        failures.append(f"failed: {text if text.startswith(failure.path) else f'{failure.path}: {text}'}")
    always = Printer(verbose=printer.verbose)
    always.notes(failures)
    always.notes([f"not there any more: {path}; `--prune` takes it out" for path in report.gone])


@catalog.command(examples=("catalogue --label pedestrian --distance 0 20", "catalogue --sql 'SELECT path FROM scenes'"))
@click.argument("catalogue", type=click.Path(path_type=Path))
@option("--sql=TEXT", "One statement that reads, instead of filters.")
@option("--label=NAME… labels", "Boxes of this class, `*` allowed; may be repeated.")
@option("--type=cuboid|box_2d… types", "Boxes of this type.")
@option("--after=T start", "Not before T: seconds of the drive, or a date and time (UTC unless stated).")
@option("--before=T stop", "Before T.")
@option(
    "--near",
    "The ego no farther from a location.",
    (options.finite, options.finite, options.not_negative),
    metavar="LAT LON METRES",
)
@option(
    "--speed",
    "The ego so fast, in m/s; `inf` for no bound.",
    (options.not_negative, options.not_negative),
    metavar="MIN MAX",
)
@option(
    "--distance",
    "Boxes so far from the ego, in metres.",
    (options.not_negative, options.not_negative),
    metavar="MIN MAX",
)
@option("--count=N", "At least N such boxes at one time.", click.IntRange(1))
@option(
    "--attribute=NAME=VALUE… attributes",
    "An attribute of the scene, a sensor or the box has this value then; may be repeated.",
)
@option("--finding=RULE… findings", "`validate` found this; may be repeated.")
@option(
    "--show=spans|drives|rows",
    "Time spans in which all filters hold, drives that have such, or each box (or frame).",
    default="spans",
)
@option("--gap=S", "Join spans so near.", options.not_negative, default=1.0)
@option("--margin=S", "Widen spans.", options.not_negative, default=0.0)
@option("--limit=N", "At most N rows.", click.IntRange(1))
@option(
    "--as=table|json|csv|list form",
    "`list`: drives and spans as lines that the verbs of `sceneloom batch` take with --list. [default: table]",
)
@verb
def query(catalogue: Path, sql: str | None, form: str | None, printer: Printer, **filters: Any) -> None:
    """Query a catalogue: drives and time spans in which all filters hold, or SQL.

    SQL sees the tables `scenes`, `sensors`, `frames`, `annotations`, `tracks`, `attributes` and `findings`, joined by
    `scene`; it can read them and nothing else.
    """
    shown = {name: filters.pop(name) for name in ("show", "gap", "margin", "limit")}
    if sql is not None and any(value not in {None, ()} for value in filters.values()):
        raise click.UsageError("--sql replaces filters: put them into its WHERE clause")
    from sceneloom.catalog.database import query as query_catalogue

    wanted = sql if sql is not None else _selection(filters)
    result = query_catalogue(catalogue, wanted, **shown)
    _print_result(result, form or ("json" if printer.as_json else "table"))


def _print_result(result: "Result", form: str) -> None:
    from sceneloom.catalog.database import format_cell, format_csv, iter_list, records

    if form == "table":
        print_table([result.columns, *([format_cell(value) for value in row] for row in result.rows)], indent="")
    elif form == "json":
        print_json(records(result))
    elif form == "csv":
        click.echo(format_csv(result), nl=False)
    else:
        for line in iter_list(result):
            click.echo(line)


def _selection(filters: dict[str, Any]) -> "Selection":
    from sceneloom.catalog.database import Selection

    pairs = [pair.partition("=") for pair in filters.pop("attributes")]
    for name, sign, value in pairs:
        if not (name and sign):
            raise click.BadParameter(f"{name + sign + value!r}; expected NAME=VALUE", param_hint="--attribute")
    return Selection(attributes=tuple((name, value) for name, _, value in pairs), **filters)
