"""`sceneloom edit crop`: a part of a scene, in time, in space, of some sensors or labels."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.edit.running import common, editing, run_edit, trajectory
from sceneloom.cli.identifiers import known_ids

if TYPE_CHECKING:
    from sceneloom.editing.move_points import OnPoints
    from sceneloom.scene.scene import Scene

_CHOICES = ("start", "stop", "box", "frame", "reach", "trajectory", "heading")
"""Options that go to the function as they are."""


class Box(click.ParamType):  # type: ignore[type-arg, unused-ignore]  # generic in newer versions only
    """Six numbers with commas between them."""

    name = "box"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """Parse the numbers."""
        try:
            numbers = tuple(float(word) for word in value.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != 6:
            self.fail(f"{value!r}; expected six numbers xmin,ymin,zmin,xmax,ymax,zmax", param, ctx)
        return numbers


@click.command()
@editing
@options.part
@click.option(
    "--box", type=Box(), metavar="BOX", help="Keep what is in the space xmin,ymin,zmin,xmax,ymax,zmax [m]."
)
@click.option(
    "--frame",
    type=click.Choice(["world", "ego", "sensor"]),
    default="world",
    show_default=True,
    help="The frame along whose axes the box lies.",
)
@click.option(
    "--range",
    "reach",
    type=float,
    metavar="M",
    help="Keep what is at most so far from the sensor; from the ego with `--frame ego`.",
)
@click.option(
    "--sensor", "sensors", multiple=True, metavar="ID", help="The only sensors to keep. [default: all]"
)
@click.option("--without", multiple=True, metavar="ID", help="Sensors to leave out.")
@click.option(
    "--label", "labels", multiple=True, metavar="LABEL", help="The only labels to keep. [default: all]"
)
@trajectory
@common
def crop(
    path: Path,
    output: Path,
    sensors: tuple[str, ...],
    without: tuple[str, ...],
    labels: tuple[str, ...],
    **values: Any,
) -> None:
    """Keep a part of a scene: in time, in space, of some sensors or labels."""
    from sceneloom.editing.crop import crop_scene

    chosen = {name: values.pop(name) for name in _CHOICES}

    def change(scenes: "Sequence[Scene]", on_points: "OnPoints") -> "Scene":
        return crop_scene(
            scenes[0],
            sensors=known_ids(scenes[0], sensors),
            without=known_ids(scenes[0], without) or (),
            labels=labels or None,
            on_points=on_points,
            **chosen,
        )

    run_edit("crop", [path], output, change, **values)
