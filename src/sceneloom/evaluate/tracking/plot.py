"""The figures of a tracker in one image: for each class HOTA and its parts over similarities, and the sequences."""

from pathlib import Path
from typing import Any

from sceneloom.evaluate.plot import check_plot
from sceneloom.evaluate.tracking.comparison import TrackingReport
from sceneloom.evaluate.tracking.evaluation import ClassTracking
from sceneloom.evaluate.tracking.scores import ALPHAS
from sceneloom.formats.output import replacing

_WIDTH_INCHES, _ROW_INCHES = 13.0, 4.6
_DPI = 120
_CURVES = {
    "hota": ("HOTA", "black", "-", 2.4),
    "deta": ("DetA", "tab:blue", "-", 1.4),
    "detre": ("DetRe", "tab:blue", "--", 1.0),
    "detpr": ("DetPr", "tab:blue", ":", 1.0),
    "assa": ("AssA", "tab:orange", "-", 1.4),
    "assre": ("AssRe", "tab:orange", "--", 1.0),
    "asspr": ("AssPr", "tab:orange", ":", 1.0),
    "loca": ("LocA", "tab:green", "-", 1.4),
}
"""By figure: its name, colour, dashes and width."""

_MOST_SEQUENCES = 40


def plot_tracking(report: TrackingReport, path: Path, *, overwrite: bool = False) -> None:
    """Draw the figures of a tracker into a file, without touching what the caller does with matplotlib.

    Raises:
        OptionError: the suffix is none of `plot.SUFFIXES`.
        OutputError: the file exists, or cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    figure_of = check_plot(path, overwrite=overwrite)
    rows = max(1, len(report.classes))
    figure = figure_of(figsize=(_WIDTH_INCHES, _ROW_INCHES * rows), dpi=_DPI, layout="constrained")
    grid = figure.add_gridspec(rows, 2, width_ratios=(1.0, 1.0))
    for row, (label, scores) in enumerate(report.classes.items()):
        _draw_curves(figure.add_subplot(grid[row, 0]), label, scores, report.similarity)
        _draw_sequences(figure.add_subplot(grid[row, 1]), scores)
    figure.suptitle(f"{report.results} against {report.truth}", fontsize=11)
    with replacing(path, overwrite=overwrite) as draft:
        figure.savefig(draft, format=path.suffix[1:].lower())


def _draw_curves(axes: Any, label: str, scores: ClassTracking, similarity: str) -> None:
    hota = scores.combined.hota
    for name, (shown, color, dashes, width) in _CURVES.items():
        reported = f"{shown} {100 * getattr(hota, name):.2f}"
        axes.plot(ALPHAS, hota.curves[name], color=color, linestyle=dashes, linewidth=width, label=reported)
    clear, identity = scores.combined.clear, scores.combined.identity
    axes.set_title(
        f"{label}: MOTA {100 * clear.mota:.2f}, IDF1 {100 * identity.idf1:.2f}, IDSW {clear.idsw}",
        fontsize=10,
    )
    axes.set(xlabel=f"least similarity ({similarity})", ylabel="share", xlim=(0, 1), ylim=(0, 1.02))
    axes.grid(visible=True, alpha=0.3)
    axes.legend(loc="lower left", fontsize=8, ncols=2)


def _draw_sequences(axes: Any, scores: ClassTracking) -> None:
    """HOTA, MOTA and IDF1 of each sequence with objects, side by side."""
    there = [name for name, one in scores.sequences.items() if one.true_boxes][:_MOST_SEQUENCES]
    bars = {
        "HOTA": [scores.sequences[name].hota.hota for name in there],
        "MOTA": [max(0.0, scores.sequences[name].clear.mota) for name in there],
        "IDF1": [scores.sequences[name].identity.idf1 for name in there],
    }
    for k, (shown, values) in enumerate(bars.items()):
        axes.bar(
            [location + 0.27 * (k - 1) for location in range(len(there))], values, width=0.25, label=shown
        )
    axes.set_xticks(range(len(there)), there, rotation=45 if len(there) > 6 else 0)
    axes.set(ylim=(0, 1.15))
    axes.set_title("sequences", fontsize=10)
    axes.grid(visible=True, axis="y", alpha=0.3)
    axes.legend(loc="upper center", fontsize=8, ncols=3)
