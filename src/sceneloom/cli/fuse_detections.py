"""`sceneloom fuse --type detection`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import detection_options, options
from sceneloom.cli.printing import print_json, print_table, print_warnings, progress_bar, several

if TYPE_CHECKING:  # the pipeline takes seconds to import, and `--help` needs none of it
    from sceneloom.pipeline.fusing_detections import DetectionFusionReport


def fuse_found(
    path: Path | str,
    output: Path | None,
    given: dict[str, Any],
    *,
    algorithm: str | None,
    form: str | None,
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
            "nothing to write: state -o objects.jsonl, or -o FOLDER for a folder of KITTI's sequences"
        )
    from sceneloom.detections.settings import ProjectionSettings
    from sceneloom.fusion.configuration import FusionConfiguration
    from sceneloom.pipeline.detection_jobs import fuse_detections

    how: dict[str, Any] = {
        "configuration": FusionConfiguration(**options.stated(detection_algorithm=algorithm)),
        "overwrite": overwrite,
        **options.stated(form=form),
        "settings": None if given["detectors"] is None else ProjectionSettings(detectors=given["detectors"]),
    }
    with progress_bar("fusing", quiet=quiet) as progress:
        report = fuse_detections(
            path,
            output,
            chosen=detection_options.chosen(given),
            lenient=reading["lenient"],
            reading=detection_options.reading(reading),
            progress=progress,
            **how,
        )
    if as_json:
        print_json(report)
    else:
        _print(report, quiet=quiet, verbose=verbose)


def _print(report: "DetectionFusionReport", *, quiet: bool, verbose: bool) -> None:
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
    if not quiet:
        print_warnings(report.warnings, verbose=verbose)
