"""`sceneloom fuse`, of sensor data and of detections, and `sceneloom demo`."""

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import detection_options, options
from sceneloom.cli.help import Verb
from sceneloom.cli.options import option
from sceneloom.cli.printing import Printer, print_outputs, print_table, several
from sceneloom.cli.running import rewriting_verb, verb

if TYPE_CHECKING:  # the pipeline takes seconds to import, and `--help` needs none of it
    from sceneloom.pipeline.fusing import FusionOutputs, FusionReport
    from sceneloom.pipeline.fusing_detections import DetectionFusionReport


@click.command(
    cls=Verb,
    examples=("drive/ -o drive.sfs", "drive/ --trajectory lidar --depth depth/ --visualize look/ -o drive.sfs"),
)
@click.argument("path", type=options.location)
@options.output("The .sfs file to write; for detections, the .jsonl file.", required=False)
@option("--type=sensor|detection fusion_type", "Fuse clouds and images, or detections in them. [default: sensor]")
@option(
    "--format=jsonl|kitti form",
    "For detections: JSON lines, or for KITTI's folders its text, without tracks. [default: jsonl]",
)
@detection_options.fused
@options.trajectory(options.STATIONARY)
@option(
    "--algorithm=NAME|FILE.py:FUNCTION",
    "`projection`: colours of nearest pixels; `blending`: means of all images; one that a package brings, "
    "or a function of a Python file, which is executed. [default: projection]",
)
@option("--depth=DIR", "Folder for depth images.", options.target, group="output")
@option(
    "--depth-format=png|npz", "16-bit PNG (metres times 256) or NPZ (float32 metres). [default: png]", group="output"
)
@options.visualize()
@option(
    "--visualize-every=N images_every",
    "Draw every Nth sweep. [default: eight spread over the drive]",
    click.IntRange(min=1),
    group="output",
)
@options.threads
@options.part
@rewriting_verb
def fuse(
    path: Path | str,
    output: Path | None,
    fusion_type: str | None,
    form: str | None,
    printer: Printer,
    reading: dict[str, Any],
    **given: Any,
) -> None:
    """Fuse lidar and cameras of a drive: coloured clouds in one world, depth images, one scene file.

    With --type detection, fuse detections: objects with existence probabilities and covariances, as JSON lines (table
    10 of DB34/T 4101). PATH is then a drive with --boxes2d and --boxes3d, or a folder laid out like KITTI's tracking
    benchmark.
    """
    if fusion_type == "detection":
        options.refuse(given, _OF_SENSOR_DATA, "detections are fused into lines of JSON")
        _fuse_detections(path, output, form, printer, reading, given)
        return
    own = [name for name in detection_options.NAMES if name != "sequences"]
    options.refuse({"form": form, **given}, ("form", *own), "it needs --type detection")
    sequence = options.one_sequence(given["sequences"])
    for name in detection_options.NAMES:
        del given[name]
    _fuse_sensor_data(path, output, printer, reading | options.stated(sequence=sequence), given)


_OF_SENSOR_DATA = (*("depth", "depth_format", "images", "images_every", "threads"), *("profile", "time_unit"))
"""Options that only the fusion of sensor data has."""


def _fuse_sensor_data(
    path: Path | str, output: Path | None, printer: Printer, reading: dict[str, Any], given: dict[str, Any]
) -> None:
    if output is None and given["depth"] is None and given["images"] is None:
        raise click.UsageError("nothing to write: give -o drive.sfs, --depth DIR or --visualize DIR")
    options.needs("--depth-format", given["depth_format"], "--depth DIR", given["depth"])
    options.needs("--visualize-every", given["images_every"], "--visualize DIR", given["images"])
    from sceneloom.colouring.visibility import VisibilitySettings
    from sceneloom.formats.base.registry import open_scene
    from sceneloom.fusion.configuration import FusionConfiguration
    from sceneloom.pipeline.fusing import FusionOutputs
    from sceneloom.pipeline.fusing import fuse as fuse_scene
    from sceneloom.pipeline.warm_up import compile_for
    from sceneloom.stages import timed

    algorithm = options.stated(fusion_algorithm=given.pop("algorithm"))
    configuration = FusionConfiguration(visibility=options.take(VisibilitySettings, given), **algorithm)
    outputs = options.take(FusionOutputs, given, scene=output)
    own: dict[str, Any] = {"outputs": outputs, "configuration": configuration, "lenient": "lenient" in reading}
    with timed() as stages, open_scene(path, **reading) as scene, printer.progress("fusing") as progress:
        compile_for("fuse", scene)
        report = fuse_scene(scene, progress=progress, **own, **given)
    printer.show(report, _print_fusion, outputs, stages=stages)


def _print_fusion(report: "FusionReport", outputs: "FusionOutputs", printer: Printer) -> None:
    """Print what was fused, what was left out and why, and where it is."""
    trajectory = "the sensors' own poses" if report.trajectory is None else f"trajectory {report.trajectory}"
    click.echo(
        f"fused {report.fused} of {several(report.frames, 'sweep')} by {trajectory} "
        f"in {report.seconds:.1f} s ({report.frames_per_second:.1f} sweeps a second)"
    )
    click.echo(f"{several(report.points, 'point')}, {report.coloured_percent:.1f} % coloured")
    rows = []
    for camera in report.cameras:
        unpaired = f"{several(camera.unpaired, 'sweep')} without an image" if camera.unpaired else ""
        unposed = f"{several(camera.unposed, 'image')} beyond the trajectory" if camera.unposed else ""
        rows.append(
            [
                str(camera.camera),
                several(camera.images, "image"),
                f"{camera.in_image_percent:.1f} % of the points in it",
                f"{camera.hidden_percent:.1f} % of these hidden",
                f"{camera.coloured} coloured",
                ", ".join(filter(None, [unpaired, unposed])),
            ]
        )
    print_table(rows)
    printer.blind(str(camera.camera) for camera in report.cameras if camera.paired and not camera.in_image_percent)
    if report.extrapolated:
        sweeps = several(report.extrapolated, "sweep")
        click.echo(f"{sweeps} used poses beyond the trajectory's ends, by at most one sweep period")
    for reason, count in report.unfused.items():
        click.echo(f"{several(count, 'sweep')} kept unfused: {reason}")
    if report.skipped:
        count = len(report.skipped)
        click.echo("1 sweep or image skipped" if count == 1 else f"{count} sweeps or images skipped")
    if report.depth_beyond_range:
        click.echo(
            f"{report.depth_beyond_range} depth pixels beyond 255.99 m were written as 0; --depth-format npz keeps them"
        )
    locations = {"scene": outputs.scene, "depth images": outputs.depth, "images": outputs.images}
    print_outputs(locations, report.files)
    printer.remarks(report)


def _fuse_detections(
    path: Path | str,
    output: Path | None,
    form: str | None,
    printer: Printer,
    reading: dict[str, Any],
    given: dict[str, Any],
) -> None:
    """Fuse the detections of a drive, or of a folder laid out like KITTI's tracking benchmark."""
    if output is None:
        raise click.UsageError(
            "nothing to write: give -o objects.jsonl, or -o FOLDER for a folder of KITTI's sequences"
        )
    from sceneloom.detections.settings import ProjectionSettings
    from sceneloom.fusion.configuration import FusionConfiguration
    from sceneloom.pipeline.fusing_detections import fuse_detections
    from sceneloom.pipeline.warm_up import compile_for_boxes

    chosen = detection_options.detection_input(given)
    detectors = given["detectors"]
    compile_for_boxes("detections")
    with printer.progress("fusing") as progress:
        report = fuse_detections(
            path,
            output,
            chosen=chosen,
            configuration=FusionConfiguration(**options.stated(detection_algorithm=given["algorithm"])),
            settings=None if detectors is None else ProjectionSettings(detectors=detectors),
            overwrite=given["overwrite"],
            lenient=reading.pop("lenient", False),
            reading=reading | options.stated(start=given["start"], stop=given["stop"]),
            progress=progress,
            **options.stated(form=form),
        )
    printer.show(report, _print_detections)


def _print_detections(report: "DetectionFusionReport", printer: Printer) -> None:
    print_table(
        [
            one.name,
            several(one.pairs, "pair"),
            several(one.objects, "object"),
            f"{one.both} of both, {one.sweeps_only} of sweeps alone, {one.images_only} of images alone",
            f"{several(one.unpaired, 'sweep')} without an image" if one.unpaired else "",
        ]
        for one in report.drives
    )
    click.echo(f"fused {several(len(report.drives), 'drive')} in {report.seconds:.1f} s: {report.output}")
    printer.warnings(report.warnings)


@click.command(cls=Verb, examples=("", "--keep street --frames 50"))
@option("--keep=DIR", "Folder for the drive, the scene and the images.", options.target, default=Path("sceneloom-demo"))
@option("--seed", "Random seed of the street.", int, default=0)
@option("--frames", "Lidar sweeps at 10 Hz.", click.IntRange(min=2), default=15)
@option("--video=h264|png", "Format of the drive's images.", default="h264")
@option("--overwrite", "Replace an earlier demo.")
@verb
def demo(keep: Path, seed: int, frames: int, video: str, overwrite: bool, printer: Printer) -> None:
    """Simulate a small drive through a street, fuse it, and show the result."""
    from sceneloom.formats.base.output import check_output, replacing

    begun = time.perf_counter()
    recording = keep / "drive"
    fused, depth, images, first_image = (keep / name for name in ("drive.sfs", "depth", "images", "first_image.png"))
    keep.mkdir(parents=True, exist_ok=True)
    for location in (recording, fused, depth, images, first_image):
        check_output(location, overwrite=overwrite)
    if not printer.quiet:
        click.echo(f"making a drive of {frames / 10:g} s through a synthetic street …", err=True)

    from sceneloom.pipeline.warm_up import compiling_for_demo

    with compiling_for_demo() as wait_for_simulation:
        from sceneloom.formats.base.images import encode_png
        from sceneloom.formats.base.registry import open_scene, write_scene
        from sceneloom.pipeline.fusing import FusionOutputs
        from sceneloom.pipeline.fusing import fuse as fuse_scene
        from sceneloom.simulate.drive import demo_drive

        outputs = FusionOutputs(scene=fused, depth=depth, images=images, overwrite=overwrite)
        wait_for_simulation()
        drive = demo_drive(seed=seed, frames=frames).scene
        with replacing(first_image, overwrite=overwrite) as draft:
            draft.write_bytes(encode_png(drive.cameras[0].images[0].rgb))
        if not printer.quiet:
            click.echo(f"its first image: {first_image}; fusing what follows …", err=True)
        written = write_scene(drive, recording, overwrite=overwrite, images=video)
    with open_scene(recording) as scene, printer.progress("fusing") as progress:
        report = fuse_scene(scene, outputs=outputs, progress=progress)
    if printer.as_json:
        printer.show(report, _print_fusion)
        return
    _print_fusion(report, outputs, replace(printer, quiet=printer.quiet or not printer.verbose))
    click.echo(f"recording: {recording}")
    if printer.verbose:
        printer.losses(written)
    elif not printer.quiet:
        # whoever begins has not asked yet what formats cannot hold
        notes = several(len([*report.warnings, *report.losses, *written]), "note")
        click.echo(f"{notes} on what these files cannot hold of the drive: `--verbose` lists them", err=True)
    click.echo(f"all in {time.perf_counter() - begun:.1f} s")
    click.echo(f"look at {images / 'cloud_drive_perspective.png'} and what is beside it; then try")
    click.echo(f"  sceneloom info {recording}")
    click.echo(f"  sceneloom info {keep / 'drive.sfs'}")
    click.echo("  sceneloom fuse YOUR_DRIVE -o YOUR_DRIVE.sfs --visualize images")
