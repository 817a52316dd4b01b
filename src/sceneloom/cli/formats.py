"""`sceneloom formats`."""

from pathlib import Path

import click

from sceneloom.cli.printing import print_json, print_table


@click.command()
@click.option(
    "--template",
    type=click.Path(path_type=Path),
    metavar="rig.toml",
    help="Write a manifest to fill in, for a folder of your own clouds and pictures; `-` prints it.",
)
@click.option(
    "--from",
    "folder",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Look into the folder, and write the template for what is in it.",
)
@click.option("--overwrite", is_flag=True, help="Replace a template that exists.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def formats(template: Path | None, folder: Path | None, overwrite: bool, as_json: bool) -> None:
    """List the formats that can be read and written, or begin a `rig.toml` for your own data."""
    if template is not None:
        _write_template(template, folder, overwrite=overwrite)
        return
    if folder is not None or overwrite:
        raise click.UsageError(
            f"{'--from' if folder else '--overwrite'} does nothing without --template rig.toml"
        )
    from sceneloom.formats.table import format_named, format_names
    from sceneloom.formats.trajectories import TRAJECTORY_FORMS

    known = {name: list(format_named(name).suffixes) for name in format_names()}
    if as_json:
        print_json(known)
    else:
        print_table(
            (name, " ".join(suffix or "a folder" for suffix in suffixes)) for name, suffixes in known.items()
        )
        click.echo("files of trajectories (`sceneloom convert`, `sceneloom eval trajectory`)")
        print_table(
            (name, " ".join(form.suffixes) or f"--to {name}", form.looks_like)
            for name, form in TRAJECTORY_FORMS.items()
        )


def _write_template(path: Path, folder: Path | None, *, overwrite: bool) -> None:
    from sceneloom.formats.rig.template import template_text, write_template

    if str(path) == "-":
        click.echo(template_text(folder=folder), nl=False)
        return
    write_template(path, folder=folder, overwrite=overwrite)
    click.echo(f"{path}: fill in what is `nan`, then `sceneloom info {path}` says what is left to do")
