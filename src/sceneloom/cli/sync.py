"""`sceneloom sync`."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.help import Verb
from sceneloom.cli.options import option
from sceneloom.cli.printing import Printer, print_table, several, wrote
from sceneloom.cli.running import rewriting_verb

if TYPE_CHECKING:
    from sceneloom.motion.clock.comparison import ClockEstimate
    from sceneloom.pipeline.syncing import SyncReport


@click.command(cls=Verb, examples=("drive/", "drive/ --reference imu --json"))
@click.argument("path", type=options.location)
@option("--reference=STREAM", "The stream of reference. [default: the IMU, else …]")
@option("--streams=NAMES", "The only streams to compare, with commas. [default: all]")
@option("--reach=S", "Search for offsets up to S seconds.", options.positive, default=5.0)
@option("--tolerance=S", "Offsets up to S seconds do no harm.", options.positive, default=0.005)
@option(
    "--lever=M lever_sigma",
    "Standard deviation of a receiver's antenna's distance from the ego's origin.",
    options.not_negative,
    default=1.0,
)
@option("--apply=OUT output", "Write the drive with clocks corrected.", options.target)
@options.part
@rewriting_verb
def sync(
    path: Path | str,
    output: Path | None,
    start: float | None,
    stop: float | None,
    streams: str | None,
    reach: float,
    tolerance: float,
    printer: Printer,
    reading: dict[str, Any],
    **given: Any,
) -> None:
    """Check whether the clocks of a drive's streams are synchronised, and correct those that are not.

    Streams are IMUs, trajectories, lidars, cameras and satellite receivers. Their motion is compared: a constant delay
    between two streams is the offset of their clocks, a growing one the skew. A stream is in step, or off, where the
    99 % interval of its offset is within, or beyond, the tolerance.
    """
    from sceneloom.formats.base.registry import open_scene
    from sceneloom.pipeline.syncing import sync as sync_scene
    from sceneloom.scene.time_range import cut_scene

    writing = options.scene_options(given)
    limits = {"reach_ns": round(reach * 1e9), "tolerance_ns": round(tolerance * 1e9)}
    own = {"streams": options.names(streams), **limits, **given}
    with open_scene(path, **reading) as scene, printer.progress("looking") as progress:
        part = cut_scene(scene, start=start, stop=stop)
        report = sync_scene(part, output, progress=progress, **own, **({} if output is None else writing))
    printer.show(report, _print_report)


def _print_report(report: "SyncReport", printer: Printer) -> None:
    if not report.comparisons:
        click.echo(f"{report.source}: nothing to compare: two streams that report the ego's motion are needed")
        return
    verdicts = Counter(c.estimate.verdict for c in report.comparisons if c.reference == report.reference)
    found = ", ".join(f"{count} {verdict}" for verdict, count in sorted(verdicts.items()))
    compared = f"{several(verdicts.total(), 'stream')} against {report.reference}"
    click.echo(f"{report.source}: {compared}: {found}; tolerance {report.tolerance_ns / 1e6:g} ms")
    titles = ("stream", "against", "by", "offset [ms]", "99 % [ms]", "skew [ppm]", "verdict")
    print_table([titles, *map(_row, report.comparisons)])
    if report.output is not None:
        for correction in report.applied:
            skew = f", skew {correction.skew_ppm:+.1f} ppm" if correction.skew_ppm else ""
            through = f" (through {correction.through})" if correction.through else ""
            click.echo(f"corrected: {correction.stream}: {-correction.offset_ns / 1e6:+.3f} ms{skew}{through}")
        wrote(report.output)
    printer.remarks(report)


def _row(comparison: Any) -> tuple[str, ...]:
    estimate: ClockEstimate = comparison.estimate
    return (
        comparison.stream,
        comparison.reference,
        comparison.method,
        _measured(estimate.offset_ns, estimate.offset_sigma_ns, 1e6),
        "-" if estimate.interval_ns is None else " to ".join(f"{end / 1e6:+.1f}" for end in estimate.interval_ns),
        _measured(estimate.skew_ppm, estimate.skew_sigma_ppm, 1.0),
        estimate.summary,
    )


def _measured(value: float | None, sigma: float | None, unit: float) -> str:
    if value is None or sigma is None:
        return "-"
    digits = 3 if sigma / unit < 0.1 else 1
    return f"{value / unit:+.{digits}f} ± {sigma / unit:.{digits}f}"
