"""`sceneloom edit to-world`: bring points, poses and annotations into the world, each frame at its own time."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli.edit.running import annotations_in, common, editing, run_edit, trajectory

if TYPE_CHECKING:
    from sceneloom.editing.move_points import OnPoints
    from sceneloom.scene.scene import Scene


@click.command("to-world")
@editing
@trajectory
@annotations_in
@common
def to_world(
    path: Path,
    output: Path,
    trajectory: str | None,
    heading: str | None,
    annotations_in: str | None,
    **common: Any,
) -> None:
    """Bring points, poses and annotations into the world, each frame at its own time."""
    from sceneloom.editing.move_world import to_world as change_frame

    def change(scenes: "Sequence[Scene]", on_points: "OnPoints") -> "Scene":
        del on_points
        return change_frame(scenes[0], trajectory=trajectory, heading=heading, annotations_in=annotations_in)

    run_edit("to-world", [path], output, change, **common)
