"""`sceneloom depth`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.help import Verb
from sceneloom.cli.options import option
from sceneloom.cli.printing import Printer, print_table, several
from sceneloom.cli.running import reading_verb

if TYPE_CHECKING:
    from sceneloom.pipeline.depth_images import DepthReport


@click.command(cls=Verb, examples=("drive/ -o depth/", "drive/ --method sparse --form npz -o depth/"))
@click.argument("path", type=options.location)
@options.output("Folder for the depth images.")
@option("--method=sparse|dense", "`sparse`: measured points only; `dense`: surfaces between them. [default: dense]")
@option("--form=png|npz", "16-bit PNG (metres times 256) or NPZ (float32 metres and confidence). [default: png]")
@option("--camera=ID… cameras", "The only cameras. [default: all]")
@option("--confidence", "Write the confidence beside PNG images: 8 bit, 255 for 1.")
@options.visualize()
@options.trajectory(options.STATIONARY)
@options.threads
@options.part
@options.overwrite
@reading_verb
def depth(
    path: Path | str, output: Path, cameras: tuple[str, ...], printer: Printer, reading: dict[str, Any], **given: Any
) -> None:
    """Write a depth image for each sweep and image: z in metres, dense by choice, with a confidence."""
    from sceneloom.colouring.visibility import VisibilitySettings
    from sceneloom.formats.base.registry import open_scene
    from sceneloom.fusion.configuration import FusionConfiguration
    from sceneloom.pipeline.depth_images import write_depth_images
    from sceneloom.pipeline.warm_up import compile_for

    configuration = FusionConfiguration(visibility=options.take(VisibilitySettings, given))
    own = {"configuration": configuration, "lenient": "lenient" in reading, **options.stated(**given)}
    with open_scene(path, **reading) as scene, printer.progress("completing") as progress:
        chosen = options.known_ids(scene, cameras)
        compile_for("depth", scene)
        report = write_depth_images(scene, output, cameras=chosen, progress=progress, **own)
    printer.show(report, _print_report, given["images"])


def _print_report(report: "DepthReport", images: Path | None, printer: Printer) -> None:
    count = sum(camera.images for camera in report.cameras)
    click.echo(
        f"{several(count, 'depth image')} ({report.method}) of {several(report.sweeps, 'sweep')} "
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
    printer.blind(str(camera.camera) for camera in report.cameras if camera.images and not camera.filled_percent)
    if images is not None:
        click.echo(f"images: {images}")
    for reason, left_out in report.unfused.items():
        click.echo(f"{several(left_out, 'sweep')} left out: {reason}")
    if report.beyond_range:
        click.echo(f"{report.beyond_range} pixels beyond 255.99 m were written as 0; --form npz keeps them")
    printer.remarks(report)
