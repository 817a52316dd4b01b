"""`sceneloom edit thin`: fewer points, fewer frames."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli.edit.running import common, editing, run_edit
from sceneloom.cli.identifiers import known_ids

if TYPE_CHECKING:
    from sceneloom.editing.move_points import OnPoints
    from sceneloom.scene.scene import Scene


@click.command()
@editing
@click.option("--voxel", type=float, metavar="M", help="Keep one point of each cube of this side.")
@click.option(
    "--keep",
    type=click.Choice(["nearest", "first"]),
    default="nearest",
    show_default=True,
    help="Which point of a cube stays: the one nearest to their mean, or the first.",
)
@click.option(
    "--share", type=float, metavar="S", help="Keep this share of the points, 0 to 1, evenly spread."
)
@click.option("--points", type=int, metavar="N", help="Keep at most N points of each frame, evenly spread.")
@click.option(
    "--every", type=int, default=1, metavar="N", help="Keep every Nth frame of each lidar, radar and camera."
)
@click.option(
    "--sensor", "sensors", multiple=True, metavar="ID", help="The only sensors to thin. [default: all]"
)
@common
def thin(
    path: Path,
    output: Path,
    voxel: float | None,
    keep: str,
    share: float | None,
    points: int | None,
    every: int,
    sensors: tuple[str, ...],
    **common: Any,
) -> None:
    """Keep fewer points, or fewer frames; labelled points follow."""
    from sceneloom.editing.thin import thin_scene

    def change(scenes: "Sequence[Scene]", on_points: "OnPoints") -> "Scene":
        return thin_scene(
            scenes[0],
            voxel=voxel,
            keep=keep,
            share=share,
            points=points,
            every=every,
            sensors=known_ids(scenes[0], sensors),
            on_points=on_points,
        )

    run_edit("thin", [path], output, change, **common)
