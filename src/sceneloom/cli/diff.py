"""`sceneloom diff`: what differs between two drives."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.printing import SHOWN, print_json, progress_bar, several

if TYPE_CHECKING:
    from sceneloom.editing.diff import Difference, SceneDifferences

MARKS = {"added": "+", "removed": "-", "changed": "~"}
MOST = 10 * SHOWN
"""Differences shown unless `--verbose` is stated."""


@click.command()
@click.argument("first", type=options.location)
@click.argument("second", type=options.location)
@click.option(
    "--tolerance-m",
    type=options.not_negative,
    default=0.0,
    metavar="M",
    help="Distances up to this are none.",
)
@click.option(
    "--tolerance-deg",
    type=options.not_negative,
    default=0.0,
    metavar="DEG",
    help="Rotates up to this are none.",
)
@click.option(
    "--tolerance-ns",
    type=options.not_negative,
    default=0.0,
    metavar="NS",
    help="Timestamps up to this apart are equal.",
)
@click.option(
    "--tolerance-px",
    type=options.not_negative,
    default=0.0,
    metavar="PX",
    help="The same of what is drawn into images.",
)
@click.option(
    "--other-timestamps",
    is_flag=True,
    help="Paths may be reported at other timestamps, if they are the same ways.",
)
@click.option("--pixels", is_flag=True, help="Decode images whose bytes differ, and compare their pixels.")
@options.reading
@options.printing
def diff(
    first: Path | str,
    second: Path | str,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    tolerance_m: float,
    tolerance_deg: float,
    tolerance_ns: float,
    tolerance_px: float,
    other_timestamps: bool,
    pixels: bool,
    **reading: Any,
) -> int:
    """Report what differs between two drives, field by field; exit 0 where nothing does, 1 where something does."""
    from sceneloom.editing.diff import diff_scenes
    from sceneloom.formats.base.registry import open_scenes

    with (
        open_scenes((first, second), options.stated(**reading)) as (a, b),
        progress_bar("comparing", quiet=quiet) as progress,
    ):
        found = diff_scenes(
            a,
            b,
            tolerance_m=tolerance_m,
            tolerance_deg=tolerance_deg,
            tolerance_ns=tolerance_ns,
            tolerance_px=tolerance_px,
            other_timestamps=other_timestamps,
            pixels=pixels,
            progress=progress,
        )
    if as_json:
        print_json(
            {"equal": found.equal, "differences": found.differences, "not_compared": found.not_compared}
        )
    else:
        _print(found, quiet=quiet, verbose=verbose)
    return 0 if found.equal else 1


def _print(found: "SceneDifferences", *, quiet: bool, verbose: bool) -> None:
    shown = found.differences if verbose else found.differences[:MOST]
    for difference in shown:
        click.echo(_line(difference))
    if len(shown) < len(found.differences):
        click.echo(f"… and {len(found.differences) - len(shown)} more: state --verbose")
    click.echo(several(len(found.differences), "difference") if found.differences else "equal")
    if not quiet:
        for what in found.not_compared:
            click.echo(f"not compared: {what}", err=True)


def _line(difference: "Difference") -> str:
    """One difference: a mark, where, by how much, how."""
    amount = "" if difference.amount is None else f" by {difference.amount:.6g} {difference.unit}".rstrip()
    frames = ""
    if difference.frame is not None:
        which = "first" if difference.amount is None else "most"
        frames = f" in {several(difference.count, 'frame')}, {which} in frame {difference.frame}"
    mark = MARKS[difference.change]
    return f"{mark} {difference.path}: {difference.change}{amount}{frames}: {difference.message}"
