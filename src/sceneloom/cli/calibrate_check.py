"""`sceneloom calibrate --check`."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.identifiers import known_id_or_none
from sceneloom.cli.printing import print_json, print_table, several

if TYPE_CHECKING:
    from sceneloom.calibrate.health.check import CalibrationHealth
    from sceneloom.calibrate.health.verdicts import Item

EXIT_CODES = MappingProxyType({"good": 0, "drifting": 3, "wrong": 4, "cannot tell": 5})
"""What each verdict means to the shell."""


def check_health(
    path: Path | str,
    *,
    camera_id: str | None,
    lidar_id: str | None,
    most: int,
    start: float | None,
    stop: float | None,
    pictures: Path | None,
    overwrite: bool,
    as_json: bool,
    verbose: bool,
    reading: Mapping[str, Any],
) -> int:
    """Check a calibration, print what came out, draw pictures where these are asked for; give the exit code."""
    from sceneloom.calibrate.frames import calibration_frames
    from sceneloom.calibrate.health.check import check_frames
    from sceneloom.formats import open_scene
    from sceneloom.formats.output import check_output
    from sceneloom.pictures.calibration import save_calibration_pictures
    from sceneloom.scene.part import cut_scene

    if pictures is not None:
        is_empty = pictures.is_dir() and not any(pictures.iterdir())
        check_output(pictures, overwrite=overwrite or is_empty)
    with open_scene(path, **options.said(**reading)) as scene:
        part = cut_scene(scene, start=start, stop=stop)
        frames = calibration_frames(
            part,
            known_id_or_none(part, camera_id),
            known_id_or_none(part, lidar_id),
            most,
        )
        health = check_frames(frames, source=scene.source)
    if pictures is not None:
        save_calibration_pictures(frames, health, pictures, overwrite=overwrite)
    if as_json:
        print_json(health)
    else:
        _print_health(health, verbose=verbose)
        if pictures is not None:
            click.echo(f"pictures: {pictures}")
    return EXIT_CODES[health.verdict]


def _print_health(health: "CalibrationHealth", *, verbose: bool) -> None:
    looked = f"{several(health.frames, 'picture')} of {several(health.views, 'view')}"
    click.echo(f"{health.source}: {health.camera_id} to {health.lidar_id}: {health.verdict} ({looked})")
    reasons = {item.reason for item in health.items}
    if len(reasons) == 1 and reasons != {""}:
        click.echo(f"nothing can be told: {reasons.pop()}")
    else:
        print_table([("part", "verdict", "to be changed by", "why"), *map(_row, health.items)])
    stated, best = health.stated_distinctness, health.distinctness
    click.echo(f"agreement above chance: {stated:.1f} deviations as stated, {best:.1f} at best")
    if verbose:
        rows = [(name, f"{here:.1f}", f"{there:.1f}") for name, (here, there) in health.measures.items()]
        print_table([("measure", "as stated", "at best"), *rows])


def _row(item: "Item") -> tuple[str, ...]:
    numbers = ", ".join(f"{v:+.2f} ± {s:.2f}" for v, s in zip(item.values, item.sigmas, strict=True))
    return (
        item.name.replace("_", " "),
        str(item.verdict),
        f"{numbers} {item.unit}" if numbers else "-",
        item.reason,
    )
