"""The file that a plot is drawn into, checked before anything is computed for it."""

from pathlib import Path
from typing import Any

from sceneloom.errors import MissingExtraError, OptionError, how_to_install
from sceneloom.formats.base.output import check_output

SUFFIXES = (".png", ".svg", ".pdf")


def check_plot(path: Path, *, overwrite: bool) -> Any:
    """Refuse an image that cannot be drawn or written, before anything is computed for it.

    Returns:
        matplotlib's class of figures.

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
    return Figure
