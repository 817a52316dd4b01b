"""`sceneloom edit simplify`: paths with fewer timestamps."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.edit.running import common, editing, run_edit

if TYPE_CHECKING:
    from sceneloom.scene.scene import Scene

PATHS = ("cuboids", "keypoints", "poses")


@click.command()
@editing
@click.option(
    "--tolerance-m",
    type=options.not_negative,
    default=0.01,
    show_default=True,
    metavar="M",
    help="How far interpolated locations and sizes may be from those left out.",
)
@click.option(
    "--tolerance-deg",
    type=options.not_negative,
    default=0.1,
    show_default=True,
    metavar="DEG",
    help="How far interpolated rotates may be from those left out.",
)
@click.option(
    "--only", multiple=True, type=click.Choice(PATHS), help="The only paths to simplify. [default: all]"
)
@common
def simplify(
    path: Path,
    output: Path,
    tolerance_m: float,
    tolerance_deg: float,
    only: tuple[str, ...],
    **common: Any,
) -> None:
    """Keep only those timestamps of paths that the others do not report within the tolerances."""
    from sceneloom.editing.simplify import simplify_scene

    chosen = {name: name in (only or PATHS) for name in PATHS}
    details: dict[str, Any] = {}

    def change(scenes: "Sequence[Scene]", _: Any) -> "Scene":
        known = scenes[0].warnings
        found = simplify_scene(scenes[0], tolerance_m=tolerance_m, tolerance_deg=tolerance_deg, **chosen)
        details["timestamps_left_out"] = sum(warning.count for warning in found.warnings[len(known) :])
        return found

    run_edit("simplify", [path], output, change, details=details, **common)
