"""`sceneloom report`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.help import Verb
from sceneloom.cli.options import option
from sceneloom.cli.printing import Printer, several
from sceneloom.cli.running import reading_verb

if TYPE_CHECKING:
    from sceneloom.report.drive_report import DriveReport


@click.command(cls=Verb, examples=("drive.sfs -o drive.html", "drive/ --json"))
@click.argument("path", type=options.location)
@option(
    "-o --output=FILE",
    "The page, one file that ends in .html. [default: report.html, unless --json or --numbers is stated]",
    options.target,
)
@option("--numbers=FILE", "Also write all its metrics as JSON.", options.target)
@option("--title=TEXT", "Title of the page. [default: the drive's name]")
@options.trajectory()
@option(
    "--truth=FILE", "Reference to compare the drive with: a trajectory, a scene, or KITTI's text.", options.source()
)
@option(
    "--compare=lidar|gnss…",
    "Also estimate the trajectory from this, and compare the drive's own with it; may be repeated.",
)
@option(
    "--losses=FILE",
    "Loss report of writing the drive to show with it, as JSON of `sceneloom convert`.",
    options.source(),
)
@option("--quick", "Read a few frames only; no check of the calibration.")
@option("--images=N", "Most images on the page.", click.IntRange(min=0), default=24)
@options.overwrite
@options.part
@reading_verb
def report(
    path: Path | str,
    output: Path | None,
    numbers: Path | None,
    overwrite: bool,
    printer: Printer,
    reading: dict[str, Any],
    **given: Any,
) -> None:
    """Write a page about a drive that can be sent: contents, quality, and what it looks like.

    One file that holds everything it shows: a verdict and what to do, timing and gaps, map, calibration, coverage,
    fusion, annotations, all findings of `sceneloom validate`. `--json` prints its metrics.
    """
    from sceneloom.report.page import ReportSettings, write_report
    from sceneloom.stages import timed

    page = Path("report.html") if output is None and numbers is None and not printer.as_json else output
    settings = options.take(ReportSettings, given)
    with printer.progress("looking") as progress, timed() as stages:
        found = write_report(
            path,
            page,
            numbers=numbers,
            settings=settings,
            overwrite=overwrite,
            progress=progress,
            **reading,
            **options.stated(**given),
        )
    printer.show(found, _print_report, {"page": page, "numbers": numbers}, stages=stages)


def _print_report(found: "DriveReport", outputs: dict[str, Path | None], printer: Printer) -> None:
    """Print what the page states first, and where it is."""
    printer.corrections(found.warnings)
    click.echo(f"{found.name}: {found.verdict.contents}")
    click.echo(found.verdict.sentence)
    advices = found.verdict.advices
    shown = advices if printer.verbose else advices[:5]
    for advice in shown:
        click.echo(f"  {advice.severity}: {advice.title}")
        if printer.verbose and advice.detail:
            click.echo(f"    {advice.detail}")
        click.echo(f"    → {advice.remedy}")
    if len(advices) > len(shown):
        click.echo(f"  … and {several(len(advices) - len(shown), 'more thing')} on the page")
    for name, written in outputs.items():
        if written is not None:
            click.echo(f"{name}: {written}")
