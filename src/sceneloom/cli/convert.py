"""`sceneloom convert`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.printing import SHOWN, print_json, print_table, print_warnings, progress_bar, several

if TYPE_CHECKING:
    from sceneloom.pipeline.converting import ConversionReport


_OWN = ("source", "target", "to", "trajectory", "strict", "loss", "overwrite", "reading", "progress")
"""What converting takes whatever the target's format."""


@click.command()
@click.argument("source", type=options.location)
@click.argument("target", type=options.target)
@options.writing_scenes
@click.option(
    "--images",
    type=click.Choice(["copy", "lossless", "h264", "ffv1", "png"]),
    help="How a recording's folder keeps images: `copy` a camera's own video packet by packet, and encode H.264 "
    "where there is none (`lossless`: FFV1); `h264`: the own video only if it is that; `ffv1` (video) and "
    "`png` (files) lose nothing. "
    "[default: copy]",
)
@click.option(
    "--trajectory",
    metavar="NAME",
    help="Which trajectory to write to a file of its own, `lidar`, `gnss`: computed, `fixes`: as received; of COLMAP, "
    "nerfstudio, nuScenes and clouds in another frame: by which to location things in the world, `identity`: "
    "stationary. "
    "[default: the drive's first one, else `gnss`, else `lidar`, else `identity`]",
)
@click.option(
    "--to",
    metavar="NAME",
    help="The format, or the form of a file of a trajectory, where TARGET's suffix should not decide: a name out of "
    "`sceneloom formats`.",
)
@click.option(
    "--strict",
    is_flag=True,
    help="Refuse to lose anything; what is only stated in another way, such as times in other units, passes.",
)
@click.option(
    "--loss",
    type=options.target,
    metavar="FILE",
    help="Write what becomes of every field to FILE: .json, .md or .txt.",
)
@click.option(
    "--output-option",
    "settings",
    multiple=True,
    metavar="NAME=VALUE",
    help="An option of TARGET's format, such as `frame=world` of clouds; each format's page lists its own.",
)
@click.option(
    "--channel",
    multiple=True,
    metavar="SENSOR=CHANNEL",
    help="The channel of a sensor in nuScenes, such as `lidar=LIDAR_TOP`; repeatable. [default: those that its "
    "development kit knows, else the sensors' ids]",
)
@click.option("--to-optical", is_flag=True, help="Write poses as a camera's: z forward, y down.")
@click.option(
    "--origin",
    "origin_lla",
    type=(options.finite, options.finite, options.finite),
    metavar="LAT LON ALT",
    help="Where on earth the world's origin is, for `--to gnss`. [default: that of GNSS, where it is known]",
)
@options.trajectories("from", "SOURCE")
@options.part
@options.reading
@options.printing
def convert(
    source: Path | str,
    target: Path,
    overwrite: bool,
    profile: str | None,
    time_unit: str | None,
    images: str | None,
    trajectory: str | None,
    to: str | None,
    strict: bool,
    loss: Path | None,
    settings: tuple[str, ...],
    channel: tuple[str, ...],
    to_optical: bool,
    origin_lla: tuple[float, float, float] | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
    **reading: Any,
) -> None:
    """Write a recording or a scene in another format; what the target cannot hold is reported.

    A TARGET without a suffix is a recording's folder, `.sfs` a scene file; `.tum`, `.kitti`, `.csv` (EuRoC) and
    `.jsonl` take one trajectory out of SOURCE, which may be such a file, too.
    """
    from sceneloom.pipeline.converting import convert as convert_scene
    from sceneloom.pipeline.converting import headline
    from sceneloom.stages import timed

    chosen = options.stated(
        profile=profile,
        time_unit=time_unit,
        images=images,
        channel=channel or None,
        optical=to_optical,
        origin_lla=origin_lla,
    )
    further = options.settings("--output-option", settings)
    for name in sorted({*_OWN, *chosen} & further.keys()):
        raise click.UsageError(
            f"--output-option {name} does not count here: what the verb itself takes has its own name"
        )
    with progress_bar("converting", quiet=quiet) as progress, timed() as stages:
        report = convert_scene(
            source,
            target,
            to=to,
            trajectory=trajectory,
            strict=strict,
            loss=loss,
            overwrite=overwrite,
            **chosen,
            **further,
            reading={name.removeprefix("from_"): value for name, value in options.stated(**reading).items()},
            progress=progress,
        )
    if as_json:
        print_json(report, stages=stages)
        return
    click.echo(headline(report))
    if not quiet:
        print_warnings(report.warnings, verbose=verbose)
        _print_supports(report, verbose=verbose)


def _print_supports(report: "ConversionReport", *, verbose: bool) -> None:
    """Print what is not simply kept, grouped by what became of it; every field where that is asked for."""
    from sceneloom.pipeline.converting import short_rows, support_groups, support_rows

    for title, fields, worth_telling in support_groups(report):
        click.echo(f"  {title}: {several(len(fields), 'field')}", err=True)
        if worth_telling or verbose:
            rows = support_rows(fields) if verbose else short_rows(fields)
            print_table(rows if verbose else rows[:SHOWN], indent="    ", err=True)
            if len(rows) > SHOWN and not verbose:
                click.echo(f"    … and {len(rows) - SHOWN} more: state --verbose", err=True)
