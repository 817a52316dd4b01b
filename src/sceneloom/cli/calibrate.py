"""`sceneloom calibrate`."""

from pathlib import Path
from typing import Any

import click

from sceneloom.cli import detection_options, options
from sceneloom.cli.calibrate_check import BOXES, box_options, check_health
from sceneloom.cli.calibrate_conventions import check_conventions
from sceneloom.cli.calibrate_repair import asked_repair, repair_calibration, repair_options


@click.command()
@click.argument("path", type=options.location)
@click.option("--check", is_flag=True, help="Report whether the calibration is right. The default.")
@click.option(
    "--conventions",
    is_flag=True,
    help="Report what the extrinsics of PATH mean, a drive or a file of numbers: direction, layout, order, unit, axes.",
)
@click.option(
    "--drive",
    type=options.location,
    metavar="DRIVE",
    help="With --conventions of a file: the drive to judge it by.",
)
@repair_options
@click.option("--camera", "camera_id", metavar="ID", help="The camera. [default: the first with images]")
@click.option("--lidar", "lidar_id", metavar="ID", help="The lidar. [default: the first with sweeps]")
@click.option(
    "--most",
    type=click.IntRange(min=1),
    default=20,
    show_default=True,
    metavar="N",
    help="Look at N images at most, spread over the drive.",
)
@click.option(
    "--visualize",
    "images",
    type=options.target,
    metavar="DIR",
    help="Draw points and edges over images into DIR.",
)
@click.option("--overwrite", is_flag=True, help="Replace outputs that exist.")
@box_options
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
    images: Path | None,
    overwrite: bool,
    start: float | None,
    stop: float | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **reading: Any,
) -> None:
    """Check how a camera is stated to lie to a lidar by what both show: rotation, shift, focal length, time.

    Exit 0 where the calibration is good, 3 where it is drifting, 4 where it is wrong, 5 where the drive cannot
    determine.

    With --refine, --hand-eye, --lidar-to-lidar or --target repair it: exit 0 where it was, 3 where what is stated was
    kept, 5 where the drive cannot determine.
    """
    asked = asked_repair(reading)
    boxes = {name: reading.pop(name) for name in BOXES}
    if check + conventions + (asked is not None) > 1:
        raise click.UsageError("--check, --conventions and a repair: state one of them")
    if drive is not None and not conventions:
        raise click.UsageError("--drive DRIVE does nothing without --conventions")
    if conventions or asked is not None:
        own = [name for name in BOXES if name != "sequences"]
        detection_options.refuse(boxes, own, "--check looks at it")
        reading["sequence"] = options.one_sequence(boxes["sequences"])
    if conventions:
        code = check_conventions(
            path, drive, camera_id=camera_id, lidar_id=lidar_id, as_json=as_json, quiet=quiet, reading=reading
        )
        context.exit(code)
    if asked is not None:
        code = repair_calibration(
            path, asked, camera_id=camera_id, lidar_id=lidar_id, most=most, start=start, stop=stop,
            images=images, overwrite=overwrite, as_json=as_json, quiet=quiet, reading=reading,
        )  # fmt: skip
        context.exit(code)
    code = check_health(
        path, camera_id=camera_id, lidar_id=lidar_id, most=most, start=start, stop=stop,
        images=images, overwrite=overwrite, as_json=as_json, verbose=verbose, boxes=boxes, reading=reading,
    )  # fmt: skip
    context.exit(code)
