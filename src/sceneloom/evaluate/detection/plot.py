"""The figures of detections in one image: for each class precision over recall, and whether scores are true."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sceneloom.evaluate.detection.calibration import Calibration
from sceneloom.evaluate.detection.comparison import DetectionReport
from sceneloom.evaluate.detection.evaluation import ClassDetection
from sceneloom.evaluate.plot import check_plot
from sceneloom.formats.output import replacing

_COLUMN_INCHES, _ROW_INCHES = 4.6, 4.4
_DPI = 120


def plot_detection(report: DetectionReport, path: Path, *, overwrite: bool = False) -> None:
    """Draw the figures of detections into a file, without touching what the caller does with matplotlib.

    Raises:
        OptionError: the suffix is none of `plot.SUFFIXES`.
        OutputError: the file exists, or cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    figure_of = check_plot(path, overwrite=overwrite)
    panels = _panels(report)
    rows, columns = max(1, len(report.classes)), max(1, len(panels))
    figure = figure_of(figsize=(_COLUMN_INCHES * columns, _ROW_INCHES * rows), dpi=_DPI, layout="constrained")
    grid = figure.add_gridspec(rows, columns)
    for row, (label, reported) in enumerate(report.classes.items()):
        for column, (draw, number) in enumerate(panels):
            draw(figure.add_subplot(grid[row, column]), label, reported[number])
    figure.suptitle(f"{report.results} against {report.truth}", fontsize=11)
    with replacing(path, overwrite=overwrite) as draft:
        figure.savefig(draft, format=path.suffix[1:].lower())


def _panels(report: DetectionReport) -> list[tuple[Callable[[Any, str, ClassDetection], None], int]]:
    """What is drawn of each class, from left to right, and of which similarity; only what some class has."""
    reported = [one for similarities in report.classes.values() for one in similarities]
    count = max((len(similarities) for similarities in report.classes.values()), default=0)
    panels: list[tuple[Callable[[Any, str, ClassDetection], None], int]]
    panels = [(_draw_precision, number) for number in range(count)]
    if any(scores.calibration for one in reported for scores in one.difficulties.values()):
        panels.append((_draw_reliability, count - 1))
    if any(one.covariances for one in reported):
        panels.append((_draw_coverage, count - 1))
    return panels


def _draw_precision(axes: Any, label: str, reported: ClassDetection) -> None:
    for name, scores in reported.difficulties.items():
        shown = f"{name}: AP40 {100 * scores.ap40:.2f}, F1 {100 * scores.max_f1:.2f}"
        (line,) = axes.plot(scores.recalls, scores.precisions, linewidth=1.6, label=shown)
        if scores.threshold is not None:
            axes.plot(scores.recall, scores.precision, marker="o", color=line.get_color(), markersize=5)
    axes.set_title(f"{label}, {reported.similarity} overlap above {reported.least_overlap:g}", fontsize=10)
    axes.set(xlabel="recall", ylabel="precision", xlim=(0, 1.02), ylim=(0, 1.02))
    axes.grid(visible=True, alpha=0.3)
    axes.legend(loc="lower left", fontsize=8)


def _draw_reliability(axes: Any, label: str, reported: ClassDetection) -> None:
    axes.plot([0, 1], [0, 1], color="0.6", linewidth=1)
    calibrations = {
        name: scores.calibration for name, scores in reported.difficulties.items() if scores.calibration
    }
    for name, calibration in calibrations.items():
        _draw_bins(axes, name, calibration)
    if calibrations:
        axes.legend(loc="upper left", fontsize=8)
    axes.set_title(f"{label}, reliability of scores, {reported.similarity}", fontsize=10)
    axes.set(xlabel="score", ylabel="share that is true", xlim=(0, 1.02), ylim=(0, 1.02))
    axes.grid(visible=True, alpha=0.3)


def _draw_bins(axes: Any, name: str, calibration: Calibration) -> None:
    filled = [part for part in calibration.bins if part.count]
    most = max(part.count for part in filled)
    scores, shares = [part.mean_score for part in filled], [part.share_true for part in filled]
    (line,) = axes.plot(scores, shares, linewidth=1.2, label=f"{name}: ECE {calibration.error:.3f}")
    sizes = [12 + 100 * part.count / most for part in filled]
    axes.scatter(scores, shares, s=sizes, color=line.get_color(), alpha=0.6)


def _draw_coverage(axes: Any, label: str, reported: ClassDetection) -> None:
    axes.plot([0, 1], [0, 1], color="0.6", linewidth=1)
    for name, part in (reported.covariances or {}).items():
        levels, shares = zip(*((one.level, one.share) for one in part.coverages), strict=True)
        shown = f"{name}: NEES {part.nees:.2f} of {part.dimensions}"
        axes.plot(levels, shares, marker="o", linewidth=1.2, label=shown)
    axes.set_title(f"{label}, regions of covariances", fontsize=10)
    axes.set(xlabel="what a region promises", ylabel="what it holds", xlim=(0.4, 1.02), ylim=(0.4, 1.02))
    axes.grid(visible=True, alpha=0.3)
    if reported.covariances:
        axes.legend(loc="upper left", fontsize=8)
