"""Options of the verbs that take what detectors found, and what a path with detections is."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli.identifiers import known_id, known_id_or_none

if TYPE_CHECKING:
    from sceneloom.pipeline.detected_scene import DetectionFiles
    from sceneloom.scene import Scene

FILES = (
    click.option(
        "--boxes3d",
        multiple=True,
        type=click.Path(path_type=Path),
        metavar="FILE",
        help="Boxes found in the sweeps: JSON lines of table 7, nuScenes' JSON, KITTI's text; may be repeated.",
    ),
    click.option(
        "--boxes2d",
        multiple=True,
        type=click.Path(path_type=Path),
        metavar="FILE",
        help="Boxes found in pictures: JSON lines of table 8, KITTI's text; may be repeated.",
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
        "--det2d", metavar="NAME", help="Which of several folders det2d_* holds the boxes of pictures."
    ),
    click.option(
        "--det3d", metavar="NAME", help="Which of several folders det3d_* holds the boxes of sweeps."
    ),
    click.option(
        "--sequence", "sequences", multiple=True, metavar="NAME", help="Only this sequence; may be repeated."
    ),
)
"""Choices in a folder laid out like KITTI's tracking benchmark."""

OF_FILES = ("boxes3d", "boxes2d", "lidar", "cameras", "trajectory", "heading")
OF_FOLDERS = ("det2d", "det3d", "sequences")
NAMES = ("boxes3d", "boxes2d", "lidar", "cameras", *OF_FOLDERS, "detectors")
"""The names of the arguments; the ego's way is an option of other verbs, too."""


DETECTORS = click.option(
    "--detectors",
    metavar="NAME",
    help="What is known of the detectors: a name, or a TOML file. [default: in KITTI's folders those of KITTI, else "
    "independent ones]",
)
"""What fusion goes by."""


def takes(command: Any) -> Any:
    """On every verb that takes detections."""
    for option in reversed((*FILES, *FOLDERS, DETECTORS)):
        command = option(command)
    return command


def is_kitti_folder(path: "Path | str") -> bool:
    """Whether a path is a folder laid out like KITTI's tracking benchmark."""
    from sceneloom.formats.kitti.tracking_folder import is_tracking_folder

    return is_tracking_folder(Path(path))


def refuse(given: dict[str, Any], names: Sequence[str], why: str) -> None:
    """Refuse options that say nothing about such an input.

    Raises:
        click.UsageError: one was said.
    """
    for name in names:
        if given.get(name):
            flag = {"cameras": "camera", "sequences": "sequence"}.get(name, name).replace("_", "-")
            raise click.UsageError(f"--{flag} does not count here: {why}")


def files_of(scene: "Scene", given: dict[str, Any]) -> "DetectionFiles":
    """The lists of boxes that were named, with the ids of sensors as the scene has them."""
    from sceneloom.pipeline.detected_scene import DetectionFiles

    return DetectionFiles(
        boxes_3d=given["boxes3d"],
        boxes_2d=given["boxes2d"],
        lidar=known_id_or_none(scene, given["lidar"]),
        cameras=tuple(known_id(scene, said) for said in given["cameras"]),
        trajectory=given["trajectory"],
        heading=given["heading"],
    )
