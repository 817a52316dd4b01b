"""`sceneloom edit apply`: put localization adjustments and camera calibrations into effect."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli.edit.running import annotations_in, common, editing, run_edit

if TYPE_CHECKING:
    from sceneloom.editing.move_points import OnPoints
    from sceneloom.scene.scene import Scene


@click.command()
@editing
@click.option(
    "--only",
    multiple=True,
    metavar="ID",
    help="The only annotations to apply. [default: all adjustments and calibrations]",
)
@annotations_in
@common
def apply(path: Path, output: Path, only: tuple[str, ...], annotations_in: str | None, **common: Any) -> None:
    """Apply localization adjustments and camera calibrations; the scene then bears them no more."""
    from sceneloom.editing.apply import apply_corrections

    def change(scenes: "Sequence[Scene]", on_points: "OnPoints") -> "Scene":
        del on_points
        ids = [annotation.id for annotation in scenes[0].annotations]
        chosen = [next((i for i in ids if stated not in ids and str(i) == stated), stated) for stated in only]
        return apply_corrections(scenes[0], corrections=chosen or None, annotations_in=annotations_in)

    run_edit("apply", [path], output, change, **common)
