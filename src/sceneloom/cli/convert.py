"""`sceneloom convert`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.help import Verb
from sceneloom.cli.options import option
from sceneloom.cli.printing import SHOWN, Printer, print_table, several, wrote
from sceneloom.cli.running import reading_verb

if TYPE_CHECKING:
    from sceneloom.pipeline.converting import ConversionReport


@click.command(cls=Verb, examples=("drive/ drive.mcap", "drive.sfs nuscenes/ --to nuscenes --strict"))
@click.argument("source", type=options.location)
@click.argument("target", type=options.target)
@options.writing_scenes
@option(
    "--images=copy|lossless|h264|ffv1|png",
    "How a recording's folder keeps images: `copy` a camera's own video packet by packet, and encode H.264 "
    "where there is none (`lossless`: FFV1); `h264`: the own video only if it is that; `ffv1` (video) and "
    "`png` (files) lose nothing. [default: copy]",
)
@option(
    "--trajectory=NAME",
    "Trajectory to write to a file of its own. `lidar`, `gnss`: computed; `fixes`: as received. For COLMAP, "
    "nerfstudio, nuScenes and clouds in another frame: the one to transform by; `identity`: stationary. "
    "[default: the drive's first one, else `gnss`, else `lidar`, else `identity`]",
)
@option("--to=NAME", "Format of TARGET, where its suffix is ambiguous: a name from `sceneloom formats`.")
@option("--strict", "Refuse to lose anything; values in another representation, such as times in other units, pass.")
@option("--loss=FILE", "Write what becomes of every field to FILE: .json, .md or .txt.", options.target)
@option(
    "--output-option=NAME=VALUE… output_options",
    "An option of TARGET's format, such as `frame=world` for clouds; each format's page lists its own.",
)
@option(
    "--channel=SENSOR=CHANNEL…",
    "The channel of a sensor in nuScenes, such as `lidar=LIDAR_TOP`; may be repeated. [default: those that its "
    "development kit knows, else the sensors' ids]",
)
@option("--to-optical optical", "Write poses as a camera's: z forward, y down.")
@option(
    "--origin origin_lla",
    "Where on earth the world's origin is, for `--to gnss`. [default: that of GNSS, where it is known]",
    (options.finite, options.finite, options.finite),
    metavar="LAT LON ALT",
)
@options.trajectory_file("from", "SOURCE")
@options.part
@reading_verb
def convert(
    source: Path | str,
    target: Path,
    output_options: tuple[str, ...],
    printer: Printer,
    reading: dict[str, Any],
    **given: Any,
) -> None:
    """Write a recording or a scene in another format; what the target cannot hold is reported.

    A TARGET without a suffix is a recording's folder, `.sfs` a scene file; `.tum`, `.kitti`, `.csv` (EuRoC) and
    `.jsonl` take one trajectory out of SOURCE, which may be such a file, too.
    """
    from sceneloom.pipeline.converting import convert as convert_scene
    from sceneloom.stages import timed

    from_file = options.of_side(given, "from_")
    reading |= options.stated(**from_file, start=given.pop("start"), stop=given.pop("stop"))
    own = options.stated(**given | {"channel": given["channel"] or None})
    others: dict[str, Any] = {**options.pairs("--output-option", output_options)}
    for name in sorted({*_OWN, *own} & others.keys()):
        raise click.UsageError(
            f"--output-option {name} does not count here: what the verb itself takes has its own name"
        )
    with printer.progress("converting") as progress, timed() as stages:
        report = convert_scene(source, target, **own, **others, reading=reading, progress=progress)
    printer.show(report, _print_report, stages=stages)


_OWN = ("source", "target", "to", "trajectory", "strict", "loss", "overwrite", "reading", "progress")
"""What converting takes whatever the target's format."""


def _print_report(report: "ConversionReport", printer: Printer) -> None:
    """Print what is not simply kept, grouped by what became of it; every field where that is asked for."""
    click.echo(report.headline)
    if printer.quiet:
        return
    printer.warnings(report.warnings)
    for group in report.groups:
        click.echo(f"  {group.title}: {several(len(group.fields), 'field')}", err=True)
        if group.explained or printer.verbose:
            rows = group.rows if printer.verbose else group.short_rows
            print_table(rows if printer.verbose else rows[:SHOWN], indent="    ", err=True)
            if len(rows) > SHOWN and not printer.verbose:
                click.echo(f"    … and {len(rows) - SHOWN} more: `--verbose` lists them", err=True)
    if report.written:
        kept = {field.field: field.count for field in report.fields if field.support != "dropped"}
        dropped = sum(field.support == "dropped" for field in report.fields)
        remark = f"{several(dropped, 'field')} could not be kept" if dropped else ""
        wrote(report.target, {noun: kept.get(name, 0) for name, noun in _COUNTED.items()}, remark=remark)


_COUNTED = {
    "sensors.lidar.frames.timestamp_ns": "sweep",
    "sensors.camera.images.timestamp_ns": "image",
    "sensors.depth_camera.frames.timestamp_ns": "depth image",
    "sensors.radar.frames.timestamp_ns": "radar cycle",
    "annotations.cuboid.id": "cuboid",
    "trajectories.timestamps_ns": "trajectory",
}  # the fields of which the last line says how many were written
