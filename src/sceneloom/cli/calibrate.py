"""`sceneloom calibrate`."""

from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.calibrate_conventions import check_conventions
from sceneloom.cli.calibrate_repair import asked_repair, repair_calibration, repair_options
from sceneloom.cli.identifiers import known_id
from sceneloom.cli.printing import print_json, print_table, several

if TYPE_CHECKING:
    from sceneloom.calibrate.health.check import CalibrationHealth
    from sceneloom.calibrate.health.verdicts import Item

EXIT_CODES = MappingProxyType({"good": 0, "drifting": 3, "wrong": 4, "cannot tell": 5})
"""What each verdict means to the shell."""


@click.command()
@click.argument("path", type=options.place)
@click.option("--check", is_flag=True, help="Say whether the calibration is right. The default.")
@click.option(
    "--conventions",
    is_flag=True,
    help="Say what the extrinsics of PATH mean, a drive or a file of numbers: direction, layout, order, unit, axes.",
)
@click.option(
    "--drive",
    type=options.place,
    metavar="DRIVE",
    help="With --conventions of a file: the drive to judge it by.",
)
@repair_options
@click.option("--camera", "camera_id", metavar="ID", help="The camera. [default: the first with pictures]")
@click.option("--lidar", "lidar_id", metavar="ID", help="The lidar. [default: the first with sweeps]")
@click.option(
    "--most",
    type=click.IntRange(min=1),
    default=20,
    show_default=True,
    metavar="N",
    help="Look at N pictures at most, spread over the drive.",
)
@click.option(
    "--pictures", type=options.target, metavar="DIR", help="Draw points and edges over pictures into DIR."
)
@click.option("--overwrite", is_flag=True, help="Replace DIR if it exists.")
@options.part
@options.reading
@options.printing
@click.pass_context
def calibrate(
    context: click.Context,
    /,
    path: Path | str,
    check: bool,
    conventions: bool,
    drive: Path | str | None,
    camera_id: str | None,
    lidar_id: str | None,
    most: int,
    pictures: Path | None,
    overwrite: bool,
    start: float | None,
    stop: float | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **reading: Any,
) -> None:
    """Check how a camera is said to lie to a lidar by what both show: rotation, shift, focal length, time.

    Exit 0 where the calibration is good, 3 where it is drifting, 4 where it is wrong, 5 where the drive cannot tell.
    """
    asked = asked_repair(reading)
    if check + conventions + (asked is not None) > 1:
        raise click.UsageError("--check, --conventions and a repair: say one of them")
    if drive is not None and not conventions:
        raise click.UsageError("--drive DRIVE does nothing without --conventions")
    if conventions:
        code = check_conventions(
            path, drive, camera_id=camera_id, lidar_id=lidar_id, as_json=as_json, quiet=quiet, reading=reading
        )
        context.exit(code)
    if asked is not None:
        code = repair_calibration(
            path, asked, camera_id=camera_id, lidar_id=lidar_id, most=most, start=start, stop=stop,
            pictures=pictures, overwrite=overwrite, as_json=as_json, quiet=quiet, reading=reading,
        )  # fmt: skip
        context.exit(code)
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
            None if camera_id is None else known_id(part, camera_id),
            None if lidar_id is None else known_id(part, lidar_id),
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
    context.exit(EXIT_CODES[health.verdict])


def _print_health(health: "CalibrationHealth", *, verbose: bool) -> None:
    looked = f"{several(health.frames, 'picture')} of {several(health.views, 'view')}"
    click.echo(f"{health.source}: {health.camera_id} to {health.lidar_id}: {health.verdict} ({looked})")
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
