"""`sceneloom edit camera model`: camera models reported by another model."""

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
@click.option("--model", required=True, metavar="NAME", help="The projection model of the new camera models.")
@click.option(
    "--camera", "cameras", multiple=True, metavar="ID", help="The only cameras to change. [default: all]"
)
@click.option(
    "--limit",
    type=options.not_negative,
    default=1.0,
    show_default=True,
    metavar="PX",
    help="Refuse a camera model that is further off than so many pixels anywhere in the image.",
)
@click.option(
    "--share",
    type=options.not_negative,
    default=0.99,
    show_default=True,
    metavar="S",
    help="Refuse a camera model that holds less than this share of the image, 0 to 1.",
)
@common
def camera_model(
    path: Path, output: Path, model: str, cameras: tuple[str, ...], limit: float, share: float, **common: Any
) -> None:
    """Report the camera models by another model, fitted as near as it comes; images stay as they are."""
    from sceneloom.editing.cameras import convert_camera_models

    def change(scenes: "Sequence[Scene]", _: Any) -> "Scene":
        chosen = known_ids(scenes[0], cameras)
        return convert_camera_models(scenes[0], model, cameras=chosen, limit_px=limit, share=share)

    run_edit("camera_model", [path], output, change, **common)
