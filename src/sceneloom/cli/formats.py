"""`sceneloom formats`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sceneloom.cli import options
from sceneloom.cli.help import Verb
from sceneloom.cli.options import option
from sceneloom.cli.printing import Printer, print_table
from sceneloom.cli.running import verb

if TYPE_CHECKING:
    from sceneloom.formats.base.losses import Holding
    from sceneloom.formats.listing import FormatListing


@click.command(cls=Verb, examples=("", "--template my_drive/rig.toml --from my_drive"))
@click.argument("name", required=False)
@option(
    "--template=rig.toml",
    "Write a manifest to fill in, for a folder of your own clouds and images; `-` prints it.",
    click.Path(path_type=Path),
)
@option("--from=FOLDER folder", "Write the template for what is in this folder.", options.source())
@option("--overwrite", "Replace a template that exists.")
@verb
def formats(name: str | None, template: Path | None, folder: Path | None, overwrite: bool, printer: Printer) -> None:
    """List the formats, the supported fields of one, or begin a `rig.toml` for your own data.

    With NAME: what becomes of each field of a scene that is written in that format.
    """
    if template is not None:
        _write_template(template, folder, overwrite=overwrite)
        return
    if folder is not None or overwrite:
        raise click.UsageError(f"{'--from' if folder else '--overwrite'} does nothing without --template rig.toml")
    if name is not None:
        from sceneloom.formats.listing import list_supported_fields

        printer.show(list_supported_fields(name), _print_supported_fields, name)
        return
    from sceneloom.formats.listing import list_formats

    printer.show(list_formats(), _print_formats)


def _print_formats(known: "Sequence[FormatListing]", printer: Printer) -> None:
    if printer.quiet:
        click.echo("\n".join(form.name for form in known))
        return
    print_table(_row(form) for form in known if not form.trajectory)
    click.echo("files of one trajectory")
    print_table(_row(form) for form in known if form.trajectory)


def _row(form: "FormatListing") -> tuple[str, str, str, str]:
    both = "read, written" if form.reads and form.writes else "only read" if form.reads else "only written"
    # a suffix says what to write; what is only read is known by its content
    suffixes = " ".join(suffix or "folder" for suffix in form.suffixes) or f"--to {form.name}"
    return form.name, both, suffixes if form.writes else "", form.looks_like


def _print_supported_fields(found: "Mapping[str, Holding]", name: str, _: Printer) -> None:
    from sceneloom.formats.base.losses import Support

    if not found:
        from sceneloom.formats.base.registry import format_named

        click.echo(f"{name} is only read: {format_named(name).looks_like}")
    for support in Support:
        rows = [(field, how.how) for field, how in found.items() if how.support == support]
        if rows:
            click.echo(f"{support} ({len(rows)})")
            print_table(rows)


def _write_template(path: Path, folder: Path | None, *, overwrite: bool) -> None:
    from sceneloom.formats.rig.template import template_text, write_template

    if str(path) == "-":
        click.echo(template_text(folder=folder), nl=False)
        return
    write_template(path, folder=folder, overwrite=overwrite)
    click.echo(f"{path}: fill in what is `nan`, then `sceneloom info {path}` says what is left to do")
