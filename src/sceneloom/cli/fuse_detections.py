"""`sceneloom fuse --type detection`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import detection_options, options
from sceneloom.cli.printing import print_json, print_notices, print_table, progress_bar, several

if TYPE_CHECKING:  # the pipeline takes seconds to import, and `--help` needs none of it
    from sceneloom.pipeline.detection_report import DetectionFusionReport


def fuse_found(
    path: Path | str,
    output: Path | None,
    given: dict[str, Any],
    *,
    algorithm: str | None,
    overwrite: bool,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **reading: Any,
) -> None:
    """Fuse what detectors found in a drive, and print what was fused.

    Args:
        path: a drive, or a folder laid out like KITTI's tracking benchmark.
        output: the file of lines, or the folder.
        given: the options of detections, by name.
        reading: the options of reading.
    """
    if output is None:
        raise click.UsageError(
            "nothing to write: say -o objects.jsonl, or -o FOLDER for a folder of KITTI's sequences"
        )
    from sceneloom.detections.settings import ProjectionSettings
    from sceneloom.fusion import FusionConfiguration

    how: dict[str, Any] = {
        "configuration": FusionConfiguration(**options.said(detection_algorithm=algorithm)),
        "overwrite": overwrite,
        "settings": None if given["detectors"] is None else ProjectionSettings(detectors=given["detectors"]),
    }
    with progress_bar("fusing", quiet=quiet) as progress:
        report = _fuse(path, output, given, reading, {**how, "progress": progress})
    if as_json:
        print_json(report)
    else:
        _print(report, quiet=quiet, verbose=verbose)


def _fuse(
    path: Path | str, output: Path, given: dict[str, Any], reading: dict[str, Any], how: dict[str, Any]
) -> "DetectionFusionReport":
    from sceneloom.formats import open_scene
    from sceneloom.formats.kitti import open_tracking_folder
    from sceneloom.pipeline.detected_scene import scene_drive
    from sceneloom.pipeline.fused_files import fuse_detections, fuse_folder_detections

    lenient = bool(reading["lenient"])
    if detection_options.is_kitti_folder(path) and not given["boxes3d"] and not given["boxes2d"]:
        detection_options.refuse(
            given, detection_options.OF_FILES, f"{path} is a folder of KITTI's sequences"
        )
        tracking = open_tracking_folder(
            path, detector_2d=given["det2d"], detector_3d=given["det3d"], lenient=lenient
        )
        return fuse_folder_detections(tracking, output, sequences=given["sequences"], **how)
    detection_options.refuse(given, detection_options.OF_FOLDERS, f"{path} is no folder of KITTI's sequences")
    with open_scene(path, **options.said(**reading)) as scene:
        drive = scene_drive(scene, detection_options.files_of(scene, given), lenient=lenient)
        return fuse_detections(drive, output, **how)


def _print(report: "DetectionFusionReport", *, quiet: bool, verbose: bool) -> None:
    print_table(
        [
            one.name,
            several(one.pairs, "pair"),
            several(one.objects, "object"),
            f"{one.both} of both, {one.sweeps_only} of sweeps alone, {one.pictures_only} of pictures alone",
            f"{several(one.unpaired, 'sweep')} without a picture" if one.unpaired else "",
        ]
        for one in report.drives
    )
    click.echo(f"fused {several(len(report.drives), 'drive')} in {report.seconds:.1f} s: {report.output}")
    if not quiet:
        print_notices(report.notices, verbose=verbose)
