"""`sceneloom eval tracking`: how good a tracker is."""

from pathlib import Path

import click

from sceneloom.cli import options
from sceneloom.cli.eval.object_options import share, sides_to_compare
from sceneloom.cli.eval.tracking_tables import print_tracking
from sceneloom.cli.printing import print_json, print_warnings


@click.command()
@sides_to_compare
@click.option(
    "--similarity",
    type=click.Choice(["2d", "bev", "3d", "distance"]),
    help="What says how alike two boxes are: overlap in the image, from above, in space; distance of middles "
    "(0 at 4 m). [default: 2d, else 3d]",
)
@click.option(
    "--threshold",
    type=share,
    metavar="S",
    help="Similarity from which CLEAR and identities take two boxes for one object. [default: 0.5]",
)
@options.printing
def tracking(
    results: Path | str,
    truth: Path | str,
    classes: tuple[str, ...],
    sequences: tuple[str, ...],
    plot: Path | None,
    overwrite: bool,
    lenient: bool,
    corrections: str | None,
    similarity: str | None,
    threshold: float | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
) -> None:
    """Report how good the tracks RESULTS are, held against TRUTH: HOTA, CLEAR MOT, IDF1, by KITTI's rules.

    Both are KITTI's text (a file NNNN.txt for each sequence, in a folder, or one file), or scenes with cuboids.
    """
    from sceneloom.evaluate.plot import check_plot
    from sceneloom.evaluate.tracking import compare_tracks, plot_tracking

    if plot is not None:
        check_plot(plot, overwrite=overwrite)
    report = compare_tracks(
        results,
        truth,
        classes=classes,
        sequences=sequences,
        similarity=similarity,
        least_similarity=threshold,
        lenient=lenient,
        corrections=corrections or "apply",
    )
    if plot is not None:
        plot_tracking(report, plot, overwrite=overwrite)
    if as_json:
        print_json(report)
        return
    print_tracking(report)
    if not quiet:
        print_warnings(report.warnings, verbose=verbose)
