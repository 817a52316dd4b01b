"""The errors of a trajectory in one figure: trajectories from above, coloured by error, and the errors over time."""

from pathlib import Path
from typing import Any

from sceneloom.evaluate.plot import check_plot
from sceneloom.evaluate.trajectory_errors import TrajectoryErrors, TrajectoryReport
from sceneloom.formats.base.output import replacing

_SIZE_INCHES = (13.0, 6.5)
_DPI = 120
_MOST_LETTERS = 60


def _short(name: str) -> str:
    """A name that leaves room for the plot."""
    return name if len(name) <= _MOST_LETTERS else f"{name[: _MOST_LETTERS - 1]}…"


def plot_errors(
    errors: TrajectoryErrors, report: TrajectoryReport, path: Path, *, overwrite: bool = False
) -> None:
    """Draw errors into a file, without touching what the caller does with matplotlib.

    Raises:
        OptionError: the suffix is none of `SUFFIXES`.
        OutputError: the file exists, or cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    figure_of = check_plot(path, overwrite=overwrite)
    # a figure of its own draws with Agg and is not known to pyplot
    figure = figure_of(figsize=_SIZE_INCHES, dpi=_DPI, layout="constrained")
    rows = 1 if errors.rotation_deg is None else 2
    grid = figure.add_gridspec(rows, 2, width_ratios=(1.2, 1.0))
    _draw_map(figure, figure.add_subplot(grid[:, 0]), errors)
    seconds = errors.pairs.seconds
    statistics = report.absolute.translation
    top = figure.add_subplot(grid[0, 1])
    _draw_curve(top, seconds, errors.translation, "translation [m]", statistics.rms)
    if errors.rotation_deg is not None and report.absolute.rotation_deg is not None:
        below = figure.add_subplot(grid[1, 1], sharex=top)
        _draw_curve(below, seconds, errors.rotation_deg, "rotation [°]", report.absolute.rotation_deg.rms)
    figure.axes[-1].set_xlabel("time since the first pair [s]")
    figure.suptitle(_title(report), fontsize=11)
    with replacing(path, overwrite=overwrite) as draft:
        figure.savefig(draft, format=path.suffix[1:].lower())


def _draw_map(figure: Any, axes: Any, errors: TrajectoryErrors) -> None:
    axes.plot(
        *errors.reference_trajectory[:, :2].T,
        color="0.6",
        linewidth=3,
        label=_short(errors.reference_name),
        zorder=1,
    )
    dots = axes.scatter(
        *errors.aligned.positions[:, :2].T,
        c=errors.translation,
        s=8,
        cmap="viridis",
        label=_short(errors.estimate_name),
        zorder=2,
    )
    axes.plot(
        *errors.reference_trajectory[0, :2], marker="s", color="black", linestyle="", label="start", zorder=3
    )
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.grid(visible=True, alpha=0.3)
    axes.legend(loc="best")
    figure.colorbar(dots, ax=axes, label="error of translation [m]")


def _draw_curve(axes: Any, seconds: Any, values: Any, label: str, rms: float) -> None:
    axes.plot(seconds, values, color="tab:blue", linewidth=1.2)
    axes.axhline(rms, color="tab:red", linestyle="--", linewidth=1, label=f"rms {rms:.4g}")
    axes.set(ylabel=f"error of {label}", ylim=(0, None))
    axes.grid(visible=True, alpha=0.3)
    axes.legend(loc="upper right")


def _title(report: TrajectoryReport) -> str:
    scale = f", scale {report.alignment.scale:.6g}" if report.alignment.kind == "sim3" else ""
    return (
        f"{report.estimate} against {report.reference}: {report.pairs} pairs, {report.path_length:.4g} m, "
        f"alignment {report.alignment.kind}{scale}"
    )
