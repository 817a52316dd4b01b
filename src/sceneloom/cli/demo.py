"""`sceneloom demo`."""

import time
from pathlib import Path

import click

from sceneloom.cli import options
from sceneloom.cli.fusion_summary import print_fusion
from sceneloom.cli.printing import print_json, print_losses, progress_bar, several


@click.command()
@click.option(
    "--keep",
    type=options.target,
    default=Path("sceneloom-demo"),
    show_default=True,
    metavar="DIR",
    help="Folder that gets the drive, the scene and the images.",
)
@click.option("--seed", type=int, default=0, show_default=True, help="Another number is another street.")
@click.option(
    "--frames", type=click.IntRange(min=2), default=30, show_default=True, help="Lidar sweeps at 10 Hz."
)
@click.option(
    "--video",
    type=click.Choice(["h264", "png"]),
    default="h264",
    show_default=True,
    help="How the drive's images are kept.",
)
@click.option("--overwrite", is_flag=True, help="Replace an earlier demo.")
@options.printing
def demo(
    keep: Path, seed: int, frames: int, video: str, overwrite: bool, as_json: bool, quiet: bool, verbose: bool
) -> None:
    """Make a small drive through a synthetic street, fuse it, and show what came out."""
    from sceneloom.formats.base.output import check_output

    begun = time.perf_counter()
    recording = keep / "drive"
    fused, depth, images = keep / "drive.sfs", keep / "depth", keep / "images"
    keep.mkdir(parents=True, exist_ok=True)
    for location in (recording, fused, depth, images):
        check_output(location, overwrite=overwrite)
    if not quiet:
        click.echo(f"making a drive of {frames / 10:g} s through a synthetic street …", err=True)

    from sceneloom.formats.base.registry import open_scene, write_scene
    from sceneloom.pipeline.fusing import FusionOutputs, fuse
    from sceneloom.simulate.drive import demo_drive

    outputs = FusionOutputs(scene=fused, depth=depth, images=images, overwrite=overwrite)
    drive = demo_drive(seed=seed, frames=frames).scene
    written = write_scene(drive, recording, overwrite=overwrite, images=video)
    with open_scene(recording) as scene, progress_bar("fusing", quiet=quiet) as progress:
        report = fuse(scene, outputs=outputs, progress=progress)
    if as_json:
        print_json(report)
        return
    print_fusion(report, outputs, quiet=quiet or not verbose, verbose=verbose)
    click.echo(f"recording: {recording}")
    if verbose and not quiet:
        print_losses(written, verbose=True)
    elif not quiet:
        # whoever begins has not asked yet what formats cannot hold
        notes = several(len([*report.warnings, *report.losses, *written]), "note")
        click.echo(f"{notes} on what these files cannot hold of the drive: `--verbose` lists them", err=True)
    click.echo(f"all in {time.perf_counter() - begun:.1f} s")
    click.echo(f"look at {images / 'cloud_drive_perspective.png'} and what is beside it; then try")
    click.echo(f"  sceneloom info {recording}")
    click.echo(f"  sceneloom info {keep / 'drive.sfs'}")
    click.echo("  sceneloom fuse YOUR_DRIVE -o YOUR_DRIVE.sfs --visualize images")
