"""`sceneloom calibrate --conventions`: what the extrinsics of a file or a drive mean."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.identifiers import known_id_or_none
from sceneloom.cli.printing import print_corrections, print_json, print_table, progress_bar

if TYPE_CHECKING:
    from sceneloom.calibrate.conventions import ConventionsReport, ExtrinsicFound
    from sceneloom.scene.scene import Scene

WRONG = 4
"""Exit code where something is not what the drive was read with."""


def check_conventions(
    path: Path | str,
    drive: Path | str | None,
    *,
    camera_id: str | None,
    lidar_id: str | None,
    as_json: bool,
    quiet: bool,
    reading: dict[str, Any],
) -> int:
    """Judge a file, by a drive where one is given, or a drive; print what was found, and give the exit code."""
    from sceneloom.calibrate.conventions import check_drive, check_file
    from sceneloom.formats.base.registry import open_scene

    def opened(location: Path | str, judge: Callable[["Scene"], "ConventionsReport"]) -> "ConventionsReport":
        with open_scene(location, **options.stated(**reading)) as scene:
            return judge(scene)

    with progress_bar("judging", quiet=quiet) as progress:
        if drive is not None:
            report = opened(
                drive,
                lambda scene: check_file(
                    Path(path),
                    scene,
                    camera_id=known_id_or_none(scene, camera_id),
                    lidar_id=known_id_or_none(scene, lidar_id),
                    progress=progress,
                ),
            )
        elif _is_drive(path):
            report = opened(path, lambda scene: check_drive(scene, progress=progress))
        else:
            report = check_file(Path(path), progress=progress)
    if as_json:
        print_json(report)
    else:
        print_corrections(report.corrections)
        _print(report, judged_by_drive=drive is not None or _is_drive(path))
    return WRONG if report.wrong else 0


def _is_drive(path: Path | str) -> bool:
    """Whether a path is one of the formats of drives; a file of numbers alone is none."""
    from sceneloom.errors import SceneloomError
    from sceneloom.formats.base.registry import format_and_location

    if Path(path).is_dir() or "://" in str(path):
        return True
    try:
        format_and_location(path)
    except SceneloomError:
        return False
    return True


def _print(report: "ConventionsReport", *, judged_by_drive: bool) -> None:
    click.echo(f"{report.source}:")
    for found in report.extrinsics:
        click.echo(f"{found.location}: {_verdict(found)}: {found.reason}")
        print_table([(f"  {name}", " or ".join(values)) for name, values in found.possible.items()])
    for points in report.points:
        possible = " or ".join(points.possible) or "the drive does not report"
        click.echo(f"points of {points.lidar}: read in {points.stated} coordinates; possible: {possible}")
    for times in report.times:
        units = " or ".join(times.possible) or "no unit fits"
        click.echo(f"timestamps of {times.sensor} ({times.kind}), read as seconds: {units}")
    if report.extrinsics and not judged_by_drive:
        click.echo("judged without a drive: --drive DRIVE lets its points and images report more")


def _verdict(found: "ExtrinsicFound") -> str:
    if found.as_read is not None:
        return "as read" if found.as_read else "NOT as read"
    return "decided" if found.decided else "cannot determine"
