"""A fusion's report as a summary that one can read."""

from typing import TYPE_CHECKING

import click

from sceneloom.cli.printing import print_lines, print_losses, print_table, print_warnings, several

if TYPE_CHECKING:  # the pipeline takes seconds to import, and `--help` needs none of it
    from sceneloom.pipeline.fusing import CameraReport, FusionOutputs, FusionReport


def print_fusion(report: "FusionReport", outputs: "FusionOutputs", *, quiet: bool, verbose: bool) -> None:
    """Print what was fused, what was left out and why, and where it is."""
    trajectory = "the sensors' own poses" if report.trajectory is None else f"trajectory {report.trajectory}"
    click.echo(
        f"fused {report.fused} of {several(report.frames, 'sweep')} by {trajectory} "
        f"in {report.seconds:.1f} s ({report.frames_per_second:.1f} sweeps a second)"
    )
    click.echo(f"{several(report.points, 'point')}, {report.coloured_percent:.1f} % coloured")
    print_table(_camera_row(camera) for camera in report.cameras)
    if not quiet:
        _print_blind(report)
    _print_left_out(report, quiet=quiet, verbose=verbose)
    locations = {"scene": outputs.scene, "depth images": outputs.depth, "images": outputs.images}
    for kind, location in locations.items():
        if location is not None:
            count = report.files.get(kind)
            click.echo(f"{kind}: {location}" + ("" if count is None else f" ({several(count, 'file')})"))
    if not quiet:
        print_warnings(report.warnings, verbose=verbose)
        print_losses(report.losses, verbose=verbose)


def _camera_row(camera: "CameraReport") -> list[str]:
    unpaired = f"{several(camera.unpaired, 'sweep')} without an image" if camera.unpaired else ""
    unposed = f"{several(camera.unposed, 'image')} beyond the trajectory" if camera.unposed else ""
    return [
        str(camera.camera),
        several(camera.images, "image"),
        f"{camera.in_image_percent:.1f} % of the points in it",
        f"{camera.hidden_percent:.1f} % of these hidden",
        f"{camera.coloured} coloured",
        ", ".join(filter(None, [unpaired, unposed])),
    ]


def _print_blind(report: "FusionReport") -> None:
    """Note cameras that see nothing of what the lidars see, as most wrong mountings have it."""
    blind = [str(camera.camera) for camera in report.cameras if camera.paired and not camera.in_image_percent]
    if blind:
        message = (
            f"no point falls into the images of {', '.join(blind)}; where they look is in `sceneloom info`"
        )
        click.echo(f"assumed: {message}: is the mounting right?", err=True)


def _print_left_out(report: "FusionReport", *, quiet: bool, verbose: bool) -> None:
    if report.extrapolated:
        sweeps = several(report.extrapolated, "sweep")
        click.echo(f"{sweeps} used poses beyond the trajectory's ends, by at most one sweep period")
    for reason, count in report.unfused.items():
        click.echo(f"{several(count, 'sweep')} kept unfused: {reason}")
    if report.skipped:
        count = len(report.skipped)
        click.echo("1 sweep or image skipped" if count == 1 else f"{count} sweeps or images skipped")
        if not quiet:
            print_lines([f"skipped: {reason}" for reason in report.skipped], verbose=verbose)
    if report.depth_beyond_range:
        click.echo(
            f"{report.depth_beyond_range} depth pixels beyond 255.99 m were written as 0; --depth-format npz keeps them"
        )
