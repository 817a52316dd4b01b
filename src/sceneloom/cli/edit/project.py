"""`sceneloom edit project`: where the cameras see the cuboids."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.edit.running import chosen_trajectory, common, editing, run_edit, trajectory
from sceneloom.cli.identifiers import known_id_or_none, known_ids

if TYPE_CHECKING:
    from sceneloom.scene.scene import Scene


@click.command()
@editing
@trajectory
@click.option(
    "--camera",
    "cameras",
    multiple=True,
    metavar="ID",
    help="The only cameras to look through. [default: all]",
)
@click.option(
    "--min-pixels",
    type=options.not_negative,
    default=1.0,
    show_default=True,
    metavar="N",
    help="What is narrower or lower than this in an image is not seen.",
)
@click.option(
    "--see-through",
    multiple=True,
    metavar="LABEL",
    help="What fills little of its cuboid, such as trees, and hides nothing.",
)
@click.option("--lidar", metavar="ID", help="Ask the points of this lidar, too, what hides a cuboid.")
@click.option("--activations", is_flag=True, help="Also report when each camera sees each cuboid.")
@common
def project(
    path: Path,
    output: Path,
    trajectory: str | None,
    heading: str | None,
    cameras: tuple[str, ...],
    min_pixels: float,
    see_through: tuple[str, ...],
    lidar: str | None,
    activations: bool,
    **common: Any,
) -> None:
    """See the cuboids with the cameras: boxes in each image, shares cut off and hidden."""
    from sceneloom.colouring.cuboid_projection import project_cuboids
    from sceneloom.scene.annotations import CuboidAnnotation

    details: dict[str, Any] = {}

    def change(scenes: "Sequence[Scene]", _: Any) -> "Scene":
        projected = project_cuboids(
            scenes[0],
            cameras=known_ids(scenes[0], cameras) or "all",
            trajectory=chosen_trajectory(scenes[0], trajectory, heading),
            min_pixels=min_pixels,
            see_through=see_through,
            lidar=known_id_or_none(scenes[0], lidar),
            activations=activations,
        )
        cuboids = [each for each in projected.annotations if isinstance(each, CuboidAnnotation)]
        details["cuboids"] = len(cuboids)
        details["cuboids_seen"] = sum(bool(each.projections) for each in cuboids)
        details["projections"] = sum(len(each.projections) for each in cuboids)
        return projected

    run_edit("project", [path], output, change, details=details, **common)
