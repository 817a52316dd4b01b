"""`sceneloom view`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.help import Verb
from sceneloom.cli.options import option
from sceneloom.cli.printing import Printer, amount, several
from sceneloom.cli.running import reading_verb

if TYPE_CHECKING:  # the viewer takes long to import, and `--help` needs none of it
    from sceneloom.view.settings import DrivePart, ViewReport
    from sceneloom.view.viewer import Viewer

_FILE = options.source(exists=True, dir_okay=False)


@click.command(cls=Verb, examples=("drive.sfs", "drive.sfs --save drive.rrd"))
@click.argument("paths", nargs=-1, metavar="PATH...", type=options.location)
@options.lists('a path, or {"path": …, "start": …, "stop": …}, as `sceneloom catalog query --as list` writes')
@option("--save=F.rrd", "Save the view to a file that `rerun F.rrd` opens.", options.target)
@option("--web", "Show it in a browser on this machine, until Ctrl-C.")
@options.overwrite
@option(
    "--colour-by=colour|intensity|height|ring|time",
    "What to colour points by. [default: their own colours, else intensity, else height]",
)
@option("--start=S", "Begin S seconds after the first timestamp.", options.not_negative)
@option("--stop --end=S stop", "End before S seconds after it.", options.positive)
@option("--every=N", "Every Nth sweep, image, … of each sensor. [default: 1]", click.IntRange(min=1))
@option("--sensor --sensors sensors", "The only sensors to show. [default: all]", metavar="ID,…")
@options.trajectory(options.STATIONARY)
@option("--as-measured", "Do not undo the motion of the sensor during a sweep.")
@option("--detections=F", "Fused objects of `fuse --type detection`.", _FILE)
@option("--tracks=F", "Tracked objects of `track`, as JSON lines.", _FILE)
@option("--depth=DIR", "Depth images of `fuse --depth` or `depth`.", options.source(exists=True, file_okay=False))
@option("--no-findings", "Do not show the findings of `validate`.")
@option("--map-tiles", "Let the viewer fetch a map from OpenStreetMap to show behind fixes.")
@reading_verb
def view(
    paths: tuple[Path | str, ...],
    lists: tuple[Path, ...],
    save: Path | None,
    web: bool,
    overwrite: bool,
    printer: Printer,
    reading: dict[str, Any],
    **given: Any,
) -> None:
    """Look at drives in Rerun's viewer: every sensor, annotation and result, on one clock and in one world.

    Nothing leaves this machine. Several drives, or parts of them from a list, have a tab each, and one in which their
    worlds are overlaid.
    """
    from sceneloom.view.settings import ColourBy, ViewSettings
    from sceneloom.view.viewer import save_view, show_view

    given["colour_by"] = given["colour_by"] and ColourBy(given["colour_by"])
    sensors = options.names(given["sensors"])
    given["sensors"] = None if sensors is None else tuple(filter(None, sensors))
    settings = options.take(ViewSettings, given, findings=not given["no_findings"], reading=reading)
    sources = [*paths, *_listed(lists, quiet=printer.quiet)]
    if save is not None and web:
        raise click.UsageError("--save and --web: the one keeps the view, the other shows it; use one of them")
    with printer.progress("showing" if save is None else "saving") as progress:
        if save is not None:
            report = save_view(sources, save, settings=settings, overwrite=overwrite, progress=progress)
        else:
            report = show_view(sources, settings=settings, web=web, ready=_print_address, progress=progress)
    printer.show(report, _print_report)


def _listed(lists: tuple[Path, ...], *, quiet: bool) -> "list[DrivePart]":
    """The drives of lists, and the parts of them that these name."""
    if not lists:
        return []
    from sceneloom.cli.batch import find_listed, options_of
    from sceneloom.formats.base.registry import PART
    from sceneloom.view.settings import DrivePart

    return [
        DrivePart(
            options.location(drive.location),
            **{name: value for name, value in drive.options.items() if name in PART},
            reading=options_of(drive),
        )
        for drive in find_listed("view", (), lists, quiet=quiet)
    ]


def _print_address(viewer: "Viewer") -> None:
    if viewer.address is not None:
        click.echo(f"{viewer.address}\nopen this in a browser on this machine; Ctrl-C ends it", err=True)


def _print_report(report: "ViewReport", printer: Printer) -> None:
    for drive in report.drives:
        logged = ", ".join(f"{count} {kind}" for kind, count in drive.logged.items())
        click.echo(f"{drive.source}: {drive.seconds:.1f} s: {logged}")
    if report.output is not None:
        click.echo(
            f"saved {several(len(report.drives), 'drive')} in {report.seconds:.1f} s: {report.output} "
            f"({amount(report.size_bytes)}); look at it with `rerun {report.output}`"
        )
    for drive in report.drives:
        printer.warnings(drive.warnings)
