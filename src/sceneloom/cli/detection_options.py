"""Options of the verbs that take what detectors found, and what a path with detections is."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options

if TYPE_CHECKING:
    from sceneloom.pipeline.detection_jobs import DetectionInput

FILES = (
    click.option(
        "--boxes3d",
        multiple=True,
        type=options.source(),
        metavar="FILE",
        help="Boxes found in the sweeps: JSON lines of table 7, nuScenes' JSON, KITTI's text; may be repeated.",
    ),
    click.option(
        "--boxes2d",
        multiple=True,
        type=options.source(),
        metavar="FILE",
        help="Boxes found in images: JSON lines of table 8, KITTI's text; may be repeated.",
    ),
    click.option("--lidar", metavar="ID", help="Whose boxes --boxes3d has, where there are several lidars."),
    click.option(
        "--camera",
        "cameras",
        multiple=True,
        metavar="ID",
        help="Whose boxes --boxes2d has, where there are several cameras; one for each file.",
    ),
)
"""Lists of boxes beside a scene."""

FOLDERS = (
    click.option(
        "--det2d", metavar="NAME", help="Which of several folders det2d_* holds the boxes of images."
    ),
    click.option(
        "--det3d", metavar="NAME", help="Which of several folders det3d_* holds the boxes of sweeps."
    ),
    click.option(
        "--sequence", "sequences", multiple=True, metavar="NAME", help="Only this sequence; may be repeated."
    ),
)
"""Choices in a folder laid out like KITTI's tracking benchmark."""

NAMES = ("boxes3d", "boxes2d", "lidar", "cameras", "det2d", "det3d", "sequences", "detectors")
"""The names of the arguments; the ego trajectory is an option of other verbs, too."""


DETECTORS = click.option(
    "--detectors",
    metavar="NAME",
    help="What is known of the detectors: a name, or a TOML file. [default: in KITTI's folders those of KITTI, else "
    "simulated ones]",
)
"""What fusion goes by."""


def takes(command: Any) -> Any:
    """On every verb that takes detections."""
    return added(command, (*FILES, *FOLDERS, DETECTORS))


def added(command: Any, options_of_detections: Sequence[Any]) -> Any:
    """Add options to a verb that reads drives: `--sequence` may then be repeated."""
    parameters = getattr(command, "__click_params__", [])
    parameters[:] = [parameter for parameter in parameters if parameter.name != "sequence"]
    for option in reversed(options_of_detections):
        command = option(command)
    return command


def refuse(given: dict[str, Any], names: Sequence[str], why: str) -> None:
    """Refuse options that state nothing about such an input.

    Raises:
        click.UsageError: one was stated.
    """
    for name in names:
        if given.get(name):
            flag = {"cameras": "camera", "sequences": "sequence"}.get(name, name).replace("_", "-")
            raise click.UsageError(f"--{flag} does not count here: {why}")


def chosen(given: dict[str, Any]) -> "DetectionInput":
    """What of a path is fused or tracked."""
    from sceneloom.pipeline.detection_jobs import DetectionInput
    from sceneloom.pipeline.detection_lists import DetectionFiles

    return DetectionInput(
        files=DetectionFiles(
            boxes_3d=given["boxes3d"],
            boxes_2d=given["boxes2d"],
            lidar=given["lidar"],
            cameras=given["cameras"],
            trajectory=given["trajectory"],
            heading=given["heading"],
        ),
        detector_2d=given["det2d"],
        detector_3d=given["det3d"],
        sequences=given["sequences"],
    )


def reading(given: dict[str, Any]) -> dict[str, Any]:
    """The options of opening a drive that were stated, without `lenient`."""
    ours = (*NAMES, "trajectory", "heading", "lenient")
    return options.stated(**{name: value for name, value in given.items() if name not in ours})
