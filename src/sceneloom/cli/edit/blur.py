"""`sceneloom edit blur`: faces, plates and whatever else nobody is to see, hidden in videos and images."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from msgspec import structs

from sceneloom.cli import options
from sceneloom.cli.edit.running import common, editing, print_edit
from sceneloom.cli.printing import print_json, print_table, progress_bar

if TYPE_CHECKING:
    from sceneloom.pipeline.redacting import BlurReport


@click.command()
@editing
@click.option(
    "--boxes",
    "box_file",
    type=options.source(),
    metavar="FILE",
    help="CSV or JSON of what to hide: camera, number or time of the image, x1, y1, x2, y2, track.",
)
@click.option(
    "--label",
    "labels",
    multiple=True,
    metavar="LABEL",
    help="Hide the drive's own boxes and outlines in images that bear this label.",
)
@click.option(
    "--fill",
    type=click.Choice(["blur", "pixelate", "black"]),
    default="blur",
    show_default=True,
    help="What takes their location: at most 4 x 4 mean colours, smooth or in squares, or nothing.",
)
@click.option(
    "--margin",
    type=options.not_negative,
    default=0.1,
    show_default=True,
    metavar="S",
    help="Share of its width and height by which a box grows on each side.",
)
@click.option(
    "--hold",
    type=options.not_negative,
    default=0.0,
    metavar="S",
    help="Hide tracks and annotations S seconds longer before their first and after their last image.",
)
@click.option("--drop-colours", is_flag=True, help="Take the colours away that cameras gave to points.")
@common
def blur(
    path: Path,
    output: Path,
    box_file: Path | None,
    labels: tuple[str, ...],
    fill: str,
    margin: float,
    hold: float,
    drop_colours: bool,
    overwrite: bool,
    profile: str | None,
    time_unit: str | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **reading: Any,
) -> None:
    """Hide faces, plates and other locations in videos and images for good."""
    from sceneloom.pipeline.image_boxes import read_image_boxes
    from sceneloom.pipeline.redacting import blur_files

    boxes = () if box_file is None else read_image_boxes(box_file)
    names = tuple(name for label in labels for name in label.split(",") if name)
    with progress_bar("edit blur", quiet=quiet) as progress:
        report = blur_files(
            path,
            output,
            boxes=boxes,
            labels=names,
            fill=fill,
            margin=margin,
            hold=hold,
            drop_colours=drop_colours,
            reading=options.stated(**reading),
            progress=progress,
            overwrite=overwrite,
            **options.stated(profile=profile, time_unit=time_unit),
        )
    if as_json:
        print_json({**structs.asdict(report.edit), "fill": fill, "margin": margin, "cameras": report.cameras})
        return
    print_edit(report.edit, quiet=quiet, verbose=verbose)
    _print_cameras(report)


def _print_cameras(report: "BlurReport") -> None:
    rows = [("camera", "boxes", "locations hidden", "in images", "outside", "video")]
    for one in report.cameras:
        video = "" if one.encoded is None else f"{one.encoded} encoded again"
        outside = str(one.outside + one.without_image)
        images = f"{one.images} of {one.of_images}"
        rows.append((str(one.camera), str(one.boxes), str(one.hidden), images, outside, video))
    print_table(rows)
