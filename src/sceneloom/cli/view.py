"""`sceneloom view`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.printing import amount, print_json, print_warnings, progress_bar, several

if TYPE_CHECKING:  # the viewer takes long to import, and `--help` needs none of it
    from sceneloom.view.settings import DrivePart, DriveShown, ViewReport
    from sceneloom.view.viewer import Viewer

_FILE = options.source(exists=True, dir_okay=False)
_FOLDER = options.source(exists=True, file_okay=False)


@click.command()
@click.argument("paths", nargs=-1, metavar="PATH...", type=options.location)
@options.lists('a path, or {"path": …, "start": …, "stop": …}, as `sceneloom catalog query --as list` writes')
@click.option(
    "--save", type=options.target, metavar="F.rrd", help="Save the view to a file that `rerun F.rrd` opens."
)
@click.option("--web", is_flag=True, help="Look at it in a browser on this machine, until Ctrl-C.")
@click.option("--overwrite", is_flag=True, help="Replace the file if it exists.")
@click.option(
    "--colour-by",
    type=click.Choice(["colour", "intensity", "height", "ring", "time"]),
    help="What gives points their colours. [default: their own, else intensity, else height]",
)
@click.option(
    "--start", type=options.not_negative, metavar="S", help="Begin S seconds after the first timestamp."
)
@click.option(
    "--stop", "--end", "stop", type=options.positive, metavar="S", help="End before S seconds after it."
)
@click.option(
    "--every",
    type=click.IntRange(min=1),
    metavar="N",
    help="Every Nth sweep, image, … of each sensor. [default: 1]",
)
@click.option(
    "--sensor", "--sensors", "sensors", metavar="ID,…", help="The only sensors to show. [default: all]"
)
@options.trajectory(further="`identity`: it was stationary")
@click.option(
    "--as-measured", is_flag=True, help="Leave points where they were measured while the sensor moved."
)
@click.option("--detections", type=_FILE, metavar="F", help="Fused objects of `fuse --type detection`.")
@click.option("--tracks", type=_FILE, metavar="F", help="Tracked objects of `track`, as lines of JSON.")
@click.option("--depth", type=_FOLDER, metavar="DIR", help="Depth images of `fuse --depth` or `depth`.")
@click.option("--no-findings", is_flag=True, help="Leave out what the rules of `validate` find.")
@click.option(
    "--map-tiles", is_flag=True, help="Let the viewer fetch a map from OpenStreetMap to go behind fixes."
)
@options.reading
@options.printing
def view(
    paths: tuple[Path | str, ...],
    lists: tuple[Path, ...],
    save: Path | None,
    web: bool,
    overwrite: bool,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **given: Any,
) -> None:
    """Look at drives in Rerun's viewer: every sensor, annotation and result, on one clock and in one world.

    Nothing leaves this machine. Several drives, or parts of them out of a list, have a tab
    each, and one in which their worlds lie over each other.
    """
    from sceneloom.view.viewer import save_view, show_view

    settings, sources = _settings(given), [*paths, *_listed(lists, quiet=quiet)]
    if save is not None and web:
        raise click.UsageError(
            "--save and --web: the one keeps the view, the other shows it; state one of them"
        )
    with progress_bar("showing" if save is None else "saving", quiet=quiet) as progress:
        if save is not None:
            report = save_view(sources, save, settings=settings, overwrite=overwrite, progress=progress)
        else:
            report = show_view(sources, settings=settings, web=web, ready=_report_where, progress=progress)
    if as_json:
        print_json(report)
    else:
        print_view(report, quiet=quiet, verbose=verbose)


def _listed(lists: tuple[Path, ...], *, quiet: bool) -> "list[DrivePart]":
    """The drives of lists, and the parts of them that these name."""
    if not lists:
        return []
    from sceneloom.batch.jobs import READING
    from sceneloom.cli.batch.listed import find_listed
    from sceneloom.formats.base.registry import PART
    from sceneloom.view.settings import DrivePart

    return [
        DrivePart(
            options.location(drive.location),
            **{name: value for name, value in drive.options.items() if name in PART},
            reading={
                name.removeprefix(READING): value
                for name, value in drive.options.items()
                if name.startswith(READING)
            },
        )
        for drive in find_listed("view", (), lists, quiet=quiet)
    ]


def _settings(given: dict[str, Any]) -> Any:
    from sceneloom.view.settings import ColourBy, ViewSettings

    own = (
        "start",
        "stop",
        "every",
        "trajectory",
        "heading",
        "as_measured",
        "detections",
        "tracks",
        "depth",
        "map_tiles",
    )
    colour_by, sensors = given["colour_by"], given["sensors"]
    shown = options.stated(**{name: given[name] for name in own})
    further = {"colour_by", "sensors", "no_findings", *own}
    return ViewSettings(
        **shown,
        colour_by=None if colour_by is None else ColourBy(colour_by),
        sensors=None if sensors is None else tuple(filter(None, map(str.strip, sensors.split(",")))),
        findings=not given["no_findings"],
        reading=options.stated(**{name: value for name, value in given.items() if name not in further}),
    )


def _report_where(viewer: "Viewer") -> None:
    if viewer.address is not None:
        click.echo(f"{viewer.address}\nopen this in a browser on this machine; Ctrl-C ends it", err=True)


def print_view(report: "ViewReport", *, quiet: bool, verbose: bool) -> None:
    """Print what was shown."""
    for drive in report.drives:
        click.echo(f"{drive.source}: {_counted(drive)}")
    if report.output is not None:
        click.echo(
            f"saved {several(len(report.drives), 'drive')} in {report.seconds:.1f} s: {report.output} "
            f"({amount(report.size_bytes)}); look at it with `rerun {report.output}`"
        )
    if not quiet:
        for drive in report.drives:
            print_warnings(drive.warnings, verbose=verbose)


def _counted(drive: "DriveShown") -> str:
    """What was logged of a drive: the frames first."""
    return f"{drive.seconds:.1f} s: " + ", ".join(f"{count} {kind}" for kind, count in drive.logged.items())
