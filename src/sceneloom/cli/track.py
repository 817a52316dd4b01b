"""`sceneloom track`."""

from pathlib import Path
from typing import Any

import click

from sceneloom.cli import options
from sceneloom.cli.printing import (
    print_json,
    print_losses,
    print_notices,
    print_table,
    progress_bar,
    several,
)


@click.command()
@click.argument("path", type=options.place)
@click.option("-o", "--output", type=options.target, required=True, help="The file or folder to write.")
@click.option(
    "--format",
    "form",
    type=click.Choice(["kitti", "sfs", "jsonl"]),
    help="KITTI's text of results, a scene with labels, or lines of JSON. [default: by the suffix, else kitti]",
)
@click.option("--offline", is_flag=True, help="Let states look ahead: smoothed over the drive, gaps filled.")
@click.option(
    "--box2d",
    type=click.Choice(["image", "projected"]),
    help="Boxes in pictures: by those found there, or outlines of the boxes in space. [default: image]",
)
@click.option("--det2d", metavar="NAME", help="Which of several folders det2d_* holds the boxes of pictures.")
@click.option("--det3d", metavar="NAME", help="Which of several folders det3d_* holds the boxes of sweeps.")
@click.option(
    "--sequence", "sequences", multiple=True, metavar="NAME", help="Only this sequence; may be repeated."
)
@click.option("--algorithm", metavar="NAME", help="Algorithm of detection fusion. [default: projection]")
@click.option("--overwrite", is_flag=True, help="Replace outputs that exist.")
@click.option("--lenient", is_flag=True, help="Skip what is broken, count it, and go on.")
@options.printing
def track(
    path: Path | str,
    output: Path,
    form: str | None,
    offline: bool,
    box2d: str | None,
    det2d: str | None,
    det3d: str | None,
    sequences: tuple[str, ...],
    algorithm: str | None,
    overwrite: bool,
    lenient: bool,
    as_json: bool,
    quiet: bool,
    verbose: bool,
) -> None:
    """Follow objects through a drive by what detectors found in its sweeps and pictures."""
    from sceneloom.formats.kitti import open_tracking_folder
    from sceneloom.pipeline.tracked_files import track_folder
    from sceneloom.pipeline.tracking import TrackingSettings
    from sceneloom.tracking import PictureBox

    settings = TrackingSettings(offline=offline, **options.said(algorithm=algorithm))
    tracking = open_tracking_folder(str(path), detector_2d=det2d, detector_3d=det3d, lenient=lenient)
    with progress_bar("tracking", quiet=quiet) as progress:
        report = track_folder(
            tracking,
            output,
            sequences=sequences,
            form=form,
            settings=settings,
            overwrite=overwrite,
            progress=progress,
            **({} if box2d is None else {"box2d": PictureBox(box2d)}),
        )
    if as_json:
        print_json(report)
    else:
        print_tracking(report, quiet=quiet, verbose=verbose)


def print_tracking(report: Any, *, quiet: bool, verbose: bool) -> None:
    """Print what was tracked, and where it is."""
    print_table(
        [
            one.name,
            several(one.frames, "frame"),
            ", ".join(several(count, label) for label, count in one.tracks.items()) or "no objects",
            several(one.states, "state"),
            f"{one.ms_per_frame:.2f} ms/frame",
        ]
        for one in report.drives
    )
    click.echo(
        f"tracked {several(len(report.drives), 'drive')} in {report.seconds:.1f} s "
        f"({report.ms_per_frame:.2f} ms a frame for fusing and tracking): {report.output}"
    )
    if not quiet:
        print_notices(report.notices, verbose=verbose)
        print_losses(report.losses, verbose=verbose)
