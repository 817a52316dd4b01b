"""`sceneloom colour`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.printing import print_json, print_lines, print_table, print_warnings, progress_bar, several

if TYPE_CHECKING:  # the pipeline takes seconds to import, and `--help` needs none of it
    from sceneloom.pipeline.colouring import ColourOutputs, ColourReport


@click.command()
@click.argument("path", type=options.location)
@click.option("-o", "--output", type=options.target, help="The map: .las, .laz, .ply, .pcd or .sfs.")
@click.option(
    "--voxel", type=options.positive, metavar="M", help="Keep one point per cube of M metres. [default: all]"
)
@click.option(
    "--blend",
    type=click.Choice(["nearest", "best", "weighted"]),
    help="The pixel nearest to an image's middle; the colour trusted most, between pixels; or the mean of those that "
    "agree with it. [default: weighted]",
)
@click.option("--no-exposure", is_flag=True, help="Leave differences in exposure between images.")
@click.option(
    "--remove-moving", is_flag=True, help="Leave out what other rays pass through, or moving boxes hold."
)
@click.option("--only-coloured", is_flag=True, help="Leave out points that no image shows.")
@click.option("--provenance", is_flag=True, help="Add camera, image, pixel and weight of each point.")
@click.option("--labels", type=options.source(), metavar="DIR", help="Label images to paint on.")
@click.option(
    "--project-labels",
    type=options.target,
    metavar="DIR",
    help="Folder for label images made of the drive's labelled points.",
)
@click.option(
    "--label-radius",
    "label_radius_px",
    type=click.IntRange(0, 100),
    metavar="PX",
    help="Pixels that a point fills beside its own in projected label images. [default: 0]",
)
@click.option(
    "--per-sweep",
    type=options.target,
    metavar="DIR",
    help="Folder for a cloud of each sweep, or an .sfs file of the drive.",
)
@click.option(
    "--visualize", "images", type=options.target, metavar="DIR", help="Folder for images to look at."
)
@options.trajectory(further="`identity`: it was stationary")
@options.threads
@options.part
@click.option("--overwrite", is_flag=True, help="Replace outputs that exist.")
@options.reading
@options.printing
def colour(
    path: Path | str,
    output: Path | None,
    project_labels: Path | None,
    label_radius_px: int | None,
    per_sweep: Path | None,
    images: Path | None,
    no_exposure: bool,
    trajectory: str | None,
    heading: str | None,
    start: float | None,
    stop: float | None,
    overwrite: bool,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **further: Any,
) -> None:
    """Colour the points of a drive from all its cameras: one map, or sweep by sweep; carry labels over."""
    from sceneloom.formats.base.registry import open_scene
    from sceneloom.pipeline.colouring import ColourOutputs, ColourSettings
    from sceneloom.pipeline.colouring import colour as colour_scene

    if label_radius_px is not None and project_labels is None:
        raise click.UsageError("--label-radius does nothing without --project-labels DIR")
    names = ("voxel", "blend", "remove_moving", "only_coloured", "provenance", "labels", "threads")
    chosen = {name: further.pop(name) for name in names}
    settings = ColourSettings(
        exposure=not no_exposure, **options.stated(**chosen, label_radius_px=label_radius_px)
    )
    outputs = ColourOutputs(
        map=output, per_sweep=per_sweep, project_labels=project_labels, images=images, overwrite=overwrite
    )
    with (
        open_scene(path, **options.stated(**further)) as scene,
        progress_bar("colouring", quiet=quiet) as progress,
    ):
        report = colour_scene(
            scene,
            trajectory=trajectory,
            heading=heading,
            start=start,
            stop=stop,
            settings=settings,
            outputs=outputs,
            lenient=further["lenient"],
            progress=progress,
        )
    if as_json:
        print_json(report)
    else:
        _print(report, outputs, quiet=quiet, verbose=verbose)


def _print(report: "ColourReport", outputs: "ColourOutputs", *, quiet: bool, verbose: bool) -> None:
    """Print what was coloured, what was left out and why, and where it is."""
    click.echo(
        f"coloured {report.fused} of {several(report.frames, 'sweep')} in {report.seconds:.1f} s: "
        f"{several(report.points, 'point')}, {report.coloured_percent:.1f} % coloured"
    )
    print_table(
        [str(camera.camera), f"{camera.in_image_percent:.1f} % of the points in its images"]
        for camera in report.cameras
    )
    _print_exposure(report)
    removed = {
        "in moving boxes": report.removed_in_boxes,
        "by rays through their locations": report.removed_by_rays,
    }
    for how, count in removed.items():
        if count:
            click.echo(f"{several(count, 'point')} removed {how}")
    if report.labels is not None:
        _print_labels(report)
    for reason, count in report.unfused.items():
        click.echo(f"{several(count, 'sweep')} left out: {reason}")
    if outputs.map is not None:
        click.echo(f"map: {outputs.map} ({several(report.written, 'point')})")
    locations = {
        "sweeps": outputs.per_sweep,
        "label images": outputs.project_labels,
        "images": outputs.images,
    }
    for kind, location in locations.items():
        if location is not None:
            files = report.files.get(kind)
            click.echo(f"{kind}: {location}" + ("" if files is None else f" ({several(files, 'file')})"))
    if not quiet:
        print_lines([f"skipped: {reason}" for reason in report.skipped], verbose=verbose)
        print_warnings(report.warnings, verbose=verbose)


def _print_exposure(report: "ColourReport") -> None:
    found = report.exposure
    if found is None:
        return
    if found.seam_before is not None and found.seam_after is not None:
        click.echo(
            f"exposure: where two cameras show a point, colours differ by {found.seam_before:.1f} levels before and "
            f"{found.seam_after:.1f} after evening out (median of {several(found.seam_points, 'point')})"
        )
    alone = [*found.alone, *found.unlinked]
    if alone and len(report.cameras) > 1:
        click.echo(f"exposure: nothing compares {', '.join(map(str, alone))} with the other cameras")


def _print_labels(report: "ColourReport") -> None:
    labels = report.labels
    if labels is None:
        return
    if labels.images or labels.missing:
        click.echo(
            f"labels: {several(labels.images, 'image')} painted onto {several(labels.points, 'point')}, "
            f"{several(labels.classes, 'label')} among them"
        )
    if labels.missing:
        click.echo(f"labels: no label image of {several(labels.missing, 'image')}")
