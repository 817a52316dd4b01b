"""`sceneloom eval detection`: how good detections are."""

from pathlib import Path

import click

from sceneloom.cli import options
from sceneloom.cli.eval.detection_tables import print_detection
from sceneloom.cli.eval.object_options import share, sides_to_compare
from sceneloom.cli.printing import print_json, print_warnings


@click.command()
@sides_to_compare
@click.option(
    "--similarity",
    "similarities",
    type=click.Choice(["2d", "bev", "3d"]),
    multiple=True,
    help="Overlap in the image, from above, in space; may be stated again. [default: all that both sides have]",
)
@click.option(
    "--threshold",
    type=share,
    metavar="S",
    help="Overlap beyond which a detection has found an object. [default: 0.7 for cars, else 0.5]",
)
@click.option(
    "--difficulty",
    "difficulties",
    type=click.Choice(["easy", "moderate", "hard", "all"]),
    multiple=True,
    help="Which objects must be found; may be stated again. [default: easy moderate hard; all without images]",
)
@click.option(
    "--regions-in-space",
    is_flag=True,
    help="Excuse detections in regions of DontCare also where boxes in space are compared, which KITTI does not.",
)
@click.option(
    "--degrees-of-freedom",
    type=options.positive,
    metavar="NU",
    help="Of the Student distribution of errors, for regions of covariances; more than 2. [default: Gaussian]",
)
@options.printing
def detection(
    results: Path | str,
    truth: Path | str,
    classes: tuple[str, ...],
    sequences: tuple[str, ...],
    plot: Path | None,
    overwrite: bool,
    lenient: bool,
    corrections: str | None,
    similarities: tuple[str, ...],
    threshold: float | None,
    difficulties: tuple[str, ...],
    regions_in_space: bool,
    degrees_of_freedom: float | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
) -> None:
    """Report how good the detections RESULTS are, held against TRUTH: AP, F1, calibration of scores, by KITTI's rules.

    Both are KITTI's text (a file for each sequence or for each frame, in a folder, or one file), or scenes with
    cuboids; RESULTS may also be lists of detections, CLASS/NNNN.txt, or what `sceneloom fuse --type detection` wrote,
    whose covariances are judged, too.
    """
    from sceneloom.evaluate.detection import compare_detections, plot_detection
    from sceneloom.evaluate.plot import check_plot
    from sceneloom.evaluate.rules import DetectionRules

    if plot is not None:
        check_plot(plot, overwrite=overwrite)
    report = compare_detections(
        results,
        truth,
        classes=classes,
        sequences=sequences,
        similarities=similarities,
        least_overlap=threshold,
        difficulties=difficulties,
        degrees_of_freedom=degrees_of_freedom,
        rules=DetectionRules(regions_in_space=regions_in_space),
        lenient=lenient,
        corrections=corrections or "apply",
    )
    if plot is not None:
        plot_detection(report, plot, overwrite=overwrite)
    if as_json:
        print_json(report)
        return
    print_detection(report)
    if not quiet:
        print_warnings(report.warnings, verbose=verbose)
