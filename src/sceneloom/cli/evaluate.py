"""`sceneloom eval`: an estimate and a reference in, metrics out."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.help import Verbs
from sceneloom.cli.options import option
from sceneloom.cli.printing import Printer, print_table, seconds, several
from sceneloom.cli.running import reading_verb, verb
from sceneloom.errors import SceneloomError

if TYPE_CHECKING:
    from sceneloom.evaluate.detection import DetectionReport, DetectionScores
    from sceneloom.evaluate.tracking import TrackingReport
    from sceneloom.evaluate.trajectory import ErrorStatistics, RelativeErrors, TrajectoryReport


@click.group("eval", cls=Verbs)
def evaluate() -> None:
    """Evaluate an estimate against a reference."""


def _threshold(name: str, help: str) -> "Callable[[options.Command], options.Command]":  # noqa: A002 - click's word
    """The least similarity of two boxes that match."""

    def share(text: str | float) -> float:
        return options.number(text, lambda value: 0.0 < value <= 1.0, "a number above 0, at most 1")

    return option(f"--threshold=S {name}", help, share)


_overwrite = option("--overwrite", "Replace an image that exists.")

_objects = options.stacked(
    click.argument("results", type=options.location, metavar="RESULTS"),
    click.argument("truth", type=options.location, metavar="TRUTH"),
    option(
        "--class=NAME… classes", "A class to evaluate; may be repeated. [default: KITTI's of the truth; of scenes all]"
    ),
    option(
        "--sequence=NAME… sequences",
        "A sequence to take, such as 0003; may be repeated for KITTI's text. [default: all of the truth]",
    ),
    option("-o --plot=OUT.png", "Plot the curves (.png, .svg, .pdf; needs sceneloom[report]).", options.target),
    _overwrite,
    click.option(
        "--no-corrections",
        "corrections",
        is_flag=True,
        flag_value="ignore",
        default="apply",
        help="Compare scenes without their localization adjustments. [default: apply them]",
    ),
    options.lenient,
)  # on both evaluations of objects


# detections


@evaluate.command(examples=("fused.jsonl labels.sfs", "results/ kitti_object/ --json"))
@_objects
@option(
    "--similarity=2d|bev|3d… similarities",
    "Overlap in the image, from above, in space; may be repeated. [default: all that both sides have]",
)
@_threshold("least_overlap", "Overlap from which a detection matches an object. [default: 0.7 for cars, else 0.5]")
@option(
    "--difficulty=easy|moderate|hard|all… difficulties",
    "Which objects must be found; may be repeated. [default: easy moderate hard; all without images]",
)
@option(
    "--regions-in-space",
    "Ignore detections in regions of DontCare also where boxes in space are compared, which KITTI does not.",
)
@option(
    "--degrees-of-freedom=NU",
    "Of the Student distribution of errors, for regions of covariances; more than 2. [default: Gaussian]",
    options.positive,
)
@verb
def detection(regions_in_space: bool, printer: Printer, **given: Any) -> None:
    """Evaluate the detections RESULTS against TRUTH: AP, F1, calibration of scores, by KITTI's rules.

    Both are KITTI's text (a file for each sequence or for each frame, in a folder, or one file), or scenes with
    cuboids; RESULTS may also be lists of detections, CLASS/NNNN.txt, or what `sceneloom fuse --type detection` wrote,
    whose covariances are evaluated, too.
    """
    from sceneloom.evaluate.detection import DetectionRules, compare_detections, plot_detection

    rules = DetectionRules(regions_in_space=regions_in_space)
    printer.show(_compared(compare_detections, plot_detection, rules=rules, **given), _print_detection)


def _compared(
    compare: Any,
    plot_report: Any,
    *,
    results: Path | str,
    truth: Path | str,
    plot: Path | None,
    overwrite: bool,
    **given: Any,
) -> Any:
    """The report of a comparison of objects, which is plotted if that was asked for."""
    from sceneloom.evaluate.plot import check_plot

    if plot is not None:
        check_plot(plot, overwrite=overwrite)
    report = compare(results, truth, **given)
    if plot is not None:
        plot_report(report, plot, overwrite=overwrite)
    return report


_DETECTION = ("AP40", "AP11", "max F1", "at score", "precision", "recall", "objects", "detections", "ECE")


def _print_detection(report: "DetectionReport", printer: Printer) -> None:
    """Print by class precision and recall, and how true scores and covariances are; shares in percent."""
    click.echo(f"{report.results} against {report.truth}")
    click.echo(several(len(report.sequences), "sequence"))
    for label, reported in report.classes.items():
        click.echo(label)
        rows = [
            (f"{one.similarity} > {one.least_overlap:g}", name, *_detection_cells(scores))
            for one in reported
            for name, scores in one.difficulties.items()
        ]
        print_table([("overlap", "", *_DETECTION), *rows])
        judged = next((one for one in reported if one.covariances), None)
        if judged is None or judged.covariances is None:
            continue
        levels = [part.level for part in next(iter(judged.covariances.values())).coverages]
        head = ("covariances", "errors", "rms", "NEES", "expected")
        covariances: list[tuple[str, ...]] = [(*head, *(f"{100 * level:g} %" for level in levels))]
        for name, part in judged.covariances.items():
            shares = (f"{100 * one.share:.2f}" for one in part.coverages)
            expected = f"{part.nees_low:.2f} to {part.nees_high:.2f}"
            numbers = (str(part.count), f"{part.root_mean_square:.3f}", f"{part.nees:.2f}")
            covariances.append((name, *numbers, expected, *shares))
        print_table(covariances)
        if judged.headings_reversed is not None:
            click.echo(f"  headings reversed: {100 * judged.headings_reversed:.2f} %")
    printer.warnings(report.warnings)


def _detection_cells(scores: "DetectionScores") -> list[str]:
    shares = [scores.ap40, scores.ap11, scores.max_f1, scores.precision, scores.recall]
    ap40, ap11, max_f1, precision, recall = (f"{100 * share:.2f}" for share in shares)
    threshold = "" if scores.threshold is None else f"{scores.threshold:.3f}"
    error = "" if scores.calibration is None else f"{scores.calibration.error:.4f}"
    counts = (str(scores.true_objects), str(scores.detections))
    return [ap40, ap11, max_f1, threshold, precision, recall, *counts, error]


# tracks


@evaluate.command(examples=("tracks/ kitti_tracking/", "tracks.sfs labels.sfs --json"))
@_objects
@option(
    "--similarity=2d|bev|3d|distance",
    "Similarity of two boxes: overlap in the image, from above, in space; distance of centres (0 at 4 m). "
    "[default: 2d, else 3d]",
)
@_threshold("least_similarity", "Similarity from which CLEAR and identity metrics match two boxes. [default: 0.5]")
@verb
def tracking(printer: Printer, **given: Any) -> None:
    """Evaluate the tracks RESULTS against TRUTH: HOTA, CLEAR MOT, IDF1, by KITTI's rules.

    Both are KITTI's text (a file NNNN.txt for each sequence, in a folder, or one file), or scenes with cuboids.
    """
    from sceneloom.evaluate.tracking import compare_tracks, plot_tracking

    printer.show(_compared(compare_tracks, plot_tracking, **given), _print_tracking)


_TRACKING = {
    "hota": ("HOTA", "DetA", "AssA", "LocA", "DetRe", "DetPr", "AssRe", "AssPr"),
    "clear": ("MOTA", "MOTP", "Recall", "Precision", "TP", "FN", "FP", "IDSW", "Frag", "MT", "PT", "ML"),
    "identity": ("IDF1", "IDP", "IDR", "IDTP", "IDFN", "IDFP"),
}  # the families of metrics


def _print_tracking(report: "TrackingReport", printer: Printer) -> None:
    """Print by class the families of metrics, of each sequence and of all together; shares in percent."""
    click.echo(f"{report.results} against {report.truth}")
    click.echo(
        f"{several(len(report.sequences), 'sequence')}, similarity {report.similarity}, "
        f"{report.least_similarity:g} for CLEAR and identities"
    )
    for label, scores in report.classes.items():
        combined = scores.combined
        click.echo(
            f"{label}: {several(combined.true_objects, 'object')} in {combined.true_boxes} boxes, "
            f"{several(combined.found_objects, 'track')} in {combined.found_boxes}"
        )
        parts = {**(scores.sequences if len(scores.sequences) > 1 else {}), "all": combined}
        for family, names in _TRACKING.items():
            rows = [("", *names)]
            for sequence, one in parts.items():
                values = [getattr(getattr(one, family), name.lower()) for name in names]
                cells = (str(value) if isinstance(value, int) else f"{100 * value:.2f}" for value in values)
                rows.append((sequence, *cells))
            print_table(rows)
    printer.warnings(report.warnings)


# trajectories


@evaluate.command(examples=("estimate.tum truth.tum", "fused.sfs truth.csv --json"))
@click.argument("estimate", type=options.location, metavar="EST")
@click.argument("reference", type=options.location, metavar="REF")
@option(
    "--align=none|origin|yaw|se3|sim3",
    "Align EST to REF first: by the first pose; translation and yaw; rigid; with scale.",
    default="se3",
)
@option("--align-first=N", "Align by the first N pairs only. [default: all]", click.IntRange(min=1))
@option(
    "--associate=interpolate|nearest",
    "Interpolate REF at the times of EST, or take its nearest poses.",
    default="interpolate",
)
@option("--tolerance=S", "Time to the nearest pose of REF at most. [default: 0.1, 0.01 for `nearest`]", float)
@option("--offset=S", "Seconds added to the times of EST.", default="0")
@options.part
@option(
    "--rpe-delta=STEP… rpe_deltas",
    "Compare motions over steps such as 1s, 10m, 1f (poses); may be repeated. [default: 1s 5m 10m 50m]",
)
@option("--plot=OUT.png", "Plot the trajectories from above and the errors.", options.target)
@_overwrite
@option("--est-name=NAME", "Which trajectory of EST.")
@option("--ref-name=NAME", "Which trajectory of REF.")
@options.trajectory_file("est", "EST")
@options.trajectory_file("ref", "REF")
@reading_verb
def trajectory(
    estimate: Path | str,
    reference: Path | str,
    offset: str,
    rpe_deltas: tuple[str, ...],
    printer: Printer,
    reading: dict[str, Any],
    **given: Any,
) -> None:
    """Evaluate the trajectory EST against the trajectory REF: ATE, RPE, KITTI's metrics, coverage.

    EST and REF are files (TUM, KITTI, EuRoC, GNSS, named columns, JSON lines) or drives; `PATH:NAME` names one of
    several trajectories; of a drive also `lidar` and `gnss` (computed) and `fixes` (as received). `--start` and
    `--stop` count from the first pose of REF.
    """
    from sceneloom.evaluate.plot import check_plot
    from sceneloom.evaluate.trajectory import RPE_DELTAS, evaluate_trajectory
    from sceneloom.formats.base.registry import SharedOptions
    from sceneloom.formats.trajectories.table import read_trajectory_file

    if given["plot"] is not None:
        check_plot(given["plot"], overwrite=given["overwrite"])
    shared, sides = SharedOptions(reading), {}
    for path, side in ((estimate, "est"), (reference, "ref")):
        own = options.stated(**options.of_side(given, f"{side}_"))
        with printer.progress(f"reading {side.upper()}") as progress:
            sides[side] = shared.read(partial(read_trajectory_file, path, progress=progress, **own))
    shared.check()
    try:
        report = evaluate_trajectory(
            sides["est"], sides["ref"], offset_ns=_offset_ns(offset), rpe_deltas=rpe_deltas or RPE_DELTAS, **given
        )
    except SceneloomError as error:
        for path in (estimate, reference):
            error.raised_with(str(path))
        raise
    printer.show(report, _print_trajectory)


def _offset_ns(text: str) -> int:
    """Seconds as they were typed, in nanoseconds, without rounding."""
    from sceneloom.formats.base.text_tables import TimestampError, parse_timestamp

    try:
        return parse_timestamp(text, "seconds")
    except TimestampError as error:
        raise click.BadParameter(str(error), param_hint="--offset") from None


_ERRORS = ("mean", "rms", "median", "95 %", "max", "min", "std")


def _print_trajectory(report: "TrajectoryReport", printer: Printer) -> None:
    """Print what was compared, the errors at the same times, those of motions, and KITTI's."""
    click.echo(f"{report.estimate} against {report.reference}")
    click.echo(
        f"{several(report.pairs, 'pair')} of {report.estimate_poses} and {report.reference_poses} poses, "
        f"{report.seconds:.3f} s from {seconds(report.start_ns)}, {report.path_length:.2f} m, "
        f"{100 * report.coverage:.1f} % of the reference's time"
    )
    how, absolute = report.alignment, report.absolute
    if how.kind == "none":
        click.echo("compared as they are, without alignment")
    else:
        scale = f", scale {how.scale:.6g}" if how.kind == "sim3" else ""
        click.echo(f"aligned by {how.kind} on {several(how.poses, 'pair')}{scale}")
    rows = [
        ("translation [m]", absolute.translation),
        ("  horizontal [m]", absolute.horizontal),
        ("  vertical [m]", absolute.vertical),
        ("rotation [°]", absolute.rotation_deg),
    ]
    click.echo("absolute errors (ATE)")
    print_table([("", *_ERRORS), *((name, *_error_cells(reported)) for name, reported in rows if reported is not None)])
    if report.relative:
        click.echo("errors of motions (RPE)")
        print_table([("over", "", *_ERRORS, "per metre", "per second"), *_relative_rows(report.relative)])
    if report.kitti is not None:
        click.echo("KITTI's odometry figures")
        table = [("segments of", "count", "translation", "rotation")]
        for part in (*report.kitti.by_length, report.kitti.overall):
            length = "all lengths" if part.length is None else f"{part.length:g} m"
            rotation = f"{part.rotation_deg_per_m:.6f} °/m"
            table.append((length, str(part.segments), f"{part.translation_percent:.4f} %", rotation))
        print_table(table)
    printer.warnings(report.warnings)


def _relative_rows(relative: "tuple[RelativeErrors, ...]") -> list[tuple[str, ...]]:
    rows = []
    for step in relative:
        percent, rotation = step.translation_percent, step.rotation_deg_per_m
        reported = "" if percent is None else f"{percent:.4g} %"
        rows.append((step.delta, "m", *_error_cells(step.translation), reported, f"{step.translation_per_s:.4g} m/s"))
        if step.rotation_deg is not None:
            reported = "" if rotation is None else f"{rotation:.4g} °/m"
            per_second = f"{step.rotation_deg_per_s:.4g} °/s"
            rows.append(("", "°", *_error_cells(step.rotation_deg), reported, per_second))
    return rows


def _error_cells(errors: "ErrorStatistics") -> list[str]:
    names = ("mean", "rms", "median", "percentile_95", "max", "min", "std")
    return [f"{getattr(errors, name):.4g}" for name in names]
