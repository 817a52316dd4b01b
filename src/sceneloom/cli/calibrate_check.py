"""`sceneloom calibrate --check`."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import detection_options, options
from sceneloom.cli.identifiers import known_id_or_none
from sceneloom.cli.printing import print_corrections, print_json, print_table, several

if TYPE_CHECKING:
    from sceneloom.calibrate.health import CalibrationHealth, Item

EXIT_CODES = MappingProxyType({"good": 0, "drifting": 3, "wrong": 4, "cannot determine": 5})
"""What each verdict means to the shell."""


BOXES = ("boxes3d", "boxes2d", "det2d", "det3d", "sequences", "motion")
"""The names of the arguments of boxes and of motion."""


_MOTION = click.option(
    "--motion", is_flag=True, help="With --check: compare how camera and lidar rotate, too; takes longer."
)


def box_options(command: Any) -> Any:
    """Add lists of boxes, and the choices in a folder of KITTI's sequences, to a command."""
    return detection_options.added(
        command, (*detection_options.FILES[:2], *detection_options.FOLDERS, _MOTION)
    )


def check_health(
    path: Path | str,
    *,
    camera_id: str | None,
    lidar_id: str | None,
    most: int,
    start: float | None,
    stop: float | None,
    images: Path | None,
    overwrite: bool,
    as_json: bool,
    verbose: bool,
    boxes: Mapping[str, Any],
    reading: Mapping[str, Any],
) -> int:
    """Check a calibration, print what came out, draw images where these are asked for; give the exit code."""
    from sceneloom.formats.base.output import check_output
    from sceneloom.formats.base.registry import open_scene
    from sceneloom.formats.kitti.tracking_reader import is_tracking_folder
    from sceneloom.pipeline.calibrating import check_drive
    from sceneloom.visualization.calibration import save_calibration_images

    if not (boxes["boxes3d"] or boxes["boxes2d"]) and is_tracking_folder(Path(path)):
        useless = {
            "camera": camera_id, "lidar": lidar_id, "start": start is not None, "stop": stop is not None,
            "images": images, "motion": boxes["motion"],
        }  # fmt: skip
        detection_options.refuse(
            useless, tuple(useless), "a folder of KITTI's sequences is judged by its boxes"
        )
        return _check_folder(path, boxes, lenient=reading["lenient"], as_json=as_json, verbose=verbose)
    detection_options.refuse(
        dict(boxes), BOXES[2:4], f"{path} is no folder of KITTI's sequences, or has lists beside it"
    )
    reading = {**reading, "sequence": options.one_sequence(boxes["sequences"])}
    if images is not None:
        is_empty = images.is_dir() and not any(images.iterdir())
        check_output(images, overwrite=overwrite or is_empty)
    with open_scene(path, **options.stated(**reading)) as scene:
        found = check_drive(
            scene, known_id_or_none(scene, camera_id), known_id_or_none(scene, lidar_id), most=most, start=start,
            stop=stop, boxes_3d=boxes["boxes3d"], boxes_2d=boxes["boxes2d"],
            motion=boxes["motion"], lenient=reading["lenient"],
        )  # fmt: skip
    if images is not None:
        save_calibration_images(found.frames, found.health, images, overwrite=overwrite)
    if as_json:
        print_json(found.health)
    else:
        _print_health(found.health, verbose=verbose)
        print_corrections(found.health.corrections)
        if images is not None:
            click.echo(f"images: {images}")
    return EXIT_CODES[found.health.verdict]


def _check_folder(
    path: Path | str, boxes: Mapping[str, Any], *, lenient: bool, as_json: bool, verbose: bool
) -> int:
    """Check each sequence of a folder by its boxes; the worst gives the exit code."""
    from sceneloom.formats.kitti.tracking_reader import open_tracking_folder
    from sceneloom.pipeline.calibrating import check_sequences

    tracking = open_tracking_folder(
        path, detector_2d=boxes["det2d"], detector_3d=boxes["det3d"], lenient=lenient
    )
    found = check_sequences(tracking, boxes["sequences"])
    if as_json:
        print_json(found)
    else:
        for health in found:
            _print_health(health, verbose=verbose)
    verdicts = {str(health.verdict) for health in found}
    return EXIT_CODES[next(verdict for verdict in _WORST_FIRST if verdict in verdicts)]


_WORST_FIRST = ("wrong", "drifting", "cannot determine", "good")


def _print_health(health: "CalibrationHealth", *, verbose: bool) -> None:
    looked = several(health.frames, "image")
    if health.views:
        looked += f" of {several(health.views, 'view')}"
    click.echo(f"{health.source}: {health.camera_id} to {health.lidar_id}: {health.verdict} ({looked})")
    reasons = {item.reason for item in health.items}
    if len(reasons) == 1 and reasons != {""}:
        click.echo(f"nothing can be reported: {reasons.pop()}")
    else:
        reported = [item for item in health.items if health.views or item.name.startswith("boxes")]
        print_table([("part", "verdict", "to be changed by", "why"), *map(_row, reported)])
    if not health.views:
        return
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
