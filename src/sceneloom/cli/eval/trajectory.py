"""`sceneloom eval trajectory`: how far a trajectory is from a reference."""

from functools import partial
from pathlib import Path
from typing import Any

import click

from sceneloom.cli import options
from sceneloom.cli.eval.figures import print_report
from sceneloom.cli.printing import print_json, print_warnings, progress_bar
from sceneloom.errors import SceneloomError


@click.command()
@click.argument("estimate", type=options.location, metavar="EST")
@click.argument("reference", type=options.location, metavar="REF")
@click.option(
    "--align",
    type=click.Choice(["none", "origin", "yaw", "se3", "sim3"]),
    default="se3",
    show_default=True,
    help="Lay EST onto REF first: by the first pose; shift and heading; shift and rotate; and scale.",
)
@click.option(
    "--align-first",
    type=click.IntRange(min=1),
    metavar="N",
    help="Align by the first N pairs only. [default: all]",
)
@click.option(
    "--associate",
    type=click.Choice(["interpolate", "nearest"]),
    default="interpolate",
    show_default=True,
    help="Take REF between its poses, at the times of EST, or its own poses.",
)
@click.option(
    "--tolerance",
    type=float,
    metavar="S",
    help="How far the nearest pose of REF may be. [default: 0.1, 0.01 for `nearest`]",
)
@click.option("--offset", metavar="S", default="0", help="Seconds added to the times of EST.")
@options.part
@click.option(
    "--rpe-delta",
    "rpe_deltas",
    multiple=True,
    metavar="STEP",
    help="Compare motions over steps such as 1s, 10m, 1f (poses); may be stated again. [default: 1s 5m 10m 50m]",
)
@click.option(
    "--plot", type=options.target, metavar="OUT.png", help="Draw the trajectories from above and the errors."
)
@click.option("--overwrite", is_flag=True, help="Replace an image that exists.")
@click.option("--est-name", metavar="NAME", help="Which trajectory of EST.")
@click.option("--ref-name", metavar="NAME", help="Which trajectory of REF.")
@options.trajectories("est", "EST")
@options.trajectories("ref", "REF")
@options.reading
@options.printing
def trajectory(
    estimate: Path | str,
    reference: Path | str,
    offset: str,
    rpe_deltas: tuple[str, ...],
    as_json: bool,
    quiet: bool,
    verbose: bool,
    align: str,
    align_first: int | None,
    associate: str,
    tolerance: float | None,
    start: float | None,
    stop: float | None,
    plot: Path | None,
    overwrite: bool,
    **reading: Any,
) -> None:
    """Report how far the trajectory EST is from the trajectory REF: ATE, RPE, KITTI's figures, coverage.

    EST and REF are files (TUM, KITTI, EuRoC, GNSS, named columns, JSON lines) or drives; `PATH:NAME` names one of
    several trajectories; of a drive also `lidar` and `gnss` (computed) and `fixes` (as received). `--start` and
    `--stop` count from the first pose of REF.
    """
    from sceneloom.evaluate.plot import check_plot
    from sceneloom.evaluate.trajectory import RPE_DELTAS, evaluate_trajectory
    from sceneloom.formats.base.registry import SharedOptions
    from sceneloom.formats.trajectories.table import read_trajectory_file

    if plot is not None:
        check_plot(plot, overwrite=overwrite)
    own = {side: _own(reading, side) for side in ("est", "ref")}
    shared, sides = SharedOptions(options.stated(**reading)), {}
    for path, side in ((estimate, "est"), (reference, "ref")):
        with progress_bar(f"reading {side.upper()}", quiet=quiet) as progress:
            sides[side] = shared.read(partial(read_trajectory_file, path, progress=progress, **own[side]))
    shared.check()
    try:
        report = evaluate_trajectory(
            sides["est"],
            sides["ref"],
            align=align,
            align_first=align_first,
            associate=associate,
            tolerance=tolerance,
            offset_ns=_offset_ns(offset),
            start=start,
            stop=stop,
            rpe_deltas=rpe_deltas or RPE_DELTAS,
            plot=plot,
            overwrite=overwrite,
        )
    except SceneloomError as error:
        for path in (estimate, reference):
            error.raised_with(str(path))
        raise
    if as_json:
        print_json(report)
        return
    print_report(report)
    if not quiet:
        print_warnings(report.warnings, verbose=verbose)


def _own(reading: dict[str, Any], side: str) -> dict[str, Any]:
    """Take the options of one side out of all."""
    named = {name: reading.pop(name) for name in list(reading) if name.startswith(f"{side}_")}
    return options.stated(**{name.removeprefix(f"{side}_"): value for name, value in named.items()})


def _offset_ns(text: str) -> int:
    """Seconds as they were typed, in nanoseconds, without rounding."""
    from sceneloom.formats.base.text_tables import TimestampError, parse_timestamp

    try:
        return parse_timestamp(text, "seconds")
    except TimestampError as error:
        raise click.BadParameter(str(error), param_hint="--offset") from None
