"""`sceneloom edit lens`: lenses told by another model."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.edit.running import common, editing, run_edit
from sceneloom.cli.identifiers import known_ids

if TYPE_CHECKING:
    from sceneloom.scene.scene import Scene


@click.command()
@editing
@click.option("--model", required=True, metavar="NAME", help="The projection model of the new lenses.")
@click.option(
    "--camera", "cameras", multiple=True, metavar="ID", help="The only cameras to change. [default: all]"
)
@click.option(
    "--limit",
    type=options.not_negative,
    default=1.0,
    show_default=True,
    metavar="PX",
    help="Refuse a lens that is further off than so many pixels anywhere in the picture.",
)
@click.option(
    "--share",
    type=options.not_negative,
    default=0.99,
    show_default=True,
    metavar="S",
    help="Refuse a lens that holds less than this share of the picture, 0 to 1.",
)
@common
def lens(
    path: Path, output: Path, model: str, cameras: tuple[str, ...], limit: float, share: float, **common: Any
) -> None:
    """Tell the lenses by another model, fitted as near as it comes; pictures stay as they are."""
    from sceneloom.editing.lenses import convert_lenses

    def change(scenes: "Sequence[Scene]", _: Any) -> "Scene":
        chosen = known_ids(scenes[0], cameras)
        return convert_lenses(scenes[0], model, cameras=chosen, limit_px=limit, share=share)

    run_edit("lens", [path], output, change, **common)
