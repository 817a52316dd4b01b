"""`sceneloom edit undistort`: images as cameras without distortion would have taken them."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli.edit.running import common, editing, run_edit
from sceneloom.cli.identifiers import known_ids

if TYPE_CHECKING:
    from sceneloom.scene.scene import Scene

KEEP = {"valid": 0.0, "all": 1.0}


def _size(_context: click.Context, _option: click.Parameter, stated: str | None) -> tuple[int, int] | None:
    match = None if stated is None else re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", stated)
    if stated is not None and match is None:
        raise click.BadParameter(f"{stated!r}; expected width x height in pixels, such as 1280x720")
    return None if match is None else (int(match[1]), int(match[2]))


@click.command()
@editing
@click.option(
    "--camera", "cameras", multiple=True, metavar="ID", help="The only cameras to change. [default: all]"
)
@click.option(
    "--keep",
    type=click.Choice(list(KEEP)),
    default="valid",
    show_default=True,
    help="Show only what fills the image, or all that the old one shows, with black where it shows nothing.",
)
@click.option("--size", callback=_size, metavar="WxH", help="Size of the new images. [default: as before]")
@common
def undistort(
    path: Path,
    output: Path,
    cameras: tuple[str, ...],
    keep: str,
    size: tuple[int, int] | None,
    **common: Any,
) -> None:
    """Resample images so that their camera models are pinholes; what is drawn into them follows."""
    from sceneloom.editing.cameras import undistort_scene

    width, height = size or (None, None)

    def change(scenes: "Sequence[Scene]", _: Any) -> "Scene":
        chosen = known_ids(scenes[0], cameras)
        return undistort_scene(scenes[0], cameras=chosen, keep=KEEP[keep], width=width, height=height)

    run_edit("undistort", [path], output, change, **common)
