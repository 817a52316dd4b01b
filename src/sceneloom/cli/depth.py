"""`sceneloom depth`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.identifiers import known_ids
from sceneloom.cli.printing import print_json, print_lines, print_table, print_warnings, progress_bar, several

if TYPE_CHECKING:
    from sceneloom.pipeline.depth_images import DepthReport


@click.command()
@click.argument("path", type=options.location)
@click.option("-o", "--output", type=options.target, required=True, help="Folder for the depth images.")
@click.option(
    "--method",
    type=click.Choice(["sparse", "fast", "quality"]),
    help="`sparse`: the measured points alone; `fast`: gaps between scan lines closed; `quality`: surfaces, with jumps "
    "where the image has edges. [default: quality]",
)
@click.option(
    "--form",
    type=click.Choice(["png", "npz"]),
    help="16-bit PNG (metres times 256) or NPZ (float32 metres and confidence). [default: png]",
)
@click.option("--camera", "cameras", multiple=True, metavar="ID", help="The only cameras. [default: all]")
@click.option("--confidence", is_flag=True, help="Write the confidence beside PNG images: 8 bit, 255 for 1.")
@click.option("--visualize", "images", type=options.target, help="Folder for images to look at.")
@options.trajectory(further="`identity`: it was stationary")
@options.threads
@options.part
@click.option("--overwrite", is_flag=True, help="Replace outputs that exist.")
@options.reading
@options.printing
def depth(
    path: Path | str,
    output: Path,
    method: str | None,
    form: str | None,
    cameras: tuple[str, ...],
    confidence: bool,
    camera_images: Path | None,
    trajectory: str | None,
    heading: str | None,
    threads: int | None,
    start: float | None,
    stop: float | None,
    overwrite: bool,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **reading: Any,
) -> None:
    """Write a depth image for each sweep and image: z in metres, dense by choice, with a confidence."""
    from sceneloom.colouring.visibility import VisibilitySettings
    from sceneloom.formats.base.registry import open_scene
    from sceneloom.fusion.configuration import FusionConfiguration
    from sceneloom.pipeline.depth_images import write_depth_images

    with (
        open_scene(path, **options.stated(**reading)) as scene,
        progress_bar("completing", quiet=quiet) as progress,
    ):
        report = write_depth_images(
            scene,
            output,
            cameras=known_ids(scene, cameras),
            confidence=confidence,
            images=camera_images,
            trajectory=trajectory,
            heading=heading,
            start=start,
            stop=stop,
            configuration=FusionConfiguration(
                visibility=VisibilitySettings(**options.stated(threads=threads))
            ),
            lenient=reading["lenient"],
            overwrite=overwrite,
            progress=progress,
            **options.stated(method=method, form=form),
        )
    if as_json:
        print_json(report)
    else:
        _print_report(report, camera_images, quiet=quiet, verbose=verbose)


def _print_report(report: "DepthReport", camera_images: Path | None, *, quiet: bool, verbose: bool) -> None:
    images = sum(camera.images for camera in report.cameras)
    click.echo(
        f"{several(images, 'depth image')} ({report.method}) of {several(report.sweeps, 'sweep')} "
        f"in {report.seconds:.1f} s: {report.folder}"
    )
    print_table(
        [
            str(camera.camera),
            several(camera.images, "image"),
            f"{camera.filled_percent:.1f} % of the pixels filled",
            f"mean confidence {camera.confidence:.2f}",
        ]
        for camera in report.cameras
    )
    if camera_images is not None:
        click.echo(f"images: {camera_images}")
    for reason, count in report.unfused.items():
        click.echo(f"{several(count, 'sweep')} left out: {reason}")
    if report.beyond_range:
        click.echo(f"{report.beyond_range} pixels beyond 255.99 m were written as 0; --form npz keeps them")
    if not quiet:
        print_lines([f"skipped: {reason}" for reason in report.skipped], verbose=verbose)
        print_warnings(report.warnings, verbose=verbose)
