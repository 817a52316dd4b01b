"""`sceneloom report`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.printing import print_corrections, print_json, progress_bar, several

if TYPE_CHECKING:
    from sceneloom.report.drive_report import DriveReport


@click.command()
@click.argument("path", type=options.location)
@click.option(
    "-o",
    "--output",
    type=options.target,
    metavar="FILE",
    help="The page, one file that ends in .html. [default: report.html, unless --json or --numbers is stated]",
)
@click.option("--numbers", type=options.target, metavar="FILE", help="All its numbers as JSON, too.")
@click.option("--title", metavar="TEXT", help="Of the page. [default: the drive's name]")
@options.trajectory()
@click.option(
    "--truth",
    type=options.source(),
    metavar="FILE",
    help="What the drive is held against: a trajectory, a scene, or KITTI's text.",
)
@click.option(
    "--compare",
    type=click.Choice(["lidar", "gnss"]),
    multiple=True,
    help="Find the ego trajectory from this, too, and hold it against the drive's own; may be stated again.",
)
@click.option(
    "--losses",
    type=options.source(),
    metavar="FILE",
    help="What writing the drive lost, as JSON of `sceneloom convert`, to be reported with it.",
)
@click.option("--quick", is_flag=True, help="Look at a few frames only; no check of the calibration.")
@click.option(
    "--images",
    type=click.IntRange(min=0),
    default=24,
    show_default=True,
    metavar="N",
    help="Images that the page may hold.",
)
@click.option("--overwrite", is_flag=True, help="Replace outputs that exist.")
@options.part
@options.reading
@options.printing
def report(
    path: Path | str,
    output: Path | None,
    numbers: Path | None,
    title: str | None,
    trajectory: str | None,
    heading: str | None,
    truth: Path | None,
    compare: tuple[str, ...],
    losses: Path | None,
    quick: bool,
    images: int,
    overwrite: bool,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **reading: Any,
) -> None:
    """Make a page about a drive that can be sent: what is in it, whether it is in order, what it looks like.

    One file that holds everything it shows: a verdict and what to do, timing and gaps, map, calibration, coverage,
    fusion, annotations, all findings of `sceneloom validate`. `--json` prints its numbers.
    """
    from sceneloom.report.page import ReportSettings, write_report
    from sceneloom.stages import timed

    page = Path("report.html") if output is None and numbers is None and not as_json else output
    settings = ReportSettings(
        trajectory=trajectory,
        heading=heading,
        truth=truth,
        compare=compare,
        losses=losses,
        quick=quick,
        images=images,
        title=title,
    )
    with progress_bar("looking", quiet=quiet) as progress, timed() as stages:
        found = write_report(
            path,
            page,
            numbers=numbers,
            settings=settings,
            overwrite=overwrite,
            progress=progress,
            **options.stated(**reading),
        )
    if as_json:
        print_json(found, stages=stages)
        return
    if not quiet:
        print_corrections(found.warnings)
    _print_verdict(found, verbose=verbose)
    for name, written in (("page", page), ("numbers", numbers)):
        if written is not None:
            click.echo(f"{name}: {written}")


def _print_verdict(found: "DriveReport", *, verbose: bool) -> None:
    """Print what the page says first."""
    click.echo(f"{found.name}: {found.verdict.contents}")
    click.echo(found.verdict.sentence)
    advices = found.verdict.advices
    shown = advices if verbose else advices[:5]
    for advice in shown:
        click.echo(f"  {advice.severity}: {advice.title}")
        if verbose and advice.detail:
            click.echo(f"    {advice.detail}")
        click.echo(f"    → {advice.remedy}")
    if len(advices) > len(shown):
        click.echo(f"  … and {several(len(advices) - len(shown), 'more thing')} on the page")
