"""Files that plots are drawn into, without touching the caller's matplotlib: checked before anything is computed."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from sceneloom.errors import MissingExtraError, OptionError, how_to_install
from sceneloom.formats.base.output import check_output, replacing

SUFFIXES = (".png", ".svg", ".pdf")


def check_plot(path: Path, *, overwrite: bool) -> Callable[..., Any]:
    """Refuse a plot that cannot be drawn or written, before anything is computed for it.

    Returns:
        What makes a figure of a `figsize`; it draws with Agg and is not known to pyplot.

    Raises:
        OptionError: the suffix is none of `SUFFIXES`.
        OutputError: the file exists, or cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise OptionError(f"{path}: suffix {path.suffix!r}; expected one of {', '.join(SUFFIXES)}")
    check_output(path, overwrite=overwrite)
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtraError(f"{path}: drawing needs matplotlib: {how_to_install('report')}") from None
    return partial(Figure, dpi=120, layout="constrained")


def save_plot(figure: Any, title: str, path: Path, *, overwrite: bool) -> None:
    """Write a figure with a title.

    Raises:
        OutputError: the file exists, or cannot be written.
    """
    figure.suptitle(title, fontsize=11)
    with replacing(path, overwrite=overwrite) as draft:
        figure.savefig(draft, format=path.suffix[1:].lower())
