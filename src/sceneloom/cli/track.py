"""`sceneloom track`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import detection_options, options
from sceneloom.cli.printing import print_json, print_losses, print_notices, print_table, progress_bar, several

if TYPE_CHECKING:  # the pipeline takes seconds to import, and `--help` needs none of it
    from sceneloom.pipeline.track_report import TrackReport


@click.command()
@click.argument("path", type=options.place)
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
    help="Boxes in pictures: by those found there, or outlines of the boxes in space. [default: image]",
)
@detection_options.takes
@options.way(further="`identity`: it stood still")
@click.option("--algorithm", metavar="NAME", help="Algorithm of detection fusion. [default: projection]")
@click.option(
    "--pictures",
    type=options.target,
    metavar="DIR",
    help="Draw a dozen moments: over photographs and from above.",
)
@click.option("--overwrite", is_flag=True, help="Replace outputs that exist.")
@options.reading
@options.printing
def track(
    path: Path | str,
    output: Path,
    form: str | None,
    offline: bool,
    box2d: str | None,
    detectors: str | None,
    algorithm: str | None,
    pictures: Path | None,
    overwrite: bool,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **given: Any,
) -> None:
    """Follow objects through a drive by what detectors found in its sweeps and pictures.

    PATH is a folder laid out like KITTI's tracking benchmark, a drive with --boxes2d and --boxes3d, or what `sceneloom
    fuse --type detection` wrote.
    """
    from sceneloom.detections.settings import ProjectionSettings
    from sceneloom.pipeline.tracking import TrackingSettings
    from sceneloom.tracking import PictureBox

    how: dict[str, Any] = {
        "form": form,
        "pictures": pictures,
        "settings": TrackingSettings(
            offline=offline,
            fusion=None if detectors is None else ProjectionSettings(detectors=detectors),
            **options.said(algorithm=algorithm),
        ),
        "overwrite": overwrite,
        **({} if box2d is None else {"box2d": PictureBox(box2d)}),
    }
    with progress_bar("tracking", quiet=quiet) as progress:
        report = _track(path, output, {**how, "progress": progress}, given)
    if as_json:
        print_json(report)
    else:
        print_tracking(report, quiet=quiet, verbose=verbose)


def _track(path: Path | str, output: Path, how: dict[str, Any], given: dict[str, Any]) -> "TrackReport":
    """Track what the path holds."""
    from sceneloom.formats import open_scene
    from sceneloom.formats.kitti import open_tracking_folder
    from sceneloom.pipeline.detected_scene import scene_drive
    from sceneloom.pipeline.fused_files import fused_files
    from sceneloom.pipeline.tracked_files import TrackableDrive, track_folder, track_into, track_many

    reading = {name: value for name, value in given.items() if name not in _OWN}
    if detection_options.is_kitti_folder(path) and not given["boxes3d"] and not given["boxes2d"]:
        detection_options.refuse(
            given, detection_options.OF_FILES, f"{path} is a folder of KITTI's sequences"
        )
        tracking = open_tracking_folder(
            path, detector_2d=given["det2d"], detector_3d=given["det3d"], lenient=reading["lenient"]
        )
        return track_folder(tracking, output, sequences=given["sequences"], **how)
    detection_options.refuse(given, detection_options.OF_FOLDERS, f"{path} is no folder of KITTI's sequences")
    fused = () if given["boxes3d"] or given["boxes2d"] else fused_files(Path(path))
    if fused and Path(path).is_dir():
        return track_many(
            lambda k: TrackableDrive.of_fused(fused[k]), len(fused), output, source=str(path), **how
        )
    if fused:
        return track_into(TrackableDrive.of_fused(fused[0]), output, **how)
    with open_scene(path, **options.said(**reading)) as scene:
        files = detection_options.files_of(scene, given)
        drive = scene_drive(scene, files, lenient=reading["lenient"])
        return track_into(TrackableDrive(drive, scene), output, **how)


_OWN = (*detection_options.OF_FILES, *detection_options.OF_FOLDERS)
"""Options that do not concern the reading of a drive."""


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
        print_notices(report.notices, verbose=verbose)
        print_losses(report.losses, verbose=verbose)
