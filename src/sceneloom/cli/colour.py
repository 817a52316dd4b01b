"""`sceneloom colour`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.help import Verb
from sceneloom.cli.options import option
from sceneloom.cli.printing import Printer, print_outputs, print_table, several, wrote
from sceneloom.cli.running import reading_verb

if TYPE_CHECKING:  # the pipeline takes seconds to import, and `--help` needs none of it
    from sceneloom.pipeline.colouring import ColourOutputs, ColourReport


@click.command(cls=Verb, examples=("drive.sfs --voxel 0.05 -o map.laz", "drive/ -o coloured.sfs"))
@click.argument("path", type=options.location)
@options.output("The map: .las, .laz, .ply, .pcd or .sfs.", required=False)
@option("--voxel=M", "Keep one point per cube of M metres. [default: all]", options.positive)
@option("--no-exposure", "Do not correct differences in exposure between images.")
@option("--remove-moving", "Remove points that other rays pass through, or in moving boxes.")
@option("--only-coloured", "Remove points that no image shows.")
@option("--provenance", "Add camera, image, pixel and weight of each point.")
@option("--labels=DIR", "Label images to transfer to points.", options.source())
@option("--project-labels=DIR", "Folder for label images projected from the drive's labelled points.", options.target)
@option(
    "--label-radius=PX label_radius_px",
    "Pixels that a point fills beside its own in projected label images. [default: 0]",
    click.IntRange(0, 100),
)
@option("--per-sweep=DIR", "Folder for a cloud of each sweep, or an .sfs file of the drive.", options.target)
@options.visualize()
@options.trajectory(options.STATIONARY)
@options.threads
@options.part
@options.overwrite
@reading_verb
def colour(
    path: Path | str, output: Path | None, no_exposure: bool, printer: Printer, reading: dict[str, Any], **given: Any
) -> None:
    """Colour the points of a drive from all its cameras: one map, or sweep by sweep; transfer labels."""
    from sceneloom.formats.base.registry import open_scene
    from sceneloom.pipeline.colouring import ColourOutputs, ColourSettings
    from sceneloom.pipeline.colouring import colour as colour_scene
    from sceneloom.pipeline.warm_up import compile_for

    options.needs("--label-radius", given["label_radius_px"], "--project-labels DIR", given["project_labels"])
    settings = options.take(ColourSettings, given, exposure=not no_exposure)
    outputs = options.take(ColourOutputs, given, map=output)
    with open_scene(path, **reading) as scene, printer.progress("colouring") as progress:
        compile_for("colour", scene)
        report = colour_scene(
            scene, settings=settings, outputs=outputs, lenient="lenient" in reading, progress=progress, **given
        )
    printer.show(report, _print_report, outputs)


def _print_report(report: "ColourReport", outputs: "ColourOutputs", printer: Printer) -> None:
    """Print what was coloured, what was left out and why, and where it is."""
    click.echo(
        f"coloured {report.fused} of {several(report.frames, 'sweep')} in {report.seconds:.1f} s: "
        f"{several(report.points, 'point')}, {report.coloured_percent:.1f} % coloured"
    )
    print_table(
        [str(camera.camera), f"{camera.in_image_percent:.1f} % of the points in its images"]
        for camera in report.cameras
    )
    printer.blind(str(camera.camera) for camera in report.cameras if camera.paired and not camera.in_image_percent)
    found, labels = report.exposure, report.labels
    if found is not None and found.seam_before is not None and found.seam_after is not None:
        click.echo(
            f"exposure: where two cameras show a point, colours differ by {found.seam_before:.1f} levels before and "
            f"{found.seam_after:.1f} after evening out (median of {several(found.seam_points, 'point')})"
        )
    alone = [] if found is None else [*found.alone, *found.unlinked]
    if alone and len(report.cameras) > 1:
        click.echo(f"exposure: nothing compares {', '.join(map(str, alone))} with the other cameras")
    removed = {"in moving boxes": report.removed_in_boxes, "by rays through their locations": report.removed_by_rays}
    for how, count in removed.items():
        if count:
            click.echo(f"{several(count, 'point')} removed {how}")
    if labels is not None and (labels.images or labels.missing):
        click.echo(
            f"labels: {several(labels.images, 'image')} painted onto {several(labels.points, 'point')}, "
            f"{several(labels.classes, 'label')} among them"
        )
    if labels is not None and labels.missing:
        click.echo(f"labels: no label image of {several(labels.missing, 'image')}")
    for reason, count in report.unfused.items():
        click.echo(f"{several(count, 'sweep')} left out: {reason}")
    if outputs.map is not None:
        wrote(outputs.map, {"point": report.written})
    folders = {"sweeps": outputs.per_sweep, "label images": outputs.project_labels, "images": outputs.images}
    print_outputs(folders, report.files)
    printer.remarks(report)
