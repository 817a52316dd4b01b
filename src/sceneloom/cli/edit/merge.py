"""`sceneloom edit merge`: several scenes of one drive made one."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.edit.running import OUTPUT, common, run_edit

if TYPE_CHECKING:
    from sceneloom.editing.move_points import OnPoints
    from sceneloom.scene.scene import Scene


@click.command()
@click.argument("paths", nargs=-1, required=True, type=options.location)
@OUTPUT
@click.option("--rename", is_flag=True, help="Give new ids to sensors and annotations whose ids are taken.")
@click.option(
    "--join", is_flag=True, help="Take sensors and annotations of equal ids for consecutive parts of one."
)
@click.option(
    "--force",
    is_flag=True,
    help="Merge scenes, too, that are of different drives by city, time, fixes or ego poses.",
)
@common
def merge(
    paths: tuple[Path | str, ...], output: Path, rename: bool, join: bool, force: bool, **common: Any
) -> None:
    """Make one scene of several scenes of one drive on one clock."""
    from sceneloom.editing.merge import merge_scenes

    def change(scenes: "Sequence[Scene]", on_points: "OnPoints") -> "Scene":
        del on_points
        return merge_scenes(scenes, rename=rename, join=join, force=force)

    run_edit("merge", paths, output, change, **common)
