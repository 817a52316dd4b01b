"""`sceneloom track`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import detection_options, options
from sceneloom.cli.help import Verb
from sceneloom.cli.options import option
from sceneloom.cli.printing import Printer, print_table, several
from sceneloom.cli.running import rewriting_verb

if TYPE_CHECKING:  # the pipeline takes seconds to import, and `--help` needs none of it
    from sceneloom.pipeline.tracking import TrackReport


@click.command(
    cls=Verb,
    examples=(
        "kitti_tracking/ --sequence 0000 -o tracks/",
        "drive.sfs --boxes3d lidar.jsonl --boxes2d camera.jsonl -o labels.sfs",
    ),
)
@click.argument("path", type=options.location)
@options.output("The file or folder to write.")
@option(
    "--format=kitti|sfs|jsonl form",
    "KITTI's text of results, a scene with labels, or JSON lines. [default: by the suffix, else kitti]",
)
@option("--offline", "Smooth states over the drive, and fill gaps.")
@option(
    "--box2d=image|projected",
    "Boxes in images: those detected there, or outlines of the boxes in space. [default: image]",
)
@detection_options.fused
@options.trajectory(options.STATIONARY)
@option(
    "--algorithm=NAME|FILE.py:FUNCTION",
    "Algorithm of detection fusion, or a function of a Python file. [default: projection]",
)
@options.visualize("Draw a dozen moments into DIR: over images and from above.")
@options.part
@rewriting_verb
def track(
    path: Path | str, output: Path, printer: Printer, reading: dict[str, Any], box2d: str | None, **given: Any
) -> None:
    """Track objects through a drive by detections in its sweeps and images.

    PATH is a folder laid out like KITTI's tracking benchmark, a drive with --boxes2d and --boxes3d, or what `sceneloom
    fuse --type detection` wrote.
    """
    from sceneloom.detections.settings import ProjectionSettings
    from sceneloom.pipeline.tracking import TrackingSettings, track_objects
    from sceneloom.pipeline.warm_up import compile_for_boxes
    from sceneloom.tracking.settings import ImageBox

    chosen, detectors = detection_options.detection_input(given), given["detectors"]
    fusion = None if detectors is None else ProjectionSettings(detectors=detectors)
    compile_for_boxes("track")
    with printer.progress("tracking") as progress:
        report = track_objects(
            path,
            output,
            chosen=chosen,
            form=given["form"],
            images=given["images"],
            settings=options.take(TrackingSettings, given, fusion=fusion),
            overwrite=given["overwrite"],
            scene_options=options.stated(profile=given["profile"], time_unit=given["time_unit"]),
            lenient=reading.pop("lenient", False),
            reading=reading | options.stated(start=given["start"], stop=given["stop"]),
            progress=progress,
            **options.stated(box2d=box2d and ImageBox(box2d)),
        )
    printer.show(report, _print_tracking)


def _print_tracking(report: "TrackReport", printer: Printer) -> None:
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
    printer.remarks(report)
