"""`sceneloom track`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import detection_options, options
from sceneloom.cli.printing import (
    print_json,
    print_losses,
    print_table,
    print_warnings,
    progress_bar,
    several,
)

if TYPE_CHECKING:  # the pipeline takes seconds to import, and `--help` needs none of it
    from sceneloom.pipeline.tracked_drive import TrackReport


@click.command()
@click.argument("path", type=options.location)
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
    help="Boxes in images: by those found there, or outlines of the boxes in space. [default: image]",
)
@detection_options.takes
@options.trajectory(further="`identity`: it was stationary")
@click.option(
    "--algorithm",
    metavar="NAME|FILE.py:FUNCTION",
    help="Algorithm of detection fusion, or a function of a Python file. [default: projection]",
)
@click.option(
    "--visualize",
    "images",
    type=options.target,
    metavar="DIR",
    help="Draw a dozen moments: over images and from above.",
)
@options.part
@options.rewriting
def track(
    path: Path | str,
    output: Path,
    form: str | None,
    offline: bool,
    box2d: str | None,
    detectors: str | None,
    algorithm: str | None,
    images: Path | None,
    overwrite: bool,
    profile: str | None,
    time_unit: str | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **given: Any,
) -> None:
    """Follow objects through a drive by what detectors found in its sweeps and images.

    PATH is a folder laid out like KITTI's tracking benchmark, a drive with --boxes2d and --boxes3d, or what `sceneloom
    fuse --type detection` wrote.
    """
    from sceneloom.detections.settings import ProjectionSettings
    from sceneloom.pipeline.detection_jobs import track_objects
    from sceneloom.pipeline.tracked_drive import TrackingSettings
    from sceneloom.tracking.settings import ImageBox

    how: dict[str, Any] = {
        "form": form,
        "images": images,
        "settings": TrackingSettings(
            offline=offline,
            fusion=None if detectors is None else ProjectionSettings(detectors=detectors),
            **options.stated(algorithm=algorithm),
        ),
        "overwrite": overwrite,
        "scene_options": options.stated(profile=profile, time_unit=time_unit),
        **({} if box2d is None else {"box2d": ImageBox(box2d)}),
    }
    with progress_bar("tracking", quiet=quiet) as progress:
        report = track_objects(
            path,
            output,
            chosen=detection_options.chosen(given),
            lenient=given["lenient"],
            reading=detection_options.reading(given),
            progress=progress,
            **how,
        )
    if as_json:
        print_json(report)
    else:
        print_tracking(report, quiet=quiet, verbose=verbose)


def print_tracking(report: "TrackReport", *, quiet: bool, verbose: bool) -> None:
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
        f"({report.ms_per_frame:.2f} ms of the processor a frame for fusing and tracking): {report.output}"
    )
    if not quiet:
        print_warnings(report.warnings, verbose=verbose)
        print_losses(report.losses, verbose=verbose)
