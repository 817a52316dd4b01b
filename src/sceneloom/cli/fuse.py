"""`sceneloom fuse`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import detection_options, options
from sceneloom.cli.fuse_detections import fuse_found
from sceneloom.cli.fusion_summary import print_fusion
from sceneloom.cli.printing import print_json, progress_bar

if TYPE_CHECKING:  # the pipeline takes seconds to import, and `--help` needs none of it
    from sceneloom.fusion.configuration import FusionConfiguration


@click.command()
@click.argument("path", type=options.location)
@click.option(
    "-o", "--output", type=options.target, help="The .sfs file to write; of detections, the .jsonl file."
)
@click.option(
    "--type",
    "fusion_type",
    type=click.Choice(["sensor", "detection"]),
    help="Fuse clouds and images, or what detectors found in them. [default: sensor]",
)
@click.option(
    "--format",
    "form",
    type=click.Choice(["jsonl", "kitti"]),
    help="Of detections: lines of JSON, or for KITTI's folders its text, without tracks. [default: jsonl]",
)
@detection_options.takes
@options.trajectory(further="`identity`: it was stationary")
@click.option(
    "--algorithm",
    metavar="NAME|FILE.py:FUNCTION",
    help="`projection`: colours of nearest pixels; `blending`: of all images, by weight; one that a package brings, "
    "or a function of a Python file, which is executed. [default: projection]",
)
@click.option("--depth", type=options.target, help="Folder for depth images.")
@click.option(
    "--depth-format",
    type=click.Choice(["png", "npz"]),
    help="16-bit PNG (metres times 256) or NPZ (float32 metres). [default: png]",
)
@click.option("--visualize", "images", type=options.target, help="Folder for images to look at.")
@click.option(
    "--visualize-every",
    "images_every",
    type=click.IntRange(min=1),
    metavar="N",
    help="Draw every Nth sweep. [default: eight spread over the drive]",
)
@options.threads
@options.part
@options.rewriting
def fuse(
    path: Path | str,
    output: Path | None,
    fusion_type: str | None,
    form: str | None,
    algorithm: str | None,
    **given: Any,
) -> None:
    """Fuse lidar and cameras of a drive: coloured clouds in one world, depth images, one scene file.

    With --type detection, fuse what detectors found: objects with existence and covariances, as lines of JSON (table 10
    of DB34/T 4101). PATH is then a drive with --boxes2d and --boxes3d, or a folder laid out like KITTI's tracking
    benchmark.
    """
    if fusion_type == "detection":
        detection_options.refuse(given, _OF_SENSOR_DATA, "detections are fused into lines of JSON")
        found = {name: given.pop(name) for name in (*detection_options.NAMES, *_TRAJECTORY)}
        kept = {name: value for name, value in given.items() if name not in _OF_SENSOR_DATA}
        fuse_found(path, output, found, algorithm=algorithm, form=form, **kept)
        return
    own = [name for name in detection_options.NAMES if name != "sequences"]
    detection_options.refuse({"format": form, **given}, ("format", *own), "state --type detection with it")
    given["sequence"] = options.one_sequence(given["sequences"])
    kept = {name: value for name, value in given.items() if name not in detection_options.NAMES}
    _fuse_sensor_data(path, output, algorithm=algorithm, **kept)


_TRAJECTORY = ("trajectory", "heading")
_OF_SENSOR_DATA = (
    *("depth", "depth_format", "images", "images_every", "threads"),
    *("profile", "time_unit"),
)
"""Options that only the fusion of sensor data has."""


def _fuse_sensor_data(
    path: Path | str,
    output: Path | None,
    *,
    trajectory: str | None,
    heading: str | None,
    algorithm: str | None,
    depth: Path | None,
    depth_format: str | None,
    images: Path | None,
    images_every: int | None,
    threads: int | None,
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
    if output is None and depth is None and images is None:
        raise click.UsageError("nothing to write: state -o drive.sfs, --depth DIR or --visualize DIR")
    _refuse_idle("--depth-format", depth_format, "--depth", depth)
    _refuse_idle("--visualize-every", images_every, "--visualize", images)
    from sceneloom.formats.base.registry import open_scene
    from sceneloom.pipeline.fusing import FusionOutputs
    from sceneloom.pipeline.fusing import fuse as fuse_scene
    from sceneloom.stages import timed

    outputs = FusionOutputs(
        scene=output,
        depth=depth,
        images=images,
        images_every=images_every,
        **options.stated(depth_format=depth_format, profile=profile, time_unit=time_unit),
        overwrite=overwrite,
    )
    with (
        timed() as stages,
        open_scene(path, **options.stated(**reading)) as scene,
        progress_bar("fusing", quiet=quiet) as progress,
    ):
        report = fuse_scene(
            scene,
            trajectory=trajectory,
            heading=heading,
            start=start,
            stop=stop,
            outputs=outputs,
            configuration=_configuration(algorithm, threads),
            lenient=reading["lenient"],
            progress=progress,
        )
    if as_json:
        print_json(report, stages=stages)
    else:
        print_fusion(report, outputs, quiet=quiet, verbose=verbose)


def _configuration(algorithm: str | None, threads: int | None) -> "FusionConfiguration":
    from sceneloom.colouring.visibility import VisibilitySettings
    from sceneloom.fusion.configuration import FusionConfiguration

    visibility = VisibilitySettings(**options.stated(threads=threads))
    return FusionConfiguration(visibility=visibility, **options.stated(fusion_algorithm=algorithm))


def _refuse_idle(option: str, value: object, needed: str, folder: Path | None) -> None:
    if value is not None and folder is None:
        raise click.UsageError(f"{option} {value} does nothing without {needed} DIR")
