"""`sceneloom edit to-sensor`: bring the points of lidars and radars into the frames of their sensors."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli.edit.running import common, editing, run_edit, trajectory

if TYPE_CHECKING:
    from sceneloom.editing.move_points import OnPoints
    from sceneloom.scene.scene import Scene


@click.command("to-sensor")
@editing
@trajectory
@common
def to_sensor(path: Path, output: Path, trajectory: str | None, heading: str | None, **common: Any) -> None:
    """Bring the points of lidars and radars into the frames of their sensors."""
    from sceneloom.editing.move_world import to_sensor as change_frame

    def change(scenes: "Sequence[Scene]", on_points: "OnPoints") -> "Scene":
        del on_points
        return change_frame(scenes[0], trajectory=trajectory, heading=heading)

    run_edit("to-sensor", [path], output, change, **common)
