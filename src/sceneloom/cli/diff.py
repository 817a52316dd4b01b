"""`sceneloom diff`: what differs between two drives."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.help import Verb
from sceneloom.cli.options import option
from sceneloom.cli.printing import SHOWN, Printer, print_json, several
from sceneloom.cli.running import reading_verb

if TYPE_CHECKING:
    from sceneloom.editing.diff import Difference, SceneDifferences

_MARKS = {"added": "+", "removed": "-", "changed": "~"}
_MOST = 10 * SHOWN  # differences shown unless `--verbose` is stated


@click.command(cls=Verb, examples=("before.sfs after.sfs", "drive/ drive.sfs --tolerance-m 0.001 --json"))
@click.argument("first", type=options.location)
@click.argument("second", type=options.location)
@option("--tolerance-m=M", "Ignore distances up to this.", options.not_negative, default=0.0)
@option("--tolerance-deg=DEG", "Ignore rotations up to this.", options.not_negative, default=0.0)
@option("--tolerance-ns=NS", "Ignore differences of timestamps up to this.", options.not_negative, default=0.0)
@option("--tolerance-px=PX", "Ignore distances of pixels up to this.", options.not_negative, default=0.0)
@option("--other-timestamps", "Take paths that are sampled at other timestamps for equal if their positions are.")
@option("--pixels", "Decode images whose bytes differ, and compare their pixels.")
@reading_verb
def diff(first: Path | str, second: Path | str, printer: Printer, reading: dict[str, Any], **given: Any) -> int:
    """Report what differs between two drives, field by field; exit 0 where nothing does, 1 where something does."""
    from sceneloom.editing.diff import diff_scenes
    from sceneloom.formats.base.registry import open_scenes

    with open_scenes((first, second), reading) as (a, b), printer.progress("comparing") as progress:
        found = diff_scenes(a, b, progress=progress, **given)
    if printer.as_json:
        print_json({"equal": found.equal, "differences": found.differences, "not_compared": found.not_compared})
    else:
        _print(found, printer)
    return 0 if found.equal else 1


def _print(found: "SceneDifferences", printer: Printer) -> None:
    shown = found.differences if printer.verbose else found.differences[:_MOST]
    for difference in shown:
        click.echo(_line(difference))
    if len(shown) < len(found.differences):
        click.echo(f"… and {len(found.differences) - len(shown)} more: `--verbose` lists them")
    click.echo(several(len(found.differences), "difference") if found.differences else "equal")
    if not printer.quiet:
        for what in found.not_compared:
            click.echo(f"not compared: {what}", err=True)


def _line(difference: "Difference") -> str:
    """One difference: a mark, where, by how much, how."""
    amount = "" if difference.amount is None else f" by {difference.amount:.6g} {difference.unit}".rstrip()
    frames = ""
    if difference.frame is not None:
        which = "first" if difference.amount is None else "most"
        frames = f" in {several(difference.count, 'frame')}, {which} in frame {difference.frame}"
    mark = _MARKS[difference.change]
    return f"{mark} {difference.path}: {difference.change}{amount}{frames}: {difference.message}"
