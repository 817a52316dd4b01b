"""What all verbs of `sceneloom edit` share: their options, and how they run and report."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from msgspec import structs

from sceneloom.cli import options
from sceneloom.cli.printing import print_json, print_losses, print_warnings, progress_bar, several

if TYPE_CHECKING:  # the pipeline takes seconds to import, and `--help` needs none of it
    from sceneloom.pipeline.editing import EditReport, Joining
    from sceneloom.scene.ego import EgoMotion
    from sceneloom.scene.scene import Scene

OUTPUT = click.option(
    "-o",
    "--output",
    type=options.target,
    required=True,
    help="The file or folder to write; its suffix chooses the format.",
)


annotations_in = click.option(
    "--annotations-in",
    type=click.Choice(["world", "ego"]),
    help="The frame of the annotations in a scene that does not state it. [default: world]",
)
"""On the verbs that bring annotations into another frame."""


trajectory = options.trajectory()
"""The options that choose the ego trajectory."""


def chosen_trajectory(
    scene: "Scene", trajectory: str | None, heading: str | None
) -> "EgoMotion | str | None":
    """The ego trajectory that was asked for; the name itself where the scene needs none.

    Which is for others to refuse.
    """
    from sceneloom.motion.ego_trajectory import find_ego_motion
    from sceneloom.scene.ego import needs_ego

    if (trajectory is None and heading is None) or not needs_ego(scene):
        return trajectory
    return find_ego_motion(scene, name=trajectory, heading=heading)


def editing(command: Callable[..., None]) -> Callable[..., None]:
    """The argument and the output of every verb that changes one drive; above its own options."""
    argument = click.argument("path", type=options.location)
    return argument(OUTPUT(command))


common = options.rewriting
"""The options of reading, writing and printing, below those of the verb; with `editing` what `run_edit` takes."""


def run_edit(
    edit: str,
    paths: Sequence[Path | str],
    output: Path,
    change: "Joining",
    *,
    details: Mapping[str, Any] | None = None,
    overwrite: bool,
    profile: str | None,
    time_unit: str | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **reading: Any,
) -> None:
    """Read, change, write and print; `change` makes one scene out of those read.

    What it then has put into `details` is reported besides: single values to people, all of it to machines.
    """
    from sceneloom.pipeline.editing import edit_files

    with progress_bar(f"edit {edit}", quiet=quiet) as progress:
        report = edit_files(
            edit,
            paths,
            output,
            change,
            reading=options.stated(**reading),
            progress=progress,
            overwrite=overwrite,
            **options.stated(profile=profile, time_unit=time_unit),
        )
    if as_json:
        print_json({**structs.asdict(report), **(details or {})})
        return
    for name, value in (details or {}).items():
        if isinstance(value, int | str):
            click.echo(f"{name.replace('_', ' ')}: {value}")
    print_edit(report, quiet=quiet, verbose=verbose)


def print_edit(report: "EditReport", *, quiet: bool, verbose: bool) -> None:
    """Print an edit for people."""
    before, after = report.before, report.after
    click.echo(f"{report.edit}: done in {report.seconds:.1f} s")
    for noun in ("sensor", "frame", "point", "annotation"):
        was, is_now = getattr(before, f"{noun}s"), getattr(after, f"{noun}s")
        those = " of the frames that stay" if noun == "point" and before.frames != after.frames else ""
        click.echo(several(was, noun) if was == is_now else f"{several(was, noun)}{those} -> {is_now}")
    click.echo(f"written: {report.output}")
    if not quiet:
        print_warnings(report.warnings, verbose=verbose)
        print_losses(report.losses, verbose=verbose)
