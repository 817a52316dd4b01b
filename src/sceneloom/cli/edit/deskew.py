"""`sceneloom edit deskew`: undo the motion during each lidar sweep."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.edit.running import editing
from sceneloom.cli.identifiers import known_id_or_none
from sceneloom.cli.printing import (
    print_json,
    print_lines,
    print_losses,
    print_warnings,
    progress_bar,
    several,
)

if TYPE_CHECKING:  # the pipeline takes seconds to import, and `--help` needs none of it
    from sceneloom.pipeline.deskewing import DeskewReport


@click.command()
@editing
@options.trajectory(further="`imu`: only the rotating that the IMU reports")
@click.option(
    "--at",
    type=click.Choice(["start", "middle", "end"]),
    default="middle",
    show_default=True,
    help="The moment of each sweep that its points are brought to.",
)
@click.option("--lidar", metavar="ID", help="The only lidar to deskew. [default: all]")
@options.part
@options.rewriting
def deskew(
    path: Path | str,
    output: Path,
    trajectory: str | None,
    heading: str | None,
    at: str,
    lidar: str | None,
    start: float | None,
    stop: float | None,
    overwrite: bool,
    profile: str | None,
    time_unit: str | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **reading: Any,
) -> None:
    """Undo the motion during each lidar sweep: points stay in their sensor, as if measured all at one time."""
    from sceneloom.formats.base.registry import open_scene
    from sceneloom.pipeline.deskewing import deskew as deskew_scene

    with (
        open_scene(path, **options.stated(**reading)) as scene,
        progress_bar("deskewing", quiet=quiet) as progress,
    ):
        report = deskew_scene(
            scene,
            output,
            trajectory=trajectory,
            heading=heading,
            at=at,
            lidar=known_id_or_none(scene, lidar),
            start=start,
            stop=stop,
            lenient=reading["lenient"],
            progress=progress,
            overwrite=overwrite,
            **options.stated(profile=profile, time_unit=time_unit),
        )
    if as_json:
        print_json(report)
    else:
        _print_deskewing(report, quiet=quiet, verbose=verbose)


def _print_deskewing(report: "DeskewReport", *, quiet: bool, verbose: bool) -> None:
    trajectory = "the lidars' own poses" if report.trajectory is None else f"trajectory {report.trajectory}"
    click.echo(
        f"deskewed {report.deskewed} of {several(report.sweeps, 'sweep')} by {trajectory} to the {report.at} of each, "
        f"in {report.seconds:.1f} s"
    )
    click.echo(
        f"{several(report.points, 'point')} moved by {report.mean_shift:.3f} m on average, "
        f"by {report.max_shift:.3f} m at most"
    )
    if report.extrapolated:
        sweeps = several(report.extrapolated, "sweep")
        click.echo(f"{sweeps} used poses beyond the trajectory's ends, by at most one sweep period")
    for reason, count in report.left.items():
        click.echo(f"{several(count, 'sweep')} left as measured: {reason}")
    if report.skipped:
        click.echo(f"{several(len(report.skipped), 'unreadable sweep')} skipped")
    click.echo(f"scene: {report.output}")
    if not quiet:
        print_lines([f"skipped: {reason}" for reason in report.skipped], verbose=verbose)
        print_warnings(report.warnings, verbose=verbose)
        print_losses(report.losses, verbose=verbose)
