"""`sceneloom edit anonymise`: positions, and on request times, that report neither location nor day."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli.edit.running import common, editing, run_edit

if TYPE_CHECKING:
    from sceneloom.scene.scene import Scene


@click.command()
@editing
@click.option(
    "--fixes",
    type=click.Choice(["drop", "shift"]),
    default="drop",
    show_default=True,
    help="What becomes of satellite fixes: left out, or put around latitude 0, longitude 0.",
)
@click.option(
    "--dates",
    type=click.Choice(["keep", "shift"]),
    default="keep",
    show_default=True,
    help="What becomes of the time of day: kept, or counted from the drive's first timestamp.",
)
@common
def anonymise(path: Path, output: Path, fixes: str, dates: str, **common: Any) -> None:
    """Take out of a drive where it was, by whom, and on request when."""
    from sceneloom.editing.anonymise import anonymised_scene

    def change(scenes: "Sequence[Scene]", _: Any) -> "Scene":
        return anonymised_scene(scenes[0], fixes=fixes, dates=dates)

    run_edit("anonymise", [path], output, change, **common)
